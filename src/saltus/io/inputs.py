"""Directories and patterns to files."""

import glob
from collections.abc import Sequence
from pathlib import Path

from saltus.errors import DataError
from saltus.text import shown

__all__ = ["expand", "left_out"]

_PATTERN = "*?["
_RESULT = "summary.json"  # marks a folder that a run wrote
_NAMED = 5  # files left out that are named


def expand(inputs: Sequence[Path | str]) -> list[Path]:
    """Return the files that inputs stand for, in the order given.

    A directory stands for the recordings below it, in the order of their names: files that are told by their content,
    and tables that have a column `time`; hidden ones and what runs wrote are left out. A name that no file has and
    that holds `*`, `?` or `[` is a pattern; `**` stands for any directories. Neither adds a file that is there already.

    Raises:
        DataError: a directory holds no recording, or nothing matches a pattern.
    """
    found: list[Path] = []
    for entry in inputs:
        path = Path(entry)
        if path.is_dir():
            found += [file for file in _below(path) if file not in found]
        elif any(c in str(path) for c in _PATTERN) and not path.exists():
            found += [file for file in _matching(path) if file not in found]
        else:
            found.append(path)
    return found


def _matching(pattern: Path) -> list[Path]:
    files = [Path(name) for name in sorted(glob.glob(str(pattern), recursive=True)) if Path(name).is_file()]
    if not files:
        raise DataError(f"{pattern}: no file matches this pattern.")
    return files


def left_out(inputs: Sequence[Path | str]) -> list[str]:
    """Say of each directory among inputs which files `expand` takes for no recordings, and why."""
    said = []
    for folder in (Path(entry) for entry in inputs if Path(entry).is_dir()):
        reasons: dict[str, list[str]] = {}
        for path in _files(folder):
            if why := _no_recording(path):
                reasons.setdefault(why, []).append(shown(path.name))
        for why, names in reasons.items():
            more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
            said.append(f"{shown(str(folder))}: not read, {why}: {', '.join(names[:_NAMED])}{more}.")
    return said


def _files(folder: Path) -> list[Path]:
    paths = sorted(folder.rglob("*"))
    results = {path.parent for path in paths if path.name == _RESULT}
    return [p for p in paths if p.is_file() and not _hidden(p.relative_to(folder)) and not results & {*p.parents}]


def _below(folder: Path) -> list[Path]:
    files = _files(folder)
    recordings = [path for path in files if not _no_recording(path)]
    if not recordings:
        raise DataError(f"{folder}: none of its {len(files)} files is a recording; name the files to read.")
    return recordings


def _hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


def _no_recording(path: Path) -> str:
    """Why the content, or a table's columns, are not those of a recording; "" where they are."""
    from saltus.io import format_of

    try:
        form = format_of(path)
    except DataError:
        return "of no format that is known"
    if "table" not in form.name:
        return ""
    return "" if "time" in _columns(path, form.name) else "tables without a column time"


def _columns(path: Path, form: str) -> list[str]:
    """Columns of a table; none where it cannot be read."""
    if form.startswith("CSV"):
        with path.open("rb") as file:
            header = file.readline(1 << 16).decode("utf-8", "replace")
        return [cell.strip().strip('"') for cell in header.split(",")]
    import pyarrow
    from pyarrow import parquet

    try:
        with path.open("rb") as file:
            names: list[str] = parquet.read_schema(file).names
    except (pyarrow.ArrowException, OSError, UnicodeDecodeError):  # names of columns may be any bytes
        return []
    return names
