"""Rows of system tracks side by side: each lane one track's measurements in time order."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

__all__ = ["Lanes", "is_first", "latest", "since"]

_Index = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]


class Lanes(NamedTuple):
    """Measurements of confirmed local tracks, sorted by system track, then by time."""

    number: _Index  # measurement
    track: _Index  # system track
    local: _Index  # local track, through all systems
    row: _Index  # row of the local tracker that this measurement gave, -1 none


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


def latest(values: npt.NDArray[np.integer], track: _Index) -> _Index:
    """The last value that is not negative, in each lane so far; -1 before."""
    at = np.where(values >= 0, np.arange(len(values)), -1)
    at = np.maximum.accumulate(at)
    first = np.maximum.accumulate(np.where(is_first(track), np.arange(len(values)), 0))
    return np.asarray(np.where(at >= first, values[np.maximum(at, 0)], -1), np.int64)
