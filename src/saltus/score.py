"""`saltus score`: how good the tracks of an output directory are against the truth."""

import json
from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from saltus.errors import DataError
from saltus.geo import geodetic_to_ecef
from saltus.io.write import output_file
from saltus.metrics.following import Targets, Tracks, each_time_once, target_scores

__all__ = ["read_tracks", "read_truth", "score_files"]

_Array = npt.NDArray[np.float64]

_CUTOFF = 20.0  # m
_LIVE = ("confirmed", "coasted")


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
        DataError: a table or a column is missing, or tracks and truth do not overlap in time.
    """
    figures = target_scores(read_tracks(output / "tracks.parquet"), read_truth(truth), cutoff=cutoff)
    if json_path is not None:
        with output_file(json_path) as temporary:
            temporary.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    _show(figures)
    return figures


def read_truth(path: Path) -> Targets:
    """Read a truth table; rows without a time or a place are left out.

    Raises:
        DataError: no such table, a column is missing, or no row is left.
    """
    table = _table(path, ("time", "target_id", "latitude", "longitude"))
    label = np.array([str(v) for v in table["target_id"].to_pylist()], object)
    time, latitude, longitude = (_column(path, table, c) for c in ("time", "latitude", "longitude"))
    good = np.isfinite(time) & np.isfinite(latitude) & np.isfinite(longitude)
    if not good.any():
        raise DataError(f"{path}: no row gives time, latitude and longitude.")
    names, target = np.unique(label[good].astype(str), return_inverse=True)
    keep = each_time_once(target, time[good])
    place = geodetic_to_ecef(np.radians(latitude[good][keep]), np.radians(longitude[good][keep]), 0.0)
    return Targets(tuple(names.tolist()), target[keep].astype(np.intp), time[good][keep], place)


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
    try:
        if path.suffix.lower() == ".csv":
            from pyarrow import csv

            table = csv.read_csv(path)
        else:
            table = pq.read_table(path)
    except pa.ArrowInvalid as error:
        raise DataError(f"{path}: no readable table: {str(error).splitlines()[0]}") from error
    missing = [c for c in needed if c not in table.column_names]
    if missing:
        raise DataError(f"{path}: no column {missing[0]!r}; needed are {', '.join(needed)}.")
    return table


def _column(path: Path, table: pa.Table, name: str) -> _Array:
    try:
        return np.asarray(table[name].cast(pa.float64(), safe=False).to_numpy(), np.float64)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise DataError(f"{path}: column {name!r} is of type {table[name].type}; it must hold numbers.") from error


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
