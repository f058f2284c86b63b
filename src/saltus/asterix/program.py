"""What a walker executes: a layout and the wanted columns as flat tables of integers.

Both walkers, the compiled one and its definition in Python (`saltus.asterix.walk`), read the same tables.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.asterix.layout import SI, Field, Layout, Node
from saltus.errors import ModelError

__all__ = ["Output", "Program", "Want", "compile_program"]

Form = Literal["value", "native", "raw", "span"]

FLOAT, INTEGER, ICAO, ASCII, BYTES, SPAN = range(6)  # forms of slots
_TEXTS = {"icao": (ICAO, 6), "ascii": (ASCII, 8)}


class Want(NamedTuple):
    """A column to take out of records.

    Forms: "value", a quantity in SI units and radians (float), a text, or the integer of all else; "native", a
    quantity in the unit of the layout; "raw", the bits as an integer, or as bytes when there are more than 64; "span",
    where the item or the part of a compound item starts and stops in the buffer.
    """

    path: str  # of a field; for "span" also of an item or a part of one
    form: Form = "value"
    signed: bool | None = None  # overrides the layout
    absent: int = -1  # integer where a record does not hold it


class Output(NamedTuple):
    """How a column comes out."""

    form: int
    repeated: bool
    dtype: np.dtype[Any]
    absent: int


@dataclass(frozen=True, slots=True, eq=False)
class Program:
    """Tables for the walkers.

    nodes (K, 6): kind, size, first and count of its entries in `index`, first and count of its slots.
    index: bytes of the parts of an item, or numbers of nodes, -1 = none.
    roots: node of each profile. select: node, offset, size of the field that tells the profile; none = empty.
    profile (V, 2): value of that field, and profile.
    slots (S, 7): form, offset, size, signed, output, first and count of its guards.
    scale (S, 2): step and origin. guards (G, 3): offset, size, value.
    """

    nodes: npt.NDArray[np.int32]
    index: npt.NDArray[np.int32]
    roots: npt.NDArray[np.int32]
    select: npt.NDArray[np.int32]
    profiles: npt.NDArray[np.int32]
    slots: npt.NDArray[np.int32]
    scale: npt.NDArray[np.float64]
    guards: npt.NDArray[np.int32]
    outputs: tuple[Output, ...]
    paths: tuple[str, ...]  # of the nodes
    required: int  # node that every record must hold, -1 = none


def compile_program(layout: Layout, wants: Mapping[str, Want], required: str | None = None) -> Program:
    """Flatten a layout with slots for what is wanted.

    Raises:
        DataError: the edition has no such field.
        ModelError: a form that the field does not have.
    """
    return _compiled(id(layout), _Held(layout), tuple(wants.values()), required)


class _Held(NamedTuple):
    """A layout as part of a cache's key: layouts are equal only when they are the same."""

    layout: Layout

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Held) and other.layout is self.layout

    def __hash__(self) -> int:
        return id(self.layout)


@lru_cache(maxsize=256)
def _compiled(key: int, held: _Held, wants: tuple[Want, ...], required: str | None) -> Program:
    del key
    layout = held.layout
    found = _order(layout)
    number = {id(node): k for k, node in enumerate(found)}
    outputs = tuple(_output(layout, want) for want in wants)
    slots: list[tuple[int, ...]] = []
    scale: list[tuple[float, float]] = []
    guards: list[tuple[int, int, int]] = []
    index: list[int] = []
    nodes = []
    for node in found:
        entries = [*node.parts, *(-1 if child is None else number[id(child)] for child in node.children)]
        first = len(slots)
        for k, want in enumerate(wants):
            for field in _matches(node, want):
                slots.append(_slot(field, want, k, outputs[k].form, len(guards)))
                scale.append(_scale(field, want))
                guards += field.guards
        nodes.append((node.kind, node.size, len(index), len(entries), first, len(slots) - first))
        index += entries
    select, profiles = _select(layout, found)
    return Program(
        nodes=np.array(nodes, np.int32).reshape(-1, 6),
        index=np.array(index, np.int32),
        roots=np.array([number[id(record)] for record in layout.records.values()], np.int32),
        select=select,
        profiles=profiles,
        slots=np.array(slots, np.int32).reshape(-1, 7),
        scale=np.array(scale, np.float64).reshape(-1, 2),
        guards=np.array(guards, np.int32).reshape(-1, 3),
        outputs=outputs,
        paths=tuple(node.path for node in found),
        required=next((k for k, node in enumerate(found) if node.path == required and node.path), -1),
    )


def _order(layout: Layout) -> list[Node]:
    """All nodes, each once."""
    found: dict[int, Node] = {}

    def visit(node: Node) -> None:
        if id(node) not in found:
            found[id(node)] = node
            for child in node.children:
                if child is not None:
                    visit(child)

    for record in layout.records.values():
        visit(record)
    return list(found.values())


def _matches(node: Node, want: Want) -> list[Field]:
    if want.form == "span":
        mine = node.path == want.path and node.path
        return [Field(node.path, "", "bytes", 0, 0)] if mine else []
    return [field for field in node.fields if field.path == want.path]


def _output(layout: Layout, want: Want) -> Output:
    if want.form == "span":
        if want.path not in layout.titles:
            layout.field(want.path)  # says what there is
            raise ModelError(f"a span is of an item or a part of a compound item; {want.path!r} is a field.")
        return Output(SPAN, False, np.dtype(np.int64), -1)
    field = layout.field(want.path)
    if field.size > 64 and (want.form == "raw" or field.kind == "bytes"):
        return Output(BYTES, field.repeated, np.dtype(f"V{field.size // 8}"), 0)
    if want.form != "raw" and field.kind in _TEXTS:
        form, bits = _TEXTS[field.kind]
        return Output(form, field.repeated, np.dtype(f"S{field.size // bits}"), 0)
    if want.form != "raw" and field.kind == "quantity":
        return Output(FLOAT, field.repeated, np.dtype(np.float64), 0)
    return Output(INTEGER, field.repeated, np.dtype(np.int64), want.absent)


def _slot(field: Field, want: Want, output: int, form: int, first_guard: int) -> tuple[int, ...]:
    signed = field.signed if want.signed is None else want.signed
    if want.form == "raw":
        signed = bool(want.signed)
    return form, field.offset, field.size, int(signed), output, first_guard, len(field.guards)


def _scale(field: Field, want: Want) -> tuple[float, float]:
    factor = SI.get(field.unit, 1.0) if want.form == "value" else 1.0
    return field.lsb * factor, field.origin * factor


def _select(layout: Layout, found: list[Node]) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    if layout.select is None:
        return np.zeros(0, np.int32), np.zeros((0, 2), np.int32)
    path, values = layout.select
    field = layout.field(path)
    node = next(k for k, n in enumerate(found) if field in n.fields)
    names = list(layout.records)
    profiles = [(value, names.index(name)) for value, name in values.items()]
    return np.array([node, field.offset, field.size], np.int32), np.array(profiles, np.int32).reshape(-1, 2)
