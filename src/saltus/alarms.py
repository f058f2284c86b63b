"""Sequential alarms: "manoeuvre began", "sensor failed", at a chosen rate of false alarms or a chosen delay.

A *level* is anything that rises when something is wrong: the probability of a chain's state, the posterior of
`shiryaev` or the sum of `cusum`. An alarm is raised where it reaches a threshold. The threshold is found by
`calibrate` from simulated levels without (and with) the fault. Plain arrays, time on the last axis.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError
from saltus.shapes import Bool, Float

__all__ = ["Alarms", "Calibration", "alarms", "calibrate", "cusum", "shiryaev"]

_Array = npt.NDArray[np.float64]


class Alarms(NamedTuple):
    """Alarms along time: those standing, and the rows that raised one."""

    standing: Bool[np.ndarray, "*lead t"]
    raised: Bool[np.ndarray, "*lead t"]


class Calibration(NamedTuple):
    """A threshold and what it does; numbers in rows (measurements).

    `mean_time` is the mean number of rows from a fresh start to the first false alarm, `low` and `high` the ends of
    its interval (inf where there was no alarm at all). `delay` is the mean number of rows from the fault's first row
    to the alarm (0: the same row), a missed fault counted to the end of its run; `detected` is the share of faults
    not missed. Both are NaN without simulated faults, or where all their runs alarm before the fault.
    """

    threshold: float
    mean_time: float
    low: float
    high: float
    delay: float
    detected: float


def cusum(llr: npt.ArrayLike, *, limit: float | None = None) -> Float[np.ndarray, "*lead t"]:
    """Sum log-likelihood ratios from the most suspicious moment on.

    g_k = min(limit, max(0, g_{k-1} + l_k)),  l_k = log f_fault(z_k | past) / f_ok(z_k | past)

    A threshold h leaves at least exp(h) rows on average between false alarms; `calibrate` finds the exact one.

    Args:
        llr: l, (*lead, T), for instance the difference of two filters' `log_likelihood`.
        limit: highest value, at least the threshold: the sum then falls as soon as the fault is over.

    Raises:
        DataError: no time axis, NaN or +inf.
        ModelError: a limit that is not positive.

    Source: Page (1954); the bound is Lorden (1971), theorem 2.
    """
    ratio = _levels("llr", llr)
    if limit is not None and not limit > 0:
        raise ModelError(f"limit must be positive, got {limit}.")
    g, out = np.zeros(ratio.shape[:-1]), np.empty_like(ratio)
    for k in range(ratio.shape[-1]):
        g = np.maximum(g + ratio[..., k], 0.0)
        out[..., k] = g = g if limit is None else np.minimum(g, limit)
    return out


def shiryaev(llr: npt.ArrayLike, *, begin: float, end: float = 0.0, prior: float = 0.0) -> Float[np.ndarray, "*lead t"]:
    """Return the probability of a fault that begins and ends like a Markov chain, given the ratios so far.

    p~_k = (1 - end) p_{k-1} + begin (1 - p_{k-1}),   odds(p_k) = exp(l_k) odds(p~_k)

    When the chain's law is right, a threshold c makes at most a share 1 - c of the rows in alarm a false one.

    Args:
        llr: log f_fault(z_k | past) / f_ok(z_k | past), (*lead, T).
        begin: probability per row that a fault begins.
        end: probability per row that it ends.
        prior: probability of the fault before the first row.

    Raises:
        DataError: no time axis, NaN or +inf.
        ModelError: a probability outside [0, 1].

    Source: Shiryaev (1963), with an end: the two-state filter of a hidden Markov chain.
    """
    ratio = _levels("llr", llr)
    for name, value in (("begin", begin), ("end", end), ("prior", prior)):
        if not 0 <= value <= 1:
            raise ModelError(f"{name} must be a probability, got {value}.")
    p, out = np.full(ratio.shape[:-1], prior), np.empty_like(ratio)
    with np.errstate(divide="ignore"):
        for k in range(ratio.shape[-1]):
            before = (1 - end) * p + begin * (1 - p)
            log_odds = np.log(before) - np.log1p(-before) + ratio[..., k]
            out[..., k] = p = np.exp(-np.logaddexp(0.0, -log_odds))
    return out


def alarms(level: npt.ArrayLike, *, threshold: float, release: float | None = None) -> Alarms:
    """Raise an alarm where a level reaches the threshold, and let it stand until it falls below `release`.

    Args:
        level: (*lead, T).
        threshold: raises.
        release: <= threshold; by default the threshold itself.

    Raises:
        DataError: no time axis, or NaN.
        ModelError: a release above the threshold.
    """
    values = _levels("level", level)
    low = threshold if release is None else release
    if not low <= threshold:
        raise ModelError(f"release = {release} lies above the threshold {threshold}: the alarm would never stand.")
    on, standing = np.zeros(values.shape[:-1], np.bool_), np.empty(values.shape, np.bool_)
    for k in range(values.shape[-1]):
        on = np.where(on, values[..., k] >= low, values[..., k] >= threshold)
        standing[..., k] = on
    before = np.concatenate([np.zeros((*on.shape, 1), np.bool_), standing[..., :-1]], axis=-1)
    return Alarms(standing, standing & ~before)


def calibrate(
    quiet: npt.ArrayLike,
    faulty: npt.ArrayLike | None = None,
    *,
    onset: int = 0,
    mean_time: float | None = None,
    delay: float | None = None,
    confidence: float = 0.95,
) -> Calibration:
    """Find the threshold for a mean time to a false alarm, or for a mean delay, by simulation.

    With N runs in alarm and W rows watched before (each run to its first alarm, or to its end) the mean time is
    W / N, and 2 W / mean_time is chi-square with 2N to 2N + 2 degrees of freedom: runs end at random or by censoring.

    Args:
        quiet: levels of runs without fault, (B, T). For an interval of 10 % make B T about 400 times the mean time.
        faulty: levels of runs with a fault from row `onset` on, (B', T').
        onset: first row of the fault.
        mean_time: rows wanted to the first false alarm; or
        delay: rows wanted between the fault's first row and the alarm, of runs without alarm before it.
        confidence: of the interval of the mean time.

    Raises:
        DataError: levels that are not (B, T), NaN, or too few rows for the mean time asked for.
        ModelError: not exactly one of mean_time and delay; a delay without faulty runs or shorter than any threshold
            gives; a number out of range.

    Source: exponential life testing with censored runs, Epstein and Sobel (1953).
    """
    if (mean_time is None) == (delay is None):
        raise ModelError("calibrate needs exactly one of mean_time= and delay=, in rows.")
    if not 0 < confidence < 1:
        raise ModelError(f"confidence must lie in (0, 1), got {confidence}.")
    clean = _runs("quiet", quiet)
    fault = None if faulty is None else _runs("faulty", faulty)
    if fault is not None and not 0 <= onset < fault.shape[1]:
        raise ModelError(f"onset = {onset} is no row of the faulty runs, which have {fault.shape[1]}.")
    if mean_time is not None:
        threshold = _for_mean_time(clean, mean_time)
    elif fault is not None and delay is not None:
        threshold = _for_delay(fault, onset, delay)
    else:
        raise ModelError("a threshold for a delay needs simulated faults: calibrate(quiet, faulty, onset=..., ...).")
    found, share = (np.nan, np.nan) if fault is None else _delay(fault, onset, threshold)
    return Calibration(threshold, *_mean_time(clean, threshold, confidence), found, share)


def _for_mean_time(quiet: _Array, wanted: float) -> float:
    """Lowest candidate threshold whose mean time is at least the one wanted; both grow together."""
    if not 1 <= wanted <= quiet.size:
        raise DataError(
            f"a mean time of {wanted:g} rows cannot be read from {quiet.size} rows of quiet runs: simulate more."
        )
    candidates = np.unique(np.maximum.accumulate(quiet, axis=1))
    low, high = 0, len(candidates)
    while low < high:
        middle = (low + high) // 2
        if _mean_time(quiet, float(candidates[middle]), 0.5)[0] >= wanted:
            high = middle
        else:
            low = middle + 1
    return float(candidates[low]) if low < len(candidates) else float(np.nextafter(candidates[-1], np.inf))


def _mean_time(quiet: _Array, threshold: float, confidence: float) -> tuple[float, float, float]:
    from scipy.special import gammaincinv

    over = quiet >= threshold
    hit = over.any(axis=1)
    watched = float(np.where(hit, over.argmax(axis=1) + 1, quiet.shape[1]).sum())
    n, tail = int(hit.sum()), (1 - confidence) / 2
    low = watched / float(gammaincinv(n + 1, 1 - tail))
    return (watched / n, low, watched / float(gammaincinv(n, tail))) if n else (np.inf, low, np.inf)


def _for_delay(faulty: _Array, onset: int, wanted: float) -> float:
    """Highest candidate threshold with a mean delay of at most the one wanted; both grow together."""
    candidates = np.unique(np.maximum.accumulate(faulty[:, onset:], axis=1))
    low, high = 0, len(candidates)
    while low < high:
        middle = (low + high) // 2
        if _delay(faulty, onset, float(candidates[middle]))[0] > wanted:  # not so where it is NaN
            high = middle
        else:
            low = middle + 1
    if low == 0:
        raise ModelError(f"no threshold detects these faults within {wanted:g} rows on average: allow more.")
    return float(candidates[low - 1])


def _delay(faulty: _Array, onset: int, threshold: float) -> tuple[float, float]:
    """Mean delay and share of detected faults, among the runs without alarm before the fault."""
    over = faulty >= threshold
    fresh = over[~over[:, :onset].any(axis=1), onset:]
    if not len(fresh):
        return np.nan, np.nan
    hit = fresh.any(axis=1)
    return float(np.where(hit, fresh.argmax(axis=1), fresh.shape[1]).mean()), float(hit.mean())


def _levels(name: str, value: npt.ArrayLike) -> _Array:
    a = np.asarray(value, np.float64)
    if a.ndim == 0:
        raise DataError(f"{name} needs a time axis, (*lead, T); got one number.")
    bad = np.isnan(a) | (np.isposinf(a) if name == "llr" else False)
    if bad.any():
        where = [int(i) for i in np.argwhere(bad)[0]]
        raise DataError(f"{name}{where} is {a[tuple(where)]}. A row without measurement has llr 0.")
    return a


def _runs(name: str, value: npt.ArrayLike) -> _Array:
    a = _levels(name, value)
    if a.ndim != 2 or not a.size:
        raise DataError(f"{name} must be the levels of simulated runs, (B, T), got shape {a.shape}.")
    return a
