"""Columns of the result tables as NumPy arrays, and arrays as compact text for the page."""

import base64
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import pyarrow as pa

__all__ = ["encode", "last_text_per_group", "numbers", "quantise", "texts"]

_NAMES = {"f4": "<f4", "u1": "u1", "u2": "<u2", "i2": "<i2", "i4": "<i4"}


def numbers(table: "pa.Table", name: str) -> npt.NDArray[np.float64]:
    """Return a numeric column as float64, NaN where it is null or absent from the table."""
    import pyarrow as pa

    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    values: npt.NDArray[np.float64] = table[name].cast(pa.float64()).to_numpy(zero_copy_only=False)
    return values


def texts(table: "pa.Table", name: str, integer_format: str = "d") -> npt.NDArray[np.object_]:
    """Return a column as text, `""` where it is null or absent; integers are written in `integer_format`."""
    values = table[name].to_pylist() if name in table.column_names else [""] * table.num_rows
    out = np.empty(len(values), object)
    for i, value in enumerate(values):
        out[i] = "" if value is None else format(value, integer_format) if isinstance(value, int) else str(value)
    return out


def last_text_per_group(values: npt.NDArray[np.object_], starts: npt.NDArray[np.intp]) -> list[str]:
    """Return each group's last non-empty text; groups are consecutive, beginning at `starts`."""
    if not len(values):
        return []
    known = np.where(values != "", np.arange(len(values)), -1)
    last = np.maximum.reduceat(known, starts)
    return [str(values[i]).strip() if i >= 0 else "" for i in last]


def encode(values: npt.ArrayLike, kind: str) -> dict[str, str]:
    """Return an array as `{"type", "b64"}`, little endian; `kind` is f4, u1, u2, i2 or i4."""
    data = np.ascontiguousarray(np.asarray(values).astype(_NAMES[kind]))
    return {"type": kind, "b64": base64.b64encode(data.tobytes()).decode("ascii")}


def quantise(values: npt.ArrayLike, step: float, kind: str) -> dict[str, str]:
    """Encode values / step, rounded; the type's largest number stands for NaN."""
    top = np.iinfo(_NAMES[kind]).max
    v = np.asarray(values, np.float64)
    with np.errstate(invalid="ignore"):
        scaled = np.clip(np.rint(v / step), np.iinfo(_NAMES[kind]).min, top - 1)
    return encode(np.where(np.isfinite(v), scaled, top), kind)
