"""The tracker's loop: slices of a scan in time order, all tracks of a slice as arrays."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from saltus.linalg import logsumexp
from saltus.tracks.associate import assign
from saltus.tracks.background import densities
from saltus.tracks.channel import MOTION
from saltus.tracks.faults import SourceCondition, plot_law
from saltus.tracks.gates import Gate, Gated
from saltus.tracks.identity import identity_gain
from saltus.tracks.kept import Kept
from saltus.tracks.kinematics import make_kinematics
from saltus.tracks.lifecycle import CONFIRMED, SEED, TENTATIVE, Birth, Lifecycle
from saltus.tracks.measurements import Measurements
from saltus.tracks.publish import Told, coast, updated_rows
from saltus.tracks.rows import ConditionFound, Fates, Fed, Rows, join_fates, join_rows
from saltus.tracks.settings import FilterSettings, TrackerSettings
from saltus.tracks.sights import sight
from saltus.tracks.slices import rounds, slices
from saltus.tracks.sources import TrackerSetup
from saltus.tracks.starts import Starts
from saltus.tracks.step import Judged, absorb, judge

__all__ = ["Tracker"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]

_SURPLUS = 1.5  # periods between two right plots, below which none is missing between them
_STANDING = np.array([-3.0, -2.0, 0.0])  # nats: a plot is less likely a seed's or a tentative track's own


class Tracker:
    """Multimode multitarget tracker over measurements in time order, fed in pieces of any size.

    What it does in a slice depends on the slices before and on the setup alone, so the pieces change nothing. Between
    pieces it holds tracks, the last plots they refer to, the conditions of sources, and the slice not yet complete.
    """

    def __init__(
        self, settings: TrackerSettings, filters: FilterSettings, setup: TrackerSetup, *, use_identity: bool
    ) -> None:
        """Prepare an empty tracker.

        Args:
            settings: association, initiation and deletion.
            filters: the filters of every track.
            setup: of the sources.
            use_identity: let Mode S addresses decide and Mode 3/A codes support the association.
        """
        self._settings, self._filters = settings, filters
        self._use_identity = use_identity
        self._kinematics = make_kinematics(filters, [s.colour for s in setup.sources], settings)
        self._life = Lifecycle(settings)
        self._sources: list[SourceCondition] = []
        self.adopt(setup)
        self._starts = Starts(settings, filters, self._gate.horizontal)
        self._pending: Measurements | None = None
        self._last = Kept()

    def adopt(self, setup: TrackerSetup) -> None:
        """Go on under another setup; sources keep their numbers, and new ones come behind them."""
        self._setup = setup
        self._periods = np.array([s.period for s in setup.sources])
        self._gate = Gate(self._settings, self._filters, self._periods, use_identity=self._use_identity)
        self._kinematics = self._kinematics.adopt([s.colour for s in setup.sources], self._settings)
        new = setup.sources[len(self._sources) :]
        self._sources += [SourceCondition(plot_law(self._settings, s.kind), self._settings) for s in new]

    @property
    def conditions(self) -> list[ConditionFound]:
        """What was found of the condition of each source, and not taken yet."""
        return [ConditionFound(source.law, source.history) for source in self._sources]

    def drained(self) -> list[ConditionFound]:
        """Take what was found of the condition of each source since the last time."""
        return [ConditionFound(source.law, source.drained()) for source in self._sources]

    def feed(self, measurements: Measurements, until: float = -np.inf) -> Fed:
        """Take measurements, none earlier than those before; return what is known anew.

        Args:
            measurements: in time order, their numbers ascending.
            until: nothing will follow up to this time, s; slices that end before are complete.
        """
        m = measurements if self._pending is None else Measurements.join([self._pending, measurements])
        parts, fates, confirmed, end = [], [], [np.zeros(0, np.int64)], 0
        for begin, end in slices(m.time, self._setup.width, until):
            fed = self._slice(m.take(np.arange(begin, end)))
            parts.append(fed.rows)
            fates.append(fed.fates)
            confirmed.append(fed.confirmed)
        self._pending = m.take(np.arange(end, len(m)))
        return Fed(join_rows(parts), join_fates(fates), np.concatenate(confirmed))

    def end(self) -> Fed:
        """Take what waits as a complete slice: nothing will follow it, or only under another setup."""
        if self._pending is None:
            return Fed(join_rows([]), join_fates([]), np.zeros(0, np.int64))
        return self.feed(self._pending.take(np.zeros(0, np.intp)), np.inf)

    def referred(self) -> npt.NDArray[np.int64]:
        """Return the numbers of the plots whose fate may still be told, or told again."""
        pending = np.zeros(0, np.int64) if self._pending is None else self._pending.plot
        return np.concatenate([self._life.plot[self._life.rows()], pending])

    def _slice(self, m: Measurements) -> Fed:
        """Go through one complete slice."""
        n = len(m)
        self._m, self._density = m, densities(m, [s.background for s in self._setup.sources])
        self._known = float(m.time[-1])
        self._rows: list[Rows] = []
        self._confirmed: list[npt.NDArray[np.int64]] = [np.zeros(0, np.int64)]
        self._renamed = [np.zeros((0, 2), np.int64)]
        self._track_id, self._split, self._elsewhere = np.zeros(n, np.int64), np.zeros(n, bool), np.zeros(n, bool)
        self._speed = np.zeros(n)  # of the track after each plot that it took, m/s
        self._housekeep(float(m.time[0]))
        _, first = np.unique(m.source, return_index=True)
        for s in m.source[np.sort(first)].tolist():  # as they come, whatever number each has
            own, source = np.flatnonzero(m.source == s), self._setup.sources[s]
            speed = self._settings.max_speed
            for scan in rounds(m, own, source.period, speed, use_identity=self._use_identity):
                self._scan(scan, source.wait)
        before = np.concatenate(self._renamed)
        none = np.zeros(len(before), bool)
        told = Fates(before[:, 0], before[:, 1], none, none)
        fates = Fates(m.plot, self._track_id, self._split, self._elsewhere)
        return Fed(join_rows(self._rows), join_fates([told, fates]), np.concatenate(self._confirmed))

    def state(self) -> dict[str, Any]:
        """Return everything that `restore` goes on from, as arrays by name."""
        return {
            "life": self._life.state(),
            "next_id": np.array(self._life.next_id),
            "bank": self._kinematics.state(),
            "source": {str(k): source.state() for k, source in enumerate(self._sources)},
            "last": self._last.state(),
            "pending": {} if self._pending is None else self._pending.columns(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from what `state` gave, of a tracker of the same settings and setup."""
        self._life.restore(state["life"], int(state["next_id"]))
        self._kinematics.restore(state["bank"])
        for k, source in enumerate(self._sources):
            source.restore(state["source"][str(k)])
        self._last.restore(state.get("last", {}))
        self._pending = Measurements(**state["pending"]) if state.get("pending") else None

    def _housekeep(self, now: float) -> None:
        """Publish what coasts; drop what is overdue or moves as no target does."""
        self._rows += coast(self._kinematics, self._life, now)
        life = self._life
        ended = np.unique(np.concatenate([life.overdue(now), life.too_fast(), life.repeated()]))
        if len(ended):
            self._kinematics.remove(ended)
            life.end(ended)

    def _scan(self, index: _Index, wait: float) -> None:
        """Associate and absorb the plots of one source in one slice."""
        life = self._life
        bearings = np.isfinite(self._m.bearing[index])
        if bearings.any():
            self._sight(index[bearings])
            index = index[~bearings]
            if not len(index):
                return
        m = self._m
        source, prior = self._source(index)
        gated = self._gate(self._kinematics, life, m, index, source, prior)
        chosen, judged = self._decide(gated, index, self._gain(gated, index))
        rows, plots = gated.pairs.track[chosen], index[gated.pairs.plot[chosen]]
        wrong = judged.wrong
        again = self._twice_wrong(rows, plots, wrong)
        life.renew(rows[again])
        self._rename(rows[again])
        new = again | (life.status[rows] == SEED)
        right = ~new & (wrong <= 0.5)
        surplus = self._surplus(rows[right], plots[right])
        if new.any():
            first = self._last.of(rows[new])
            begun = life.time[rows[new]]
            start = self._starts.of_two(first, begun, m, plots[new], self._kinematics.colours)
            self._kinematics.write(rows[new], start)
        absorb(self._kinematics, rows[~new], gated, chosen[~new], judged.take(~new))
        self._enter(rows, plots, wait, gated.height_used[chosen], sound=new | (wrong <= 0.5))
        life.p_fault[rows] = np.where(new, np.nan, wrong)
        # Neither a start nor a fault, nor a degraded source, says whether the filter's innovations are what it thinks.
        d2 = np.where(new | (wrong > 0.5) | source.degraded, np.nan, gated.d2[chosen])
        fault = np.where(new, 0, judged.fault)
        told = Told(gated.centre[chosen], gated.gate_cov[chosen], d2, life.p_fault[rows], fault, source.p_degraded)
        self._publish(rows, plots, told)
        left = np.ones(len(index), bool)
        left[gated.pairs.plot[chosen]] = False
        used = plots[life.status[rows] == CONFIRMED]
        self._speed[plots] = np.hypot(life.mean[rows, 1], life.mean[rows, 3])
        self._begin(index[left], used, wait)
        far = np.linalg.norm(m.position[plots, :2] - gated.centre[chosen], axis=-1) > self._settings.split_range
        self._also_begin(plots[~new & (wrong > 0.5) & far], used, wait)
        if surplus is not None:
            self._seed(surplus, self._unnamed(surplus, np.arange(len(surplus))), wait)

    def _twice_wrong(self, rows: _Index, plots: _Index, wrong: _Array) -> npt.NDArray[np.bool_]:
        """Say which tracks have begun wrongly: tentative ones with two faulty plots in a row.

        Likelier than that is one faulty plot among the two they began with. They begin anew, as other tracks, with this
        plot and the one before.
        """
        life = self._life
        twice = (life.status[rows] == TENTATIVE) & (wrong > 0.5) & (life.p_fault[rows] > 0.5)
        return np.asarray(twice & (self._m.time[plots] > life.time[rows]))

    def _rename(self, rows: _Index) -> None:
        """The last plots of rows that begin anew are their new tracks' own."""
        life, here = self._life, self._m.plot
        plots = life.plot[rows]
        of, at = np.nonzero(plots[:, None] == here)
        self._track_id[at] = life.id[rows[of]]
        inside = np.zeros(len(rows), bool)
        inside[of] = True
        self._renamed.append(np.column_stack([plots, life.id[rows]])[~inside])

    def _surplus(self, rows: _Index, plots: _Index) -> Measurements | None:
        """Return plots that tracks took as faulty while their right ones came one period apart, as if none were.

        A target gives one plot a period, so they are another's. Each begins a track, if none has begun with it.
        """
        m, life = self._m, self._life
        faulty = life.p_fault[rows] > 0.5
        rows, plots = rows[faulty], plots[faulty]
        if not len(rows):
            return None
        one = (life.source[rows] == m.source[plots]) & (life.sound_source[rows] == m.source[plots])
        usual = m.time[plots] - life.sound_time[rows] < _SURPLUS * self._periods[m.source[plots]]
        rows = rows[one & usual]
        live = life.rows()
        return self._last.of(rows[~np.isin(life.plot[rows], life.plot[live[life.status[live] == SEED]])])

    def _source(self, index: _Index) -> tuple[SourceCondition, _Array]:
        """Return the source of reports, and log probabilities of its conditions at the last of them."""
        source = self._sources[self._m.source[index[0]]]
        return source, source.predicted(float(self._m.time[index[-1]]))

    def _decide(self, gated: Gated, index: _Index, gain: _Array) -> tuple[_Index, Judged]:
        """Choose pairs, and judge what is wrong with the reports chosen.

        Args:
            gated: pairs of tracks and reports.
            index: the reports of one source.
            gain: log-likelihood ratio of each pair to report and track apart, but for the density of the report.
        """
        m, life = self._m, self._life
        source, prior = self._source(index)
        log_f = gated.score()
        chosen = assign(gated.pairs, gain + logsumexp(source.weights(prior) + log_f, (1,))[:, 0])
        rows, plots = gated.pairs.track[chosen], index[gated.pairs.plot[chosen]]
        voice = source.voice(life.id[rows], m.time[plots], life.status[rows] == CONFIRMED)
        return chosen, judge(source, float(m.time[index[-1]]), prior, log_f[chosen], voice)

    def _sight(self, index: _Index) -> None:
        """Absorb the bearings of one source in one slice: they update confirmed tracks, and do nothing else."""
        settings, m, life = self._settings, self._m, self._life
        source, prior = self._source(index)
        gated = sight(self._kinematics, life, m, index, self._gate, source, prior)
        detection = settings.detection_probability
        gain = np.log(detection / (1.0 - detection)) - np.log(settings.clutter_density_azimuth)
        chosen, judged = self._decide(gated, index, np.full(len(gated.copy), gain))
        rows, plots = gated.pairs.track[chosen], index[gated.pairs.plot[chosen]]
        absorb(self._kinematics, rows, gated, chosen, judged)
        life.sighted(rows, m.time[plots])
        self._track_id[plots] = life.id[rows]
        centre, cov, nothing = gated.centre[chosen], gated.gate_cov[chosen], np.full(len(rows), np.nan)
        self._publish(rows, plots, Told(centre, cov, nothing, judged.wrong, judged.fault, source.p_degraded))

    def _gain(self, gated: Gated, index: _Index) -> _Array:
        """Log-likelihood ratio of "this plot is this track's" against "the track missed and the plot is new".

        Without the density of the plot, which is a matter of hypotheses.
        """
        settings, m, life = self._settings, self._m, self._life
        track, plot = gated.pairs.track, index[gated.pairs.plot]
        detection = settings.detection_probability
        gain = np.log(detection / (1.0 - detection)) - np.log(self._density.plane[plot])
        has_height, new_height = np.isfinite(m.position[plot, 2]), self._density.height[plot]
        gain = gain + np.where(gated.height_used, np.log((1.0 - settings.altitude_outlier) / new_height), 0.0)
        gain = gain + np.where(has_height & ~gated.height_used, np.log(settings.altitude_outlier), 0.0)
        gain = gain + _STANDING[life.status[track]]
        if self._use_identity:
            gain = gain + identity_gain(life.icao24[track], m.icao24[plot], life.mode3a[track], m.mode3a[plot])
        return np.asarray(gain)

    def _enter(
        self,
        rows: _Index,
        plots: _Index,
        wait: float,
        height_used: npt.NDArray[np.bool_],
        sound: npt.NDArray[np.bool_],
    ) -> None:
        """Note plots, codes and status of the rows updated; what is not sound confirms no track."""
        life = self._life
        fresh = life.status[rows] != CONFIRMED
        life.hit(rows, self._m.time[plots], np.full(len(rows), wait), self._m.plot[plots], sound)
        life.heard_altitude(rows, height_used, self._m.cov[plots, 2, 2])
        self._note(rows, self._m, plots)
        life.sound_time[rows[sound]] = self._m.time[plots[sound]]
        life.sound_source[rows[sound]] = self._m.source[plots[sound]]
        self._track_id[plots] = life.id[rows]
        self._confirmed.append(life.id[rows[fresh & (life.status[rows] == CONFIRMED)]])

    def _begin(self, plots: _Index, used: _Index, wait: float) -> None:
        """Mark plots left over that are split or contradict their address; begin a track with every other one."""
        if not len(plots):
            return
        split = self._split_from(plots, used)
        elsewhere = self._life.holds(self._m.icao24[plots]) & self._use_identity & ~split
        self._split[plots[split]], self._elsewhere[plots[elsewhere]] = True, True
        plots = plots[~split & ~elsewhere]
        rows = self._seed(self._m, plots, wait)
        self._track_id[plots] = self._life.id[rows]

    def _also_begin(self, plots: _Index, used: _Index, wait: float) -> None:
        """Begin tracks with plots that others took as faulty: they may be right ones of a target not yet known.

        They stay with the track that took them.
        """
        plots = self._unnamed(self._m, plots)
        if len(plots):
            self._seed(self._m, plots[~self._split_from(plots, np.setdiff1d(used, plots))], wait)

    def _unnamed(self, m: Measurements, plots: _Index) -> _Index:
        """Leave out plots with an address, which settles whose they are."""
        return plots[(m.icao24[plots] < 0) | (not self._use_identity)]

    def _split_from(self, plots: _Index, used: _Index) -> npt.NDArray[np.bool_]:
        settings = self._settings
        reach = settings.split_range, np.radians(settings.split_azimuth)
        return self._m.split_from(plots, used, self._speed[used], *reach)

    def _seed(self, m: Measurements, plots: _Index, wait: float) -> _Index:
        """Begin a track with every plot."""
        if not len(plots):
            return np.zeros(0, np.intp)
        life, start = self._life, self._starts.of_one(m, plots, self._kinematics.colours)
        rows = self._kinematics.add(start)
        state = start.mean[:, :MOTION], start.cov[:, :MOTION, :MOTION]
        life.begin(rows, Birth(m.time[plots], np.full(len(plots), wait), m.plot[plots], *state))
        life.heard_altitude(rows, np.isfinite(m.position[plots, 2]), m.cov[plots, 2, 2])
        self._note(rows, m, plots)
        life.sound_time[rows], life.sound_source[rows] = m.time[plots], m.source[plots]
        return rows

    def _note(self, rows: _Index, m: Measurements, plots: _Index) -> None:
        """Note the plots and codes of rows."""
        life = self._life
        self._last.note(rows, m, plots)
        life.source[rows] = m.source[plots]
        if self._use_identity:
            life.icao24[rows] = np.where(m.icao24[plots] >= 0, m.icao24[plots], life.icao24[rows])
            life.mode3a[rows] = np.where(m.mode3a[plots] >= 0, m.mode3a[plots], life.mode3a[rows])
            life.callsign[rows] = np.where(m.callsign[plots] != "", m.callsign[plots], life.callsign[rows])

    def _publish(self, rows: _Index, plots: _Index, told: Told) -> None:
        if len(rows):
            life, moments = self._life, self._kinematics.moments(rows)
            life.mean[rows], life.cov[rows] = moments.mean, moments.cov
            self._rows.append(updated_rows(life, rows, moments, self._m, plots, told, self._known))
