"""What the latest rows of all systems say about which of their local tracks are one object."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.identify import (
    APART,
    LocalTracks,
    PairSettings,
    doubled,
    latest_ratios,
    thinned,
    track_updates,
    window_start,
)
from saltus.shapes import Float, Int
from saltus.tracks.encounters import SystemTracks
from saltus.tracks.identity import identity_gain
from saltus.tracks.settings import FilterSettings, SystemsSettings
from saltus.tracks.splits import echo_rows
from saltus.tracks.systems import Region, Registered, lasting_difference, pairing_settings, short_difference

__all__ = ["Compared", "Looked", "Weigher"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]

_SCALES = ((1.0, 0.7), (3.0, 0.2), (10.0, 0.07), (30.0, 0.03))  # of the lasting difference, with probabilities
_SLOW = 10.0  # times the usual size, from which a difference lasts longer in proportion
_REACH = 4.0  # standard deviations of a residual within which tracks may be one object
_REACH_SPLIT = 5.0  # standard deviations of the distance between echoes
_ROWS = 8.0  # of the slower system that a window holds at least
_LARGE = 10.0  # of the lasting difference: so far it may reach
_FAST = 1.5  # reports in `spacing` seconds from which one in so many counts as new


class Compared(NamedTuple):
    """One system at a look."""

    view: SystemTracks  # registered rows of its latest minutes; tracks are numbered through all systems
    mode3a: Int[np.ndarray, " k"]  # code of every track, as known now, -1 none
    how: Registered
    region: Region
    own: bool  # whether it has measurements, and not another centre's tracks alone
    noise: float  # of another centre's positions, m
    period: float  # s between two reports of one track


class Looked(NamedTuple):
    """What a look says of pairs of tracks."""

    pairs: Int[np.ndarray, "p 2"]
    time: Float[np.ndarray, " p"]  # s, of the last row that counts
    llr: Float[np.ndarray, " p"]  # nats
    span: Float[np.ndarray, " p"]  # s: since when rows count
    apart: Float[np.ndarray, " p"]  # s: at the look before both were there, and out of reach; -inf: they were not


class Weigher:
    """Weighs pairs by the rows of a window that moves on.

    Two systems differ by something that lasts some time with each object (antenna and reflector, latency) and is now
    and then many times as large (a poor satellite position, multilateration far outside its area): a mixture over its
    size. What codes say is added to the ratio. Two tracks of one radar may be echoes of one object, too.
    """

    def __init__(self, settings: SystemsSettings, filters: FilterSettings) -> None:
        """Take settings.

        Args:
            settings: windows, spacing.
            filters: how objects move, as tracks do.
        """
        self._settings, self._filters = settings, filters

    def look(self, now: float, before: float, systems: Sequence[Compared], pairs: _Index, of: _Index) -> Looked:
        """Weigh all pairs.

        Args:
            now: s.
            before: time of the look before, s.
            systems: all of them.
            pairs: of which something was known before, (P, 2).
            of: system of every track, (K,).
        """
        found = []
        for i, a in enumerate(systems):
            for j in range(i + 1, len(systems)):
                mine = pairs[(of[pairs] == np.array([i, j])).all(axis=1) | (of[pairs] == np.array([j, i])).all(axis=1)]
                found.append(self._across(now, before, a, systems[j], mine))
            echoes = pairs[(of[pairs] == i).all(axis=1)]
            found.append(self._splits(now, before, a, echoes))
        none = np.zeros(0)
        found = [Looked(np.zeros((0, 2), np.int64), none, none, none, none), *found]
        return Looked._make(np.concatenate(columns) for columns in zip(*found, strict=True))

    def _across(self, now: float, before: float, a: Compared, b: Compared, known: _Index) -> Looked:
        lasting = lasting_difference(a.how, b.how)
        pairing = pairing_settings([a.region, b.region], self._settings, self._filters, lasting)
        slower = max(self._interval(a), self._interval(b))
        since = window_start(now, max(self._settings.window, _ROWS * slower))
        difference = short_difference(a.how, b.how)
        rows = [self._counted(x, since, difference) for x in (a, b)]
        rows = rows if a.own and b.own else [doubled(x) for x in rows]
        wide = [float(np.quantile(np.trace(t.R, axis1=-2, axis2=-1), 0.9)) if len(t.time) else 0.0 for t in rows]
        reach = _REACH * float(np.sqrt(sum(wide) + 2.0 * (_LARGE * lasting) ** 2))
        found = _weighed(rows[0], rows[1], *_mixture(pairing), reach, known, before)
        names_a, names_b = a.view.icao24, b.view.icao24
        i, j = found.pairs.T
        first = np.isin(i, rows[0].track)  # pairs are sorted: their first track may be of either
        i, j = np.where(first, i, j), np.where(first, j, i)
        gain = identity_gain(names_a[i], names_b[j], a.mode3a[i], b.mode3a[j])
        return found._replace(llr=found.llr + gain, span=np.full(len(gain), since))

    def _splits(self, now: float, before: float, a: Compared, known: _Index) -> Looked:
        """Compare the tracks of one radar by the reports made in motion."""
        rows = echo_rows(a.view, own=a.own)
        since = window_start(now, 0.5 * self._settings.window)
        rows = LocalTracks(*(column[rows.time >= since] for column in rows))
        offset = self._settings.split_offset
        pairing = pairing_settings([a.region], self._settings, self._filters, offset)
        found = _weighed(rows, rows, [pairing], [1.0], _REACH_SPLIT * offset, known, before)
        return found._replace(span=np.full(len(found.llr), since))

    def _interval(self, x: Compared) -> float:
        """Interval between the rows of a track that count, s."""
        return max(self._settings.spacing, x.period) if x.own else self._settings.track_memory

    def _counted(self, x: Compared, since: float, difference: float) -> LocalTracks:
        """The rows of a system that count as measurements.

        Tracks of another centre may come from the very reports they are compared with: one update per correlation time,
        and (elsewhere) both covariances doubled, which bounds whatever they have in common. Of reports, one in each
        stretch of `spacing` seconds counts, the last, with its share of the short difference: errors last some seconds,
        and a filter that takes those that follow for new would see one object's two positions move apart.
        """
        view, tracks = x.view, x.view.tracks
        late = tracks.time >= since
        tracks = LocalTracks(*(column[late] for column in tracks))
        if not x.own:
            velocity, memory = view.velocity[late], self._settings.track_memory
            track, time, z, _ = tracks
            return track_updates(track, time, z, sigma=x.noise, memory=memory, velocity=velocity, shared=False)
        spacing = self._settings.spacing
        extra = 0.5 * difference**2 * np.eye(2) if x.period * _FAST < spacing else np.zeros((2, 2))
        kept = thinned(tracks, spacing)
        return kept._replace(R=kept.R + extra)


def _mixture(pairing: PairSettings) -> tuple[list[PairSettings], list[float]]:
    """Objects with a lasting difference of unknown size: multiples of its standard deviation."""
    parts = []
    for scale, _ in _SCALES:
        cov, lasts = scale**2 * np.asarray(pairing.offset_cov), max(1.0, scale / _SLOW) * pairing.offset_time
        parts.append(replace(pairing, offset_cov=cov, offset_time=lasts))
    return parts, [share for _, share in _SCALES]


def _weighed(
    a: LocalTracks,
    b: LocalTracks,
    settings: Sequence[PairSettings],
    weights: Sequence[float],
    reach: float,
    known: _Index,
    before: float,
) -> Looked:
    """Weigh pairs within reach; of those known before that are out of reach now, say so."""
    none = np.zeros(0)
    if not len(a.time) or not len(b.time):
        return Looked(np.zeros((0, 2), np.int64), none, none, none, none)
    (ids_a, first_a, last_a, short_a), (ids_b, first_b, last_b, short_b) = (_packed(x) for x in (a, b))
    near, time, llr = latest_ratios(short_a, short_a if a is b else short_b, settings, weights, reach=reach)
    i, j = near.T
    met = np.maximum(first_a[i], first_b[j]) < np.minimum(_until(a, before)[i], _until(b, before)[j])
    ends = np.column_stack([ids_a[i], ids_b[j]])
    new = Looked(ends, time, llr, np.full(len(time), np.inf), np.where(met, before, -np.inf))
    width = 1 + int(max(ids_a[-1], ids_b[-1], known.max(initial=0)))
    sides = np.where(np.isin(known[:, :1], ids_a), known, known[:, ::-1])
    there = np.isin(sides[:, 0], ids_a) & np.isin(sides[:, 1], ids_b)
    there &= ~np.isin(sides[:, 0] * width + sides[:, 1], new.pairs[:, 0] * width + new.pairs[:, 1])
    far = sides[there]
    at_a, at_b = np.searchsorted(ids_a, far[:, 0]), np.searchsorted(ids_b, far[:, 1])
    both = np.maximum(first_a[at_a], first_b[at_b]) <= np.minimum(last_a[at_a], last_b[at_b])
    when = np.minimum(last_a[at_a], last_b[at_b])[both]
    nothing = np.full(len(when), -np.inf)
    apart = Looked(far[both], when, np.full(len(when), APART), -nothing, nothing)
    out = Looked._make(np.concatenate(columns) for columns in zip(new, apart, strict=True))
    return out._replace(pairs=np.sort(out.pairs, axis=1))


def _until(tracks: LocalTracks, time: float) -> _Array:
    """Return the time of the last row of each track up to a time, -inf where there is none."""
    ids, place = np.unique(tracks.track, return_inverse=True)
    out = np.full(len(ids), -np.inf)
    early = tracks.time <= time
    np.maximum.at(out, place[early], tracks.time[early])
    return out


def _packed(tracks: LocalTracks) -> tuple[_Index, _Array, _Array, LocalTracks]:
    """Number tracks without gaps; return their numbers before, and the times of their first and last rows."""
    ids, first, short = np.unique(tracks.track, return_index=True, return_inverse=True)
    last = np.append(first[1:], len(short)) - 1
    return ids, tracks.time[first], tracks.time[last], tracks._replace(track=short)
