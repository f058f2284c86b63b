"""The wanted items of one category's records as columns, and what a category makes of them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.io.layout import Layout
from saltus.records import REASONS, Traits

__all__ = ["Category", "Columns", "Decoded", "first_reason", "icao_text", "validated"]

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
    tracks: pa.Table | None = None  # columns of another system's tracks, one row for each record


@dataclass(frozen=True, slots=True)
class Category:
    """What to take from the records of one category, and how to read it.

    `items` are kept as bytes while the file is walked; `decode` turns them into arrays. `plausible` says how well
    the numbers hang together (0 to 1): it decides between editions whose definitions both parse. `traits` are those
    of every source of the category; that one rotates is told by its reports.
    """

    number: int
    items: tuple[str, ...]
    decode: Callable[["Columns"], Decoded]
    plausible: Callable[["Columns"], float] | None = None
    traits: Traits = Traits()


class Columns:
    """Items of N records: absent ones are NaN, `absent` or empty."""

    def __init__(self, layout: Layout, n: int, items: Mapping[str, tuple[list[int], list[bytes]]]) -> None:
        self.layout = layout
        self.n = n
        self.items = items
        self._words: dict[str, tuple[npt.NDArray[np.intp], npt.NDArray[np.uint64]]] = {}

    def defines(self, item: str) -> bool:
        """Whether this edition has the item at all."""
        return item in self.layout.names

    def has(self, item: str) -> Mask:
        """Whether each record carries the item, (N,)."""
        present = np.zeros(self.n, np.bool_)
        present[self._word(item)[0]] = True
        return present

    def number(self, item: str, name: str | None = None, *, signed: bool | None = None) -> Numbers:
        """A quantity in SI units and radians, (N,), NaN where absent."""
        values = np.full(self.n, np.nan)
        if self.defines(item):
            field = self.layout.field(item, name, signed=signed)
            index, words = self._word(item)
            values[index] = field.raw(words) * field.lsb
        return values

    def code(self, item: str, name: str | None = None, *, absent: int = -1) -> Codes:
        """A coded value, (N,). Parts of an extended item that were not sent read 0, as the standard has it."""
        values = np.full(self.n, absent, np.int64)
        if self.defines(item):
            index, words = self._word(item)
            values[index] = self.layout.field(item, name).raw(words)
        return values

    def text(self, item: str, name: str | None = None) -> Texts:
        """A name of 8 characters of 6 bits (ICAO Annex 10 vol. IV, 3.1.2.9.1.2), (N,), without blanks around it."""
        values = np.full(self.n, "", "U8")
        if self.defines(item):
            index, words = self._word(item)
            values[index] = icao_text(self.layout.field(item, name).raw(words))
        return values

    def _word(self, item: str) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.uint64]]:
        """Records that carry an item, and its first 8 bytes, left-aligned."""
        found = self._words.get(item)
        if found is None:
            index, chunks = self.items.get(item, ([], []))
            joined = b"".join(chunk[:8].ljust(8, b"\0") for chunk in chunks)
            found = np.array(index, np.intp), np.frombuffer(joined, ">u8").astype(np.uint64)
            self._words[item] = found
        return found


def icao_text(codes: Codes) -> Texts:
    """Spell 48-bit names: A to Z are 1 to 26, digits 48 to 57, blank 32; other values stand for nothing."""
    letters = np.full(64, "", "U1")
    letters[1:27] = [chr(ord("A") + k) for k in range(26)]
    letters[48:58] = [str(k) for k in range(10)]
    letters[32] = " "
    name = np.full(len(codes), "", "U8")
    for shift in range(42, -1, -6):
        name = np.char.add(name, letters[(codes >> shift) & 63])
    return np.char.strip(name).astype("U8")


def validated(columns: Columns, item: str) -> Mask:
    """Codes that the sensor calls neither unvalidated (V) nor garbled (G), (N,)."""
    valid: Mask = (columns.code(item, "V") == 0) & (columns.code(item, "G") == 0)
    return valid


def first_reason(n: int, cases: Mapping[str, Mask]) -> npt.NDArray[np.int8]:
    """Reason codes of `n` reports: the first case that holds, 0 where none does."""
    reason = np.zeros(n, np.int8)
    for text, holds in reversed(list(cases.items())):
        reason[holds] = REASONS.index(text)
    return reason
