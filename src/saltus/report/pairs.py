"""Probability over time that two local tracks are one object: thinned series, and the pairs worth a look."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.identify import posterior
from saltus.report.colours import system_colours
from saltus.report.columns import encode, quantise
from saltus.report.systems import Named, SystemsFound, named

__all__ = [
    "MAX_PAIRS",
    "MAX_POINTS",
    "PairRow",
    "Series",
    "pair_payload",
    "pair_rows",
    "probable_pairs",
    "thinned_series",
    "undecided",
]

MAX_PAIRS = 1000  # whose series the page holds
MAX_POINTS = 200  # of each
MAX_TOTAL = 60_000
MAX_ROWS = 24
WIDTH, HEIGHT = 240.0, 26.0  # of a small picture, in its units
_FINEST = 0.01  # change of probability that is drawn
_SURE = 0.01  # from 0 or 1: nearer is decided
_STEP = 0.004  # of a probability on the page

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]


class Series(NamedTuple):
    """The probability that a pair is one object, by its own evidence; each value holds until the next time."""

    pair: int  # row of the evidence's pairs
    time: _Array
    p: _Array  # NaN where nothing is known


class PairRow(NamedTuple):
    """A pair in the page's list."""

    a: Named
    b: Named
    tracks: tuple[int, ...]  # the system tracks in common, or those of both
    together: float  # s declared one object
    probability: float  # mean while declared, NaN never
    undecided: float  # s
    path: str


class _Evidence(NamedTuple):
    """Evidence by pair and time, as probabilities."""

    pair: _Index
    time: _Array
    p: _Array
    lasts: _Array  # s that each holds


def _ordered(found: SystemsFound) -> _Evidence:
    e, rule = found.evidence, found.rule
    order = np.argsort(e.pair, kind="stable")
    pair, time = e.pair[order], e.time[order]
    lasts = np.zeros(len(time))
    lasts[:-1] = np.where(np.diff(pair) == 0, np.minimum(np.diff(time), rule.hold), 0.0)
    return _Evidence(pair, time, posterior(e.llr[order], rule.prior), lasts)


def undecided(found: SystemsFound) -> _Array:
    """Return for how long each pair was neither one object nor two with 99 %, s."""
    e = _ordered(found)
    open_ = (e.p > _SURE) & (e.p < 1.0 - _SURE)
    return np.bincount(e.pair, np.where(open_, e.lasts, 0.0), minlength=len(found.evidence.pairs)).astype(np.float64)


def thinned_series(found: SystemsFound) -> list[Series]:
    """Return the series of the pairs declared, of those in conflict and of those once probable, in this order.

    A value is left out while it differs from the last one kept by no more than a bound, 0.01 or what is needed to get
    by with `MAX_POINTS`; silences and the last row are kept always.
    """
    e = _ordered(found)
    edge = np.searchsorted(e.pair, np.arange(len(found.evidence.pairs) + 1))
    out, room = [], MAX_TOTAL
    for k in _carried(found, e)[:MAX_PAIRS].tolist():
        rows = slice(edge[k], edge[k + 1])
        if rows.start == rows.stop:
            continue
        series = Series(k, *_thinned(e.time[rows], e.p[rows], found.rule.hold))
        room -= len(series.time)
        if room < 0:
            break
        out.append(series)
    return out


def probable_pairs(found: SystemsFound) -> int:
    """Return how many pairs were declared, in conflict or once probable."""
    return len(_carried(found, _ordered(found)))


def _carried(found: SystemsFound, e: _Evidence) -> _Index:
    """Rank the pairs whose series the page should hold."""
    pairs = found.evidence.pairs
    rank = np.zeros(len(pairs))
    np.maximum.at(rank, e.pair, np.where(e.p >= 0.5, e.p, 0.0))
    number = {(a, b): k for k, (a, b) in enumerate(pairs.tolist())}
    for c in found.decisions.conflicts:
        rank[number[c.a, c.b]] = 2.0
    episodes = found.decisions.episodes
    for a, b in zip(episodes.a.tolist(), episodes.b.tolist(), strict=True):
        rank[number[a, b]] = 3.0
    order = np.argsort(-rank, kind="stable")
    return order[rank[order] > 0]


def _thinned(time: _Array, p: _Array, hold: float) -> tuple[_Array, _Array]:
    silent = np.flatnonzero(np.diff(time) > hold)
    t, v = np.insert(time, silent + 1, time[silent] + hold), np.insert(p, silent + 1, np.nan)
    bound = _FINEST
    keep = _changes(v, bound)
    while len(keep) > MAX_POINTS and bound < 1.0:
        bound *= 2.0
        keep = _changes(v, bound)
    if keep[-1] < len(v) - 1:
        keep = np.append(keep, len(v) - 1)
    return t[keep], v[keep]


def _changes(v: _Array, bound: float) -> _Index:
    """Return the rows that differ from the last one returned by more than the bound; NaN differs from all else."""
    keep, last = [0], v[0]
    for i, x in enumerate(v.tolist()):
        if abs(x - last) > bound or (x != x) != (last != last):
            keep.append(i)
            last = x
    return np.array(keep)


def pair_payload(found: SystemsFound, series: list[Series], index: dict[int, int], t0: float) -> dict[str, object]:
    """Return what the page's script reads of systems: whose local tracks made each track, and the series of pairs.

    Args:
        found: who is whom.
        series: of pairs.
        index: place of each system track in the page's list.
        t0: time that counts as 0, s.
    """
    s, pairs = found.segments, found.evidence.pairs
    known = np.array([k for k, track in enumerate(s.system_track.tolist()) if track in index], np.int64)
    ends = pairs[[x.pair for x in series]] if series else np.zeros((0, 2), np.int64)
    join = np.concatenate if series else (lambda _: np.zeros(0))
    return {
        "names": list(found.titles),
        "colours": system_colours(len(found.names)),
        "local": [list(named(found, k)) for k in range(len(found.system))],
        "members": {
            "track": encode([index[t] for t in s.system_track[known].tolist()], "i4"),
            "local": encode(s.track[known], "i4"),
            "from": encode(s.time_from[known] - t0, "f4"),
            "to": encode(s.time_to[known] - t0, "f4"),
            "p": quantise(s.probability[known], _STEP, "u1"),
        },
        "pairs": {
            "a": encode(ends[:, 0], "i4"),
            "b": encode(ends[:, 1], "i4"),
            "first": encode(np.cumsum([0, *(len(x.time) for x in series)]), "i4"),
            "t": encode(join([x.time for x in series]) - t0, "f4"),
            "p": quantise(join([x.p for x in series]), _STEP, "u1"),
        },
    }


def pair_rows(found: SystemsFound, series: list[Series], span: tuple[float, float]) -> list[PairRow]:
    """Return some pairs that the page holds, those undecided longest first, then the least probable ones."""
    open_ = undecided(found)
    lowest = {x.pair: float(np.nanmin(x.p)) for x in series}
    first = sorted(series, key=lambda x: (-open_[x.pair], lowest[x.pair]))[:MAX_ROWS]
    return [_row(found, x, float(open_[x.pair]), span) for x in first]


def _row(found: SystemsFound, series: Series, open_: float, span: tuple[float, float]) -> PairRow:
    a, b = found.evidence.pairs[series.pair].tolist()
    s, e = found.segments, found.decisions.episodes
    mine, its = (set(s.system_track[s.track == k].tolist()) for k in (a, b))
    declared = (e.a == a) & (e.b == b)
    lasted = e.time_to[declared] - e.time_from[declared]
    together = float(lasted.sum())
    weight = lasted if together > 0 else np.ones(len(lasted))
    probability = float(np.average(e.probability[declared], weights=weight)) if declared.any() else np.nan
    tracks = tuple(sorted(mine & its or mine | its))
    return PairRow(named(found, a), named(found, b), tracks, together, probability, open_, step_path(series, span))


def step_path(series: Series, span: tuple[float, float]) -> str:
    """Draw a series as steps over the span of the page, broken where nothing is known."""
    x = WIDTH * (series.time - span[0]) / max(span[1] - span[0], 1e-9)
    y = HEIGHT * (1.0 - series.p)
    out, on = [], False
    for h, v in zip(x.tolist(), y.tolist(), strict=True):
        if v != v:
            out += [f"H{h:.1f}"] if on else []
            on = False
        else:
            out.append(f"H{h:.1f}V{v:.1f}" if on else f"M{h:.1f} {v:.1f}")
            on = True
    return "".join(out)
