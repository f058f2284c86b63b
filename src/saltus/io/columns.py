"""The wanted items of one category's records as columns, and what a category makes of them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.asterix.codec import Column, Data, Records, Want, decode
from saltus.asterix.layout import SI, Layout
from saltus.records import REASONS, Traits

__all__ = [
    "SOURCE",
    "Category",
    "Columns",
    "Decoded",
    "first_reason",
    "read_columns",
    "status",
    "time_of_day",
    "times_of",
    "validated",
]

SOURCE = "010"  # the item that names the source, in every category
Numbers = npt.NDArray[np.float64]
Codes = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]
Texts = npt.NDArray[Any]  # of strings: their length is part of the type


class Decoded(NamedTuple):
    """One category's records as arrays over the records, in file order."""

    time_of_day: Numbers  # s after midnight, NaN = not given
    is_report: Mask  # a target report (a track of another system included); the others are status messages
    types: Codes  # message or detection type
    labels: Mapping[int, str]  # what the types mean
    columns: Mapping[str, npt.ArrayLike]  # columns of Plots
    new_cycle: Mask  # north markers and starts of an update cycle
    steps: Mapping[str, float]  # quantisation: fields of Source
    site: tuple[Numbers, Numbers, Numbers] | None = None  # told by the source: latitude, longitude, rad, height, m
    tracks: pa.Table | None = None  # columns of another system's tracks, one row for each record


@dataclass(frozen=True, slots=True)
class Category:
    """What to take from the records of one category, and how to read it.

    `words` say what its sources are. `time` are the paths that tell the time of day, the best last. `fields` are
    the paths taken (those that an edition does not have stay absent);
    `decode` makes sense of them. `traits` are those of every source of the category; that one rotates is told by its
    reports. `turns` is the category of the service messages that tell the update cycle of its sources.
    """

    number: int
    words: str
    time: tuple[str, ...]
    fields: tuple[str | Want, ...]
    decode: Callable[["Columns"], Decoded]
    traits: Traits = Traits()
    turns: int | None = None
    counted: bool = False  # no target reports are taken
    time_modulus: float = 0.0  # s: times of day are given modulo this; 0 = whole

    def timed(self) -> "Category":
        """The same category of which the times alone are taken."""
        return replace(self, fields=self.time, decode=partial(times_of, self.time))


class Columns:
    """Fields of N records by path: absent ones are NaN, `absent` or empty."""

    def __init__(self, layout: Layout, n: int, held: Mapping[str, Column]) -> None:
        self.layout = layout
        self.n = n
        self._held = held

    def defines(self, path: str) -> bool:
        """Whether this edition has the field at all."""
        return path in self._held

    def has(self, path: str) -> Mask:
        """Whether each record carries the field, (N,)."""
        column = self._held.get(path)
        return np.zeros(self.n, np.bool_) if column is None or column.present is None else column.present

    def number(self, path: str) -> Numbers:
        """A quantity in SI units and radians, (N,), NaN where absent."""
        column = self._held.get(path)
        return np.full(self.n, np.nan) if column is None else column.values

    def code(self, path: str, *, beside: str | None = None) -> Codes:
        """A coded value, (N,), -1 where absent.

        Parts of an extended item that were not sent read 0, as the standard has it: where the field `beside`, of the
        item's first part, is there.
        """
        column = self._held.get(path)
        if column is not None and column.values.dtype.kind not in "biu":
            column = None  # this edition has a text there
        values = np.full(self.n, -1, np.int64) if column is None else column.values
        if beside is None or column is None:
            return values
        return np.where((values < 0) & self.has(beside), 0, values)

    def text(self, path: str) -> Texts:
        """A text without blanks around it, (N,); one that has a byte that is no letter of ASCII is lost."""
        column = self._held.get(path)
        if column is None or column.values.dtype.kind != "S":
            return np.full(self.n, "", "U8")
        width = column.values.dtype.itemsize
        octets = np.ascontiguousarray(column.values).view(np.uint8).reshape(self.n, width)
        odd = ((octets >= 0x7F) | (octets < 0x20) & (octets > 0)).any(axis=1)
        return np.where(odd, b"", column.values).astype("U8")

    def spans(self, item: str) -> npt.NDArray[np.int64]:
        """Where an item starts and stops in the buffer, (N, 2)."""
        return self._held[item].values

    def step(self, path: str) -> float:
        """Least significant bit of a quantity, SI units."""
        field = self.layout.field(path)
        return field.lsb * SI.get(field.unit, 1.0)

    def labels(self, path: str) -> Mapping[int, str]:
        """What the values of a coded field mean; nothing where this edition does not have it."""
        return self.layout.labels(path) if self.layout.has(path) else {}


def read_columns(data: Data, records: Records, layout: Layout, fields: tuple[str | Want, ...]) -> Columns:
    """Take the fields that this edition has."""
    wants = {w.path: w for w in (Want(f) if isinstance(f, str) else f for f in fields) if w.path in layout.fields}
    held = decode(data, records, layout, {**wants, SOURCE: Want(SOURCE, "span")})
    return Columns(layout, len(records.start), held)


def validated(columns: Columns, item: str) -> Mask:
    """Codes that the sensor calls neither unvalidated (V) nor garbled (G), (N,)."""
    valid: Mask = (columns.code(f"{item}/V") == 0) & (columns.code(f"{item}/G") == 0)
    return valid


def first_reason(n: int, cases: Mapping[str, Mask]) -> npt.NDArray[np.int8]:
    """Reason codes of `n` reports: the first case that holds, 0 where none does."""
    reason = np.zeros(n, np.int8)
    for text, holds in reversed(list(cases.items())):
        reason[holds] = REASONS.index(text)
    return reason


def time_of_day(c: "Columns", paths: tuple[str, ...]) -> Numbers:
    """Time of day of each record, s, from the best item that it has, (N,)."""
    time = np.full(c.n, np.nan)
    for path in paths:
        given = c.number(path)
        time = np.where(np.isnan(given), time, given)
    return time


def times_of(paths: tuple[str, ...], c: "Columns") -> Decoded:
    """Records of which only the times are taken."""
    none = np.full(c.n, -1, np.int64)
    return Decoded(time_of_day(c, paths), none > 0, none, {}, {}, none > 0, {})


def status(
    c: Columns, time: str, message: str = "", cycle: int = -1, site: tuple[str, str, str] | None = None
) -> Decoded:
    """Records that are no target reports: their time, the type of message, which starts a cycle, the source's site."""
    kinds = c.code(message)
    return Decoded(
        time_of_day=c.number(time),
        is_report=np.zeros(c.n, np.bool_),
        types=kinds,
        labels=c.labels(message),
        columns={},
        new_cycle=kinds == cycle if cycle >= 0 else np.zeros(c.n, np.bool_),
        steps={},
        site=None if site is None else (c.number(site[0]), c.number(site[1]), c.number(site[2])),
    )
