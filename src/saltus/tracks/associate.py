"""Which plot belongs to which track: coarse gates by a tree, then an assignment."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.identify.assignment import best_assignment

__all__ = ["Pairs", "assign", "equal_codes", "join_pairs", "near_pairs", "nearest_pairs"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]
_Mask = npt.NDArray[np.bool_]


_AT_ONCE = 4096  # pairs up to which all distances cost less than a tree


class Pairs(NamedTuple):
    """Candidate pairs: positions in the lists of tracks and plots they were made from."""

    track: _Index  # (P,)
    plot: _Index  # (P,)


def near_pairs(tracks: _Array, reach: _Array, plots: _Array, most: int | None = None) -> Pairs:
    """Return all pairs with |track - plot| <= reach of the track, or the nearest `most` of a track that has more.

    Args:
        tracks: plane positions, (K, 2), m.
        reach: radius about each, (K,), m.
        plots: plane positions, (N, 2), m.
        most: pairs of one track; None: no bound.
    """
    if len(tracks) * len(plots) <= _AT_ONCE:  # a tree costs more than all distances
        apart = np.hypot(tracks[:, None, 0] - plots[:, 0], tracks[:, None, 1] - plots[:, 1])
        return Pairs(*np.nonzero(apart <= reach[:, None]))
    from scipy.spatial import cKDTree

    tree = cKDTree(plots)
    counts = np.asarray(tree.query_ball_point(tracks, reach, return_length=True), np.intp)
    crowded = np.zeros(len(tracks), bool) if most is None else counts > most
    found = tree.query_ball_point(tracks[~crowded], reach[~crowded])
    near = np.concatenate([np.zeros(0, np.intp), *(np.asarray(f, np.intp) for f in found)])
    pairs = Pairs(np.repeat(np.flatnonzero(~crowded), counts[~crowded]), near)
    if not crowded.any():
        return pairs
    nearest = np.asarray(tree.query(tracks[crowded], k=range(1, 1 + (most or 0)))[1], np.intp)
    return join_pairs(pairs, Pairs(np.repeat(np.flatnonzero(crowded), nearest.shape[1]), nearest.ravel()))


def nearest_pairs(pairs: Pairs, distance: _Array, most: int) -> _Mask:
    """Say which pairs are among the nearest `most` of their track; of equal distances the earlier pair is nearer.

    Args:
        pairs: candidates.
        distance: of each, (P,).
        most: pairs of one track.
    """
    order = np.lexsort((distance, pairs.track))
    track = pairs.track[order]
    first = np.searchsorted(track, track)
    keep = np.zeros(len(track), bool)
    keep[order] = np.arange(len(track)) - first < most
    return keep


def equal_codes(tracks: npt.NDArray[np.integer], plots: npt.NDArray[np.integer]) -> Pairs:
    """Return all pairs of equal codes; negative codes are unknown and equal nothing."""
    order = np.argsort(plots, kind="stable")
    sorted_plots = plots[order]
    first = np.searchsorted(sorted_plots, tracks, side="left")
    counts = np.where(tracks >= 0, np.searchsorted(sorted_plots, tracks, side="right") - first, 0)
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return Pairs(np.repeat(np.arange(len(tracks)), counts), order[np.repeat(first, counts) + within])


def join_pairs(a: Pairs, b: Pairs) -> Pairs:
    """Return the pairs of both, each once."""
    track, plot = np.concatenate([a.track, b.track]), np.concatenate([a.plot, b.plot])
    width = 1 + int(plot.max(initial=0))
    return Pairs(*np.divmod(np.unique(track * width + plot), width))


def assign(pairs: Pairs, gain: _Array) -> _Index:
    """Return the indices of the pairs chosen: each track and each plot at most once, total gain greatest.

    Args:
        pairs: candidates.
        gain: log-likelihood ratio of each pair against leaving both alone, (P,), nats.
    """
    return best_assignment(pairs.track, pairs.plot, gain)
