"""Scores of tracks against the truth, over all its epochs (each distinct time of any target)."""

import numpy as np
import numpy.typing as npt

from saltus.evaluate.matching import Matches, Tracks, match, target_places, track_places
from saltus.evaluate.reference import Reference
from saltus.evaluate.sets import gospa
from saltus.geo import ecef_to_geodetic, local_basis

__all__ = ["target_scores"]

_Array = npt.NDArray[np.float64]

_CHI2_95 = 5.991  # of two degrees of freedom


def target_scores(tracks: Tracks, truth: Reference, *, cutoff: float) -> dict[str, object]:
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

    Source: `saltus.evaluate.match`, `saltus.evaluate.gospa`, `saltus.evaluate.nees`.
    """
    epochs = np.unique(truth.time)
    matches = match(tracks, truth, epochs, cutoff=cutoff)
    parts, cost = _set_distances(tracks, truth, epochs, cutoff)
    overall: dict[str, object] = {"cutoff_m": cutoff, "epochs": len(epochs), **_figures(matches, epochs, cutoff)}
    overall["gospa_m"] = _mean(parts[:, 0])
    overall["gospa_parts_m2"] = {
        name: _mean(parts[:, k]) for k, name in enumerate(("localisation", "missed", "false"), start=1)
    }
    overall["false_tracks"] = _mean(parts[:, 4])
    per_target: dict[str, object] = {}
    for k, name in enumerate(truth.names):
        own = Matches(*(column[matches.target == k] for column in matches))
        per_target[name] = {**_figures(own, epochs, cutoff), "gospa_m": _mean(np.sqrt(cost[matches.target == k]))}
    return {**overall, "targets": per_target}


def _set_distances(tracks: Tracks, truth: Reference, epochs: _Array, cutoff: float) -> tuple[_Array, _Array]:
    """GOSPA and its parts at each epoch with a target, (epochs, 5), and each target's own part squared, m^2."""
    fixes, states = target_places(truth, epochs), track_places(tracks, epochs)
    cost, parts = np.full(len(fixes.epoch), 0.5 * cutoff**2), []
    ends, state_ends = (np.searchsorted(s.epoch, np.arange(len(epochs) + 1)) for s in (fixes, states))
    for k in range(len(epochs)):
        i, j = np.arange(ends[k], ends[k + 1]), slice(state_ends[k], state_ends[k + 1])
        if not len(i):
            continue
        # One basis for the epoch: only distances matter here.
        flat = local_basis(*ecef_to_geodetic(fixes.place[i[:1]])[:2])[0, :2]
        here, there = (fixes.place[i] - fixes.place[i[0]]) @ flat.T, (states.place[j] - fixes.place[i[0]]) @ flat.T
        found = gospa(here, there, cutoff=cutoff)
        parts.append((found.distance, found.localisation, found.missed, found.false, found.n_false))
        cost[i[found.pairs[:, 0]]] = np.square(here[found.pairs[:, 0]] - there[found.pairs[:, 1]]).sum(axis=-1)
    return np.array(parts), cost


def _figures(m: Matches, epochs: _Array, cutoff: float) -> dict[str, object]:
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
