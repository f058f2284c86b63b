"""Where aircraft were really going when a plot was made: what they downlink, a simulation's truth, or another run."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.errors import DataError
from saltus.evaluate.reference import Reference
from saltus.io.cells import numbers
from saltus.io.sheet import read_sheet
from saltus.records import Plots

__all__ = ["KNOT", "OWN_RUN", "Followed", "Motion", "downlinked", "followed", "from_run", "simulated"]

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

KNOT = 1852.0 / 3600.0
OWN_RUN = "the run over clean plots, faults known"  # name of a reference that is no truth
_STEPS = (1 / 128, 1852 / 256, 2 * np.pi / 65536)  # s, m, rad: quantisation of CAT048
_STRAIGHT, _TURN = 3.0, 10.0  # degrees of roll
_COLUMNS = ("time", "rho_nm", "theta_deg", "bds50_track_deg", "bds50_roll_deg", "bds50_gs_kt")
_COVERED = 0.99  # of the radar plots that a reference must know


class Motion(NamedTuple):
    """True course and speed at each plot."""

    name: str
    course: _Array  # degrees, NaN unknown
    speed: _Array  # m/s
    straight: _Mask
    turning: _Mask


class Followed(NamedTuple):
    """What the tracker said at each plot; NaN where the plot gave no row."""

    track: npt.NDArray[np.int64]  # 0 none
    course: _Array  # degrees
    speed: _Array  # m/s
    p_fault: _Array
    p_manoeuvre: _Array
    confirmed: _Mask  # whether the track was, at that plot


def followed(plots: Plots, tracks: pa.Table, assigned: pa.Table) -> Followed:
    """Join rows of tracks to the plots that made them, by track and time."""
    track = assigned["track_id"].fill_null(0).to_numpy()
    updated = tracks.filter(np.array(tracks["status"].to_pylist()) != "coasted")
    keys = zip(updated["track_id"].to_pylist(), updated["time"].to_pylist(), strict=True)
    row_of = {key: k for k, key in enumerate(keys)}
    row = np.array([row_of.get(key, -1) for key in zip(track.tolist(), plots.time.tolist(), strict=True)])

    def column(name: str) -> _Array:
        values = np.append(updated[name].to_numpy(zero_copy_only=False).astype(np.float64), np.nan)
        return np.asarray(values[row])

    names = ("course_deg", "speed_mps", "p_fault", "p_manoeuvre_h")
    confirmed = np.append(np.array(updated["status"].to_pylist()) == "confirmed", False)
    course, speed, p_fault, p_manoeuvre = (column(name) for name in names)
    return Followed(track, course, speed, p_fault, p_manoeuvre, confirmed[row])


def downlinked(plots: Plots, path: Path) -> Motion:
    """Track angle, roll and ground speed that aircraft sent with each plot (BDS 5,0), from a table of the same plots.

    Straight is less than 3 degrees of roll, turning more than 10.

    Args:
        plots: reports.
        path: Parquet with time (s, UTC), rho_nm, theta_deg, bds50_track_deg, bds50_roll_deg, bds50_gs_kt.

    Raises:
        DataError: no Parquet table, a column is missing, or the table knows other plots.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such file.")
    try:
        table = read_sheet(path, _COLUMNS).columns
    except DataError as error:
        raise DataError(
            f"{error} A reference is a table of the same plots with what aircraft downlinked (BDS 5,0), "
            f"in columns {', '.join(_COLUMNS)}."
        ) from error
    missing = [name for name in _COLUMNS if name not in table]
    if missing:
        raise DataError(f"{path}: no column {', '.join(missing)}; a reference has {', '.join(_COLUMNS)}.")
    t, rho, theta, course, roll, knots = (numbers(path, name, table[name], []) for name in _COLUMNS)
    row = {key: k for k, key in enumerate(_keys(t, rho * 1852.0, np.radians(theta)))}
    usable = plots.reason == 0
    at = np.array([row.get(key, -1) for key in _keys(plots.time, plots.range, plots.azimuth)])
    if np.mean(at[usable] >= 0) < _COVERED:
        raise DataError(f"{path}: only {np.mean(at[usable] >= 0):.1%} of the recording's plots are in this table.")
    course, roll, knots = (np.where(at >= 0, values[at], np.nan) for values in (course, roll, knots))
    known = np.isfinite(course + roll + knots)
    bank = np.abs(np.where(known, roll, np.nan))
    return Motion(f"BDS 5,0 in {path.name}", course, knots * KNOT, bank < _STRAIGHT, bank > _TURN)


def _keys(time: _Array, slant: _Array, azimuth: _Array) -> list[tuple[int, ...]]:
    """What tells plots apart in two decodings: raw time of day, range and azimuth."""
    values = (time % 86400.0, slant, azimuth)
    known = [np.where(np.isfinite(v), v, -1.0) for v in values]
    raw = [np.rint(v / step).astype(np.int64) for v, step in zip(known, _STEPS, strict=True)]
    raw[2] %= 65536
    return list(zip(*(r.tolist() for r in raw), strict=True))


def simulated(target: npt.NDArray[np.int64], time: _Array, truth: Reference) -> Motion:
    """Course, speed and turning of simulated aircraft.

    Args:
        target: of each plot, index into the truth's names, -1 none.
        time: of each plot, s.
        truth: with velocities.
    """
    known = truth.at(target, time)
    east, north = known.velocity.T
    told, turning = np.isfinite(east), truth.turned(target, time)
    course = np.degrees(np.arctan2(east, north)) % 360.0
    return Motion("the simulation's truth", course, np.hypot(east, north), told & ~turning, told & turning)


def from_run(run: Followed) -> Motion:
    """Take a run over clean plots for the truth: straight is where it thinks so."""
    known = np.isfinite(run.course)
    return Motion(
        OWN_RUN,
        run.course,
        run.speed,
        known & (run.p_manoeuvre < 0.5),
        known & (run.p_manoeuvre >= 0.5),
    )
