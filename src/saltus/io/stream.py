"""A recording of any size, a piece at a time: blocks by category, editions told by what comes first, times going on."""

import datetime
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from saltus.framing import Framer, read_chunks
from saltus.io.assemble import Read, read_records, time_of_day
from saltus.io.blocks import Blocks, credible, joined
from saltus.io.clock import DAY, day_offsets
from saltus.io.editions import Chosen, choose_edition
from saltus.io.found import Found, find

__all__ = ["PIECE", "Clock", "Stream"]

PIECE = 1 << 21  # bytes: what is decoded at once
_TAIL = 15  # times of day that tell the day of the next


class Stream:
    """One file as pieces; `told` and `chosen` say afterwards what was met."""

    def __init__(self, path: Path, editions: Mapping[int, str], framing: str | None = None) -> None:
        """Begin a file.

        Args:
            path: the file.
            editions: category -> edition; categories not named are guessed where they occur first.
            framing: one of `saltus.framing.NAMES`; None has it guessed.
        """
        self.path = path
        self.chosen: dict[int, Chosen] = {}
        self._editions = editions
        self._framer = Framer(path.name, credible, framing=framing)
        self.told = self._framer.told

    def pieces(
        self, *, most: int | None = None, progress: Callable[[str, float], None] | None = None
    ) -> Iterator[dict[int, tuple[Blocks, npt.NDArray[np.int64]]]]:
        """Yield for each category its blocks, and the number of each among the blocks of the piece.

        Args:
            most: bytes read at all.
            progress: called with the file's name and the share read.
        """
        for chunk in read_chunks(self.path, self._framer, piece=PIECE, most=most, progress=progress):
            blocks = joined([chunk])
            found = {}
            for number in np.unique(blocks.category).tolist():
                place = np.flatnonzero(blocks.category == number)
                found[number] = blocks.take(place), place
                if number not in self.chosen:
                    asked = self._editions.get(number)
                    self.chosen[number] = choose_edition(number, found[number][0], asked, self.path.name)
            yield found

    def records(self, piece: Mapping[int, tuple[Blocks, npt.NDArray[np.int64]]]) -> dict[int, Found]:
        """The records of a piece by category, of those whose edition is known, with what the categories take."""
        return {
            number: find(number, self.chosen[number].edition, blocks, place)
            for number, (blocks, place) in piece.items()
            if self.chosen[number].edition
        }


class Clock:
    """Times of records, s, UTC, from times of day: midnights are counted from piece to piece."""

    def __init__(self, date: datetime.date | None, name: str) -> None:
        """Begin on a day; without one, clocks of captures tell it, else 1970-01-01 is the first."""
        self._date = date
        self._first = ((date or datetime.date(1970, 1, 1)) - datetime.date(1970, 1, 1)).days
        self._name = name
        self._tail = np.zeros(0)  # the last times of day, and
        self._days = np.zeros(0, np.int64)  # their days
        self.problems: list[str] = []

    def times(self, found: Mapping[int, Found], *, dated: bool) -> dict[int, npt.NDArray[np.float64]]:
        """Times of the records of a piece, by category."""
        read: dict[int, Read] = {n: read_records(n, f) for n, f in found.items() if len(f)}
        if not read:
            return {n: np.zeros(0) for n in found}
        tod = np.concatenate([time_of_day(n, read, self._name, self.problems) for n in read])
        if dated and self._date is None:
            clock = np.concatenate([r.found.clock for r in read.values()])
            days = np.round((clock - tod) / DAY)
            time = tod + DAY * np.where(np.isnan(days), np.nanmedian(days) if np.isfinite(days).any() else 0.0, days)
        else:
            time = self._counted(tod, np.concatenate([r.found.sequence for r in read.values()]))
        bounds = np.cumsum([0] + [len(r.found) for r in read.values()])
        told = {n: time[a:b] for n, a, b in zip(read, bounds[:-1], bounds[1:], strict=True)}
        return {n: told.get(n, np.zeros(0)) for n in found}

    def _counted(self, tod: npt.NDArray[np.float64], sequence: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        order = np.argsort(sequence, kind="stable")
        joined_tod = np.concatenate([self._tail, tod[order]])
        days = day_offsets(joined_tod)
        known = len(self._tail)
        if known:
            days = days + int(np.median(self._days - days[:known]))
        counted = np.empty(len(tod))
        counted[order] = days[known:]
        valid = np.flatnonzero(np.isfinite(joined_tod))[-_TAIL:]
        self._tail, self._days = joined_tod[valid], days[valid]
        return tod + DAY * (counted + self._first)
