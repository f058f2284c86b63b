"""Errors of estimates over Monte-Carlo runs: root mean squares with intervals, NEES and NIS with their bands.

Axis 0 is always the run: runs are independent, times within a run are not, so every interval comes from the
spread *between* runs.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError
from saltus.shapes import Bool, Float

__all__ = ["Consistency", "Interval", "consistency", "mean_over_runs", "nees", "nis", "rmse"]


class Interval(NamedTuple):
    """A figure over runs, its standard error and the ends of its confidence interval; all of one shape."""

    value: Float[np.ndarray, "*shape"]
    standard_error: Float[np.ndarray, "*shape"]
    low: Float[np.ndarray, "*shape"]
    high: Float[np.ndarray, "*shape"]
    n_runs: int


class Consistency(NamedTuple):
    """The mean over runs of a normalised squared error at each time, and the band it should lie in.

    `inside` is the share of times within the band: near the band's probability for a consistent filter.
    """

    mean: Float[np.ndarray, "*times"]
    low: Float[np.ndarray, "*times"]
    high: Float[np.ndarray, "*times"]
    inside: float


def mean_over_runs(
    values: npt.ArrayLike,
    *,
    pool: tuple[int, ...] = (),
    where: npt.ArrayLike | None = None,
    confidence: float = 0.95,
) -> Interval:
    """Average over runs, and over the axes in `pool` within each run, with an interval from the runs' spread.

    m = sum_b s_b / sum_b w_b,  se^2 = B/(B-1) sum_b (s_b - m w_b)^2 / (sum_b w_b)^2,  m -+ t_{B-1} se

    s_b and w_b are run b's sum and count of the selected values, so times within a run may be correlated in
    any way, and runs may select different numbers of values. Only the central limit over runs is assumed.

    Args:
        values: (B, ...), one entry of axis 0 per run, B >= 2.
        pool: axes (not 0) averaged within the runs as well.
        where: mask that broadcasts against `values` (axis 0 included); False is left out.
        confidence: probability of the interval.

    Returns:
        Value, standard error and interval, of the shape of `values` without axis 0 and `pool`; NaN where
        nothing is selected.

    Raises:
        DataError: fewer than two runs, or a selected value is not finite.
        ModelError: axis 0 in `pool`, or a confidence outside (0, 1).

    Source: ratio estimator and its linearised variance, Cochran (1977), chapter 6.
    """
    x = np.asarray(values, np.float64)
    if x.ndim == 0 or x.shape[0] < 2:
        raise DataError(f"an interval needs at least two runs on axis 0: values have shape {x.shape}")
    if not 0.0 < confidence < 1.0:
        raise ModelError(f"confidence must lie in (0, 1): {confidence}")
    axes = tuple(a % x.ndim for a in pool)
    if 0 in axes:
        raise ModelError(f"pool = {pool} contains axis 0, the runs: leave it out, it is always averaged")
    keep = np.broadcast_to(True if where is None else np.asarray(where, np.bool_), x.shape)
    if not np.all(np.isfinite(x[keep])):
        at = tuple(int(i) for i in np.argwhere(keep & ~np.isfinite(x))[0])
        raise DataError(f"value at index {at} is {x[at]}: leave it out with where=, or find out why")
    s = np.where(keep, x, 0.0).sum(axes)
    w = keep.sum(axes).astype(np.float64)
    total = np.where(w.sum(0) > 0, w.sum(0), np.nan)
    m = s.sum(0) / total
    n_runs = x.shape[0]
    se = np.sqrt(n_runs / (n_runs - 1) * np.square(s - m * w).sum(0)) / total
    half = _student(confidence, n_runs - 1) * se
    return Interval(m, se, m - half, m + half, n_runs)


def rmse(
    errors: npt.ArrayLike,
    *,
    pool: tuple[int, ...] = (),
    where: npt.ArrayLike | None = None,
    confidence: float = 0.95,
) -> Interval:
    """Root mean square error over runs (and over the axes in `pool`), with an interval.

    rmse = sqrt(m), m the mean square;  se(rmse) = se(m) / (2 rmse);  interval rmse exp(-+ t_{B-1} se(rmse) / rmse)

    The interval rests on the spread of the runs' mean squares, not on a chi-square law, so it holds for
    pooled (correlated) times, biased and non-Gaussian errors. It is taken on the logarithm because mean squares
    are skewed; with few runs and strongly correlated times it still covers a few per cent less than it says.

    Args:
        errors: (B, ...), one entry of axis 0 per run; any unit. For a position error pass the norm.
        pool: axes (not 0) averaged within the runs as well, e.g. time.
        where: mask that broadcasts against `errors`; False is left out.
        confidence: probability of the interval.

    Returns:
        Value, standard error, interval, of the shape of `errors` without axis 0 and `pool`.

    Raises:
        DataError, ModelError: as `mean_over_runs`.

    Source: delta method, on the logarithm, of `mean_over_runs`.
    """
    m = mean_over_runs(np.square(np.asarray(errors, np.float64)), pool=pool, where=where, confidence=confidence)
    value = np.sqrt(m.value)
    relative = np.divide(m.standard_error, 2 * m.value, out=np.zeros_like(value), where=m.value != 0)
    factor = np.exp(_student(confidence, m.n_runs - 1) * relative)
    return Interval(value, value * relative, value / factor, value * factor, m.n_runs)


def nees(errors: npt.ArrayLike, covs: npt.ArrayLike) -> Float[np.ndarray, "*lead"]:
    """Normalised estimation error squared, e' P^-1 e; chi-square with n degrees of freedom if P is honest.

    Args:
        errors: truth minus estimate, (..., n).
        covs: the filter's covariances, (..., n, n); leading axes broadcast.

    Returns:
        One number for each error, (...).

    Raises:
        DataError: shapes do not match, or a covariance is singular.

    Source: Bar-Shalom, Li, Kirubarajan (2001), section 5.4.
    """
    e, p = np.asarray(errors, np.float64), np.asarray(covs, np.float64)
    if e.ndim < 1 or p.ndim < 2 or p.shape[-2:] != (e.shape[-1], e.shape[-1]):
        raise DataError(f"errors {e.shape} need covariances (..., n, n) with the same n, got {p.shape}")
    try:
        whitened = np.linalg.solve(p, e[..., None])[..., 0]
    except np.linalg.LinAlgError as error:
        raise DataError(f"a covariance is singular ({error}): leave out components that are known exactly") from None
    return np.asarray(np.sum(e * whitened, axis=-1))


def nis(innovations: npt.ArrayLike, covs: npt.ArrayLike) -> Float[np.ndarray, "*lead"]:
    """Normalised innovation squared, nu' S^-1 nu; chi-square with m degrees of freedom if S is honest.

    Args:
        innovations: measurement minus its prediction, (..., m).
        covs: innovation covariances S, (..., m, m).

    Returns:
        One number for each innovation, (...).

    Raises:
        DataError: shapes do not match, or a covariance is singular.

    Source: Bar-Shalom, Li, Kirubarajan (2001), section 5.4.
    """
    return nees(innovations, covs)


def consistency(values: npt.ArrayLike, dof: npt.ArrayLike | int, *, probability: float = 0.95) -> Consistency:
    """Compare the mean NEES or NIS over runs with its chi-square band, at each time.

    B mean ~ chi2(sum_b dof_b):  band = chi2 quantiles at (1 -+ probability) / 2, over B

    Args:
        values: NEES or NIS, (B, ...), axis 0 the runs.
        dof: degrees of freedom: the state's or measurement's dimension, or the numbers of observed
            components, broadcast against `values`. A value with 0 of them (an empty row) must be 0.
        probability: of the band at each single time.

    Returns:
        Mean and band at each time, and the share of times inside.

    Raises:
        DataError: no runs, or a value that is not finite.
        ModelError: negative degrees of freedom or a probability outside (0, 1).

    Source: Bar-Shalom, Li, Kirubarajan (2001), section 5.4.2.
    """
    from scipy.special import gammaincinv

    x = np.asarray(values, np.float64)
    if x.ndim == 0 or x.shape[0] == 0:
        raise DataError(f"axis 0 must hold the runs: values have shape {x.shape}")
    if not np.all(np.isfinite(x)):
        raise DataError(f"{int(np.sum(~np.isfinite(x)))} of {x.size} values are not finite")
    k = np.broadcast_to(np.asarray(dof, np.float64), x.shape)
    if np.any(k < 0) or not 0.0 < probability < 1.0:
        raise ModelError(f"need dof >= 0 and 0 < probability < 1: least dof {k.min()}, probability {probability}")
    n_runs, total = x.shape[0], k.sum(0)
    shape = np.where(total > 0, total / 2, 1.0)
    low, high = (
        np.where(total > 0, 2 * gammaincinv(shape, tail) / n_runs, 0.0)
        for tail in ((1 - probability) / 2, (1 + probability) / 2)
    )
    mean = x.mean(0)
    inside: Bool[np.ndarray, "*times"] = (low <= mean) & (mean <= high)
    return Consistency(mean, low, high, float(np.mean(inside)))


def _student(confidence: float, dof: int) -> float:
    from scipy.special import stdtrit

    return float(stdtrit(dof, (1 + confidence) / 2))
