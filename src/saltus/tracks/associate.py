"""Which plot belongs to which track: coarse gates by a tree, then an assignment within each cluster."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

__all__ = ["Pairs", "assign", "equal_codes", "join_pairs", "near_pairs"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]


_AT_ONCE = 4096  # elements of a matrix up to which its clusters are not told apart


class Pairs(NamedTuple):
    """Candidate pairs: positions in the lists of tracks and plots they were made from."""

    track: _Index  # (P,)
    plot: _Index  # (P,)


def near_pairs(tracks: _Array, reach: _Array, plots: _Array) -> Pairs:
    """Return all pairs with |track - plot| <= reach of the track.

    Args:
        tracks: plane positions, (K, 2), m.
        reach: radius about each, (K,), m.
        plots: plane positions, (N, 2), m.
    """
    from scipy.spatial import cKDTree

    if not len(tracks) or not len(plots):
        empty = np.zeros(0, np.intp)
        return Pairs(empty, empty)
    found = cKDTree(plots).query_ball_point(tracks, reach)
    counts = np.array([len(f) for f in found])
    return Pairs(np.repeat(np.arange(len(tracks)), counts), np.concatenate([np.asarray(f, np.intp) for f in found]))


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
    both = np.unique(np.stack([np.concatenate([a.track, b.track]), np.concatenate([a.plot, b.plot])]), axis=1)
    return Pairs(both[0], both[1])


def assign(pairs: Pairs, gain: _Array) -> _Index:
    """Return the indices of the pairs chosen: each track and each plot at most once, total gain greatest.

    Pairs of gain <= 0 are never chosen. Pairs that compete with no other are taken at once; the rest is solved
    cluster by cluster (connected components of the gates).

    Args:
        pairs: candidates.
        gain: log-likelihood ratio of each pair against leaving both alone, (P,), nats.
    """
    good = np.flatnonzero(gain > 0.0)
    track, plot = pairs.track[good], pairs.plot[good]
    alone = (np.bincount(track)[track] == 1) & (np.bincount(plot)[plot] == 1) if len(good) else np.zeros(0, bool)
    chosen = [good[alone]]
    contested = good[~alone]
    if len(contested):
        chosen.extend(_solve(pairs, gain, contested))
    return np.concatenate(chosen)


def _solve(pairs: Pairs, gain: _Array, contested: _Index) -> list[_Index]:
    tracks, track_idx = np.unique(pairs.track[contested], return_inverse=True)
    plots, plot_idx = np.unique(pairs.plot[contested], return_inverse=True)
    if len(tracks) * len(plots) <= _AT_ONCE:  # clusters are blocks of one matrix, and its optimum theirs
        return [_best(track_idx, plot_idx, gain, contested)]
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    size = len(tracks) + len(plots)
    links = coo_array((np.ones(len(contested)), (track_idx, len(tracks) + plot_idx)), shape=(size, size))
    _, label = connected_components(links, directed=False)
    order = np.argsort(label[track_idx], kind="stable")
    clusters = np.split(order, np.flatnonzero(np.diff(label[track_idx][order])) + 1)
    return [_best(track_idx[c], plot_idx[c], gain, contested[c]) for c in clusters]


def _best(track: _Index, plot: _Index, gain: _Array, pairs: _Index) -> _Index:
    """Return the pairs of greatest total gain, as a rectangular assignment in which 0 leaves both alone."""
    from scipy.optimize import linear_sum_assignment

    rows, row = np.unique(track, return_inverse=True)
    cols, col = np.unique(plot, return_inverse=True)
    matrix = np.zeros((len(rows), len(cols)))
    which = np.full(matrix.shape, -1)
    matrix[row, col], which[row, col] = gain[pairs], pairs
    r, c = linear_sum_assignment(matrix, maximize=True)
    picked = which[r, c]
    return picked[picked >= 0]
