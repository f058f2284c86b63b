"""Bearings of cameras on tracks: the track's position across the line of sight is measured, nothing along it."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.tracks.associate import Pairs
from saltus.tracks.channel import MOTION, Plan
from saltus.tracks.colour import NO_SOURCE
from saltus.tracks.faults import SourceCondition
from saltus.tracks.gates import Gate, Gated
from saltus.tracks.kinematics import Kinematics
from saltus.tracks.lifecycle import CONFIRMED, Lifecycle
from saltus.tracks.measurements import Measurements

__all__ = ["sight", "sighted"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]

_LATEST = -2.0  # s: how far a bearing may lie before its track's last update


class _Line(NamedTuple):
    """Tracks moved to the times of bearings, and where these lead past the most agile mode."""

    copies: Kinematics
    offset: _Array  # (P,) s, <= 0
    across: _Array  # (P, 2): unit vector across the line of sight
    rho: _Array  # (P,): distance along it, m
    aside: _Array  # (P,): distance across it, m
    variance: _Array  # (P,): of that, of the track alone, m^2
    C: _Array  # (P, 6 + slots): how the states enter
    carried: _Array  # (P,): variance of the bearing that states stand for, rad^2
    lasting: _Array  # (P,): variance of lasting errors that none stands for, rad^2


def sight(
    kinematics: Kinematics,
    life: Lifecycle,
    m: Measurements,
    index: _Index,
    gate: Gate,
    source: SourceCondition,
    prior: _Array,
) -> Gated:
    """Pair confirmed tracks with the bearings `index` of a slice.

    With o the observer, u the unit vector along the bearing beta and c across it, the sensor's equation
    beta = atan2(x - o_x, y - o_y) + v linearised about the predicted position y is, times rho = u'(y - o),

        0 = c'(x - o) + rho v,   innovation -c'(y - o),  variance c'P c + (rho sigma)^2.

    It is exact in the angle (no wrapping is met); sigma is that of every hypothesis of the source. Where the track has
    a state u for the source's lasting errors of deviation L, v = L u + the rest.

    Args:
        kinematics: the filters of all tracks.
        life: their lifecycle.
        m: measurements.
        index: bearings of one source in one slice.
        gate: the gates.
        source: the condition of that source, and what may be wrong with its bearings.
        prior: log probabilities of the conditions.

    Source: linearisation of the bearing at the predicted position, the extended Kalman filter's.
    """
    live = source.live(prior)
    near = _candidates(life, m, index, gate, source, live)
    plot = index[near.plot]
    line = _line(kinematics, life, m, near.track, plot)
    limit = np.where(source.law.fault[live] > 0, gate.fault_bearing, gate.height)
    angular = source.law.angular(m.sigma_bearing[plot], live) - line.carried[:, None]
    S = line.variance[:, None] + line.rho[:, None] ** 2 * angular
    inside = np.flatnonzero((line.rho > 0.0) & (line.aside[:, None] ** 2 <= limit * S).any(axis=1))
    return _gated(line, Pairs(near.track[inside], near.plot[inside]), inside, m, plot[inside], source)


def sighted(
    kinematics: Kinematics, life: Lifecycle, m: Measurements, rows: _Index, plots: _Index, source: SourceCondition
) -> Gated:
    """Measure tracks by bearings that are known to be theirs: rows and plots (P,), of one source.

    Bearings that lead away from their track are left out.
    """
    line = _line(kinematics, life, m, rows, plots)
    ahead = np.flatnonzero(line.rho > 0.0)
    return _gated(line, Pairs(rows[ahead], ahead), ahead, m, plots[ahead], source)


def _line(kinematics: Kinematics, life: Lifecycle, m: Measurements, track: _Index, plot: _Index) -> _Line:
    dt, source = m.time[plot] - life.time[track], int(m.source[plot[0]]) if len(plot) else NO_SOURCE
    offset = np.minimum(dt, 0.0)
    copies = kinematics.predicted(track, np.maximum(dt, 0.0), source, m.time[plot])
    u, c = _directions(m.bearing[plot])
    mean, cov = copies.widest(np.arange(len(plot)))
    rho, aside = _along(mean, offset, m.origin[plot], u), _along(mean, offset, m.origin[plot], c)
    C, effect = np.zeros(mean.shape), m.lasting[plot]
    C[:, :3:2], C[:, 1:4:2] = c, offset[:, None] * c
    C[:, MOTION:] = rho[:, None] * copies.colours.columns(source, effect)[:, 0]
    carried = copies.colours.carried(source, effect)[:, 0, 0]
    aside = aside + (C[:, MOTION:] * mean[:, MOTION:]).sum(axis=1)
    variance = np.einsum("ki,kij,kj->k", C, cov, C)
    return _Line(copies, offset, c, rho, aside, variance, C, carried, effect[:, 0, 0] ** 2 - carried)


def _gated(line: _Line, pairs: Pairs, inside: _Index, m: Measurements, plot: _Index, source: SourceCondition) -> Gated:
    c, rho, offset, row = line.across[inside], line.rho[inside], line.offset[inside], line.C[inside]
    mean, cov = line.copies.mixture(inside)
    far = rho[:, None] ** 2
    variance = far * (source.law.angular(m.sigma_bearing[plot]) - line.carried[inside, None])
    aside = (row * mean).sum(axis=1) - (c * m.origin[plot]).sum(axis=1)
    d2 = aside**2 / (np.einsum("ki,kij,kj->k", row, cov, row) + variance[:, 0])
    z, C = np.full((len(inside), 3), np.nan), np.zeros((len(inside), 3, row.shape[1]))
    z[:, 0], C[:, 0] = (c * m.origin[plot]).sum(axis=-1), row
    covs = np.tile(np.eye(3), (*variance.shape, 1, 1))
    again = line.copies.colours.again(int(m.source[plot[0]])) if len(plot) else 0.0
    covs[..., 0, 0] = variance + again * far * line.lasting[inside, None]
    return Gated(
        pairs,
        Plan(z, C),
        covs,
        np.log(rho),
        mean[:, :3:2] + offset[:, None] * mean[:, 1:4:2],
        cov[:, :3:2, :3:2],
        d2,
        np.zeros(len(inside), bool),
        line.copies,
        inside,
    )


def _candidates(
    life: Lifecycle, m: Measurements, index: _Index, gate: Gate, source: SourceCondition, live: _Index
) -> Pairs:
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
    sigma = np.sqrt(source.law.angular(m.sigma_bearing[index], live).max(axis=1))[plot]
    reach = np.sqrt(gate.height) * (2.0 * spread + np.abs(rho) * sigma) + speed * np.abs(dt)
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
