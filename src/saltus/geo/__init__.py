"""Geometry of radars on the WGS-84 ellipsoid: float64, radians and metres, vectorised.

Heights above mean sea level and pressure altitudes are taken as heights above the ellipsoid; rays are straight
(no refraction). Azimuths and courses count from north, clockwise, except in `spherical_to_cartesian`.
"""

from saltus.geo.earth import (
    Site,
    Sites,
    circular_mean,
    circular_median,
    ecef_to_geodetic,
    geodetic_to_ecef,
    geodetic_to_polar,
    local_basis,
    polar_to_geodetic,
    radius_of_curvature,
    slant_to_ground,
    wrap,
)
from saltus.geo.plane import Plane, TrueState
from saltus.geo.positions import (
    PlanePositions,
    geodetic_to_plane,
    local_to_plane,
    polar_to_plane,
    spherical_to_plane,
)
from saltus.geo.spherical import spherical_to_cartesian

__all__ = [
    "Plane",
    "PlanePositions",
    "Site",
    "Sites",
    "TrueState",
    "circular_mean",
    "circular_median",
    "ecef_to_geodetic",
    "geodetic_to_ecef",
    "geodetic_to_plane",
    "geodetic_to_polar",
    "local_basis",
    "local_to_plane",
    "polar_to_geodetic",
    "polar_to_plane",
    "radius_of_curvature",
    "slant_to_ground",
    "spherical_to_cartesian",
    "spherical_to_plane",
    "wrap",
]
