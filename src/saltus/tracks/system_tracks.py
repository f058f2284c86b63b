"""System tracks as published rows: who belongs together, states from all measurements, what became of each plot."""

from collections.abc import Sequence
from dataclasses import fields
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.tracks.bias import corrected, effects, learnt, spread
from saltus.tracks.faults import PlotLaw, plot_law
from saltus.tracks.fuse import Fused, LaneRows, fuse
from saltus.tracks.kinematics import Moments
from saltus.tracks.lanes import Lanes, held, in_several, is_first, latest, shortest_periods, since, with_coasted
from saltus.tracks.lifecycle import COASTED, CONFIRMED, TENTATIVE
from saltus.tracks.local import LocalSystem
from saltus.tracks.measurements import Measurements
from saltus.tracks.membership import Segments
from saltus.tracks.rows import Assignments, Rows, join_rows
from saltus.tracks.settings import FilterSettings, TrackerSettings
from saltus.tracks.splits import second_echoes
from saltus.tracks.systems import Registered

__all__ = ["Part", "SystemTracking", "track_systems"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]

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


def track_systems(
    parts: Sequence[Part],
    segments: Segments,
    lasting: float,
    filters: FilterSettings,
    settings: TrackerSettings,
    periods: Sequence[float],
    *,
    use_identity: bool,
) -> SystemTracking:
    """Publish system tracks.

    A system track that one local track of an unbiased system makes alone is published as its tracker left it. Every
    other one is filtered anew from all measurements of its local tracks in exact time order, corrected for the biases
    of their systems, from the state in which the first of them was published. Bearings stay with their own system, and
    second echoes move no state.

    Args:
        parts: systems in the order in which local tracks are numbered.
        segments: to which system track each local track belongs, and when.
        lasting: standard deviation of what lasts between systems, m: added where systems meet in a track.
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
    echo = _echoing(lanes, scene.time, segments, parts)
    alone = _published_as_left(parts, lanes, m, owner)
    kept = _kept(rows, parts, first, segments, alone)
    lanes = Lanes(*(column[~echo] for column in lanes))
    lanes = lanes._replace(piece=np.cumsum(is_first(lanes.track) | _reframed(lanes, scene)))
    anew = _anew(lanes, alone, scene, lasting, (filters, settings), periods, use_identity=use_identity)
    return SystemTracking(join_rows([kept, anew]), m, _assigned(parts, place, of, rows))


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
    time, velocity, doubt = np.zeros(len(m)), np.zeros((len(m), 2)), np.zeros((len(m), 2, 2))
    update = np.flatnonzero(rows.measurement >= 0)
    velocity[rows.measurement[update]] = rows.moments.mean[update][:, [1, 3]]
    for part, at in zip(parts, place, strict=True):
        time[at] = part.m.time
        if part.registered.found is not None:
            _, cov = part.registered.found.series.at(part.m.time)
            doubt[at] = spread(effects(m.ray[at], velocity[at]), cov)
    return _Scene(parts, m, rows, owner, time, velocity, doubt)


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
    return Lanes(index, of[index], local[index], row[index], of[index])


def _reframed(lanes: Lanes, scene: _Scene) -> _Mask:
    """Say at which rows what is known of a system's biases has stepped further than the noise of its reports.

    No target moved there: a track that this system sees alone goes on from the state of the local tracker, moved into
    the new frame. Where another system sees it, too, the state is in that one's frame already.
    """
    m, owner = scene.m, scene.owner[lanes.number]
    out = np.zeros(len(lanes.number), bool)
    usable = (lanes.row >= 0) & np.isfinite(m.position[lanes.number, 0])
    for k, part in enumerate(scene.parts):
        at = np.flatnonzero(usable & (owner == k))
        if part.registered.found is None or not len(at):
            continue
        other = latest(np.where(owner == k, -1, np.arange(len(owner))), lanes.track)
        met = np.where(other >= 0, scene.time[lanes.number[other]], -np.inf)
        again = np.flatnonzero(~is_first(lanes.track[at]))
        index, before = lanes.number[at[again]], lanes.number[at[again - 1]]
        span = scene.time[before], scene.time[index]
        shift = learnt(part.registered.found.series, m.ray[index], scene.velocity[index], *span)
        d2 = np.einsum("ni,nij,nj->n", shift, np.linalg.inv(m.cov[index, :2, :2]), shift)
        out[at[again]] = (d2 > _STEP**2) & (span[1] - met[at[again]] > _LATELY)
    return out


def _echoing(lanes: Lanes, time: _Array, segments: Segments, parts: Sequence[Part]) -> _Mask:
    """Say which rows are second echoes."""
    system = np.repeat(np.arange(len(parts)), [len(p.system.ids) for p in parts])
    own = np.flatnonzero(segments.track < len(system))  # another centre's tracks, numbered last, have no measurements
    out = np.zeros(len(lanes.number), bool)
    for spell in second_echoes(Segments(*(column[own] for column in segments)), system):
        when = time[lanes.number]
        out |= (lanes.local == spell.track) & (when >= spell.time_from) & (when < spell.time_to)
    return out


def _published_as_left(parts: Sequence[Part], lanes: Lanes, m: Measurements, owner: _Index) -> _Mask:
    """Say of each system track (by number, 0 unused) whether its one local track's own rows are published."""
    count = int(lanes.track.max(initial=0)) + 1
    fewest, most = np.full(count, np.iinfo(np.int64).max), np.full(count, -1)
    np.minimum.at(fewest, lanes.track, lanes.local)
    np.maximum.at(most, lanes.track, lanes.local)
    moved = np.array(
        [p.registered.found is not None and bool(p.registered.found.series.estimated.any()) for p in parts]
    )
    sights = np.array([bool(np.isfinite(p.m.bearing).any()) for p in parts])
    biased = np.zeros(count, bool)
    biased[lanes.track[(moved & ~sights)[owner[lanes.number]]]] = True
    return np.asarray((fewest == most) & ~biased)


def _kept(rows: Rows, parts: Sequence[Part], first: _Index, segments: Segments, alone: _Mask) -> Rows:
    """Rows of local trackers under the number of their system track."""
    local = np.concatenate(
        [np.full(0, -1)]
        + [
            np.where(
                np.isin(p.rows.track_id, p.system.ids), first[k] + np.searchsorted(p.system.ids, p.rows.track_id), -1
            )
            for k, p in enumerate(parts)
        ]
    )
    at = np.flatnonzero(local >= 0)
    if not len(segments.track):
        return join_rows([])
    of = segments.system_track[np.maximum(segments.at(local[at], rows.time[at]), 0)]
    keep = alone[np.minimum(of, len(alone) - 1)] & (of < len(alone))
    return _taken(rows, at[keep])._replace(track_id=of[keep])


def _taken(rows: Rows, at: _Index) -> Rows:
    moments = Moments(*(column[at] for column in rows.moments))
    return Rows(moments=moments, **{n: getattr(rows, n)[at] for n in Rows._fields if n != "moments"})


def _anew(
    lanes: Lanes,
    alone: _Mask,
    scene: _Scene,
    lasting: float,
    rules: tuple[FilterSettings, TrackerSettings],
    periods: Sequence[float],
    *,
    use_identity: bool,
) -> Rows:
    """Filter the other system tracks."""
    (filters, settings), (m, rows) = rules, (scene.m, scene.rows)
    pick = ~alone[lanes.track] & np.isfinite(m.position[lanes.number, 0])
    lanes = Lanes(*(column[pick] for column in lanes))
    started = since(lanes.row >= 0, lanes.track)
    lanes = Lanes(*(column[started] for column in lanes))
    if not len(lanes.number):
        return join_rows([])
    index, begin = lanes.number, np.flatnonzero(is_first(lanes.piece))
    start = _start(rows, lanes, begin, m, scene.parts, scene.owner)
    several = in_several(lanes.piece, scene.owner[index])
    cov = (m.cov[index] + m.stamped(index, scene.velocity[index])) * m.inflation[index, None, None]
    cov[:, :2, :2] += several[:, None, None] * (0.5 * lasting**2 * np.eye(2) + scene.doubt[index])
    faulty = _faulty(m, index, settings) + (cov - m.cov[index])[:, None]
    lane = np.cumsum(is_first(lanes.piece)) - 1
    updates = LaneRows(lane, m.time[index], m.position[index], cov, faulty)
    every, measured = with_coasted(updates, lanes.track, shortest_periods(lanes, m, periods), settings)
    fused = fuse(every, start, filters, settings)
    return _published(every, measured, fused, lanes, m, rows, use_identity=use_identity)


def _start(rows: Rows, lanes: Lanes, begin: _Index, m: Measurements, parts: Sequence[Part], owner: _Index) -> Moments:
    """State of the local tracker at the first row of each lane, moved with the measurement it was made from."""
    row, index = lanes.row[begin], lanes.number[begin]
    raw, turn = np.empty((len(m), 2)), np.zeros(len(m))
    for k, part in enumerate(parts):
        own = np.flatnonzero(owner == k)  # in time order, as the part's, but for corrected times
        back = _same_plots(m.plot[own], part.m.plot)
        raw[own] = part.m.position[back, :2]
        if part.registered.found is not None:
            turn[own] = part.registered.found.series.at(part.m.time[back])[0][:, 2]
    mean = rows.moments.mean[row].copy()
    mean[:, [0, 2]] += m.position[index, :2] - raw[index]
    c, s = np.cos(turn[index]), np.sin(turn[index])
    vx, vy = mean[:, 1].copy(), mean[:, 3].copy()
    mean[:, 1], mean[:, 3] = c * vx - s * vy, s * vx + c * vy
    moments = rows.moments
    return Moments(mean, moments.cov[row], moments.p_manoeuvre_h[row], moments.p_manoeuvre_v[row])


def _same_plots(wanted: _Index, plots: _Index) -> _Index:
    order = np.argsort(plots, kind="stable")
    return np.asarray(order[np.searchsorted(plots[order], wanted)])


def _faulty(m: Measurements, index: _Index, settings: TrackerSettings) -> _Array:
    """Covariances of plots with either fault, (k, 2, 3, 3): of azimuth and range, or of the position, twice."""
    out = np.repeat(m.cov[index][:, None], 2, axis=1)
    polar = np.isfinite(m.ray[index, 0])
    for kind in (True, False):
        law: PlotLaw = plot_law(settings, polar=kind)
        at = np.flatnonzero(polar == kind)
        faults = np.flatnonzero((law.condition == 0) & (law.fault > 0))
        if len(at) and len(faults):
            out[at] = law.covariances(m, index[at], faults)
    return out


def _published(
    every: LaneRows,
    measured: _Index,
    fused: Fused,
    lanes: Lanes,
    m: Measurements,
    rows: Rows,
    *,
    use_identity: bool,
) -> Rows:
    at = np.maximum.accumulate(measured)  # the latest update; every lane begins with one
    seen = measured >= 0
    index, track = lanes.number[at], lanes.track[at]
    known = (lanes.row >= 0) & (rows.status[np.maximum(lanes.row, 0)] == CONFIRMED)
    sure = since(known, lanes.track)[at]
    status = np.where(seen, np.where(sure, CONFIRMED, TENTATIVE), COASTED)
    nu = every.position[:, :2] - fused.centre
    d2 = np.einsum("ki,kij,kj->k", nu, np.linalg.inv(fused.gate_cov), nu)
    wrong = fused.p_fault.sum(axis=1)
    d2[is_first(lanes.piece[at]) | ~seen | (np.nan_to_num(wrong) > 0.5)] = np.nan
    polar = np.isfinite(m.ray[index, 0])
    likeliest = np.where(polar & (fused.p_fault[:, -1] > fused.p_fault[:, 0]), 2, 1)
    nothing = np.full(len(lanes.number), -1)
    icao24, mode3a = (latest(c[lanes.number] if use_identity else nothing, lanes.track) for c in (m.icao24, m.mode3a))
    named = latest(np.where((m.callsign[lanes.number] != "") & use_identity, lanes.number, -1), lanes.track)[at]
    keep = seen | (sure & (every.time <= m.time.max()))  # neither a tentative track is coasted, nor any after the end
    out = Rows(
        track_id=track,
        time=every.time,
        moments=fused.moments,
        status=status.astype(np.int8),
        has_altitude=since(np.isfinite(m.position[lanes.number, 2]), lanes.track)[at],
        icao24=icao24[at].astype(np.int32),
        mode3a=mode3a[at].astype(np.int16),
        callsign=np.where(named >= 0, m.callsign[named], ""),
        measurement=np.where(seen, index, -1),
        source=np.where(seen, m.source[index], -1).astype(np.int32),
        lever=np.where(seen[:, None], m.lever[index], 0.0),
        centre=fused.centre,
        gate_cov=fused.gate_cov,
        d2=d2,
        p_fault=held(wrong, track),
        fault=np.where(seen & np.isfinite(wrong), likeliest, 0).astype(np.int8),
        p_degraded=np.full(len(at), np.nan),
        time_known=every.time,
    )
    return _taken(out, np.flatnonzero(keep))


def _assigned(parts: Sequence[Part], place: Sequence[_Index], of: _Index, rows: Rows) -> Assignments:
    """What became of every measurement; local tracks never confirmed get numbers behind those of system tracks."""
    track_id, n = of.copy(), len(of)
    split, elsewhere = np.zeros(n, bool), np.zeros(n, bool)
    above = int(of.max(initial=0))
    sources = list(parts[0].found.sources)
    for part, at in zip(parts, place, strict=True):
        split[at], elsewhere[at] = part.found.split, part.found.elsewhere
        rest = (of[at] == 0) & (part.found.track_id > 0)
        track_id[at[rest]] = above + part.found.track_id[rest]
        above += int(part.found.track_id.max(initial=0))
        for s in part.own.tolist():
            sources[s] = part.found.sources[s]
    return Assignments(track_id, split, elsewhere, np.unique(of[of > 0]), sources)
