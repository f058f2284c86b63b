"""Several systems in one run: local tracks of each, registration, identification, system tracks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa

from saltus.config import Config
from saltus.errors import ModelError
from saltus.geo import Plane
from saltus.identify import Decisions, Episodes, Evidence, join_evidence
from saltus.progress import Progress
from saltus.records import REASONS, Plots
from saltus.run.tracking import track_system
from saltus.summary import Sensors, Tracked
from saltus.tracks.identities import identify
from saltus.tracks.local import LocalSystem, Party, foreign_systems, group_sources, local_system
from saltus.tracks.measurements import make_plane
from saltus.tracks.membership import Segments, segments
from saltus.tracks.rows import join_rows
from saltus.tracks.settings import SystemsSettings
from saltus.tracks.system_tracks import Part, track_systems
from saltus.tracks.systems import Registered, lasting_difference, register_all

__all__ = ["Identified", "track_plots"]

_ELSEWHERE = REASONS.index("system track")  # for reports that are another system's in this pass


@dataclass(frozen=True, slots=True)
class Identified:
    """Who is whom in a run; local tracks are numbered through all systems in their order."""

    systems: list[LocalSystem]
    registered: list[Registered]
    segments: Segments  # system tracks are numbered as in the published rows
    decisions: Decisions
    evidence: Evidence


def track_plots(
    plots: Plots, foreign: pa.Table | None, sensors: Sensors, config: Config, bar: Progress, *, use_identity: bool
) -> tuple[Tracked, Identified]:
    """Track all systems of a recording.

    One system is the tracker alone. Several are tracked each by itself, put into one frame, told apart or found to be
    one, and published as system tracks.

    Args:
        plots: reports in time order; what cannot be used carries a reason.
        foreign: another centre's tracks, never part of a state.
        sensors: what is known of the sources.
        config: settings.
        bar: shows progress.
        use_identity: whether addresses and codes count.
    """
    plane = make_plane(plots, sensors.sites)
    parties = _parties(plots, sensors)
    tracked, local = [], []
    for party in parties:
        own = np.isin(plots.source, party.sources)
        elsewhere = (plots.reason == 0) & ~own
        part = replace(plots, reason=np.where(elsewhere, _ELSEWHERE, plots.reason).astype(plots.reason.dtype))
        found = track_system(part, plane, sensors, config, bar, use_identity=use_identity)
        tracked.append(found)
        m, rows = found.measurements, join_rows(found.rows)
        numbers = plots.local_id[m.plot]
        local.append(local_system(party.name, m, found.assignments, rows, numbers, use_identity=use_identity))
    if foreign is not None and len(foreign):
        local += _foreign(foreign, plane, config, plots, use_identity=use_identity)
    reference = _reference(config.systems.reference, parties, sensors, [system.name for system in local])
    if len(local) == 1:
        return tracked[0], _single(local[0])
    whole = _identified(local, replace(config.systems, reference=reference), config)
    return _joined(tracked, parties, whole, plane, sensors, config, use_identity=use_identity), whole


def _parties(plots: Plots, sensors: Sensors) -> list[Party]:
    """Return the systems that have usable reports."""
    used = np.unique(plots.source[plots.reason == 0])
    names, pooled = [str(s.system) for s in plots.sources], [s.traits.pooled for s in plots.sources]
    found = group_sources(names, pooled, sensors.told_systems)
    return [party for party in found if np.isin(party.sources, used).any()]


def _foreign(tracks: pa.Table, plane: Plane, config: Config, plots: Plots, *, use_identity: bool) -> list[LocalSystem]:
    """Another centre's tracks within the time of the reports."""
    time = tracks["time"].to_numpy(zero_copy_only=False)
    usable = plots.time[plots.reason == 0]
    inside = (time >= usable.min()) & (time <= usable.max())
    found = foreign_systems(
        tracks.filter(pa.array(inside)), plane, config.systems.track_sigma, use_identity=use_identity
    )
    return [system for system in found if len(system.ids)]


def _single(system: LocalSystem) -> Identified:
    """One system: every local track is a system track with the tracker's number."""
    tracks = system.view.tracks
    first = np.flatnonzero(np.diff(tracks.track, prepend=-1))
    last = np.append(first[1:], len(tracks.time)) - 1
    known = tracks.track[first] if len(first) else np.zeros(0, np.int64)
    ids = system.ids[known]
    lives = Segments(
        known, tracks.time[first], tracks.time[last] if len(first) else np.zeros(0), ids, np.ones(len(ids))
    )
    none = np.zeros(0)
    nobody = Episodes(none.astype(np.int64), none.astype(np.int64), none, none, none)
    return Identified([system], [Registered(system.name, "", None)], lives, Decisions(nobody, ()), join_evidence([]))


def _reference(told: str, parties: Sequence[Party], sensors: Sensors, systems: Sequence[str]) -> str:
    """Return the system that the configuration calls its reference, by its name or that of one of its sensors."""
    if not told or told in systems:
        return told
    of_sensor = {sensors.names[s]: party.name for party in parties for s in party.sources}
    if told not in of_sensor:
        known = ", ".join(dict.fromkeys([*systems, *of_sensor]))
        raise ModelError(f"systems.reference = {told!r} names none of the systems in the inputs: {known}.")
    return of_sensor[told]


def _identified(local: Sequence[LocalSystem], settings: SystemsSettings, config: Config) -> Identified:
    registered, how = register_all(local, settings, config.registration)
    decisions, evidence = identify(registered, how, settings, config.filter)
    begin, end = [], []
    for system in local:
        tracks = system.view.tracks
        first = np.searchsorted(tracks.track, np.arange(len(system.ids)))
        last = np.searchsorted(tracks.track, np.arange(len(system.ids)), side="right") - 1
        begin.append(tracks.time[first])
        end.append(tracks.time[last])
    ready = np.concatenate([s.ready for s in local])
    foreign = np.repeat([not s.own for s in local], [len(s.ids) for s in local])
    lives = segments(
        np.concatenate(begin), ready, np.concatenate(end), decisions.episodes, settings.settle, foreign=foreign
    )
    return Identified(registered, how, lives, decisions, evidence)


def _joined(
    tracked: Sequence[Tracked],
    parties: Sequence[Party],
    whole: Identified,
    plane: Plane,
    sensors: Sensors,
    config: Config,
    *,
    use_identity: bool,
) -> Tracked:
    parts = [
        Part(system, how, t.measurements, t.assignments, join_rows(t.rows), np.array(party.sources))
        for system, how, t, party in zip(whole.systems, whole.registered, tracked, parties, strict=False)
    ]
    lasting = max(
        [lasting_difference(a, b) for a in whole.registered for b in whole.registered if a is not b], default=0.0
    )
    found = track_systems(
        parts, whole.segments, lasting, config.filter, config.tracker, sensors.waits, use_identity=use_identity
    )
    noise, estimates = dict(tracked[0].noise), dict(tracked[0].estimates)
    for party, t in zip(parties, tracked, strict=True):
        noise |= {s: t.noise[s] for s in party.sources}
        estimates |= {s: t.estimates[s] for s in party.sources}
    return Tracked([found.rows], found.measurements, found.assignments, plane, noise, estimates)
