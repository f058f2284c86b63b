"""Outputs appear whole or not at all."""

import errno
import json
import os
import shutil
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from saltus.errors import DataError
from saltus.io.publish import is_stage, open_stage, publish, settle, sweep

if TYPE_CHECKING:
    import pyarrow as pa

__all__ = ["blamed", "output_directory", "output_file", "write_batches", "write_json", "write_table", "write_text"]

_GROUP = 1 << 16  # rows of a table that are written together
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def output_directory(path: Path | str, kind: str = "results", kept: Collection[str] = ()) -> Iterator[Path]:
    """Give a temporary folder whose files take the place of an older set in `path` when the block ends well.

    At any moment, killed or not, `path` holds the old set or the new one (`saltus.io.publish`). When the block raises,
    Ctrl-C included, the temporary folder goes and `path` stays as it was; that of a killed run goes with the next run.

    Args:
        path: folder to fill; made, with its parents, if absent. Files in it that belong to no set of this kind stay.
        kind: of the set: the new one replaces an older one of its kind, whatever that had.
        kept: names of files that the next set does not take with it when it goes, such as recordings.

    Yields:
        The temporary folder to write files into.

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
        for place in {target, target.parent} if target.is_dir() else {target.parent}:
            sweep(place, target.name, target)
        settle(target)
        stage = open_stage(target if target.is_dir() else target.parent, target.name)
    try:
        with _named(path, target, stage.path):
            yield stage.path
        with _named(path, target):
            publish(stage, target, kind, frozenset(kept))
    finally:
        stage.close()
        shutil.rmtree(stage.path, ignore_errors=True)


@contextmanager
def output_file(path: Path | str) -> Iterator[Path]:
    """Give a temporary file name, renamed to `path` in one step when the block ends well.

    What is no regular file, as a pipe or /dev/null, is written directly, and what is to appear with others too.

    Args:
        path: file to write; its directory is made if absent.

    Yields:
        The name to write to, with the suffix of `path`.

    Raises:
        DataError: `path` is a directory or cannot be written, or the block wrote nothing.
    """
    target = _absolute(path)
    if target.is_dir():
        raise DataError(f"{path}: is a directory; give the name of a file.")
    if Path(path).exists() and not target.is_file():
        with _named(path, target, target):
            yield Path(path)
        return
    if is_stage(target.parent.name):
        with blamed(target):
            yield target
        return
    with _named(path, target):
        target.parent.mkdir(parents=True, exist_ok=True)
        sweep(target.parent, target.name, target)
        stage = open_stage(target.parent, target.name)
    try:
        temporary = stage.path / target.name
        with _named(path, target, temporary):
            yield temporary
        if not temporary.exists():
            raise DataError(f"{path}: nothing was written.")
        with _named(path, target):
            os.replace(temporary, target)
    finally:
        stage.close()
        shutil.rmtree(stage.path, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Write text as UTF-8; a failure names the file."""
    with blamed(path):
        path.write_text(text, encoding="utf-8")


def write_json(path: Path, tree: object) -> None:
    """Write JSON, which knows no NaN; a failure names the file.

    Raises:
        ValueError: a number is not finite.
    """
    write_text(path, json.dumps(tree, indent=2, allow_nan=False) + "\n")


def write_table(path: Path, table: "pa.Table") -> None:
    """Write a table as Parquet; a failure names the file."""
    import pyarrow.parquet as pq

    with blamed(path), path.open("wb") as file:
        pq.write_table(table, file)


def write_batches(path: Path, batches: Iterable["pa.Table"]) -> None:
    """Write batches of one table as Parquet, so many rows a group; a failure names the file.

    Raises:
        ValueError: there is none.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    batches = iter(batches)
    first = next(batches, None)
    if first is None:
        raise ValueError(f"{path}: a table has one batch at least, which says what its columns are.")
    with blamed(path), path.open("wb") as file, pq.ParquetWriter(file, first.schema) as writer:
        waiting, n = [first], first.num_rows
        for batch in batches:
            if n + batch.num_rows > _GROUP:
                writer.write_table(pa.concat_tables(waiting))
                waiting, n = [], 0
            waiting.append(batch)
            n += batch.num_rows
        writer.write_table(pa.concat_tables(waiting))


@contextmanager
def blamed(path: Path) -> Iterator[None]:
    """Name the file in failures that do not: systems name it when it is opened, not when the disk is full."""
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            raise
        code = error.errno or errno.EIO
        raise OSError(code, os.strerror(code), str(path)) from error


@contextmanager
def _named(path: Path | str, target: Path, temporary: Path | None = None) -> Iterator[None]:
    """Blame what the user gave for a failure to write; of the block's own failures, those in `temporary`."""
    try:
        yield
    except OSError as error:
        failed = Path(os.fsdecode(error.filename or ""))
        inside = temporary is not None and failed.is_relative_to(temporary)
        if temporary is not None and not inside and (error.filename is not None or error.errno not in _FULL):
            raise
        in_the_way = next((p for p in target.parents if p.exists() and not p.is_dir()), None)
        if in_the_way is not None:
            raise DataError(f"{path}: {in_the_way} is a file; name an output that is not inside it.") from error
        file = Path(path) / failed.relative_to(temporary) if temporary is not None and inside else path
        said = (error.strerror or str(error)).lower()
        mend = "make room" if error.errno in _FULL else "name a place that you may write to"
        raise DataError(f"{file}: cannot be written ({said}); {mend}.") from error


def _absolute(path: Path | str) -> Path:
    """Resolve links and `.`: the temporary must lie on the target's own file system."""
    return Path(path).resolve()
