"""The likelihood ratio of "one object" against "two objects" for many pairs of local tracks, multimode.

All filters are lanes of the batch kernel: one own filter for each local track, shared by its pairs, and one joint
filter for each pair, which starts from the own belief of the track that was there first.

Source: Chervakov, Bogdanov and Zhironkin (2016), section on two systems, with a multimode filter for each hypothesis.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError
from saltus.identify.candidates import candidate_pairs
from saltus.identify.lanes import (
    Index,
    Lanes,
    Start,
    batches,
    flatten,
    joint_log_likelihood,
    own_filters,
    region_start,
)
from saltus.identify.local import LocalTracks, PairSettings, Spans, spans
from saltus.models.checks import FloatArray
from saltus.shapes import Float, Int

__all__ = ["LocalTracks", "PairSettings", "Ratios", "candidate_pairs", "pair_ratios", "ratios_under"]


@dataclass(frozen=True, slots=True)
class Ratios:
    """The cumulative ratio of every pair after each row of both, NaN behind a pair's last row."""

    time: Float[np.ndarray, "p k"]  # s
    llr: Float[np.ndarray, "p k"]  # log f(rows so far | one object) - log f(rows so far | two), nats
    count: Int[np.ndarray, " p"]  # rows


class _Rows(NamedTuple):
    """The rows of each pair between the time its later track begins and the time its first one ends."""

    first: tuple[Index, Index]  # of a and of b, (P,)
    length: tuple[Index, Index]
    earlier: tuple[Index, Index]  # row before them, -1 where the track has none: at most one of both is not


class _Own(NamedTuple):
    """What own filters said of every row of a system (N rows), and the beliefs that pairs start from."""

    log_likelihood: FloatArray  # (N,)
    velocity: FloatArray  # (N, 2), 0 where no clocks differ
    spread: FloatArray  # (N, 2, 2)
    start: Start  # (P, ...)


def pair_ratios(
    a: LocalTracks,
    b: LocalTracks,
    pairs: npt.ArrayLike,
    settings: PairSettings,
    *,
    log_prior_identity: npt.ArrayLike | None = None,
) -> Ratios:
    """Return the cumulative log-likelihood ratio of every pair from the time both of its tracks live.

    llr_k = sum over the rows so far of log f_joint(row) - log f_own(row)

    Both hypotheses begin with an object somewhere in the region, at the first measurement of its track. Before the
    later track begins the ratio is 0, because one object or two explain one track alike; it ends when one of the
    tracks does. Under "one object" the later track carries the offset and the difference of clocks. A value uses no
    later row.

    Args:
        a: tracks of one system.
        b: tracks of the other; or a once more, for splits of one object.
        pairs: indices of tracks in a and b, (P, 2).
        settings: objects and offset.
        log_prior_identity: log-ratio that other evidence gives, such as addresses, (P,), nats; added to every row.

    Raises:
        DataError: local tracks that are none, or pairs that name no track.
        NumericalError: a measurement without noise.
    """
    (found,) = ratios_under(a, b, pairs, [settings])
    if log_prior_identity is not None:
        found.llr[:] += np.broadcast_to(np.asarray(log_prior_identity, dtype=np.float64), len(found.count))[:, None]
    return found


def ratios_under(
    a: LocalTracks, b: LocalTracks, pairs: npt.ArrayLike, settings: Sequence[PairSettings]
) -> list[Ratios]:
    """Return the ratios of `pair_ratios` under several offsets of the same objects: what these do alone is one work.

    Args:
        a: tracks of one system.
        b: of the other, or a.
        pairs: (P, 2).
        settings: which differ in `offset_cov` and `offset_time` alone.
    """
    spans_a, spans_b = spans(a, "a"), spans(b, "b")
    chosen = _pairs(pairs, len(spans_a.first), len(spans_b.first))
    rows = _common(a, b, spans_a, spans_b, chosen)
    own_a, own_b = (
        _own(tracks, span, settings[0], earlier)
        for tracks, span, earlier in ((a, spans_a, rows.earlier[0]), (b, spans_b, rows.earlier[1]))
    )
    both = LocalTracks(*(np.concatenate(part) for part in zip(a, b, strict=True)))
    alone, velocity, spread = (np.concatenate(part) for part in zip(own_a[:3], own_b[:3], strict=True))
    return [_under(a, both, rows, (own_a, own_b), alone, velocity, spread, offset) for offset in settings]


def _under(
    a: LocalTracks,
    both: LocalTracks,
    rows: _Rows,
    own: tuple[_Own, _Own],
    alone: FloatArray,
    velocity: FloatArray,
    spread: FloatArray,
    settings: PairSettings,
) -> Ratios:
    count = rows.length[0] + rows.length[1]
    time, llr = np.full((2, len(count), int(count.max(initial=0))), np.nan)
    for lanes in batches(count, 4 + len(settings.differences()), _modes(settings)):
        at, row, late = _merged(both, rows, lanes, len(a.time))
        merged = _filled(count[lanes], at, both, row)
        merged = _with_differences(merged, at, late, velocity[row], spread[row], settings)
        start = _started(merged.time[:, 0], lanes, rows, (own[0].start, own[1].start), settings)
        step = joint_log_likelihood(merged, start, settings)
        step[at] -= alone[row]
        place = (lanes[at[0]], at[1])
        time[place], llr[place] = both.time[row], np.cumsum(step, axis=1)[at]
    return Ratios(time, llr, count)


def _pairs(pairs: npt.ArrayLike, n_a: int, n_b: int) -> Index:
    chosen = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
    if ((chosen < 0) | (chosen >= [n_a, n_b])).any():
        wrong = chosen[((chosen < 0) | (chosen >= [n_a, n_b])).any(-1)][0]
        raise DataError(f"pair {tuple(wrong.tolist())} names no tracks: a has {n_a}, b has {n_b}.")
    return chosen


def _common(a: LocalTracks, b: LocalTracks, spans_a: Spans, spans_b: Spans, pairs: Index) -> _Rows:
    i, j = pairs.T
    begin, end = np.maximum(spans_a.begin[i], spans_b.begin[j]), np.minimum(spans_a.end[i], spans_b.end[j])
    never = ~(begin <= end)
    low, count, earlier = [], [], []
    for tracks, span, which in ((a, spans_a, i), (b, spans_b, j)):
        lo, hi = _find(tracks, which, begin, "left"), _find(tracks, which, end, "right")
        low.append(lo)
        count.append(np.where(never, 0, hi - lo))
        earlier.append(np.where(never | (lo <= span.first[which]), -1, lo - 1))
    return _Rows((low[0], low[1]), (count[0], count[1]), (earlier[0], earlier[1]))


def _find(tracks: LocalTracks, which: Index, time: FloatArray, side: str) -> Index:
    """Search each time among the rows of its track: tracks lie one behind the other on one axis."""
    if not len(tracks.time):
        return np.zeros(len(which), np.int64)
    start = tracks.time.min()
    life = float(tracks.time.max() - start) + 2.0
    at = which * life + np.clip(time - start, -1.0, life - 1.0)
    axis = tracks.track * life + (tracks.time - start)
    return np.asarray(np.searchsorted(axis, at, side="left" if side == "left" else "right"))


def _modes(settings: PairSettings) -> int:
    return len(settings.accel) * (2 if settings.outlier_probability > 0 else 1)


def _own(tracks: LocalTracks, span: Spans, settings: PairSettings, wanted: Index) -> _Own:
    """Filter every track by itself; beliefs are those after the wanted rows (P,), -1 for none."""
    length, n, modes = span.stop - span.first, len(tracks.time), len(settings.accel)
    start = Start(np.zeros(len(wanted)), *(np.zeros((len(wanted), modes, *shape)) for shape in ((), (4,), (4, 4))))
    out = _Own(np.zeros(n), np.zeros((n, 2)), np.zeros((n, 2, 2)), start)
    asked = np.flatnonzero(wanted >= 0)
    track = tracks.track[wanted[asked]]
    start.time[asked] = tracks.time[wanted[asked]]
    for lanes in batches(length, 4, _modes(settings)):
        lane, row = flatten(span.first[lanes], length[lanes])
        at = (lane, row - span.first[lanes][lane])
        where = np.full(len(length), -1)
        where[lanes] = np.arange(len(lanes))
        mine = asked[where[track] >= 0]
        of = tracks.track[wanted[mine]]
        after = (where[of], wanted[mine] - span.first[of])
        found = own_filters(_filled(length[lanes], at, tracks, row), settings, after)
        for store, values in zip(out[:3], found[:3], strict=True):
            store[row] = values[at]
        for store, values in zip(start[1:], found.beliefs, strict=True):
            store[mine] = values
    return out


def _merged(
    both: LocalTracks, rows: _Rows, lanes: Index, n_a: int
) -> tuple[tuple[Index, Index], Index, npt.NDArray[np.bool_]]:
    """Places (lane, row) of all rows of some pairs in order of time, their rows in `both`, and who carries the offset.

    The later track carries it: the one of b where both begin together.
    """
    lane_a, row_a = flatten(rows.first[0][lanes], rows.length[0][lanes])
    lane_b, row_b = flatten(rows.first[1][lanes], rows.length[1][lanes])
    lane, row = np.concatenate([lane_a, lane_b]), np.concatenate([row_a, row_b + n_a])
    order = np.lexsort((both.time[row], lane))  # stable: a before b at equal times
    lane, row = lane[order], row[order]
    length = rows.length[0][lanes] + rows.length[1][lanes]
    at = (lane, np.arange(len(lane)) - np.repeat(np.cumsum(length) - length, length))
    a_is_later = rows.earlier[1][lanes] >= 0
    return at, row, (row < n_a) == a_is_later[lane]


def _filled(length: Index, at: tuple[Index, Index], tracks: LocalTracks, row: Index) -> Lanes:
    """Put rows in their places and fill up: NaN at the last time, an interval of 0 with a covariance of 1."""
    shape = (len(length), int(length.max()))
    out = Lanes(
        np.full(shape, -np.inf),
        np.full((*shape, 2), np.nan),
        np.broadcast_to(np.eye(2), (*shape, 2, 2)).copy(),
        np.zeros((*shape, 2, 0)),
    )
    out.time[at], out.z[at], out.R[at] = tracks.time[row], tracks.z[row], tracks.R[row]
    return out._replace(time=np.maximum.accumulate(out.time, axis=1))


def _with_differences(
    lanes: Lanes,
    at: tuple[Index, Index],
    late: npt.NDArray[np.bool_],
    velocity: FloatArray,
    spread: FloatArray,
    settings: PairSettings,
) -> Lanes:
    """Let late rows differ by an offset, and by a clock times their velocity; what that is uncertain by is noise."""
    parts = []
    if np.any(settings.offset_cov):
        parts.append(late[:, None, None] * np.eye(2))
    if settings.time_sigma > 0:
        parts.append(late[:, None, None] * velocity[:, :, None])
        lanes.R[at] += settings.time_sigma**2 * late[:, None, None] * spread
    if not parts:
        return lanes
    differs = np.zeros((*lanes.time.shape, 2, len(settings.differences())))
    differs[at] = np.concatenate(parts, axis=-1)
    return lanes._replace(differs=differs)


def _started(begin: FloatArray, lanes: Index, rows: _Rows, own: tuple[Start, Start], settings: PairSettings) -> Start:
    """Beliefs before the common rows: of the own filter that has rows before them, else the region."""
    start = Start(*(np.array(part) for part in region_start(settings, begin)))
    for belief, earlier in zip(own, rows.earlier, strict=True):
        known = earlier[lanes] >= 0
        for store, values in zip(start, belief, strict=True):
            store[known] = values[lanes[known]]
    return start
