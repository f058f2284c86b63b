"""Points on and above the WGS-84 ellipsoid: sites, curvature, slant range to ground range, a ray to a point."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.shapes import Float

__all__ = [
    "Site",
    "Sites",
    "circular_mean",
    "circular_median",
    "ecef_to_geodetic",
    "geodetic_to_ecef",
    "geodetic_to_polar",
    "local_basis",
    "polar_to_geodetic",
    "radius_of_curvature",
    "slant_to_ground",
    "wrap",
]

SEMI_MAJOR = 6378137.0  # m; NIMA TR8350.2 (2000)
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY_SQ = FLATTENING * (2.0 - FLATTENING)


def wrap(angle: npt.ArrayLike) -> Float[np.ndarray, "*lead"]:
    """Bring angles (rad) to [-pi, pi); those already there are returned unchanged."""
    a = np.asarray(angle, np.float64)
    turned = a - 2.0 * np.pi * np.floor((a + np.pi) / (2.0 * np.pi))
    # Round-off may leave a value next to the edge on its wrong side.
    turned = np.where((turned >= np.pi) | (turned < -np.pi), -np.pi, turned)
    return np.where((a >= -np.pi) & (a < np.pi), a, turned)


def circular_mean(angle: npt.ArrayLike) -> float:
    """Mean of angles (rad) that lie within half a circle, in [-pi, pi): that of their distances from one direction.

    The direction is that of the sum of their unit vectors, so nothing depends on where angles are cut.
    """
    a = np.asarray(angle, np.float64)
    centre = _direction(a)
    return float(wrap(centre + np.mean(wrap(a - centre))))


def circular_median(angle: npt.ArrayLike) -> float:
    """Median of angles (rad), in [-pi, pi), counted like `circular_mean`: some may lie anywhere."""
    a = np.asarray(angle, np.float64)
    centre = _direction(a)
    return float(wrap(centre + np.median(wrap(a - centre))))


def _direction(angle: npt.NDArray[np.float64]) -> float:
    return float(np.arctan2(np.sin(angle).sum(), np.cos(angle).sum()))


@dataclass(frozen=True, slots=True)
class Site:
    """Where a sensor stands: latitude and longitude (rad), height (m) and its standard deviation (m).

    A site of unknown height is given one with a large `sigma_height`, which widens the covariance of its plots.

    Raises:
        ModelError: a value is not finite, or cannot be an angle in radians.
    """

    latitude: float
    longitude: float
    height: float
    sigma_height: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what cannot be a site."""
        values = (self.latitude, self.longitude, self.height, self.sigma_height)
        if not np.all(np.isfinite(values)) or self.sigma_height < 0.0:
            raise ModelError(
                f"site must have finite coordinates and sigma_height >= 0, got {self}. "
                "Give an unknown height a value and a large sigma_height."
            )
        if abs(self.latitude) > np.pi / 2 or abs(self.longitude) > 2 * np.pi:
            raise ModelError(f"site outside the earth: {self}. Give latitude and longitude in radians.")


@dataclass(frozen=True, slots=True, eq=False)
class Sites:
    """Where a moving sensor stood at each of N reports; where a `Site` is taken, one element for each report."""

    latitude: npt.NDArray[np.float64]  # (N,), rad
    longitude: npt.NDArray[np.float64]  # (N,), rad
    height: npt.NDArray[np.float64]  # (N,), m
    sigma_height: float = 0.0


def radius_of_curvature(latitude: npt.ArrayLike, azimuth: npt.ArrayLike) -> Float[np.ndarray, "*lead"]:
    """Radius of the ellipsoid's normal section in a direction, m (Euler).

    1/R = cos^2(azimuth)/M + sin^2(azimuth)/N, M and N the meridional and prime vertical radii.

    Source: Euler's theorem on the curvature of normal sections.
    """
    w_sq = 1.0 - ECCENTRICITY_SQ * np.sin(np.asarray(latitude, np.float64)) ** 2
    n = SEMI_MAJOR / np.sqrt(w_sq)
    m = n * (1.0 - ECCENTRICITY_SQ) / w_sq
    beta = np.asarray(azimuth, np.float64)
    return np.asarray(m * n / (n * np.cos(beta) ** 2 + m * np.sin(beta) ** 2))


def geodetic_to_ecef(
    latitude: npt.ArrayLike, longitude: npt.ArrayLike, height: npt.ArrayLike
) -> Float[np.ndarray, "*lead 3"]:
    """Earth-centred coordinates (..., 3) in m of points given by latitude, longitude (rad) and height (m)."""
    lat, lon, h = (np.asarray(v, np.float64) for v in (latitude, longitude, height))
    n = SEMI_MAJOR / np.sqrt(1.0 - ECCENTRICITY_SQ * np.sin(lat) ** 2)
    p = (n + h) * np.cos(lat)
    z = (n * (1.0 - ECCENTRICITY_SQ) + h) * np.sin(lat)
    return np.stack(np.broadcast_arrays(p * np.cos(lon), p * np.sin(lon), z), axis=-1)


def ecef_to_geodetic(
    xyz: npt.ArrayLike,
) -> tuple[Float[np.ndarray, "*lead"], Float[np.ndarray, "*lead"], Float[np.ndarray, "*lead"]]:
    """Latitude, longitude (rad) and height (m) of earth-centred points (..., 3).

    Two steps of Bowring's iteration: below 1e-8 m from the deepest mine to the geostationary orbit.

    Source: Bowring (1976), Survey Review 23, the iteration on the reduced latitude.
    """
    x, y, z = np.moveaxis(np.asarray(xyz, np.float64), -1, 0)
    p = np.hypot(x, y)
    semi_minor = SEMI_MAJOR * (1.0 - FLATTENING)
    second_ecc_sq = ECCENTRICITY_SQ / (1.0 - ECCENTRICITY_SQ)
    reduced = np.arctan2(z, (1.0 - FLATTENING) * p)
    lat = reduced
    for _ in range(2):
        lat = np.arctan2(
            z + second_ecc_sq * semi_minor * np.sin(reduced) ** 3,
            p - ECCENTRICITY_SQ * SEMI_MAJOR * np.cos(reduced) ** 3,
        )
        reduced = np.arctan2((1.0 - FLATTENING) * np.sin(lat), np.cos(lat))
    # This form of the height has no singularity at the poles or the equator.
    h = p * np.cos(lat) + z * np.sin(lat) - SEMI_MAJOR * np.sqrt(1.0 - ECCENTRICITY_SQ * np.sin(lat) ** 2)
    return np.asarray(lat), np.asarray(np.arctan2(y, x)), np.asarray(h)


def local_basis(latitude: npt.ArrayLike, longitude: npt.ArrayLike) -> Float[np.ndarray, "*lead 3 3"]:
    """Rows are the unit vectors east, north, up at a point, in earth-centred coordinates."""
    lat, lon = np.broadcast_arrays(np.asarray(latitude, np.float64), np.asarray(longitude, np.float64))
    s, c, sl, cl = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    east = np.stack([-sl, cl, np.zeros_like(sl)], axis=-1)
    north = np.stack([-s * cl, -s * sl, c], axis=-1)
    up = np.stack([c * cl, c * sl, s], axis=-1)
    return np.stack([east, north, up], axis=-2)


def slant_to_ground(
    slant: npt.ArrayLike, height: npt.ArrayLike, site_height: npt.ArrayLike, radius: npt.ArrayLike
) -> Float[np.ndarray, "*lead"]:
    """Ground range (m, along a sphere of the given radius) of a point at a slant range and a height.

    sin^2(theta/2) = (r - dh)(r + dh) / (4 (R + hs)(R + h)),  dh = h - hs,  ground = R theta.

    The law of cosines without its cancellation of squared earth radii. A triangle that cannot be (r < |dh|) is
    taken as overhead: 0.

    Args:
        slant: r, slant range, m.
        height: h, height of the target, m.
        site_height: hs, height of the sensor, m.
        radius: R, m, as of `radius_of_curvature`.
    """
    r, h, hs, big_r = (np.asarray(v, np.float64) for v in (slant, height, site_height, radius))
    dh = h - hs
    haversine = (r - dh) * (r + dh) / (4.0 * (big_r + hs) * (big_r + h))
    return np.asarray(2.0 * big_r * np.arcsin(np.sqrt(np.clip(haversine, 0.0, 1.0))))


def polar_to_geodetic(
    slant: npt.ArrayLike, azimuth: npt.ArrayLike, altitude: npt.ArrayLike, site: Site | Sites
) -> tuple[
    Float[np.ndarray, "*lead"],
    Float[np.ndarray, "*lead"],
    Float[np.ndarray, "*lead"],
    Float[np.ndarray, "*lead"],
]:
    """Find the point at a slant range and azimuth from a site that has a given height above the ellipsoid.

    The elevation of the ray is that of a sphere of Euler's radius, refined on the ellipsoid by Newton steps in its
    sine (slope of the sphere, which misses the ellipsoid's by less than 0.5 %) to below 1 mm.

    Args:
        slant: slant range, m.
        azimuth: at the site, rad from north, clockwise.
        altitude: height of the point, m.
        site: the sensor's site, or one for each point.

    Returns:
        Latitude and longitude of the point (rad), and elevation and azimuth of the ray *at the point*, seen in the
        direction of travel away from the site. An impossible triangle (slant < |height difference|) gives the
        point above (or below) the site at elevation ±pi/2.
    """
    r, beta, h = np.broadcast_arrays(*(np.asarray(v, np.float64) for v in (slant, azimuth, altitude)))
    hs, big_r = site.height, radius_of_curvature(site.latitude, beta)
    origin = geodetic_to_ecef(site.latitude, site.longitude, hs)
    east, north, up = np.moveaxis(local_basis(site.latitude, site.longitude), -2, 0)
    level = np.sin(beta)[..., None] * east + np.cos(beta)[..., None] * north
    safe = np.where(r > 0.0, r, 1.0)
    sine = np.clip(((h - hs) * (2.0 * big_r + h + hs) - r**2) / (2.0 * safe * (big_r + hs)), -1.0, 1.0)
    slope = safe * (big_r + hs) / (big_r + h)
    for _ in range(3):
        _, _, found = ecef_to_geodetic(origin + r[..., None] * _ray(level, up, sine))
        sine = np.clip(sine + (h - found) / slope, -1.0, 1.0)
    ray = _ray(level, up, sine)
    lat, lon, _ = ecef_to_geodetic(origin + r[..., None] * ray)
    e, n, u = np.moveaxis(np.einsum("...ij,...j->...i", local_basis(lat, lon), ray), -1, 0)
    flat = np.hypot(e, n)
    # Straight up, the direction over the ground is the antenna's.
    azimuth_t = np.where(flat > 1e-9, np.arctan2(e, n) % (2.0 * np.pi), beta)
    return lat, lon, np.asarray(np.arctan2(u, flat)), azimuth_t


def geodetic_to_polar(
    latitude: npt.ArrayLike, longitude: npt.ArrayLike, height: npt.ArrayLike, site: Site
) -> tuple[Float[np.ndarray, "*lead"], Float[np.ndarray, "*lead"], Float[np.ndarray, "*lead"]]:
    """Slant range (m), azimuth ([0, 2 pi), from north, clockwise) and elevation (rad) of points seen from a site."""
    offset = geodetic_to_ecef(latitude, longitude, height) - geodetic_to_ecef(
        site.latitude, site.longitude, site.height
    )
    east, north, up = np.moveaxis(offset @ local_basis(site.latitude, site.longitude).T, -1, 0)
    level = np.hypot(east, north)
    azimuth = np.arctan2(east, north) % (2.0 * np.pi)
    return np.asarray(np.hypot(level, up)), np.asarray(azimuth), np.asarray(np.arctan2(up, level))


def _ray(level: npt.NDArray[np.float64], up: npt.NDArray[np.float64], sine: npt.ArrayLike) -> npt.NDArray[np.float64]:
    sine = np.asarray(sine)
    return np.asarray(np.sqrt((1.0 - sine) * (1.0 + sine))[..., None] * level + sine[..., None] * up)
