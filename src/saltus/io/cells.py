"""Cells of a table as numbers, codes and truths; what cannot be read is absent and told with its row and column."""

import datetime
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.errors import DataError
from saltus.io.sheet import is_text
from saltus.text import brief, cut

__all__ = ["RowProblems", "Texts", "codes", "naive", "numbers", "refuse", "tell", "texts", "times", "truths"]

_TRUTH = {"true": 1, "1": 1, "1.0": 1, "t": 1, "yes": 1, "false": 0, "0": 0, "0.0": 0, "f": 0, "no": 0}
_DIGITS = {16: ("hexadecimal", re.compile("[0-9a-fA-F]{1,8}")), 8: ("octal", re.compile("[0-7]{1,6}"))}
_NAN = (b"-1.#QNAN", b"-NaN", b"-nan", b"1.#QNAN", b"NaN", b"nan")  # no text either
_TICKS = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}  # a second's, by the unit of Arrow's time stamps
_EPOCH = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)


class RowProblems(list[str]):
    """What is told of a table that is read in pieces: bad cells of one column and kind once, with their number.

    `first_row` is the number of the piece's first row.
    """

    def __init__(self) -> None:
        super().__init__()
        self.first_row = 0
        self._cells: dict[tuple[str, str, str], tuple[int, str, int]] = {}

    def add(self, file: str, name: str, what: str, row: int, said: str, count: int) -> None:
        """Count bad cells; the first of all is told."""
        first, cell, before = self._cells.get((file, name, what), (row + self.first_row, said, 0))
        self._cells[file, name, what] = first, cell, before + count

    def texts(self) -> list[str]:
        """All that is told."""
        cells = [_bad_cells(file, name, what, *rest) for (file, name, what), rest in self._cells.items()]
        return list(dict.fromkeys([*self, *cells]))


class Texts(NamedTuple):
    """A column of text: its distinct values, and which each row has; -1 where there is none."""

    values: list[str]
    which: npt.NDArray[np.int64]  # (N,)

    def each(self, of: Mapping[str, Any], absent: object, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        """What a table says of each row's text, (N,)."""
        return np.array([*(of[v] for v in self.values), absent], dtype)[self.which]

    def rows(self, wrong: set[str]) -> list[tuple[int, str]]:
        """Rows whose text is one of these, in order, with the text."""
        odd = [k for k, v in enumerate(self.values) if v in wrong]
        return [(int(row), self.values[self.which[row]]) for row in np.flatnonzero(np.isin(self.which, odd))]


def texts(path: Path, name: str, column: pa.ChunkedArray, problems: list[str]) -> Texts:
    """Read text; numbers are spelt. A cell that is no UTF-8 is told and absent, like one that is empty.

    Raises:
        DataError: the column holds neither text nor numbers nor truths.
    """
    if not is_text(column.type):
        kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
        plain = (pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean, pa.types.is_decimal, pa.types.is_null)
        if not any(test(kind) for test in plain):
            raise DataError(f"{path}: column {brief(name)} is of type {cut(str(column.type))}; it must hold text.")
        return _spelt(column)
    position: dict[bytes, int] = {}
    index = np.full(len(column), -1, np.int64)
    begin = 0
    for chunk in column.chunks:
        encoded = chunk if pa.types.is_dictionary(chunk.type) else chunk.dictionary_encode()
        cells = encoded.dictionary.cast(pa.large_binary()).to_pylist()
        here = [-1 if not cell or cell in _NAN else position.setdefault(cell, len(position)) for cell in cells]
        at = encoded.indices.fill_null(len(here)).to_numpy(zero_copy_only=False)
        index[begin : begin + len(chunk)] = np.array([*here, -1], np.int64)[at]
        begin += len(chunk)
    return _decoded(path, name, list(position), index, problems)


def _decoded(path: Path, name: str, cells: list[bytes], index: npt.NDArray[np.int64], problems: list[str]) -> Texts:
    values, odd = [], []
    for k, cell in enumerate(cells):
        try:
            values.append(cell.decode("utf-8"))
        except UnicodeDecodeError:
            values.append("")
            odd.append(k)
    bad = np.flatnonzero(np.isin(index, odd))
    tell(path, name, [(int(row), cells[index[row]]) for row in bad[:1]], "no UTF-8 text", problems, len(bad))
    index[bad] = -1
    return Texts(values, index)


def _spelt(column: pa.ChunkedArray) -> Texts:
    cells = ["" if v is None else str(v) for v in column.to_pylist()]
    values = list(dict.fromkeys(v for v in cells if v))
    position = {v: k for k, v in enumerate(values)}
    return Texts(values, np.array([position.get(v, -1) for v in cells], np.int64))


def _read(
    path: Path,
    name: str,
    found: Texts,
    read: Callable[[str], float | int],
    absent: float | int,
    what: str,
    problems: list[str],
) -> npt.NDArray[Any]:
    """Read every distinct text once; those that raise ValueError or OverflowError are told as `what`, and absent."""
    table: dict[str, float | int] = {}
    wrong = set()
    for value in found.values:
        try:
            table[value] = read(value.strip()) if value.strip() else absent
        except (ValueError, OverflowError):
            table[value] = absent
            wrong.add(value)
    tell(path, name, found.rows(wrong), what, problems)
    return found.each(table, absent, np.float64 if isinstance(absent, float) else np.int64)


def times(path: Path, column: pa.ChunkedArray, problems: list[str]) -> npt.NDArray[np.float64]:
    """UTC seconds from numbers, time stamps or text.

    Raises:
        DataError: the column holds something else, as dates or times of day alone.
    """
    if pa.types.is_timestamp(column.type):
        ticks = _TICKS[column.type.unit]
        count = column.cast(pa.int64())
        known = count.is_valid().to_numpy()
        whole, part = np.divmod(count.fill_null(0).to_numpy(), ticks)
        return np.where(known, whole + part / ticks, np.nan)
    if not is_text(column.type):
        return numbers(path, "time", column, problems)
    plain = _as_floats(column)
    if plain is not None:
        return plain
    found = texts(path, "time", column, problems)
    return _read(path, "time", found, _seconds, float("nan"), "neither seconds nor ISO 8601", problems)


def naive(column: pa.ChunkedArray) -> int:
    """Count the rows whose time is a date and time without an offset from UTC."""
    if pa.types.is_timestamp(column.type):
        return 0 if column.type.tz else len(column) - column.null_count
    if not is_text(column.type) or _as_floats(column) is not None:
        return 0
    found = texts(Path(), "time", column, [])
    local = [k for k, text in enumerate(found.values) if _is_naive(text)]
    return int(np.count_nonzero(np.isin(found.which, local)))


def _is_naive(text: str) -> bool:
    try:
        return datetime.datetime.fromisoformat(text.strip()).tzinfo is None
    except ValueError:
        return False


def _number(text: str) -> float:
    if "_" in text:
        raise ValueError("Python's grouping of digits is no number in a table")
    return float(text)


def _seconds(text: str) -> float:
    try:
        return _number(text)
    except ValueError:
        moment = datetime.datetime.fromisoformat(text)
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=datetime.UTC)
    return (moment - _EPOCH) / datetime.timedelta(seconds=1)


def numbers(path: Path, name: str, column: pa.ChunkedArray, problems: list[str]) -> npt.NDArray[np.float64]:
    """A column as float64, absent and unreadable cells NaN.

    Raises:
        DataError: the column holds neither numbers nor text.
    """
    kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
    if not is_text(kind):
        plain = (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal, pa.types.is_null)
        if not any(test(kind) for test in plain):
            raise DataError(f"{path}: column {brief(name)} is of type {cut(str(column.type))}; it must hold numbers.")
        values: npt.NDArray[np.float64] = column.cast(pa.float64(), safe=False).to_numpy().astype(np.float64)
        return values
    found = _as_floats(column)
    if found is not None:
        return found
    return _read(path, name, texts(path, name, column, problems), _number, float("nan"), "no number", problems)


def _as_floats(column: pa.ChunkedArray) -> npt.NDArray[np.float64] | None:
    """Read text as numbers all at once, where every cell is a plain one."""
    if pa.types.is_dictionary(column.type):
        return None
    try:
        values: npt.NDArray[np.float64] = column.cast(pa.string()).cast(pa.float64()).to_numpy().astype(np.float64)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
        return None
    return values


def codes(
    path: Path, name: str, column: pa.ChunkedArray, base: int, largest: int, problems: list[str]
) -> npt.NDArray[np.int64]:
    """Codes from text in base 16 or 8, absent and unreadable ones -1.

    Raises:
        DataError: the column holds no text.
    """
    kind, digits = _DIGITS[base]
    if not (is_text(column.type) or pa.types.is_null(column.type)):
        raise DataError(f"{path}: column {brief(name)} is of type {cut(str(column.type))}; give {kind} digits as text.")

    def read(text: str) -> int:
        if not digits.fullmatch(text) or int(text, base) > largest:
            raise ValueError
        return int(text, base)

    return _read(path, name, texts(path, name, column, problems), read, -1, f"no {kind} code", problems)


def truths(path: Path, column: pa.ChunkedArray, problems: list[str]) -> npt.NDArray[np.int64]:
    """1 for true, 0 for false, -1 for absent and unreadable cells."""

    def read(text: str) -> int:
        if text.lower() not in _TRUTH:
            raise ValueError
        return _TRUTH[text.lower()]

    found = texts(path, "on_ground", column, problems)
    return _read(path, "on_ground", found, read, -1, "neither true nor false", problems)


def tell(
    path: Path,
    name: str,
    bad: Sequence[tuple[int, object]],
    what: str,
    problems: list[str],
    count: int | None = None,
) -> None:
    """Add one problem: the first of the bad cells by row and column, and how many more there are."""
    if bad:
        row, cell = bad[0]
        count = len(bad) if count is None else count
        said = brief(cell if isinstance(cell, bytes | str) else str(cell), 42)
        if isinstance(problems, RowProblems):
            problems.add(path.name, name, what, row, said, count)
        else:
            problems.append(_bad_cells(path.name, name, what, row, said, count))


def _bad_cells(file: str, name: str, what: str, row: int, said: str, count: int) -> str:
    more = f", and in {count - 1} more rows" if count > 1 else ""
    return f"{file}: row {row}, column {brief(name)}: {said} is {what}{more}."


def refuse(path: Path, problems: Sequence[str]) -> None:
    """Refuse a table for the first of its problems, where every cell is needed.

    Raises:
        DataError: there is one.
    """
    if problems:
        raise DataError(f"{path}: {problems[0].removeprefix(f'{path.name}: ')}")
