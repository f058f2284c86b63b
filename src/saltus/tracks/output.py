"""Published rows as tables: true north and east at the target, degrees where people read them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.geo import Plane
from saltus.records import REASONS, Plots
from saltus.tracks.lifecycle import STATUS
from saltus.tracks.rows import Rows

__all__ = [
    "BEARING",
    "ELSEWHERE",
    "NOT_CONFIRMED",
    "SINGLE",
    "SPLIT",
    "Fate",
    "assignment_table",
    "innovation_table",
    "report_table",
    "track_table",
]

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

SPLIT = "split plot"
ELSEWHERE = "address elsewhere"  # far from the track that has its address
BEARING = "bearing alone"  # in no confirmed track's direction: it starts none
SINGLE = "single plot"  # no second plot near it
NOT_CONFIRMED = "track not confirmed"


def track_table(rows: Rows, plane: Plane, sigma_pressure: float) -> pa.Table:
    """Return rows with the columns of tracks.parquet.

    The error of pressure altitude as height moves a radar plot along its ray by `lever` metres per metre; it is the
    same scan after scan, so no filter averages it out and it is added to the published covariance.
    """
    mean, cov = rows.moments.mean, rows.moments.cov.copy()
    push = rows.lever * sigma_pressure
    cov[:, 0:3:2, 0:3:2] += push[:, :, None] * push[:, None, :]
    told = rows.has_altitude
    altitude = np.where(told, mean[:, 4], np.nan)
    true = plane.to_true(mean[:, :4], cov[:, :4, :4], altitude)
    ve, vn = true.velocity.T
    position, velocity = true.position_cov, true.velocity_cov
    return pa.table(
        {
            "track_id": rows.track_id,
            "time": rows.time,
            "latitude": np.degrees(true.latitude),
            "longitude": np.degrees(true.longitude),
            "altitude": _null_nan(altitude),
            "ve": ve,
            "vn": vn,
            "vu": _null_nan(np.where(told, mean[:, 5], np.nan)),
            "course_deg": np.degrees(np.arctan2(ve, vn)) % 360.0,
            "speed_mps": np.hypot(ve, vn),
            "cov_ee": position[:, 0, 0],
            "cov_en": position[:, 0, 1],
            "cov_nn": position[:, 1, 1],
            "cov_uu": _null_nan(np.where(told, cov[:, 4, 4], np.nan)),
            "cov_veve": velocity[:, 0, 0],
            "cov_vevn": velocity[:, 0, 1],
            "cov_vnvn": velocity[:, 1, 1],
            "p_manoeuvre_h": np.clip(rows.moments.p_manoeuvre_h, 0.0, 1.0),
            "p_manoeuvre_v": np.clip(rows.moments.p_manoeuvre_v, 0.0, 1.0),
            "p_fault": _null_nan(rows.p_fault),
            "status": pa.array(np.array(STATUS)[rows.status], pa.string()),
            "icao24": pa.array([f"{c:06X}" if c >= 0 else None for c in rows.icao24], pa.string()),
            "mode3a": pa.array([f"{c:04o}" if c >= 0 else None for c in rows.mode3a], pa.string()),
            "callsign": pa.array([str(c) or None for c in rows.callsign], pa.string()),
            "x_m": mean[:, 0],
            "y_m": mean[:, 2],
            "p_degraded": _null_nan(rows.p_degraded),
            "time_known": rows.time_known,
        }
    )


def innovation_table(rows: Rows, plane: Plane, names: Sequence[str]) -> pa.Table:
    """Return the gates of updated rows: centre, three-sigma half widths to true east and north, NIS.

    Args:
        rows: published rows.
        plane: theirs.
        names: designation of each source.
    """
    seen = np.flatnonzero(rows.measurement >= 0)
    state, cov = np.zeros((len(seen), 4)), np.zeros((len(seen), 4, 4))
    state[:, 0::2], cov[:, 0::2, 0::2] = rows.centre[seen], rows.gate_cov[seen]
    true = plane.to_true(state, cov)
    half = 3.0 * np.sqrt(np.diagonal(true.position_cov, axis1=-2, axis2=-1))
    return pa.table(
        {
            "track_id": rows.track_id[seen],
            "time": rows.time[seen],
            "source": pa.array([names[s] for s in rows.source[seen]], pa.string()),
            "latitude": np.degrees(true.latitude),
            "longitude": np.degrees(true.longitude),
            "gate_e": half[:, 0],
            "gate_n": half[:, 1],
            "nis": _null_nan(rows.d2[seen]),
            "dof": np.full(len(seen), 2, np.int32),
        }
    )


class Fate(NamedTuple):
    """What became of reports, as far as their tables tell."""

    placed: _Mask  # whether a tracker was given it
    bearing: _Mask  # whether it is a bearing alone
    split: _Mask  # a second plot of a target already updated
    elsewhere: _Mask  # far from the track that has its address
    single: _Mask  # the only one of its track, or of no track


def assignment_table(plots: Plots, track_id: npt.NDArray[np.int64], fate: Fate) -> pa.Table:
    """Return one row per target report read: the track it belongs to (0 none), or why none."""
    why = np.select(
        [~fate.placed, track_id > 0, fate.bearing, fate.split, fate.elsewhere, fate.single],
        [np.array(REASONS)[plots.reason], "", BEARING, SPLIT, ELSEWHERE, SINGLE],
        NOT_CONFIRMED,
    )
    return report_table(plots, track_id, why.tolist())


def report_table(plots: Plots, track_id: npt.NDArray[np.int64], reason: Sequence[str]) -> pa.Table:
    """Return the columns of assignments.parquet.

    Args:
        plots: reports.
        track_id: of each, 0 none.
        reason: why a report has no track, "" where it has one.
    """
    sources = np.array([-1 if s.system.category is None else s.system.category for s in plots.sources] or [-1])
    category = sources[plots.source]
    return pa.table(
        {
            "source": pa.array(_names(plots.files, plots.file), pa.string()),
            "category": pa.array(category, pa.int32(), mask=category < 0),
            "record": pa.array(plots.record, pa.int64()),
            "time": _null_nan(plots.time),
            "track_id": pa.array(track_id, pa.int64(), mask=track_id == 0),
            "reason": pa.array([r or None for r in reason], pa.string()),
        }
    )


def _names(files: Sequence[str], index: npt.NDArray[np.int32]) -> list[str]:
    return [files[i] for i in index]


def _null_nan(values: _Array) -> pa.Array:
    return pa.array(values, pa.float64(), from_pandas=True)
