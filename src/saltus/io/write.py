"""Outputs appear whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from saltus.errors import DataError

__all__ = ["output_directory", "output_file"]


@contextmanager
def output_directory(path: Path | str) -> Iterator[Path]:
    """Give a temporary directory whose files are moved into `path` when the block ends well.

    The temporary directory lies beside `path`, on the same file system: each file moves by one atomic rename.
    When the block raises (Ctrl-C included) it is removed: `path` and older files in it stay as they were.

    Args:
        path: directory to fill; made, with its parents, if absent. Other files in it stay.

    Yields:
        The temporary directory to write into; subdirectories are allowed.

    Raises:
        DataError: `path` exists and is not a directory.
    """
    target = _absolute(path)
    if target.exists() and not target.is_dir():
        raise DataError(f"{path}: the output must be a directory; a file of that name exists.")
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".tmp", dir=target.parent))
    try:
        yield temporary
        target.mkdir(exist_ok=True)
        for written in sorted(p for p in temporary.rglob("*") if p.is_file()):
            place = target / written.relative_to(temporary)
            place.parent.mkdir(parents=True, exist_ok=True)
            os.replace(written, place)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def output_file(path: Path | str) -> Iterator[Path]:
    """Give a temporary file name beside `path`, renamed to it in one step when the block ends well.

    Args:
        path: file to write; its directory is made if absent.

    Yields:
        The temporary name, with the suffix of `path`.

    Raises:
        DataError: `path` is a directory, or the block wrote nothing.
    """
    target = _absolute(path)
    if target.is_dir():
        raise DataError(f"{path}: is a directory; give the name of a file.")
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.stem}.{os.getpid()}.tmp{target.suffix}")
    try:
        yield temporary
        if not temporary.exists():
            raise DataError(f"{path}: nothing was written.")
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def _absolute(path: Path | str) -> Path:
    """Resolve links and `.`: the temporary sibling must lie on the target's own file system."""
    return Path(path).resolve()
