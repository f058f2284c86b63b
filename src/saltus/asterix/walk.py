"""The definition of the decoder, in Python: walks records over the tables of a program.

Its compiled twin is `native/asterix.cpp`; both give the same records, faults and columns for any bytes.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.asterix.layout import COMPOUND, EXPLICIT, EXTENDED, FIXED, RANDOM, REPEATED
from saltus.asterix.program import ASCII, BYTES, FLOAT, ICAO, INTEGER, SPAN, Output, Program

__all__ = ["extract", "find", "places"]

# codes of faults; `saltus.asterix.codec.FAULTS` says them in words
(_, ENDLESS, LONG, UNDEFINED, SHORT, BEYOND, EMPTY, RANDOM_UNKNOWN, NO_SOURCE, NO_PROFILE, CONTENT) = range(11)


class Fault(Exception):
    """Why a walk stopped: code, byte, node, and what was needed."""

    def __init__(self, code: int, position: int, node: int, need: int = 0) -> None:
        super().__init__(code)
        self.code, self.position, self.node, self.need = code, position, node, need


class Visit(NamedTuple):
    """A node met on the way: an item, or one repetition of it."""

    node: int
    start: int
    stop: int
    whole: bool  # the item itself, not one repetition


class Walker:
    """Walks single records."""

    def __init__(self, data: bytes, program: Program, strict: bool) -> None:
        self.data = data
        self.nodes: list[list[int]] = program.nodes.tolist()
        self.index: list[int] = program.index.tolist()
        self.roots: list[int] = program.roots.tolist()
        self.select: list[int] = program.select.tolist()
        self.profiles = {value: profile for value, profile in program.profiles.tolist()}
        self.required = program.required
        self.root = self.roots[0]
        self.profile = 0
        self.source = False
        self.strict = strict
        self.visits: list[Visit] = []
        self.notes: list[Fault] = []  # of items skipped in a record that goes on

    def record(self, start: int, end: int) -> tuple[int, int]:
        """Walk the record at `start`; return where it stops and its profile.

        Raises:
            Fault: it does not follow the layout, or ends beyond `end`.
        """
        self.visits, self.notes = [], []
        self.profile = -1 if self.select else 0
        self.root = self.roots[0]
        flags, position = self._flags(self.root, start, end, max(self.nodes[r][1] for r in self.roots))
        self.source = self.required < 0
        for bit in flags:
            child = self._child(self.root, bit, start)
            stop = self._node(child, position, end)
            self.source |= child == self.required
            if self.select and child == self.select[0]:
                value = bits(self.data, position, self.select[1], self.select[2])
                self.profile = self.profiles.get(value, -1)
                if self.profile < 0:
                    raise Fault(NO_PROFILE, position, child, value)
                self.root = self.roots[self.profile]
            position = stop
        if self.profile < 0:
            raise Fault(NO_PROFILE, start, self.select[0], -1)
        if not self.source:
            raise Fault(NO_SOURCE, start, self.required)
        return position, self.profile

    def keeps(self, fault: Fault) -> bool:
        """Whether a record is worth keeping although it breaks off: all but a field of its own length was read.

        These fields (reserved expansion, special purpose) come last, so nothing before them depends on their length.
        """
        kind = self.nodes[fault.node][0]
        return kind == EXPLICIT and self.source and self.profile >= 0

    def _flags(self, node: int, start: int, end: int, longest: int) -> tuple[list[int], int]:
        """Numbers of the flags set in a field specification, and where it stops."""
        flags, position = [], start
        while True:
            if position >= end:
                raise Fault(ENDLESS, start, node)
            if position - start >= longest:
                raise Fault(LONG, start, node, longest)
            octet = self.data[position]
            flags += [7 * (position - start) + bit for bit in range(7) if octet & (0x80 >> bit)]
            position += 1
            if not octet & 1:
                return flags, position

    def _child(self, node: int, bit: int, start: int) -> int:
        _, _, first, count, *_ = self.nodes[node]
        child = self.index[first + bit] if bit < count else -1
        if child < 0:
            raise Fault(UNDEFINED, start, node, bit + 1)
        return child

    def _node(self, node: int, start: int, end: int) -> int:
        kind, size, first, count, *_ = self.nodes[node]
        if kind == FIXED:
            stop = self._within(node, start, start + size, end)
        elif kind == EXTENDED:
            stop = self._extended(node, start, end)
        elif kind == REPEATED:
            stop = self._repeated(node, start, end, size, self.index[first])
        elif kind == EXPLICIT:
            stop = self._explicit(node, start, end, self.index[first] if count else -1)
        elif kind == COMPOUND:
            flags, stop = self._flags(node, start, end, size)
            for bit in flags:
                stop = self._node(self._child(node, bit, start), stop, end)
        else:
            assert kind == RANDOM
            return self._random(node, start, end)
        if kind != EXPLICIT:
            self.visits.append(Visit(node, start, stop, True))
        return stop

    def _within(self, node: int, start: int, stop: int, end: int) -> int:
        if stop > end:
            raise Fault(SHORT, start, node, stop - start)
        return stop

    def _extended(self, node: int, start: int, end: int) -> int:
        _, _, first, count, *_ = self.nodes[node]
        stop = start
        for part in self.index[first : first + count]:
            stop = self._within(node, start, stop + abs(part), end)
            if part < 0 or not self.data[stop - 1] & 1:
                return stop
        if self.strict:
            raise Fault(BEYOND, start, node)
        self.notes.append(Fault(BEYOND, start, node))
        while self.data[stop - 1] & 1:
            stop = self._within(node, start, stop + 1, end)
        return stop

    def _repeated(self, node: int, start: int, end: int, size: int, count_bytes: int) -> int:
        stop = self._within(node, start, start + count_bytes, end)
        if count_bytes:
            each = range(int.from_bytes(self.data[start:stop], "big"))
            self._within(node, start, stop + len(each) * size, end)
            for _ in each:
                self.visits.append(Visit(node, stop, stop + size, False))
                stop += size
        else:
            more = True
            while more:
                stop = self._within(node, start, stop + size, end)
                self.visits.append(Visit(node, stop - size, stop, False))
                more = bool(self.data[stop - 1] & 1)
        return stop

    def _explicit(self, node: int, start: int, end: int, content: int) -> int:
        stop = self._within(node, start, start + 1, end)
        length = self.data[start]
        if length == 0:
            raise Fault(EMPTY, start, node)
        stop = self._within(node, start, start + length, end)
        self.visits.append(Visit(node, start, stop, True))
        if content >= 0:
            kept, noted = len(self.visits), len(self.notes)
            try:
                if self._content(content, start + 1, stop) != stop:
                    raise Fault(CONTENT, start, node)
            except Fault:
                del self.visits[kept:], self.notes[noted:]
                self.notes.append(Fault(CONTENT, start, node))
        return stop

    def _content(self, node: int, start: int, end: int) -> int:
        _, size, first, count, *_ = self.nodes[node]
        stop = self._within(node, start, start + size, end)
        for bit in range(8 * size):
            if self.data[start + bit // 8] & (0x80 >> bit % 8):
                if bit >= count or self.index[first + bit] < 0:
                    raise Fault(UNDEFINED, start, node, bit + 1)
                stop = self._node(self.index[first + bit], stop, end)
        return stop

    def _random(self, node: int, start: int, end: int) -> int:
        _, _, first, count, *_ = self.nodes[self.root]
        position = self._within(node, start, start + 1, end)
        for _ in range(self.data[start]):
            at = position
            position = self._within(node, at, at + 1, end)
            frn = self.data[at]
            child = self.index[first + frn - 1] if 0 < frn <= count else -1
            if child < 0 or self.nodes[child][0] == RANDOM:
                raise Fault(RANDOM_UNKNOWN, at, node, frn)
            position = self._node(child, position, end)
        return position


def find(
    data: bytes, offset: npt.NDArray[np.int64], length: npt.NDArray[np.int64], program: Program, strict: bool
) -> tuple[list[npt.NDArray[np.int64]], list[npt.NDArray[np.int64]]]:
    """Walk the records of all blocks.

    Returns:
        Columns of the records: block, number in it, start, stop, profile; and of the faults: block, byte, code, node,
        needed, left, record kept or -1.
    """
    walker = Walker(data, program, strict)
    records: list[tuple[int, ...]] = []
    faults: list[tuple[int, ...]] = []
    for block, (start, size) in enumerate(zip(offset.tolist(), length.tolist(), strict=True)):
        position, end, number = start + 3, start + size, 0
        while position < end:
            broken: Fault | None = None
            try:
                stop, profile = walker.record(position, end)
            except Fault as what:
                broken, stop, profile = what, end, walker.profile
            kept = broken is None or walker.keeps(broken)
            mine = len(records) if kept else -1
            for fault in (*walker.notes, *([broken] if broken else [])):
                faults.append((block, fault.position, fault.code, fault.node, fault.need, end - fault.position, mine))
            if kept:
                records.append((block, number, position, stop, profile))
                number += 1
            position = stop
    return list(np.array(records, np.int64).reshape(-1, 5).T.copy()), list(
        np.array(faults, np.int64).reshape(-1, 7).T.copy()
    )


def extract(
    data: bytes, start: npt.NDArray[np.int64], stop: npt.NDArray[np.int64], program: Program
) -> list[tuple[Any, Any]]:
    """Values of each output, with presence (dense) or rows (repeated)."""
    walker = Walker(data, program, False)
    slots, guards, scale = program.slots.tolist(), program.guards.tolist(), program.scale.tolist()
    found: list[dict[int, Any]] = [{} for _ in program.outputs]
    many: list[list[tuple[int, Any]]] = [[] for _ in program.outputs]
    for row, span in enumerate(zip(start.tolist(), stop.tolist(), strict=True)):
        try:
            walker.record(*span)
        except Fault:
            pass  # `find` has told; what was met before it counts
        for node, first, last, whole in walker.visits:
            _, _, _, _, first_slot, n_slots = walker.nodes[node]
            for k in range(first_slot, first_slot + n_slots):
                form, shift, size, signed, output, first_guard, n_guards = slots[k]
                if form == SPAN:
                    if whole:
                        found[output][row] = first, last
                    continue
                if whole != (walker.nodes[node][0] != REPEATED) or shift + size > 8 * (last - first):
                    continue
                mine = guards[first_guard : first_guard + n_guards]
                given = 8 * (last - first)
                if all(o + s <= given and bits(data, first, o, s) == v for o, s, v in mine):
                    value = _value(bits(data, first, shift, size), form, size, signed, scale[k])
                    many[output].append((row, value))
                    found[output][row] = value
    return [
        _repeated(out.dtype, rows) if out.repeated else _dense(len(start), out, held)
        for out, held, rows in zip(program.outputs, found, many, strict=True)
    ]


def bits(data: bytes, start: int, offset: int, size: int) -> int:
    """The unsigned integer of `size` bits, `offset` bits from byte `start`."""
    first, last = start + offset // 8, start + (offset + size + 7) // 8
    return int.from_bytes(data[first:last], "big") >> (-(offset + size) % 8) & ((1 << size) - 1)


def _value(raw: int, form: int, size: int, signed: int, scale: list[float]) -> Any:
    if form in (FLOAT, INTEGER):
        value = raw - (1 << size) if signed and raw >> (size - 1) else raw
        if form == FLOAT:
            return value * scale[0] + scale[1]
        return value - (1 << 64) if value >> 63 == 1 else value
    if form == BYTES:
        return raw.to_bytes(size // 8, "big")
    width, letter = {ICAO: (6, _icao), ASCII: (8, _ascii)}[form]
    codes = [raw >> shift & ((1 << width) - 1) for shift in range(size - width, -1, -width)]
    return b"".join(letter(code) for code in codes).strip(b" ")


def _icao(code: int) -> bytes:
    """A to Z are 1 to 26, blank 32, digits 48 to 57; others stand for nothing (ICAO Annex 10 vol. IV, 3.1.2.9.1.2)."""
    if 1 <= code <= 26:
        return bytes([64 + code])
    return bytes([code]) if code == 32 or 48 <= code <= 57 else b""


def _ascii(code: int) -> bytes:
    return bytes([code]) if code else b""


def places(n: int, out: Output) -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_]]:
    """Empty places for the values of n records, and for whether they are there."""
    present = np.zeros(n, np.bool_)
    if out.form == SPAN:
        return np.full((n, 2), -1, out.dtype), present
    if out.form in (FLOAT, INTEGER):
        return np.full(n, np.nan if out.form == FLOAT else out.absent, out.dtype), present
    return np.zeros(n, out.dtype), present


def _dense(n: int, out: Output, held: dict[int, Any]) -> tuple[Any, Any]:
    values, present = places(n, out)
    rows = list(held)
    if rows:
        present[rows] = True
        values[rows] = np.array(list(held.values()), out.dtype)
    return values, present


def _repeated(dtype: np.dtype[Any], rows: list[tuple[int, Any]]) -> tuple[Any, Any]:
    return np.array([value for _, value in rows], dtype), np.array([row for row, _ in rows], np.int64)
