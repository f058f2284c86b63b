"""Directories and patterns to files."""

import glob
from collections.abc import Sequence
from pathlib import Path

from saltus.errors import DataError

__all__ = ["expand"]

_PATTERN = "*?["
_RESULT = "summary.json"  # marks a folder that a run wrote


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


def _below(folder: Path) -> list[Path]:
    paths = sorted(folder.rglob("*"))
    results = {path.parent for path in paths if path.name == _RESULT}
    files = [p for p in paths if p.is_file() and not _hidden(p.relative_to(folder)) and not results & {*p.parents}]
    recordings = [path for path in files if _is_recording(path)]
    if not recordings:
        raise DataError(f"{folder}: none of its {len(files)} files is a recording; name the files to read.")
    return recordings


def _hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


def _is_recording(path: Path) -> bool:
    """Whether the content, or a table's columns, are those of a recording."""
    from saltus.io import format_of

    try:
        form = format_of(path)
    except DataError:
        return False
    if "table" not in form.name:
        return True
    return "time" in _columns(path, form.name)


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
    except (pyarrow.ArrowException, OSError):
        return []
    return names
