"""Reports of any kind to positions in the tracker's plane, with the covariance of their errors."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.geo.earth import Site, Sites, ecef_to_geodetic, geodetic_to_ecef, local_basis, polar_to_geodetic
from saltus.geo.ground import ground_range
from saltus.geo.plane import Plane, true_from_plane
from saltus.geo.spherical import spherical_to_cartesian, variance

__all__ = ["PlanePositions", "geodetic_to_plane", "local_to_plane", "polar_to_plane", "spherical_to_plane"]

HEIGHT_PRIOR = (5000.0, 3500.0)  # m: mean and standard deviation of the height of a target that does not tell it

Array = npt.NDArray[np.float64]


class PlanePositions(NamedTuple):
    """Positions in a `Plane` with the covariance of their errors, one per report."""

    xy: Array  # (N, 2), m
    cov: Array  # (N, 2, 2), m^2
    altitude: Array  # (N,), m; NaN where unknown
    altitude_var: Array  # (N,), m^2; inf where unknown
    cross: Array  # (N, 2), m^2: covariance of xy with the altitude; 0 where unknown


def polar_to_plane(
    slant: npt.ArrayLike,
    azimuth: npt.ArrayLike,
    altitude: npt.ArrayLike,
    site: Site | Sites,
    plane: Plane,
    *,
    sigma_range: npt.ArrayLike,
    sigma_azimuth: npt.ArrayLike,
    sigma_altitude: npt.ArrayLike,
    height_prior: tuple[float, float] = HEIGHT_PRIOR,
    unbiased: bool = True,
) -> PlanePositions:
    """Place plots of slant range, azimuth and (where known) altitude in a plane.

    Along the ray, with eps the elevation at the site and eps_t at the target,
    d(ground) = (dr - sin(eps_t) dh + sin(eps) dhs) / cos(eps_t); across it, r cos(eps) dbeta; hence
    cov(along, altitude) = -tan(eps_t) sigma_altitude^2. An unknown site height widens the first term only.

    Where the altitude is unknown (NaN), mean and variance of the ground range are taken over a normal height
    prior cut to what the range allows: not below the radio horizon or sea level, not above the site by more than
    the slant range. Near overhead, where the above fails, they are taken likewise over the altitude's error; a
    triangle that cannot be (slant < height difference) comes out overhead with a covariance as large as the
    contradiction.

    Args:
        slant: slant range, m, (N,).
        azimuth: rad from north, clockwise, (N,).
        altitude: m, (N,); NaN where unknown.
        site: where the radar stands, or stood at each report.
        plane: the plane of the result.
        sigma_range: standard deviation of the slant range, m, scalar or (N,), as are the next two.
        sigma_azimuth: of the azimuth, rad.
        sigma_altitude: of the altitude, m; ignored where that is unknown.
        height_prior: mean and standard deviation, m, for targets of unknown altitude.
        unbiased: move the position outwards by exp(sigma_azimuth^2/2), and use the azimuth's exact moments.

    Raises:
        DataError: a standard deviation is negative.
    """
    r, beta, h, var_r, var_b, var_h = _columns(
        slant,
        azimuth,
        altitude,
        variance("sigma_range", sigma_range),
        variance("sigma_azimuth", sigma_azimuth),
        variance("sigma_altitude", sigma_altitude),
    )
    ground = ground_range(r, beta, h, var_r, var_h, site, height_prior)
    lat, lon, _, azimuth_t = polar_to_geodetic(r, beta, ground.height, site)
    convergence, scale = plane.factors_at(lat, lon)
    bearing = azimuth_t - convergence
    along = np.stack([np.sin(bearing), np.cos(bearing)], axis=-1) * scale[:, None]
    across = np.stack([np.cos(bearing), -np.sin(bearing)], axis=-1) * scale[:, None]
    xy, var_along, var_across = plane.forward(lat, lon), ground.var, ground.rho**2 * var_b
    if unbiased:
        xy = xy + along * (ground.rho * np.expm1(var_b / 2))[:, None]
        var_along = ground.var * np.cosh(var_b) + ground.rho**2 * 2 * np.sinh(var_b / 2) ** 2
        var_across = (ground.rho**2 + ground.var) * np.sinh(var_b)
    cov = _outer(along) * var_along[:, None, None] + _outer(across) * var_across[:, None, None]
    known = np.isfinite(h)
    cross = along * np.where(known, ground.cov_altitude, 0.0)[:, None]
    return PlanePositions(xy, cov, h, np.where(known, var_h, np.inf), cross)


def spherical_to_plane(
    slant: npt.ArrayLike,
    azimuth: npt.ArrayLike,
    elevation: npt.ArrayLike,
    site: Site | Sites,
    plane: Plane,
    *,
    sigma_range: npt.ArrayLike,
    sigma_azimuth: npt.ArrayLike,
    sigma_elevation: npt.ArrayLike,
    unbiased: bool = True,
) -> PlanePositions:
    """Place plots of a radar that measures elevation; the altitude comes out of the measurement.

    The Cartesian position and covariance of `spherical_to_cartesian` at the site, turned to east, north and up at
    the target. An unknown site height widens the altitude.

    Args:
        slant: slant range, m, (N,).
        azimuth: rad from north, clockwise, (N,).
        elevation: rad above the site's horizontal plane, (N,).
        site: where the radar stands, or stood at each report.
        plane: the plane of the result.
        sigma_range: standard deviation of the slant range, m, scalar or (N,), as are the next two.
        sigma_azimuth: of the azimuth, rad.
        sigma_elevation: of the elevation, rad.
        unbiased: remove the conversion bias.

    Raises:
        DataError: a standard deviation is negative.
    """
    r, beta, eps = _columns(slant, azimuth, elevation)
    local, cov = spherical_to_cartesian(
        r, np.pi / 2 - beta, eps, sigma_range, sigma_azimuth, sigma_elevation, unbiased=unbiased
    )
    lat, lon, h, turn = _place(local, site)
    cov = turn @ cov @ np.swapaxes(turn, -1, -2)
    shrink = _plane_from_true(plane, lat, lon, h)
    cross = (shrink @ cov[:, :2, 2:])[..., 0]
    level = shrink @ cov[:, :2, :2] @ np.swapaxes(shrink, -1, -2)
    return PlanePositions(plane.forward(lat, lon), level, h, cov[:, 2, 2] + site.sigma_height**2, cross)


def local_to_plane(
    x: npt.ArrayLike,
    y: npt.ArrayLike,
    altitude: npt.ArrayLike,
    site: Site | Sites,
    plane: Plane,
    sigma_xy: npt.ArrayLike,
    sigma_altitude: npt.ArrayLike,
) -> PlanePositions:
    """Place reports given by east and north (m) in the tangent plane of a site.

    The point of that east and north that has the altitude. Where the altitude is unknown (NaN), it is taken for the
    site's in placing the point (surface targets), and stays unknown.

    Args:
        x: east of the site, m, (N,).
        y: north of the site, m, (N,).
        altitude: m, (N,); NaN where unknown.
        site: origin of x and y, or one for each report.
        plane: the plane of the result.
        sigma_xy: standard deviation of x and of y, m, scalar or (N,).
        sigma_altitude: of the altitude, m; ignored where that is unknown.

    Raises:
        DataError: a standard deviation is negative.
    """
    east, north, alt, var_xy, var_h = _columns(
        x, y, altitude, variance("sigma_xy", sigma_xy), variance("sigma_altitude", sigma_altitude)
    )
    known = np.isfinite(alt)
    target = np.where(known, alt, site.height)
    local = np.stack([east, north, target - site.height], axis=-1)
    for _ in range(4):
        lat, lon, found, turn = _place(local, site)
        local[:, 2] += (target - found) / turn[:, 2, 2]
    # Raising the point along the site's vertical moves it over the ground where the two verticals differ.
    slide = turn[:, :2, 2] / turn[:, 2:, 2]
    var_slide = np.where(known, var_h, 0.0)
    cov = var_xy[:, None, None] * np.eye(2) + var_slide[:, None, None] * _outer(slide)
    shrink = _plane_from_true(plane, lat, lon, target)
    cross = (shrink @ (slide * var_slide[:, None])[..., None])[..., 0]
    level = shrink @ cov @ np.swapaxes(shrink, -1, -2)
    return PlanePositions(plane.forward(lat, lon), level, alt, np.where(known, var_h, np.inf), cross)


def geodetic_to_plane(
    latitude: npt.ArrayLike,
    longitude: npt.ArrayLike,
    altitude: npt.ArrayLike,
    plane: Plane,
    sigma_xy: npt.ArrayLike,
    sigma_altitude: npt.ArrayLike,
) -> PlanePositions:
    """Place reports given by latitude and longitude (rad, WGS-84); altitude in m, NaN where unknown.

    Raises:
        DataError: a standard deviation is negative.
    """
    lat, lon, alt, var_xy, var_h = _columns(
        latitude,
        longitude,
        altitude,
        variance("sigma_xy", sigma_xy),
        variance("sigma_altitude", sigma_altitude),
    )
    shrink = _plane_from_true(plane, lat, lon, alt)
    cov = var_xy[:, None, None] * (shrink @ np.swapaxes(shrink, -1, -2))
    altitude_var = np.where(np.isfinite(alt), var_h, np.inf)
    return PlanePositions(plane.forward(lat, lon), cov, alt, altitude_var, np.zeros((len(lat), 2)))


def _columns(*values: npt.ArrayLike) -> tuple[Array, ...]:
    return np.broadcast_arrays(*(np.atleast_1d(np.asarray(v, np.float64)) for v in values))


def _outer(vectors: Array) -> Array:
    return np.asarray(vectors[..., :, None] * vectors[..., None, :])


def _place(local: Array, site: Site | Sites) -> tuple[Array, Array, Array, Array]:
    """Points east, north, up of a site: latitude, longitude, height, and the turn to their own axes."""
    basis = local_basis(site.latitude, site.longitude)
    offset = (local[..., None, :] @ basis)[..., 0, :]
    lat, lon, h = ecef_to_geodetic(geodetic_to_ecef(site.latitude, site.longitude, site.height) + offset)
    return lat, lon, h, local_basis(lat, lon) @ np.swapaxes(basis, -1, -2)


def _plane_from_true(plane: Plane, lat: Array, lon: Array, altitude: Array) -> Array:
    """Inverse of `true_from_plane`: a turn times a factor."""
    turn = true_from_plane(*plane.factors_at(lat, lon), lat, altitude)
    return np.asarray(np.swapaxes(turn, -1, -2) / np.linalg.det(turn)[..., None, None])
