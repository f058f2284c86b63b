"""System tracks as published rows: who belongs together, states from all measurements, what became of each plot."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.tracks.bias import BiasSeries, corrected, effects, learnt, spread
from saltus.tracks.faults import PlotLaw, SourceCondition
from saltus.tracks.fuse import Candidates, Fusion
from saltus.tracks.lanes import is_first, latest, since
from saltus.tracks.lifecycle import CONFIRMED
from saltus.tracks.measurements import Measurements
from saltus.tracks.membership import Segments
from saltus.tracks.rows import Rows, join_rows
from saltus.tracks.settings import FilterSettings, SystemsSettings, TrackerSettings
from saltus.tracks.slices import slices
from saltus.tracks.sources import SourceSetup
from saltus.tracks.splits import second_echoes
from saltus.tracks.systems import Registered, lasting_differences
from saltus.tracks.window import Reported

__all__ = ["Fused", "SystemTracking"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]

_LONGEST = 4.0  # s that a slice lasts


class Fused(NamedTuple):
    """What is known anew of system tracks."""

    rows: Rows  # `measurement` is the number of the plot
    plot: _Index  # numbers of reports
    track: _Index  # system track of each, 0 none
    before: float  # s: no row to come is known before that
    time: _Array  # s: of the reports, corrected


class _Corrected(NamedTuple):
    """Reports of one system or all, corrected for biases as known at their times."""

    m: Measurements  # corrected
    time: _Array  # as reported, s
    owner: _Index  # system
    local: _Index  # local track through all systems, -1 none that is ever confirmed
    updated: _Mask  # whether the local tracker published a row of it
    mean: _Array  # (n, 6): state after it, by the local tracker
    cov: _Array
    status: npt.NDArray[np.int8]
    shift: _Array  # (n, 2): what corrections moved the position by, m
    turn: _Array  # (n,): and turned directions by, rad
    doubt: _Array  # (n, 2, 2): what uncertain biases leave of the position, m^2

    @property
    def velocity(self) -> _Array:
        """What the local tracker said of the target, 0 where it said nothing, (n, 2), m/s."""
        return np.where(self.updated[:, None], self.mean[:, [1, 3]], 0.0)

    @property
    def usable(self) -> _Mask:
        """Whether there is a state after a position."""
        return np.asarray(self.updated & np.isfinite(self.m.position[:, 0]))

    def take(self, at: npt.NDArray[np.integer] | _Mask) -> "_Corrected":
        """Return those selected."""
        where = np.arange(len(self.time))[at]
        return _Corrected._make([self.m.take(where), *(column[where] for column in self[1:])])


def _joined(parts: Sequence[_Corrected]) -> _Corrected:
    columns = [np.concatenate(column) for column in zip(*(part[1:] for part in parts), strict=True)]
    return _Corrected._make([Measurements.join([part.m for part in parts]), *columns])


class SystemTracking:
    """System tracks, fed with the reports of all systems in order of time.

    Every system track begins in the state in which its first local track was published, and is updated by all reports
    of its local tracks in exact time order, corrected for the biases of their systems (`Fusion`). Second echoes move no
    state. Who belongs together is known beforehand.
    """

    def __init__(
        self,
        ids: Sequence[_Index],
        registered: Sequence[Registered],
        segments: Segments,
        laws: Sequence[PlotLaw],
        filters: FilterSettings,
        settings: TrackerSettings,
        systems: SystemsSettings,
        sources: Sequence[SourceSetup],
        *,
        use_identity: bool,
    ) -> None:
        """Begin without reports.

        Args:
            ids: each local tracker's numbers of its tracks, in the order in which local tracks are numbered.
            registered: how each of these systems was.
            segments: to which system track each local track belongs, and when.
            laws: what may be wrong with reports of each source.
            filters: manoeuvres.
            settings: faults, coasting.
            systems: when the frame of a track moves.
            sources: all of them, of all systems.
            use_identity: whether tracks take over addresses and codes.
        """
        self._ids, self._registered, self._segments = ids, registered, segments
        self._first = np.cumsum([0, *(len(own) for own in ids)])
        self._fusion = Fusion(settings, filters, laws, sources, use_identity=use_identity)
        self._width = min([_LONGEST, *(s.wait for s in sources)])
        system = np.repeat(np.arange(len(ids)), [len(own) for own in ids])
        own = np.flatnonzero(segments.track < len(system))  # another centre's tracks, numbered last, have no reports
        self._echoes = second_echoes(Segments(*(column[own] for column in segments)), system)
        late = [r.found.series.mean[:, 5].max(initial=0.0) for r in registered if r.found is not None]
        self._late = float(max(late, default=0.0))
        self._pending: list[list[_Corrected]] = [[] for _ in ids]  # others may still come before
        self._lanes = _Lanes(np.unique(segments.system_track), registered, systems)
        self._waiting: tuple[Measurements, Candidates] | None = None  # of slices that are not complete
        self._before = -np.inf  # s: time of the last report of the slices complete

    @property
    def conditions(self) -> list[SourceCondition]:
        """The condition of each source."""
        return self._fusion.conditions

    def feed(self, systems: Sequence[Reported], until: float) -> Fused:
        """Take the next reports of each system; none that follows is earlier than `until`, s."""
        known = until - self._late
        ready: list[_Corrected] = []
        for k, reported in enumerate(systems):
            part = _joined([*self._pending[k], self._corrected(k, reported)])
            early = part.m.time < known
            self._pending[k] = [part.take(~early)]
            ready.append(part.take(early))
        merged = _joined(ready)
        merged = merged.take(np.argsort(merged.m.time, kind="stable"))
        of = self._system_tracks(merged)
        rows = self._fused(merged, of, known)
        return Fused(rows, merged.m.plot, of, self._before, merged.m.time)

    def _corrected(self, k: int, new: Reported) -> _Corrected:
        """Take biases out of the reports of one system."""
        found, m, n = self._registered[k].found, new.m, len(new.m)
        ids = self._ids[k]
        local, owner = np.full(n, -1), np.full(n, k)
        if len(ids):
            place = np.minimum(np.searchsorted(ids, new.track), len(ids) - 1)
            local = np.where(ids[place] == new.track, self._first[k] + place, -1)
        shift, turn, doubt = np.zeros((n, 2)), np.zeros(n), np.zeros((n, 2, 2))
        if found is not None:
            m = corrected(new.m, np.arange(n), found.series)
            mean, cov = found.series.at(new.m.time)
            doubt = spread(effects(m.ray, new.velocity), cov)
            shift, turn = m.position[:, :2] - new.m.position[:, :2], mean[:, 2]
        return _Corrected(m, new.m.time, owner, local, new.updated, new.mean, new.cov, new.status, shift, turn, doubt)

    def _system_tracks(self, merged: _Corrected) -> _Index:
        """Return the system track of each report, 0 none."""
        of = np.zeros(len(merged.time), np.int64)
        known = np.flatnonzero(merged.local >= 0)
        if len(self._segments.track):
            at = self._segments.at(merged.local[known], merged.time[known])
            of[known] = self._segments.system_track[at]
        return of

    def _fused(self, merged: _Corrected, of: _Index, known: float) -> Rows:
        """Update states by the reports of slices that are complete."""
        at = np.flatnonzero((of > 0) & ~self._echoing(merged))
        at = at[np.lexsort((merged.m.time[at], of[at]))]
        lanes = merged.take(at)
        new = self._lanes.candidates(lanes, of[at])
        order = np.argsort(lanes.m.time, kind="stable")
        m, candidates = lanes.m.take(order), new.take(order)
        if self._waiting is not None:
            old, before = self._waiting
            m = Measurements.join([old, m])
            both = zip(before, candidates, strict=True)
            candidates = Candidates._make(np.concatenate(columns) for columns in both)
        candidates = candidates._replace(number=np.arange(len(m)))
        out, stop = [], 0
        for begin, stop in slices(m.time, self._width, known):
            out += self._fusion.feed(m, candidates.take(np.arange(begin, stop)))
        rest = np.arange(stop, len(m))
        self._waiting = m.take(rest), candidates.take(rest)
        if stop:
            self._before = float(m.time[stop - 1])
        return join_rows(out)

    def _echoing(self, merged: _Corrected) -> _Mask:
        """Say which reports are of second echoes."""
        out = np.zeros(len(merged.time), bool)
        if not len(merged.time):
            return out
        first, last = merged.time.min(), merged.time.max()
        for spell in self._echoes:
            if spell.time_from <= last and spell.time_to > first:
                inside = (merged.time >= spell.time_from) & (merged.time < spell.time_to)
                out |= (merged.local == spell.track) & inside
        return out


class _Lanes:
    """What is known of each system track so far: which systems saw it, when, and whether it is confirmed."""

    def __init__(self, tracks: _Index, registered: Sequence[Registered], settings: SystemsSettings) -> None:
        """Begin with nothing known of system tracks, sorted by number."""
        n = len(tracks)
        self._tracks, self._registered, self._settings = tracks, registered, settings
        self._owner = np.full(n, -1)  # system of the first report
        self._several, self._sure = np.zeros(n, bool), np.zeros(n, bool)
        self._n = 0  # reports so far
        self._place = np.full((n, len(registered)), -1)  # of the last one of each system among all
        self._time = np.full((n, len(registered)), -np.inf)  # its time, s
        self._usable = np.full((n, len(registered)), -np.inf)  # time of the last usable one

    def candidates(self, r: _Corrected, track: _Index) -> Candidates:
        """Return reports, sorted by system track and then by time, as candidates; note them."""
        lane = np.searchsorted(self._tracks, track)
        first = np.flatnonzero(is_first(lane))
        last = np.append(first[1:], len(lane)) - 1 if len(first) else first
        fresh = first[self._owner[lane[first]] < 0]
        self._owner[lane[fresh]] = r.owner[fresh]
        several = since(r.owner != self._owner[lane], lane) | self._several[lane]
        sure = since(r.updated & (r.status == CONFIRMED), lane) | self._sure[lane]
        self._several[lane[last]], self._sure[lane[last]] = several[last], sure[last]
        shift, turn = self._reframed(r, lane)
        self._note(r, lane)
        n, lasting = len(lane), lasting_differences(self._registered, r.m.time)
        extra = np.zeros((n, 2, 2))
        extra[several] = 0.5 * lasting[several, None, None] ** 2 * np.eye(2) + r.doubt[several]
        mean, cov = _state(r)
        return Candidates(np.arange(n), track, sure, r.usable, mean, cov, shift, turn, extra)

    def _reframed(self, r: _Corrected, lane: _Index) -> tuple[_Array, _Array]:
        """Return how far the frame of a track moves before each report (n, 2), m, and turns (n,), rad.

        It does where what is known of a system's biases has stepped further than the noise of its reports. No target
        moved there: a track that this system sees alone moves with the new frame. Where another system sees it, too,
        the state is in that one's frame already.
        """
        shift, turn = np.zeros((len(lane), 2)), np.zeros(len(lane))
        for k, registered in enumerate(self._registered):
            at = np.flatnonzero(r.usable & (r.owner == k))
            if registered.found is None or not len(at):
                continue
            before = self._usable[lane[at], k]
            again = ~is_first(lane[at])
            before[again] = r.time[at[np.flatnonzero(again) - 1]]
            there = np.isfinite(before)
            at, before = at[there], before[there]
            alone = r.time[at] - self._met(r, lane, k)[at]
            step, turned = _stepped(registered.found.series, r, at, before)
            d2 = np.einsum("ni,nij,nj->n", step, np.linalg.inv(r.m.cov[at, :2, :2]), step)
            moves = (d2 > self._settings.step**2) & (alone > self._settings.lately)
            shift[at[moves]], turn[at[moves]] = step[moves], turned[moves]
        return shift, turn

    def _met(self, r: _Corrected, lane: _Index, k: int) -> _Array:
        """Return when a system other than k saw each track last, at each report, s."""
        other = latest(np.where(r.owner == k, -1, np.arange(len(lane))), lane)
        place = np.where(np.arange(self._place.shape[1]) == k, -1, self._place)
        newest = place.argmax(axis=1)
        rows = np.arange(len(place))
        carried = np.where(place[rows, newest] >= 0, self._time[rows, newest], -np.inf)
        return np.where(other >= 0, r.time[np.maximum(other, 0)], carried[lane])

    def _note(self, r: _Corrected, lane: _Index) -> None:
        """Keep the last report of each system in each lane; of equal places the last one assigned stays."""
        for k in range(len(self._registered)):
            at = np.flatnonzero(r.owner == k)
            at = at[np.append(np.diff(lane[at]) != 0, True)] if len(at) else at
            self._place[lane[at], k], self._time[lane[at], k] = self._n + at, r.time[at]
            at = np.flatnonzero((r.owner == k) & r.usable)
            at = at[np.append(np.diff(lane[at]) != 0, True)] if len(at) else at
            self._usable[lane[at], k] = r.time[at]
        self._n += len(lane)


def _stepped(series: BiasSeries, r: _Corrected, at: _Index, before: _Array) -> tuple[_Array, _Array]:
    """Return how far, and by which angle, the frame of one system's reports stepped since the ones before them.

    Args:
        series: biases of the system.
        r: reports.
        at: those of the system, (k,).
        before: times of the ones before, s.
    """
    now = r.time[at]
    azimuth = [series.at(time)[0][:, 2] for time in (before, now)]
    return learnt(series, r.m.ray[at], r.velocity[at], before, now), azimuth[1] - azimuth[0]


def _state(r: _Corrected) -> tuple[_Array, _Array]:
    """State of the local tracker after each report, moved with the measurement that it was made from."""
    mean, turn = r.mean.copy(), r.turn
    mean[:, :3:2] += r.shift
    c, s = np.cos(turn), np.sin(turn)
    vx, vy = mean[:, 1].copy(), mean[:, 3].copy()
    mean[:, 1], mean[:, 3] = c * vx - s * vy, s * vx + c * vy
    return mean, r.cov
