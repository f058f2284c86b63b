"""Records of data blocks as columns.

    blocks = offsets and lengths of data blocks of one category in a buffer (framing is not known here)
    found  = find_records(data, offset, length, layout)
                                                            where each record lies; what does not follow the layout
    held   = decode(data, found.records, layout, {"range": Want("040/RHO"), "turn": Want("250/5,0/ROLL")})
    held["range"].values                                          metres, NaN where a record does not say

Everything happens in compiled code when the package has it, else in its definition, `saltus.asterix.walk`.
"""

import sys
from collections.abc import Mapping
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.asterix import walk
from saltus.asterix.layout import Layout
from saltus.asterix.program import SPAN, Program, Want, compile_program
from saltus.compiled import native_module
from saltus.shapes import Int

__all__ = [
    "FAULTS",
    "Column",
    "Data",
    "Faults",
    "Found",
    "Records",
    "Want",
    "announced",
    "decode",
    "find_records",
]

Data = bytes | bytearray | memoryview | npt.NDArray[np.uint8]

# What is wrong with a record, by code; {item}, {need}, {left} are filled in by `Faults.text`.
FAULTS = (
    "",
    "the field specification has no end",
    "the field specification is longer than {need} bytes",
    "field {need} is announced but not defined in this edition",
    "item {item} needs {need} bytes, {left} are left",
    "item {item} extends beyond its definition",
    "item {item}, of explicit length, says 0 bytes",
    "random field sequencing names item {need}, which is not defined",
    "a record does not name its source (item 010)",
    "item {item} does not tell the kind of record",
    "what item {item} holds does not follow its definition",
)


class Records(NamedTuple):
    """Where records lie, one entry for each, in the order of the blocks."""

    block: Int[np.ndarray, " n"]  # index of its block
    number: Int[np.ndarray, " n"]  # in the block, from 0
    start: Int[np.ndarray, " n"]  # first byte in the buffer
    stop: Int[np.ndarray, " n"]
    profile: Int[np.ndarray, " n"]  # index of the layout's user application profile

    def take(self, rows: npt.NDArray[Any]) -> "Records":
        """Select records by index or mask."""
        return Records(*(column[rows] for column in self))


class Faults(NamedTuple):
    """What does not follow the layout, one entry for each.

    A record with a fault is lost with the rest of its block, unless `record` says which record was kept: without the
    item of explicit length that broke it, or whole, when an item extends beyond its definition.
    """

    paths: tuple[str, ...]  # of the layout's nodes
    block: Int[np.ndarray, " f"]
    offset: Int[np.ndarray, " f"]  # byte in the buffer
    code: Int[np.ndarray, " f"]  # index into FAULTS
    node: Int[np.ndarray, " f"]
    need: Int[np.ndarray, " f"]
    left: Int[np.ndarray, " f"]
    record: Int[np.ndarray, " f"]  # index of the record that was kept, -1 = lost

    def item(self, k: int) -> str:
        """Path of the item at fault; empty for the record itself."""
        return self.paths[int(self.node[k])]

    def text(self, k: int) -> str:
        """A fault in words."""
        words = FAULTS[int(self.code[k])]
        return words.format(item=self.item(k), need=int(self.need[k]), left=int(self.left[k]))


class Found(NamedTuple):
    """What `find_records` found."""

    records: Records
    faults: Faults


class Column(NamedTuple):
    """One wanted column.

    Dense: `values` and `present` have one entry for each record; absent ones are NaN, `Want.absent`, empty or (-1, -1).
    Repeated: one entry for each value, `rows` says of which record, in order.
    """

    values: npt.NDArray[Any]
    present: npt.NDArray[np.bool_] | None
    rows: npt.NDArray[np.int64] | None


def find_records(
    data: Data,
    offset: Int[np.ndarray, " n"],
    length: Int[np.ndarray, " n"],
    layout: Layout,
    *,
    strict: bool = False,
    require: str | None = "010",
) -> Found:
    """Find the records of data blocks.

    Args:
        data: buffer that holds the blocks.
        offset: (N,) where each block starts: its category byte.
        length: (N,) its bytes, the three of its header included.
        layout: of the blocks' category.
        strict: an item that extends beyond its definition is a fault; else it is skipped, and noted.
        require: item that every record must have.
    """
    program = compile_program(layout, {}, require if require and layout.has(require) else None)
    offset, length = np.ascontiguousarray(offset, np.int64), np.ascontiguousarray(length, np.int64)
    octets = _octets(data)
    _check(octets, offset, length)
    native = native_module()
    if native is None:
        records, faults = walk.find(octets.tobytes(), offset, length, program, strict)
    else:
        records, faults = native.asterix_find(octets, offset, length, program, strict)
    return Found(Records(*records), Faults(program.paths, *faults))


def decode(data: Data, records: Records, layout: Layout, wants: Mapping[str, Want]) -> dict[str, Column]:
    """Take columns out of records.

    Args:
        data: the buffer that was given to `find_records`.
        records: what it found, or some of it in any order.
        layout: as given to `find_records`.
        wants: columns by name.

    Raises:
        DataError: the edition has no such field; `Layout.has` tells.
    """
    program = compile_program(layout, wants)
    octets = _octets(data)
    start, stop = (np.ascontiguousarray(column, np.int64) for column in (records.start, records.stop))
    native = native_module()
    if native is None:
        pairs = walk.extract(octets.tobytes(), start, stop, program)
    else:
        pairs = _extract(native, octets, start, stop, program)
    return {name: _column(program, k, *pair) for k, (name, pair) in enumerate(zip(wants, pairs, strict=True))}


def announced(data: Data, records: Records, layout: Layout) -> tuple[list[list[str]], Int[np.ndarray, " n"]]:
    """Tell which items records announce in their field specifications.

    Returns:
        The different sets of items that occur, and which of them each record has, (N,).
    """
    octets = _octets(data)
    longest = max((node.size for node in layout.records.values()), default=1)
    head = np.zeros((len(records.start), 8), np.uint8)
    go_on = np.ones(len(records.start), np.bool_)
    for k in range(longest):
        go_on &= records.start + k < records.stop
        head[go_on, k] = octets[records.start[go_on] + k]
        go_on = go_on & (head[:, k] & 1 == 1)
    head[:, 7] = records.profile
    words, which = np.unique(head.view(np.uint64)[:, 0], return_inverse=True)
    profiles = [[child.path if child else "" for child in node.children] for node in layout.records.values()]
    return [_named(int(word).to_bytes(8, sys.byteorder), profiles) for word in words], which.astype(np.int64)


def _named(head: bytes, profiles: list[list[str]]) -> list[str]:
    names = profiles[head[7]]
    flags = [7 * k + bit for k in range(7) for bit in range(7) if head[k] & (0x80 >> bit)]
    return [names[frn] for frn in flags if frn < len(names) and names[frn] not in ("", "RFS")]


def _extract(
    native: ModuleType,
    octets: npt.NDArray[np.uint8],
    start: npt.NDArray[np.int64],
    stop: npt.NDArray[np.int64],
    program: Program,
) -> list[tuple[npt.NDArray[Any], npt.NDArray[Any]]]:
    dense = [None if out.repeated else walk.places(len(start), out) for out in program.outputs]
    widths = [2 * 8 if out.form == SPAN else out.dtype.itemsize for out in program.outputs]
    places = [None if pair is None else tuple(a.reshape(-1).view(np.uint8) for a in pair) for pair in dense]
    found = native.asterix_extract(octets, start, stop, program, places, widths)
    return [
        pair if pair is not None else (many[0].view(out.dtype), many[1])
        for pair, many, out in zip(dense, found, program.outputs, strict=True)
    ]


def _octets(data: Data) -> npt.NDArray[np.uint8]:
    octets = data if isinstance(data, np.ndarray) else np.frombuffer(data, np.uint8)
    return np.ascontiguousarray(octets, np.uint8)


def _column(program: Program, k: int, values: npt.NDArray[Any], other: npt.NDArray[Any]) -> Column:
    return Column(values, None, other) if program.outputs[k].repeated else Column(values, other, None)


def _check(data: npt.NDArray[np.uint8], offset: npt.NDArray[np.int64], length: npt.NDArray[np.int64]) -> None:
    if len(offset) != len(length) or np.any((offset < 0) | (length < 0) | (offset + length > len(data))):
        raise ValueError(f"blocks must lie in the buffer of {len(data)} bytes.")
