"""The running picture of several systems: looks, as soon as everything they need is known, and what they announce."""

from collections.abc import Collection, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.engine.identified import IDENTIFICATIONS
from saltus.engine.setup import Setup
from saltus.records import Plots
from saltus.tracks.lifecycle import CONFIRMED
from saltus.tracks.local import LocalSystem, Party, local_system
from saltus.tracks.measurements import Measurements
from saltus.tracks.picture import Picture
from saltus.tracks.rows import Assignments, Rows, join_rows

__all__ = ["APART", "Heard", "Live"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]

APART = 10**12  # between the numbers that the local tracks of two systems have until they are numbered
_LATE = 4.0  # s: longest that a report waits for others, before what became of it is known


class Heard(NamedTuple):
    """What is known anew of one system."""

    m: Measurements
    local_id: _Index  # the system's own track number of each measurement, -1 none
    rows: Rows  # of its tracker; `measurement` is the number of the plot


class _Recent:
    """The latest measurements of a system, and the rows that its tracker made of them."""

    def __init__(self, name: str, nothing: Heard) -> None:
        self.name = name
        self._parts = [nothing]

    def take(self, heard: Heard) -> None:
        self._parts.append(heard)

    def system(self, now: float, kept: float, numbered: Collection[int], *, use_identity: bool) -> LocalSystem:
        """Return its local tracks as known at `now`; forget what is older than `kept`."""
        m = Measurements.join([p.m for p in self._parts])
        local_id = np.concatenate([p.local_id for p in self._parts])
        rows = join_rows([p.rows for p in self._parts])
        stay, late = np.flatnonzero(m.time >= now - kept), (rows.time >= now - kept) & (rows.measurement >= 0)
        m, local_id, rows = m.take(stay), local_id[stay], rows.take(late)
        self._parts = [Heard(m, local_id, rows)]
        rows = rows.take(rows.time_known <= now)
        order = np.argsort(m.plot, kind="stable")
        place = np.minimum(np.searchsorted(m.plot[order], rows.measurement), max(len(order) - 1, 0))
        there = m.plot[order][place] == rows.measurement if len(order) else np.zeros(len(rows.time), bool)
        rows = rows.take(there)
        rows = rows._replace(measurement=order[place[there]])
        track = np.zeros(len(m), np.int64)
        track[rows.measurement] = rows.track_id
        sure = np.union1d(rows.track_id[rows.status == CONFIRMED], np.array(sorted(numbered), np.int64))
        none = np.zeros(len(m), bool)
        found = Assignments(track, none, none, sure, [])
        return local_system(self.name, m, found, rows, local_id, use_identity=use_identity)


class Live:
    """Looks at several systems while their reports come in.

    It decides by the rules by which `finish` does, from the rows that were published. Another centre's tracks have no
    part in it.
    """

    def __init__(
        self, setup: Setup, first: Sequence[int], heard: Iterable[tuple[int, Heard]], looked: float = -np.inf
    ) -> None:
        """Begin with systems that have reported.

        Args:
            setup: of the sources.
            first: the first source of each system, in the order in which systems are numbered.
            heard: what was heard of systems so far, by their first sources.
            looked: number of the last look whose news have been taken.
        """
        parties = {party.sources[0]: party for party in setup.parties()}
        self._setup, self._parties = setup, [parties[own] for own in first]
        names = [party.name for party in self._parties]
        rank = {name: k for k, name in enumerate(setup.order)}
        order = sorted(range(len(names)), key=lambda k: rank.get(names[k], len(rank)))
        config, periods = setup.config, [_period(setup, party) for party in self._parties]
        self._picture = Picture(names, order, periods, config.systems, config.registration, config.filter)
        none = np.zeros(0, np.int64)
        empty = Plots.build(0, tuple(s.source for s in setup.sensors), (), {})
        self._nothing = Heard(setup.placed(empty, none), none, join_rows([]))
        self._recent = [_Recent(name, self._nothing) for name in names]
        self._look = -np.inf  # number of the last look
        self._newest = -np.inf
        self._labels: dict[int, str] = {}
        self._announced = 0  # local tracks whose number was told
        self._news: list[dict[str, Any]] = []
        for own, part in heard:
            self.take(own, part)
        if np.isfinite(looked):
            self.look(looked)
            self.taken()

    @property
    def looked(self) -> float:
        """Number of the last look; -inf before the first."""
        return self._look

    def adopt(self, setup: Setup, first: Sequence[int]) -> None:
        """Go on under another setup, with the systems that are new in it, behind the others."""
        self._setup = setup
        parties = {party.sources[0]: party for party in setup.parties()}
        for own in first[len(self._parties) :]:
            self._parties.append(parties[own])
            self._recent.append(_Recent(parties[own].name, self._nothing))
            self._picture.add(parties[own].name, _period(setup, parties[own]))

    def heard(self, rows: Rows, m: Measurements | None, local_id: _Index | None) -> Heard:
        """Return what is known anew of a system, without measurements where there are none."""
        return self._nothing._replace(rows=rows) if m is None or local_id is None else Heard(m, local_id, rows)

    def take(self, own: int, heard: Heard) -> None:
        """Take what is known anew of the system whose first source is `own`."""
        place = next(k for k, party in enumerate(self._parties) if party.sources[0] == own)
        self._recent[place].take(heard)
        if np.isinf(self._look) and len(heard.m):
            first = float(np.floor(heard.m.time[0] / self._setup.config.systems.every))
            self._look = first if np.isinf(self._newest) else min(first, self._look)
        self._newest = max(self._newest, float(heard.m.time.max(initial=-np.inf)))

    def look(self, last: float = np.inf) -> None:
        """Do the looks for which everything is known, up to the one of a number."""
        every = self._setup.config.systems.every
        while np.isfinite(self._look) and self._look < last and (self._look + 1.0) * every + _LATE < self._newest:
            self._look += 1.0
            now, picture = self._look * every, self._picture
            systems = [
                recent.system(
                    now,
                    picture.kept + every,
                    [own for system, own in picture.number if system == k],
                    use_identity=self._setup.use_identity,
                )
                for k, recent in enumerate(self._recent)
            ]
            picture.look(now, systems)
            self._label(systems)
            self._tell(now)

    def named(self, provisional: _Index) -> _Index:
        """Return the numbers that are known now of local tracks, given as `system * APART + own`.

        One that is not numbered yet gets a number of its own, above all others.
        """
        ids, place = np.unique(provisional, return_inverse=True)
        number = self._picture.number
        out = [
            self._picture.membership.current(number[key]) if key in number else k + APART
            for k, key in ((k, divmod(k, APART)) for k in ids.tolist())
        ]
        return np.array(out, np.int64)[place] if len(ids) else provisional

    def taken(self) -> pa.Table:
        """Return what was announced since the last time, with the columns of identifications.parquet."""
        rows = sorted(self._news, key=lambda row: (row["time_known"], row["track_id"], row["time_from"]))
        self._news = []
        return pa.Table.from_pylist(rows, schema=IDENTIFICATIONS)

    def _label(self, systems: Sequence[LocalSystem]) -> None:
        for k, system in enumerate(systems):
            for own, label in zip(system.ids.tolist(), system.local_id, strict=True):
                if label and (k, own) in self._picture.number:
                    self._labels[self._picture.number[k, own]] = label

    def _tell(self, now: float) -> None:
        """Announce numbers, what local tracks are a part of, and numbers given up."""
        found, mergers = self._picture.news()
        number = list(self._picture.number.items())
        system = [key[0] for key, _ in number]
        first = {int(g): float(t) for g, t in zip(found.track[::-1], found.time_from[::-1], strict=True)}
        for (k, own), g in number[self._announced :]:
            begun = first.get(g, now)
            into = self._picture.membership.born_as(g)
            self._news.append(self._row(k, g, own + (k + 1) * APART, (begun, now), 1.0, now, into))
        self._announced = len(number)
        columns = (found.track, found.time_from, found.time_to, found.system_track, found.probability, found.time_known)
        for g, begin, end, track, probability, known in zip(*(c.tolist() for c in columns), strict=True):
            self._news.append(self._row(system[g], g, track, (begin, end), probability, known, None))
        for m in mergers:
            self._news.append(self._row(system[m.track], m.track, m.number, (m.time_from, now), 1.0, now, m.into))

    def _row(
        self, k: int, g: int, track: int, span: tuple[float, float], probability: float, known: float, into: int | None
    ) -> dict[str, Any]:
        return {
            "track_id": track,
            "system": self._parties[k].name,
            "local_id": self._labels.get(g),
            "time_from": span[0],
            "time_to": span[1],
            "probability": probability,
            "time_known": known,
            "merged_into": into,
        }


def _period(setup: Setup, party: Party) -> float:
    return min(setup.sensors[s].period for s in party.sources if setup.sensors[s].heard)
