"""What the tracker gives: published rows, and what became of each measurement."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.tracks.faults import History, PlotLaw
from saltus.tracks.kinematics import Moments
from saltus.tracks.measurements import Measurements

__all__ = [
    "Assignments",
    "ConditionFound",
    "Fates",
    "Fed",
    "Rows",
    "Tracked",
    "assignments",
    "join_fates",
    "join_rows",
]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]


class Rows(NamedTuple):
    """Published track rows, one array element each, in the tracker's plane."""

    track_id: npt.NDArray[np.int64]
    time: _Array
    moments: Moments
    status: npt.NDArray[np.int8]  # index into lifecycle.STATUS
    has_altitude: npt.NDArray[np.bool_]
    icao24: npt.NDArray[np.int32]
    mode3a: npt.NDArray[np.int16]
    callsign: npt.NDArray[Any]  # "" none
    measurement: npt.NDArray[np.int64]  # number of the plot of the update, -1 where coasted
    source: npt.NDArray[np.int32]  # of that plot, -1 where coasted
    lever: _Array  # (k, 2): of that plot, 0 where coasted
    centre: _Array  # (k, 2): centre of the gate
    gate_cov: _Array  # (k, 2, 2): innovation covariance
    d2: _Array  # squared Mahalanobis distance of the horizontal innovation; NaN where there is none
    p_fault: _Array  # probability that the track's last plot was faulty; NaN where nothing told
    fault: npt.NDArray[np.int8]  # likeliest fault of the measurement: 1 + component of its source's; 0 without one
    p_degraded: _Array  # probability that the source of the update is degraded; NaN where coasted
    time_known: _Array  # time of the last report that the row rests on, s

    def take(self, at: npt.NDArray[np.integer] | npt.NDArray[np.bool_]) -> "Rows":
        """Return the rows selected."""
        moments = Moments(*(column[at] for column in self.moments))
        return Rows(moments=moments, **{n: getattr(self, n)[at] for n in Rows._fields if n != "moments"})


def join_rows(parts: Sequence[Rows]) -> Rows:
    """Join rows published at different times; no part gives no rows."""
    nothing = Rows(
        np.zeros(0, np.int64),
        np.zeros(0),
        Moments(np.zeros((0, 6)), np.zeros((0, 6, 6)), np.zeros(0), np.zeros(0)),
        np.zeros(0, np.int8),
        np.zeros(0, bool),
        np.zeros(0, np.int32),
        np.zeros(0, np.int16),
        np.zeros(0, "U8"),
        np.zeros(0, np.int64),
        np.zeros(0, np.int32),
        np.zeros((0, 2)),
        np.zeros((0, 2)),
        np.zeros((0, 2, 2)),
        np.zeros(0),
        np.zeros(0),
        np.zeros(0, np.int8),
        np.zeros(0),
        np.zeros(0),
    )
    parts = [nothing, *parts]
    moments = Moments(*(np.concatenate(column) for column in zip(*(p.moments for p in parts), strict=True)))
    columns = {name: np.concatenate([getattr(p, name) for p in parts]) for name in Rows._fields if name != "moments"}
    return Rows(moments=moments, **columns)


class Fates(NamedTuple):
    """What became of plots, in the order in which it became known; of two fates of one plot the later one holds."""

    plot: npt.NDArray[np.int64]  # number of the plot
    track_id: npt.NDArray[np.int64]  # 0 = none
    split: npt.NDArray[np.bool_]  # a second plot of a target already updated
    elsewhere: npt.NDArray[np.bool_]  # far from the track that has its address


class Fed(NamedTuple):
    """What a tracker knows anew."""

    rows: Rows
    fates: Fates
    confirmed: npt.NDArray[np.int64]  # ids of the tracks confirmed meanwhile


def join_fates(parts: Sequence[Fates]) -> Fates:
    """Join fates told at different times; no part gives none."""
    nothing = Fates(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, bool), np.zeros(0, bool))
    return Fates(*(np.concatenate(column) for column in zip(nothing, *parts, strict=True)))


class ConditionFound(NamedTuple):
    """What was found of the condition of one source."""

    law: PlotLaw
    history: History


class Assignments(NamedTuple):
    """What became of each measurement."""

    track_id: npt.NDArray[np.int64]  # (N,), 0 = none
    split: npt.NDArray[np.bool_]  # (N,): a second plot of a target already updated
    elsewhere: npt.NDArray[np.bool_]  # (N,): far from the track that has its address
    confirmed: npt.NDArray[np.int64]  # ids of the tracks that were confirmed at some time
    sources: Sequence[ConditionFound]  # what was found of the condition of each source


@dataclass(frozen=True, slots=True)
class Tracked:
    """Everything that trackers found."""

    rows: list[Rows]  # `measurement` is a place in `measurements`
    measurements: Measurements
    assignments: Assignments


def assignments(
    plot: npt.NDArray[np.int64],
    fates: Fates,
    confirmed: Sequence[npt.NDArray[np.int64]],
    sources: Sequence[ConditionFound],
) -> Assignments:
    """Return the last fate of each plot.

    Args:
        plot: numbers of the plots.
        fates: everything told of them.
        confirmed: ids of confirmed tracks, as told.
        sources: what was found of the condition of each source.
    """
    n = len(plot)
    found = Assignments(
        np.zeros(n, np.int64),
        np.zeros(n, bool),
        np.zeros(n, bool),
        np.unique(np.concatenate([np.zeros(0, np.int64), *confirmed])),
        sources,
    )
    place = np.full(int(plot.max(initial=-1)) + 1, -1)
    place[plot] = np.arange(n)
    at = place[fates.plot]
    found.track_id[at], found.split[at], found.elsewhere[at] = fates[1:]
    return found
