"""Rows of system tracks side by side: each lane one track's measurements in time order, and where coasted rows go."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.tracks.fuse import LaneRows
from saltus.tracks.measurements import Measurements
from saltus.tracks.settings import TrackerSettings

__all__ = ["Lanes", "held", "in_several", "is_first", "latest", "shortest_periods", "since", "with_coasted"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]

_SLACK = 0.6  # of a period: how late a plot may come before it counts as missed


class Lanes(NamedTuple):
    """Measurements of confirmed local tracks, sorted by system track, then by time."""

    number: _Index  # measurement
    track: _Index  # system track
    local: _Index  # local track, through all systems
    row: _Index  # row of the local tracker that this measurement gave, -1 none
    piece: _Index  # stretch of a system track that is filtered in one go


def is_first(track: _Index) -> _Mask:
    """Say which rows begin a run of equal numbers."""
    return np.asarray(np.diff(track, prepend=-1) != 0)


def since(event: _Mask, track: _Index) -> _Mask:
    """Say of each row whether the event has happened in its lane, there included."""
    if not len(track):
        return np.zeros(0, bool)
    count = np.cumsum(event)
    first = np.maximum.accumulate(np.where(is_first(track), np.arange(len(track)), 0))
    return np.asarray(count - count[first] + event[first] > 0)


def in_several(track: _Index, owner: _Index) -> _Mask:
    """Say of each row whether its lane holds measurements of several systems."""
    count = int(track.max(initial=0)) + 1
    low, high = np.full(count, np.iinfo(np.int64).max), np.full(count, -1)
    np.minimum.at(low, track, owner)
    np.maximum.at(high, track, owner)
    return np.asarray(low[track] != high[track])


def latest(values: npt.NDArray[np.integer], track: _Index) -> _Index:
    """The last value that is not negative, in each lane so far; -1 before."""
    at = np.where(values >= 0, np.arange(len(values)), -1)
    at = np.maximum.accumulate(at)
    first = np.maximum.accumulate(np.where(is_first(track), np.arange(len(values)), 0))
    return np.asarray(np.where(at >= first, values[np.maximum(at, 0)], -1), np.int64)


def held(values: _Array, track: _Index) -> _Array:
    """The last value that is a number, in each lane so far."""
    at = latest(np.where(np.isnan(values), -1, np.arange(len(values))), track)
    return np.asarray(np.where(at >= 0, values[np.maximum(at, 0)], np.nan))


def shortest_periods(lanes: Lanes, m: Measurements, periods: Sequence[float]) -> _Array:
    """Shortest update period of the sources that each lane has had so far, s."""
    own = np.asarray(periods, float)[m.source[lanes.number]]
    out, first = own.copy(), np.flatnonzero(is_first(lanes.track))
    for a, b in zip(first, np.append(first[1:], len(own)), strict=True):
        out[a:b] = np.minimum.accumulate(own[a:b])
    return out


def with_coasted(
    updates: LaneRows, track: _Index, period: _Array, settings: TrackerSettings
) -> tuple[LaneRows, _Index]:
    """Put rows without measurement where one was expected; return all rows, and the update each of them is, -1 none."""
    n = len(updates.lane)
    last = np.append(track[1:] != track[:-1], True)
    limit = np.maximum(settings.coast_scans * period, settings.coast_seconds)
    ahead = np.where(last, limit, np.minimum(np.append(np.diff(updates.time), 0.0) - _SLACK * period, limit))
    count = np.maximum(np.floor(ahead / period + 1e-9), 0).astype(np.int64)
    source = np.repeat(np.arange(n), count)
    number = np.arange(len(source)) - np.repeat(np.cumsum(count) - count, count) + 1
    lane = np.concatenate([updates.lane, updates.lane[source]])
    time = np.concatenate([updates.time, updates.time[source] + number * period[source]])
    order = np.lexsort((time, lane))
    measured = np.concatenate([np.arange(n), np.full(len(source), -1)])[order]
    pick = np.concatenate([np.arange(n), source])[order]
    position = np.where(measured[:, None] >= 0, updates.position[pick], np.nan)
    return LaneRows(lane[order], time[order], position, updates.cov[pick], updates.faulty[pick]), measured
