"""Scores of tracks from labels: which object each plot truly came from, and which track it was given to."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError
from saltus.shapes import Bool, Float, Int

__all__ = ["FalseTracks", "TrackScores", "false_tracks", "track_scores"]


class TrackScores(NamedTuple):
    """Scores of tracks against labelled plots.

    The four shares and means are NaN when there is nothing to judge; `per_object_*` and `objects` have one
    entry for each object that is judged. `n_pure` of `n_assigned` labelled plots agree with their track,
    `n_covered` of the `n_judged` plots of judged objects lie on confirmed tracks.
    """

    purity: float
    completeness: float
    fragmentation: float  # confirmed tracks whose majority label is the object, mean over judged objects
    touching: float  # confirmed tracks with any of the object's plots, mean over judged objects
    n_pure: int
    n_assigned: int
    n_covered: int
    n_judged: int
    objects: Int[np.ndarray, " k"]
    per_object_completeness: Float[np.ndarray, " k"]
    per_object_tracks: Int[np.ndarray, " k"]
    per_object_touching: Int[np.ndarray, " k"]


class FalseTracks(NamedTuple):
    """Number of false confirmed tracks, their rate per hour and its interval, and their ids."""

    n_false: int
    per_hour: float
    low: float
    high: float
    ids: Int[np.ndarray, " k"]


def track_scores(
    tracks: npt.ArrayLike,
    objects: npt.ArrayLike,
    *,
    confirmed: npt.ArrayLike | None = None,
    min_plots: int = 10,
) -> TrackScores:
    """Score an assignment of plots to tracks against the plots' true labels.

    purity = share of labelled, assigned plots that lie on a track whose majority label is theirs;
    completeness = share of the judged objects' plots on confirmed tracks;
    fragmentation = confirmed tracks per judged object.

    The majority is over labelled plots; the lowest label wins a tie.

    Args:
        tracks: track id of each plot, (N,) integers, negative for a plot on no track.
        objects: true label of each plot, (N,) integers, negative for a plot without label.
        confirmed: ids of the tracks that were confirmed, (k,); None means all.
        min_plots: an object is judged when it has at least so many plots.

    Returns:
        The scores, in total and for each judged object.

    Raises:
        DataError: the two columns do not match or are not integers.
        ModelError: `min_plots` < 1.
    """
    track, label = _columns(tracks, objects)
    if min_plots < 1:
        raise ModelError(f"min_plots must be at least 1: {min_plots}")
    good = _is_confirmed(track, confirmed)
    assigned = (track >= 0) & (label >= 0)
    ids, majority = _majorities(track[assigned], label[assigned])
    pure = majority[np.searchsorted(ids, track[assigned])] == label[assigned]

    names, n_plots = np.unique(label[label >= 0], return_counts=True)
    names, n_plots = names[n_plots >= min_plots], n_plots[n_plots >= min_plots]
    covered = _count(names, label[good & (label >= 0)])
    touching = _count(names, np.unique(np.stack([track, label])[:, good & assigned], axis=1)[1])
    owned = _count(names, majority[np.isin(ids, track[good])])
    return TrackScores(
        purity=_share(int(pure.sum()), len(pure)),
        completeness=_share(int(covered.sum()), int(n_plots.sum())),
        fragmentation=_share(int(owned.sum()), len(names)),
        touching=_share(int(touching.sum()), len(names)),
        n_pure=int(pure.sum()),
        n_assigned=len(pure),
        n_covered=int(covered.sum()),
        n_judged=int(n_plots.sum()),
        objects=names,
        per_object_completeness=covered / n_plots,
        per_object_tracks=owned,
        per_object_touching=touching,
    )


def false_tracks(
    tracks: npt.ArrayLike,
    objects: npt.ArrayLike,
    *,
    duration: float,
    confirmed: npt.ArrayLike | None = None,
    confidence: float = 0.95,
) -> FalseTracks:
    """Count confirmed tracks that follow no object: no object has half of the track's plots.

    rate = count / duration; interval from the chi-square law of a Poisson count,
    [chi2_{2c}(a), chi2_{2c+2}(1 - a)] / 2 with a = (1 - confidence) / 2

    Args:
        tracks: track id of each plot, (N,) integers, negative for a plot on no track.
        objects: true label of each plot, (N,) integers, negative for clutter.
        duration: length of the recording, s.
        confirmed: ids of the tracks that were confirmed, (k,); None means all. A confirmed id without any
            plot counts as false.
        confidence: probability of the interval.

    Returns:
        Count, rate per hour with its interval, and the false tracks' ids.

    Raises:
        DataError: the two columns do not match or are not integers.
        ModelError: a duration that is not positive, or a confidence outside (0, 1).

    Source: Garwood (1936), interval for a Poisson mean.
    """
    from scipy.special import gammaincinv

    if not (duration > 0 and 0 < confidence < 1):
        raise ModelError(f"need duration > 0 s and 0 < confidence < 1: {duration}, {confidence}")
    track, label = _columns(tracks, objects)
    judged = np.unique(track[track >= 0] if confirmed is None else np.asarray(confirmed, np.int64))
    n_all = _count(judged, track)
    n_best = np.zeros(len(judged), np.int64)
    known = (track >= 0) & (label >= 0)
    pairs, n = np.unique(np.stack([track, label])[:, known], axis=1, return_counts=True)
    at = np.isin(pairs[0], judged)
    np.maximum.at(n_best, np.searchsorted(judged, pairs[0][at]), n[at])
    ids = judged[(2 * n_best < n_all) | (n_all == 0)]
    hours, count, tail = duration / 3600, len(ids), (1 - confidence) / 2
    low = float(gammaincinv(count, tail)) if count else 0.0
    return FalseTracks(count, count / hours, low / hours, float(gammaincinv(count + 1, 1 - tail)) / hours, ids)


def _columns(tracks: npt.ArrayLike, objects: npt.ArrayLike) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    track, label = np.asarray(tracks), np.asarray(objects)
    if track.ndim != 1 or track.shape != label.shape:
        raise DataError(f"tracks and objects must be two columns of one length: {track.shape}, {label.shape}")
    for name, column in (("tracks", track), ("objects", label)):
        if column.size and column.dtype.kind not in "iu":
            raise DataError(f"{name} must be integers with a negative number for none, not {column.dtype}")
    return track.astype(np.int64), label.astype(np.int64)


def _is_confirmed(track: Int[np.ndarray, " n"], confirmed: npt.ArrayLike | None) -> Bool[np.ndarray, " n"]:
    if confirmed is None:
        return track >= 0
    return np.isin(track, np.asarray(confirmed, np.int64)) & (track >= 0)


def _majorities(
    track: Int[np.ndarray, " n"], label: Int[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Return each track's id (sorted) and the label most of its plots have."""
    pairs, n = np.unique(np.stack([track, label]), axis=1, return_counts=True)
    order = np.lexsort((pairs[1], -n, pairs[0]))  # per track: most plots first, then the lowest label
    ids, first = np.unique(pairs[0][order], return_index=True)
    return ids, pairs[1][order][first]


def _count(names: Int[np.ndarray, " k"], labels: Int[np.ndarray, " n"]) -> Int[np.ndarray, " k"]:
    """Count how often each of the sorted `names` occurs."""
    return np.searchsorted(np.sort(labels), names, "right") - np.searchsorted(np.sort(labels), names, "left")


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
