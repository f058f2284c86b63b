"""Truth and tracks from tables."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.errors import DataError
from saltus.evaluate.matching import Tracks
from saltus.evaluate.reference import Reference, each_time_once, make_reference
from saltus.geo import geodetic_to_ecef
from saltus.io.cells import numbers, refuse, texts
from saltus.io.merge import LIMITS
from saltus.io.sheet import read_sheet

__all__ = ["read_reference", "read_tracks", "reference_of", "tracks_of"]

_Array = npt.NDArray[np.float64]

_NUMBERS = ("track_id", "time", "latitude", "longitude", "cov_ee", "cov_en", "cov_nn")
_LIVE = ("confirmed", "coasted")
_CAN_BE = {  # of the truth's columns: least, greatest, what they are
    "time": (*LIMITS["time"], "seconds since 1970-01-01, UTC"),
    "latitude": (-90.0, 90.0, "degrees north"),
    "longitude": (-180.0, 360.0, "degrees east"),
}


def read_reference(path: Path) -> Reference:
    """Read a table of the truth: time, target_id, latitude, longitude, and what else of `Reference` it has.

    Altitude (m), ve and vn (m/s, true east and north) and turning (whether the target manoeuvres) may be absent.

    Raises:
        DataError: no such table, no row, a column is missing, or a value is absent or cannot be.
    """
    table = _table(path, ("time", "target_id", "latitude", "longitude"), ("altitude", "ve", "vn", "turning"))
    if not table.num_rows:
        raise DataError(f"{path}: the truth has columns and no row.")
    return reference_of(table, path)


def reference_of(table: pa.Table, path: Path = Path("truth")) -> Reference:
    """Return the truth of a table with the columns of `read_reference`; `path` is its name in messages.

    Raises:
        DataError: a value is absent or cannot be.
    """
    label = np.array(_words(path, table, "target_id"), object)
    time, latitude, longitude = (_checked(path, _column(path, table, c), c) for c in _CAN_BE)

    def told(name: str) -> _Array:
        return _column(path, table, name) if name in table.column_names else np.full(len(label), np.nan)

    return make_reference(
        label,
        time,
        np.radians(latitude),
        np.radians(longitude),
        altitude=told("altitude"),
        velocity=np.column_stack([told("ve"), told("vn")]),
        turning=told("turning") > 0.5,
    )


def _checked(path: Path, values: _Array, name: str) -> _Array:
    """Refuse the first value that is absent or out of range."""
    low, high, meaning = _CAN_BE[name]
    for k in np.flatnonzero(~((values >= low) & (values <= high)))[:1]:
        what = "no value; give one or leave the row out" if np.isnan(values[k]) else f"{values[k]:g} cannot be"
        raise DataError(f"{path}: row {k}, column {name!r}: {what} ({meaning}, {low:g} to {high:g}).")
    return values


def read_tracks(path: Path) -> Tracks:
    """Read the confirmed and coasted rows of tracks.parquet.

    Raises:
        DataError: no such table, or a column is missing.
    """
    return tracks_of(_table(path, (*_NUMBERS, "status")), path)


def tracks_of(table: pa.Table, path: Path = Path("tracks"), statuses: Sequence[str] = _LIVE) -> Tracks:
    """Return rows of the columns of tracks.parquet.

    Args:
        table: tracks.
        path: its name in messages.
        statuses: of the rows taken.

    Raises:
        DataError: a column does not hold numbers.
    """
    live = np.isin(_words(path, table, "status"), statuses)
    ids, time, latitude, longitude, ee, en, nn = (_column(path, table, c)[live] for c in _NUMBERS)
    cov = np.stack([np.stack([ee, en], axis=-1), np.stack([en, nn], axis=-1)], axis=-2)
    keep = each_time_once(ids.astype(np.int64), time)
    place = geodetic_to_ecef(np.radians(latitude[keep]), np.radians(longitude[keep]), 0.0)
    return Tracks(ids[keep].astype(np.int64), time[keep], place, cov[keep])


def _table(path: Path, needed: Sequence[str], further: Sequence[str] = ()) -> pa.Table:
    if not path.is_file():
        raise DataError(f"{path}: {'is a folder; name a table' if path.is_dir() else 'no such file'}.")
    sheet = read_sheet(path, (*needed, *further))
    missing = [c for c in needed if c not in sheet.columns]
    if missing:
        raise DataError(f"{path}: no column {missing[0]!r}; needed are {', '.join(needed)}.")
    refuse(path, sheet.problems)
    return pa.table(sheet.columns)


def _column(path: Path, table: pa.Table, name: str) -> _Array:
    """Numbers, NaN where a cell is empty; text that holds them is read, and one that does not is refused."""
    faults: list[str] = []
    column = table[name]
    if name == "turning" and pa.types.is_boolean(column.type):
        column = column.cast(pa.int8())
    values = numbers(path, name, column, faults)
    refuse(path, faults)
    return values


def _words(path: Path, table: pa.Table, name: str) -> list[str]:
    faults: list[str] = []
    found = texts(path, name, table[name], faults)
    refuse(path, faults)
    return [str(v) for v in found.each({v: v for v in found.values}, "", object)]
