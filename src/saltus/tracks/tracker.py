"""The tracker's loop: slices of a scan in time order, all tracks of a slice as arrays."""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from saltus.linalg import logsumexp
from saltus.tracks.associate import assign
from saltus.tracks.background import Background, background, flat
from saltus.tracks.faults import SourceCondition, plot_law
from saltus.tracks.gates import Gate, Gated
from saltus.tracks.identity import identity_gain
from saltus.tracks.kinematics import Plan, Start, make_kinematics, two_point_start, with_speed_prior
from saltus.tracks.lifecycle import COASTED, CONFIRMED, SEED, TENTATIVE, Birth, Lifecycle
from saltus.tracks.measurements import Measurements
from saltus.tracks.rows import Assignments, Rows
from saltus.tracks.settings import FilterSettings, TrackerSettings
from saltus.tracks.sights import sight
from saltus.tracks.slices import rounds, slices

__all__ = ["Tracker"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]

_CLIMB = 15.0  # m/s: standard deviation of the vertical speed of a new track
_SURPLUS = 1.5  # periods between two right plots, below which none is missing between them
_NEGLIGIBLE = 1e-3  # probability of all other hypotheses of a plot that is taken for right
_STANDING = np.array([-3.0, -2.0, 0.0])  # nats: a plot is less likely a seed's or a tentative track's own


class Tracker:
    """Multimode multitarget tracker over measurements in time order."""

    def __init__(
        self,
        settings: TrackerSettings,
        filters: FilterSettings,
        periods: Sequence[float],
        *,
        use_identity: bool,
        waits: Sequence[float] | None = None,
    ) -> None:
        """Prepare an empty tracker.

        Args:
            settings: association, initiation and deletion.
            filters: the filters of every track.
            periods: update period of each source, s.
            use_identity: let Mode S addresses decide and Mode 3/A codes support the association.
            waits: s between two reports of a target that each source leaves waiting longest, before one counts as
                missed; the update periods if not given.
        """
        self._settings = settings
        self._periods = np.asarray(periods, float)
        self._waits = self._periods if waits is None else np.asarray(waits, float)
        self._use_identity = use_identity
        self._kinematics = make_kinematics(filters)
        self._life = Lifecycle(settings)
        self._gate = Gate(settings, filters, self._periods, use_identity=use_identity)
        # The gate of a track of one plot, at rest with this deviation of speed, ends at the fastest target's.
        self._seed_speed = settings.max_speed / np.sqrt(self._gate.horizontal)
        sojourn = np.array(filters.sojourn_h)
        self._mean_accel_sq = float(sojourn @ np.square(filters.accel_h) / sojourn.sum())
        self._confirmed: list[npt.NDArray[np.int64]] = []

    def run(
        self,
        measurements: Measurements,
        emit: Callable[[Rows], None],
        progress: Callable[[float], None] | None = None,
    ) -> Assignments:
        """Track all measurements.

        Args:
            measurements: in time order.
            emit: receives the published rows, slice by slice.
            progress: receives the share done, 0 to 1.
        """
        self._m, self._emit = measurements, emit
        self._track_id = np.zeros(len(measurements), np.int64)
        self._split = np.zeros(len(measurements), bool)
        self._elsewhere = np.zeros(len(measurements), bool)
        self._speed = np.zeros(len(measurements))  # of the track after each plot that it took, m/s
        self._background = self._densities(measurements)
        self._sources = [self._condition(s) for s in range(len(self._periods))]
        for begin, end in slices(measurements, self._periods):
            self._housekeep(float(measurements.time[begin]))
            sources = measurements.source[begin:end]
            _, first = np.unique(sources, return_index=True)
            for s in sources[np.sort(first)]:  # as they come, whatever number each has
                own, period = begin + np.flatnonzero(sources == s), float(self._periods[s])
                speed = self._settings.max_speed
                for scan in rounds(measurements, own, period, speed, use_identity=self._use_identity):
                    self._scan(scan, float(self._waits[s]))
            if progress is not None:
                progress(end / len(measurements))
        confirmed = np.concatenate([np.zeros(0, np.int64), *self._confirmed])
        return Assignments(self._track_id, self._split, self._elsewhere, np.unique(confirmed), self._sources)

    def _condition(self, source: int) -> SourceCondition:
        own = (self._m.source == source) & np.isfinite(self._m.position[:, 0])
        law = plot_law(self._settings, polar=bool(own.any() and np.isfinite(self._m.ray[own, 0]).all()))
        return SourceCondition(law, self._settings)

    def _densities(self, m: Measurements) -> Background:
        """Clutter and new targets at each measurement."""
        given = self._settings.clutter_density
        return background(m, self._periods) if given is None else flat(len(m), given)

    def _housekeep(self, now: float) -> None:
        """Publish what coasts; drop what is overdue or moves as no target does."""
        rows, expected = self._life.to_coast(now)
        while len(rows):
            self._publish_coasted(rows, expected)
            rows, expected = self._life.to_coast(now)
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
        m, time = self._m, float(self._m.time[index[-1]])
        source = self._sources[m.source[index[0]]]
        prior = source.predicted(time)
        gated = self._gate(self._kinematics, life, m, index, source, prior)
        log_f = gated.copies.score(gated.copy, gated.plan, gated.covs)
        chosen = assign(gated.pairs, self._gain(gated, index, logsumexp(source.weights(prior) + log_f, (1,))[:, 0]))
        rows, plots = gated.pairs.track[chosen], index[gated.pairs.plot[chosen]]
        voice = source.voice(life.id[rows], m.time[plots], life.status[rows] == CONFIRMED)
        weights = source.absorb(time, prior, log_f[chosen], voice)
        p = _normalised(weights + log_f[chosen])
        wrong, fault = source.law.faulty(p)
        again = self._twice_wrong(rows, plots, wrong)
        life.renew(rows[again])
        self._track_id[life.plot[rows[again]]] = life.id[rows[again]]
        new = again | (life.status[rows] == SEED)
        right = ~new & (wrong <= 0.5)
        surplus = self._surplus(rows[right], plots[right])
        self._start(rows[new], plots[new])
        self._update(rows[~new], gated, chosen[~new], weights[~new], p[~new])
        self._enter(rows, plots, wait, gated.height_used[chosen], sound=new | (wrong <= 0.5))
        life.p_fault[rows] = np.where(new, np.nan, wrong)
        # Neither a start nor a fault, nor a degraded source, says whether the filter's innovations are what it thinks.
        d2 = np.where(new | (wrong > 0.5) | source.degraded, np.nan, gated.d2[chosen])
        self._publish(rows, plots, gated.centre[chosen], gated.gate_cov[chosen], d2, np.where(new, 0, fault))
        left = np.ones(len(index), bool)
        left[gated.pairs.plot[chosen]] = False
        used = plots[life.status[rows] == CONFIRMED]
        self._speed[plots] = np.hypot(life.mean[rows, 1], life.mean[rows, 3])
        self._begin(index[left], used, wait)
        far = np.linalg.norm(m.position[plots, :2] - gated.centre[chosen], axis=-1) > self._settings.split_range
        self._also_begin(plots[~new & (wrong > 0.5) & far], used, wait)
        self._seed(self._unnamed(surplus), wait)

    def _twice_wrong(self, rows: _Index, plots: _Index, wrong: _Array) -> npt.NDArray[np.bool_]:
        """Say which tracks have begun wrongly: tentative ones with two faulty plots in a row.

        Likelier than that is one faulty plot among the two they began with. They begin anew, as other tracks, with this
        plot and the one before.
        """
        life = self._life
        twice = (life.status[rows] == TENTATIVE) & (wrong > 0.5) & (life.p_fault[rows] > 0.5)
        return np.asarray(twice & (self._m.time[plots] > life.time[rows]))

    def _surplus(self, rows: _Index, plots: _Index) -> _Index:
        """Return plots that tracks took as faulty while their right ones came one period apart, as if none were.

        A target gives one plot a period, so they are another's. Each begins a track, if none has begun with it.
        """
        m, life = self._m, self._life
        taken, right = life.plot[rows], life.sound[rows]
        one = (m.source[taken] == m.source[plots]) & (m.source[right] == m.source[plots])
        usual = m.time[plots] - m.time[right] < _SURPLUS * self._periods[m.source[plots]]
        taken = taken[(life.p_fault[rows] > 0.5) & one & usual]
        live = life.rows()
        return np.asarray(taken[~np.isin(taken, life.plot[live[life.status[live] == SEED]])])

    def _update(self, rows: _Index, gated: Gated, pairs: _Index, log_weights: _Array, p: _Array) -> None:
        """Condition tracks on the plots chosen, each a mixture of what may be wrong with it.

        A plot that is right but for a probability of 1e-3 moves its track as a right one: the other hypotheses would
        move it by less than that share of its distance.
        """
        mixed = p[:, 0] < 1.0 - _NEGLIGIBLE
        for which, several in ((~mixed, False), (mixed, True)):
            at = pairs[which]
            if not len(at):
                continue
            plan = Plan(*(column[at] for column in gated.plan))
            if several:
                gated.copies.update_mixture(gated.copy[at], plan, gated.covs[at], log_weights[which])
            else:
                gated.copies.update(gated.copy[at], plan)
        self._kinematics.put(rows, gated.copies, gated.copy[pairs])

    def _sight(self, index: _Index) -> None:
        """Absorb the bearings of one source in one slice: they update confirmed tracks, and do nothing else."""
        settings, m, life = self._settings, self._m, self._life
        seen = sight(self._kinematics, life, m, index, self._gate.height)
        seen.copies.update(seen.copy, seen.plan)
        detection = settings.detection_probability
        gain = seen.log_f - np.log(settings.clutter_density_azimuth) + np.log(detection / (1.0 - detection))
        chosen = assign(seen.pairs, gain)
        rows, plots = seen.pairs.track[chosen], index[seen.pairs.plot[chosen]]
        self._kinematics.put(rows, seen.copies, seen.copy[chosen])
        life.sighted(rows, m.time[plots])
        self._track_id[plots] = life.id[rows]
        nothing = np.full(len(rows), np.nan)
        self._publish(rows, plots, seen.centre[chosen], seen.cov[chosen], nothing, np.zeros(len(rows), np.int8))

    def _gain(self, gated: Gated, index: _Index, log_f: _Array) -> _Array:
        """Log-likelihood ratio of "this plot is this track's" against "the track missed and the plot is new"."""
        settings, m, life = self._settings, self._m, self._life
        track, plot = gated.pairs.track, index[gated.pairs.plot]
        detection = settings.detection_probability
        gain = log_f - np.log(self._background.plane[plot]) + np.log(detection / (1.0 - detection))
        has_height, new_height = np.isfinite(m.position[plot, 2]), self._background.height[plot]
        gain = gain + np.where(gated.height_used, np.log((1.0 - settings.altitude_outlier) / new_height), 0.0)
        gain = gain + np.where(has_height & ~gated.height_used, np.log(settings.altitude_outlier), 0.0)
        gain = gain + _STANDING[life.status[track]]
        if self._use_identity:
            gain = gain + identity_gain(life.icao24[track], m.icao24[plot], life.mode3a[track], m.mode3a[plot])
        return np.asarray(gain)

    def _start(self, rows: _Index, plots: _Index) -> None:
        """Begin the filters of tracks that found their second plot."""
        m, life, prior = self._m, self._life, self._settings.height_prior
        if not len(rows):
            return
        first, dt = life.plot[rows], m.time[plots] - life.time[rows]
        way = m.position[plots, :2] - m.position[first, :2]
        velocity = way / np.maximum(dt, np.linalg.norm(way, axis=-1) / self._settings.max_speed)[:, None]
        (z0, R0), (z1, R1) = m.with_height(first, prior), m.with_height(plots, prior)
        start = two_point_start(z0, R0 + m.stamped(first, velocity), z1, R1 + m.stamped(plots, velocity), dt)
        start = with_speed_prior(start, self._settings.max_speed)
        # The target may have manoeuvred between the two.
        start.cov[:, [1, 3], [1, 3]] += self._mean_accel_sq * (0.5 * dt[:, None]) ** 2
        known = np.isfinite(m.position[plots, 2])
        one_height = ~(known & np.isfinite(m.position[first, 2]))
        position, cov = m.with_height(np.where(known, plots, first)[one_height], prior)
        start.mean[one_height, 4], start.mean[one_height, 5] = position[:, 2], 0.0
        start.cov[one_height, 4:, :] = start.cov[one_height, :, 4:] = 0.0
        start.cov[one_height, 4, 4], start.cov[one_height, 5, 5] = cov[:, 2, 2], _CLIMB**2
        self._kinematics.write(rows, start)

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
        life.hit(rows, self._m.time[plots], np.full(len(rows), wait), plots, sound)
        life.has_altitude[rows] |= height_used
        self._note_codes(rows, plots)
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
        rows = self._seed(plots, wait)
        self._track_id[plots] = self._life.id[rows]

    def _also_begin(self, plots: _Index, used: _Index, wait: float) -> None:
        """Begin tracks with plots that others took as faulty: they may be right ones of a target not yet known.

        They stay with the track that took them.
        """
        plots = self._unnamed(plots)
        if len(plots):
            self._seed(plots[~self._split_from(plots, np.setdiff1d(used, plots))], wait)

    def _unnamed(self, plots: _Index) -> _Index:
        """Leave out plots with an address, which settles whose they are."""
        return plots[(self._m.icao24[plots] < 0) | (not self._use_identity)]

    def _split_from(self, plots: _Index, used: _Index) -> npt.NDArray[np.bool_]:
        settings = self._settings
        reach = settings.split_range, np.radians(settings.split_azimuth)
        return self._m.split_from(plots, used, self._speed[used], *reach)

    def _seed(self, plots: _Index, wait: float) -> _Index:
        """Begin a track with every plot."""
        if not len(plots):
            return np.zeros(0, np.intp)
        m, life, settings = self._m, self._life, self._settings
        mean, cov = np.zeros((len(plots), 6)), np.zeros((len(plots), 6, 6))
        mean[:, 0::2], cov[:, 0::2, 0::2] = m.with_height(plots, settings.height_prior)
        cov[:, [1, 3], [1, 3]] = self._seed_speed**2
        cov[:, 5, 5] = _CLIMB**2
        rows = self._kinematics.add(Start(mean, cov))
        life.begin(rows, Birth(m.time[plots], np.full(len(plots), wait), plots, mean, cov))
        life.has_altitude[rows] = np.isfinite(m.position[plots, 2])
        self._note_codes(rows, plots)
        return rows

    def _note_codes(self, rows: _Index, plots: _Index) -> None:
        if self._use_identity:
            m, life = self._m, self._life
            life.icao24[rows] = np.where(m.icao24[plots] >= 0, m.icao24[plots], life.icao24[rows])
            life.mode3a[rows] = np.where(m.mode3a[plots] >= 0, m.mode3a[plots], life.mode3a[rows])
            life.named[rows] = np.where(m.named[plots], plots, life.named[rows])

    def _publish(
        self, rows: _Index, plots: _Index, centre: _Array, gate_cov: _Array, d2: _Array, fault: npt.NDArray[np.int8]
    ) -> None:
        if len(rows):
            life, moments = self._life, self._kinematics.moments(rows)
            life.mean[rows], life.cov[rows] = moments.mean, moments.cov
            codes = life.icao24[rows], life.mode3a[rows], life.named[rows]
            self._emit(
                Rows(
                    life.id[rows],
                    life.time[rows],  # of the state: a late plot is older
                    moments,
                    life.status[rows],
                    life.has_altitude[rows],
                    *codes,
                    plots,
                    centre,
                    gate_cov,
                    d2,
                    life.p_fault[rows],
                    fault.astype(np.int8),
                )
            )

    def _publish_coasted(self, rows: _Index, time: _Array) -> None:
        life, nothing = self._life, np.full(len(rows), -1)
        ahead = self._kinematics.predicted(rows, time - life.time[rows])
        moments = ahead.moments(np.arange(len(rows)))
        self._emit(
            Rows(
                life.id[rows],
                time,
                moments,
                np.full(len(rows), COASTED, np.int8),
                life.has_altitude[rows],
                life.icao24[rows],
                life.mode3a[rows],
                life.named[rows],
                nothing,
                moments.mean[:, [0, 2]],
                moments.cov[:, [[0], [2]], [0, 2]],
                np.full(len(rows), np.nan),
                life.p_fault[rows],
                np.zeros(len(rows), np.int8),
            )
        )


def _normalised(log_p: _Array) -> _Array:
    return np.asarray(np.exp(log_p - logsumexp(log_p, (1,))))
