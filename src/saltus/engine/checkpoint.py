"""A checkpoint: a session's state as one file of arrays and one of words, replaced as a whole.

What was changed after it was written is refused: arrays and words have a checksum, and so has each of the journal's
segments. A changed number would otherwise be a wrong state, and go unnoticed.
"""

import json
import os
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from saltus.engine.arrays import flattened, nested
from saltus.engine.journal import SCHEMA
from saltus.errors import DataError

__all__ = ["begin_anew", "has_checkpoint", "load_checkpoint", "save_checkpoint", "understood"]

FORMAT = 2
_POINTER = "checkpoint.json"
_STATE = re.compile(r"state-\d{6}\.npz")
_OURS = re.compile(rf"{_STATE.pattern}|[a-z]+-\d{{6}}\.arrow")


def has_checkpoint(folder: Path) -> bool:
    """Say whether a state was saved in a folder."""
    return (folder / _POINTER).exists()


def begin_anew(folder: Path) -> None:
    """Forget the state saved in a folder, and remove its journal, which is about to be written anew."""
    (folder / _POINTER).unlink(missing_ok=True)
    for path in sorted(folder.glob("*-*")):
        if _OURS.fullmatch(path.name):
            path.unlink()


def save_checkpoint(folder: Path, state: Mapping[str, Any], words: Mapping[str, Any]) -> None:
    """Write a state; a reader finds the one before until this one is whole.

    Args:
        folder: where.
        state: nested mappings of arrays.
        words: what is no array, fit for JSON.
    """
    folder.mkdir(parents=True, exist_ok=True)
    before = _pointer(folder)
    number = 0 if before is None else int(before["number"]) + 1
    name = f"state-{number:06d}.npz"
    with (folder / name).open("wb") as file:
        np.savez(file, allow_pickle=False, **dict(flattened(state)))
        file.flush()
        os.fsync(file.fileno())
    written = {"format": FORMAT, "journal": SCHEMA, "saltus": version("saltus"), "number": number, "state": name}
    temporary = folder / f".{_POINTER}.tmp"
    with temporary.open("w", encoding="utf-8") as text:
        json.dump({**written, "checksum": _checksum(words), "words": words}, text)
        text.flush()
        os.fsync(text.fileno())
    os.replace(temporary, folder / _POINTER)
    if before is not None:
        (folder / str(before["state"])).unlink(missing_ok=True)


def load_checkpoint(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the state and the words saved last.

    Raises:
        DataError: there is no checkpoint, it cannot be read, or another version wrote it.
    """
    found = _pointer(folder)
    if found is None:
        raise DataError(f"{folder}: holds no checkpoint ({_POINTER}). Name the folder that --checkpoint named.")
    if [found.get(name) for name in ("format", "journal", "saltus")] != [FORMAT, SCHEMA, version("saltus")]:
        raise DataError(
            f"{folder}: the checkpoint is of format {found.get('format')} with a journal of version "
            f"{found.get('journal')} (saltus {found.get('saltus')}); this is saltus {version('saltus')}, format "
            f"{FORMAT} and version {SCHEMA}. Go on with the version that wrote it, or begin anew without --resume."
        )
    with (
        understood(folder),
        (folder / str(found["state"])).open("rb") as file,
        np.load(file, allow_pickle=False) as arrays,
    ):
        if found["checksum"] != _checksum(found["words"]):
            raise ValueError(f"{_POINTER} was changed after it was written")
        return nested({name: arrays[name] for name in arrays.files}), dict(found["words"])


@contextmanager
def understood(folder: Path) -> Iterator[None]:
    """Refuse a checkpoint that does not hold what it should, whatever is wrong with it."""
    try:
        yield
    except (OSError, EOFError, LookupError, TypeError, ValueError, AttributeError, StopIteration) as error:
        raise DataError(f"{folder}: the checkpoint there cannot be read: {error}. {_CURE}") from error
    except (zipfile.BadZipFile, zlib.error) as error:
        raise DataError(f"{folder}: the checkpoint there is cut short or changed: {error}. {_CURE}") from error


_CURE = "Begin anew without --resume."


def _checksum(words: Mapping[str, Any]) -> int:
    return zlib.crc32(json.dumps(words).encode())


def _pointer(folder: Path) -> dict[str, Any] | None:
    path = folder / _POINTER
    if not path.exists():
        return None
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: no readable checkpoint: {error}. Begin anew.") from error
    if isinstance(found, dict) and isinstance(found.get("number"), int) and _STATE.fullmatch(str(found.get("state"))):
        return found
    raise DataError(f"{path}: no checkpoint. Begin anew.")
