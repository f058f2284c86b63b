"""What speaks for "one object" at each time: the ratio since a pair began, or that of a window that moves on.

A ratio that only accumulates never forgets: after an hour as two objects, a pair needs as much evidence to become one,
and a track that the local tracker handed over to another object needs it too. A window of length W answers anew what
the last rows alone say: at time t it is the ratio of the rows since the last multiple of W/2 that lies at least W/2
before t, hence of the last W/2 to W seconds, with objects that were somewhere in the region before.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from saltus.errors import DataError, ModelError
from saltus.identify.lanes import Index, flatten
from saltus.identify.local import LocalTracks, PairSettings, spans
from saltus.identify.pairs import Ratios, candidate_pairs, pair_ratios, ratios_under
from saltus.models.checks import FloatArray
from saltus.shapes import Float, Int

__all__ = [
    "APART",
    "Evidence",
    "as_evidence",
    "join_evidence",
    "latest_ratios",
    "pair_evidence",
    "window_start",
]

APART = -100.0  # nats: what a pair is worth while both tracks live out of each other's reach


class Evidence(NamedTuple):
    """Log-likelihood ratios of pairs as they became known."""

    pairs: Int[np.ndarray, "p 2"]  # tracks of each pair
    pair: Int[np.ndarray, " n"]  # row of `pairs`
    time: Float[np.ndarray, " n"]  # s, not decreasing within a pair
    llr: Float[np.ndarray, " n"]  # nats, of the rows that count at that time


def window_start(now: float, window: float) -> float:
    """Return since when rows count at a time: the last multiple of W/2 that lies at least W/2 before it, s."""
    return float((np.floor(now / (0.5 * window)) - 1.0) * 0.5 * window)


def latest_ratios(
    a: LocalTracks, b: LocalTracks, settings: Sequence[PairSettings], weights: Sequence[float], *, reach: float
) -> tuple[Int[np.ndarray, "p 2"], Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Return what the rows given say of every pair within reach: a mixture of ratios, as of the pair's last row.

    Args:
        a: rows of one system's tracks in a window.
        b: of the other's; a itself for splits.
        settings: objects and offsets, of each component.
        weights: probability of each component.
        reach: m, see `candidate_pairs`.

    Returns:
        Pairs (P, 2), times of their last rows (P,), s, and ratios (P,), nats.
    """
    pairs = candidate_pairs(a, b, settings[0], reach=reach)
    if a is b:
        pairs = pairs[pairs[:, 0] < pairs[:, 1]]
    total, time = np.full(len(pairs), -np.inf), np.full(len(pairs), -np.inf)
    last = np.zeros(len(pairs), np.int64)
    for ratios, weight in zip(ratios_under(a, b, pairs, settings), weights, strict=True):
        last = ratios.count - 1
        if not (len(pairs) and last.max() >= 0):
            return pairs[:0], time[:0], total[:0]
        total = np.logaddexp(total, ratios.llr[np.arange(len(pairs)), last] + np.log(weight))
        time = ratios.time[np.arange(len(pairs)), last]
    some = last >= 0
    return pairs[some], time[some], total[some]


class _Pieces(NamedTuple):
    tracks: LocalTracks  # each piece a track
    owner: Index  # track that each piece is of
    window: Index  # number of its window
    middle: FloatArray  # s: where the second half of its window begins


def as_evidence(ratios: Ratios, pairs: Int[np.ndarray, "p 2"]) -> Evidence:
    """Return cumulative ratios as evidence: everything since a pair began counts alike.

    Raises:
        DataError: not one ratio for each pair.
    """
    if np.shape(pairs) != (len(ratios.count), 2):
        raise DataError(f"pairs has shape {np.shape(pairs)}; there are ratios of {len(ratios.count)} pairs, (P, 2).")
    known = ~np.isnan(ratios.time)
    return Evidence(np.asarray(pairs), np.nonzero(known)[0], ratios.time[known], ratios.llr[known])


def join_evidence(parts: Sequence[tuple[Evidence, int, int]]) -> Evidence:
    """Put evidence of several pairs of systems together, with tracks numbered through all systems.

    Args:
        parts: evidence, and what is added to the numbers of its first and second tracks.
    """
    before = np.cumsum([0, *(len(e.pairs) for e, _, _ in parts)])
    columns = [
        (e.pairs + np.array([first, second]), e.pair + at, e.time, e.llr)
        for (e, first, second), at in zip(parts, before[:-1], strict=True)
    ]
    none = (np.zeros((0, 2), np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    return Evidence(*(np.concatenate(column) for column in zip(none, *columns, strict=True)))


def pair_evidence(
    a: LocalTracks, b: LocalTracks, settings: PairSettings, *, reach: float, window: float = np.inf
) -> Evidence:
    """Return the evidence on every pair of tracks that came within reach of each other.

    Args:
        a: tracks of one system.
        b: tracks of the other; a itself (the same object) for tracks that are splits of one another.
        settings: objects and offset.
        reach: m, see `candidate_pairs`.
        window: W of this module, s; inf: the ratio since the pair began. In a window in which both tracks live and
            stay out of reach, a pair that was near in another one has `APART`.

    Raises:
        DataError: local tracks that are none.
        ModelError: reach or window is not positive.
    """
    if not window > 0:
        raise ModelError(f"window must be positive, or inf, got {window} s.")
    if np.isinf(window) or not len(a.time) or not len(b.time):
        pairs = candidate_pairs(a, b, settings, reach=reach)
        if a is b:
            pairs = pairs[pairs[:, 0] < pairs[:, 1]]
        return as_evidence(pair_ratios(a, b, pairs, settings), pairs)
    start = min(a.time.min(), b.time.min())
    found = []
    for phase in (0.0, 0.5):  # windows of either phase lie one behind the other, and count in their second halves
        pieces = [_cut(tracks, start, window, phase) for tracks in (a, b)]
        near = candidate_pairs(pieces[0].tracks, pieces[1].tracks, settings, reach=reach)
        owners = np.column_stack([p.owner[near[:, s]] for s, p in enumerate(pieces)])
        once = owners[:, 0] < owners[:, 1] if a is b else np.ones(len(owners), bool)
        found.append((pieces, near[once], owners[once]))
    pairs = np.unique(np.concatenate([owners for _, _, owners in found]), axis=0)
    width = int(pairs[:, 1].max(initial=0)) + 1
    rows = [
        row
        for (first, second), near, owners in found
        for row in (_scored(first, second, near, owners, pairs, width, settings), _apart(first, second, near, pairs))
    ]
    pair, time, llr = (np.concatenate(column) for column in zip(*rows, strict=True))
    order = np.lexsort((time, pair))
    return Evidence(pairs, pair[order], time[order], llr[order])


def _cut(tracks: LocalTracks, start: float, window: float, phase: float) -> _Pieces:
    """Make a track of every piece of a track in one window."""
    spans(tracks, "a system")
    number = np.floor((tracks.time - start) / window + phase).astype(np.int64)
    new = np.ones(len(number), bool)
    new[1:] = (np.diff(tracks.track) != 0) | (np.diff(number) != 0)
    first = np.flatnonzero(new)
    middle = np.asarray(start + (number[first] - phase + 0.5) * window, dtype=np.float64)
    return _Pieces(tracks._replace(track=np.cumsum(new) - 1), tracks.track[first], number[first], middle)


def _scored(
    a: _Pieces, b: _Pieces, near: Index, owners: Index, pairs: Index, width: int, settings: PairSettings
) -> tuple[Index, FloatArray, FloatArray]:
    """Pair, time and ratio of every row in the second half of its window."""
    ratios = pair_ratios(a.tracks, b.tracks, near, settings)
    late = ratios.time >= a.middle[near[:, 0], None]
    which = np.searchsorted(pairs[:, 0] * width + pairs[:, 1], owners[:, 0] * width + owners[:, 1])
    return which[np.nonzero(late)[0]], ratios.time[late], ratios.llr[late]


def _apart(a: _Pieces, b: _Pieces, near: Index, pairs: Index) -> tuple[Index, FloatArray, FloatArray]:
    """Pair, time and `APART` for the windows in which both tracks of a pair live out of each other's reach."""
    windows = 1 + int(max(a.window.max(), b.window.max()))
    # Pieces are sorted by owner, then window, so a piece is found by its key.
    keys = [p.owner * windows + p.window for p in (a, b)]
    first = np.searchsorted(keys[0], pairs[:, 0] * windows)
    count = np.searchsorted(keys[0], (pairs[:, 0] + 1) * windows) - first
    pair, piece_a = flatten(first, count)
    wanted = pairs[pair, 1] * windows + a.window[piece_a]
    piece_b = np.minimum(np.searchsorted(keys[1], wanted), len(keys[1]) - 1)
    size = len(keys[1])
    known = np.isin(piece_a * size + piece_b, near[:, 0] * size + near[:, 1])
    there = (keys[1][piece_b] == wanted) & ~known
    pair, piece_a, piece_b = pair[there], piece_a[there], piece_b[there]
    span_a, span_b = (spans(p.tracks, "a window") for p in (a, b))
    begin = np.maximum(np.maximum(span_a.begin[piece_a], span_b.begin[piece_b]), a.middle[piece_a])
    both = begin <= np.minimum(span_a.end[piece_a], span_b.end[piece_b])
    return pair[both], begin[both], np.full(int(both.sum()), APART)
