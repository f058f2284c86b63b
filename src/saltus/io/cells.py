"""Cells of a table as numbers, codes and truths; what cannot be read is absent and told with its row and column."""

import datetime
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.errors import DataError

__all__ = ["codes", "numbers", "tell", "times", "truths"]

_TRUTH = {"true": 1, "1": 1, "1.0": 1, "t": 1, "yes": 1, "false": 0, "0": 0, "0.0": 0, "f": 0, "no": 0}


def times(path: Path, column: pa.ChunkedArray, problems: list[str]) -> npt.NDArray[np.float64]:
    """UTC seconds from numbers, time stamps or text."""
    if pa.types.is_timestamp(column.type):
        micro = column.cast(pa.timestamp("us"), safe=False).cast(pa.int64())
        return _floats(micro) / 1e6
    if not _is_text(column.type):
        return numbers(path, "time", column, problems)
    values = np.full(len(column), np.nan)
    bad = []
    for k, text in enumerate(column.to_pylist()):
        try:
            values[k] = _seconds(text) if text else np.nan
        except ValueError:
            bad.append((k, text))
    tell(path, "time", bad, "neither seconds nor ISO 8601", problems)
    return values


def _seconds(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        moment = datetime.datetime.fromisoformat(text.strip())
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=datetime.UTC)
    epoch = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
    return (moment - epoch) / datetime.timedelta(seconds=1)


def numbers(path: Path, name: str, column: pa.ChunkedArray, problems: list[str]) -> npt.NDArray[np.float64]:
    """A column as float64, absent and unreadable cells NaN."""
    if not _is_text(column.type):
        try:
            return _floats(column)
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
            raise DataError(f"{path}: column {name!r} is of type {column.type}; it must hold numbers.") from error
    values = np.full(len(column), np.nan)
    bad = []
    for k, text in enumerate(column.to_pylist()):
        try:
            values[k] = float(text) if text else np.nan
        except ValueError:
            bad.append((k, text))
    tell(path, name, bad, "no number", problems)
    return values


def _floats(column: pa.ChunkedArray) -> npt.NDArray[np.float64]:
    values: npt.NDArray[np.float64] = column.cast(pa.float64(), safe=False).to_numpy().astype(np.float64)
    return values


def codes(
    path: Path, name: str, column: pa.ChunkedArray, base: int, largest: int, problems: list[str]
) -> npt.NDArray[np.int64]:
    """Codes from text in base 16 or 8, absent and unreadable ones -1."""
    kind = {16: "hexadecimal", 8: "octal"}[base]
    if not (_is_text(column.type) or pa.types.is_null(column.type)):
        raise DataError(f"{path}: column {name!r} is of type {column.type}; give {kind} digits as text.")
    values = np.full(len(column), -1, np.int64)
    bad = []
    for k, text in enumerate(column.to_pylist()):
        if text and text.strip():
            try:
                values[k] = int(text.strip(), base)
            except ValueError:
                bad.append((k, text))
            else:
                if not 0 <= values[k] <= largest:
                    bad.append((k, text))
                    values[k] = -1
    tell(path, name, bad, f"no {kind} code", problems)
    return values


def truths(path: Path, column: pa.ChunkedArray, problems: list[str]) -> npt.NDArray[np.int64]:
    """1 for true, 0 for false, -1 for absent and unreadable cells."""
    cells = ["" if v is None else str(v).strip().lower() for v in column.to_pylist()]
    bad = [(k, v) for k, v in enumerate(cells) if v not in _TRUTH and v not in ("", "nan")]
    tell(path, "on_ground", bad, "neither true nor false", problems)
    return np.array([_TRUTH.get(v, -1) for v in cells], np.int64)


def tell(path: Path, name: str, bad: Sequence[tuple[int, object]], what: str, problems: list[str]) -> None:
    """Add one problem: the first of the bad cells by row and column, and how many more there are."""
    if bad:
        row, cell = bad[0]
        more = f", and in {len(bad) - 1} more rows" if len(bad) > 1 else ""
        problems.append(f"{path.name}: row {row}, column {name!r}: {str(cell)[:40]!r} is {what}{more}.")


def _is_text(kind: pa.DataType) -> bool:
    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind))
