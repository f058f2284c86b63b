"""The radar experiment: an object that turns and climbs hard, seen by a coarse radar, and six filters that follow it.

Repeated with fresh measurement errors; the trajectory is fixed. Horizontal and vertical two-mode filters side by
side (decomposition), a joint filter of all six states, Kalman filters for one mode each, and one that is told the
true mode. Predictions are those made one scan before.

Source: Zhuk, Kozheshkurt, Yuzefovich (2009); theory notes on Cartesian radar filtering, sections 2-4.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus import montecarlo
from saltus.errors import ModelError
from saltus.filters import Estimates, imm_filter, steps
from saltus.geo import spherical_to_cartesian
from saltus.shapes import Bool, Float
from saltus.simulate import radar_paper_trajectory

__all__ = ["FILTERS", "SIGMA", "Followed", "Scene", "Trial", "follow", "run_radar", "scene", "two_point_start"]

FILTERS = ("adaptive", "kalman_steady", "kalman_manoeuvre", "clairvoyant", "joint")
SIGMA = (300.0, np.radians(0.166), np.radians(0.166))  # range (m), azimuth, elevation (rad)
_PERIOD = 10.0  # s
_ACCEL_H = np.array([3.0, 35.0])  # m/s^2 per horizontal axis: steady, manoeuvre
_ACCEL_V = np.array([3.0, 25.0])
_TRANS = np.array([[0.9, 0.1], [0.1, 0.9]])
_START = 2  # the scans before it start the filters
_RUNS_AT_ONCE = 500  # about 250 MB

_Array = npt.NDArray[np.float64]


class Scene(NamedTuple):
    """The truth at the filtered scans, T of them; `scan` is its number."""

    scan: npt.NDArray[np.int64]
    time: Float[np.ndarray, " t"]  # s
    position: Float[np.ndarray, "t 3"]  # m
    turning: Bool[np.ndarray, " t"]  # the scan ends a horizontal manoeuvre interval
    climbing: Bool[np.ndarray, " t"]


class Trial(NamedTuple):
    """What B runs gave at T scans; filters in the order of FILTERS, positions x, y, z in m."""

    measurement: Float[np.ndarray, "b t 3"]
    noise_cov: Float[np.ndarray, "b t 3 3"]
    estimate: Float[np.ndarray, "b f t 3"]
    prediction: Float[np.ndarray, "b f t 3"]
    prediction_sd: Float[np.ndarray, "b f t 3"]
    prob_manoeuvre: Float[np.ndarray, "b t 2"]  # horizontal, vertical, of the adaptive filter


class Followed(NamedTuple):
    """What one filter said of positions, m axes at T scans of B runs; P(modes) after each scan."""

    estimate: Float[np.ndarray, "b t m"]
    prediction: Float[np.ndarray, "b t m"]  # one scan before
    prediction_sd: Float[np.ndarray, "b t m"]
    probs: Float[np.ndarray, "b t *modes"]


def scene() -> Scene:
    """Return the truth at the scans that are filtered (the first two only start the filters)."""
    truth = radar_paper_trajectory()
    at = slice(_START, None)
    return Scene(
        np.arange(len(truth.time))[at], truth.time[at], truth.position[at], truth.turning[at], truth.climbing[at]
    )


def run_radar(n_runs: int, seed: int, progress: Callable[[int, int], None] | None = None) -> Trial:
    """Repeat the experiment.

    Args:
        n_runs: number of runs, each with its own measurement errors.
        seed: root of the runs' generators.
        progress: called with (runs done, all runs).

    Returns:
        Measurements and every filter's estimates and predictions, one row of axis 0 per run.
    """
    return montecarlo.run(_trial, n_runs, seed, batch=_RUNS_AT_ONCE, progress=progress)


def _trial(rngs: Sequence[np.random.Generator]) -> Trial:
    truth = scene()
    xyz = radar_paper_trajectory().position
    z, R = _measure(xyz, rngs)
    (zh, Rh), (zv, Rv) = (z[..., :2], R[..., :2, :2]), (z[..., 2:], R[..., 2:, 2:])
    Qh, Qv = (np.stack([_process_noise([s] * dims) for s in sigmas]) for sigmas, dims in ((_ACCEL_H, 2), (_ACCEL_V, 1)))
    joint = np.array([[_process_noise([a, a, c]) for c in _ACCEL_V] for a in _ACCEL_H])
    turning, climbing = truth.turning.astype(int), truth.climbing.astype(int)

    adaptive = [follow(zh, Rh, Qh, [_TRANS]), follow(zv, Rv, Qv, [_TRANS])]
    answers = [
        _side_by_side(adaptive),
        _side_by_side([follow(zh, Rh, Qh[0], []), follow(zv, Rv, Qv[0], [])]),
        _side_by_side([follow(zh, Rh, Qh[1], []), follow(zv, Rv, Qv[1], [])]),
        _side_by_side([follow(zh, Rh, Qh[turning], []), follow(zv, Rv, Qv[climbing], [])]),
        follow(z, R, joint, [_TRANS, _TRANS]),
    ]
    return Trial(
        measurement=z[:, _START:],
        noise_cov=R[:, _START:],
        estimate=np.stack([a.estimate for a in answers], axis=1),
        prediction=np.stack([a.prediction for a in answers], axis=1),
        prediction_sd=np.stack([a.prediction_sd for a in answers], axis=1),
        prob_manoeuvre=np.stack([a.probs[..., 1] for a in adaptive], axis=-1),
    )


def _measure(xyz: _Array, rngs: Sequence[np.random.Generator]) -> tuple[_Array, _Array]:
    """Measure range, azimuth and elevation with errors; convert at the measured values."""
    ground = np.hypot(xyz[:, 0], xyz[:, 1])
    exact = np.stack([np.hypot(ground, xyz[:, 2]), np.arctan2(xyz[:, 1], xyz[:, 0]), np.arctan2(xyz[:, 2], ground)], -1)
    seen = exact + np.array(SIGMA) * np.stack([rng.normal(size=exact.shape) for rng in rngs])
    return spherical_to_cartesian(seen[..., 0], seen[..., 1], seen[..., 2], *SIGMA)


def two_point_start(z: npt.ArrayLike, R: npt.ArrayLike, period: float) -> tuple[_Array, _Array]:
    """Start position and velocity from two positions.

    x = z_1,  v = (z_1 - z_0) / T,  cov = [[R_1, R_1/T], [R_1/T, (R_0 + R_1)/T^2]] for every pair of axes

    Args:
        z: the two positions, (..., 2, m), m.
        R: their covariances, (..., 2, m, m).
        period: time between them, s.

    Returns:
        Mean (..., 2m) and covariance (..., 2m, 2m) of the state (x, vx, y, vy, ...) at the second position.

    Source: theory notes on Cartesian radar filtering, section 3.
    """
    z, R = np.asarray(z, np.float64), np.asarray(R, np.float64)
    m = z.shape[-1]
    mean = np.stack([z[..., 1, :], (z[..., 1, :] - z[..., 0, :]) / period], -1).reshape(*z.shape[:-2], 2 * m)
    pp, pv, vv = R[..., 1, :, :], R[..., 1, :, :] / period, (R[..., 0, :, :] + R[..., 1, :, :]) / period**2
    blocks = np.stack([np.stack([pp, pv], -1), np.stack([pv, vv], -1)], -2)  # (..., axis, axis, x|v, x|v)
    return mean, np.moveaxis(blocks, -2, -3).reshape(*z.shape[:-2], 2 * m, 2 * m)


def _process_noise(sigmas: list[float]) -> _Array:
    """Return G G' for accelerations constant within a scan: state (x, vx, y, vy, ...)."""
    g = np.array([_PERIOD**2 / 2, _PERIOD])
    return np.kron(np.diag(np.square(sigmas)), np.outer(g, g))


def follow(z: npt.ArrayLike, R: npt.ArrayLike, Q: npt.ArrayLike, trans: Sequence[npt.NDArray[np.float64]]) -> Followed:
    """Filter positions from scan 2 on, started by scans 0 and 1, and predict every scan from the one before.

    Prediction: mix and propagate the belief of the scan before, mean and covariance of that mixture.

    Args:
        z: measured positions, (B, 2 + T, m), m.
        R: their covariances, (B, 2 + T, m, m).
        Q: process noise of the state (x, vx, ...) per mode, (M1, ..., 2m, 2m); without chains also (T, 2m, 2m).
        trans: one matrix per chain; none gives a Kalman filter.

    Returns:
        Estimates, predictions and mode probabilities at the T scans.

    Raises:
        ModelError: shapes that do not fit, as `imm_filter`.

    Source: theory notes on Cartesian radar filtering, sections 2 and 3.
    """
    z, R, Q = (np.asarray(a, np.float64) for a in (z, R, Q))
    m, modes = z.shape[-1], (1,) * len(trans)
    F = np.kron(np.eye(m), np.array([[1.0, _PERIOD], [0.0, 1.0]]))
    H = np.kron(np.eye(m), np.array([1.0, 0.0]))
    mean0, cov0 = two_point_start(z[:, :_START], R[:, :_START], _PERIOD)
    mean0, cov0 = mean0.reshape(-1, *modes, 2 * m), cov0.reshape(-1, *modes, 2 * m, 2 * m)
    probs0 = np.full(tuple(len(t) for t in trans), 1.0 / np.prod([len(t) for t in trans]))
    z, R = z[:, _START:], R[:, _START:]
    est = imm_filter(
        z,
        F=F.reshape(*modes, 2 * m, 2 * m),
        Q=Q,
        H=H.reshape(*modes, m, 2 * m),
        R=R.reshape(*R.shape[:2], *modes, m, m),
        trans=trans,
        mean0=mean0,
        cov0=cov0,
        probs0=probs0,
        per_mode=True,
    )
    mean, cov = _predict(est, steps.Belief(np.asarray(np.log(probs0)), mean0, cov0), F, Q, trans)
    sd = np.sqrt(np.diagonal(H @ cov @ H.T, axis1=-2, axis2=-1))
    return Followed(est.mean @ H.T, mean @ H.T, sd, est.probs)


def _predict(
    est: Estimates, prior: steps.Belief, F: _Array, Q: _Array, trans: Sequence[_Array]
) -> tuple[_Array, _Array]:
    """Predict every scan, mean and covariance, from the belief one scan before: the prior for the first."""
    if est.mode_means is None or est.mode_covs is None:
        raise ModelError("predictions need every mode's moments: filter with per_mode=True.")
    with np.errstate(divide="ignore"):
        after = steps.Belief(np.log(est.probs), est.mode_means, est.mode_covs)
    before = steps.Belief(*(_shifted(first, history) for first, history in zip(prior, after, strict=True)))
    mixed = steps.mix(*before, trans)
    means, covs = steps.propagate(mixed.means, mixed.covs, F, None, Q)
    return steps.collapse(mixed.log_probs, means, covs, len(trans))


def _shifted(first: _Array, history: _Array) -> _Array:
    """Put `first` before the history (B, T, ...) and drop its last row."""
    return np.concatenate([np.broadcast_to(first, history[:, 0].shape)[:, None], history[:, :-1]], axis=1)


def _side_by_side(parts: list[Followed]) -> Followed:
    estimate, prediction, sd = (np.concatenate(a, axis=-1) for a in list(zip(*parts, strict=True))[:3])
    return Followed(estimate, prediction, sd, parts[0].probs)
