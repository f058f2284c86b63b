"""Layouts of ASTERIX records: how long each item is, where its fields lie and what they are called.

One file of `tables/` holds all editions of one category; `scripts/asterix_tables.py` writes them and says their form.
A layout is a tree of nodes (what a walker needs to measure a record) and a table of fields (what can be asked for).

A field's path is the item's name and the names inside it: "040/RHO", "380/ADR", "130/SRL", "RE/MES/SUM/M5". An item
without parts is its own field: "070" of category 62. "250/5,0/ROLL" is a field of a Comm-B register, taken from the
repetition that carries this register. "150/AS[IM=1]" is a field as it is to be read when another has that value.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple

from saltus.asterix.registers import REGISTERS
from saltus.errors import DataError

__all__ = ["SI", "Field", "Guard", "Layout", "Node", "categories", "editions", "expansions", "layout"]

# unit of the tables -> factor to SI units and radians; what is not here is kept as it is (dB, %, degrees Celsius)
SI = {
    **{"NM": 1852.0, "NM/s": 1852.0, "kt": 1852 / 3600, "ft": 0.3048, "FL": 30.48, "ft/min": 0.3048 / 60},
    **{"°": 0.017453292519943295, "°/s": 0.017453292519943295, "ms": 1e-3, "ns": 1e-9, "fs": 1e-15},
    **{"mb": 100.0, "hPa": 100.0, "MHz": 1e6, "ALTFL": 30.48},
}

FIXED, EXTENDED, REPEATED, EXPLICIT, COMPOUND, EXPANSION, RANDOM = range(7)  # kinds of nodes


class Guard(NamedTuple):
    """A field counts only where these bits, counted as its own, hold this value."""

    offset: int
    size: int
    value: int


@dataclass(frozen=True, slots=True)
class Field:
    """One number, code or text of a record."""

    path: str
    title: str
    kind: str  # "integer", "table", "quantity", "register", "octal" (an integer), "icao", "ascii" (texts), "bytes"
    offset: int  # bits, from the first bit of its item, part of a compound item or repetition
    size: int  # bits
    signed: bool = False
    lsb: float = 1.0
    unit: str = ""
    origin: float = 0.0  # of a quantity whose raw value is 0, in `unit`
    labels: Mapping[int, str] | None = None
    guards: tuple[Guard, ...] = ()
    repeated: bool = False  # a record may hold it many times

    @property
    def item(self) -> str:
        """Name of the item it belongs to."""
        return self.path.partition("/")[0]


class Node(NamedTuple):
    """What a walker needs to know of an item, a part of one, or a record.

    FIXED: `size` bytes. EXTENDED: `parts` bytes each up to the next extension bit; the last is negative when it ends
    without one. REPEATED: `size` bytes each, their number in parts[0] bytes (0 = chained by extension bits).
    EXPLICIT: a length byte; children[0] is its content, an EXPANSION of `size` bytes of flags, 8 children a byte.
    COMPOUND: up to `size` bytes of flags, 7 children a byte. RANDOM: numbered items in any order.
    """

    kind: int
    path: str
    size: int
    parts: tuple[int, ...] = ()
    children: tuple["Node | None", ...] = ()
    fields: tuple[Field, ...] = ()


@dataclass(frozen=True, slots=True)
class Layout:
    """One edition of one category."""

    category: int
    edition: str
    records: Mapping[str, Node]  # one, named "", or one for each user application profile
    select: tuple[str, Mapping[int, str]] | None  # field and its values that tell the profile of a record
    titles: Mapping[str, str]  # of items, by name
    fields: Mapping[str, tuple[Field, ...]]  # by path; more than one where profiles define it differently

    def has(self, path: str) -> bool:
        """Whether this edition defines an item, a part of one or a field."""
        return path in self.titles or path in self.fields

    def field(self, path: str) -> Field:
        """The field of a path, by its first definition.

        Raises:
            DataError: this edition has no such field.
        """
        found = self.fields.get(path)
        if found is None:
            raise DataError(
                f"category {self.category} edition {self.edition} has no field {path!r}; its items are "
                f"{', '.join(sorted(self.titles))}."
            )
        return found[0]

    def labels(self, path: str) -> Mapping[int, str]:
        """What the definition says about each value of a coded field."""
        return self.field(path).labels or {}


@cache
def categories() -> tuple[int, ...]:
    """Numbers of all categories with a layout."""
    folder = files("saltus.asterix") / "tables"
    return tuple(sorted(int(f.name[3:6]) for f in folder.iterdir() if f.name.endswith(".json")))


def editions(category: int) -> tuple[str, ...]:
    """Editions of a category, oldest first; none when it has no layout."""
    return tuple(_table(category)["editions"]) if category in categories() else ()


def expansions(category: int) -> tuple[str, ...]:
    """Editions of what the reserved expansion field of a category holds, oldest first."""
    return tuple(_table(category)["expansions"]) if category in categories() else ()


@cache
def layout(category: int, edition: str, expansion: str | None = None) -> Layout:
    """Compile one edition of a category.

    Args:
        category: its number.
        edition: as in the documents: "0.23", "2.1".
        expansion: edition of the reserved expansion field; the newest when not given.

    Raises:
        DataError: there is no such category or edition.
    """
    known = editions(category)
    if edition not in known:
        raise DataError(
            f"edition {edition!r} of category {category} is not known; choose one of {', '.join(known)}."
            if known
            else f"category {category} has no layout; those known are {', '.join(map(str, categories()))}."
        )
    return _Compiler(_table(category), expansion).layout(edition)


@cache
def _table(category: int) -> dict[str, Any]:
    text = (files("saltus.asterix") / "tables" / f"cat{category:03d}.json").read_text(encoding="utf-8")
    table: dict[str, Any] = json.loads(text)
    return table


class _Compiler:
    """From the pools of one category's file to nodes and fields."""

    def __init__(self, table: dict[str, Any], expansion: str | None) -> None:
        self.table = table
        held = table["expansions"]
        self.expansion = held[expansion or list(held)[-1]] if held else None
        self.titles: dict[str, str] = {}
        self.memo: dict[tuple[int, str], Node] = {}
        self.depends: dict[str, Mapping[str, int]] = {}  # path of a field -> other fields and the values they need

    def layout(self, edition: str) -> Layout:
        entry = self.table["editions"][edition]
        records = {
            name: Node(COMPOUND, "", entry["bytes"][name], children=tuple(map(self._entry, uap)))
            for name, uap in entry["uaps"].items()
        }
        select = None
        if "select" in entry:
            path, names = entry["select"]
            select = "/".join(path), {int(value): name for value, name in names.items()}
        found: dict[str, list[Field]] = {}
        for node in {id(n): n for record in records.values() for n in _descend(record)}.values():
            for field in node.fields:
                found.setdefault(field.path, []).append(field)
        fields = {path: tuple(same) for path, same in found.items()}
        return Layout(self.table["category"], edition, records, select, self.titles, fields)

    def _entry(self, entry: int | str | None) -> Node | None:
        if isinstance(entry, int):
            return self._item(entry, "")
        return None if entry is None else Node(RANDOM, "RFS", 0)

    def _item(self, number: int, prefix: str) -> Node:
        name, title, node = self.table["items"][number]
        path = prefix + name
        if (number, path) not in self.memo:
            self.titles[path] = title
            self.memo[number, path] = self._node(node, path, title)
        return self.memo[number, path]

    def _node(self, number: int, path: str, title: str) -> Node:
        kind, *body = self.table["nodes"][number]
        if kind == "x":
            parts = tuple(self._octets(part) for part in body[0])
            return Node(EXTENDED, path, 0, parts, fields=self._dependent(self._fields(number, path, title, 0)))
        if kind == "r":
            inner = self._fields(body[1], path, title, 0)
            bits = self._bits(body[1]) + (not body[0])
            fields = tuple(replace(f, repeated=True) for f in self._dependent(inner)) + _registers(path, inner)
            return Node(REPEATED, path, bits // 8, (body[0],), fields=fields)
        if kind == "p":
            return Node(EXPLICIT, path, 0, children=self._expansion(path) if body[0] == "RE" else ())
        if kind == "c":
            children = tuple(None if n is None else self._item(n, path + "/") for n in body[1])
            return Node(COMPOUND, path, body[0], children=children)
        fields = self._fields(number, path, title, 0)
        return Node(FIXED, path, self._bits(number) // 8, fields=self._dependent(fields) + _registers(path, fields))

    def _expansion(self, path: str) -> tuple[Node, ...]:
        if self.expansion is None:
            return ()
        size, items = self.expansion
        children = tuple(None if n is None else self._item(n, path + "/") for n in items)
        return (Node(EXPANSION, path, size, children=children),)

    def _dependent(self, fields: tuple[Field, ...]) -> tuple[Field, ...]:
        """Guard the fields that depend on others of the same node."""
        at = {f.path: f for f in fields}
        return tuple(
            replace(f, guards=tuple(Guard(at[o].offset, at[o].size, v) for o, v in self.depends[f.path].items()))
            if f.path in self.depends
            else f
            for f in fields
        )

    def _bits(self, number: int) -> int:
        kind, body, *_ = self.table["nodes"][number]
        return int(body) if kind == "e" else sum(self._size(part) for part in body)

    def _size(self, part: Any) -> int:
        """Bits of a part of a group or an extended item: a named one, spare bits, or the extension bit."""
        if isinstance(part, list):
            return self._bits(part[2])
        return 1 if part is None else int(part)

    def _octets(self, parts: list[Any]) -> int:
        size = sum(self._size(part) for part in parts) // 8
        return size if parts[-1] is None else -size

    def _fields(self, number: int, path: str, title: str, offset: int) -> tuple[Field, ...]:
        """Fields of an element, a group or an extended item, in order."""
        kind, *body = self.table["nodes"][number]
        if kind == "e":
            return tuple(self._contents(path, title, offset, body[0], body[1]))
        parts = body[0] if kind == "g" else [part for octet in body[0] for part in octet]
        fields: list[Field] = []
        for part in parts:
            if isinstance(part, list):
                fields += self._fields(part[2], f"{path}/{part[0]}", part[1] or title, offset)
            offset += self._size(part)
        return tuple(fields)

    def _contents(self, path: str, title: str, offset: int, size: int, content: Any) -> Iterator[Field]:
        """The field of an element; one more for each case of a content that depends on another field."""
        kind = content[0] if content else "raw"
        if kind == "d":
            yield Field(path, title, "integer", offset, size)
            for values, case in content[2:]:
                others = dict(zip(content[1], values, strict=True))
                said = ",".join(f"{other.rpartition('/')[2]}={v}" for other, v in others.items())
                self.depends[f"{path}[{said}]"] = others
                yield from self._contents(f"{path}[{said}]", title, offset, size, case)
        elif size > 64:
            yield Field(path, title, content[1] if kind == "s" else "bytes", offset, size)
        elif kind == "t":
            labels = {int(k): text for k, text in self.table["tables"][content[1]].items()}
            yield Field(path, title, "table", offset, size, labels=labels)
        elif kind == "q":
            yield Field(path, title, "quantity", offset, size, bool(content[1]), content[2], content[3])
        elif kind == "s":
            yield Field(path, title, content[1], offset, size)
        elif kind == "b":
            yield Field(path, title, "register", offset, size)
        else:
            yield Field(path, title, "integer", offset, size, kind == "i" and bool(content[1]))


def _descend(node: Node) -> Iterator[Node]:
    yield node
    for child in node.children:
        if child is not None:
            yield from _descend(child)


def _registers(path: str, fields: tuple[Field, ...]) -> tuple[Field, ...]:
    """Fields of the Comm-B registers in 56 bits that have their address beside them."""
    named = {f.path.rpartition("/")[2]: f for f in fields}
    if "BDS1" in named and fields[0].size == 56:
        address = named["BDS1"].offset
    elif len(fields) == 1 and fields[0].size == 64 and fields[0].kind == "register":
        address = 56
    else:
        return ()
    start = fields[0].offset - 1  # bits of registers count from 1
    return tuple(
        Field(
            path=f"{path}/{first},{second}/{r.name}",
            title=f"BDS {first},{second} {r.title}",
            kind="quantity" if r.unit else "integer",
            offset=start + r.first,
            size=r.last - r.first + 1,
            signed=r.signed,
            lsb=r.lsb,
            unit=r.unit,
            origin=r.origin,
            guards=(Guard(address, 8, 16 * first + second), Guard(start + r.status, 1, 1)),
        )
        for (first, second), held in REGISTERS.items()
        for r in held
    )
