"""System tracks as published rows: who belongs together, states from all measurements, what became of each plot."""

from collections.abc import Iterator, Sequence
from dataclasses import fields
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.tracks.bias import corrected, effects, learnt, spread
from saltus.tracks.faults import PlotLaw, SourceCondition
from saltus.tracks.fuse import Candidates, Fusion
from saltus.tracks.lanes import Lanes, is_first, latest, since
from saltus.tracks.lifecycle import CONFIRMED
from saltus.tracks.local import LocalSystem
from saltus.tracks.measurements import Measurements
from saltus.tracks.membership import Segments
from saltus.tracks.rows import Assignments, ConditionFound, Rows, join_rows
from saltus.tracks.settings import FilterSettings, TrackerSettings
from saltus.tracks.slices import slices
from saltus.tracks.splits import second_echoes
from saltus.tracks.systems import Registered, lasting_differences

__all__ = ["Part", "SystemTracking", "track_systems"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]

_LONGEST = 4.0  # s that a slice lasts
_LATELY = 30.0  # s within which another system must have seen a target for its frame to hold
_STEP = 2.0  # standard deviations of a report by which a correction steps, from which a state is moved with it


class Part(NamedTuple):
    """What the tracker of one system found, and how the system was registered."""

    system: LocalSystem
    registered: Registered
    m: Measurements
    found: Assignments
    rows: Rows
    own: _Index  # sources of the system


class SystemTracking(NamedTuple):
    """System tracks over the measurements of all systems."""

    rows: Rows
    measurements: Measurements
    assignments: Assignments


class _Scene(NamedTuple):
    """Everything measured, of all systems."""

    parts: Sequence[Part]
    m: Measurements  # corrected for biases, in time order
    rows: Rows  # of the local trackers, measurements numbered as in m
    owner: _Index  # part of each measurement
    time: _Array  # of each measurement, as reported, s
    velocity: _Array  # (N, 2): what the local tracker said of its target, 0 where it said nothing, m/s
    doubt: _Array  # (N, 2, 2): what uncertain biases leave of each position, m^2
    shift: _Array  # (N, 2): what corrections moved each position by, m
    turn: _Array  # (N,): and turned directions by, rad


def track_systems(
    parts: Sequence[Part],
    segments: Segments,
    filters: FilterSettings,
    settings: TrackerSettings,
    periods: Sequence[float],
    *,
    use_identity: bool,
) -> SystemTracking:
    """Publish system tracks.

    Every system track begins in the state in which its first local track was published, and is updated by all reports
    of its local tracks in exact time order, corrected for the biases of their systems (`Fusion`). Second echoes move no
    state.

    Args:
        parts: systems in the order in which local tracks are numbered.
        segments: to which system track each local track belongs, and when.
        filters: manoeuvres.
        settings: faults, coasting.
        periods: s without a report after which a target counts as missed, of each source.
        use_identity: whether tracks take over addresses and codes.
    """
    m, place = _merged(parts)
    rows = join_rows([_renumbered(part, at) for part, at in zip(parts, place, strict=True)])
    first = np.cumsum([0, *(len(p.system.ids) for p in parts)])
    local, owner = _local_tracks(parts, place, first, len(m))
    scene = _scene(parts, place, m, rows, owner)
    segment = np.full(len(m), -1)
    known = np.flatnonzero(local >= 0)
    segment[known] = segments.at(local[known], scene.time[known])
    of = (
        np.where(segment >= 0, segments.system_track[segment], 0) if len(segments.track) else np.zeros(len(m), np.int64)
    )
    lanes = _lanes(m, of, local, rows)
    lanes = Lanes(*(column[~_echoing(lanes, scene.time, segments, parts)] for column in lanes))
    laws = [_law(parts, s) for s in range(len(periods))]
    fusion = Fusion(settings, filters, laws, periods, use_identity=use_identity)
    published = [part for c in _candidates(lanes, scene, periods) for part in fusion.feed(m, c)]
    return SystemTracking(join_rows(published), m, _assigned(parts, place, of, fusion.conditions))


def _law(parts: Sequence[Part], source: int) -> PlotLaw:
    """What may be wrong with reports of a source: as its own system's tracker was told."""
    own = next((part for part in parts if source in part.own), parts[0])
    return own.found.sources[source].law


def _merged(parts: Sequence[Part]) -> tuple[Measurements, list[_Index]]:
    """Measurements of all systems, corrected, in time order, and where those of each part went."""
    fixed = []
    for part in parts:
        found = part.registered.found
        m = part.m if found is None else corrected(part.m, np.arange(len(part.m)), found.series)
        fixed.append(m)
    columns = {f.name: np.concatenate([getattr(m, f.name) for m in fixed]) for f in fields(Measurements)}
    order = np.argsort(columns["time"], kind="stable")
    where = np.empty(len(order), np.int64)
    where[order] = np.arange(len(order))
    edge = np.cumsum([0, *(len(m) for m in fixed)])
    return Measurements(**{k: v[order] for k, v in columns.items()}), [where[a:b] for a, b in pairwise(edge)]


def _scene(parts: Sequence[Part], place: Sequence[_Index], m: Measurements, rows: Rows, owner: _Index) -> _Scene:
    n = len(m)
    time, velocity, doubt = np.zeros(n), np.zeros((n, 2)), np.zeros((n, 2, 2))
    shift, turn = np.zeros((n, 2)), np.zeros(n)
    update = np.flatnonzero(rows.measurement >= 0)
    velocity[rows.measurement[update]] = rows.moments.mean[update][:, [1, 3]]
    for part, at in zip(parts, place, strict=True):
        time[at] = part.m.time
        if part.registered.found is not None:
            mean, cov = part.registered.found.series.at(part.m.time)
            doubt[at] = spread(effects(m.ray[at], velocity[at]), cov)
            shift[at], turn[at] = m.position[at, :2] - part.m.position[:, :2], mean[:, 2]
    return _Scene(parts, m, rows, owner, time, velocity, doubt, shift, turn)


def _renumbered(part: Part, at: _Index) -> Rows:
    """Rows of one system with measurements numbered through all."""
    rows = part.rows
    return rows._replace(
        measurement=np.where(rows.measurement >= 0, at[rows.measurement], -1) if len(at) else rows.measurement
    )


def _local_tracks(parts: Sequence[Part], place: Sequence[_Index], first: _Index, n: int) -> tuple[_Index, _Index]:
    """Local track of each measurement through all systems (-1: none confirmed), and its part."""
    local, owner = np.full(n, -1), np.zeros(n, np.int64)
    for k, (part, at) in enumerate(zip(parts, place, strict=True)):
        ids = part.system.ids
        owner[at] = k
        if len(ids):
            found = np.minimum(np.searchsorted(ids, part.found.track_id), len(ids) - 1)
            mine = ids[found] == part.found.track_id
            local[at] = np.where(mine, first[k] + found, -1)
    return local, owner


def _lanes(m: Measurements, of: _Index, local: _Index, rows: Rows) -> Lanes:
    row = np.full(len(m), -1)
    update = np.flatnonzero(rows.measurement >= 0)
    row[rows.measurement[update]] = update
    index = np.flatnonzero(of > 0)
    index = index[np.lexsort((m.time[index], of[index]))]
    return Lanes(index, of[index], local[index], row[index])


def _candidates(lanes: Lanes, scene: _Scene, periods: Sequence[float]) -> Iterator[Candidates]:
    """Reports of local tracks for system tracks, a slice of time each."""
    m, owner = scene.m, scene.owner[lanes.number]
    several = since(
        owner != owner[np.maximum.accumulate(np.where(is_first(lanes.track), np.arange(len(owner)), 0))], lanes.track
    )
    known = (lanes.row >= 0) & (scene.rows.status[np.maximum(lanes.row, 0)] == CONFIRMED)
    sure, (shift, turn) = since(known, lanes.track), _reframed(lanes, scene)
    order = np.argsort(m.time[lanes.number], kind="stable")
    time = m.time[lanes.number[order]]
    lasting = lasting_differences([part.registered for part in scene.parts], m.time)
    for begin, end in slices(time, min([_LONGEST, *periods]), np.inf):
        at = order[begin:end]
        number, extra = lanes.number[at], np.zeros((end - begin, 2, 2))
        extra[several[at]] = (
            0.5 * lasting[number[several[at]], None, None] ** 2 * np.eye(2) + scene.doubt[number[several[at]]]
        )
        begins = (lanes.row[at] >= 0) & np.isfinite(m.position[number, 0])
        mean, cov = _state(scene, number, np.maximum(lanes.row[at], 0))
        yield Candidates(number, lanes.track[at], sure[at], begins, mean, cov, shift[at], turn[at], extra)


def _state(scene: _Scene, number: _Index, row: _Index) -> tuple[_Array, _Array]:
    """State of the local tracker at rows, moved with the measurement that each was made from."""
    moments = scene.rows.moments
    mean, turn = moments.mean[row].copy(), scene.turn[number]
    mean[:, :3:2] += scene.shift[number]
    c, s = np.cos(turn), np.sin(turn)
    vx, vy = mean[:, 1].copy(), mean[:, 3].copy()
    mean[:, 1], mean[:, 3] = c * vx - s * vy, s * vx + c * vy
    return mean, moments.cov[row]


def _reframed(lanes: Lanes, scene: _Scene) -> tuple[_Array, _Array]:
    """Return how far the frame of a track moves before each report (n, 2), m, and turns (n,), rad.

    It does where what is known of a system's biases has stepped further than the noise of its reports. No target moved
    there: a track that this system sees alone moves with the new frame. Where another system sees it, too, the state is
    in that one's frame already.
    """
    m, owner = scene.m, scene.owner[lanes.number]
    shift, turn = np.zeros((len(owner), 2)), np.zeros(len(owner))
    usable = (lanes.row >= 0) & np.isfinite(m.position[lanes.number, 0])
    for k, part in enumerate(scene.parts):
        at = np.flatnonzero(usable & (owner == k))
        if part.registered.found is None or not len(at):
            continue
        series = part.registered.found.series
        other = latest(np.where(owner == k, -1, np.arange(len(owner))), lanes.track)
        met = np.where(other >= 0, scene.time[lanes.number[other]], -np.inf)
        again = np.flatnonzero(~is_first(lanes.track[at]))
        index, before = lanes.number[at[again]], lanes.number[at[again - 1]]
        since_then = scene.time[before], scene.time[index]
        step = learnt(series, m.ray[index], scene.velocity[index], *since_then)
        d2 = np.einsum("ni,nij,nj->n", step, np.linalg.inv(m.cov[index, :2, :2]), step)
        moves = (d2 > _STEP**2) & (since_then[1] - met[at[again]] > _LATELY)
        shift[at[again[moves]]] = step[moves]
        azimuth = [series.at(time[moves])[0][:, 2] for time in since_then]
        turn[at[again[moves]]] = azimuth[1] - azimuth[0]
    return shift, turn


def _echoing(lanes: Lanes, time: _Array, segments: Segments, parts: Sequence[Part]) -> _Mask:
    """Say which rows are second echoes."""
    system = np.repeat(np.arange(len(parts)), [len(p.system.ids) for p in parts])
    own = np.flatnonzero(segments.track < len(system))  # another centre's tracks, numbered last, have no measurements
    out = np.zeros(len(lanes.number), bool)
    for spell in second_echoes(Segments(*(column[own] for column in segments)), system):
        when = time[lanes.number]
        out |= (lanes.local == spell.track) & (when >= spell.time_from) & (when < spell.time_to)
    return out


def _assigned(
    parts: Sequence[Part], place: Sequence[_Index], of: _Index, conditions: Sequence[SourceCondition]
) -> Assignments:
    """What became of every measurement; local tracks never confirmed get numbers behind those of system tracks."""
    track_id, n = of.copy(), len(of)
    split, elsewhere = np.zeros(n, bool), np.zeros(n, bool)
    above = int(of.max(initial=0))
    for part, at in zip(parts, place, strict=True):
        split[at], elsewhere[at] = part.found.split, part.found.elsewhere
        rest = (of[at] == 0) & (part.found.track_id > 0)
        track_id[at[rest]] = above + part.found.track_id[rest]
        above += int(part.found.track_id.max(initial=0))
    told = [ConditionFound(c.law, c.history) for c in conditions]
    return Assignments(track_id, split, elsewhere, np.unique(of[of > 0]), told)
