"""Which local tracks of two systems could be one object at all: those that were near each other while both lived."""

import numpy as np

from saltus.errors import ModelError
from saltus.identify.local import LocalTracks, PairSettings, Spans, spans
from saltus.models.checks import FloatArray
from saltus.shapes import Float, Int

__all__ = ["candidate_pairs"]

_EVERY = 8.0  # s between the times at which tracks are laid beside each other
_FASTEST = 3.0  # standard deviations of speed


def candidate_pairs(
    a: LocalTracks, b: LocalTracks, settings: PairSettings, *, reach: float, every: float = _EVERY
) -> Int[np.ndarray, "p 2"]:
    """Return the pairs of tracks that lay within reach of each other at some time while both lived.

    Both systems are laid out at common times, at which positions are interpolated between a track's measurements, and
    a tree finds what is near. Tracks that lived together between common times only are compared at the nearest one,
    with a reach that grows by the way an object of three `speed_sigma` makes.

    Args:
        a: tracks of one system.
        b: tracks of the other.
        settings: for the speed of objects.
        reach: m; a few standard deviations of both systems' errors and of the offset between them.
        every: s between common times; shorter finds tracks that meet for a moment only.

    Returns:
        Indices of the tracks of a and b, each pair once, sorted.

    Raises:
        DataError: local tracks that are none.
        ModelError: reach or every is not positive.
    """
    if not (0 < reach < np.inf and 0 < every < np.inf):
        raise ModelError(f"reach and every must be positive and finite, got {reach} m and {every} s.")
    from scipy.spatial import cKDTree

    spans_a, spans_b = spans(a, "a"), spans(b, "b")
    if not len(a.track) or not len(b.track):
        return np.zeros((0, 2), np.int64)
    start = min(a.time.min(), b.time.min())
    speed = _FASTEST * settings.speed_sigma
    (owner_a, slot_a, at_a, loose_a), (owner_b, slot_b, at_b, loose_b) = (
        _sampled(tracks, span, start, every) for tracks, span in ((a, spans_a), (b, spans_b))
    )
    widest = reach + speed * every  # no query reaches farther, so layers this far apart do not see each other
    points_a = np.column_stack([at_a, 2.0 * widest * slot_a])
    points_b = np.column_stack([at_b, 2.0 * widest * slot_b])
    found = cKDTree(points_a).query_ball_point(points_b, reach + speed * (loose_b + loose_a.max(initial=0.0)))
    count = np.array([len(f) for f in found], dtype=np.int64)
    if not count.sum():
        return np.zeros((0, 2), np.int64)
    i = np.concatenate([np.asarray(f, dtype=np.int64) for f in found if f])
    j = np.repeat(np.arange(len(found)), count)
    begin = np.maximum(spans_a.begin[owner_a[i]], spans_b.begin[owner_b[j]])
    end = np.minimum(spans_a.end[owner_a[i]], spans_b.end[owner_b[j]])
    met = np.floor((end - start) / every) >= np.ceil((begin - start) / every)  # both lived at a common time
    loose = loose_a[i] + loose_b[j]
    near = np.hypot(*(at_a[i] - at_b[j]).T) <= reach + speed * loose
    near &= (begin <= end) & ((loose == 0.0) | ~met)
    return np.unique(np.column_stack([owner_a[i[near]], owner_b[j[near]]]), axis=0)


def _sampled(
    tracks: LocalTracks, span: Spans, start: float, every: float
) -> tuple[Int[np.ndarray, " s"], Int[np.ndarray, " s"], Float[np.ndarray, "s 2"], Float[np.ndarray, " s"]]:
    """Owner, number of the common time, position there, and s that this time lies outside of the track's life."""
    alive = np.flatnonzero(~span.empty)
    low = np.ceil((span.begin[alive] - start) / every - 0.5).astype(np.int64)
    high = np.floor((span.end[alive] - start) / every + 0.5).astype(np.int64)
    count = high - low + 1
    owner = np.repeat(alive, count)
    slot = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(low, count)
    time = np.clip(start + every * slot, span.begin[owner], span.end[owner])
    loose = np.abs(start + every * slot - time)
    return owner, slot, _interpolated(tracks, span, owner, time, start), loose


def _interpolated(
    tracks: LocalTracks, span: Spans, owner: Int[np.ndarray, " s"], time: FloatArray, start: float
) -> FloatArray:
    """Positions at times within the lives of their tracks."""
    life = float(tracks.time.max() - start) + 1.0  # tracks one behind the other on one axis
    after = np.searchsorted(tracks.track * life + (tracks.time - start), owner * life + (time - start))
    after = np.clip(after, span.first[owner], span.stop[owner] - 1)
    before = np.maximum(after - 1, span.first[owner])
    gap = tracks.time[after] - tracks.time[before]
    share = np.where(gap > 0, (time - tracks.time[before]) / np.where(gap > 0, gap, 1.0), 1.0)
    return np.asarray(tracks.z[before] + share[:, None] * (tracks.z[after] - tracks.z[before]))
