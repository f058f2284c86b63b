"""Bearings of cameras on tracks: the track's position across the line of sight is measured, nothing along it."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.tracks.associate import Pairs
from saltus.tracks.kinematics import Kinematics, Plan
from saltus.tracks.lifecycle import CONFIRMED, Lifecycle
from saltus.tracks.measurements import Measurements

__all__ = ["Sighted", "sight"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]

_LATEST = -2.0  # s: how far a bearing may lie before its track's last update


class Sighted(NamedTuple):
    """Pairs of confirmed tracks and bearings inside their gates, with a copy of each pair's track at that time."""

    pairs: Pairs  # rows of the bank, positions in the slice
    plan: Plan  # one component: the distance across the line of sight
    cov: _Array  # (P, 3, 3)
    centre: _Array  # (P, 2), predicted position, m
    centre_cov: _Array  # (P, 2, 2), of the predicted position, m^2
    log_f: _Array  # (P,): log density of the bearing, per rad
    copies: Kinematics
    copy: _Index  # (P,): row of each pair among the copies


def sight(kinematics: Kinematics, life: Lifecycle, m: Measurements, index: _Index, gate: float) -> Sighted:
    """Pair confirmed tracks with the bearings `index` of a slice.

    With o the observer, u the unit vector along the bearing beta and c across it, the sensor's equation
    beta = atan2(x - o_x, y - o_y) + v linearised about the predicted position y is, times rho = u'(y - o),

        0 = c'(x - o) + rho v,   innovation -c'(y - o),  variance c'P c + (rho sigma)^2.

    It is exact in the angle (no wrapping is met); the filter takes the variance times the source's inflation.

    Args:
        kinematics: the filters of all tracks.
        life: their lifecycle.
        m: measurements.
        index: bearings of one source in one slice.
        gate: quantile of the chi-square law of one degree of freedom.

    Source: linearisation of the bearing at the predicted position, the extended Kalman filter's.
    """
    near = _candidates(life, m, index, gate)
    plot = index[near.plot]
    dt = m.time[plot] - life.time[near.track]
    offset = np.minimum(dt, 0.0)
    copies = kinematics.predicted(near.track, np.maximum(dt, 0.0))
    every = np.arange(len(plot))
    u, c = _directions(m.bearing[plot])
    mean, cov = copies.widest(every)
    rho, aside = _along(mean, offset, m.origin[plot], u), _along(mean, offset, m.origin[plot], c)
    P = cov[:, :3:2, :3:2]  # the offset of a late bearing is too short to matter here
    sigma = rho * m.sigma_bearing[plot]
    S = np.einsum("ki,kij,kj->k", c, P, c) + sigma**2
    inside = np.flatnonzero((rho > 0.0) & (aside**2 <= gate * S))
    c, rho, sigma, offset = c[inside], rho[inside], sigma[inside], offset[inside]
    mixture = copies.moments(inside)
    P = mixture.cov[:, :3:2, :3:2]
    S = np.einsum("ki,kij,kj->k", c, P, c) + sigma**2
    d2 = _along(mixture.mean, offset, m.origin[plot[inside]], c) ** 2 / S
    sigma = sigma * np.sqrt(m.inflation[plot[inside]])
    z, C = np.full((len(inside), 3), np.nan), np.zeros((len(inside), 3, 6))
    z[:, 0] = (c * m.origin[plot[inside]]).sum(axis=-1)
    C[:, 0, :3:2], C[:, 0, 1:4:2] = c, offset[:, None] * c
    R = np.tile(np.eye(3), (len(inside), 1, 1))
    R[:, 0, 0] = sigma**2
    centre = mixture.mean[:, :3:2] + offset[:, None] * mixture.mean[:, 1:4:2]
    return Sighted(
        Pairs(near.track[inside], near.plot[inside]),
        Plan(z, C),
        R,
        centre,
        P,
        np.log(rho) - 0.5 * (d2 + np.log(2.0 * np.pi * S)),
        copies,
        inside,
    )


def _candidates(life: Lifecycle, m: Measurements, index: _Index, gate: float) -> Pairs:
    """Pair every confirmed track with every bearing it could have, judged from its last state alone."""
    rows = life.rows()
    rows = rows[life.status[rows] == CONFIRMED]
    track, plot = np.repeat(rows, len(index)), np.tile(np.arange(len(index)), len(rows))
    dt = m.time[index[plot]] - life.time[track]
    u, c = _directions(m.bearing[index[plot]])
    rho, aside = (_along(life.mean[track], dt, m.origin[index[plot]], v) for v in (u, c))
    cov = life.cov[track]
    speed = np.hypot(life.mean[track, 1], life.mean[track, 3])
    spread = np.sqrt(cov[:, 0, 0] + cov[:, 2, 2] + dt**2 * (cov[:, 1, 1] + cov[:, 3, 3]))
    reach = np.sqrt(gate) * (2.0 * spread + np.abs(rho) * m.sigma_bearing[index[plot]]) + speed * np.abs(dt)
    keep = (dt > _LATEST) & (np.abs(aside) <= reach)
    return Pairs(track[keep], plot[keep])


def _directions(bearing: _Array) -> tuple[_Array, _Array]:
    """Unit vectors along bearings and across them."""
    s, k = np.sin(bearing), np.cos(bearing)
    return np.stack([s, k], axis=-1), np.stack([k, -s], axis=-1)


def _along(mean: _Array, offset: _Array, origin: _Array, direction: _Array) -> _Array:
    """Component of the position seen from the observer."""
    position = mean[:, :3:2] + offset[:, None] * mean[:, 1:4:2]
    return np.asarray(((position - origin) * direction).sum(axis=-1))
