"""What a sensor's noise really is, from the straight stretches of its own tracks."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.records import Source
from saltus.tracks.measurements import Measurements, Noise

__all__ = ["NoiseEstimate", "apply_estimate", "estimate_noise", "widened"]

_Array = npt.NDArray[np.float64]

_WINDOW = 7  # plots of one track in a row
_MAX_ACCEL = 1.0  # m/s^2 over the window: straighter than any turn of an aircraft
_MOVING = 3.0  # m/s
_MAX_GAP = 2.5  # of the median interval: no window spans a longer gap
_MIN_WINDOWS = 30  # fewer say nothing
_TRIM = 4.0
_SHARE, _CHI2_QUANTILE = 0.8, 3.2189  # of the chi-square law of two degrees of freedom
_MAD = 1.4826  # normal standard deviation per median absolute deviation


class NoiseEstimate(NamedTuple):
    """Standard deviations found; NaN where the recording cannot tell."""

    range: float  # m
    azimuth: float  # rad
    xy: float  # m, each axis, for sources that give plane or geodetic positions
    n_windows: int


def estimate_noise(m: Measurements, track_id: npt.NDArray[np.int64], source: int) -> NoiseEstimate:
    """Estimate one source's noise from the scatter of its plots about local quadratics in time.

    For seven plots of one track in a row a quadratic x(t), y(t) is fitted by least squares; the residual e of the
    middle plot has variance sigma^2 (1 - h), h its leverage, whatever constant acceleration the target has. Along
    and across the ray from the radar, sigma is the root mean square of e / sqrt(1 - h) over all straight windows,
    those beyond four median deviations (outliers, turns) left out.

    Args:
        m: measurements in time order.
        track_id: of each measurement, 0 none, (N,).
        source: which source.
    """
    index = np.flatnonzero((m.source == source) & (track_id > 0))
    index = index[np.lexsort((m.time[index], track_id[index]))]
    if len(index) < _WINDOW:
        return NoiseEstimate(np.nan, np.nan, np.nan, 0)
    window = np.lib.stride_tricks.sliding_window_view(index, _WINDOW)
    time = m.time[window] - m.time[window[:, _WINDOW // 2]][:, None]
    step = np.diff(m.time[window], axis=1)
    whole = (track_id[window] == track_id[window[:, :1]]).all(axis=1) & (step > 0).all(axis=1)
    whole &= step.max(axis=1) < _MAX_GAP * np.median(step[whole]) if whole.any() else False
    residual, speed, accel = _middle_residuals(time[whole], m.position[window[whole], :2])
    straight = accel < _MAX_ACCEL
    moving = straight & (speed > _MOVING)
    if moving.sum() >= _MIN_WINDOWS:  # what stands still repeats one rounded position and shows no noise
        straight = moving
    middle = window[whole, _WINDOW // 2][straight]
    return _scatter(residual[straight], m.ray[middle])


def _middle_residuals(time: _Array, xy: _Array) -> tuple[_Array, _Array, _Array]:
    """Return the middle plots' residuals with variance sigma^2, (W, 2), fitted speeds and accelerations, (W,)."""
    scale = np.abs(time).max(axis=1, initial=0.0)[:, None]
    u = time / np.where(scale > 0, scale, 1.0)
    A = np.stack([np.ones_like(u), u, u * u], axis=-1)
    pinv = np.linalg.pinv(A)  # (W, 3, 7)
    centre = xy[:, _WINDOW // 2 : _WINDOW // 2 + 1]
    coefficients = pinv @ (xy - centre)
    leverage = pinv[:, 0, _WINDOW // 2]  # the middle plot is at u = 0
    residual = -coefficients[:, 0] / np.sqrt(1.0 - leverage)[:, None]
    unit = np.maximum(scale[:, 0], 1e-9)
    speed, accel = np.linalg.norm(coefficients[:, 1:], axis=-1).T / np.stack([unit, 0.5 * unit**2])
    return residual, speed, accel


def _scatter(residual: _Array, ray: _Array) -> NoiseEstimate:
    n = len(residual)
    if n < _MIN_WINDOWS:
        return NoiseEstimate(np.nan, np.nan, np.nan, n)
    if np.isnan(ray).any():
        return NoiseEstimate(np.nan, np.nan, _trimmed(residual), n)
    distance = np.linalg.norm(ray, axis=-1)
    u = ray / distance[:, None]
    along = residual[:, 0] * u[:, 0] + residual[:, 1] * u[:, 1]
    across = (residual[:, 1] * u[:, 0] - residual[:, 0] * u[:, 1]) / distance
    return NoiseEstimate(_trimmed(along), _trimmed(across), np.nan, n)


def _trimmed(e: _Array) -> float:
    inside = np.abs(e) <= _TRIM * _MAD * np.median(np.abs(e))
    return float(np.sqrt(np.mean(np.square(e[inside]))))


def apply_estimate(noise: Noise, estimate: NoiseEstimate, source: Source) -> Noise:
    """Replace what was estimated, never below quantisation, LSB / sqrt(12)."""
    step = np.sqrt(12.0)

    def at_least(value: float, lsb: float, otherwise: float) -> float:
        return max(value, lsb / step) if np.isfinite(value) and value > 0 else otherwise

    return replace(
        noise,
        range=at_least(estimate.range, source.range_lsb, noise.range),
        azimuth=at_least(estimate.azimuth, source.azimuth_lsb, noise.azimuth),
        xy=at_least(estimate.xy, source.xy_lsb, noise.xy),
    )


def widened(noise: Noise, d2: _Array) -> Noise:
    """Widen the noise of a source whose innovations are larger than it explains.

    Errors that persist from plot to plot (multilateration, satellite navigation) hardly show in the scatter about a
    short curve, but they do in the innovations: where the 0.8 quantile of d2 = nu' S^-1 nu exceeds that of its law,
    every standard deviation grows by the root of the ratio.

    Args:
        noise: what the tracks were made with.
        d2: of updates in steady motion, two degrees of freedom.
    """
    if len(d2) < _MIN_WINDOWS:
        return noise
    factor = float(np.sqrt(max(1.0, float(np.quantile(d2, _SHARE)) / _CHI2_QUANTILE)))
    return replace(noise, range=noise.range * factor, azimuth=noise.azimuth * factor, xy=noise.xy * factor)
