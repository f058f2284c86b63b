"""Correlation time and level of a sensor's errors, by maximum likelihood, with intervals and a verdict."""

from itertools import pairwise, product
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.diagnose.likelihood import Series, Sums, innovations, log_likelihood, pack, sums
from saltus.errors import DataError

__all__ = ["NoiseFit", "Parameter", "fit_noise"]

Verdict = Literal["white", "coloured", "unexplained"]
_Array = npt.NDArray[np.float64]

_SIGNIFICANT = 9.21  # twice the log-likelihood ratio: chi-square, 2 degrees of freedom, 1 %
_WORTH = 3.84  # likewise for one parameter, 5 %
_UNEXPLAINED = 0.25  # correlation of successive innovations that a right model does not leave
_LOST = 1e-3  # share of a parameter along directions without information that leaves it open
_FINE = 0.02  # last step of the search, in logarithms
_CONSTANT = 1e-12  # relative: values that differ by less are one value
_HIDDEN = 9.0  # logit of the coloured share at which the white part counts as absent


class Parameter(NamedTuple):
    """An estimate with its 95 % interval; an end that the data do not bound is None."""

    value: float
    low: float | None
    high: float | None


class NoiseFit(NamedTuple):
    """First-order noise plus white noise, fitted to one component.

    Attributes:
        tau: correlation time, s.
        sigma: standard deviation of the coloured part.
        white: standard deviation of the white part; 0 where the data are explained without.
        bias: common to all series; NaN when positions were fitted.
        accel: spectral density of the acceleration when positions were fitted, else None.
        n_values, n_series, n_outliers: used, their series, and values left out as outliers.
        interval: median interval between values, s.
        gain: log-likelihood over that of white noise (with the same motion), in nats.
        verdict: "coloured" where the gain is significant at 1 %, else "white"; "unexplained" where innovations stay
            correlated under either: first-order noise (or the motion) is not what these data show.
        lag1_white, lag1_coloured: correlation of successive standardised innovations under either model.
        overconfidence: variance of the mean of 10 successive errors over what white noise promises.
    """

    tau: Parameter
    sigma: Parameter
    white: Parameter
    bias: float
    accel: Parameter | None
    n_values: int
    n_series: int
    n_outliers: int
    interval: float
    gain: float
    verdict: Verdict
    lag1_white: float
    lag1_coloured: float
    overconfidence: float

    def suggestion(self) -> str:
        """The noise as a sensor's description, in Python."""
        if self.verdict == "unexplained":
            return "none: first-order noise does not explain these data"
        if self.verdict == "white":
            return f"R = {self.sigma.value**2 + self.white.value**2:.4g}  # white is enough"
        white = f", white={self.white.value**2:.4g}" if self.white.value > 0 else ""
        known = "" if self.tau.low is not None else "  # these data do not bound it"
        return f"first_order(tau={self.tau.value:.4g}, sigma={self.sigma.value:.4g}{white}){known}"


def fit_noise(
    times: npt.ArrayLike,
    values: npt.ArrayLike,
    series: npt.ArrayLike | None = None,
    *,
    motion: bool = False,
    outlier: float = 6.0,
) -> NoiseFit:
    """Fit the noise of one component to residuals, or to positions.

    With `motion`, values are positions of an object with white acceleration, and the innovations of its filter tell
    noise and motion apart; a reference is not needed, but what is slow in the noise is then hard to tell from motion.

    Args:
        times: (N,), s; irregular intervals are welcome.
        values: residuals against a reference, or positions, (N,).
        series: label of each value, (N,): objects or passes, independent of each other; absent means one series.
        motion: values are positions.
        outlier: residuals further from the median than this many robust standard deviations are left out.

    Raises:
        DataError: shapes differ, values are not finite or all alike, two values of a series share a
            time, or there are too few.

    Source: exact Gaussian likelihood by prediction errors, Schweppe (1965); intervals from the observed information.
    """
    t, r = np.asarray(times, np.float64), np.asarray(values, np.float64)
    label = np.zeros(len(t), np.int64) if series is None else np.asarray(series)
    if t.ndim != 1 or r.shape != t.shape or label.shape != t.shape:
        raise DataError(f"times {t.shape}, values {r.shape} and series {label.shape} must be vectors of one length.")
    if len(t) == 0:
        raise DataError("there is no value to fit noise to.")
    if not (np.isfinite(t).all() and np.isfinite(r).all()):
        raise DataError("times and values must be finite: drop rows without a residual first.")
    if np.ptp(r) <= _CONSTANT * np.abs(r).max():
        raise DataError(f"all {len(r)} values are constant ({r[0]:.6g}): there is no noise to fit.")
    kept = np.ones(len(t), bool) if motion else _inliers(r, outlier)
    data = pack(t[kept], r[kept], label[kept])
    steps = np.diff(data.t, axis=1)
    steps = steps[np.isfinite(steps)]
    if len(steps) < 30:
        raise DataError(f"{len(steps)} intervals are too few to tell a correlation time; give 30 or more.")
    if steps.min() <= 0:
        raise DataError("two values of one series share a time: give every object its own label, or thin the data.")
    return _describe(data, float(np.median(steps)), motion, int((~kept).sum()))


def _inliers(r: _Array, limit: float) -> npt.NDArray[np.bool_]:
    off = np.abs(r - np.median(r))
    return np.asarray(off <= limit * 1.4826 * max(float(np.median(off)), 1e-12))


def _describe(data: Series, dt: float, motion: bool, n_outliers: int) -> NoiseFit:
    best, level = _search(data, dt, motion)
    plain, plain_level = _search(data, dt, motion, coloured=False)
    bare = best.copy()
    bare[1] = _HIDDEN
    hidden, hidden_level = _profile(data, bare[None], dt)
    if 2 * (level - hidden_level[0]) < _WORTH:
        theta, absent = hidden[0], True
    else:
        theta, absent = _profile(data, best[None], dt)[0][0], False
    found = _intervals(data, theta, absent)
    gain = float(level - plain_level)
    white, left = _profile(data, plain[None], dt)[0][0], _lag1(data, theta)
    return NoiseFit(
        tau=found[0],
        sigma=_root(found[1]),
        white=Parameter(0.0, 0.0, None) if absent else _root(found[2]),
        bias=float("nan") if motion else float(sums(data, theta[None]).bias[0]),
        accel=found[3] if motion else None,
        n_values=int(np.isfinite(data.r).sum()),
        n_series=len(data.r),
        n_outliers=n_outliers,
        interval=dt,
        gain=gain,
        verdict="unexplained" if abs(left) > _UNEXPLAINED else "coloured" if 2 * gain > _SIGNIFICANT else "white",
        lag1_white=_lag1(data, white),
        lag1_coloured=left,
        overconfidence=float("nan") if motion else _overconfidence(data),
    )


def _theta(u: _Array, dt: float) -> _Array:
    """Search coordinates (log tau, logit share, log motion) -> tau, sigma^2, white^2 (, q), of total variance 1."""
    share = 1.0 / (1.0 + np.exp(-u[:, 1]))
    columns = [np.exp(u[:, 0]), share, 1.0 / (1.0 + np.exp(u[:, 1]))]
    if u.shape[1] == 3:
        columns.append(np.exp(u[:, 2]) / dt**3)
    return np.stack(columns, axis=-1)


def _profile(data: Series, u: _Array, dt: float) -> tuple[_Array, _Array]:
    """Parameters with the scale at its best value, and their log-likelihood."""
    theta = _theta(u, dt)
    s = sums(data, theta)
    scale = s.quadratic / s.n
    level = -0.5 * (s.n * (np.log(2 * np.pi) + 1.0 + np.log(scale)) + s.log_s)
    theta[:, 1:] *= scale[:, None]
    return theta, np.asarray(level)


def _search(data: Series, dt: float, motion: bool, coloured: bool = True) -> tuple[_Array, float]:
    """Find the best search coordinates: a coarse grid, then a compass that halves its steps."""
    span = float(np.nanmax(data.t - data.t[:, :1]))
    low, high = np.log(dt / 5.0), np.log(max(5.0 * span, 50.0 * dt))
    axes = [np.linspace(low, high, 10), np.array([-4.0, -2.0, 0.0, 2.0, 4.0, 7.0])]
    if not coloured:
        axes = [np.array([low]), np.array([-30.0])]
    if motion:
        axes.append(np.linspace(-14.0, 6.0, 11))
    grid = np.array(list(product(*axes)))
    level = _profile(data, grid, dt)[1]
    best, top = grid[int(level.argmax())], float(level.max())
    step = np.array([(a[-1] - a[0]) / max(len(a) - 1, 1) for a in axes]) / 2
    floor, ceiling = np.array([a.min() for a in axes]), np.array([a.max() for a in axes])
    floor[1], ceiling[1] = (-9.0, _HIDDEN) if coloured else (-30.0, -30.0)
    stencil = np.array(list(product((-1.0, 0.0, 1.0), repeat=len(axes))))
    while step.max() > _FINE:
        around = np.clip(best + stencil * step, floor, ceiling)
        level = _profile(data, around, dt)[1]
        if level.max() > top + 1e-9:
            best, top = around[int(level.argmax())], float(level.max())
        else:
            step = step / 2
    return best, top


def _intervals(data: Series, theta: _Array, absent: bool) -> list[Parameter]:
    """95 % intervals from the observed information in logarithms of tau, sigma^2, white^2 (, q)."""
    free = [i for i in range(len(theta)) if not (absent and i == 2)]
    h = 0.05
    points = {tuple(np.zeros(len(free), int)): theta}
    for i, j in product(range(len(free)), repeat=2):
        for a, b in product((-1, 1), repeat=2):
            move = np.zeros(len(free), int)
            move[i] += a
            move[j] += b
            shifted = theta.copy()
            shifted[free] = shifted[free] * np.exp(h * move)
            points[tuple(move)] = shifted
    level = dict(zip(points, log_likelihood(sums(data, np.array(list(points.values())))), strict=True))
    information = np.zeros((len(free), len(free)))
    for i, j in product(range(len(free)), repeat=2):
        corners = {}
        for a, b in product((-1, 1), repeat=2):
            move = np.zeros(len(free), int)
            move[i] += a
            move[j] += b
            corners[a, b] = level[tuple(move)]
        information[i, j] = -(corners[1, 1] - corners[1, -1] - corners[-1, 1] + corners[-1, -1]) / (4 * h * h)
    out = [Parameter(float(v), None, None) for v in theta]
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    flat = values <= 0  # directions in which the data say nothing
    sd = np.sqrt(((vectors[:, ~flat] ** 2) / values[~flat]).sum(axis=1))
    lost = (vectors[:, flat] ** 2).sum(axis=1) > _LOST
    for i, s, unknown in zip(free, sd, lost, strict=True):
        if s < 3.0 and not unknown:
            spread = float(np.exp(1.96 * s))
            out[i] = Parameter(float(theta[i]), float(theta[i] / spread), float(theta[i] * spread))
    return out


def _root(p: Parameter) -> Parameter:
    return Parameter(*(None if v is None else float(np.sqrt(v)) for v in p))  # type: ignore[arg-type]  # value is not None


def _lag1(data: Series, theta: _Array) -> float:
    """Correlation of successive standardised innovations within the series."""
    rows = innovations(data, theta[None])
    bias = _sums_bias(data, theta)
    first = 3 if len(theta) == 4 else 0
    e = [((nu[0] - bias * nu[1]) / np.sqrt(S))[0] for nu, S in rows[first:]]
    pairs = [(a[: len(b)], b) for a, b in pairwise(e)]
    before, after = (np.concatenate(part) for part in zip(*pairs, strict=True))
    return float((before * after).mean() / (np.concatenate(e) ** 2).mean())


def _sums_bias(data: Series, theta: _Array) -> float:
    found: Sums = sums(data, theta[None])
    return float(found.bias[0])


def _overconfidence(data: Series, n: int = 10) -> float:
    """Variance of means of n successive residuals, over the n-th part of the residuals' variance."""
    r = data.r - np.nanmean(data.r)
    whole = r[:, : r.shape[1] // n * n].reshape(len(r), -1, n).mean(-1)
    means = whole[np.isfinite(whole)]
    return float(np.mean(means**2) / (np.nanmean(r**2) / n)) if len(means) else float("nan")
