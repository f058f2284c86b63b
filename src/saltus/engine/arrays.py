"""Arrays by name as Arrow tables, and nested states as arrays by path; both lose no bit."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

__all__ = ["flattened", "from_table", "joined", "nested", "to_table"]

_Array = npt.NDArray[Any]


def to_table(columns: Mapping[str, _Array]) -> pa.Table:
    """Return arrays (n, ...) as columns of a table; more than one axis becomes lists of fixed length."""
    fields, arrays = [], []
    for name, values in columns.items():
        column = _column(np.ascontiguousarray(values))
        kept = {"shape": " ".join(map(str, values.shape[1:])), "dtype": values.dtype.str}
        fields.append(pa.field(name, column.type, metadata=kept))
        arrays.append(column)
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields))


def _column(values: _Array) -> pa.Array:
    flat = values.reshape(-1)
    array = pa.array(flat.tolist(), pa.string()) if values.dtype.kind == "U" else pa.array(flat)
    width = int(np.prod(values.shape[1:], dtype=np.int64))
    return array if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(array, width)


def from_table(table: pa.Table) -> dict[str, _Array]:
    """Return the arrays that `to_table` made a table of."""
    return {field.name: _array(table[field.name], field) for field in table.schema}


def _array(column: pa.ChunkedArray, field: pa.Field) -> _Array:
    whole = pa.concat_arrays(column.chunks) if column.num_chunks else pa.array([], field.type)
    shape = [int(n) for n in field.metadata[b"shape"].split()]
    flat, dtype = whole.flatten() if shape else whole, np.dtype(field.metadata[b"dtype"].decode())
    values = flat.to_pylist() if pa.types.is_string(flat.type) else flat.to_numpy(zero_copy_only=False)
    return np.array(values, dtype).reshape(len(whole), *shape)


def joined(parts: Sequence[Mapping[str, _Array]]) -> dict[str, _Array]:
    """Join columns of one kind one behind the other; there is at least one part."""
    return {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}


def flattened(state: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, _Array]]:
    """Yield the arrays of nested mappings by their paths, `a/b/c`; an empty mapping is none."""
    for name, value in state.items():
        if isinstance(value, Mapping):
            yield from flattened(value, f"{path}{name}/")
        else:
            yield f"{path}{name}", np.asarray(value)


def nested(arrays: Mapping[str, _Array]) -> dict[str, Any]:
    """Return nested mappings of arrays by their paths."""
    out: dict[str, Any] = {}
    for path, value in arrays.items():
        *parents, name = path.split("/")
        at = out
        for parent in parents:
            at = at.setdefault(parent, {})
        at[name] = value
    return out
