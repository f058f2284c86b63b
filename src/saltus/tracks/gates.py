"""Gates: which plots of a slice may belong to which tracks."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.tracks.associate import Pairs, equal_codes, join_pairs, near_pairs, nearest_pairs
from saltus.tracks.channel import MOTION, Plan
from saltus.tracks.colour import NO_SOURCE
from saltus.tracks.faults import SourceCondition, rays
from saltus.tracks.identity import conflicting
from saltus.tracks.kinematics import Kinematics
from saltus.tracks.lifecycle import CONFIRMED, SEED, Lifecycle
from saltus.tracks.measurements import Measurements
from saltus.tracks.range_rate import with_range_rates
from saltus.tracks.settings import FilterSettings, TrackerSettings

__all__ = ["Ahead", "Gate", "Gated", "distances", "predict"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]

_POSITION, _VELOCITY = np.array([0, 2, 4]), np.array([1, 3, 5])
_FAULT_GATE = 0.99
_SOONEST = 0.75  # of the update period: what comes sooner after a first plot is taken for a neighbour's
_COARSE = 8  # times the candidates of a track: those nearest in metres, of which the nearest in deviations are kept
_LATEST = -2.0  # s: how far a plot may lie before its track's last update


class Gated(NamedTuple):
    """Pairs of tracks and reports, with a copy of each pair's track moved to the report's time."""

    pairs: Pairs  # rows of the bank, positions in the slice
    plan: Plan  # the measurement of each pair, its height removed where it fell outside
    covs: _Array  # (P, h, m, m): its covariance under every hypothesis of its source
    log_scale: _Array  # (P,): what makes a density of `plan` one of the report's own units
    centre: _Array  # (P, 2), predicted position
    gate_cov: _Array  # (P, 2, 2), innovation covariance of the most agile mode: the gate
    d2: _Array  # (P,), horizontal squared Mahalanobis distance to the mixture's prediction
    height_used: npt.NDArray[np.bool_]  # (P,)
    copies: Kinematics
    copy: _Index  # (P,): row of each pair among the copies

    def score(self) -> _Array:
        """Return log densities of the reports under every hypothesis, (P, h)."""
        return self.log_scale[:, None] + self.copies.score(self.copy, self.plan, self.covs)


class Ahead(NamedTuple):
    """Tracks moved to the times of reports of theirs."""

    copies: Kinematics
    offset: _Array  # (P,) s, <= 0: how far a report lies before its track's time
    late: _Array  # (P, 3, 3): what the error of its time stamp adds to a report's covariance
    lasting: _Array  # (P, 2, slots): how states of lasting errors enter it
    carried: _Array  # (P, 2, 2): covariance of the report's that these stand for
    extra: _Array  # (P, 3, 3): what else does, whatever is wrong with the report
    nu: _Array  # (P, 3): innovation of the most agile mode
    S: _Array  # (P, 3, 3): its covariance
    centre: _Array  # (P, 2): predicted position


class Gate:
    """Chi-square gates at a stated probability: horizontal (2 degrees of freedom) and height (1).

    The gate is that of the most agile mode, wide enough for turns, so that a manoeuvre begun since the last plot stays
    inside; which mode explains the plot is for the likelihoods to say.
    """

    def __init__(
        self, settings: TrackerSettings, filters: FilterSettings, periods: _Array, *, use_identity: bool
    ) -> None:
        """Fix thresholds from the settings and the update periods of the sources, s."""
        self._periods = periods
        self.horizontal = _chi2_quantile(settings.gate_probability, 2)
        self.height = _chi2_quantile(settings.gate_probability, 1)
        self.fault = _chi2_quantile(_FAULT_GATE, 2)
        self.fault_bearing = _chi2_quantile(_FAULT_GATE, 1)
        self._growth = settings.degraded_noise**2
        self._accel, self._accel_time = max(filters.accel_h), filters.accel_time
        self._turn = float(np.radians(max(filters.turn_rate, default=0.0)))
        self._use_identity, self._most = use_identity, settings.most_candidates
        # Against any rate that a target may have; one left out is wrong, whoever's the plot is.
        self._rates = np.log(
            [2.0 * settings.max_speed * (1.0 - settings.range_rate_outlier), settings.range_rate_outlier]
        )

    def __call__(
        self,
        kinematics: Kinematics,
        life: Lifecycle,
        m: Measurements,
        index: _Index,
        source: SourceCondition,
        prior: _Array,
    ) -> Gated:
        """Pair tracks with the plots `index` of a slice inside their gates.

        Args:
            kinematics: the filters of all tracks.
            life: their lifecycle.
            m: all measurements.
            index: plots of one source in one slice.
            source: the condition of that source, and what may be wrong with its plots.
            prior: log probabilities of the conditions.
        """
        near = self._near(life, m, index, source, prior)
        plot = index[near.plot]
        ahead = predict(kinematics, life, m, near.track, plot, np.zeros((len(plot), 3, 3)))
        d2, _ = distances(ahead.nu, ahead.S)
        trusted = (life.status[near.track] == CONFIRMED) | self._same_address(near, life, m, index)
        inside = np.flatnonzero((d2 <= self.horizontal) | self._faulty(d2, trusted, ahead, m, plot, source, prior))
        return self._measured(ahead, near, plot, inside, m, source)

    def given(
        self,
        kinematics: Kinematics,
        life: Lifecycle,
        m: Measurements,
        rows: _Index,
        plots: _Index,
        source: SourceCondition,
        extra: _Array,
    ) -> Gated:
        """Measure tracks by plots that are known to be theirs; a height outside its gate is left out all the same.

        Args:
            kinematics: the filters of all tracks.
            life: their lifecycle.
            m: all measurements.
            rows: of tracks, (P,).
            plots: the one of each, of one source.
            source: the condition of that source.
            extra: covariances that plots have beyond those of `m`, (P, 3, 3).
        """
        every = np.arange(len(rows))
        ahead = predict(kinematics, life, m, rows, plots, extra)
        return self._measured(ahead, Pairs(rows, every), plots, every, m, source)

    def _measured(
        self, ahead: Ahead, pairs: Pairs, plot: _Index, inside: _Index, m: Measurements, source: SourceCondition
    ) -> Gated:
        """What is left of pairs inside their gates."""
        plot, offset = plot[inside], ahead.offset[inside]
        position, late, extra = m.position[plot].copy(), ahead.late[inside], ahead.extra[inside]
        lasting, carried = ahead.lasting[inside], ahead.carried[inside]
        R = m.cov[plot] + late + extra
        R[:, :2, :2] -= carried
        y, S = _innovation(*ahead.copies.mixture(inside), offset, lasting, R)
        d2, _ = distances(position - y, S)
        _, d2_height = distances(ahead.nu[inside], ahead.S[inside])
        height_used = np.isfinite(position[:, 2]) & (d2_height <= self.height)
        position[~height_used, 2] = np.nan
        plan, log_scale = Plan.of_positions(position, offset, lasting), np.zeros(len(inside))
        covs = source.law.covariances(m, plot) + (late + extra)[:, None]
        covs[..., :2, :2] += self._told_again(ahead.copies, m, plot, carried)[:, None]
        if np.isfinite(m.range_rate[plot]).any():
            plan, covs, used = with_range_rates(plan, covs, ahead.copies, inside, m, plot, self.height)
            log_scale += np.where(np.isnan(m.range_rate[plot]), 0.0, np.where(used, *self._rates))
        return Gated(
            Pairs(pairs.track[inside], pairs.plot[inside]),
            plan,
            covs,
            log_scale,
            ahead.centre[inside],
            ahead.S[inside, :2, :2],
            d2,
            height_used,
            ahead.copies,
            inside,
        )

    def _told_again(self, copies: Kinematics, m: Measurements, plot: _Index, carried: _Array) -> _Array:
        """What lasting errors add to covariances (k, 2, 2): less what states stand for, and more without these."""
        if not m.lasting[plot].any():
            return -carried
        again = copies.colours.again(int(m.source[plot[0]]))
        return again * (m.lasting[plot] @ m.lasting[plot].swapaxes(1, 2) - carried) - carried

    def _near(self, life: Lifecycle, m: Measurements, index: _Index, source: SourceCondition, prior: _Array) -> Pairs:
        """Pair what cheap bounds allow."""
        rows, live = life.rows(), source.live(prior)
        bounds = _Bounds(
            self._growth if source.law.condition[live].any() else 1.0,
            source.law.outlier if source.law.fault.any() else np.zeros(1),
        )
        near = self._coarse(life, rows, m, index, bounds)
        near = self._close(Pairs(rows[near.track], near.plot), life, m, index, bounds)
        if self._use_identity:
            same = equal_codes(life.icao24[rows], m.icao24[index])
            near = join_pairs(near, Pairs(rows[same.track], same.plot))
        return self._admissible(near, life, m, index)

    def _faulty(
        self,
        d2: _Array,
        trusted: npt.NDArray[np.bool_],
        ahead: Ahead,
        m: Measurements,
        plot: _Index,
        source: SourceCondition,
        prior: _Array,
    ) -> npt.NDArray[np.bool_]:
        """Say which pairs outside the plain gate lie inside that of a fault, or of a condition to be reckoned with.

        A fault of the plot's own is for confirmed tracks, and those of its address.
        """
        live, out = source.live(prior), np.zeros(len(d2), bool)
        lasting = source.law.condition[live].any()
        at = np.flatnonzero((d2 > self.horizontal) & (trusted | lasting))
        if len(live) == 1 or not len(at):
            return out
        predicted = ahead.S[at] - m.cov[plot[at]]  # what states of lasting errors stand for stays taken off
        wide = predicted[:, None] + source.law.covariances(m, plot[at], live)
        k, h = wide.shape[:2]
        d2_wide = distances(np.repeat(ahead.nu[at], h, axis=0), wide.reshape(-1, 3, 3))[0].reshape(k, h)
        own = source.law.fault[live] > 0
        out[at] = ((d2_wide <= np.where(own, self.fault, self.horizontal)) & (trusted[at, None] | ~own)).any(axis=1)
        return out

    def _coarse(self, life: Lifecycle, rows: _Index, m: Measurements, index: _Index, bounds: "_Bounds") -> Pairs:
        """Pair by a radius about the position in mid-slice that no plot inside a gate can exceed."""
        middle, half = _span(m.time[index])
        dt = np.maximum(middle - life.time[rows], 0.0)
        velocity = life.mean[rows][:, _VELOCITY[:2]]
        position = life.mean[rows][:, _POSITION[:2]] + dt[:, None] * velocity
        speed = np.hypot(velocity[:, 0], velocity[:, 1])
        variance = float(bounds.spread(m, index).max()) + (float(m.jitter[index].max()) * speed) ** 2
        reach = self._reach(life, rows, dt + half, variance)
        reach = reach + np.where(life.status[rows] == CONFIRMED, float(self._astray(m, index, bounds).max()), 0.0)
        return near_pairs(position, reach + speed * half, m.position[index, :2], _COARSE * self._most)

    def _close(self, pairs: Pairs, life: Lifecycle, m: Measurements, index: _Index, bounds: "_Bounds") -> Pairs:
        """Keep the pairs that the same radius allows at the plot's own time, the nearest of a track that has many."""
        track, plot = pairs.track, index[pairs.plot]
        dt = m.time[plot] - life.time[track]
        velocity = life.mean[track][:, _VELOCITY[:2]]
        position = life.mean[track][:, _POSITION[:2]] + dt[:, None] * velocity
        variance = bounds.spread(m, plot) + m.jitter[plot] ** 2 * np.square(velocity).sum(axis=1)
        reach = self._reach(life, track, np.abs(dt), variance)
        reach = reach + np.where(life.status[track] == CONFIRMED, self._astray(m, plot, bounds), 0.0)
        nu = m.position[plot, :2] - position
        keep = np.linalg.norm(nu, axis=-1) <= reach
        seed = life.status[track] == SEED
        many = np.bincount(track[keep], minlength=1 + int(track.max(initial=0)))[track] > self._most
        weighed = np.flatnonzero(keep & (seed | many))
        d2 = np.zeros(len(track))
        d2[weighed] = self._apart(
            nu[weighed], life.cov[track[weighed]], bounds.growth * m.cov[plot[weighed]], dt[weighed]
        )
        # The gate of a track of one plot is the widest of all, and of the hardest mode: most of its radius is outside.
        keep &= ~seed | (d2 <= self.horizontal * (1.0 + 1e-9))
        keep[keep] = nearest_pairs(Pairs(track[keep], pairs.plot[keep]), d2[keep], self._most)
        return Pairs(track[keep], pairs.plot[keep])

    def _apart(self, nu: _Array, P: _Array, R: _Array, dt: _Array) -> _Array:
        """Squared distances, in deviations, of innovations (k, 2) of tracks that move as the hardest mode lets them."""
        S = np.zeros((len(nu), 3, 3))
        t = dt[:, None, None]
        pp, pv, vv = P[:, 0:3:2, 0:3:2], P[:, 0:3:2, 1:4:2], P[:, 1:4:2, 1:4:2]
        hardest = self._accel**2 * dt**3 * (0.25 * dt + self._accel_time / 3.0)
        S[:, :2, :2] = (
            pp + t * (pv + pv.swapaxes(1, 2)) + t * t * vv + R[:, :2, :2] + hardest[:, None, None] * np.eye(2)
        )
        S[:, 2, 2] = 1.0
        return distances(np.column_stack([nu, np.zeros(len(nu))]), S)[0]

    def _reach(self, life: Lifecycle, rows: _Index, dt: _Array, plot_variance: float | _Array) -> _Array:
        """Radius of the gate after dt, from the last state and the hardest manoeuvre since."""
        cov = life.cov[rows]
        variance = cov[:, 0, 0] + cov[:, 2, 2] + dt**2 * (cov[:, 1, 1] + cov[:, 3, 3])
        variance += 2.0 * dt * np.abs(cov[:, 0, 1] + cov[:, 2, 3])
        variance += self._accel**2 * dt**3 * (0.5 * dt + 2.0 / 3.0 * self._accel_time)
        aside = 0.5 * self._turn * dt**2  # per m/s: how far a turn leads off the straight
        variance += aside**2 * np.square(life.mean[rows][:, _VELOCITY[:2]]).sum(axis=1)
        return np.asarray(np.sqrt(self.horizontal * (variance + plot_variance)))

    def _astray(self, m: Measurements, plot: _Index, bounds: "_Bounds") -> _Array:
        return np.asarray(np.sqrt(self.fault) * bounds.astray(m, plot))

    def _admissible(self, pairs: Pairs, life: Lifecycle, m: Measurements, index: _Index) -> Pairs:
        """Drop pairs of contradicting addresses, plots too old for the track, and those too soon after its first.

        Where targets report at times of their own, a neighbour's plot comes before the next one of a new target.
        """
        plot = index[pairs.plot]
        dt = m.time[plot] - life.time[pairs.track]
        soonest = np.where(m.source[plot] == life.source[pairs.track], _SOONEST * self._periods[m.source[plot]], 0.0)
        late = (dt >= soonest) | self._same_address(pairs, life, m, index)
        keep = np.where(life.status[pairs.track] == SEED, (dt > 0.0) & late, dt > _LATEST)
        if self._use_identity:
            keep &= ~conflicting(life.icao24[pairs.track], m.icao24[plot])
            keep &= (life.icao24[pairs.track] >= 0) | ~life.holds(m.icao24[plot])  # an address goes to its own track
        return Pairs(pairs.track[keep], pairs.plot[keep])

    def _same_address(self, pairs: Pairs, life: Lifecycle, m: Measurements, index: _Index) -> npt.NDArray[np.bool_]:
        known = life.icao24[pairs.track] >= 0
        return np.asarray(self._use_identity & known & (life.icao24[pairs.track] == m.icao24[index[pairs.plot]]))


class _Bounds(NamedTuple):
    """What the plots of a source may be at the worst."""

    growth: float  # of the variance, in the conditions to be reckoned with
    outlier: _Array  # deviations of faults, rad and m

    def spread(self, m: Measurements, plot: _Index) -> _Array:
        return np.asarray(self.growth * (m.cov[plot, 0, 0] + m.cov[plot, 1, 1]))

    def astray(self, m: Measurements, plot: _Index) -> _Array:
        """Deviation of a faulty plot."""
        if len(self.outlier) == 1:
            return np.full(len(plot), np.sqrt(2.0) * self.outlier[0])
        return np.asarray(np.hypot(self.outlier[1], self.outlier[0] * np.hypot(*rays(m, plot, self.outlier).T)))


def _chi2_quantile(probability: float, dof: int) -> float:
    """Quantile of the chi-square law (scipy.stats says the same, and takes a second to import)."""
    from scipy.special import gammaincinv

    return float(2.0 * gammaincinv(0.5 * dof, probability))


def _span(time: _Array) -> tuple[float, float]:
    return 0.5 * float(time[0] + time[-1]), 0.5 * float(time[-1] - time[0])


def predict(
    kinematics: Kinematics, life: Lifecycle, m: Measurements, track: _Index, plot: _Index, extra: _Array
) -> Ahead:
    """Move copies of tracks to the times of plots, and say what the most agile mode thinks of these.

    Args:
        kinematics: the filters of all tracks.
        life: their lifecycle.
        m: all measurements.
        track: rows, (P,), repeats allowed.
        plot: the one to be compared with each, all of one source.
        extra: covariances that plots have beyond those of `m` and of their time stamps, (P, 3, 3).
    """
    dt, source = m.time[plot] - life.time[track], int(m.source[plot[0]]) if len(plot) else NO_SOURCE
    offset = np.minimum(dt, 0.0)  # a plot of another source may come a little late
    copies = kinematics.predicted(track, np.maximum(dt, 0.0), source, m.time[plot])
    lasting = copies.colours.columns(source, m.lasting[plot])
    carried = copies.colours.carried(source, m.lasting[plot])
    late = m.stamped(plot, life.mean[track][:, _VELOCITY[:2]])
    R = m.cov[plot] + late + extra
    R[:, :2, :2] -= carried
    y, S = _innovation(*copies.widest(np.arange(len(dt))), offset, lasting, R)
    return Ahead(copies, offset, late, lasting, carried, extra, m.position[plot] - y, S, y[:, :2])


def _innovation(mean: _Array, P: _Array, offset: _Array, lasting: _Array, R: _Array) -> tuple[_Array, _Array]:
    """Return the measurement predicted `offset` seconds from the rows' time, and its innovation covariance."""
    t = offset[:, None, None]
    pp, pv, vv = (
        P[:, _POSITION[:, None], _POSITION],
        P[:, _POSITION[:, None], _VELOCITY],
        P[:, _VELOCITY[:, None], _VELOCITY],
    )
    y = mean[:, _POSITION] + offset[:, None] * mean[:, _VELOCITY]
    S = pp + t * (pv + pv.swapaxes(-1, -2)) + t * t * vv + R
    if lasting.any():
        L = lasting.swapaxes(1, 2)
        cross = (P[:, _POSITION, MOTION:] + t * P[:, _VELOCITY, MOTION:]) @ L
        y[:, :2] += (lasting @ mean[:, MOTION:, None])[..., 0]
        S[:, :, :2] += cross
        S[:, :2] += cross.swapaxes(1, 2)
        S[:, :2, :2] += lasting @ P[:, MOTION:, MOTION:] @ L
    return y, S


def distances(nu: _Array, S: _Array) -> tuple[_Array, _Array]:
    """Return the squared Mahalanobis distances of plane position and of height."""
    det = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2
    a, b = nu[:, 0], nu[:, 1]
    d2 = (S[:, 1, 1] * a * a - 2.0 * S[:, 0, 1] * a * b + S[:, 0, 0] * b * b) / det
    height = nu[:, 2] ** 2 / S[:, 2, 2]
    return d2, np.where(np.isnan(height), np.inf, height)
