"""Rows that are published of tracks: after an update, and where one was expected and none came."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.tracks.kinematics import Kinematics, Moments
from saltus.tracks.lifecycle import COASTED, Lifecycle
from saltus.tracks.measurements import Measurements
from saltus.tracks.rows import Rows

__all__ = ["Told", "coast", "updated_rows"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]


class Told(NamedTuple):
    """What an update said of each plot and of its source."""

    centre: _Array  # (k, 2): centre of the gate
    gate_cov: _Array  # (k, 2, 2): innovation covariance
    d2: _Array  # (k,): of the innovation, NaN where it says nothing of the noise
    p_fault: _Array  # (k,): probability that it is faulty, NaN where nothing told
    fault: npt.NDArray[np.int8]  # (k,): likeliest fault, 1 + component, 0 where none can be
    p_degraded: float  # of the source, NaN where unknown


def updated_rows(
    life: Lifecycle, rows: _Index, moments: Moments, m: Measurements, plots: _Index, told: Told, known: float
) -> Rows:
    """Return the rows of tracks just updated.

    Args:
        life: all tracks.
        rows: those updated.
        moments: their states.
        m: measurements.
        plots: the one of each track.
        told: what the updates said.
        known: time by which that is known, s.
    """
    n = len(rows)
    return Rows(
        track_id=life.id[rows],
        time=life.time[rows],  # of the state: a late plot is older
        moments=moments,
        status=life.status[rows],
        has_altitude=life.knows_altitude(rows, moments.cov),
        icao24=life.icao24[rows],
        mode3a=life.mode3a[rows],
        callsign=life.callsign[rows],
        measurement=m.plot[plots],
        source=m.source[plots],
        lever=m.lever[plots],
        centre=told.centre,
        gate_cov=told.gate_cov,
        d2=told.d2,
        p_fault=told.p_fault,
        fault=told.fault.astype(np.int8),
        p_degraded=np.full(n, told.p_degraded),
        time_known=np.full(n, known),
    )


def coast(kinematics: Kinematics, life: Lifecycle, now: float) -> list[Rows]:
    """Return rows of confirmed tracks where a plot was expected by `now` and none came."""
    out = []
    rows, expected = life.to_coast(now)
    while len(rows):
        ahead = kinematics.predicted(rows, expected - life.time[rows])
        out.append(_coasted(life, rows, ahead.moments(np.arange(len(rows))), expected, now))
        rows, expected = life.to_coast(now)
    return out


def _coasted(life: Lifecycle, rows: _Index, moments: Moments, time: _Array, known: float) -> Rows:
    """Return the rows of tracks that missed the plot expected at `time`, as known at `known`."""
    n = len(rows)
    return Rows(
        track_id=life.id[rows],
        time=time,
        moments=moments,
        status=np.full(n, COASTED, np.int8),
        has_altitude=life.knows_altitude(rows, moments.cov),
        icao24=life.icao24[rows],
        mode3a=life.mode3a[rows],
        callsign=life.callsign[rows],
        measurement=np.full(n, -1),
        source=np.full(n, -1, np.int32),
        lever=np.zeros((n, 2)),
        centre=moments.mean[:, [0, 2]],
        gate_cov=moments.cov[:, [[0], [2]], [0, 2]],
        d2=np.full(n, np.nan),
        p_fault=life.p_fault[rows],
        fault=np.zeros(n, np.int8),
        p_degraded=np.full(n, np.nan),
        time_known=np.full(n, known),
    )
