"""Records of a recording, piece after piece, to times: midnights counted, truncated times completed."""

import datetime
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from saltus.io.categories import CATEGORIES
from saltus.io.clock import DAY, complete, day_offsets, impossible
from saltus.io.columns import SOURCE, Category, Decoded
from saltus.io.found import Found
from saltus.records import REASONS, System

__all__ = ["Clock", "Read", "read_records"]

_TAIL = 15  # times of day that tell the day of the next


@dataclass(frozen=True, slots=True)
class Read:
    """What became of the records of one category."""

    category: Category
    found: Found
    decoded: Decoded
    systems: list[System]
    system_of: npt.NDArray[np.int64]  # of each record


def read_records(
    category: Category, found: Found, apart: Mapping[int, str] | None = None, codes: Collection[tuple[int, int]] = ()
) -> Read:
    """What becomes of the records of a category.

    Args:
        category: what it takes.
        found: its records.
        apart: names of channels by number.
        codes: SAC and SIC of the sources that are told apart by channel.
    """
    first, stop = found.columns.spans(SOURCE).T
    octets = found.data
    word = octets[first].astype(np.int64) << 8 | octets[np.minimum(first + 1, stop - 1)]
    split = np.isin(word, [sac << 8 | sic for sac, sic in codes])
    values, which = np.unique(word << 32 | np.where(split, found.channel + 1, 0), return_inverse=True)
    names = apart or {}
    systems = [
        System(category.number, int(v) >> 40, int(v) >> 32 & 255, channel=names.get((int(v) & 0xFFFFFFFF) - 1, ""))
        for v in values
    ]
    return Read(category, found, _possible(category.decode(found.columns)), systems, which.astype(np.int64))


def _possible(decoded: Decoded) -> Decoded:
    """Take away the times of day that are none, and give their reports the reason."""
    wrong = impossible(decoded.time_of_day)
    if not wrong.any():
        return decoded
    reason = np.asarray(decoded.columns.get("reason", np.zeros(len(wrong))), np.int8)
    marked = np.where(wrong & (reason == 0), REASONS.index("impossible time of day"), reason)
    columns = {**decoded.columns, "reason": marked}
    return decoded._replace(time_of_day=np.where(wrong, np.nan, decoded.time_of_day), columns=columns)


class Clock:
    """Times of records, s, UTC, from times of day, piece after piece of a recording.

    Midnights are counted from piece to piece, and the times of service messages complete those of the next piece.
    """

    def __init__(self, date: datetime.date | None, name: str) -> None:
        """Begin on a day; without one, clocks of captures tell it, else 1970-01-01 is the first."""
        self._first = ((date or datetime.date(1970, 1, 1)) - datetime.date(1970, 1, 1)).days
        self._name = name
        self._given = date is not None
        self._tail = np.zeros(0)  # the last times of day, and
        self._days = np.zeros(0, np.int64)  # their days
        self._services: dict[System, float] = {}  # the last time of day of each source of service messages
        self._started = False
        self.captured = False  # the clock of a capture told the days of the last piece
        self.dateless = False  # days count from 1970-01-01
        self._lost: Counter[tuple[int, float]] = Counter()  # by category and modulus: times that nothing completes
        self._silent: Counter[int] = Counter()  # by category: reports without a time, dated by what recorded them

    @property
    def problems(self) -> list[str]:
        """What could not be dated."""
        return [
            f"{self._name}: {n} records of category {number} tell their time modulo {modulus:g} s only, and neither a "
            f"message of category {CATEGORIES[number].turns} of their source nor a capture clock completes it: they "
            "have no time. Record the service messages too, or capture packets."
            for (number, modulus), n in self._lost.items()
        ] + [
            f"{self._name}: {n} reports of category {number} tell no time: the clock that recorded them dates them."
            for number, n in self._silent.items()
            if n
        ]

    def times(self, read: Mapping[int, Read], *, dated: bool) -> dict[int, npt.NDArray[np.float64]]:
        """Times of the records of a recording or its next piece, by category.

        The clock of a capture tells the days where no date is given, unless the recording began without one.

        Args:
            read: the records.
            dated: the clocks of all blocks tell the date.
        """
        if not read:
            return {}
        if not self._started:
            self._started, self.dateless = True, not (self._given or dated)
        self.captured = dated and not self._given and not self.dateless
        tod = np.concatenate([self._time_of_day(number, read) for number in read])
        sequence = np.concatenate([r.found.sequence for r in read.values()])
        if self.captured:
            clock = np.concatenate([r.found.clock for r in read.values()])
            days = np.round((clock - tod) / DAY)
            usual = np.nanmedian(days) if np.isfinite(days).any() else (self._first + np.append(self._days, 0)[0])
            days = np.where(np.isnan(days), usual, days)
            self._remember(tod, days.astype(np.int64) - self._first, sequence)
            time = tod + DAY * days
        else:
            time = self._counted(tod, sequence)
        for r in read.values():
            self._hear(r)
        bounds = np.cumsum([0] + [len(r.found) for r in read.values()])
        return {n: time[a:b] for n, a, b in zip(read, bounds[:-1], bounds[1:], strict=True)}

    def _remember(
        self, tod: npt.NDArray[np.float64], days: npt.NDArray[np.int64], sequence: npt.NDArray[np.int64]
    ) -> None:
        """Keep the last times of day and their days."""
        order = np.argsort(sequence, kind="stable")
        valid = order[np.isfinite(tod[order])][-_TAIL:]
        if len(valid):
            self._tail, self._days = tod[valid], days[valid]

    def _hear(self, r: Read) -> None:
        """Keep the last time of day of each source, where others complete theirs by it."""
        if any(c.turns == r.found.layout.category for c in CATEGORIES.values()):
            for k, system in enumerate(r.systems):
                told = np.flatnonzero((r.system_of == k) & np.isfinite(r.decoded.time_of_day))
                if len(told):
                    self._services[system] = float(r.decoded.time_of_day[told[np.argmax(r.found.sequence[told])]])

    def _counted(self, tod: npt.NDArray[np.float64], sequence: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        order = np.argsort(sequence, kind="stable")
        joined_tod = np.concatenate([self._tail, tod[order]])
        days = day_offsets(joined_tod)
        known = len(self._tail)
        if known:
            days = days + int(np.median(self._days - days[:known]))
        counted = np.empty(len(tod), np.int64)
        counted[order] = days[known:]
        valid = np.flatnonzero(np.isfinite(joined_tod))[-_TAIL:]
        self._tail, self._days = joined_tod[valid], days[valid]
        return tod + DAY * (counted + self._first)

    def _time_of_day(self, number: int, read: Mapping[int, Read]) -> npt.NDArray[np.float64]:
        """Times of day of a category; truncated ones are completed, or become NaN, and are counted."""
        r = read[number]
        modulus = r.category.time_modulus
        if not modulus:
            return r.decoded.time_of_day
        time = complete(r.decoded.time_of_day, modulus, self._reference(number, read))
        silent = np.isnan(r.decoded.time_of_day) & np.isfinite(r.found.clock) & r.decoded.is_report
        time[silent] = r.found.clock[silent] % DAY
        self._silent[number] += int(np.count_nonzero(silent))
        lost = int(np.count_nonzero(np.isnan(time) & ~np.isnan(r.decoded.time_of_day)))
        if lost:
            self._lost[number, modulus] += lost
        return time

    def _reference(self, number: int, read: Mapping[int, Read]) -> npt.NDArray[np.float64]:
        """A time of day near each record: that of its source's last service message, else the next, else captured."""
        r, turns = read[number], CATEGORIES[number].turns
        near = r.found.clock % DAY
        service = read.get(turns or 0)
        for k, system in enumerate(r.systems):
            mine, own = r.system_of == k, replace(system, category=turns)
            before = self._services.get(own, np.nan)
            near[mine] = np.where(np.isnan(before), near[mine], before)
            if service is None or own not in service.systems:
                continue
            told = (service.system_of == service.systems.index(own)) & np.isfinite(service.decoded.time_of_day)
            if told.any():
                last = np.searchsorted(service.found.sequence[told], r.found.sequence[mine]) - 1
                first = np.nan if np.isfinite(before) else service.decoded.time_of_day[told][0]
                given = service.decoded.time_of_day[told][np.maximum(last, 0)]
                given = np.where(last < 0, first, given)
                near[mine] = np.where(np.isnan(given), near[mine], given)
        return near
