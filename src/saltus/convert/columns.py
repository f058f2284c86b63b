"""Which columns a table of decoded items has, and their values."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.asterix.codec import Column, Want, decode
from saltus.asterix.layout import SI, Field, Layout
from saltus.asterix.program import Form
from saltus.errors import DataError
from saltus.io.found import Found

__all__ = ["COMMON", "Items", "Layouts", "fields_of", "held_by", "schema_of", "table_of"]

Layouts = Mapping[int, Layout]  # by category
COMMON = pa.schema(
    [
        pa.field("file", pa.string()),
        pa.field("byte", pa.int64()),  # where the record's block begins
        pa.field("category", pa.int16()),
        pa.field("record", pa.int64()),  # of its category in the file, from 0
        pa.field("sac", pa.int16()),
        pa.field("sic", pa.int16()),
        pa.field("time", pa.float64(), metadata={"unit": "s", "title": "UTC since 1970-01-01"}),
    ]
)
_SI_NAMES = {"NM": "m", "NM/s": "m/s", "kt": "m/s", "ft": "m", "FL": "m", "ft/min": "m/s", "°": "rad", "°/s": "rad/s"}
_SI_NAMES |= {"ms": "s", "ns": "s", "fs": "s", "mb": "Pa", "hPa": "Pa", "MHz": "Hz", "ALTFL": "m"}
_EXACT = 53  # bits that a reader of numbers is sure to keep; longer codes are hexadecimal texts
_SPLIT = re.compile(
    r"\s+|,(?!\d(?:[/,\s]|$))"
)  # the comma of a register, as in 250/5,0/ROLL, is none between two items
_NAME = re.compile(r"(?:I(\d{3})/)?(.+)")


class Items(NamedTuple):
    """The items asked for: of every category, or of one; none = all."""

    wanted: tuple[tuple[int | None, str], ...] = ()

    @classmethod
    def parse(cls, texts: Iterable[str]) -> "Items":
        """Read items as 040, 040/RHO, I048/040 or 250/5,0/ROLL, with commas or blanks between them."""
        found = []
        for name in (name for text in texts for name in _SPLIT.split(text) if name):
            match = _NAME.fullmatch(name)
            category, path = match.groups() if match else (None, name)
            found.append((None if category is None else int(category), path))
        return cls(tuple(found))

    def take(self, category: int, path: str) -> bool:
        """Whether a field is asked for."""
        return not self.wanted or any(
            number in (None, category) and (path == name or path.startswith(name + "/")) for number, name in self.wanted
        )

    def check(self, layouts: Layouts) -> None:
        """Refuse what none of the categories there has.

        Raises:
            DataError: naming the item and what there is.
        """
        for number, name in self.wanted:
            some = [form for category, form in layouts.items() if number in (None, category)]
            if not any(path == name or path.startswith(name + "/") for form in some for path in form.fields):
                known = "; ".join(
                    f"I{form.category:03d}: {', '.join(sorted({f[0].item for f in form.fields.values()}))}"
                    for form in layouts.values()
                )
                asked = name if number is None else f"I{number:03d}/{name}"
                raise DataError(f"--items {asked}: no category of these recordings has it. There are {known}.")


def fields_of(form: Layout, items: Items) -> list[Field]:
    """Fields of an edition that are asked for; what names the source is common to all."""
    some = (fields[0] for fields in form.fields.values())
    return [f for f in some if f.item != "010" and items.take(form.category, f.path)]


def held_by(found: Found, fields: Sequence[Field]) -> set[str]:
    """Paths of those fields that some record holds."""
    held = decode(found.data, found.records, found.layout, {f.path: Want(f.path, "raw") for f in fields})
    return {p for p, c in held.items() if (len(c.values) if c.present is None else c.present.any())}


def schema_of(columns: Mapping[int, Sequence[Field]], *, native: bool) -> pa.Schema:
    """The columns of all categories, named I048/040/RHO, with title and unit as metadata."""
    found = list(COMMON)
    for number, fields in columns.items():
        for field in fields:
            kind = pa.list_(_type(field)) if field.repeated else _type(field)
            unit = field.unit if native or field.unit not in SI else _SI_NAMES[field.unit]
            about = {"title": field.title, **({"unit": unit} if unit else {})}
            found.append(pa.field(_name(number, field), kind, metadata=about))
    return pa.schema(found)


def table_of(number: int, found: Found, fields: Sequence[Field], *, native: bool) -> dict[str, pa.Array]:
    """Columns of the records of one category."""
    plain: Form = "native" if native else "value"
    wants = {f.path: Want(f.path, plain if f.kind == "quantity" else "value", signed=_signed(f)) for f in fields}
    held = decode(found.data, found.records, found.layout, wants)
    return {_name(number, f): _array(f, held[f.path], len(found)) for f in fields}


def _name(number: int, field: Field) -> str:
    return f"I{number:03d}/{field.path}"


def _signed(field: Field) -> bool | None:
    """Flight levels are two's complement in every edition; older tables say unsigned."""
    return True if field.unit == "FL" else None


def _is_address(field: Field) -> bool:
    return field.kind == "integer" and field.size == 24 and "address" in field.title.lower()


def _type(field: Field) -> pa.DataType:
    if field.kind == "quantity":
        return pa.float64()
    if field.kind in ("icao", "ascii", "octal", "bytes") or _is_address(field) or field.size > _EXACT:
        return pa.string()
    return pa.int32() if field.size < 32 else pa.int64()


def _array(field: Field, column: Column, n: int) -> pa.Array:
    """A column as an array of its type; absent values are null, repeated ones lists."""
    if column.rows is None:
        absent = np.zeros(n, np.bool_) if column.present is None else ~column.present
        return _values(field, column.values, absent)
    flat = _values(field, column.values, np.zeros(len(column.values), np.bool_))
    count = np.bincount(column.rows, minlength=n)
    offsets = np.concatenate([[0], np.cumsum(count)]).astype(np.int32)
    mask = pa.array(count == 0)
    return pa.ListArray.from_arrays(pa.array(offsets), flat, mask=mask)


def _values(field: Field, values: npt.NDArray[np.generic], absent: npt.NDArray[np.bool_]) -> pa.Array:
    kind = _type(field)
    if kind != pa.string():
        return pa.array(values, kind, mask=absent)
    texts = [None if gone else _spelt(field, v) for v, gone in zip(values.tolist(), absent.tolist(), strict=True)]
    return pa.array(texts, kind)


def _spelt(field: Field, value: object) -> str:
    """A code as people write it: octal digits of Mode 1 to 3/A, hexadecimal ones of addresses and of raw bytes."""
    if isinstance(value, bytes):
        return value.hex() if field.kind == "bytes" else value.decode("ascii", "replace").strip()
    if isinstance(value, int):
        return f"{value:0{-(-field.size // 3)}o}" if field.kind == "octal" else f"{value:0{-(-field.size // 4)}x}"
    return str(value).strip()
