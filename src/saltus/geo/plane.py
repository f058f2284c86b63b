"""The tracker's horizontal plane: a conformal map of the ellipsoid, and the way back to true north and east."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.geo.earth import ECCENTRICITY_SQ, SEMI_MAJOR
from saltus.shapes import Float

if TYPE_CHECKING:
    import pyproj

__all__ = ["Plane", "TrueState"]


class TrueState(NamedTuple):
    """Position and velocity in true east and north at the target."""

    latitude: npt.NDArray[np.float64]  # (...,), rad
    longitude: npt.NDArray[np.float64]  # (...,), rad
    velocity: npt.NDArray[np.float64]  # (..., 2): east, north, m/s
    position_cov: npt.NDArray[np.float64]  # (..., 2, 2), m^2
    velocity_cov: npt.NDArray[np.float64]  # (..., 2, 2), (m/s)^2


@dataclass(frozen=True)
class Plane:
    """Conformal stereographic plane touching the WGS-84 ellipsoid at a centre (latitude, longitude in rad).

    x points to the east and y to the north at the centre. Rays from the centre are straight and shapes are kept;
    lengths on the ellipsoid are multiplied by `scale` (1.0001 at 130 km, 1.001 at 400 km).

    Raises:
        ModelError: the centre is not finite or not in radians.
    """

    latitude: float
    longitude: float

    def __post_init__(self) -> None:
        """Refuse what cannot be a centre."""
        if not (abs(self.latitude) <= np.pi / 2 and abs(self.longitude) <= 2 * np.pi):
            raise ModelError(f"no such centre of a plane: {self}. Give latitude and longitude in radians.")

    @cached_property
    def _projection(self) -> "pyproj.Proj":
        import pyproj

        lat, lon = np.degrees([self.latitude, self.longitude])
        return pyproj.Proj(proj="stere", lat_0=lat, lon_0=lon, ellps="WGS84")

    def forward(self, latitude: npt.ArrayLike, longitude: npt.ArrayLike) -> Float[np.ndarray, "*lead 2"]:
        """Coordinates (..., 2) in m of points given by latitude and longitude in rad; NaN stays NaN."""
        lat, lon = np.broadcast_arrays(np.asarray(latitude, np.float64), np.asarray(longitude, np.float64))
        x, y = self._projection(lon, lat, radians=True)
        return _finite_or_nan(np.stack([np.asarray(x), np.asarray(y)], axis=-1))

    def inverse(self, xy: npt.ArrayLike) -> tuple[Float[np.ndarray, "*lead"], Float[np.ndarray, "*lead"]]:
        """Latitude and longitude (rad) of points (..., 2) of the plane."""
        x, y = np.moveaxis(np.asarray(xy, np.float64), -1, 0)
        lon, lat = self._projection(x, y, inverse=True, radians=True)
        return _finite_or_nan(np.asarray(lat)), _finite_or_nan(np.asarray(lon))

    def factors(self, xy: npt.ArrayLike) -> tuple[Float[np.ndarray, "*lead"], Float[np.ndarray, "*lead"]]:
        """Convergence (rad) and scale of the plane at points (..., 2).

        The convergence is the angle from true north to the plane's y axis, clockwise positive:
        true course = course in the plane + convergence. It is positive east of the centre on the northern
        hemisphere. The scale is length in the plane over length on the ellipsoid.
        """
        return self.factors_at(*self.inverse(xy))

    def factors_at(
        self, latitude: npt.ArrayLike, longitude: npt.ArrayLike
    ) -> tuple[Float[np.ndarray, "*lead"], Float[np.ndarray, "*lead"]]:
        """Convergence and scale as of `factors`, at latitudes and longitudes in rad."""
        lat, lon = np.broadcast_arrays(np.asarray(latitude, np.float64), np.asarray(longitude, np.float64))
        if not lat.size:  # PROJ refuses to answer nothing with nothing
            return np.zeros(lat.shape), np.ones(lat.shape)
        known = np.isfinite(lat) & np.isfinite(lon)
        found = self._projection.get_factors(
            np.where(known, lon, self.longitude), np.where(known, lat, self.latitude), radians=True
        )
        convergence = np.where(known, np.radians(found.meridian_convergence), np.nan)
        return convergence, np.where(known, found.meridional_scale, np.nan)

    def to_true(self, state: npt.ArrayLike, cov: npt.ArrayLike, altitude: npt.ArrayLike = 0.0) -> TrueState:
        """Turn a state of the plane into latitude, longitude and true east and north at the target.

        With U = [[cos g, sin g], [-sin g, cos g]] (h + R)/(R k), g the convergence, k the scale and R the earth's
        mean radius there: v_true = U v, cov_true = U cov U'. Metres and m/s are those at the altitude given.

        Args:
            state: x, vx, y, vy in m and m/s, (..., 4).
            cov: its covariance, (..., 4, 4).
            altitude: m, (...,); NaN counts as 0.
        """
        s, p = np.asarray(state, np.float64), np.asarray(cov, np.float64)
        lat, lon = self.inverse(s[..., [0, 2]])
        turn = true_from_plane(*self.factors_at(lat, lon), lat, altitude)
        position, velocity = p[..., [[0], [2]], [0, 2]], p[..., [[1], [3]], [1, 3]]
        turn_t = np.swapaxes(turn, -1, -2)
        return TrueState(
            lat, lon, (turn @ s[..., [1, 3], None])[..., 0], turn @ position @ turn_t, turn @ velocity @ turn_t
        )


def true_from_plane(
    convergence: npt.ArrayLike, scale: npt.ArrayLike, latitude: npt.ArrayLike, altitude: npt.ArrayLike
) -> Float[np.ndarray, "*lead 2 2"]:
    """Matrix taking small displacements of the plane to metres true east and north at an altitude (NaN: 0)."""
    g, k = np.asarray(convergence, np.float64), np.asarray(scale, np.float64)
    stretch = 1.0 / (k * altitude_scale(latitude, altitude))
    g, stretch = np.broadcast_arrays(g, stretch)
    c, s = stretch * np.cos(g), stretch * np.sin(g)
    return np.stack([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)], axis=-2)


def altitude_scale(latitude: npt.ArrayLike, altitude: npt.ArrayLike) -> Float[np.ndarray, "*lead"]:
    """Length on the ellipsoid over length at an altitude above it: R/(R + h), R = sqrt(M N); NaN altitude: 1."""
    lat, h = np.asarray(latitude, np.float64), np.nan_to_num(np.asarray(altitude, np.float64), nan=0.0)
    radius = SEMI_MAJOR * np.sqrt(1.0 - ECCENTRICITY_SQ) / (1.0 - ECCENTRICITY_SQ * np.sin(lat) ** 2)
    return np.asarray(radius / (radius + h))


def _finite_or_nan(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    # PROJ answers points it cannot map, NaN among them, with infinity.
    return np.where(np.isfinite(values), values, np.nan)
