"""A table as its columns, from CSV or Parquet, whatever its bytes are and however much it unpacks to.

Text stays as it lies in the file, distinct values and which row has which (Arrow's dictionary of binary), so a text of
a megabyte in a million rows takes a megabyte; `saltus.io.cells` reads it. Cells of a CSV table are all text.
"""

import csv
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from saltus.errors import DataError
from saltus.io.settings import ReadingSettings
from saltus.text import brief, cut, shown

if TYPE_CHECKING:
    from pyarrow import csv as arrow
    from pyarrow.parquet import ParquetFile

__all__ = ["PER_ROW", "Sheet", "is_text", "read_sheet", "read_sheets", "refuse_size"]

PER_ROW = 700.0  # bytes that a row takes as a report while files are read and merged, measured; see docs/formats.md
_BLOCK = 1 << 22  # bytes; no row of a CSV table is longer
_ROWS = 1 << 16  # of a Parquet table, taken at a time
_SUFFIXES = (".parquet", ".pq")
_PARQUET, _BOM = b"PAR1", b"\xef\xbb\xbf"
# Text that stands for no value, as common tools write it; "nan" is a number that is none (`saltus.io.cells`).
_EMPTY = ("", "#N/A", "#N/A N/A", "#NA", "-1.#IND", "1.#IND", "N/A", "NA", "NULL", "n/a", "null")


@dataclass(frozen=True, slots=True)
class Sheet:
    """Columns of a table by name, all of `n_rows` rows; those not asked for are only counted."""

    path: Path
    n_rows: int
    columns: dict[str, pa.ChunkedArray]
    unused: dict[str, int]  # other columns -> cells that hold something
    broken: npt.NDArray[np.bool_]  # (n_rows,): rows of more or fewer cells than the header; all their cells are null
    problems: list[str] = field(default_factory=list)
    first: int = 0  # number of its first row in the table, where it is a piece of one


def read_sheet(path: Path, wanted: Collection[str] | None = None, settings: ReadingSettings | None = None) -> Sheet:
    """Read a Parquet table, told by its first bytes or its suffix, or else a CSV table with a header line.

    Args:
        path: the file.
        wanted: names of the columns to read; None = all.
        settings: bounds.

    Raises:
        DataError: it is no such table, the names of its columns are no UTF-8, a wanted one occurs twice, or it is
            larger than the settings allow.
    """
    memory = (settings or ReadingSettings()).memory
    with path.open("rb") as file:
        parquet = file.read(4) == _PARQUET or path.suffix.lower() in _SUFFIXES
    return _read_parquet(path, wanted, memory) if parquet else _read_csv(path, wanted, memory)


def read_sheets(path: Path, wanted: Collection[str]) -> Iterator[Sheet]:
    """Read a table as `read_sheet` does, a piece of some ten thousand rows at a time.

    Yields:
        Pieces in the order of their rows; the last has no rows, and tells what was wrong with rows of all.

    Raises:
        DataError: as `read_sheet`.
    """
    with path.open("rb") as file:
        parquet = file.read(4) == _PARQUET or path.suffix.lower() in _SUFFIXES
    yield from _parquet_sheets(path, wanted) if parquet else _csv_sheets(path, wanted)


def refuse_size(path: Path, needed: float, memory: float, what: str) -> None:
    """Refuse what would take more memory than is allowed.

    Raises:
        DataError: it would.
    """
    if needed > memory:
        raise DataError(
            f"{path}: {what}: about {needed / 1e9:.3g} GB of memory, and {memory / 1e9:.3g} GB are allowed. Divide the "
            "file, or give more as memory (bytes) in the table [reading] of the configuration."
        )


def is_text(kind: pa.DataType) -> bool:
    """Whether cells of this type hold text, UTF-8 or not, plain or by way of a dictionary."""
    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    tests = (pa.types.is_string, pa.types.is_large_string, pa.types.is_string_view)
    return any(test(kind) for test in (*tests, pa.types.is_binary, pa.types.is_large_binary, pa.types.is_binary_view))


def _wanted(path: Path, names: Sequence[str], wanted: Collection[str] | None) -> list[int]:
    """Positions of the columns to read."""
    for name in names:
        if names.count(name) > 1 and (wanted is None or name in wanted):
            raise DataError(f"{path}: column {brief(name)} occurs {names.count(name)} times; keep one.")
    return [k for k, name in enumerate(names) if wanted is None or name in wanted]


def _read_parquet(path: Path, wanted: Collection[str] | None, memory: float) -> Sheet:
    from pyarrow import parquet

    try:
        # opened here, since Arrow takes no name that is no UTF-8
        with path.open("rb") as opened, parquet.ParquetFile(opened) as whole:
            schema, rows = whole.schema_arrow, whole.metadata.num_rows
        names = [shown(name) for name in schema.names]
        refuse_size(path, rows * PER_ROW, memory, f"{rows} rows")
        at = [schema.names[k] for k in _wanted(path, names, wanted)]
        text = [field.name for field in schema if is_text(field.type)]
        with path.open("rb") as opened, parquet.ParquetFile(opened, read_dictionary=text) as file:
            table, counts = _unpacked(path, file, at, memory)
    except UnicodeDecodeError as error:
        named = brief(bytes(error.object))
        raise DataError(f"{path}: the name of a column is no UTF-8 text: {named}; rename it.") from error
    except (pa.ArrowException, OSError, ValueError, KeyError, OverflowError, MemoryError) as error:
        said = cut((str(error) or type(error).__name__).splitlines()[0], 200)
        raise DataError(f"{path}: no readable Parquet table: {said}") from error
    columns = {shown(name): table[name] for name in at}
    unused = {shown(name): counts.get(name, table.num_rows) for name in schema.names if name not in at}
    return Sheet(path, table.num_rows, columns, unused, np.zeros(table.num_rows, np.bool_))


def _parquet_sheets(path: Path, wanted: Collection[str]) -> Iterator[Sheet]:
    from pyarrow import parquet

    first = 0
    try:
        with path.open("rb") as opened, parquet.ParquetFile(opened) as whole:
            schema = whole.schema_arrow
        names = [shown(name) for name in schema.names]
        at = [schema.names[k] for k in _wanted(path, names, wanted)]
        text = [field.name for field in schema if is_text(field.type)]
        with path.open("rb") as opened, parquet.ParquetFile(opened, read_dictionary=text) as file:
            flat = [f.name for f in schema if not pa.types.is_nested(f.type) and schema.names.count(f.name) == 1]
            for batch in file.iter_batches(batch_size=_ROWS, columns=list(dict.fromkeys([*at, *flat]))):
                n = batch.num_rows
                unused = {name: n - batch[name].null_count for name in flat if name not in at}
                unused |= {name: n for name in schema.names if name not in flat and name not in at}
                table = pa.Table.from_batches([_sound(path, batch.select(at))])
                columns = {shown(name): table[name] for name in at}
                others = {shown(name): count for name, count in unused.items()}
                yield Sheet(path, n, columns, others, np.zeros(n, np.bool_), first=first)
                first += n
    except UnicodeDecodeError as error:
        named = brief(bytes(error.object))
        raise DataError(f"{path}: the name of a column is no UTF-8 text: {named}; rename it.") from error
    except (pa.ArrowException, OSError, ValueError, KeyError, OverflowError, MemoryError) as error:
        said = cut((str(error) or type(error).__name__).splitlines()[0], 200)
        raise DataError(f"{path}: no readable Parquet table: {said}") from error
    yield Sheet(path, 0, {}, {}, np.zeros(0, np.bool_), first=first)


def _unpacked(path: Path, file: "ParquetFile", names: list[str], memory: float) -> tuple[pa.Table, dict[str, int]]:
    """Read columns batch by batch, and stop when they outgrow the memory.

    Returns:
        The columns of these names, and of every other that is no nest the number of cells that hold something: what a
        file says of itself is not believed (and Arrow ends the program where that is damaged).
    """
    flat = [f.name for f in file.schema_arrow if not pa.types.is_nested(f.type)]
    every = list(dict.fromkeys([*names, *(name for name in flat if file.schema_arrow.names.count(name) == 1)]))
    others = [name for name in every if name not in names]
    batches = []
    counts = dict.fromkeys(others, 0)
    rows = 0
    for batch in file.iter_batches(batch_size=_ROWS, columns=every):
        rows += batch.num_rows
        refuse_size(path, rows * PER_ROW, memory, f"more than {rows} rows")
        for name in others:
            counts[name] += len(batch[name]) - batch[name].null_count
        batches.append(_sound(path, batch.select(names)))
        if batches[-1].nbytes > _BLOCK:
            size = pa.Table.from_batches(batches).get_total_buffer_size()
            refuse_size(path, rows * PER_ROW + size, memory, f"{rows} rows of {size / rows:.0f} bytes")
    schema = pa.schema([file.schema_arrow.field(name) for name in names])
    return pa.Table.from_batches(batches, None if batches else schema), counts


def _sound(path: Path, batch: pa.RecordBatch) -> pa.RecordBatch:
    """Refuse texts that are said to be where none is."""
    for name, column in zip(batch.schema.names, batch.columns, strict=True):
        if pa.types.is_dictionary(column.type):
            which = pc.min_max(column.indices).as_py()
            if len(column) > column.null_count and not 0 <= which["min"] <= which["max"] < len(column.dictionary):
                raise DataError(
                    f"{path}: column {brief(shown(name))} is damaged: it names texts that it does not hold."
                )
    return batch


def _read_csv(path: Path, wanted: Collection[str] | None, memory: float) -> Sheet:
    refuse_size(path, float(path.stat().st_size), memory, "the file alone")
    names = _header(path)
    at = _wanted(path, names, wanted)
    wrong: list[tuple[int, int]] = []  # row, cells
    try:
        table = _cells_of(path, len(names), wrong, memory)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise _no_csv(path, error) from error
    n_rows = table.num_rows + len(wrong)
    broken = np.zeros(n_rows, np.bool_)
    broken[[row for row, _ in wrong]] = True
    problems = _told_broken(path, wrong, n_rows, len(names))
    kept, unused = _kept(names, at, table.columns, broken)
    return Sheet(path, n_rows, kept, unused, broken, problems)


def _kept(
    names: Sequence[str], at: Sequence[int], cells: Sequence[pa.ChunkedArray], broken: npt.NDArray[np.bool_]
) -> tuple[dict[str, pa.ChunkedArray], dict[str, int]]:
    """Columns with the rows of another width as nulls: those wanted, and how much the others hold."""
    columns = [_as_lies(column) for column in cells]
    if broken.any():
        row = np.cumsum(~broken) - 1
        columns = [column.take(pa.array(row, pa.int64(), mask=broken)) for column in columns]
    kept = {names[k]: columns[k] for k in at}
    return kept, {name: len(c) - c.null_count for name, c in zip(names, columns, strict=True) if name not in kept}


def _no_csv(path: Path, error: Exception) -> DataError:
    said = cut(str(error).splitlines()[0], 200)
    if "straddling" in said:
        said = f"a row is longer than {_BLOCK} bytes; is a quote never closed?"
    return DataError(f"{path}: no readable CSV table: {said}")


def _csv_sheets(path: Path, wanted: Collection[str]) -> Iterator[Sheet]:
    names = _header(path)
    at = _wanted(path, names, wanted)
    wrong: list[tuple[int, int]] = []  # row, cells: of all pieces so far, and of what is read ahead
    first = placed = 0
    try:
        for table in _cell_tables(path, len(names), wrong):
            stop = first + table.num_rows
            begin = placed
            while placed < len(wrong) and wrong[placed][0] < stop:
                stop, placed = stop + 1, placed + 1
            broken = np.zeros(stop - first, np.bool_)
            broken[[row - first for row, _ in wrong[begin:placed]]] = True
            if len(broken):
                kept, unused = _kept(names, at, table.columns, broken)
                yield Sheet(path, len(broken), kept, unused, broken, first=first)
            first = stop
    except (pa.ArrowException, OSError, ValueError) as error:
        raise _no_csv(path, error) from error
    rest = len(wrong) - placed
    if rest:
        nulls = pa.chunked_array([pa.nulls(rest, pa.string())])
        yield Sheet(path, rest, {names[k]: nulls for k in at}, {}, np.ones(rest, np.bool_), first=first)
    problems = _told_broken(path, wrong, first + rest, len(names))
    yield Sheet(path, 0, {}, {}, np.zeros(0, np.bool_), problems, first + rest)


def _header(path: Path) -> list[str]:
    """Names of the columns of a CSV table."""
    with path.open("rb") as file:
        first = file.readline(_BLOCK)
    for mark, name in ((b";", "semicolons"), (b"\t", "tabs")):
        if mark in first and b"," not in first:
            remedy = "Separate them by commas, and decimals by points."
            raise DataError(f"{path}: {name} separate the columns. {remedy}")
    with path.open(encoding="latin-1", newline="") as text:
        text.seek(len(_BOM) if first.startswith(_BOM) else 0)
        try:
            cells = next((cells for cells in csv.reader(text) if cells), [])
        except csv.Error as error:
            raise DataError(f"{path}: no readable CSV table: {error} in the header.") from error
    if not cells:
        raise DataError(f"{path}: no readable CSV table: it is empty, or has no header.")
    names = []
    for k, cell in enumerate(cells):
        try:
            names.append(shown(cell.encode("latin-1").decode("utf-8")))
        except UnicodeDecodeError as error:
            raise DataError(
                f"{path}: header, column {k}: {brief(cell)} is no UTF-8 text; save the table as UTF-8 CSV."
            ) from error
    return names


def _cells_of(path: Path, width: int, wrong: list[tuple[int, int]], memory: float) -> pa.Table:
    """Read the cells as text, the rows of another width noted, not returned; columns are numbered."""
    tables = []
    rows = size = 0
    for table in _cell_tables(path, width, wrong):
        rows, size = rows + table.num_rows, size + table.nbytes
        tables.append(table)
        refuse_size(path, (rows + len(wrong)) * PER_ROW + size, memory, f"more than {rows} rows")
    return pa.concat_tables(tables)


def _cell_tables(path: Path, width: int, wrong: list[tuple[int, int]]) -> Iterator[pa.Table]:
    """Read the cells as text, some megabytes at a time, without the header.

    Bytes are taken for Latin-1, in which every byte is a character: what is no UTF-8 costs its cell alone.
    """
    from pyarrow import csv as arrow

    names = [str(k) for k in range(width)]

    def note(row: "arrow.InvalidRow") -> str:
        wrong.append((row.number - 2, row.actual_columns))  # it counts from 1, and the header
        return "skip"

    with (
        path.open("rb") as opened,
        arrow.open_csv(
            opened,
            read_options=arrow.ReadOptions(
                column_names=names, use_threads=False, block_size=_BLOCK, encoding="latin-1"
            ),
            parse_options=arrow.ParseOptions(newlines_in_values=True, invalid_row_handler=note),
            convert_options=arrow.ConvertOptions(
                column_types=dict.fromkeys(names, pa.binary()),
                null_values=list(_EMPTY),
                strings_can_be_null=True,
            ),
        ) as reader,
    ):
        header = 1
        for batch in reader:
            if wrong[:1] and wrong[0][0] < 0:
                raise DataError(f"{path}: no readable CSV table: its header is not one row of cells.")
            table = pa.Table.from_batches([batch]).slice(header)
            header = max(header - batch.num_rows, 0)
            yield table


def _told_broken(path: Path, wrong: list[tuple[int, int]], n_rows: int, width: int) -> list[str]:
    """One line on the rows of another width; a table in which they are half is none."""
    if not wrong:
        return []
    row, cells = wrong[0]
    first = f"row {row}: {cells} cells where the header has {width}"
    if 2 * len(wrong) >= n_rows:
        raise DataError(f"{path}: no readable CSV table: {first}, like {len(wrong)} of {n_rows} rows.")
    more = f", and {len(wrong) - 1} more such rows" if len(wrong) > 1 else ""
    return [f"{path.name}: {first}{more}: not used (broken row)."]


def _as_lies(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Give cells that were read as Latin-1 the bytes that the file has."""
    text = column.cast(pa.string())
    if not len(text) or pc.all(pc.string_is_ascii(text)).as_py() is not False:
        return text
    cells = [None if cell is None else cell.encode("latin-1") for cell in text.to_pylist()]
    return pa.chunked_array([pa.array(cells, pa.binary())])
