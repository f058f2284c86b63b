"""What two systems say about the same objects at the same times: residuals of pairs of local tracks, in blocks."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.identify import LocalTracks
from saltus.shapes import Float, Int
from saltus.tracks.bias import effects

__all__ = ["Blocks", "SystemTracks", "encounters", "medians"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]

_GAP, _SHORTEST_GAP = 2.5, 3.0  # of the median interval, and s: no interpolation across a longer one
_ACCEL = 0.5  # m/s^2: what straight interpolation leaves out


class SystemTracks(NamedTuple):
    """The local tracks of one system with what registration needs to know of each row."""

    tracks: LocalTracks
    velocity: Float[np.ndarray, "n 2"]  # of the track's own filter after each row, m/s
    ray: Float[np.ndarray, "n 2"]  # from the site, m; NaN where the row is not polar
    icao24: Int[np.ndarray, " k"]  # address of each track, -1 none


class Blocks(NamedTuple):
    """Residuals of pairs, one for each stretch of time, sorted by pair, then by time."""

    pair: Int[np.ndarray, " n"]  # position in the list of pairs
    time: Float[np.ndarray, " n"]  # when the last report of the block was there, s
    residual: Float[np.ndarray, "n 2"]  # position by a minus position by b, m: the medians of the block
    effect: Float[np.ndarray, "n 2 q"]  # of the biases of a, mean over the block
    cov: Float[np.ndarray, "n 2 2"]  # of one report's residual by the stated noise, m^2

    def until(self, start: float, stop: float) -> "Blocks":
        """Return the blocks complete in (start, stop]."""
        keep = (self.time > start) & (self.time <= stop)
        return Blocks(*(column[keep] for column in self))


def encounters(a: SystemTracks, b: SystemTracks, pairs: Int[np.ndarray, "p 2"], length: float) -> Blocks:
    """Compare each report of a's tracks with the paired track of b, interpolated between its reports.

    Reports of some seconds share what lasts: satellite positions, a reflector's place on the aircraft, rounding. So
    one residual is kept for each block of time, the median, and it counts once.

    Args:
        a: tracks of the system whose biases are wanted.
        b: tracks of the system it is compared with.
        pairs: indices of tracks in a and b.
        length: of a block, s.
    """
    pair, row = _rows_in(a.tracks.track, pairs[:, 0])
    life = float(max(b.tracks.time.max(initial=0.0), a.tracks.time.max(initial=0.0))) + 1.0
    start = float(min(b.tracks.time.min(initial=np.inf), a.tracks.time.min(initial=np.inf)))
    start = start if np.isfinite(start) else 0.0
    life -= start
    axis = b.tracks.track * life + (b.tracks.time - start)
    time = a.tracks.time[row]
    after = np.searchsorted(axis, pairs[pair, 1] * life + (time - start), side="right")
    inside = (after > 0) & (after < len(axis))
    pair, row, after, time = pair[inside], row[inside], after[inside], time[inside]
    before, gap = after - 1, b.tracks.time[after] - b.tracks.time[after - 1]
    mine = (b.tracks.track[before] == pairs[pair, 1]) & (b.tracks.track[after] == pairs[pair, 1])
    near = mine & (gap > 0) & (gap <= _longest_gap(b.tracks))
    pair, row, before, after, gap, time = (v[near] for v in (pair, row, before, after, gap, time))
    share = ((time - b.tracks.time[before]) / gap)[:, None]
    at_b = (1.0 - share) * b.tracks.z[before] + share * b.tracks.z[after]
    w = share[:, :, None]
    bent = (0.5 * _ACCEL * gap**2)[:, None, None] * w * (1.0 - w)
    cov = a.tracks.R[row] + (1.0 - w) ** 2 * b.tracks.R[before] + w**2 * b.tracks.R[after] + bent**2 * np.eye(2)
    seen = np.maximum(time, b.tracks.time[after])
    effect = effects(a.ray[row], a.velocity[row])
    block = np.floor(time / length) - np.floor(start / length)  # the same blocks, whatever the first report given
    return _blocks(pair, block, seen, a.tracks.z[row] - at_b, effect, cov)


def _rows_in(track: _Index, wanted: _Index) -> tuple[_Index, _Index]:
    """Return position in `wanted` and row, for all rows of each track wanted."""
    first, stop = np.searchsorted(track, wanted, "left"), np.searchsorted(track, wanted, "right")
    count = stop - first
    place = np.repeat(np.arange(len(wanted)), count)
    return place, np.arange(len(place)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)


def _longest_gap(tracks: LocalTracks) -> float:
    step = np.diff(tracks.time)[np.diff(tracks.track) == 0]
    return max(_SHORTEST_GAP, _GAP * float(np.median(step))) if len(step) else _SHORTEST_GAP


def _blocks(pair: _Index, block: _Array, seen: _Array, residual: _Array, effect: _Array, cov: _Array) -> Blocks:
    key = pair * (block.max(initial=0.0) + 1.0) + block
    names, group = np.unique(key, return_inverse=True)
    if not len(names):
        return Blocks(pair, seen, residual, effect, cov)
    count = np.bincount(group)
    first = np.cumsum(count) - count
    order = np.argsort(group, kind="stable")

    def mean(values: _Array) -> _Array:
        total = np.add.reduceat(values[order], first, axis=0)
        return np.asarray(total / count.reshape(-1, *(1 for _ in total.shape[1:])))

    middle = np.stack([medians(residual[:, c], group, first, count) for c in (0, 1)], axis=-1)
    return Blocks(pair[order][first], np.maximum.reduceat(seen[order], first), middle, mean(effect), mean(cov))


def medians(values: _Array, group: _Index, first: _Index, count: _Index) -> _Array:
    """Return the median of each group; `first` and `count` say where they lie when sorted by group."""
    ordered = values[np.lexsort((values, group))]
    return np.asarray(0.5 * (ordered[first + (count - 1) // 2] + ordered[first + count // 2]))
