"""What a rotating radar reports of moving objects: plots at the antenna's passage, noise, misses, clutter."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.geo import Plane, Site, geodetic_to_polar, wrap
from saltus.simulate.motion import Trajectory

__all__ = ["Observations", "Radar", "observe"]

Array = npt.NDArray[np.float64]
_N_PASSES = 12  # fixed-point steps to the antenna's passage; each gains a factor 2 pi R / (v T), at least 3


class Observations(NamedTuple):
    """Plots of one radar in time order."""

    time: Array  # (N,), s
    slant: Array  # (N,), m
    azimuth: Array  # (N,), rad from north, clockwise, [0, 2 pi)
    altitude: Array  # (N,), m; NaN where not reported
    target: npt.NDArray[np.int64]  # (N,): index of the trajectory, -1 = clutter


@dataclass(frozen=True, slots=True)
class Radar:
    """A rotating radar: where it stands, how it turns, how well it sees.

    Quantisation steps of 0 leave values as they are.

    Raises:
        ModelError: a value that cannot be.
    """

    site: Site
    period: float  # s, one turn of the antenna
    sigma_range: float  # m
    sigma_azimuth: float  # rad
    sigma_altitude: float = 0.0  # m, of the altitude the target reports
    prob_detection: float = 0.9
    clutter_per_scan: float = 0.0  # mean number of false plots in a turn, uniform over the area covered
    clutter_altitudes: tuple[float, float] | None = None  # m: false plots carry an altitude between these; None: none
    min_range: float = 500.0  # m
    max_range: float = 150e3  # m
    north_time: float = 0.0  # s, a time at which the antenna points north
    range_step: float = 0.0  # m
    azimuth_step: float = 0.0  # rad
    altitude_step: float = 0.0  # m

    def __post_init__(self) -> None:
        """Refuse what cannot be a radar."""
        sigmas = (self.sigma_range, self.sigma_azimuth, self.sigma_altitude, self.clutter_per_scan)
        steps = (self.range_step, self.azimuth_step, self.altitude_step)
        if min(*sigmas, *steps) < 0.0 or not 0.0 <= self.prob_detection <= 1.0:
            raise ModelError(f"sigmas, steps and clutter must be >= 0 and prob_detection in [0, 1]: {self}.")
        if self.period <= 0.0 or not 0.0 <= self.min_range < self.max_range:
            raise ModelError(f"period must be above 0 and 0 <= min_range < max_range: {self}.")

    def north_times(self, time_from: float, time_to: float) -> Array:
        """Times of passing north, from the last one before `time_from` to the first after `time_to`."""
        first = np.floor((time_from - self.north_time) / self.period)
        last = np.ceil((time_to - self.north_time) / self.period)
        return np.asarray(self.north_time + self.period * np.arange(first, last + 1))


def observe(
    radar: Radar,
    trajectories: Sequence[Trajectory],
    plane: Plane,
    time_from: float,
    time_to: float,
    rng: np.random.Generator,
) -> Observations:
    """Let a radar look at objects moving in a plane.

    Every object in range is seen at most once a turn, at the time the antenna points at it, with probability
    `prob_detection`; errors are Gaussian and independent. False plots are Poisson in number.

    Args:
        radar: the radar.
        trajectories: objects; x, y in `plane`, altitude.
        plane: the plane of the trajectories.
        time_from: s.
        time_to: s.
        rng: source of randomness.
    """
    parts = [_clutter(radar, time_from, time_to, rng)]
    for i, trajectory in enumerate(trajectories):
        time, slant, azimuth, altitude = _passages(radar, trajectory, plane, time_from, time_to)
        seen = (slant >= radar.min_range) & (slant <= radar.max_range)
        seen &= rng.uniform(size=len(time)) < radar.prob_detection
        slant = slant + radar.sigma_range * rng.standard_normal(len(time))
        azimuth = azimuth + radar.sigma_azimuth * rng.standard_normal(len(time))
        altitude = altitude + radar.sigma_altitude * rng.standard_normal(len(time))
        target = np.full(len(time), i)
        parts.append(Observations(time[seen], slant[seen], azimuth[seen], altitude[seen], target[seen]))
    time, slant, azimuth, altitude, target = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(time, kind="stable")
    return Observations(
        time[order],
        _quantised(np.maximum(slant, 0.0), radar.range_step)[order],
        _quantised(azimuth, radar.azimuth_step)[order] % (2 * np.pi),
        _quantised(altitude, radar.altitude_step)[order],
        target[order],
    )


def _passages(
    radar: Radar, trajectory: Trajectory, plane: Plane, time_from: float, time_to: float
) -> tuple[Array, Array, Array, Array]:
    """Times at which the antenna points at the object, and range, azimuth and altitude then."""
    begin, end = max(time_from, trajectory.start), min(time_to, trajectory.end)
    north = radar.north_times(begin, end) if begin <= end else np.empty(0)
    # Each start finds the passage within half a turn of it: two to a turn, so that none is missed.
    t = np.concatenate([north, north + radar.period / 2])
    for _ in range(_N_PASSES):
        t = np.clip(t, begin, end)
        _, azimuth, _ = _polar(radar, trajectory, plane, t)
        late = wrap(azimuth - 2 * np.pi * (t - radar.north_time) / radar.period)
        t = t + radar.period * late / (2 * np.pi)
    t = np.unique(t[(t >= begin) & (t <= end)])
    t = t[np.diff(t, prepend=-np.inf) > radar.period / 2]
    slant, azimuth, altitude = _polar(radar, trajectory, plane, t)
    late = np.abs(wrap(azimuth - 2 * np.pi * (t - radar.north_time) / radar.period))
    met = late < 1e-3  # what passes overhead may outrun the antenna
    return t[met], slant[met], azimuth[met], altitude[met]


def _polar(radar: Radar, trajectory: Trajectory, plane: Plane, times: Array) -> tuple[Array, Array, Array]:
    position = trajectory.at(times).position
    lat, lon = plane.inverse(position[:, :2])
    slant, azimuth, _ = geodetic_to_polar(lat, lon, position[:, 2], radar.site)
    return slant, azimuth, position[:, 2]


def _clutter(radar: Radar, time_from: float, time_to: float, rng: np.random.Generator) -> Observations:
    n = rng.poisson(radar.clutter_per_scan * (time_to - time_from) / radar.period)
    time = rng.uniform(time_from, time_to, n)
    slant = np.sqrt(rng.uniform(radar.min_range**2, radar.max_range**2, n))
    altitude = np.full(n, np.nan)
    if radar.clutter_altitudes is not None:
        altitude = rng.uniform(*radar.clutter_altitudes, n)
    azimuth = 2 * np.pi * (time - radar.north_time) / radar.period
    return Observations(time, slant, azimuth, altitude, np.full(n, -1))


def _quantised(values: Array, step: float) -> Array:
    return np.asarray(np.round(values / step) * step) if step > 0.0 else values
