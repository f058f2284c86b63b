"""Records of a recording, piece after piece, to times: midnights counted, truncated times completed."""

import datetime
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from saltus.io.categories import CATEGORIES
from saltus.io.clock import DAY, complete, day_offsets, impossible
from saltus.io.columns import SOURCE, Decoded
from saltus.io.found import Found
from saltus.records import REASONS, System

__all__ = ["Clock", "Read", "read_records"]

_TAIL = 15  # times of day that tell the day of the next


@dataclass(frozen=True, slots=True)
class Read:
    """What became of the records of one category."""

    found: Found
    decoded: Decoded
    systems: list[System]
    system_of: npt.NDArray[np.int64]  # of each record


def read_records(number: int, found: Found) -> Read:
    """What becomes of the records of a category."""
    first, stop = found.columns.spans(SOURCE).T
    octets = found.data
    word = octets[first].astype(np.int64) << 8 | octets[np.minimum(first + 1, stop - 1)]
    values, which = np.unique(word, return_inverse=True)
    systems = [System(number, int(v) >> 8, int(v) & 255) for v in values]
    return Read(found, _possible(CATEGORIES[number].decode(found.columns)), systems, which.astype(np.int64))


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
    """Times of records, s, UTC, from times of day: midnights are counted from piece to piece."""

    def __init__(self, date: datetime.date | None, name: str) -> None:
        """Begin on a day; without one, clocks of captures tell it, else 1970-01-01 is the first."""
        self._date = date
        self._first = ((date or datetime.date(1970, 1, 1)) - datetime.date(1970, 1, 1)).days
        self._name = name
        self._tail = np.zeros(0)  # the last times of day, and
        self._days = np.zeros(0, np.int64)  # their days
        self.problems: list[str] = []

    def captured(self, *, dated: bool) -> bool:
        """Whether the clock of a capture tells the days: where it does and no date was given."""
        return dated and self._date is None

    def times(self, read: Mapping[int, Read], *, dated: bool) -> dict[int, npt.NDArray[np.float64]]:
        """Times of the records of a recording or its next piece, by category.

        Args:
            read: the records.
            dated: the clocks of all blocks tell the date.
        """
        if not read:
            return {}
        tod = np.concatenate([_time_of_day(number, read, self._name, self.problems) for number in read])
        if self.captured(dated=dated):
            clock = np.concatenate([r.found.clock for r in read.values()])
            days = np.round((clock - tod) / DAY)
            time = tod + DAY * np.where(np.isnan(days), np.nanmedian(days) if np.isfinite(days).any() else 0.0, days)
        else:
            time = self._counted(tod, np.concatenate([r.found.sequence for r in read.values()]))
        bounds = np.cumsum([0] + [len(r.found) for r in read.values()])
        return {n: time[a:b] for n, a, b in zip(read, bounds[:-1], bounds[1:], strict=True)}

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


def _time_of_day(number: int, read: Mapping[int, Read], name: str, problems: list[str]) -> npt.NDArray[np.float64]:
    """Times of day of a category's records; truncated ones are completed, or become NaN, and a problem says so."""
    r = read[number]
    modulus = r.decoded.time_modulus
    if not modulus:
        return r.decoded.time_of_day
    time = complete(r.decoded.time_of_day, modulus, _reference(number, read))
    lost = np.count_nonzero(np.isnan(time) & ~np.isnan(r.decoded.time_of_day))
    if lost:
        problems.append(
            f"{name}: {lost} records of category {number} tell their time modulo {modulus:g} s only, and neither a "
            f"message of category {CATEGORIES[number].turns} of their source nor a capture clock completes it: they "
            "have no time. Record the service messages too, or capture packets."
        )
    return time


def _reference(number: int, read: Mapping[int, Read]) -> npt.NDArray[np.float64]:
    """A time of day near each record: the last of its source's service messages, else the next, else its capture."""
    r = read[number]
    near = r.found.clock % DAY
    service = read.get(CATEGORIES[number].turns or 0)
    if service is None:
        return near
    for k, system in enumerate(r.systems):
        said = [j for j, s in enumerate(service.systems) if (s.sac, s.sic) == (system.sac, system.sic)]
        told = np.isin(service.system_of, said) & np.isfinite(service.decoded.time_of_day)
        if told.any():
            mine = r.system_of == k
            last = np.searchsorted(service.found.sequence[told], r.found.sequence[mine]) - 1
            near[mine] = service.decoded.time_of_day[told][np.maximum(last, 0)]
    return near
