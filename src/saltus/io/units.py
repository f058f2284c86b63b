"""Whether the columns of a table can be what their names say, and what the columns meant that are not used."""

import difflib
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError
from saltus.io.cells import tell
from saltus.io.merge import LIMITS
from saltus.text import cut

__all__ = ["check_units", "doubts", "meaning", "tell_impossible", "told_unused"]

_Array = npt.NDArray[np.float64]

_LIMIT_OF = {"heading": "azimuth", "origin_latitude": "latitude", "origin_longitude": "longitude"} | {
    "observer_x": "x",
    "observer_y": "y",
    "observer_z": "z",
    "origin_height": "observer_height",
}
_HALF = 0.5  # a column with more impossible values than this has another unit
_ENOUGH = 20  # values from which a habit can be told
_ARC = 0.2  # rad: values that leave no greater gap of the circle fill it
_LISTED = 50  # columns named one by one
_CEILING, _MANY = 18e3, 0.2  # m: no aircraft of this share of a table flies higher
# What people call a column, and the name and unit it has here.
_MEANT = {
    "range_nm": "range_m (1 NM = 1852 m)",
    "range_km": "range_m (1 km = 1000 m)",
    "range": "range_m, in metres",
    "rho": "range_m, in metres",
    "rho_m": "range_m",
    "rho_nm": "range_m (1 NM = 1852 m)",
    "azimuth": "azimuth_deg, in degrees",
    "azimuth_rad": "azimuth_deg (1 rad = 57.29578 degrees)",
    "theta": "azimuth_deg, in degrees",
    "theta_deg": "azimuth_deg",
    "bearing": "azimuth_deg, in degrees",
    "elevation": "elevation_deg, in degrees",
    "altitude_ft": "altitude_m (1 ft = 0.3048 m)",
    "altitude": "altitude_m, in metres",
    "baroaltitude": "altitude_m, in metres",
    "baro_altitude": "altitude_m, in metres",
    "geoaltitude": "altitude_m, in metres",
    "flight_level": "altitude_m (1 flight level = 30.48 m)",
    "fl": "altitude_m (1 flight level = 30.48 m)",
    "x": "x_m, in metres",
    "y": "y_m, in metres",
    "z": "z_m, in metres",
    "lng": "longitude, in degrees",
    "long": "longitude, in degrees",
    "timestamp": "time: UTC seconds since 1970-01-01, or ISO 8601 text",
    "datetime": "time: UTC seconds since 1970-01-01, or ISO 8601 text",
    "basedatetime": "time: UTC seconds since 1970-01-01, or ISO 8601 text",
    "date": "time: UTC seconds since 1970-01-01, or ISO 8601 text",
    "utc": "time: UTC seconds since 1970-01-01, or ISO 8601 text",
    "squawk": "mode3a, four octal digits",
    "hex": "icao24, six hexadecimal digits",
    "icao": "icao24, six hexadecimal digits",
    "icao_address": "icao24, six hexadecimal digits",
    "flight": "callsign",
    "ident": "callsign",
    "sensor": "source",
    "lat": "latitude, in degrees",
    "lon": "longitude, in degrees",
}


def check_units(path: Path, columns: Mapping[str, tuple[str, float]], values: Mapping[str, npt.ArrayLike]) -> None:
    """Refuse a column most of whose values cannot be: its unit is another.

    Args:
        path: the table.
        columns: name in the table -> name among the values, factor to SI units.
        values: columns in SI units.

    Raises:
        DataError: there is one.
    """
    for name, given, outside in _impossible(columns, values):
        told = ~np.isnan(given)
        if np.count_nonzero(outside) > _HALF * np.count_nonzero(told):
            k = int(outside.argmax())
            raise DataError(
                f"{path}: row {k}, column {name!r}: {given[k]:g} cannot be, like {np.count_nonzero(outside)} of "
                f"{np.count_nonzero(told)} values: {_remedy(name, values)}"
            )
    azimuth = _told(values, "azimuth")
    if len(azimuth) >= _ENOUGH and _fills_the_circle_in_radians(azimuth / columns["azimuth_deg"][1]):
        raise DataError(
            f"{path}: column 'azimuth_deg': all {len(azimuth)} values lie within 0 and 6.2832 (or -3.1416 and 3.1416) "
            "and fill that circle: they are radians. Multiply them by 57.29578."
        )


def tell_impossible(
    path: Path, columns: Mapping[str, tuple[str, float]], values: Mapping[str, npt.ArrayLike], problems: list[str]
) -> None:
    """Name the first value of each column that cannot be."""
    for name, given, outside in _impossible(columns, values):
        bad = [(int(k), f"{given[k]:g}") for k in np.flatnonzero(outside)]
        tell(path, name, bad, "out of range", problems)


def doubts(name: str, columns: Mapping[str, tuple[str, float]], values: Mapping[str, npt.ArrayLike]) -> list[str]:
    """Say which columns are in another unit by all appearances, though each value could be.

    Args:
        name: of the file, for messages.
        columns: name in the table -> name among the values, factor to SI units.
        values: columns in SI units.
    """
    found = []
    for column in ("azimuth_deg", "heading_deg"):
        target, factor = columns[column]
        angle = _told(values, target) / factor
        if len(angle) >= _ENOUGH and _within_a_circle_of_radians(angle) and np.ptp(angle) > 1.0:
            found.append(
                f"{name}: column {column!r}: all {len(angle)} values lie within -6.2832 and 6.2832: are they radians? "
                "They are taken as degrees."
            )
    for lat, lon in (("latitude", "longitude"), ("observer_latitude", "observer_longitude")):
        north, east = (_told(values, columns[c][0]) / columns[c][1] for c in (lat, lon))
        if len(north) >= _ENOUGH and np.abs(north).max() <= np.pi / 2 and np.abs(east).max(initial=0.0) <= np.pi:
            found.append(
                f"{name}: columns {lat!r} and {lon!r}: all values lie within 1.5708 and 3.1416: are they radians? They "
                "are taken as degrees."
            )
    altitude = _told(values, "altitude")
    if len(altitude) >= _ENOUGH and np.mean(altitude > _CEILING) > _MANY:
        found.append(
            f"{name}: column 'altitude_m': {np.mean(altitude > _CEILING):.0%} of the values lie above "
            f"{_CEILING:g} m: are they feet (1 ft = 0.3048 m)? They are taken as metres."
        )
    return found


def told_unused(name: str, unused: Mapping[str, int], known: Collection[str]) -> list[str]:
    """Name the columns that are passed over, how many of their cells hold something, and what they may have meant."""
    if not unused:
        return []
    hints = {column: meaning(column, known) for column in unused}
    said = [
        f"{cut(column, 40)} ({count} values{'; write ' if hints[column] else ''}{hints[column]})"
        for column, count in unused.items()
    ]
    more = f", and {len(said) - _LISTED} more" if len(said) > _LISTED else ""
    return [f"{name}: columns not used: {', '.join(said[:_LISTED])}{more}."]


def meaning(column: str, known: Collection[str]) -> str:
    """Say by which name and in which unit a column would be read, "" where nothing is like it."""
    plain = cut(column, 40).strip().lower().replace(" ", "_")
    if plain in _MEANT:
        return _MEANT[plain]
    near = [plain] if plain in known else difflib.get_close_matches(plain, list(known), n=1, cutoff=0.85)
    about = bool(near) and plain.startswith(f"{near[0]}_")  # mode3a_v is no Mode 3/A code, but whether one is valid
    return near[0] if near and not about else ""


def _told(values: Mapping[str, npt.ArrayLike], name: str) -> _Array:
    column = np.asarray(values.get(name, ()), np.float64)
    return column[np.isfinite(column)]


def _within_a_circle_of_radians(angle: _Array) -> bool:
    return bool(np.abs(angle).max() <= 2.0 * np.pi * (1.0 + 1e-6))


def _fills_the_circle_in_radians(angle: _Array) -> bool:
    if not _within_a_circle_of_radians(angle) or np.ptp(angle) > 2.0 * np.pi * (1.0 + 1e-6):
        return False
    turned = np.sort(angle % (2.0 * np.pi))
    return bool(np.diff(turned, append=turned[0] + 2.0 * np.pi).max() < _ARC)


def _remedy(name: str, values: Mapping[str, npt.ArrayLike]) -> str:
    if name == "time":
        return "seconds since 1970, not milliseconds?"
    longitude = _told(values, "longitude")
    if name == "latitude" and len(longitude) and np.abs(longitude).max() <= np.pi / 2:
        return "are latitude and longitude swapped? Is it in degrees?"
    return f"is it in {'m/s' if name.endswith('_mps') else 'm' if name.endswith('_m') else 'degrees'}?"


def _impossible(
    columns: Mapping[str, tuple[str, float]], values: Mapping[str, npt.ArrayLike]
) -> list[tuple[str, _Array, npt.NDArray[np.bool_]]]:
    """Each numeric column in the units of the table, and which of its values cannot be."""
    found = []
    for name, (target, factor) in {"time": ("time", 1.0), **columns}.items():
        if target in values:
            given = np.asarray(values[target], np.float64)
            low, high = LIMITS[_LIMIT_OF.get(target, target)]
            outside = ~np.isnan(given) & ~((given >= low * (1 + 1e-12)) & (given <= high * (1 + 1e-12)))
            found.append((name, given / factor, outside))
    return found
