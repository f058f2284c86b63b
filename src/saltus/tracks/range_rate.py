"""Range rates: a plot's fourth component, the speed along the ray from the radar, where the radar measures it."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.tracks.channel import Plan
from saltus.tracks.kinematics import Kinematics
from saltus.tracks.measurements import Measurements

__all__ = ["Rated", "rate_of", "with_range_rates"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]

_AT = 3  # component of a measurement, behind the position's


class Rated(NamedTuple):
    """Measurements of positions and range rates."""

    plan: Plan  # (P, 4)
    covs: _Array  # (P, h, 4, 4)
    used: npt.NDArray[np.bool_]  # (P,): which range rates lie inside their gates


def rate_of(mean: _Array, offset: _Array, site: _Array, cosine: _Array) -> tuple[_Array, _Array]:
    """Return range rates of states and their derivatives.

    With d = p + offset v - s from the site s in the plane, u = d / |d|, and e the elevation of the ray,

        h = cos(e) u'v + sin(e) v_z,   dh/dv = cos(e) u,   dh/dp = cos(e) (v - (u'v) u) / |d|.

    Args:
        mean: states (x, vx, y, vy, z, vz, ...), (k, n).
        offset: s from their time to the report's, (k,).
        site: plane x, y, m, (k, 2).
        cosine: of the elevation, (k,).

    Returns:
        h (k,), m/s, and the row C (k, n) of its derivatives; that by v_z is left to the noise, and 0 in it.
    """
    v = mean[:, 1:4:2]
    d = mean[:, 0:3:2] + offset[:, None] * v - site
    distance = np.maximum(np.linalg.norm(d, axis=-1), 1.0)[:, None]
    u = d / distance
    along = (u * v).sum(axis=-1)
    C = np.zeros_like(mean)
    C[:, 0:3:2] = cosine[:, None] * (v - along[:, None] * u) / distance
    C[:, 1:4:2] = cosine[:, None] * u + offset[:, None] * C[:, 0:3:2]
    return cosine * along + np.sqrt(1.0 - cosine**2) * mean[:, 5], C


def with_range_rates(
    plan: Plan, covs: _Array, copies: Kinematics, rows: _Index, m: Measurements, plot: _Index, limit: float
) -> Rated:
    """Add range rates to measurements of positions, linearised about the mixture's prediction.

    The row measured is z = r - h(x) + C x with noise sigma^2 + sin(e)^2 var(v_z). One that the most agile mode puts
    outside its gate (folded by ambiguity, or another echo's) is left out.

    Args:
        plan: of positions, (P, 3).
        covs: their covariances under every hypothesis, (P, h, 3, 3).
        copies: tracks moved to the reports' times.
        rows: the one of each pair, (P,).
        m: all measurements.
        plot: the one of each pair, (P,).
        limit: squared distance of the gate, one degree of freedom.

    Source: linearisation at the predicted state, the extended Kalman filter's.
    """
    offset = plan.C[:, 0, 1]
    site = m.position[plot, :2] - m.ray[plot]
    cosine = np.clip(np.linalg.norm(m.ray[plot], axis=-1) / m.polar[plot, 0], 0.0, 1.0)
    rate = m.range_rate[plot]
    told = np.isfinite(rate) & np.isfinite(cosine)
    site, cosine = np.where(told[:, None], site, 0.0), np.where(told, cosine, 1.0)
    expected, spread = copies.mixture(rows)
    value, C = rate_of(expected, offset, site, cosine)
    variance = m.sigma_range_rate[plot] ** 2 + (1.0 - cosine**2) * spread[:, 5, 5]
    mean, cov = copies.widest(rows)
    nu = rate - rate_of(mean, offset, site, cosine)[0]
    used = told & (nu**2 <= limit * (np.einsum("ki,kij,kj->k", C, cov, C) + variance))
    z = np.where(used, rate - value + (C * expected).sum(axis=-1), np.nan)
    wide = np.zeros((*covs.shape[:2], _AT + 1, _AT + 1))
    wide[..., :_AT, :_AT] = covs
    wide[..., _AT, _AT] = np.where(used, variance, 1.0)[:, None]
    return Rated(Plan(np.column_stack([plan.z, z]), np.concatenate([plan.C, C[:, None]], axis=1)), wide, used)
