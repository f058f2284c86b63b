"""Which local tracks of all systems are one object, over time."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from saltus.identify import (
    Decisions,
    DecisionSettings,
    Evidence,
    LocalTracks,
    PairSettings,
    decide_pairs,
    doubled,
    join_evidence,
    pair_evidence,
    track_updates,
)
from saltus.linalg import logsumexp
from saltus.tracks.identity import identity_gain
from saltus.tracks.local import LocalSystem
from saltus.tracks.settings import FilterSettings, SystemsSettings
from saltus.tracks.splits import split_evidence
from saltus.tracks.systems import Registered, lasting_difference, pairing_settings, short_difference

__all__ = ["decision_rule", "identify"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]

_SCALES = ((1.0, 0.7), (3.0, 0.2), (10.0, 0.07), (30.0, 0.03))  # of the lasting difference, with probabilities
_SLOW = 10.0  # times the usual size, from which a difference lasts longer in proportion
_REACH = 4.0  # standard deviations of a residual within which tracks may be one object
_ROWS = 8.0  # of the slower system that a window holds at least
_LARGE = 10.0  # of the lasting difference: so far it may reach


def identify(
    systems: Sequence[LocalSystem], how: Sequence[Registered], settings: SystemsSettings, filters: FilterSettings
) -> tuple[Decisions, Evidence]:
    """Decide over time which local tracks are one object.

    Tracks are numbered through all systems in their order. Two systems differ by something that lasts some time with
    each object (antenna and reflector, latency) and is now and then many times as large (a poor satellite position,
    multilateration far outside its area): a mixture over its size. What codes say is added to the ratio. Two tracks of
    one radar may be echoes of one object, too.

    Args:
        systems: registered.
        how: how they were.
        settings: when to declare.
        filters: how objects move, as tracks do.
    """
    first = np.cumsum([0, *(len(s.ids) for s in systems)])
    parts = []
    for i in range(len(systems)):
        for j in range(i + 1, len(systems)):
            lasting = lasting_difference(how[i], how[j])
            pairing = pairing_settings([systems[i], systems[j]], settings, filters, lasting)
            own = short_difference(how[i], how[j])
            a, b = _counted(systems[i], systems[j], settings, own)
            if not len(a.time) or not len(b.time):
                continue
            wide = [float(np.quantile(np.trace(t.R, axis1=-2, axis2=-1), 0.9)) for t in (a, b)]
            reach = _REACH * float(np.sqrt(sum(wide) + 2.0 * (_LARGE * lasting) ** 2))
            found = _mixed(a, b, pairing, reach, max(settings.window, _ROWS * max(_interval(a), _interval(b))))
            gain = _identity(systems[i], systems[j], found.pairs)
            parts.append((found._replace(llr=found.llr + gain[found.pair]), int(first[i]), int(first[j])))
        split = split_evidence(systems[i], settings, filters)
        if split is not None:
            parts.append((split, int(first[i]), int(first[i])))
    evidence = join_evidence(parts)
    number = np.repeat(np.arange(len(systems)), np.diff(first))
    address = np.concatenate([s.view.icao24 for s in systems])
    return decide_pairs(evidence, number, decision_rule(systems, settings), address=address), evidence


def decision_rule(systems: Sequence[LocalSystem], settings: SystemsSettings) -> DecisionSettings:
    """Return when tracks are declared one object: any track that a system has at a time could be the one."""
    return DecisionSettings(
        prior=1.0 / _at_once(systems),
        p_false=settings.p_false,
        p_false_split=settings.p_false_split,
        hysteresis=settings.hysteresis,
    )


def _interval(tracks: LocalTracks) -> float:
    """Median interval between the rows of a track, s."""
    step = np.diff(tracks.time)[np.diff(tracks.track) == 0]
    return float(np.median(step)) if len(step) else 0.0


def _at_once(systems: Sequence[LocalSystem]) -> float:
    """How many tracks a system has at a time, of the system with most: so many could be the other one's object."""
    most = 2.0
    for system in systems:
        tracks = system.view.tracks
        edge = np.flatnonzero(np.diff(tracks.track, prepend=-1, append=-1))
        if len(edge) > 1:
            lived = tracks.time[edge[1:] - 1] - tracks.time[edge[:-1]]
            most = max(most, float(lived.sum() / max(np.ptp(tracks.time), 1.0)))
    return most


def _mixed(a: LocalTracks, b: LocalTracks, pairing: PairSettings, reach: float, window: float) -> Evidence:
    """Evidence with a lasting difference of unknown size: a mixture over multiples of its standard deviation."""
    parts = []
    for scale, share in _SCALES:
        cov, lasts = scale**2 * np.asarray(pairing.offset_cov), max(1.0, scale / _SLOW) * pairing.offset_time
        wide = replace(pairing, offset_cov=cov, offset_time=lasts)
        parts.append((pair_evidence(a, b, wide, reach=reach, window=window), np.log(share)))
    first = parts[0][0]
    llr = logsumexp(np.stack([e.llr + weight for e, weight in parts], axis=-1), (1,))[:, 0]
    return first._replace(llr=llr)


def _identity(a: LocalSystem, b: LocalSystem, pairs: _Index) -> _Array:
    i, j = pairs.T
    return identity_gain(a.view.icao24[i], b.view.icao24[j], a.mode3a[i], b.mode3a[j])


def _counted(
    a: LocalSystem, b: LocalSystem, settings: SystemsSettings, difference: float
) -> tuple[LocalTracks, LocalTracks]:
    """The rows of both systems that count as measurements.

    Tracks of another centre may come from the very reports they are compared with: one update per correlation time,
    and both covariances doubled, which bounds whatever they have in common.
    """
    rows = [
        _sparse(s.view.tracks, settings.spacing, difference)
        if s.own
        else track_updates(
            s.view.tracks.track,
            s.view.tracks.time,
            s.view.tracks.z,
            sigma=s.noise,
            memory=settings.track_memory,
            velocity=s.view.velocity,
            shared=False,
        )
        for s in (a, b)
    ]
    if a.own and b.own:
        return rows[0], rows[1]
    return doubled(rows[0]), doubled(rows[1])


def _sparse(tracks: LocalTracks, spacing: float, difference: float) -> LocalTracks:
    """Keep the last report of each stretch of `spacing` seconds, with its share of the short difference.

    Errors last some seconds: reports that follow faster are no new ones, and a filter that takes them for new would
    see one object's two positions move apart.
    """
    number = np.floor(tracks.time / spacing)
    last = np.ones(len(number), bool)
    last[:-1] = (np.diff(number) != 0) | (np.diff(tracks.track) != 0)
    fast = len(number) > 1.5 * last.sum()
    extra = 0.5 * difference**2 * np.eye(2) if fast else np.zeros((2, 2))
    return LocalTracks(tracks.track[last], tracks.time[last], tracks.z[last], tracks.R[last] + extra)
