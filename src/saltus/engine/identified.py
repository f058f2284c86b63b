"""Who is whom among several systems: local tracks registered, identified, joined into system tracks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.engine.distances import Distances
from saltus.engine.journal import Journal
from saltus.engine.replay import replayed
from saltus.engine.setup import Setup
from saltus.engine.tally import PartyTally, Tally
from saltus.errors import ModelError
from saltus.identify import Decisions, Episodes, Evidence, LocalTracks, join_evidence
from saltus.records import Plots
from saltus.tracks.bias import PARAMETERS
from saltus.tracks.local import LocalSystem, Party, foreign_systems, local_system
from saltus.tracks.membership import Change, Merger, Segments
from saltus.tracks.picture import Picture
from saltus.tracks.rows import Tracked, join_rows
from saltus.tracks.systems import Registered, order_of_trust
from saltus.tracks.window import Window

__all__ = [
    "IDENTIFICATIONS",
    "Identified",
    "SystemNames",
    "bias_tables",
    "identification_table",
    "identify",
    "local_systems",
    "published_tracks",
    "refuse_reference",
    "trusted",
]


_TEXT, _NUMBER, _TIME = pa.string(), pa.int64(), pa.float64()
IDENTIFICATIONS = pa.schema(
    {
        "track_id": _NUMBER,
        "system": _TEXT,
        "local_id": _TEXT,
        "time_from": _TIME,
        "time_to": _TIME,
        "probability": _TIME,
        "time_known": _TIME,
        "merged_into": _NUMBER,
    }
)


class SystemNames(NamedTuple):
    """A system's confirmed local tracks; arrays are (K,)."""

    name: str
    own: bool  # whether there are measurements, and not another centre's tracks alone
    ids: npt.NDArray[np.int64]  # the local tracker's number of each
    local_id: tuple[str, ...]  # the system's own number or address of each, "" none
    address: npt.NDArray[np.int64]  # -1 none
    end: npt.NDArray[np.float64]  # last report of each, s


@dataclass(frozen=True, slots=True)
class Identified:
    """Who is whom in a run; local tracks are numbered through all systems in their order."""

    systems: list[SystemNames]
    registered: list[Registered]
    segments: Segments  # system tracks are numbered as in the published rows
    mergers: Sequence[Merger]  # numbers of the running picture that are not used any more
    changes: Sequence[Change]
    decisions: Decisions
    evidence: Evidence
    apart: Mapping[tuple[int, int, int], float]  # m between two systems' positions of one address: median
    told_every: int = 1  # of so many looks `evidence` tells one


def identify(journal: Journal, setup: Setup, told: Tally) -> Identified:
    """Find out who is whom among several systems: each look sees what was known by then; one system is itself.

    Args:
        journal: of a session that has ended.
        setup: of all sources.
        told: of the journal.
    """
    foreign = journal.all("foreign")
    centres = [] if foreign is None else _foreign(pa.table(foreign), setup, told.span)
    names = [party_names(p, setup) for p in told.parties] + [_centre_names(x) for x in centres]
    refuse_reference(setup, [x.name for x in names])
    if len(names) == 1:
        return _single(names[0], told.parties[0])
    windows = [Window(p.party.name, p.ids, p.ready, use_identity=setup.use_identity) for p in told.parties]
    picture, distances = _picture(names, [p.party for p in told.parties], setup), Distances([x.address for x in names])
    looks = _Looks(picture, windows, centres, setup.config.systems.every)
    for stretch in replayed(journal, told, states=False):
        for window, reported in zip(windows, stretch.systems, strict=True):
            window.take(reported)
        distances.add([*(w.latest for w in windows), *(_rows_until(x, stretch.until) for x in centres)])
        looks.until(stretch.until)
    looks.end()
    return _found(names, picture, distances.medians())


def party_names(told: PartyTally, setup: Setup) -> SystemNames:
    """Return what the local tracks of a system with measurements are called."""
    hidden = np.full(len(told.ids), -1)
    label = tuple(
        f"{c:06X}" if c >= 0 else str(n) if n >= 0 else ""
        for c, n in zip(told.names.icao24.tolist(), told.names.local_id.tolist(), strict=True)
    )
    address = told.names.icao24 if setup.use_identity else hidden
    return SystemNames(told.party.name, True, told.ids, label, address, told.end)


def _centre_names(x: LocalSystem) -> SystemNames:
    tracks = x.view.tracks
    last = np.append(np.flatnonzero(np.diff(tracks.track)), len(tracks.track) - 1)
    return SystemNames(x.name, x.own, x.ids, x.local_id, x.view.icao24, tracks.time[last])


class _Looks:
    """Looks at several systems, every so many seconds, from the first report known to the last."""

    def __init__(self, picture: Picture, windows: Sequence[Window], centres: Sequence[LocalSystem], every: float):
        self._picture, self._windows, self._centres, self._every = picture, windows, centres, every
        known = [x.known for x in centres if len(x.known)]
        self._first = min((float(k.min()) for k in known), default=np.inf)
        self._last = max((float(k.max()) for k in known), default=-np.inf)
        self._next: float | None = None
        self._before = -np.inf  # s: of the last look

    def until(self, time: float) -> None:
        """Do those for which everything is known, where nothing to come is earlier than a time, s."""
        spans = [window.known for window in self._windows]
        first = min(self._first, *(span[0] for span in spans))
        last = max(self._last, *(span[1] for span in spans))
        if self._next is None:
            if first > time or not np.isfinite(first):
                return
            self._next = float(np.floor(first / self._every)) + 1.0
        while (self._next * self._every < time) and self._next <= np.floor(last / self._every):
            now, since = self._next * self._every, self._next * self._every - self._picture.kept
            self._picture.look(now, self._systems(now, since))
            for window in self._windows:
                window.forget(since, now)
            self._before, self._next = now, self._next + 1.0

    def end(self) -> None:
        """Do the rest, and number the tracks confirmed since the last one."""
        self.until(np.inf)
        self._picture.close(self._systems(np.inf, np.inf))

    def _systems(self, now: float, since: float) -> list[LocalSystem]:
        return [*(window.system(now, since, self._before) for window in self._windows), *self._centres]


def local_systems(
    setup: Setup, tracked: Mapping[Party, Tracked], plots: Plots, foreign: pa.Table | None
) -> list[LocalSystem]:
    """Return the local tracks of all systems, another centre's behind those with measurements."""
    local = [
        local_system(
            party.name,
            t.measurements,
            t.assignments,
            join_rows(t.rows),
            plots.local_id[t.measurements.plot],
            use_identity=setup.use_identity,
        )
        for party, t in tracked.items()
    ]
    if foreign is None or not len(foreign):
        return local
    usable = plots.time[plots.reason == 0]
    return local + _foreign(foreign, setup, (float(usable.min()), float(usable.max())))


def _foreign(tracks: pa.Table, setup: Setup, span: tuple[float, float]) -> list[LocalSystem]:
    """Another centre's tracks within the time of the reports."""
    time = tracks["time"].to_numpy(zero_copy_only=False)
    inside = (time >= span[0]) & (time <= span[1])
    found = foreign_systems(
        tracks.filter(pa.array(inside)), setup.plane, setup.config.systems.track_sigma, use_identity=setup.use_identity
    )
    return [system for system in found if len(system.ids)]


def _rows_until(x: LocalSystem, time: float) -> LocalTracks:
    """Return the rows of a centre's tracks up to a time."""
    keep = x.view.tracks.time <= time
    return LocalTracks(*(column[keep] for column in x.view.tracks))


def _single(names: SystemNames, told: PartyTally) -> Identified:
    """One system: every local track is a system track with the tracker's number."""
    ids = told.ids
    lives = Segments(np.arange(len(ids)), told.begin, told.end, ids, np.ones(len(ids)), told.ready)
    none = np.zeros(0)
    nobody = Episodes(none.astype(np.int64), none.astype(np.int64), none, none, none, none, none)
    alone = [Registered(names.name, "", None)]
    return Identified([names], alone, lives, (), (), Decisions(nobody, ()), join_evidence([]), {})


def refuse_reference(setup: Setup, systems: Sequence[str]) -> None:
    """Refuse a reference that is none of the systems, those of the setup and others named.

    Raises:
        ModelError: it names none.
    """
    told = setup.config.systems.reference
    known = dict.fromkeys([*(p.name for p in setup.parties()), *systems, *(s.name for s in setup.sensors)])
    if told and told not in known:
        raise ModelError(f"systems.reference = {told!r} names none of the systems in the inputs: {', '.join(known)}.")


def trusted(setup: Setup, systems: Sequence[LocalSystem]) -> tuple[str, ...]:
    """Return the names of systems, the reference first, the most trusted next."""
    told = setup.config.systems.reference
    of_sensor = {setup.sensors[s].name: party.name for party in setup.parties() for s in party.sources}
    names = [system.name for system in systems]
    order = order_of_trust(systems, told if told in names else of_sensor.get(told, told))
    return tuple(names[k] for k in order)


def _picture(systems: Sequence[SystemNames], parties: Sequence[Party], setup: Setup) -> Picture:
    config, names = setup.config, [system.name for system in systems]
    order = sorted(range(len(names)), key=lambda k: setup.order.index(names[k]) if names[k] in setup.order else np.inf)
    periods = [min(setup.sensors[s].period for s in p.sources if setup.sensors[s].heard) for p in parties]
    periods += [config.systems.track_memory] * (len(names) - len(parties))
    return Picture(names, order, periods, config.systems, config.registration, config.filter)


def _found(systems: list[SystemNames], picture: Picture, apart: Mapping[tuple[int, int, int], float]) -> Identified:
    """Return what a picture found, with local tracks numbered through all systems in their order."""
    first = np.cumsum([0, *(len(system.ids) for system in systems)])
    place = {(k, own): first[k] + at for k, s in enumerate(systems) for at, own in enumerate(s.ids.tolist())}
    number = np.array([place[key] for key in picture.number], np.int64)
    end = np.concatenate([system.end for system in systems])
    members, decisions, evidence = picture.membership, picture.decisions(), picture.evidence()
    lives = members.segments(end[number])
    order = np.lexsort((lives.time_from, number[lives.track])) if len(lives.track) else np.zeros(0, np.int64)
    e = decisions.episodes
    return Identified(
        systems,
        picture.registered(),
        Segments(*(column[order] for column in lives._replace(track=number[lives.track]))),
        [m._replace(track=int(number[m.track])) for m in members.mergers],
        members.changes,
        Decisions(
            e._replace(a=number[e.a], b=number[e.b]),
            tuple(c._replace(a=int(number[c.a]), b=int(number[c.b])) for c in decisions.conflicts),
        ),
        evidence._replace(pairs=number[evidence.pairs]),
        apart,
        picture.told_every,
    )


class _Stretches(NamedTuple):
    """Columns of identifications, before they have names."""

    track_id: npt.NDArray[np.int64]
    local: npt.NDArray[np.int64]
    time_from: npt.NDArray[np.float64]
    time_to: npt.NDArray[np.float64]
    probability: npt.NDArray[np.float64]
    time_known: npt.NDArray[np.float64]
    merged_into: npt.NDArray[np.int64]  # 0: into none


def identification_table(whole: Identified) -> pa.Table:
    """Return one row for each stretch of time in which a system's local track was part of a system track.

    The local track that names a system track has probability 1; another one that with which it was declared the same
    object. A system track that was found to be another one has rows that say which, and when that became known.
    """
    found = _Stretches._make(np.concatenate(column) for column in zip(_held(whole), _merged(whole), strict=True))
    order = np.lexsort((found.time_from, found.track_id, found.time_known))
    found = _Stretches._make(column[order] for column in found)
    names = np.repeat([x.name for x in whole.systems], [len(x.ids) for x in whole.systems])
    labels = [label for x in whole.systems for label in x.local_id]
    return pa.table(
        [
            found.track_id,
            [str(names[k]) for k in found.local],
            [labels[k] or None for k in found.local],
            *(found.time_from, found.time_to, found.probability, found.time_known),
            pa.array(found.merged_into, pa.int64(), mask=found.merged_into == 0),
        ],
        schema=IDENTIFICATIONS,
    )


def _held(whole: Identified) -> _Stretches:
    """What holds in the end."""
    s = whole.segments
    at = np.flatnonzero(np.isin(s.system_track, published_tracks(whole)))
    columns = (s.system_track, s.track, s.time_from, s.time_to, s.probability, s.time_known)
    return _Stretches._make([*(column[at] for column in columns), np.zeros(len(at), np.int64)])


def _merged(whole: Identified) -> _Stretches:
    """Numbers of the running picture that were given up."""
    foreign = np.repeat([not x.own for x in whole.systems], [len(x.ids) for x in whole.systems])
    end = {int(k): float(t) for k, t in zip(whole.segments.track, whole.segments.time_to, strict=True)}  # of the last
    rows = [
        (m.number, m.track, m.time_from, max(m.time_from, min(m.known, end[m.track])), 1.0, m.known, m.into)
        for m in whole.mergers
        if not foreign[m.track]
    ]
    kinds = (np.int64, np.int64, *(np.float64,) * 4, np.int64)
    columns = zip(*rows, strict=True) if rows else ((),) * len(kinds)
    return _Stretches._make(np.array(column, kind) for column, kind in zip(columns, kinds, strict=True))


def published_tracks(whole: Identified) -> npt.NDArray[np.int64]:
    """Return the system tracks that hold measurements, and not another centre's tracks alone."""
    own = np.repeat([x.own for x in whole.systems], [len(x.ids) for x in whole.systems])
    return np.unique(whole.segments.system_track[own[whole.segments.track]]) if len(own) else np.zeros(0, np.int64)


def bias_tables(whole: Identified) -> dict[str, Any]:
    """Return every system's biases against the reference: reported minus true, as of the end.

    `series` holds the estimates over time, each from what was known then.
    """
    reference = next(r.name for r in whole.registered if r.found is None)
    return {
        "convention": "value = reported minus true; true is what the system named in relative_to says",
        "reference": reference,
        "systems": {r.name: biases(r) for r in whole.registered if r.found is not None},
    }


def biases(r: Registered) -> dict[str, Any]:
    """Return what was found of one system's biases."""
    found = r.found
    if found is None:
        return {}
    series = found.series
    table: dict[str, Any] = {"relative_to": r.to, "compared_with": r.by, "common_objects": 0, "biases": {}}
    table["not_estimated"] = found.not_estimated
    if not len(series.time):
        return table | {"series": []}
    table["common_objects"] = int(series.objects[-1])
    table["scatter_between_objects_m"] = _rounded(series.scatter[-1])
    table["excess_within_objects_m"] = _rounded(found.excess_sd)
    table["biases"] = _values(series.mean[-1], series.cov[-1], series.estimated[-1])
    table["series"] = [
        {"time": float(t), "common_objects": int(n), **_values(mean, cov, known)}
        for t, n, mean, cov, known in zip(
            series.time, series.objects, series.mean, series.cov, series.estimated, strict=True
        )
    ]
    return table


def _values(
    mean: npt.NDArray[np.float64], cov: npt.NDArray[np.float64], known: npt.NDArray[np.bool_]
) -> dict[str, Any]:
    out = {}
    for k in np.flatnonzero(known):
        name, scale = PARAMETERS[k], 1.0
        if name == "azimuth_rad":
            name, scale = "azimuth_deg", float(180.0 / np.pi)
        out[name] = {"value": _rounded(mean[k] * scale), "sd": _rounded(float(np.sqrt(cov[k, k])) * scale)}
    return out


def _rounded(value: float) -> float | None:
    return float(f"{value:.4g}") if np.isfinite(value) else None
