"""Tables written a piece at a time: Parquet, CSV, JSON lines."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol, runtime_checkable

import pyarrow as pa

from saltus.errors import DataError

__all__ = ["SUFFIXES", "Writer", "open_writer"]


@runtime_checkable
class Writer(Protocol):
    """Takes tables of one schema in turn."""

    def write(self, table: pa.Table) -> None:
        """Add rows."""

    def close(self) -> None:
        """Finish the file."""


class _Parquet:
    def __init__(self, path: Path, schema: pa.Schema) -> None:
        from pyarrow import parquet

        self._writer = parquet.ParquetWriter(path, schema)

    def write(self, table: pa.Table) -> None:
        self._writer.write_table(table)

    def close(self) -> None:
        self._writer.close()


class _Csv:
    def __init__(self, path: Path, schema: pa.Schema) -> None:
        from pyarrow import csv

        flat = [pa.field(f.name, pa.string()) if pa.types.is_list(f.type) else f for f in schema]
        self._schema = pa.schema(flat)
        self._writer = csv.CSVWriter(path, self._schema)

    def write(self, table: pa.Table) -> None:
        columns = [_spaced(c) if pa.types.is_list(c.type) else c for c in table.columns]
        self._writer.write_table(pa.table(columns, schema=self._schema))

    def close(self) -> None:
        self._writer.close()


class _Lines:
    def __init__(self, path: Path, schema: pa.Schema) -> None:
        del schema
        self._file = path.open("w", encoding="utf-8")

    def write(self, table: pa.Table) -> None:
        rows: list[list[str]] = [[] for _ in range(table.num_rows)]
        for name, column in zip(table.column_names, table.columns, strict=True):
            head = json.dumps(name) + ": "
            for row, value in zip(rows, column.to_pylist(), strict=True):
                if value is not None:
                    row.append(head + json.dumps(value))
        self._file.writelines("{" + ", ".join(row) + "}\n" for row in rows)

    def close(self) -> None:
        self._file.close()


SUFFIXES: Mapping[str, Callable[[Path, pa.Schema], Writer]] = {
    ".parquet": _Parquet,
    ".pq": _Parquet,
    ".csv": _Csv,
    ".jsonl": _Lines,
    ".ndjson": _Lines,
}


def open_writer(path: Path, schema: pa.Schema) -> Writer:
    """Open a file by its suffix."""
    return SUFFIXES[path.suffix.lower()](path, schema)


def check_suffix(path: Path) -> None:
    """Refuse a file whose suffix names no format.

    Raises:
        DataError: naming those there are.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise DataError(f"{path}: write to a file that ends in {', '.join(SUFFIXES)}.")


def _spaced(column: pa.ChunkedArray) -> pa.Array:
    """Lists as texts, a blank between two values."""
    return pa.array([None if v is None else " ".join(map(str, v)) for v in column.to_pylist()], pa.string())
