"""The definition of the encoder, in Python: packs columns of raw integers into records over the tables of a program.

Its compiled twin is `native/asterix_pack.hpp`; both give the same bytes.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.asterix.layout import COMPOUND, EXPANSION, EXPLICIT, EXTENDED, FIXED, REPEATED
from saltus.asterix.program import Program

__all__ = ["Input", "pack"]


class Input(NamedTuple):
    """Raw integers of one field.

    Dense: `first` is None and `values`, `present` have one entry for each record. Repeated: the values of record k are
    values[first[k]:first[k + 1]].
    """

    values: npt.NDArray[np.int64]
    present: npt.NDArray[np.bool_] | None
    first: npt.NDArray[np.int64] | None


class _Packer:
    """Packs single records."""

    def __init__(self, program: Program, inputs: list[Input]) -> None:
        self.nodes: list[list[int]] = program.nodes.tolist()
        self.index: list[int] = program.index.tolist()
        self.slots: list[list[int]] = program.slots.tolist()
        self.values: list[list[int]] = [i.values.tolist() for i in inputs]
        self.present = [None if i.present is None else i.present.tolist() for i in inputs]
        self.overflow = -1  # record with more repetitions or bytes than their count can say
        self.first = [None if i.first is None else i.first.tolist() for i in inputs]

    def count(self, output: int, row: int) -> tuple[int, int]:
        """Where the values of a record start, and how many there are."""
        first = self.first[output]
        if first is not None:
            return first[row], first[row + 1] - first[row]
        present = self.present[output]
        return row, int(present is None or present[row])

    def mine(self, node: int) -> list[list[int]]:
        """Slots of a node."""
        _, _, _, _, first, n = self.nodes[node]
        return self.slots[first : first + n]

    def has(self, node: int, row: int) -> bool:
        """Whether a record holds a node."""
        kind, _, first, count, *_ = self.nodes[node]
        if any(self.count(slot[4], row)[1] for slot in self.mine(node)):
            return True
        if kind not in (COMPOUND, EXPANSION, EXPLICIT):
            return False
        return any(child >= 0 and self.has(child, row) for child in self.index[first : first + count])

    def put(self, node: int, row: int) -> bytes:
        """Bytes of a node that a record holds."""
        kind, size, first, count, *_ = self.nodes[node]
        entries = self.index[first : first + count]
        if kind == FIXED:
            return self.fields(node, row, size, 0)
        if kind == EXTENDED:
            return self.extended(node, row, entries)
        if kind == REPEATED:
            n = self.count(self.mine(node)[0][4], row)[1]
            if entries[0] and n >= 256 ** entries[0]:
                self.overflow = row
                return b""
            parts = [self.fields(node, row, size, k) for k in range(n)]
            if entries[0]:
                return n.to_bytes(entries[0], "big") + b"".join(parts)
            return b"".join(p[:-1] + bytes([p[-1] | (k < n - 1)]) for k, p in enumerate(parts))
        if kind == EXPLICIT:
            return self.explicit(node, row, entries)
        held = [child >= 0 and self.has(child, row) for child in entries]
        body = b"".join(self.put(child, row) for child, h in zip(entries, held, strict=True) if h)
        return (_flags(held) if kind == COMPOUND else _fixed_flags(held, size)) + body

    def fields(self, node: int, row: int, size: int, repetition: int) -> bytes:
        """All fields of an item or of one repetition; what is not given is 0."""
        word = 0
        for _, offset, bits, _, output, *_ in self.mine(node):
            start, n = self.count(output, row)
            if n > repetition:
                word |= self.raw(output, start + repetition, bits) << (8 * size - offset - bits)
        return word.to_bytes(size, "big")

    def raw(self, output: int, place: int, bits: int) -> int:
        """Bits of one value; of more than 64 its bytes stand one by one."""
        values = self.values[output]
        if bits <= 64:
            return values[place] & ((1 << bits) - 1)
        n = bits // 8
        return int.from_bytes(bytes(values[n * place : n * place + n]), "big")

    def extended(self, node: int, row: int, parts: list[int]) -> bytes:
        """Parts up to the last with a field that is given."""
        given = [slot[1] + slot[2] for slot in self.mine(node) if self.count(slot[4], row)[1]]
        sizes = np.cumsum(np.abs(parts))
        n = int(np.searchsorted(8 * sizes, max(given))) + 1
        body = bytearray(self.fields(node, row, int(sizes[-1]), 0)[: sizes[n - 1]])
        for stop in sizes[: n - 1]:
            body[stop - 1] |= 1
        return bytes(body)

    def explicit(self, node: int, row: int, entries: list[int]) -> bytes:
        """A length byte, and what it counts: bytes as given, or items."""
        slots = self.mine(node)
        if slots:
            start, n = self.count(slots[0][4], row)
            body = bytes(self.values[slots[0][4]][start : start + n])
        else:
            body = b""
        if entries and self.has(entries[0], row):
            body = self.put(entries[0], row)
        if len(body) > 254:
            self.overflow = row
            return b""
        return bytes([len(body) + 1]) + body


def _fixed_flags(held: list[bool], size: int) -> bytes:
    octets = bytearray(size)
    for k, h in enumerate(held):
        if h:
            octets[k // 8] |= 0x80 >> k % 8
    return bytes(octets)


def _flags(held: list[bool]) -> bytes:
    last = max((k for k, h in enumerate(held) if h), default=0) // 7
    octets = bytearray(last + 1)
    for k, h in enumerate(held):
        if h:
            octets[k // 7] |= 0x80 >> k % 7
    for k in range(last):
        octets[k] |= 1
    return bytes(octets)


def pack(program: Program, inputs: list[Input], n: int, root: int) -> tuple[bytes, npt.NDArray[np.int64], int]:
    """Pack n records of a profile.

    Returns:
        Their bytes; where each starts, the end included, (n + 1,); and a record that cannot be packed, or -1.
    """
    packer = _Packer(program, inputs)
    records = [packer.put(int(program.roots[root]), row) for row in range(n)]
    start = np.zeros(n + 1, np.int64)
    np.cumsum([len(record) for record in records], out=start[1:])
    return b"".join(records), start, packer.overflow
