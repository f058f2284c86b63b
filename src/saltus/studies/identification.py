"""The identification experiments: two curves of single estimates, a recursive demonstration, and kept promises.

Single estimates: the distance of two estimates in standard deviations, 2-D and 3-D, of one object or of two whose
distance is uniform. Recursive: objects in a plane under white acceleration of 1 m/s^2 per root hertz, measured every
second by two systems in turn, 50 m and 100 m, both priors 300 m and 20 m/s about the same mean; declared one at a ratio
of 0. Dynamic: objects that manoeuvre at times (two levels of acceleration), systems with a constant offset between
them, and bounds on the multimode ratio for false-identification probabilities from 1e-1 to 1e-4.

Source: Chervakov, Bogdanov and Zhironkin (2016); identification notes, sections 3 to 5, whose choices are made here.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.identify import (
    FalseRatios,
    PairDraws,
    PairSettings,
    Schedule,
    different_pairs,
    false_ratios,
    filled,
    identification_llr,
    pair_ratios,
    posterior,
    same_pairs,
)
from saltus.models import discretise
from saltus.shapes import Bool, Float

__all__ = [
    "AFTER",
    "ASKED",
    "DIMS",
    "FARTHEST",
    "POINTS",
    "SCHEDULE",
    "SETTINGS",
    "TRUTHS",
    "Bounds",
    "Calibration",
    "Recursive",
    "Static",
    "run_bounds",
    "run_calibration",
    "run_recursive",
    "run_static",
]

DIMS = (2, 3)
FARTHEST = (5.0, 10.0, 20.0)  # standard deviations: distances are uniform from 0
POINTS = np.arange(0.25, 5.01, 0.25)  # thresholds h at which the curves are checked
TRUTHS = ("one object", "two, the second from the prior", "two, 400 m apart", "two, 200 m apart", "two, 100 m apart")
AFTER = (4, 10, 20)  # measurements
ASKED = (1e-1, 1e-2, 1e-3, 1e-4)  # false-identification probabilities

_APART = (None, None, 400.0, 200.0, 100.0)
_SD = np.array([50.0, 100.0])  # m, of the two systems
_PRIOR = (np.array([0.0, 100.0, 0.0, 50.0]), np.diag(np.square([300.0, 20.0, 300.0, 20.0])))
_F = np.kron(np.eye(2), [[0.0, 1.0], [0.0, 0.0]])
_G = np.kron(np.eye(2), [[0.0], [1.0]])
_H = np.eye(4)[[0, 2]]

SETTINGS = PairSettings(
    accel=(0.5, 5.0), sojourn=(40.0, 10.0), offset_cov=100.0 * np.eye(2), region_cov=1e6 * np.eye(2), speed_sigma=60.0
)
SCHEDULE = Schedule.of(
    [0.0, 0.7, 2.7, 4.0, 4.7, 6.7, 8.0, 8.7], [0, 1, 1, 0, 1, 1, 0, 1], [2500.0 * np.eye(2), 400.0 * np.eye(2)]
)
_DRAWS = 100_000  # weighted, for the bounds
_AT_ONCE = 20_000
_PRIOR_ONE = 1e-3  # probability of one object, for the calibration of the dynamic case

_Array = npt.NDArray[np.float64]


class Static(NamedTuple):
    """Shares of draws declared one object, at the thresholds POINTS."""

    correct: Float[np.ndarray, "d h"]  # of one object
    false: Float[np.ndarray, "d u h"]  # of two whose distance is uniform up to FARTHEST
    draws: int


class Recursive(NamedTuple):
    """Ratios of the demonstration."""

    llr: Float[np.ndarray, "b s k"]  # of each run, truth and measurement


class Calibration(NamedTuple):
    """Stated probabilities of one object, whether it was, and what a pair weighs among those of its prior."""

    stated: Float[np.ndarray, " b"]
    truth: Bool[np.ndarray, " b"]
    weight: Float[np.ndarray, " b"]


class Bounds(NamedTuple):
    """What was asked, and what pairs of different objects did; ASKED is the axis."""

    bound: Float[np.ndarray, " p"]  # nats
    stated: Float[np.ndarray, " p"]  # probability in the weighted sample
    stated_error: Float[np.ndarray, " p"]
    reached: Float[np.ndarray, " p"]  # number of plain pairs at or above the bound
    pairs: Float[np.ndarray, " p"]  # number of plain pairs
    fresh: Float[np.ndarray, " p"]  # probability in another weighted sample
    fresh_error: Float[np.ndarray, " p"]
    inverse: Float[np.ndarray, " p"]  # E[exp(-llr); llr >= bound] of one object
    recognised: Float[np.ndarray, " p"]  # share of one object declared so
    paths: Float[np.ndarray, "b k"]  # ratios of plain pairs of different objects
    paths_same: Float[np.ndarray, "b k"]  # and of one object


def run_static(draws: int, seed: int) -> Static:
    """Draw distances of two estimates."""
    rng = np.random.default_rng([seed, 1])
    correct, false = np.empty((len(DIMS), len(POINTS))), np.empty((len(DIMS), len(FARTHEST), len(POINTS)))
    for d, dim in enumerate(DIMS):
        correct[d] = _below(rng.standard_normal((draws, dim)))
        for u, high in enumerate(FARTHEST):
            off = rng.standard_normal((draws, dim))
            off[:, 0] += rng.uniform(0.0, high, draws)
            false[d, u] = _below(off)
    return Static(correct, false, draws)


def _below(off: _Array) -> _Array:
    length = np.sort(np.sqrt((off**2).sum(-1)))
    return np.searchsorted(length, POINTS) / len(length)


def run_recursive(runs: int, seed: int) -> Recursive:
    """Repeat the demonstration for every truth."""
    rng = np.random.default_rng([seed, 2])
    return Recursive(np.stack([_demonstration(runs, apart, s == 0, rng) for s, apart in enumerate(_APART)], axis=1))


def _demonstration(runs: int, apart: float | None, same: bool, rng: np.random.Generator, rows: int = 20) -> _Array:
    times, system = 1.0 + np.arange(rows), np.arange(rows) % 2
    A, Q = discretise(_F, _G, 1.0)
    root = np.linalg.cholesky(Q)
    x = _PRIOR[0] + rng.standard_normal((runs, 2, 4)) @ np.sqrt(_PRIOR[1])
    if apart is not None:
        x[:, 1] = x[:, 0] + np.array([apart, 0.0, 0.0, 0.0])
    z = np.empty((runs, rows, 2))
    for k, s in enumerate(system):
        x = x @ A.T + rng.standard_normal(x.shape) @ root.T
        z[:, k] = x[:, 0 if same else s] @ _H.T + _SD[s] * rng.standard_normal((runs, 2))
    R = _SD[:, None, None] ** 2 * np.eye(2)
    return identification_llr(times, system, z, F=_F, G=_G, H=_H, R=R, t0=0.0, prior_same=_PRIOR, prior_other=_PRIOR)


def run_calibration(runs: int, seed: int) -> dict[str, Calibration]:
    """Draw single objects and pairs from the models.

    "linear": the demonstration after 6 measurements, as many of one kind as of the other. "multimode": the dynamic
    case, with a thousand times as many pairs as single objects, for which weighted draws stand.
    """
    rng = np.random.default_rng([seed, 3])
    linear = np.concatenate([_demonstration(runs, None, same, rng, 6)[:, -1] for same in (True, False)])
    one, two = _ratios(same_pairs(SCHEDULE, SETTINGS, runs, rng))[:, -1], _false(seed + 2_000_003)
    llr = np.concatenate([one, two.llr[:, -1]])
    weight = np.concatenate([np.full(runs, _PRIOR_ONE / runs), (1.0 - _PRIOR_ONE) * two.weight / len(two.weight)])
    return {
        "linear": Calibration(posterior(linear), np.repeat([True, False], runs), np.ones(2 * runs)),
        "multimode": Calibration(posterior(llr, _PRIOR_ONE), np.arange(len(llr)) < runs, weight),
    }


def run_bounds(runs: int, seed: int, progress: Callable[[int, int], None] | None = None) -> Bounds:
    """Ask for false-identification probabilities, and count in up to 200 `runs` plain pairs for each."""
    stated, fresh = _false(seed), _false(seed + 1_000_003)
    bound = np.array([stated.bound(p) for p in ASKED])
    rng, most = np.random.default_rng([seed, 4]), 200 * runs
    paths = []
    for done in range(0, most, _AT_ONCE):
        n = min(_AT_ONCE, most - done)
        paths.append(_ratios(different_pairs(SCHEDULE, SETTINGS, n, rng, np.zeros((0, 4, 4)))))
        if progress is not None:
            progress(done + n, most)
    two, one = np.concatenate(paths), _ratios(same_pairs(SCHEDULE, SETTINGS, max(200, 10 * runs), rng))
    # No more pairs than tell 500 events: the bound itself is known within 2 or 3 %.
    pairs = np.array([min(most, int(500 / p)) for p in ASKED])
    last = one[:, -1]
    said, said_error = np.array([stated.probability(b) for b in bound]).T
    again, again_error = np.array([fresh.probability(b) for b in bound]).T
    return Bounds(
        bound,
        said,
        said_error,
        np.array([float((two[:n, -1] >= b).sum()) for n, b in zip(pairs, bound, strict=True)]),
        pairs.astype(np.float64),
        again,
        again_error,
        np.array([float((np.exp(-last) * (last >= b)).mean()) for b in bound]),
        np.array([float((last >= b).mean()) for b in bound]),
        two,
        one,
    )


def _false(seed: int) -> FalseRatios:
    return false_ratios(SCHEDULE, SETTINGS, draws=_DRAWS, seed=seed)


def _ratios(draws: PairDraws) -> _Array:
    pairs = np.repeat(np.arange(len(draws.weight))[:, None], 2, axis=1)
    return filled(pair_ratios(draws.a, draws.b, pairs, SETTINGS))
