"""Outputs appear whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from saltus.errors import DataError

__all__ = ["output_directory", "output_file"]


@contextmanager
def output_directory(path: Path | str, stale: Collection[str] = ()) -> Iterator[Path]:
    """Give a temporary directory whose files are moved into `path` when the block ends well.

    The temporary directory lies in `path` if that exists (whose parent may be another file system, or read-only), else
    beside it: each file moves by one atomic rename. When the block raises (Ctrl-C included) it is removed: `path` and
    older files in it stay as they were.

    Args:
        path: directory to fill; made, with its parents, if absent. Other files in it stay.
        stale: names of older files that do not belong with the new ones: removed when those appear, unless written.

    Yields:
        The temporary directory to write into; subdirectories are allowed.

    Raises:
        DataError: `path` is no directory, is the root, or cannot be written.
    """
    target = _absolute(path)
    if target == target.parent:
        raise DataError(f"{path}: is the root of the file system; name a folder of its own for the output.")
    if target.exists() and not target.is_dir():
        raise DataError(f"{path}: the output must be a directory; a file of that name exists.")
    with _named(path, target):
        if not target.is_dir():
            target.parent.mkdir(parents=True, exist_ok=True)
        place = target if target.is_dir() else target.parent
        temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".tmp", dir=place))
    try:
        with _named(path, target, temporary):
            yield temporary
        with _named(path, target):
            _move(temporary, target, stale)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _move(temporary: Path, target: Path, stale: Collection[str]) -> None:
    target.mkdir(exist_ok=True)
    written = sorted(p.relative_to(temporary) for p in temporary.rglob("*") if p.is_file())
    for name in written:
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(temporary / name, target / name)
    for old in {Path(name) for name in stale}.difference(written):
        (target / old).unlink(missing_ok=True)


@contextmanager
def output_file(path: Path | str) -> Iterator[Path]:
    """Give a temporary file name beside `path`, renamed to it in one step when the block ends well.

    Args:
        path: file to write; its directory is made if absent.

    Yields:
        The temporary name, with the suffix of `path`.

    Raises:
        DataError: `path` is a directory or cannot be written, or the block wrote nothing.
    """
    target = _absolute(path)
    if target.is_dir():
        raise DataError(f"{path}: is a directory; give the name of a file.")
    temporary = target.with_name(f".{target.stem}.{os.getpid()}.tmp{target.suffix}")
    with _named(path, target):
        target.parent.mkdir(parents=True, exist_ok=True)
    try:
        with _named(path, target, temporary):
            yield temporary
        if not temporary.exists():
            raise DataError(f"{path}: nothing was written.")
        with _named(path, target):
            os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def _named(path: Path | str, target: Path, temporary: Path | None = None) -> Iterator[None]:
    """Blame the path that the user gave for a failure to write; of the block's own failures, those in `temporary`."""
    try:
        yield
    except OSError as error:
        if temporary is not None and not str(error.filename or "").startswith(str(temporary)):
            raise
        in_the_way = next((p for p in target.parents if p.exists() and not p.is_dir()), None)
        if in_the_way is not None:
            raise DataError(f"{path}: {in_the_way} is a file; name an output that is not inside it.") from error
        said = (error.strerror or str(error)).lower()
        raise DataError(f"{path}: cannot be written ({said}); name a place that you may write to.") from error


def _absolute(path: Path | str) -> Path:
    """Resolve links and `.`: the temporary must lie on the target's own file system."""
    return Path(path).resolve()
