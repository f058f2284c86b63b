"""`saltus score`: how good the tracks of an output directory are against the truth."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError
from saltus.evaluate import Reference, Tracks, target_scores
from saltus.evaluate.tables import read_reference, read_tracks
from saltus.geo import circular_mean, ecef_to_geodetic, wrap
from saltus.io.publish import settle
from saltus.io.write import output_file, write_json
from saltus.text import say

__all__ = ["score_files"]

_Array = npt.NDArray[np.float64]

_CUTOFF = 20.0  # m
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
    settle(output)
    if not (output / "tracks.parquet").is_file():
        raise DataError(f"{output}: no tracks.parquet in it; OUTPUT is a folder that saltus track wrote.")
    tracks, targets = read_tracks(output / "tracks.parquet"), read_reference(truth)
    _check_common(truth, targets, tracks)
    figures = target_scores(tracks, targets, cutoff=cutoff)
    if json_path is not None:
        with output_file(json_path) as temporary:
            write_json(temporary, figures)
    _show(figures)
    return figures


def _check_common(path: Path, truth: Reference, tracks: Tracks) -> None:
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
    latitude, longitude = ecef_to_geodetic(place)[:2]
    centre = circular_mean(longitude)  # so that an area across 180 degrees is no belt round the earth
    latitude, longitude = np.degrees(latitude), np.degrees(centre + wrap(longitude - centre))
    return (
        f"latitude {latitude.min():.4g} to {latitude.max():.4g} "
        f"and longitude {longitude.min():.4g} to {longitude.max():.4g}"
    )


def _show(figures: dict[str, object]) -> None:
    """Print the figures of all targets and of each, one column each."""
    targets = figures["targets"]
    columns = {"all targets": figures, **(targets if isinstance(targets, dict) else {})}
    say(f"{'':<22}" + "".join(f"{name:>14}" for name in columns))
    for key, value in figures.items():
        if not isinstance(value, dict):
            say(f"{key:<22}" + "".join(f"{_text(row.get(key, '')):>14}" for row in columns.values()))


def _text(value: object) -> str:
    return "none" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
