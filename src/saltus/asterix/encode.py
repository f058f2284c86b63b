"""Columns to records, and records to data blocks."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.asterix.codec import Column
from saltus.asterix.layout import EXPLICIT, REPEATED, SI, Field, Layout
from saltus.asterix.pack import Input, pack
from saltus.asterix.program import Program, Want, compile_program
from saltus.compiled import native_module
from saltus.errors import DataError, ModelError
from saltus.shapes import Int

__all__ = ["Encoded", "blocks", "encode"]

_HEADER, _LONGEST = 3, 65535  # bytes of a data block


class Encoded(NamedTuple):
    """Records one after another."""

    data: bytes
    start: Int[np.ndarray, " n1"]  # (N + 1,) where each starts, and the end


def encode(layout: Layout, columns: Mapping[str, npt.ArrayLike | Column], *, profile: str | None = None) -> Encoded:
    """Pack columns into records.

    An item is sent where one of its fields is given; its other fields are 0 then. An extended item is sent up to the
    last part with a field that is given.

    Args:
        layout: of the category and edition to write.
        columns: field -> values: quantities as floats in SI units and radians, NaN = not given, or as the integers
            that stand in the field; texts, "" = not given; integers of all else. A `Column` tells with `present`
            what is given, and holds repeated fields with `rows`, in order. An item of explicit length without a
            definition is a repeated field of its bytes.
        profile: name of the user application profile; of the layout's first one when not given.

    Raises:
        ModelError: a column cannot be written.
        DataError: a value does not fit its field.
    """
    given = {path: c if isinstance(c, Column) else Column(np.asarray(c), None, None) for path, c in columns.items()}
    n = max((_rows(c) for c in given.values()), default=0)
    wants = {path: _want(layout, path) for path in given}
    program = compile_program(layout, wants)
    inputs = [_input(layout, path, column, n) for path, column in given.items()]
    _check_repeated(program, list(given), inputs)
    names = list(layout.records)
    root = names.index(profile) if profile is not None else 0
    native = native_module()
    packed = pack if native is None else native.asterix_pack
    data, start, overflow = packed(program, inputs, n, root)
    if overflow >= 0:
        raise DataError(f"record {overflow} repeats an item, or gives one bytes, more often than its count can say.")
    return Encoded(data, start)


def blocks(category: int, encoded: Encoded, first: npt.ArrayLike) -> Encoded:
    """Put records into data blocks.

    Args:
        category: of the records.
        encoded: the records.
        first: index of the first record of each block, increasing from 0.

    Returns:
        The blocks, and where each starts.

    Raises:
        DataError: a block would be longer than 65535 bytes.
    """
    cuts = np.append(np.asarray(first, np.int64), len(encoded.start) - 1)
    size = _HEADER + np.diff(encoded.start[cuts])
    if np.any(size > _LONGEST):
        k = int(np.argmax(size))
        raise DataError(f"block {k} of category {category} has {size[k]} bytes; a data block holds at most {_LONGEST}.")
    start = np.concatenate([[0], np.cumsum(size)]).astype(np.int64)
    out = np.empty(int(start[-1]), np.uint8)
    header = np.arange(len(size)) * _HEADER + encoded.start[cuts[:-1]]
    body = np.ones(len(out), np.bool_)
    for k, values in enumerate((np.full(len(size), category), size >> 8, size & 255)):
        out[header + k] = values
        body[header + k] = False
    out[body] = np.frombuffer(encoded.data, np.uint8)
    return Encoded(out.tobytes(), start)


def _rows(column: Column) -> int:
    if column.rows is None:
        return len(column.values)
    return int(column.rows[-1]) + 1 if len(column.rows) else 0


def _want(layout: Layout, path: str) -> Want:
    if path not in layout.fields and path in layout.titles:
        return Want(path, "span")
    field = layout.field(path)
    if field.guards:
        raise ModelError(f"{path!r} is a reading of other bits and cannot be written; write the item's own fields.")
    return Want(path, "raw")


def _input(layout: Layout, path: str, column: Column, n: int) -> Input:
    """Raw integers of a column, checked."""
    values, present, rows = column
    if path in layout.fields:
        field = layout.fields[path][0]
        if present is not None and field.kind != "bytes":
            values = np.where(present, values, np.zeros(1, values.dtype))  # what is not sent need not fit
        raw, given = _raw(field, values)
    else:
        raw, given = np.asarray(values, np.int64), None
    if rows is not None:
        first = np.searchsorted(rows, np.arange(n + 1)).astype(np.int64)
        return Input(np.ascontiguousarray(raw), None, first)
    if len(values) != n:
        raise ModelError(f"{path!r} has {len(values)} values, others have {n}.")
    if present is not None:
        given = present if given is None else present & given
    return Input(np.ascontiguousarray(raw), None if given is None else np.ascontiguousarray(given, np.bool_), None)


def _raw(field: Field, values: npt.NDArray[Any]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_] | None]:
    """Integers as they stand in the field, and which values are given at all."""
    if field.kind in ("icao", "ascii") and values.dtype.kind in "SU":
        texts = np.asarray(values, "S")
        return _letters(field, texts), texts != b""
    if field.size > 64:
        width = field.size // 8
        return np.asarray(values, f"V{width}").view(np.uint8).astype(np.int64), None
    if field.kind == "quantity" and values.dtype.kind == "f":
        factor = SI.get(field.unit, 1.0)
        numbers = np.asarray(values, np.float64)
        given = ~np.isnan(numbers)
        raw = np.rint((np.where(given, numbers, 0.0) - field.origin * factor) / (field.lsb * factor))
        return _fit(field, raw, numbers).astype(np.int64), given
    raw = np.asarray(values)
    return np.asarray(_fit(field, raw, raw), np.int64), None


def _fit(field: Field, raw: npt.NDArray[Any], values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Refuse what does not fit: a wrapped value would come back as another one."""
    low = -(2.0 ** (field.size - 1)) if field.signed else 0.0
    high = 2.0 ** (field.size - 1) if field.signed and raw.dtype.kind == "f" else 2.0**field.size
    if field.size < 64:
        bad = ~((raw >= low) & (raw < high))
        if np.any(bad):
            k = int(np.argmax(bad))
            raise DataError(f"{field.path}[{k}] is {values[k]}, which does not fit its {field.size} bits.")
    return raw


def _letters(field: Field, texts: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Texts, filled up with blanks, as integers, or as bytes when longer than 64 bits."""
    width = 6 if field.kind == "icao" else 8
    n_letters = field.size // width
    if texts.dtype.itemsize > n_letters and np.any(np.char.str_len(texts) > n_letters):
        raise DataError(f"{field.path} holds texts of at most {n_letters} letters.")
    codes = np.char.ljust(texts, n_letters).astype(f"S{n_letters}").view(np.uint8).reshape(len(texts), n_letters)
    if width == 6:
        table = np.full(256, -1, np.int64)
        table[ord("A") : ord("Z") + 1] = np.arange(1, 27)
        table[ord("0") : ord("9") + 1] = np.arange(48, 58)
        table[ord(" ")] = 32
        letters = table[codes]
        if np.any(letters < 0):
            k = int(np.argmax(np.any(letters < 0, axis=1)))
            raise DataError(f"{field.path}[{k}] is {texts[k]!r}; use capitals, digits and blanks.")
    else:
        letters = codes.astype(np.int64)
    if field.size > 64:
        return letters.reshape(-1)
    shifts = np.arange(width * (n_letters - 1), -1, -width)
    words: npt.NDArray[np.int64] = np.bitwise_or.reduce(letters << shifts, axis=1)
    return words


def _check_repeated(program: Program, paths: list[str], inputs: list[Input]) -> None:
    """Fields of a repeated item must be repeated alike, and those of others not at all."""
    for kind, _, _, _, first, n in program.nodes.tolist():
        outputs = program.slots[first : first + n, 4].tolist()
        counts = [inputs[k].first for k in outputs]
        if kind in (REPEATED, EXPLICIT):
            if any(c is None or not np.array_equal(c, counts[0]) for c in counts):
                raise ModelError(f"{', '.join(paths[k] for k in outputs)} must be repeated alike: give `rows` to each.")
        elif any(c is not None for c in counts):
            raise ModelError(f"{', '.join(paths[k] for k in outputs)} are not repeated.")
