"""What a slant range says of the distance over the ground, with the height known, doubtful or unknown."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.geo.earth import Site, Sites, radius_of_curvature, slant_to_ground

__all__ = ["GroundRange", "ground_range"]

N_NODES = 24  # Gauss-Legendre nodes over the height
NEAR_OVERHEAD = 8.0  # slant range less height difference, in standard deviations, below which we integrate
HORIZON_RADIUS = 4.0 / 3.0 * 6371e3  # m: the radio horizon of the standard atmosphere
_NODES, _NODE_WEIGHTS = np.polynomial.legendre.leggauss(N_NODES)

Array = npt.NDArray[np.float64]


class GroundRange(NamedTuple):
    """What a slant range and a height say of the distance over the ground (on the ellipsoid)."""

    height: Array  # the height that gives the mean ground range
    rho: Array  # distance from the site's vertical, m
    var: Array  # of the ground range, m^2
    cov_altitude: Array  # of ground range and altitude, m^2


def ground_range(
    r: Array, beta: Array, h: Array, var_r: Array, var_h: Array, site: Site | Sites, prior: tuple[float, float]
) -> GroundRange:
    """Ground range by linearisation where that is good, by quadrature over the height where not."""
    known = np.isfinite(h)
    mean = np.where(known, h, prior[0])
    var_h = np.where(known, var_h, prior[1] ** 2)
    big_r, hs = radius_of_curvature(site.latitude, beta), np.broadcast_to(site.height, r.shape)
    var_d = var_h + site.sigma_height**2 + var_r
    excess = np.abs(mean - hs) - r
    rough = ~known | (-excess < NEAR_OVERHEAD * np.sqrt(var_d))
    height, var, cov = mean.copy(), np.empty_like(r), np.empty_like(r)
    if rough.any():
        # A contradiction beyond the stated errors means that one of them was understated.
        var_d = np.maximum(var_d, np.where(excess > 0, excess / 2, 0.0) ** 2)
        lowest = np.where(known, -np.inf, _horizon(r, hs))
        mean_g, var_g, cov_g = _integrate(r[rough], mean[rough], var_d[rough], lowest[rough], big_r[rough], hs[rough])
        height[rough] = _height_at(r[rough], mean_g, big_r[rough], hs[rough])
        var[rough] = var_g + var_r[rough]  # 1/cos^2 = 1 + tan^2: the second part is in var_d
        cov[rough] = cov_g * var_h[rough] / var_d[rough]
    theta = slant_to_ground(r, height, hs, big_r) / big_r
    shrink, fine = big_r / (big_r + height), ~rough
    rise = (height - hs) + (big_r + hs) * 2 * np.sin(theta / 2) ** 2
    run = (big_r + hs) * np.sin(theta)
    tangent = rise / np.where(fine, run, 1.0)  # of the elevation at the target
    site_part = (tangent * np.cos(theta) - np.sin(theta)) * site.sigma_height  # sin(eps) / cos(eps_t)
    linear = shrink**2 * (var_r * (1 + tangent**2) + tangent**2 * var_h + site_part**2)
    return GroundRange(
        height,
        big_r * np.sin(theta),
        np.where(fine, linear, var),
        np.where(fine, -shrink * tangent * var_h, cov),
    )


def _horizon(r: Array, hs: Array) -> Array:
    """Least height of a target seen at a range: 0, or the radio horizon of a standard atmosphere."""
    own = np.sqrt(2 * HORIZON_RADIUS * np.maximum(hs, 0.0))
    return np.asarray(np.clip((r - own), 0.0, None) ** 2 / (2 * HORIZON_RADIUS))


def _integrate(
    r: Array, mean: Array, var_d: Array, lowest: Array, big_r: Array, hs: Array
) -> tuple[Array, Array, Array]:
    """Moments of the ground range over a normal height, cut to [lowest, hs + r] and at five sigma.

    Returns mean, variance, and covariance with the height. A normal law of (range - height difference), cut at
    zero, is the posterior of a target anywhere over the ground: area grows as the square of the ground range,
    that is, in proportion to this difference.
    """
    sigma = np.sqrt(np.maximum(var_d, 1e-6))
    centre = np.clip(mean, hs - r, hs + r)
    upper = np.minimum(hs + r, centre + 5 * sigma)
    # A target seen beyond the horizon of all that flies keeps a strip of five to three sigma to be in.
    lower = np.maximum(np.minimum(lowest, mean + 3 * sigma), np.maximum(centre - 5 * sigma, hs - r))
    lower = np.minimum(lower, upper)
    h = lower[:, None] + (upper - lower)[:, None] * (1 + _NODES) / 2
    log_w = -0.5 * ((h - mean[:, None]) / sigma[:, None]) ** 2
    w = _NODE_WEIGHTS * np.exp(log_w - log_w.max(axis=1, keepdims=True))
    w /= w.sum(axis=1, keepdims=True)
    ground = slant_to_ground(r[:, None], h, hs[:, None], big_r[:, None])
    mean_g = (w * ground).sum(axis=1)
    off = ground - mean_g[:, None]
    mean_h = (w * h).sum(axis=1, keepdims=True)
    return mean_g, (w * off**2).sum(axis=1), (w * off * (h - mean_h)).sum(axis=1)


def _height_at(r: Array, ground: Array, big_r: Array, hs: Array) -> Array:
    """Height of the upper point of a sphere's vertical at a ground range that lies at a slant range."""
    theta = ground / big_r
    run = (big_r + hs) * np.sin(theta)
    rise = np.sqrt(np.maximum((r - run) * (r + run), 0.0))
    return np.asarray(hs - (big_r + hs) * 2 * np.sin(theta / 2) ** 2 + rise)
