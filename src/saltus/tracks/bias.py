"""Lasting errors of a system: what they do to a report, what is known of them over time, and taking them out."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from saltus.shapes import Bool, Float
from saltus.tracks.measurements import Measurements

__all__ = ["GROUPS", "PARAMETERS", "BiasSeries", "corrected", "effects", "learnt", "second_order", "spread", "steps"]

_Array = npt.NDArray[np.float64]

PARAMETERS = ("east_m", "north_m", "azimuth_rad", "range_m", "range_scale", "time_s")
GROUPS: Mapping[str, tuple[int, ...]] = {  # what is separable or not as a whole
    "position offset": (0, 1),
    "azimuth": (2,),
    "range": (3,),
    "range scale": (4,),
    "time": (5,),
}


@dataclass(frozen=True, slots=True, eq=False)
class BiasSeries:
    """What was known of a system's biases from each time on, by reports before it alone.

    A bias is reported minus true; true is what the system it is compared with says. Parameters not estimated are 0
    with variance 0. Before the first time nothing is known, and the prior holds.
    """

    time: Float[np.ndarray, " e"]  # s, from when on
    mean: Float[np.ndarray, "e q"]
    cov: Float[np.ndarray, "e q q"]
    estimated: Bool[np.ndarray, "e q"]
    scatter: Float[np.ndarray, " e"]  # m: standard deviation between objects, each axis
    objects: npt.NDArray[np.int64]  # (E,): pairs of tracks that it rests on
    excess: Float[np.ndarray, " e"]  # m: of what differs within an object beyond the stated noise, each axis
    prior: Float[np.ndarray, " q"]  # standard deviations before anything is known

    def at(self, time: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, "n q"], Float[np.ndarray, "n q q"]]:
        """Return mean and covariance known at given times."""
        index = np.searchsorted(self.time, time, side="right")  # 0: before the first
        mean = np.concatenate([np.zeros((1, len(PARAMETERS))), self.mean])
        cov = np.concatenate([np.diag(self.prior**2)[None], self.cov])
        return mean[index], cov[index]


def steps(time: Float[np.ndarray, " e"], values: Float[np.ndarray, " e"], at: Float[np.ndarray, " n"]) -> _Array:
    """Return the values known at given times, 0 before the first."""
    return np.append(0.0, values)[np.searchsorted(time, at, side="right")]


def effects(ray: Float[np.ndarray, "n 2"], velocity: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2 q"]:
    """Return the change of reported position per unit of each bias, the columns in the order of `PARAMETERS`.

    An azimuth too great by d turns the ray (x, y) clockwise, to (x + d y, y - d x); a range too long by r moves along
    it; a time stamp late by t says where the object was, -t v.

    Args:
        ray: from the site to the position, m; NaN where the sensor measures no range and azimuth: no such effect.
        velocity: m/s.
    """
    n = len(ray)
    polar = np.isfinite(ray[:, 0])
    away = np.where(polar[:, None], ray, 0.0)
    distance = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1.0)
    out = np.zeros((n, 2, len(PARAMETERS)))
    out[:, 0, 0] = out[:, 1, 1] = 1.0
    out[:, 0, 2], out[:, 1, 2] = away[:, 1], -away[:, 0]
    out[:, :, 3] = away / distance[:, None]
    out[:, :, 4] = away
    out[:, :, 5] = -velocity
    return out


def second_order(mean: Float[np.ndarray, "*n q"]) -> Float[np.ndarray, "*n q"]:
    """Return biases whose linear effect on reported rays is right to the second order of an azimuth bias.

    Turning a reported ray p back by d takes away d c + d^2/2 p, c the effect of azimuth: like a scale error of d^2/2.
    """
    out = np.array(mean)
    out[..., 4] += 0.5 * mean[..., 2] ** 2
    return out


def spread(effect: Float[np.ndarray, "n 2 q"], cov: Float[np.ndarray, "*n q q"]) -> Float[np.ndarray, "n 2 2"]:
    """Return the covariance of position that uncertain biases leave, B P B', m^2."""
    return np.asarray(effect @ cov @ effect.swapaxes(-1, -2))


def learnt(
    series: BiasSeries,
    ray: Float[np.ndarray, "n 2"],
    velocity: Float[np.ndarray, "n 2"],
    before: Float[np.ndarray, " n"],
    after: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 2"]:
    """Return how much further corrections move a position at one time than they did at an earlier one, m.

    Args:
        series: what was known of a system's biases.
        ray: from the site to the position, m; NaN where the sensor measures no range and azimuth.
        velocity: m/s.
        before: s.
        after: s.
    """
    change = series.at(after)[0] - series.at(before)[0]
    return np.asarray(-np.einsum("nij,nj->ni", effects(ray, velocity), change))


def corrected(m: Measurements, at: npt.NDArray[np.intp], series: BiasSeries) -> Measurements:
    """Return the measurements with the biases of one system taken out of its own, as known at their times.

    Azimuth turns the ray back exactly; range, scale and offset shift the position; time shifts the time stamp, so the
    order may change: sort afterwards.

    Args:
        m: measurements of all systems.
        at: which of them are the system's, (k,).
        series: its biases.
    """
    mean, _ = series.at(m.time[at])
    ray = m.ray[at]
    polar = np.isfinite(ray[:, 0])
    shift = -mean[:, :2]
    c, s = np.cos(mean[:, 2]), np.sin(mean[:, 2])
    distance = np.hypot(ray[:, 0], ray[:, 1])
    shorter = np.where(polar, 1.0 - mean[:, 3] / np.maximum(distance, 1.0) - mean[:, 4], 1.0)
    turned = shorter[:, None] * np.stack([c * ray[:, 0] - s * ray[:, 1], s * ray[:, 0] + c * ray[:, 1]], axis=-1)
    shift = shift + np.where(polar[:, None], turned - ray, 0.0)
    position, polar_values, rays, time = m.position.copy(), m.polar.copy(), m.ray.copy(), m.time.copy()
    position[at, :2] += shift
    rays[at] = turned
    polar_values[at, 0] -= mean[:, 3] + mean[:, 4] * polar_values[at, 0]
    polar_values[at, 1] -= mean[:, 2]
    time[at] -= mean[:, 5]
    return replace(m, position=position, polar=polar_values, ray=rays, time=time, bearing=_turned(m, at, mean))


def _turned(m: Measurements, at: npt.NDArray[np.intp], mean: _Array) -> _Array:
    bearing = m.bearing.copy()
    bearing[at] -= mean[:, 2]
    return bearing
