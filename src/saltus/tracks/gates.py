"""Gates: which plots of a slice may belong to which tracks."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.tracks.associate import Pairs, equal_codes, join_pairs, near_pairs
from saltus.tracks.identity import conflicting
from saltus.tracks.kinematics import Kinematics, Plan
from saltus.tracks.lifecycle import CONFIRMED, SEED, Lifecycle
from saltus.tracks.measurements import Measurements
from saltus.tracks.settings import FilterSettings, TrackerSettings

__all__ = ["Gate", "Gated"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]

_POSITION, _VELOCITY = np.array([0, 2, 4]), np.array([1, 3, 5])
_FAULT_GATE = 0.99
_LATEST = -2.0  # s: how far a plot may lie before its track's last update


class Gated(NamedTuple):
    """Pairs inside their gates, with a copy of each pair's track moved to the plot's time."""

    pairs: Pairs  # rows of the bank, positions in the slice
    plan: Plan  # the measurement of each pair, its height removed where it fell outside
    centre: _Array  # (P, 2), predicted measurement
    gate_cov: _Array  # (P, 2, 2), innovation covariance of the most agile mode: the gate
    d2: _Array  # (P,), horizontal squared Mahalanobis distance to the mixture's prediction
    height_used: npt.NDArray[np.bool_]  # (P,)
    fault: npt.NDArray[np.int8]  # (P,): 0 none, 1 azimuth, 2 range
    copies: Kinematics
    copy: _Index  # (P,): row of each pair among the copies


class Gate:
    """Chi-square gates at a stated probability: horizontal (2 degrees of freedom) and height (1).

    The gate is that of the most agile mode, so that a manoeuvre begun since the last plot stays inside; which mode
    explains the plot is for the likelihoods to say.
    """

    def __init__(self, settings: TrackerSettings, filters: FilterSettings, *, use_identity: bool) -> None:
        """Fix thresholds from the settings."""
        self.horizontal = _chi2_quantile(settings.gate_probability, 2)
        self.height = _chi2_quantile(settings.gate_probability, 1)
        self.fault = _chi2_quantile(_FAULT_GATE, 2)
        self._outlier_azimuth = float(np.radians(settings.outlier_azimuth))
        self._outlier_range, self._outlier_xy = settings.outlier_range, settings.outlier_xy
        self._accel, self._accel_time = max(filters.accel_h), filters.accel_time
        self._use_identity = use_identity

    def __call__(self, kinematics: Kinematics, life: Lifecycle, m: Measurements, index: _Index) -> Gated:
        """Pair tracks with the plots `index` of a slice inside their gates."""
        rows = life.rows()
        near = self._coarse(life, rows, m, index)
        near = self._close(Pairs(rows[near.track], near.plot), life, m, index)
        if self._use_identity:
            same = equal_codes(life.icao24[rows], m.icao24[index])
            near = join_pairs(near, Pairs(rows[same.track], same.plot))
        near = self._admissible(near, life, m, index)
        dt = m.time[index[near.plot]] - life.time[near.track]
        offset = np.minimum(dt, 0.0)  # a plot of another source may come a little late
        copies = kinematics.predicted(near.track, np.maximum(dt, 0.0))
        every = np.arange(len(dt))
        z, R = m.position[index[near.plot]], m.cov[index[near.plot]]
        y, S = _measured(*copies.widest(every), offset, R)
        d2_gate, d2_height = _distances(z - y, S)
        in_gate = d2_gate <= self.horizontal
        trusted = (life.status[near.track] == CONFIRMED) | self._same_address(near, life, m, index)
        R, fault = self._faults(~in_gate & trusted, z - y, S, R, m, index[near.plot])
        inside = np.flatnonzero(in_gate | (fault > 0))
        mixture = copies.moments(every)
        y_mixture, S_mixture = _measured(mixture.mean, mixture.cov, offset, R)
        d2, _ = _distances(z - y_mixture, S_mixture)
        height_used = np.isfinite(z[:, 2]) & (d2_height <= self.height)
        z = z.copy()
        z[~height_used, 2] = np.nan
        return Gated(
            Pairs(near.track[inside], near.plot[inside]),
            Plan(z[inside], R[inside] * m.inflation[index[near.plot[inside]], None, None], offset[inside]),
            y[inside, :2],
            S[inside, :2, :2],
            d2[inside],
            height_used[inside],
            fault[inside],
            copies,
            inside,
        )

    def _faults(
        self, candidate: npt.NDArray[np.bool_], nu: _Array, S: _Array, R: _Array, m: Measurements, plot: _Index
    ) -> tuple[_Array, npt.NDArray[np.int8]]:
        """Explain plots outside the gate of a confirmed track by a faulty azimuth or range where that fits."""
        fault = np.zeros(len(nu), np.int8)
        at = np.flatnonzero(candidate)
        wide = m.faulty(plot[at], self._outlier_azimuth, self._outlier_range, self._outlier_xy)
        S_fault = (S[at] - R[at])[:, None] + wide
        d2 = np.stack([_distances(nu[at], S_fault[:, k])[0] for k in (0, 1)], axis=-1)
        log_f = -0.5 * (d2 + np.log(np.linalg.det(S_fault[..., :2, :2])))
        best = log_f.argmax(-1)
        row = np.arange(len(at))
        fits = d2[row, best] <= self.fault
        fault[at[fits]] = 1 + best[fits]
        R = R.copy()
        R[at[fits]] = wide[row, best][fits]
        return R, fault

    def _coarse(self, life: Lifecycle, rows: _Index, m: Measurements, index: _Index) -> Pairs:
        """Pair by a radius about the position in mid-slice that no plot inside a gate can exceed."""
        middle, half = _span(m.time[index])
        dt = np.maximum(middle - life.time[rows], 0.0)
        velocity = life.mean[rows][:, _VELOCITY[:2]]
        position = life.mean[rows][:, _POSITION[:2]] + dt[:, None] * velocity
        reach = self._reach(life, rows, dt + half, float(self._spread(m, index).max()))
        reach = reach + np.where(life.status[rows] == CONFIRMED, float(self._astray(m, index).max()), 0.0)
        return near_pairs(position, reach + np.hypot(velocity[:, 0], velocity[:, 1]) * half, m.position[index, :2])

    def _close(self, pairs: Pairs, life: Lifecycle, m: Measurements, index: _Index) -> Pairs:
        """Keep the pairs that the same radius allows at the plot's own time."""
        track, plot = pairs.track, index[pairs.plot]
        dt = m.time[plot] - life.time[track]
        position = life.mean[track][:, _POSITION[:2]] + dt[:, None] * life.mean[track][:, _VELOCITY[:2]]
        reach = self._reach(life, track, np.abs(dt), self._spread(m, plot))
        reach = reach + np.where(life.status[track] == CONFIRMED, self._astray(m, plot), 0.0)
        keep = np.linalg.norm(m.position[plot, :2] - position, axis=-1) <= reach
        return Pairs(track[keep], pairs.plot[keep])

    def _reach(self, life: Lifecycle, rows: _Index, dt: _Array, plot_variance: float | _Array) -> _Array:
        """Radius of the gate after dt, from the last state and the hardest manoeuvre since."""
        cov = life.cov[rows]
        variance = cov[:, 0, 0] + cov[:, 2, 2] + dt**2 * (cov[:, 1, 1] + cov[:, 3, 3])
        variance += 2.0 * dt * np.abs(cov[:, 0, 1] + cov[:, 2, 3])
        variance += self._accel**2 * dt**3 * (0.5 * dt + 2.0 / 3.0 * self._accel_time)
        return np.asarray(np.sqrt(self.horizontal * (variance + plot_variance)))

    def _spread(self, m: Measurements, plot: _Index) -> _Array:
        return np.asarray(m.cov[plot, 0, 0] + m.cov[plot, 1, 1])

    def _astray(self, m: Measurements, plot: _Index) -> _Array:
        """How far a faulty plot may lie."""
        far = np.hypot(m.ray[plot, 0], m.ray[plot, 1])
        wrong = np.hypot(self._outlier_range, self._outlier_azimuth * far)
        return np.asarray(np.sqrt(self.fault) * np.where(np.isnan(far), 1.5 * self._outlier_xy, wrong))

    def _admissible(self, pairs: Pairs, life: Lifecycle, m: Measurements, index: _Index) -> Pairs:
        """Drop pairs of contradicting addresses, and plots too old for the track."""
        plot = index[pairs.plot]
        dt = m.time[plot] - life.time[pairs.track]
        keep = np.where(life.status[pairs.track] == SEED, dt > 0.0, dt > _LATEST)
        if self._use_identity:
            keep &= ~conflicting(life.icao24[pairs.track], m.icao24[plot])
            keep &= (life.icao24[pairs.track] >= 0) | ~life.holds(m.icao24[plot])  # an address goes to its own track
        return Pairs(pairs.track[keep], pairs.plot[keep])

    def _same_address(self, pairs: Pairs, life: Lifecycle, m: Measurements, index: _Index) -> npt.NDArray[np.bool_]:
        known = life.icao24[pairs.track] >= 0
        return np.asarray(self._use_identity & known & (life.icao24[pairs.track] == m.icao24[index[pairs.plot]]))


def _chi2_quantile(probability: float, dof: int) -> float:
    """Quantile of the chi-square law (scipy.stats says the same, and takes a second to import)."""
    from scipy.special import gammaincinv

    return float(2.0 * gammaincinv(0.5 * dof, probability))


def _span(time: _Array) -> tuple[float, float]:
    return 0.5 * float(time[0] + time[-1]), 0.5 * float(time[-1] - time[0])


def _measured(mean: _Array, P: _Array, offset: _Array, R: _Array) -> tuple[_Array, _Array]:
    """Return the measurement predicted `offset` seconds from the rows' time, and its innovation covariance."""
    t = offset[:, None, None]
    pp, pv, vv = (
        P[:, _POSITION[:, None], _POSITION],
        P[:, _POSITION[:, None], _VELOCITY],
        P[:, _VELOCITY[:, None], _VELOCITY],
    )
    y = mean[:, _POSITION] + offset[:, None] * mean[:, _VELOCITY]
    return y, pp + t * (pv + pv.swapaxes(-1, -2)) + t * t * vv + R


def _distances(nu: _Array, S: _Array) -> tuple[_Array, _Array]:
    """Return the squared Mahalanobis distances of plane position and of height."""
    det = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2
    a, b = nu[:, 0], nu[:, 1]
    d2 = (S[:, 1, 1] * a * a - 2.0 * S[:, 0, 1] * a * b + S[:, 0, 0] * b * b) / det
    return d2, np.nan_to_num(nu[:, 2] ** 2 / S[:, 2, 2], nan=np.inf)
