"""System tracks' states: the tracker's own step, with the reports that local tracks hand on in place of association."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.tracks.channel import Start
from saltus.tracks.faults import PlotLaw, SourceCondition
from saltus.tracks.gates import Gate
from saltus.tracks.kinematics import make_kinematics
from saltus.tracks.lifecycle import CONFIRMED, NO_CODE, TENTATIVE, Birth, Lifecycle
from saltus.tracks.measurements import Measurements
from saltus.tracks.publish import Told, coast, updated_rows
from saltus.tracks.rows import Rows
from saltus.tracks.settings import FilterSettings, TrackerSettings
from saltus.tracks.sights import sighted
from saltus.tracks.sources import SourceSetup
from saltus.tracks.starts import erring
from saltus.tracks.step import absorb, judge

__all__ = ["Candidates", "Fusion"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]


class Candidates(NamedTuple):
    """Reports that local tracks hand on to system tracks, in time order; one array element each."""

    number: _Index  # measurement
    track: _Index  # system track
    sure: _Mask  # whether a local track of it is confirmed by then
    begins: _Mask  # whether a track may begin here, from the state below
    mean: _Array  # (n, 6): of the local track after the report
    cov: _Array  # (n, 6, 6)
    shift: _Array  # (n, 2): what the track's frame moves by beforehand, m; 0 mostly
    turn: _Array  # (n,): and turns by, rad
    extra: _Array  # (n, 2, 2): covariance of the position beyond the sensor's, m^2

    def take(self, index: _Index) -> "Candidates":
        """Return those selected."""
        return Candidates._make(column[index] for column in self)


class Fusion:
    """States of system tracks, fed with slices of candidates.

    Each report is weighed, absorbed and published as in `Tracker`, by the same functions under the same settings; only
    whose it is was found before, by the trackers of single systems. The condition of every source is filtered from the
    system tracks: what contradicts the other sources' reports of the same objects is told from what contradicts the
    past of one source alone.
    """

    def __init__(
        self,
        settings: TrackerSettings,
        filters: FilterSettings,
        laws: Sequence[PlotLaw],
        sources: Sequence[SourceSetup],
        *,
        use_identity: bool,
    ) -> None:
        """Begin without tracks.

        Args:
            settings: faults, coasting, gates of heights.
            filters: manoeuvres.
            laws: what may be wrong with reports of each source.
            sources: all of them.
            use_identity: whether tracks take over addresses and codes.
        """
        self._kinematics = make_kinematics(filters, [s.colour for s in sources], settings)
        self._life = Lifecycle(settings)
        self._periods, self._use_identity = np.array([s.wait for s in sources]), use_identity
        self._gate = Gate(settings, filters, self._periods, use_identity=use_identity)
        self.conditions = [SourceCondition(law, settings) for law in laws]
        self._row: dict[int, int] = {}  # of each system track alive

    def feed(self, m: Measurements, candidates: Candidates) -> list[Rows]:
        """Take one slice; return what is published.

        Args:
            m: all measurements.
            candidates: of the slice.
        """
        now, known = float(m.time[candidates.number[0]]), float(m.time[candidates.number[-1]])
        out = self._housekeep(now)
        for turn in _turns(candidates.track):
            part = candidates.take(turn)
            new = np.array([track not in self._row for track in part.track.tolist()])
            out += self._begin(m, part.take(np.flatnonzero(new & part.begins)), known)
            rest = part.take(np.flatnonzero(~new))
            moved = np.flatnonzero(rest.shift.any(axis=1) | (rest.turn != 0.0))
            if len(moved):
                self._kinematics.move(self._rows(rest.take(moved)), rest.shift[moved], rest.turn[moved])
            bearing, source = np.isfinite(m.bearing[rest.number]), m.source[rest.number]
            for s in np.unique(source).tolist():
                for sights in (False, True):
                    own = np.flatnonzero((source == s) & (bearing == sights))
                    if len(own):
                        out += self._step(m, rest.take(own), s, known, sights=sights)
        return out

    def _rows(self, candidates: Candidates) -> _Index:
        return np.array([self._row[track] for track in candidates.track.tolist()], np.intp)

    def _housekeep(self, now: float) -> list[Rows]:
        """Publish what coasts; forget what has been silent for too long: should it come back, it begins anew."""
        life = self._life
        out = coast(self._kinematics, life, now)
        ended = life.overdue(now)
        if len(ended):
            self._kinematics.remove(ended)
            life.end(ended)
            for track in life.id[ended].tolist():
                del self._row[track]
        return out

    def _begin(self, m: Measurements, new: Candidates, known: float) -> list[Rows]:
        """Begin tracks in the state of a local one."""
        if not len(new.track):
            return []
        life, n = self._life, len(new.track)
        L, time, source = m.lasting[new.number], m.time[new.number], m.source[new.number]
        rows = self._kinematics.add(erring(Start(new.mean, new.cov), self._kinematics.colours, source, time, L))
        self._row |= dict(zip(new.track.tolist(), rows.tolist(), strict=True))
        periods = self._periods[m.source[new.number]]
        life.begin(rows, Birth(m.time[new.number], periods, new.number, new.mean, new.cov))
        life.id[rows] = new.track
        life.heard_altitude(rows, np.isfinite(m.position[new.number, 2]), m.cov[new.number, 2, 2])
        self._note(m, rows, new)
        cov = m.cov[new.number, :2, :2] + new.extra
        nothing, none = np.full(n, np.nan), np.zeros(n, np.int8)
        return self._publish(m, rows, new, Told(new.mean[:, :3:2], cov, nothing, nothing, none, np.nan), known)

    def _step(self, m: Measurements, given: Candidates, s: int, known: float, *, sights: bool) -> list[Rows]:
        """Update tracks by reports of one source, no track twice."""
        life, source = self._life, self.conditions[s]
        rows, time = self._rows(given), float(m.time[given.number].max())
        if sights:
            gated = sighted(self._kinematics, life, m, rows, given.number, source)
            given = given.take(gated.pairs.plot)
            rows = gated.pairs.track
        else:
            extra = np.zeros((len(rows), 3, 3))
            extra[:, :2, :2] = given.extra
            gated = self._gate.given(self._kinematics, life, m, rows, given.number, source, extra)
        plots = given.number
        voice = source.voice(life.id[rows], m.time[plots], life.status[rows] == CONFIRMED)
        judged = judge(source, time, source.predicted(time), gated.score(), voice)
        absorb(self._kinematics, rows, gated, np.arange(len(rows)), judged)
        if sights:
            life.sighted(rows, m.time[plots])
        else:
            life.hit(rows, m.time[plots], self._periods[m.source[plots]], plots)
            life.heard_altitude(rows, gated.height_used, m.cov[plots, 2, 2])
            life.p_fault[rows] = judged.wrong
        self._note(m, rows, given)
        d2 = np.where((judged.wrong > 0.5) | source.degraded | sights, np.nan, gated.d2)
        told = Told(gated.centre, gated.gate_cov, d2, judged.wrong, judged.fault, source.p_degraded)
        return self._publish(m, rows, given, told, known)

    def _note(self, m: Measurements, rows: _Index, given: Candidates) -> None:
        """Take over status and codes."""
        life, plots = self._life, given.number
        life.status[rows] = np.where(given.sure, CONFIRMED, TENTATIVE)
        life.source[rows] = m.source[plots]
        if self._use_identity:
            life.icao24[rows] = np.where(m.icao24[plots] != NO_CODE, m.icao24[plots], life.icao24[rows])
            life.mode3a[rows] = np.where(m.mode3a[plots] != NO_CODE, m.mode3a[plots], life.mode3a[rows])
            life.callsign[rows] = np.where(m.callsign[plots] != "", m.callsign[plots], life.callsign[rows])

    def _publish(self, m: Measurements, rows: _Index, given: Candidates, told: Told, known: float) -> list[Rows]:
        life, moments = self._life, self._kinematics.moments(rows)
        life.mean[rows], life.cov[rows] = moments.mean, moments.cov
        return [updated_rows(life, rows, moments, m, given.number, told, known)]


def _turns(track: _Index) -> Iterator[_Index]:
    """Divide candidates so that no track has two at a time, its earlier ones first."""
    order = np.argsort(track, kind="stable")
    turn = np.empty(len(track), np.intp)
    turn[order] = np.arange(len(track)) - np.searchsorted(track[order], track[order])
    for k in range(int(turn.max(initial=-1)) + 1):
        yield np.flatnonzero(turn == k)
