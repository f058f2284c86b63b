"""What a sensor's noise really is, from the straight stretches of its own tracks."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.records import Source
from saltus.tracks.lasting import Lasting
from saltus.tracks.measurements import Measurements, Noise

__all__ = ["LEAST", "LEAST_ANGLE", "NoiseEstimate", "apply_estimate", "estimate_noise", "widened", "with_lasting"]

_Array = npt.NDArray[np.float64]

LEAST = 0.01  # m: what an aircraft flies while no clock of a sensor tells the time better
LEAST_ANGLE = LEAST / 5e3  # rad: the same at a range of 5 km

_WINDOW, _INNER = 7, 5  # plots of one track; of what climbs bend as turns do positions, which no window leaves out
_STEP = 2.0  # s, some, between those of a position: in less, what an aircraft's position errs by looks like a turn
_FAST = 30.0  # m/s, from which errors of the time stamp show
_MAX_ACCEL = 1.0  # m/s^2 over the window: straighter than any turn of an aircraft
_MOVING = 3.0  # m/s
_MAX_GAP = 2.5  # of the median interval: no window spans a longer gap
_MIN_WINDOWS = 30  # fewer say nothing
_TRIM = 4.0
_ROUNDS = 4
_SHARE, _CHI2_QUANTILE = 0.8, 3.2189  # of the chi-square law of two degrees of freedom
_MAD = 1.4826  # normal standard deviation per median absolute deviation


class NoiseEstimate(NamedTuple):
    """Standard deviations found; NaN where the recording cannot tell."""

    range: float  # m
    azimuth: float  # rad
    xy: float  # m, each axis, for sources that give plane or geodetic positions
    time: float  # s, of the time stamps of such sources
    n_windows: int
    elevation: float = float("nan")  # rad
    range_rate: float = float("nan")  # m/s
    lasting: float = float("nan")  # rad or m, of errors that last; 0: none does
    lasting_time: float = float("nan")  # s
    lasting_distance: float = float("inf")  # m at which they are 1.4 times as large as at the sensor
    lasting_told: bool = False  # whether the recording tells that time, or it is assumed
    lasting_gain: float = float("nan")  # nats per report that they explain more than white errors


def estimate_noise(m: Measurements, track_id: npt.NDArray[np.int64], source: int) -> NoiseEstimate:
    """Estimate one source's noise from the scatter of its plots about local quadratics in time.

    For seven plots of one track, of positions some two seconds apart, a quadratic x(t), y(t) is fitted by least
    squares; the residual e of the middle plot has variance sigma^2 (1 - h), h its leverage, whatever constant
    acceleration the target has. Along and across the ray from the radar, sigma is the root mean square of
    e / sqrt(1 - h) over all straight windows, those beyond four median deviations (outliers, turns) left out. Of
    positions, sigma is found across the course, and from what is more along it the deviation of time stamps tau:
    mean e^2 = sigma^2 + tau^2 v^2. Elevations and range rates are taken as they are, by quadratics of their own.

    Args:
        m: measurements in time order.
        track_id: of each measurement, 0 none, (N,).
        source: which source.
    """
    index = np.flatnonzero((m.source == source) & (track_id > 0))
    index = index[np.lexsort((m.time[index], track_id[index]))]
    step = np.diff(m.time[index])[np.diff(track_id[index]) == 0]
    every = 1
    if (step > 0).any() and np.isnan(m.ray[index, 0]).any():
        every = max(1, round(_STEP / float(np.median(step[step > 0]))))
    for each in dict.fromkeys((every, 1)):  # tracks too short for windows of that length tell by shorter ones
        found = _estimated(m, track_id, index, each)
        if found.n_windows >= _MIN_WINDOWS:
            return found
    return found


def _estimated(
    m: Measurements, track_id: npt.NDArray[np.int64], index: npt.NDArray[np.intp], every: int
) -> NoiseEstimate:
    """Estimate from windows of every so many plots; `index` is sorted by track, then by time."""
    length = (_WINDOW - 1) * every + 1
    if len(index) < length:
        return NoiseEstimate(np.nan, np.nan, np.nan, np.nan, 0)
    window = np.lib.stride_tricks.sliding_window_view(index, length)[:, ::every]
    time = m.time[window] - m.time[window[:, _WINDOW // 2]][:, None]
    step = np.diff(m.time[window], axis=1)
    whole = (track_id[window] == track_id[window[:, :1]]).all(axis=1) & (step > 0).all(axis=1)
    whole &= step.max(axis=1) < _MAX_GAP * np.median(step[whole]) if whole.any() else False
    residual, velocity, accel = _middle_residuals(time[whole], m.position[window[whole], :2])
    straight = accel < _MAX_ACCEL
    moving = straight & (np.linalg.norm(velocity, axis=-1) > _MOVING)
    if moving.sum() >= _MIN_WINDOWS:  # what stands still repeats one rounded position and shows no noise
        straight = moving
    middle = window[whole, _WINDOW // 2][straight]
    found = _scatter(residual[straight], velocity[straight], m.ray[middle])
    inner = slice((_WINDOW - _INNER) // 2, (_WINDOW + _INNER) // 2)
    window, time = window[whole][straight][:, inner], time[whole][straight][:, inner]
    return found._replace(
        elevation=_of_values(m.elevation[window], time), range_rate=_of_values(m.range_rate[window], time)
    )


def _of_values(values: _Array, time: _Array) -> float:
    """Return the standard deviation of what windows measure beside positions, (W, 5); NaN where too few do."""
    measured = np.isfinite(values).all(axis=1)
    if measured.sum() < _MIN_WINDOWS:
        return np.nan
    residual, *_ = _middle_residuals(time[measured], values[measured][..., None])
    return float(_MAD * np.median(np.abs(residual)))  # climbs begin and end within the windows of some tracks


def _middle_residuals(time: _Array, xy: _Array) -> tuple[_Array, _Array, _Array]:
    """Return the middle plots' residuals with variance sigma^2, fitted velocities, (W, 2), and accelerations, (W,)."""
    scale = np.abs(time).max(axis=1, initial=0.0)[:, None]
    u = time / np.where(scale > 0, scale, 1.0)
    A = np.stack([np.ones_like(u), u, u * u], axis=-1)
    pinv = np.linalg.pinv(A)  # (W, 3, plots)
    middle = time.shape[1] // 2
    centre = xy[:, middle : middle + 1]
    coefficients = pinv @ (xy - centre)
    leverage = pinv[:, 0, middle]  # the middle plot is at u = 0
    residual = -coefficients[:, 0] / np.sqrt(1.0 - leverage)[:, None]
    unit = np.maximum(scale[:, 0], 1e-9)
    return residual, coefficients[:, 1] / unit[:, None], 2.0 * np.linalg.norm(coefficients[:, 2], axis=-1) / unit**2


def _scatter(residual: _Array, velocity: _Array, ray: _Array) -> NoiseEstimate:
    n = len(residual)
    if n < _MIN_WINDOWS:
        return NoiseEstimate(np.nan, np.nan, np.nan, np.nan, n)
    if np.isnan(ray).any():
        return NoiseEstimate(np.nan, np.nan, *_of_positions(residual, velocity), n)
    distance = np.linalg.norm(ray, axis=-1)
    u = ray / distance[:, None]
    along = residual[:, 0] * u[:, 0] + residual[:, 1] * u[:, 1]
    across = (residual[:, 1] * u[:, 0] - residual[:, 0] * u[:, 1]) / distance
    return NoiseEstimate(_trimmed(along), _trimmed(across), np.nan, np.nan, n)


def _of_positions(residual: _Array, velocity: _Array) -> tuple[float, float]:
    """Return the standard deviations of positions, m, and of their time stamps, s (NaN where too few are fast)."""
    speed = np.linalg.norm(velocity, axis=-1)
    fast = speed > _FAST
    if fast.sum() < _MIN_WINDOWS:
        return _trimmed(residual), np.nan
    moving = speed > _MOVING
    u = velocity[moving] / speed[moving, None]
    xy = _trimmed(residual[moving, 1] * u[:, 0] - residual[moving, 0] * u[:, 1])
    along, v = (residual[fast] * velocity[fast]).sum(axis=-1) / speed[fast], speed[fast]
    late = 0.0
    for _ in range(_ROUNDS):  # what is an outlier depends on it
        e = np.abs(along) / np.sqrt(np.maximum(xy**2 + (late * v) ** 2, 1e-12))
        inside = e <= _TRIM * _MAD * np.median(e)
        late = float(np.sqrt(max(0.0, np.mean(along[inside] ** 2) - xy**2) / np.mean(v[inside] ** 2)))
    return xy, late


def _trimmed(e: _Array) -> float:
    inside = np.abs(e) <= _TRIM * _MAD * np.median(np.abs(e))
    return float(np.sqrt(np.mean(np.square(e[inside]))))


def apply_estimate(noise: Noise, estimate: NoiseEstimate, source: Source) -> Noise:
    """Replace what was estimated, never below quantisation, LSB / sqrt(12), nor below `LEAST`."""
    step = np.sqrt(12.0)

    def at_least(value: float, lsb: float, otherwise: float, least: float = LEAST) -> float:
        return max(value, lsb / step, least) if np.isfinite(value) and value > 0 else otherwise

    return replace(
        noise,
        range=at_least(estimate.range, source.range_lsb, noise.range),
        azimuth=at_least(estimate.azimuth, source.azimuth_lsb, noise.azimuth, LEAST_ANGLE),
        elevation=at_least(estimate.elevation, source.elevation_lsb, noise.elevation, LEAST_ANGLE),
        range_rate=at_least(estimate.range_rate, source.range_rate_lsb, noise.range_rate),
        xy=at_least(estimate.xy, source.xy_lsb, noise.xy),
        time=estimate.time if np.isfinite(estimate.time) else noise.time,
    )


def with_lasting(
    estimate: NoiseEstimate, noise: Noise, found: Lasting, source: Source, *, polar: bool
) -> tuple[NoiseEstimate, Noise]:
    """Put what was found of lasting errors into an estimate, and where there are any, into the noise.

    Then the rest of the noise is what they leave to each report by itself.
    """
    if np.isnan(found.white):
        return estimate, noise
    estimate = estimate._replace(
        lasting=found.lasting,
        lasting_time=found.time,
        lasting_distance=found.distance,
        lasting_told=found.told,
        lasting_gain=found.gain,
    )
    if not found.lasting:
        return estimate, noise
    lasts = replace(noise, lasting=found.lasting, lasting_time=found.time, lasting_distance=found.distance)
    if polar:
        return estimate, replace(lasts, azimuth=max(found.white, source.azimuth_lsb / np.sqrt(12.0), LEAST_ANGLE))
    return estimate, replace(lasts, xy=max(found.white, source.xy_lsb / np.sqrt(12.0), LEAST))


def widened(noise: Noise, d2: _Array) -> Noise:
    """Widen the noise of a source whose innovations are larger than it explains.

    Errors that persist from plot to plot (multilateration, satellite navigation) hardly show in the scatter about a
    short curve, but they do in the innovations: where the 0.8 quantile of d2 = nu' S^-1 nu exceeds that of its law,
    every standard deviation of a report by itself grows by the root of the ratio.

    Args:
        noise: what the tracks were made with.
        d2: of updates in steady motion, two degrees of freedom.
    """
    if len(d2) < _MIN_WINDOWS:
        return noise
    factor = float(np.sqrt(max(1.0, float(np.quantile(d2, _SHARE)) / _CHI2_QUANTILE)))
    wider = {name: getattr(noise, name) * factor for name in ("range", "azimuth", "xy", "time")}
    return replace(noise, **wider)
