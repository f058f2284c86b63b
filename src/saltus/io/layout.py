"""How long each ASTERIX item is and where its fields lie, compiled from the tables of libasterix.

libasterix parses a record into objects, about 0.7 ms each; a recording needs a handful of numbers of each record.
So its tables (one class for each item of each edition) are compiled once into measuring functions: a record is
walked item by item, strictly as the library does it (the tests hold both against each other), and the bytes of
the wanted items are kept for conversion as whole columns.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

__all__ = ["Field", "Layout", "Malformed", "categories", "edition_name", "layout"]

# Length of an item: bytes, or (data, start, end) -> where the item stops, which raises Malformed.
Measure = int | Callable[[bytes, int, int], int]

_SI = {"NM": 1852.0, "°": np.pi / 180, "s": 1.0, "FL": 30.48, "ft": 0.3048, "m": 1.0, "m/s": 1.0, "ft/min": 0.00508}


class Malformed(Exception):
    """The bytes do not follow the edition's definition; `offset` is where, `what` says how."""

    def __init__(self, offset: int, what: str) -> None:
        super().__init__(what)
        self.offset = offset
        self.what = what


class Field(NamedTuple):
    """A number in the first 8 bytes of an item: its bits, sign and step in SI units."""

    item: str
    offset: int  # bits from the item's first bit
    size: int  # bits
    signed: bool
    lsb: float

    def raw(self, words: npt.NDArray[np.uint64]) -> npt.NDArray[np.int64]:
        """Take the field's integer out of items held left-aligned in 64-bit words, (N,)."""
        shift = np.uint64(64 - self.offset - self.size)
        value = ((words >> shift) & np.uint64((1 << self.size) - 1)).astype(np.int64)
        half = 1 << (self.size - 1)
        return np.where(value >= half, value - 2 * half, value) if self.signed else value


class Layout:
    """One edition of one category: walks records, and tells where fields lie."""

    def __init__(self, record: Any, edition: str) -> None:
        self.edition = edition
        self._record = record
        self._base = _base()
        self.names: list[str] = []
        self._items: list[tuple[str, Measure] | None] = []
        for entry in record.cv_items_list:
            if issubclass(entry, self._base.UapItem):
                name = entry.cv_non_spare.cv_name
                self.names.append(name)
                self._items.append((name, _measure(_variation(entry.cv_non_spare))))
            elif issubclass(entry, self._base.UapItemRFS):
                self._items.append(("RFS", self._random_sequence))
            else:
                self._items.append(None)
        self._plans: dict[bytes, list[tuple[str, Measure]]] = {}

    def walk(self, data: bytes, start: int, end: int) -> tuple[bytes, dict[str, tuple[int, int]], int]:
        """Measure the record at `start`.

        Returns:
            Its FSPEC, where each of its items starts and stops, and where the record stops.

        Raises:
            Malformed: the record does not follow the definition, or ends beyond `end`.
        """
        fspec, position = _fspec(data, start, end, self._record.cv_fspec_max_bytes)
        plan = self._plans.get(fspec)
        if plan is None:
            plan = self._plans[fspec] = _flagged(fspec, self._items, start)
        spans = {}
        for name, measure in plan:
            stop = position + measure if isinstance(measure, int) else measure(data, position, end)
            if stop > end:
                raise Malformed(position, f"item {name} needs {stop - position} bytes, {end - position} are left")
            spans[name] = (position, stop)
            position = stop
        return fspec, spans, position

    def names_in(self, fspec: bytes) -> list[str]:
        """Items that an FSPEC announces."""
        return [name for name, _ in self._plans[fspec]]

    def field(self, item: str, name: str | None = None, *, signed: bool | None = None) -> Field:
        """Locate a field of an item, or the item's only one; `signed` overrides the definition."""
        base = self._base
        variation = _variation(self._record.cv_items_dict[item])
        offset, element = _locate(variation, name) if name else (0, variation)
        rule = element.cv_rule
        content = rule.cv_content if issubclass(rule, base.RuleContentContextFree) else rule.cv_default_content
        lsb, negative = 1.0, False
        if issubclass(content, base.ContentQuantity):
            lsb = content.cv_lsb * _SI[content.cv_unit]
            negative = content.cv_signedness is base.Signed
        return Field(item, offset, element.cv_bit_size, negative if signed is None else signed, lsb)

    def labels(self, item: str, name: str | None = None) -> Mapping[int, str]:
        """What the definition says about each value of a coded field."""
        variation = _variation(self._record.cv_items_dict[item])
        _, element = _locate(variation, name) if name else (0, variation)
        values: Mapping[int, str] = element.cv_rule.cv_content.cv_values
        return values

    def part(self, item: str, name: str, data: bytes) -> bytes | None:
        """Bytes of one part of a compound item, or None when it is not there."""
        variation = _variation(self._record.cv_items_dict[item])
        fspec, position = _fspec(data, 0, len(data), variation.cv_fspec_max_bytes)
        for label, measure in _flagged(fspec, _compound_items(variation), 0):
            stop = _stop(measure, data, position, len(data))
            if label == name:
                return data[position:stop]
            position = stop
        return None

    def _random_sequence(self, data: bytes, start: int, end: int) -> int:
        position = start + 1
        for _ in range(_byte(data, start, end)):
            frn = _byte(data, position, end)
            entry = self._items[frn - 1] if 0 < frn <= len(self._items) else None
            if entry is None or entry[0] == "RFS":
                raise Malformed(position, f"random field sequencing names item {frn}, which is not defined")
            position = _stop(entry[1], data, position + 1, end)
        return position


@cache
def layout(category: int, edition: str) -> Layout:
    """Compile one edition of a category; KeyError when libasterix does not have it."""
    return Layout(categories()[category][edition], edition)


@cache
def categories() -> dict[int, dict[str, Any]]:
    """All categories of libasterix with one record definition: edition -> record class, oldest first."""
    from asterix import generated

    base = _base()
    table: dict[int, dict[str, Any]] = {}
    manifest: Any = generated.manifest
    for number, editions in manifest["CATS"].items():
        single = [e for e in editions if issubclass(e.cv_uap, base.UapSingle)]
        if single:
            ordered = sorted(single, key=lambda e: e.cv_edition)
            table[number] = {edition_name(*e.cv_edition): e.cv_uap.cv_record for e in ordered}
    return table


def edition_name(major: int, minor: int) -> str:
    """Edition as written in the documents: 0.23, 2.1."""
    return f"{major}.{minor}"


def _base() -> Any:
    from asterix import base

    return base


def _variation(non_spare: Any) -> Any:
    rule = non_spare.cv_rule
    return rule.cv_variation if hasattr(rule, "cv_variation") else rule.cv_default_variation


def _stop(measure: Measure, data: bytes, start: int, end: int) -> int:
    return start + measure if isinstance(measure, int) else measure(data, start, end)


def _byte(data: bytes, position: int, end: int) -> int:
    if position >= end:
        raise Malformed(position, "the record ends within an item")
    return data[position]


def _fspec(data: bytes, start: int, end: int, max_bytes: int) -> tuple[bytes, int]:
    stop = start
    while True:
        stop += 1
        if stop > end:
            raise Malformed(start, "the field specification has no end")
        if stop - start > max_bytes:
            raise Malformed(start, f"the field specification is longer than {max_bytes} bytes")
        if not data[stop - 1] & 1:
            return data[start:stop], stop


def _flagged(fspec: bytes, items: Sequence[tuple[str, Measure] | None], start: int) -> list[tuple[str, Measure]]:
    plan = []
    for k, octet in enumerate(fspec):
        for bit in range(7):
            if octet & (0x80 >> bit):
                frn = 7 * k + bit
                entry = items[frn] if frn < len(items) else None
                if entry is None:
                    raise Malformed(start, f"field {frn + 1} is announced but not defined in this edition")
                plan.append(entry)
    return plan


def _bits(variation: Any) -> int:
    """Size of an item of fixed size; 0 for the others."""
    base = _base()
    if issubclass(variation, base.Element | base.Group):
        return int(variation.cv_bit_size)
    return 0


@cache
def _measure(variation: Any) -> Measure:
    base = _base()
    if issubclass(variation, base.Element | base.Group):
        return _bits(variation) // 8
    if issubclass(variation, base.Extended):
        return _measure_extended(variation)
    if issubclass(variation, base.Repetitive):
        return _measure_repetitive(variation)
    if issubclass(variation, base.Explicit):
        return _measure_explicit
    return _measure_compound(variation)


def _measure_extended(variation: Any) -> Measure:
    parts = [
        (sum(1 if entry is None else entry[1] for entry in part) // 8, part[-1] is None)
        for part in variation.cv_items_list
    ]

    def measure(data: bytes, start: int, end: int) -> int:
        position = start
        for n_bytes, extends in parts:
            position += n_bytes
            if not extends:
                return position
            if position > end:
                raise Malformed(start, "the record ends within an item")
            if not data[position - 1] & 1:
                return position
        raise Malformed(start, "an item extends beyond its definition")

    return measure


def _measure_repetitive(variation: Any) -> Measure:
    inner = variation.cv_variation
    n_count: int | None = variation.cv_rep_bytes
    if n_count is None:
        step = (_bits(inner) + 1) // 8

        def measure_chain(data: bytes, start: int, end: int) -> int:
            position = start + step
            while _byte(data, position - 1, end) & 1:
                position += step
            return position

        return measure_chain
    each, n_bytes = _measure(inner), _bits(inner) // 8

    def measure(data: bytes, start: int, end: int) -> int:
        position = start + n_count
        _byte(data, position - 1, end)
        count = int.from_bytes(data[start:position], "big")
        if n_bytes:
            return position + count * n_bytes
        for _ in range(count):
            position = _stop(each, data, position, end)
        return position

    return measure


def _measure_explicit(data: bytes, start: int, end: int) -> int:
    length = _byte(data, start, end)
    if length == 0:
        raise Malformed(start, "an item of explicit length says 0 bytes")
    return start + length


@cache
def _compound_items(variation: Any) -> list[tuple[str, Measure] | None]:
    return [None if sub is None else (sub.cv_name, _measure(_variation(sub))) for sub in variation.cv_items_list]


def _measure_compound(variation: Any) -> Measure:
    items = _compound_items(variation)
    longest = variation.cv_fspec_max_bytes
    plans: dict[bytes, list[tuple[str, Measure]]] = {}

    def measure(data: bytes, start: int, end: int) -> int:
        fspec, position = _fspec(data, start, end, longest)
        plan = plans.get(fspec)
        if plan is None:
            plan = plans[fspec] = _flagged(fspec, items, start)
        for name, each in plan:
            stop = position + each if isinstance(each, int) else each(data, position, end)
            if stop > end:
                raise Malformed(position, f"part {name} needs {stop - position} bytes, {end - position} are left")
            position = stop
        return position

    return measure


def _locate(variation: Any, name: str) -> tuple[int, Any]:
    """Bit offset and definition of a named field of a group or an extended item."""
    base = _base()
    if issubclass(variation, base.Extended):
        entries = [entry for part in variation.cv_items_list for entry in part]
    else:
        entries = list(variation.cv_items_list)
    offset = 0
    for entry in entries:
        if entry is not None and issubclass(entry[0], base.Item) and entry[0].cv_non_spare.cv_name == name:
            return offset, _variation(entry[0].cv_non_spare)
        offset += 1 if entry is None else entry[1]
    raise KeyError(name)
