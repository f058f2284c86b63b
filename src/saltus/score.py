"""`saltus score`: how good the tracks of an output directory are against the truth."""

import csv
import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import click
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from saltus.errors import DataError
from saltus.geo import ecef_to_geodetic, geodetic_to_ecef
from saltus.io.merge import LIMITS
from saltus.io.table import csv_as_text
from saltus.io.write import output_file
from saltus.metrics.following import Targets, Tracks, each_time_once, target_scores

__all__ = ["read_tracks", "read_truth", "score_files"]

_Array = npt.NDArray[np.float64]

_CUTOFF = 20.0  # m
_LIVE = ("confirmed", "coasted")
_CAN_BE = {  # of the truth's columns: least, greatest, what they are
    "time": (*LIMITS["time"], "seconds since 1970-01-01, UTC"),
    "latitude": (-90.0, 90.0, "degrees north"),
    "longitude": (-180.0, 360.0, "degrees east"),
}
_ELSEWHERE = 10e3  # m: tracks and truth further apart than this have no place in common


def score_files(output: Path, truth: Path, json_path: Path | None = None, cutoff: float = _CUTOFF) -> dict[str, object]:
    """Score the tracks in an output directory, show the figures, and write them as JSON where asked.

    Args:
        output: directory that `saltus track` wrote, with tracks.parquet.
        truth: Parquet or CSV table: time (s), target_id, latitude, longitude (degrees).
        json_path: file to write.
        cutoff: m: no track follows a target from further away; also GOSPA's.

    Returns:
        The figures, as written.

    Raises:
        DataError: a table or a column is missing, a value cannot be, or the two have no time or place in common.
    """
    if not (output / "tracks.parquet").is_file():
        raise DataError(f"{output}: no tracks.parquet in it; OUTPUT is a folder that saltus track wrote.")
    tracks, targets = read_tracks(output / "tracks.parquet"), read_truth(truth)
    _check_common(truth, targets, tracks)
    figures = target_scores(tracks, targets, cutoff=cutoff)
    if json_path is not None:
        with output_file(json_path) as temporary:
            temporary.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    _show(figures)
    return figures


def read_truth(path: Path) -> Targets:
    """Read a truth table.

    Raises:
        DataError: no such table, no row, a column is missing, or a value is absent or cannot be.
    """
    table = _table(path, ("time", "target_id", "latitude", "longitude"))
    if not table.num_rows:
        raise DataError(f"{path}: the truth has columns and no row.")
    label = np.array([str(v) for v in table["target_id"].to_pylist()], object)
    time, latitude, longitude = (_checked(path, _column(path, table, c), c) for c in _CAN_BE)
    names, target = np.unique(label.astype(str), return_inverse=True)
    keep = each_time_once(target, time)
    place = geodetic_to_ecef(np.radians(latitude[keep]), np.radians(longitude[keep]), 0.0)
    return Targets(tuple(names.tolist()), target[keep].astype(np.intp), time[keep], place)


def _checked(path: Path, values: _Array, name: str) -> _Array:
    """Refuse the first value that is absent or out of range."""
    low, high, meaning = _CAN_BE[name]
    for k in np.flatnonzero(~((values >= low) & (values <= high)))[:1]:
        what = "no value; give one or leave the row out" if np.isnan(values[k]) else f"{values[k]:g} cannot be"
        raise DataError(f"{path}: row {k}, column {name!r}: {what} ({meaning}, {low:g} to {high:g}).")
    return values


def _check_common(path: Path, truth: Targets, tracks: Tracks) -> None:
    """Refuse a truth of another time or place than the tracks'; no track at all may be scored."""
    if not len(tracks.time):
        return
    spans = [(float(t.min()), float(t.max())) for t in (truth.time, tracks.time)]
    if max(a for a, _ in spans) > min(b for _, b in spans):
        known, tracked = (f"{_utc(a)} to {_utc(b)}" for a, b in spans)
        raise DataError(f"{path}: truth covers {known}, tracks cover {tracked} (UTC): nothing in common.")
    low, high = (
        np.max([p.min(0), q.min(0)], 0) for p, q in ((truth.place, tracks.place), (-truth.place, -tracks.place))
    )
    if np.linalg.norm(np.maximum(low + high, 0.0)) > _ELSEWHERE:
        known, tracked = _area(truth.place), _area(tracks.place)
        raise DataError(f"{path}: truth covers {known}, tracks cover {tracked} (degrees): nothing in common.")


def _utc(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S")


def _area(place: _Array) -> str:
    latitude, longitude = (np.degrees(a) for a in ecef_to_geodetic(place)[:2])
    return (
        f"latitude {latitude.min():.4g} to {latitude.max():.4g} "
        f"and longitude {longitude.min():.4g} to {longitude.max():.4g}"
    )


def read_tracks(path: Path) -> Tracks:
    """Read the confirmed and coasted rows of tracks.parquet.

    Raises:
        DataError: no such table, or a column is missing.
    """
    numbers = ("track_id", "time", "latitude", "longitude", "cov_ee", "cov_en", "cov_nn")
    table = _table(path, (*numbers, "status"))
    live = np.isin(np.array(table["status"].to_pylist(), object).astype(str), _LIVE)
    ids, time, latitude, longitude, ee, en, nn = (_column(path, table, c)[live] for c in numbers)
    cov = np.stack([np.stack([ee, en], axis=-1), np.stack([en, nn], axis=-1)], axis=-2)
    keep = each_time_once(ids.astype(np.int64), time)
    place = geodetic_to_ecef(np.radians(latitude[keep]), np.radians(longitude[keep]), 0.0)
    return Tracks(ids[keep].astype(np.int64), time[keep], place, cov[keep])


def _table(path: Path, needed: Sequence[str]) -> pa.Table:
    if not path.is_file():
        raise DataError(f"{path}: {'is a folder; name a table' if path.is_dir() else 'no such file'}.")
    try:
        table = csv_as_text(path) if path.suffix.lower() == ".csv" else pq.read_table(path)
    except pa.ArrowException as error:
        said = _ragged(path) if path.suffix.lower() == ".csv" else str(error).splitlines()[0]
        raise DataError(f"{path}: no readable table: {said}") from error
    missing = [c for c in needed if c not in table.column_names]
    if missing:
        raise DataError(f"{path}: no column {missing[0]!r}; needed are {', '.join(needed)}.")
    return table


def _ragged(path: Path) -> str:
    """Say which row of a CSV file that cannot be read has another number of cells than the header."""
    lines = list(csv.reader(path.read_text(encoding="utf-8", errors="replace").splitlines()))
    for k, cells in enumerate(lines[1:]):
        if len(cells) != len(lines[0]):
            return f"row {k} has {len(cells)} cells where the header has {len(lines[0])}."
    return "it is empty, or not UTF-8 text with a header and one row a line."


def _column(path: Path, table: pa.Table, name: str) -> _Array:
    """Numbers, NaN where a cell is empty; text that holds them is read."""
    column = table[name]
    if not pa.types.is_string(column.type):
        try:
            return np.asarray(column.cast(pa.float64(), safe=False).to_numpy(), np.float64)
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
            raise DataError(f"{path}: column {name!r} is of type {column.type}; it must hold numbers.") from error
    values = np.full(len(column), np.nan)
    for k, text in enumerate(column.to_pylist()):
        try:
            values[k] = float(text) if text else np.nan
        except ValueError as error:
            raise DataError(f"{path}: row {k}, column {name!r}: {text!r} is no number.") from error
    return values


def _show(figures: dict[str, object]) -> None:
    """Print the figures of all targets and of each, one column each."""
    targets = figures["targets"]
    columns = {"all targets": figures, **(targets if isinstance(targets, dict) else {})}
    click.echo(f"{'':<22}" + "".join(f"{name:>14}" for name in columns))
    for key, value in figures.items():
        if not isinstance(value, dict):
            click.echo(f"{key:<22}" + "".join(f"{_text(row.get(key, '')):>14}" for row in columns.values()))


def _text(value: object) -> str:
    return "none" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
