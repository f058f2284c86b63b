"""The track table in order, and one line for each track."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.report.columns import last_text_per_group, numbers, texts

if TYPE_CHECKING:
    import pyarrow as pa

__all__ = ["TrackRow", "Updates", "groups", "read_updates", "vertical_chance"]

_STATUS = {"tentative": 0, "confirmed": 1, "coasted": 2}
_COASTED = 2
MOVING = 3.0  # m/s


class TrackRow(NamedTuple):
    """One track in the page's table; times in s, NaN where nothing is known."""

    id: int
    callsign: str
    icao24: str
    mode3a: str
    start: float
    duration: float
    n_updates: int
    n_coasted: int
    max_h: float
    max_v: float
    manoeuvre_s: float  # updates with P(manoeuvre) > 1/2 in either direction, times the usual update interval
    n_moving: int  # updates faster than MOVING
    confirmed: bool

    @property
    def label(self) -> str:
        """The best name known: callsign, address or number."""
        return self.callsign or self.icao24 or f"#{self.id}"


@dataclass(frozen=True, slots=True, eq=False)
class Updates:
    """Track updates ordered by track and time; track k owns the rows starts[k] to starts[k + 1]."""

    table: "pa.Table"
    track: npt.NDArray[np.intp]  # row -> index into `rows`
    starts: npt.NDArray[np.intp]
    time: npt.NDArray[np.float64]
    status: npt.NDArray[np.uint8]
    rows: tuple[TrackRow, ...]


def read_updates(tracks: "pa.Table") -> Updates:
    """Order the track table and sum up each track."""
    if tracks.num_rows:
        tracks = tracks.sort_by([("track_id", "ascending"), ("time", "ascending")])
    ids = numbers(tracks, "track_id").astype(np.int64)
    starts = np.flatnonzero(np.diff(ids, prepend=ids[0] - 1)) if len(ids) else np.zeros(0, np.intp)
    track = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(ids))))
    time = numbers(tracks, "time")
    status = np.array([_STATUS.get(s, 0) for s in texts(tracks, "status")], np.uint8)
    names = [
        last_text_per_group(texts(tracks, column, form), starts)
        for column, form in (("callsign", "d"), ("icao24", "06X"), ("mode3a", "04o"))
    ]
    rows = _rows(tracks, ids, starts, time, status, names)
    return Updates(tracks, track, np.append(starts, len(ids)), time, status, rows)


def vertical_chance(tracks: "pa.Table") -> npt.NDArray[np.float64]:
    """Return each row's probability of a vertical manoeuvre, NaN where no height was measured."""
    return np.where(np.isfinite(numbers(tracks, "altitude")), numbers(tracks, "p_manoeuvre_v"), np.nan)


def _rows(
    tracks: "pa.Table",
    ids: npt.NDArray[np.int64],
    starts: npt.NDArray[np.intp],
    time: npt.NDArray[np.float64],
    status: npt.NDArray[np.uint8],
    names: list[list[str]],
) -> tuple[TrackRow, ...]:
    if not len(ids):
        return ()
    p_h, p_v = numbers(tracks, "p_manoeuvre_h"), vertical_chance(tracks)
    last = np.append(starts[1:], len(ids)) - 1
    measured = status != _COASTED
    speed = numbers(tracks, "speed_mps")
    # Parked transponders seem to jump about: what moves does so at a tenth of the traffic's speed at least.
    known = speed[measured & np.isfinite(speed)]
    floor = max(MOVING, 0.1 * float(np.quantile(known, 0.95))) if len(known) else MOVING
    moving = (speed > floor) & measured
    jumping = (np.fmax(p_h, p_v) > 0.5) & moving
    max_h, max_v = np.fmax.reduceat(p_h, starts), np.fmax.reduceat(p_v, starts)
    n_coasted = np.add.reduceat(status == _COASTED, starts, dtype=np.int64)
    n_all = last + 1 - starts
    period = [float(np.median(np.diff(time[a : b + 1]))) if b > a else 0.0 for a, b in zip(starts, last, strict=True)]
    manoeuvre = np.add.reduceat(jumping, starts, dtype=np.int64) * np.array(period)
    n_moving = np.add.reduceat(moving, starts, dtype=np.int64)
    confirmed = np.maximum.reduceat(status, starts) > 0
    return tuple(
        TrackRow(
            int(ids[s]),
            names[0][k],
            names[1][k].upper(),
            names[2][k],
            float(time[s]),
            float(time[last[k]] - time[s]),
            int(n_all[k] - n_coasted[k]),
            int(n_coasted[k]),
            float(max_h[k]),
            float(max_v[k]),
            float(manoeuvre[k]),
            int(n_moving[k]),
            bool(confirmed[k]),
        )
        for k, s in enumerate(starts)
    )


def groups(rows: tuple[TrackRow, ...], n: int = 3) -> tuple[list[int], list[int]]:
    """Choose the most manoeuvring tracks, and the busiest of the others, as indices into `rows`.

    Busiest means most updates in motion: parked transponders have the most updates and nothing to show.
    """
    known = [k for k, row in enumerate(rows) if row.confirmed]
    jumping = sorted((k for k in known if rows[k].manoeuvre_s > 0), key=lambda k: -rows[k].manoeuvre_s)[:n]
    others = [k for k in known if k not in jumping]
    return jumping, sorted(others, key=lambda k: (-rows[k].n_moving, -rows[k].n_updates))[:n]
