"""Which track follows which target: one matching, as in CLEAR MOT, for every score.

At every epoch a target's place is that of the reference, and a track's is interpolated linearly between the two rows
around the epoch. With w the share of the interval gone,

    x = (1 - w) x_0 + w x_1,   P = (1 - w) P_0 + w P_1,

which bounds the covariance of the interpolated estimate however the errors of the two rows are correlated (the square
is convex), and is the row's own at the row's time. A track exists from its first row to its last. Distances are
horizontal, in metres east and north at the target.

A target keeps its track while the two are within the cut-off, the rest is matched at the least sum of squares.

Source: Bernardin, Stiefelhagen (2008), the matching of CLEAR MOT.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError
from saltus.evaluate.estimation import nees
from saltus.evaluate.reference import Reference, around
from saltus.geo import ecef_to_geodetic, local_basis
from saltus.shapes import Float, Int

__all__ = ["Matches", "Places", "Tracks", "match", "match_rows", "target_places", "track_places"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]


class Tracks(NamedTuple):
    """Rows of tracks, sorted by track and time, each time once."""

    id: Int[np.ndarray, " n"]
    time: Float[np.ndarray, " n"]  # s
    place: Float[np.ndarray, "n 3"]  # earth-centred, m, at height 0
    cov: Float[np.ndarray, "n 2 2"]  # m^2, true east and north


class Places(NamedTuple):
    """Objects at epochs, sorted by epoch."""

    epoch: Int[np.ndarray, " n"]  # index into the epochs
    label: Int[np.ndarray, " n"]  # which object
    place: Float[np.ndarray, "n 3"]
    cov: Float[np.ndarray, "n 2 2"]  # 0 of targets


class Matches(NamedTuple):
    """One row per target and epoch at which it is there, sorted by epoch."""

    epoch: Int[np.ndarray, " n"]  # index into the epochs
    target: Int[np.ndarray, " n"]  # index into the reference's names
    track: Int[np.ndarray, " n"]  # id of the track that follows it, -1 none
    error: Float[np.ndarray, "n 2"]  # east, north, estimate minus truth, m; NaN where missed
    nees: Float[np.ndarray, " n"]  # NaN where missed


def match(tracks: Tracks, reference: Reference, epochs: Float[np.ndarray, " e"], *, cutoff: float) -> Matches:
    """Match targets and tracks epoch by epoch.

    Args:
        tracks: rows of tracks.
        reference: the truth.
        epochs: ascending, s.
        cutoff: m: no track follows a target from further away.

    Raises:
        DataError: there is no epoch at which a target is known.
    """
    targets, states = target_places(reference, epochs), track_places(tracks, epochs)
    n = len(targets.epoch)
    if not n:
        raise DataError("the truth has no epoch at which a target is known: fixes too far apart?")
    ids = np.unique(tracks.id)
    basis = local_basis(*ecef_to_geodetic(targets.place)[:2])[:, :2]  # rows east, north
    partner, last = np.full(n, -1, np.intp), np.full(int(targets.label.max()) + 1, -1, np.intp)
    ends, state_ends = (np.searchsorted(s.epoch, np.arange(len(epochs) + 1)) for s in (targets, states))
    for k in range(len(epochs)):
        i, j = slice(ends[k], ends[k + 1]), slice(state_ends[k], state_ends[k + 1])
        if i.start == i.stop or j.start == j.stop:
            continue
        d = np.linalg.norm((targets.place[i, None] - states.place[None, j]) @ basis[i.start].T, axis=-1)
        for row, column in _follow(d, last[targets.label[i]], states.label[j], cutoff):
            partner[i.start + row] = j.start + column
            last[targets.label[i.start + row]] = states.label[j.start + column]
    seen = partner >= 0
    error, ratio, track = np.full((n, 2), np.nan), np.full(n, np.nan), np.full(n, -1, np.int64)
    offset = states.place[partner[seen]] - targets.place[seen]
    error[seen] = (basis[seen] @ offset[:, :, None])[:, :, 0]
    ratio[seen] = nees(error[seen], states.cov[partner[seen]])
    track[seen] = ids[states.label[partner[seen]]]
    return Matches(targets.epoch, targets.label, track, error, ratio)


def match_rows(tracks: Tracks, reference: Reference, *, cutoff: float) -> tuple[_Index, _Array]:
    """Match tracks at the times of their rows: the target each row follows, -1 none, and its error east and north, m.

    Args:
        tracks: rows of tracks.
        reference: the truth.
        cutoff: m: no track follows a target from further away.
    """
    target, error = np.full(len(tracks.time), -1, np.intp), np.full((len(tracks.time), 2), np.nan)
    epochs, epoch = np.unique(tracks.time, return_inverse=True)
    if not len(target_places(reference, epochs).epoch):
        return target, error
    found = match(tracks, reference, epochs, cutoff=cutoff)
    ids, rank = np.unique(tracks.id, return_inverse=True)
    followed = np.flatnonzero(found.track >= 0)
    key = found.epoch[followed] * len(ids) + np.searchsorted(ids, found.track[followed])
    order = np.argsort(key)
    wanted = epoch * len(ids) + rank
    at = np.minimum(np.searchsorted(key[order], wanted), max(len(key) - 1, 0))
    mine = np.flatnonzero(key[order][at] == wanted) if len(key) else np.zeros(0, np.intp)
    match_of = followed[order[at[mine]]]
    target[mine], error[mine] = found.target[match_of], found.error[match_of]
    return target, error


def target_places(reference: Reference, epochs: Float[np.ndarray, " e"]) -> Places:
    """Return the targets known at each epoch."""
    epoch, label = _alive(reference.target, reference.time, epochs)
    place = reference.at(label, epochs[epoch]).place
    known = np.isfinite(place[:, 0])
    return Places(epoch[known], label[known], place[known], np.zeros((int(known.sum()), 2, 2)))


def track_places(tracks: Tracks, epochs: Float[np.ndarray, " e"]) -> Places:
    """Return the tracks that exist at each epoch, labelled by the order of their ids."""
    _, rank = np.unique(tracks.id, return_inverse=True)
    epoch, label = _alive(rank, tracks.time, epochs)
    a, b, w, _ = around(rank, tracks.time, label, epochs[epoch])
    place = (1.0 - w)[:, None] * tracks.place[a] + w[:, None] * tracks.place[b]
    cov = (1.0 - w)[:, None, None] * tracks.cov[a] + w[:, None, None] * tracks.cov[b]
    return Places(epoch, label, place, cov)


def _alive(label: npt.NDArray[np.integer], time: _Array, epochs: _Array) -> tuple[_Index, _Index]:
    """Pair every epoch with the objects that have a row no later and one no earlier, sorted by epoch."""
    begin = np.flatnonzero(np.diff(label, prepend=-1))
    end = np.append(begin[1:], len(label)) - 1 if len(begin) else begin
    first, stop = np.searchsorted(epochs, time[begin]), np.searchsorted(epochs, time[end], side="right")
    count = stop - first
    who = np.repeat(label[begin], count).astype(np.intp)
    epoch = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
    order = np.argsort(epoch, kind="stable")
    return epoch[order], who[order]


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
