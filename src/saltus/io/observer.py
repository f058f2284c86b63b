"""Where a moving sensor was: the columns of a table that say it, to latitude, longitude and height for each report.

    observer_latitude, observer_longitude   degrees, WGS-84, with
    observer_height_m                       m above the ellipsoid; absent = 0
or, in a frame of one's own,
    observer_x_m, observer_y_m, observer_z_m   m east, north (and up; absent = 0) of an origin, with
    origin_latitude, origin_longitude       degrees, WGS-84: the origin, in every row, and
    origin_height_m                         m above the ellipsoid; absent = 0
and
    heading_deg                             degrees from north, clockwise: azimuth_deg then counts from the bow

The origin without the observer's x and y is itself the observer: x_m and y_m count from there. A row that says no
observer is seen from its source's configured site.
"""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError
from saltus.geo import ecef_to_geodetic, geodetic_to_ecef, local_basis

__all__ = ["FRAME", "observer_columns"]

_Array = npt.NDArray[np.float64]

_DEGREE = np.pi / 180
# column -> (name below, factor to SI units)
FRAME = {
    "observer_latitude": ("observer_latitude", _DEGREE),
    "observer_longitude": ("observer_longitude", _DEGREE),
    "observer_height_m": ("observer_height", 1.0),
    "observer_x_m": ("observer_x", 1.0),
    "observer_y_m": ("observer_y", 1.0),
    "observer_z_m": ("observer_z", 1.0),
    "origin_latitude": ("origin_latitude", _DEGREE),
    "origin_longitude": ("origin_longitude", _DEGREE),
    "origin_height_m": ("origin_height", 1.0),
    "heading_deg": ("heading", _DEGREE),
}
_PLACE = ("observer_latitude", "observer_longitude", "observer_height")


def observer_columns(path: Path, columns: dict[str, npt.ArrayLike]) -> dict[str, npt.ArrayLike]:
    """Replace the columns of `FRAME` by the observer's latitude, longitude and height, and turn azimuths to north.

    Raises:
        DataError: a column lacks the one it goes with.
    """
    given = {name for name, _ in FRAME.values()} & set(columns)
    _need_partners(path, given)
    n = len(np.asarray(columns["time"]))

    def column(name: str, absent: float = np.nan) -> _Array:
        values = np.asarray(columns[name], np.float64) if name in given else np.full(n, np.nan)
        return np.where(np.isnan(values), absent, values)

    latitude, longitude = column("observer_latitude"), column("observer_longitude")
    height = column("observer_height", 0.0)
    if "origin_latitude" in given:
        at_origin = 0.0 if "observer_x" not in given else np.nan
        offset = [column("observer_x", at_origin), column("observer_y", at_origin), column("observer_z", 0.0)]
        origin = column("origin_latitude"), column("origin_longitude"), column("origin_height", 0.0)
        missing = np.isnan(latitude) | np.isnan(longitude)
        found = _from_origin(np.stack(offset, axis=-1), *origin)
        latitude, longitude, height = (
            np.where(missing, other, own) for own, other in zip((latitude, longitude, height), found, strict=True)
        )
    known = np.isfinite(latitude) & np.isfinite(longitude) & np.isfinite(height)
    place = {name: np.where(known, v, np.nan) for name, v in zip(_PLACE, (latitude, longitude, height), strict=True)}
    kept = {name: values for name, values in columns.items() if name not in given}
    if "heading" in given and "azimuth" in columns:
        heading = column("heading", 0.0)
        turned = (np.asarray(columns["azimuth"], np.float64) + heading) % (2.0 * np.pi)
        turned[np.abs(heading) > 2.0 * np.pi] = np.nan  # no heading, so no azimuth
        kept["azimuth"] = np.where(heading == 0.0, columns["azimuth"], turned)
    return kept | place if given - {"heading"} else kept


def _need_partners(path: Path, given: set[str]) -> None:
    needs = {
        "observer_latitude": ("observer_longitude",),
        "observer_longitude": ("observer_latitude",),
        "observer_height": ("observer_latitude",),
        "observer_x": ("observer_y", "origin_latitude"),
        "observer_y": ("observer_x", "origin_latitude"),
        "observer_z": ("observer_x",),
        "origin_latitude": ("origin_longitude",),
        "origin_longitude": ("origin_latitude",),
        "origin_height": ("origin_latitude",),
    }
    labels = {name: label for label, (name, _) in FRAME.items()}
    for name in sorted(given & set(needs)):
        for partner in needs[name]:
            if partner not in given:
                raise DataError(f"{path}: column {labels[name]!r} needs {labels[partner]!r} beside it.")


def _from_origin(offset: _Array, latitude: _Array, longitude: _Array, height: _Array) -> tuple[_Array, _Array, _Array]:
    """Latitude, longitude and height of points east, north, up of origins; NaN stays NaN."""
    basis = local_basis(latitude, longitude)
    moved = (offset[:, None, :] @ basis)[:, 0]
    return ecef_to_geodetic(geodetic_to_ecef(latitude, longitude, height) + moved)
