"""Who is whom among several systems: local tracks registered, identified, joined into system tracks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.config import Config
from saltus.engine.setup import Setup
from saltus.errors import ModelError
from saltus.identify import Decisions, Episodes, Evidence, join_evidence
from saltus.records import Plots
from saltus.tracks.bias import PARAMETERS
from saltus.tracks.identities import identify
from saltus.tracks.local import LocalSystem, Party, foreign_systems, local_system
from saltus.tracks.membership import Segments, segments
from saltus.tracks.rows import Tracked, join_rows
from saltus.tracks.settings import SystemsSettings
from saltus.tracks.system_tracks import Part, track_systems
from saltus.tracks.systems import Registered, lasting_difference, register_all

__all__ = ["Identified", "bias_tables", "identification_table", "published_tracks", "together"]


@dataclass(frozen=True, slots=True)
class Identified:
    """Who is whom in a run; local tracks are numbered through all systems in their order."""

    systems: list[LocalSystem]
    registered: list[Registered]
    segments: Segments  # system tracks are numbered as in the published rows
    decisions: Decisions
    evidence: Evidence


def together(
    setup: Setup, tracked: Mapping[Party, Tracked], plots: Plots, foreign: pa.Table | None
) -> tuple[Identified, Tracked]:
    """Put what the trackers of all systems found together.

    One system is its tracker alone. Several are put into one frame, told apart or found to be one, and published as
    system tracks.

    Args:
        setup: of all sources.
        tracked: what each system's tracker found.
        plots: all reports; `Measurements.plot` are places in it.
        foreign: another centre's tracks, never part of a state.
    """
    use_identity, config = setup.use_identity, setup.config
    local = [
        local_system(
            party.name,
            t.measurements,
            t.assignments,
            join_rows(t.rows),
            plots.local_id[t.measurements.plot],
            use_identity=use_identity,
        )
        for party, t in tracked.items()
    ]
    if foreign is not None and len(foreign):
        local += _foreign(foreign, setup, plots)
    reference = _reference(setup, list(tracked), [system.name for system in local])
    if len(local) == 1:
        return _single(local[0]), next(iter(tracked.values()))
    whole = _identified(local, replace(config.systems, reference=reference), config)
    return whole, _joined(tracked, whole, setup)


def _foreign(tracks: pa.Table, setup: Setup, plots: Plots) -> list[LocalSystem]:
    """Another centre's tracks within the time of the reports."""
    time = tracks["time"].to_numpy(zero_copy_only=False)
    usable = plots.time[plots.reason == 0]
    inside = (time >= usable.min()) & (time <= usable.max())
    found = foreign_systems(
        tracks.filter(pa.array(inside)), setup.plane, setup.config.systems.track_sigma, use_identity=setup.use_identity
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


def _reference(setup: Setup, parties: Sequence[Party], systems: Sequence[str]) -> str:
    """Return the system that the configuration calls its reference, by its name or that of one of its sensors."""
    told = setup.config.systems.reference
    if not told or told in systems:
        return told
    of_sensor = {setup.sensors[s].name: party.name for party in parties for s in party.sources}
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


def _joined(tracked: Mapping[Party, Tracked], whole: Identified, setup: Setup) -> Tracked:
    parts = [
        Part(system, how, t.measurements, t.assignments, join_rows(t.rows), np.array(party.sources))
        for system, how, (party, t) in zip(whole.systems, whole.registered, tracked.items(), strict=False)
    ]
    lasting = max(
        [lasting_difference(a, b) for a in whole.registered for b in whole.registered if a is not b], default=0.0
    )
    waits, config = [s.wait for s in setup.sensors], setup.config
    found = track_systems(
        parts, whole.segments, lasting, config.filter, config.tracker, waits, use_identity=setup.use_identity
    )
    return Tracked([found.rows], found.measurements, found.assignments)


def identification_table(whole: Identified) -> pa.Table:
    """Return one row for each stretch of time in which a system's local track was part of a system track.

    The first local track of a system track has probability 1; another one that with which it was declared the same
    object.
    """
    s = whole.segments
    names = np.repeat([x.name for x in whole.systems], [len(x.ids) for x in whole.systems])
    labels = [label for x in whole.systems for label in x.local_id]
    order = np.lexsort((s.time_from, s.system_track))
    order = order[np.isin(s.system_track[order], published_tracks(whole))]
    return pa.table(
        {
            "track_id": pa.array(s.system_track[order], pa.int64()),
            "system": pa.array([str(names[k]) for k in s.track[order]], pa.string()),
            "local_id": pa.array([labels[k] or None for k in s.track[order]], pa.string()),
            "time_from": pa.array(s.time_from[order], pa.float64()),
            "time_to": pa.array(s.time_to[order], pa.float64()),
            "probability": pa.array(s.probability[order], pa.float64()),
        }
    )


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
