"""Who is whom among several systems, as it becomes known from look to look."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from saltus.identify import (
    Decider,
    Decisions,
    DecisionSettings,
    Episodes,
    Evidence,
    LocalTracks,
    joined_episodes,
)
from saltus.tracks.encounters import SystemTracks
from saltus.tracks.identities import Compared, Looked, Weigher
from saltus.tracks.local import LocalSystem
from saltus.tracks.membership import Local, Membership, Merger, Segments
from saltus.tracks.settings import FilterSettings, RegistrationSettings, SystemsSettings
from saltus.tracks.systems import Frames, Region, Registered
from saltus.tracks.told import Told

__all__ = ["Picture", "decision_settings"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]


def decision_settings(settings: SystemsSettings) -> DecisionSettings:
    """Return when tracks are declared one object."""
    return DecisionSettings(
        p_false=settings.p_false,
        p_false_split=settings.p_false_split,
        hysteresis=settings.hysteresis,
        every=settings.every,
    )


class Picture:
    """Registers, weighs, decides and joins, every `every` seconds, from what is known by then and nothing later.

    Local tracks are numbered through all systems as they are confirmed.
    """

    def __init__(
        self,
        names: Sequence[str],
        order: Sequence[int],
        periods: Sequence[float],
        settings: SystemsSettings,
        expected: RegistrationSettings,
        filters: FilterSettings,
    ) -> None:
        """Begin without tracks.

        Args:
            names: of the systems.
            order: their numbers, the reference first, the most trusted next.
            periods: s between two reports of one track, of each system.
            settings: when to declare.
            expected: biases.
            filters: how objects move.
        """
        self._settings, self._expected, self._periods = settings, expected, list(periods)
        self._frames = Frames(names, order, settings.speed, expected)
        self._weigher = Weigher(settings, filters)
        self._decider = Decider(decision_settings(settings))
        self.membership = Membership()
        self._regions = [Region() for _ in names]
        self._before = self._asked = -np.inf
        self.number: dict[tuple[int, int], int] = {}  # of a system's local track
        self._of: list[int] = []  # system of each track
        self._last: list[float] = []
        self._votes: list[tuple[Counter[int], Counter[int]]] = []  # addresses and codes that each gave
        self._codes: list[tuple[int, int]] = []
        self._alive, self._looks = 0, 0  # tracks of the fullest system, summed over looks
        self._ended: list[Episodes] = []
        self._said = Told(settings.evidence)

    def add(self, name: str, period: float) -> None:
        """Take in a system that appears later."""
        self._frames.add(name)
        self._periods.append(period)
        self._regions.append(Region())

    @property
    def kept(self) -> float:
        """S of rows that a look needs."""
        return max(self._settings.window, 8.0 * max(self._periods), self._expected.interval + self._settings.rows_kept)

    def news(self) -> tuple[Segments, list[Merger]]:
        """Take what the last look found about the numbers of local tracks."""
        return self.membership.news(np.array(self._last), self._asked)

    def look(self, now: float, systems: Sequence[LocalSystem]) -> None:
        """Take in what is known by `now`.

        Args:
            now: s; the next multiple of `every`.
            systems: in the order of `names`, with their latest rows and any others.
        """
        interval = self._expected.interval
        for k, system in enumerate(systems):
            self._heard(k, system, now)
        self._born(systems, now)
        views = [self._view(k, system, now) for k, system in enumerate(systems)]
        if np.floor(now / interval) > np.floor(self._before / interval) or np.isinf(self._before):
            self._frames.update(now, views)
        said = self._weigh(now, systems, views)
        self._decide(now, said)
        self._asked, self._before = self._before, now

    def close(self, systems: Sequence[LocalSystem]) -> None:
        """Number the tracks confirmed since the last look."""
        self._born(systems, np.inf)

    def registered(self) -> list[Registered]:
        """Return how each system is registered."""
        return self._frames.registered()

    def decisions(self) -> Decisions:
        """Return all decisions and conflicts."""
        return Decisions(joined_episodes([*self._ended, self._decider.open()]), self._decider.conflicts())

    def evidence(self) -> Evidence:
        """Return the ratios at looks, so many at most (`SystemsSettings.evidence`)."""
        return self._said.evidence()

    @property
    def told_every(self) -> int:
        """Of so many looks `evidence` tells one."""
        return self._said.every

    @property
    def prior(self) -> float:
        """Probability that a pair is one object: any track that a system has at a time could be the one."""
        return 1.0 / max(self._settings.rivals, self._alive / max(self._looks, 1))

    def _heard(self, k: int, system: LocalSystem, now: float) -> None:
        """Count what new rows of a system say; a track that is confirmed now brings all it has."""
        tracks = system.view.tracks
        known = np.maximum(system.known, system.ready[tracks.track])
        new = np.flatnonzero((known > self._before) & (known <= now))
        self._regions[k].add(tracks.z[new])
        for track in np.unique(tracks.track[new]).tolist():
            rows = new[tracks.track[new] == track]
            local = k, int(system.ids[track])
            if local not in self.number:
                continue
            self._count(self.number[local], system.codes[rows], float(tracks.time[rows].max()))

    def _count(self, g: int, codes: _Index, last: float) -> None:
        for votes, column in zip(self._votes[g], codes.T, strict=True):
            votes.update(column[column >= 0].tolist())
        found = (_commonest(self._votes[g][0]), _commonest(self._votes[g][1]))
        if found[0] != self._codes[g][0]:
            self.membership.named(g, found[0])
        self._codes[g], self._last[g] = found, max(self._last[g], last)
        self.membership.revived(g)

    def _born(self, systems: Sequence[LocalSystem], now: float) -> None:
        """Number tracks in the order in which they were confirmed."""
        born = [
            (float(ready), k, int(own), place)
            for k, system in enumerate(systems)
            for place in np.flatnonzero(
                (system.ready > self._before - self._settings.silent) & (system.ready <= now)
            ).tolist()
            for ready, own in [(system.ready[place], int(system.ids[place]))]
            if np.isfinite(ready) and (k, own) not in self.number
        ]
        for ready, k, own, place in sorted(born):
            system, g = systems[k], len(self._of)
            tracks = system.view.tracks
            rows = slice(*np.searchsorted(tracks.track, [place, place + 1]))
            known = np.flatnonzero(system.known[rows] <= max(ready, now if np.isfinite(now) else ready)) + rows.start
            begin = float(tracks.time[rows].min())
            self.number[k, own] = g
            self._of.append(k)
            self._last.append(begin)
            self._votes.append((Counter(), Counter()))
            self._codes.append((-1, -1))
            self.membership.birth(g, Local(begin, k, -1, not system.own), ready)
            self._count(g, system.codes[known], float(tracks.time[known].max(initial=begin)))

    def _view(self, k: int, system: LocalSystem, now: float) -> SystemTracks:
        """Return the latest rows of a system that are known, under the numbers of all."""
        view, tracks = system.view, system.view.tracks
        known = np.maximum(system.known, system.ready[tracks.track])
        at = np.flatnonzero((known <= now) & (tracks.time >= now - self.kept))
        every = np.array([self.number.get((k, own), -1) for own in system.ids.tolist()], np.int64)
        number = every[tracks.track[at]]
        order = np.argsort(number, kind="stable")
        at, number = at[order], number[order]
        names = np.array([codes[0] for codes in self._codes], np.int64)
        rows = LocalTracks(number, *(column[at] for column in tracks[1:]))
        return SystemTracks(rows, view.velocity[at], view.ray[at], names)

    def _weigh(self, now: float, systems: Sequence[LocalSystem], views: Sequence[SystemTracks]) -> Looked:
        how = self._frames.registered()
        mode3a = np.array([codes[1] for codes in self._codes], np.int64)
        compared = [
            Compared(self._frames.moved(k, view), mode3a, how[k], self._regions[k], s.own, s.noise, self._periods[k])
            for k, (s, view) in enumerate(zip(systems, views, strict=True))
        ]
        of = np.array(self._of, np.int64)
        return self._weigher.look(now, self._before, compared, self._decider.pairs, of)

    def _decide(self, now: float, said: Looked) -> None:
        """Decide, and join and part tracks."""
        of, last = np.array(self._of, np.int64), np.array(self._last)
        alive = last >= now - self._settings.silent
        self._looks += 1
        self._alive += int(np.bincount(of[alive], minlength=1).max(initial=0))
        decided = self._decider.update(
            now,
            said.pairs,
            said.time,
            said.llr,
            system=of,
            address=np.array([codes[0] for codes in self._codes], np.int64),
            prior=self.prior,
            apart=said.apart,
            span=said.span,
            alive=alive,
        )
        self._said.add(said.pairs, said.time, said.llr)
        self._ended.append(decided.ended)
        members = self.membership
        for g in np.flatnonzero(~alive & (last >= self._before - self._settings.silent)).tolist():
            members.death(g, float(last[g]))
        ended = Episodes._make(column[decided.parted] for column in decided.ended)
        for e in _rows(ended):
            members.part(int(e.a), int(e.b), float(e.until), now)
        for e in _rows(decided.begun):
            members.join(int(e.a), int(e.b), float(e.since), now, float(e.probability))


def _rows(e: Episodes) -> list[Episodes]:
    return [Episodes(*row) for row in zip(*(column.tolist() for column in e), strict=True)]


def _commonest(votes: Counter[int]) -> int:
    """Return what was said most often, the least of equals; -1 where nothing was."""
    return min(votes, key=lambda code: (-votes[code], code)) if votes else -1
