"""How well tracks follow targets whose true places are known, epoch by epoch.

At every epoch of the truth (each distinct time of any target) a target's place is interpolated linearly between its
fixes, and a track's between the two rows around the epoch. With w the share of the interval gone,

    x = (1 - w) x_0 + w x_1,   P = (1 - w) P_0 + w P_1,

which bounds the covariance of the interpolated estimate however the errors of the two rows are correlated (the square
is convex), and is the row's own at the row's time. A track exists from its first row to its last. Distances are
horizontal, in metres east and north at the target.

Targets and tracks are matched as in CLEAR MOT: a target keeps its track while the two are within the cut-off, the
rest is matched at the least sum of squares; another track than the target's last is an identity switch.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError
from saltus.geo import ecef_to_geodetic, local_basis
from saltus.metrics.estimation import nees
from saltus.metrics.sets import gospa

__all__ = ["Targets", "Tracks", "each_time_once", "target_scores"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]

_LONGEST_GAP = 10.0  # s: between two fixes further apart a target's place is unknown
_CHI2_95 = 5.991  # of two degrees of freedom


class Targets(NamedTuple):
    """True places: one row per fix, sorted by target and time."""

    names: tuple[str, ...]
    target: _Index  # (N,) index into names
    time: _Array  # (N,) s
    place: _Array  # (N, 3) earth-centred, m, at height 0


class Tracks(NamedTuple):
    """Rows of tracks, sorted by track and time, each time once."""

    id: npt.NDArray[np.int64]  # (N,)
    time: _Array  # (N,) s
    place: _Array  # (N, 3) earth-centred, m, at height 0
    cov: _Array  # (N, 2, 2) m^2, true east and north


class _States(NamedTuple):
    """Objects at epochs, sorted by epoch: which epoch, which object, where."""

    epoch: _Index
    label: _Index
    place: _Array
    cov: _Array


class _Matches(NamedTuple):
    """One row per target and epoch at which it is there; track -1 where none follows it."""

    epoch: _Index
    target: _Index
    track: npt.NDArray[np.int64]
    error: _Array  # (N, 2) east, north, estimate minus truth, m; NaN where missed
    nees: _Array  # (N,) NaN where missed
    cost: _Array  # (N,) the target's part of GOSPA squared, m^2


def target_scores(tracks: Tracks, truth: Targets, *, cutoff: float) -> dict[str, object]:
    """Compare tracks with the truth at all its epochs.

    Over all targets, and for each under "targets": `rmse_m` of the horizontal position where a track follows the
    target, `rmse_missing<cutoff>_m` with a missing track counted as the cut-off, `bias_east_m` and `bias_north_m`
    (mean of estimate minus truth), `nees` (mean, 2 for honest covariances), `nees_inside_95` (share below the 0.95
    quantile), `gospa_m` (mean over the epochs, order 2; for one target its own part, without false tracks),
    `completeness` (share of its epochs at which a track follows it), `id_switches`, `tracks` (different tracks that
    followed it), `longest_gap_s` without one. Over all also the mean squared parts of GOSPA and of false tracks.

    Args:
        tracks: rows of tracks.
        truth: fixes of targets.
        cutoff: m: no track follows a target from further away; also GOSPA's.

    Raises:
        DataError: the truth has no epoch at which a target is known.

    Source: Bernardin, Stiefelhagen (2008), the matching of CLEAR MOT; `saltus.metrics.gospa`, `saltus.metrics.nees`.
    """
    epochs = np.unique(truth.time)
    fixes = _interpolated(
        truth.target, truth.time, truth.place, np.zeros((len(truth.time), 2, 2)), epochs, _LONGEST_GAP
    )
    names, label = np.unique(tracks.id, return_inverse=True)
    states = _interpolated(label, tracks.time, tracks.place, tracks.cov, epochs, np.inf)
    matches, parts = _match(fixes, states, names, epochs, cutoff)
    overall: dict[str, object] = {"cutoff_m": cutoff, "epochs": len(epochs), **_figures(matches, epochs, cutoff)}
    overall["gospa_m"] = _mean(parts[:, 0])
    overall["gospa_parts_m2"] = {
        name: _mean(parts[:, k]) for k, name in enumerate(("localisation", "missed", "false"), start=1)
    }
    overall["false_tracks"] = _mean(parts[:, 4])
    per_target: dict[str, object] = {}
    for k, name in enumerate(truth.names):
        own = _Matches(*(column[matches.target == k] for column in matches))
        per_target[name] = {**_figures(own, epochs, cutoff), "gospa_m": _mean(np.sqrt(own.cost))}
    return {**overall, "targets": per_target}


def _interpolated(
    label: npt.NDArray[np.integer], time: _Array, place: _Array, cov: _Array, epochs: _Array, longest: float
) -> _States:
    """Objects at the epochs between their first and last rows, where the rows around are near enough in time."""
    found = [_States(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros((0, 3)), np.zeros((0, 2, 2)))]
    ends = np.append(np.searchsorted(label, np.unique(label)), len(label))
    for a, b in pairwise(ends):
        first, last = np.searchsorted(epochs, time[a]), np.searchsorted(epochs, time[b - 1], side="right")
        epoch = np.arange(first, last)
        after = np.clip(np.searchsorted(time[a:b], epochs[epoch]), 0, b - a - 1) + a
        before = np.maximum(after - 1, a)
        gap = time[after] - time[before]
        w = np.where(gap > 0, (epochs[epoch] - time[before]) / np.where(gap > 0, gap, 1.0), 1.0)
        near = (gap <= longest) | (w == 1.0)
        w, before, after, epoch = w[near], before[near], after[near], epoch[near]
        x = (1.0 - w)[:, None] * place[before] + w[:, None] * place[after]
        P = (1.0 - w)[:, None, None] * cov[before] + w[:, None, None] * cov[after]
        found.append(_States(epoch, np.full(len(epoch), label[a], np.intp), x, P))
    joined = _States(*(np.concatenate(column) for column in zip(*found, strict=True)))
    order = np.argsort(joined.epoch, kind="stable")
    return _States(joined.epoch[order], joined.label[order], joined.place[order], joined.cov[order])


def _match(
    fixes: _States, states: _States, ids: npt.NDArray[np.int64], epochs: _Array, cutoff: float
) -> tuple[_Matches, _Array]:
    """Match targets and tracks epoch by epoch; return also GOSPA and its parts, (epochs, 5)."""
    if not len(fixes.epoch):
        raise DataError("the truth has no epoch at which a target is known: fixes too far apart?")
    n = len(fixes.epoch)
    partner, cost = np.full(n, -1, np.intp), np.full(n, 0.5 * cutoff**2)
    parts, last = [], np.full(int(fixes.label.max()) + 1, -1, np.intp)
    fix_ends, state_ends = (np.searchsorted(s.epoch, np.arange(len(epochs) + 1)) for s in (fixes, states))
    basis = local_basis(*_latitude_longitude(fixes.place))[:, :2]  # rows east, north
    for k in range(len(epochs)):
        i, j = np.arange(fix_ends[k], fix_ends[k + 1]), np.arange(state_ends[k], state_ends[k + 1])
        if not len(i):
            continue
        # One basis for the epoch: only distances matter here.
        flat = basis[i[0]]
        here, there = (fixes.place[i] - fixes.place[i[0]]) @ flat.T, (states.place[j] - fixes.place[i[0]]) @ flat.T
        found = gospa(here, there, cutoff=cutoff)
        parts.append((found.distance, found.localisation, found.missed, found.false, found.n_false))
        d = np.linalg.norm(here[:, None] - there[None], axis=-1)
        cost[i[found.pairs[:, 0]]] = d[found.pairs[:, 0], found.pairs[:, 1]] ** 2
        for row, column in _follow(d, last[fixes.label[i]], states.label[j], cutoff):
            partner[i[row]] = j[column]
            last[fixes.label[i[row]]] = states.label[j[column]]
    seen = partner >= 0
    error, ratio, track = np.full((n, 2), np.nan), np.full(n, np.nan), np.full(n, -1, np.int64)
    offset = states.place[partner[seen]] - fixes.place[seen]
    error[seen] = (basis[seen] @ offset[:, :, None])[:, :, 0]
    ratio[seen] = nees(error[seen], states.cov[partner[seen]])
    track[seen] = ids[states.label[partner[seen]]]
    return _Matches(fixes.epoch, fixes.label, track, error, ratio, cost), np.array(parts)


def _follow(d: _Array, last: _Index, present: _Index, cutoff: float) -> list[tuple[int, int]]:
    """Keep each target's last track while it is near enough, then match the rest at the least sum of squares."""
    pairs = []
    for row, label in enumerate(last):
        for column in np.flatnonzero(present == label):
            if d[row, column] < cutoff:
                pairs.append((row, int(column)))
    rows = np.setdiff1d(np.arange(d.shape[0]), [p[0] for p in pairs]).astype(np.intp)
    columns = np.setdiff1d(np.arange(d.shape[1]), [p[1] for p in pairs]).astype(np.intp)
    if len(rows) and len(columns):
        from scipy.optimize import linear_sum_assignment

        rest = np.minimum(d[np.ix_(rows, columns)], cutoff) ** 2
        for r, c in zip(*linear_sum_assignment(rest), strict=True):
            if d[rows[r], columns[c]] < cutoff:
                pairs.append((int(rows[r]), int(columns[c])))
    return pairs


def _figures(m: _Matches, epochs: _Array, cutoff: float) -> dict[str, object]:
    seen = m.track >= 0
    squares = np.square(m.error[seen]).sum(axis=-1)
    missing = np.concatenate([squares, np.full(int((~seen).sum()), cutoff**2)])
    switches, gap = 0, 0.0
    for k in np.unique(m.target):
        own = m.target == k
        track = m.track[own & seen]
        switches += int(np.count_nonzero(np.diff(track)))
        gap = max(gap, _longest_gap(epochs[m.epoch[own]], seen[own]))
    mean = _mean(squares)
    total = _mean(missing)
    return {
        "rmse_m": None if mean is None else float(np.sqrt(mean)),
        f"rmse_missing{cutoff:g}_m": None if total is None else float(np.sqrt(total)),
        "bias_east_m": _mean(m.error[seen, 0]),
        "bias_north_m": _mean(m.error[seen, 1]),
        "nees": _mean(m.nees[seen]),
        "nees_inside_95": _mean((m.nees[seen] < _CHI2_95).astype(np.float64)),
        "completeness": _mean(seen.astype(np.float64)),
        "id_switches": switches,
        "tracks": len(np.unique(m.track[seen])),
        "longest_gap_s": gap,
    }


def _longest_gap(time: _Array, seen: npt.NDArray[np.bool_]) -> float:
    """Longest time without a track: between two epochs with one, or from an end of the truth to the nearest."""
    n = len(seen)
    marks = np.unique(np.concatenate([[0], np.flatnonzero(seen), [n - 1]]))
    a, b = marks[:-1], marks[1:]
    missed = ~(seen[a] & seen[b] & (b == a + 1))
    return float((time[b] - time[a])[missed].max(initial=0.0))


def _mean(values: npt.NDArray[np.float64]) -> float | None:
    return float(values.mean()) if len(values) else None


def _latitude_longitude(place: _Array) -> tuple[_Array, _Array]:
    latitude, longitude, _ = ecef_to_geodetic(place)
    return latitude, longitude


def each_time_once(label: npt.NDArray[np.integer], time: _Array) -> _Index:
    """Order by label and time; of rows of one label and time the last is kept."""
    order: _Index = np.lexsort((time, label))
    again = (np.diff(label[order]) == 0) & (np.diff(time[order]) == 0)
    return np.asarray(order[np.append(~again, np.ones(min(1, len(order)), bool))])
