"""What is known after the end: a function of the journal and the setup."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.engine.figures import Figures, RunFigures
from saltus.engine.identified import (
    Identified,
    bias_tables,
    identification_table,
    identify,
    local_systems,
    refuse_reference,
    trusted,
)
from saltus.engine.journal import Journal
from saltus.engine.live import Heard
from saltus.engine.outcome import Outcome, outcome
from saltus.engine.replay import rows_of
from saltus.engine.setup import Setup
from saltus.engine.spool import InOrder, Place, Spool, Stored
from saltus.engine.states import FusedStates, LocalStates
from saltus.engine.tally import Tally, tally
from saltus.records import Plots
from saltus.tracks.faults import History, plot_law
from saltus.tracks.health import Health
from saltus.tracks.local import Party
from saltus.tracks.measurements import Measurements
from saltus.tracks.noise import estimate_noise
from saltus.tracks.output import innovation_table, track_table
from saltus.tracks.rows import ConditionFound, Fates, Rows, Tracked, assignments, join_rows

__all__ = ["Result", "finished", "heard_so_far", "order_of_systems"]

_Index = npt.NDArray[np.int64]

_AT_ONCE = 1 << 14  # rows made into a table at a time


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """Tables and findings of a session; the long tables lie in files and are mapped into memory."""

    tracks: pa.Table  # columns of tracks.parquet
    assignments: pa.Table  # columns of assignments.parquet, one row for each report in order of arrival
    identifications: pa.Table  # columns of identifications.parquet
    biases: dict[str, Any]  # as in biases.json
    health: dict[str, Any]
    gates: pa.Table  # of the updates, for the report
    reason: npt.NDArray[np.int8]  # of each report, index into `records.REASONS`
    setup: Setup
    whole: Identified
    outcome: Outcome
    figures: Figures
    conditions: Sequence[ConditionFound]  # of each source
    span: tuple[float, float]  # first and last time of the reports placed, s
    stored: Mapping[str, Stored]  # `tracks` and `assignments`, to be read batch by batch

    def sensors(self) -> list[Health]:
        """Return the faults of each source over time."""
        return self.figures.health([sensor.name for sensor in self.setup.sensors], self.conditions)


def finished(journal: Journal, setup: Setup, files: Sequence[str], health: dict[str, Any]) -> Result:
    """Make the tables of a session that has ended, in memory that holds some bytes of each report.

    Args:
        journal: everything that became known.
        setup: its last version.
        files: names of the files that reports came from.
        health: as told last.
    """
    told, place = tally(journal, setup), Place()
    whole = identify(journal, setup, told)
    states: LocalStates | FusedStates = LocalStates(journal, told, _conditions(journal, setup))
    if len(whole.systems) > 1:
        states = FusedStates(journal, setup, told, whole)
    setup = _with_estimates(setup, journal, told)
    figures, tracks, gates = _written(states, setup, place)
    sources = tuple(s.source for s in setup.sensors)
    became = outcome(journal, told, states.track, sources, files, place)
    return Result(
        tracks=tracks.table(),
        assignments=became.stored.table(),
        identifications=identification_table(whole),
        biases=bias_tables(whole),
        health=health,
        gates=gates.table(),
        reason=told.reason,
        setup=setup,
        whole=whole,
        outcome=became,
        figures=figures,
        conditions=states.conditions,
        span=states.span,
        stored={"tracks": tracks, "assignments": became.stored},
    )


def _written(states: LocalStates | FusedStates, setup: Setup, place: Place) -> tuple[Figures, Stored, Stored]:
    """Write the rows of tracks that were confirmed at some time, as they became known, and their gates."""
    names, config = [str(s.source.system) for s in setup.sensors], setup.config
    figures, order = RunFigures(len(names), place), InOrder(_AT_ONCE)
    tracks, gates = Spool(place, "tracks"), Spool(place, "gates")

    def write(rows: Rows) -> None:
        tracks.write(track_table(rows, setup.plane, config.tracker.sigma_pressure))
        gates.write(innovation_table(rows, setup.plane, names))

    for rows, published, before in states:
        figures.add(rows, published)
        for batch in order.add(rows.take(published), before):
            write(batch)
    for batch in order.end():
        write(batch)
    return figures.found(), tracks.stored(), gates.stored()


def heard_so_far(journal: Journal, setup: Setup) -> list[tuple[int, Heard]]:
    """Return the measurements and rows of each system, by its first source."""
    reports = journal.all("reports") or {"local_id": np.zeros(0, np.int64)}
    out = []
    for party in setup.parties():
        placed = [_chosen(part, np.isin(part["source"], party.sources)) for part in journal.parts("plots")]
        if any(len(part["plot"]) for part in placed):
            m, own = Measurements.join([Measurements(**part) for part in placed]), party.sources[0]
            rows = join_rows([rows_of(p, p["system"] == own) for p in journal.parts("rows")])
            out.append((own, Heard(m, np.asarray(reports["local_id"], np.int64)[m.plot], rows)))
    return out


def order_of_systems(journal: Journal, setup: Setup, files: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the systems heard so far, the reference first, the most trusted next.

    Raises:
        ModelError: the configured reference is none of them.
    """
    plots, tracked, foreign = _reports(journal, setup, files), _all_tracked(journal, setup), journal.all("foreign")
    local = local_systems(setup, tracked, plots, None if foreign is None else pa.table(foreign))
    refuse_reference(setup, [system.name for system in local])
    return trusted(setup, local)


def _all_tracked(journal: Journal, setup: Setup) -> dict[Party, Tracked]:
    parties = [p for p in setup.parties() if any(setup.sensors[s].heard for s in p.sources)]
    return {party: t for party in parties if (t := _tracked(journal, setup, party)) is not None}


def _with_estimates(setup: Setup, journal: Journal, told: Tally) -> Setup:
    """Estimate, to be told, the noise of sources whose noise was not learnt: configured, or they appeared later."""
    sensors = list(setup.sensors)
    ever = {s: p.ever for p in told.parties for s in p.party.sources if not sensors[s].estimate.n_windows}
    found: dict[int, list[Measurements]] = {s: [] for s in ever}
    missing = dict.fromkeys(ever, setup.config.setup.estimated)
    for part in journal.parts("plots") if ever else ():
        m = Measurements(**part)
        for s in [s for s, n in missing.items() if n]:
            own = np.flatnonzero(m.source == s)[: missing[s]]
            found[s].append(m.take(own))
            missing[s] -= len(own)
        if not any(missing.values()):
            break
    for s, parts in found.items():
        m = Measurements.join(parts)
        track = told.track[m.plot].astype(np.int64)
        estimate = estimate_noise(m, np.where(np.isin(track, ever[s]), track, 0), s)
        sensors[s] = replace(sensors[s], estimate=estimate)
    return replace(setup, sensors=tuple(sensors))


def _reports(journal: Journal, setup: Setup, files: Sequence[str]) -> Plots:
    """All reports, as far as the journal has them, with the reasons why some were not used."""
    columns = journal.all("reports") or {}
    refused = journal.all("refused")
    if refused is not None:
        columns["reason"][refused["plot"]] = refused["reason"]
    n = len(columns.get("time", ()))
    return Plots.build(n, tuple(s.source for s in setup.sensors), tuple(files), columns)


def _tracked(journal: Journal, setup: Setup, party: Party) -> Tracked | None:
    """What the tracker of one system did; None where it was given nothing."""
    placed = [_chosen(part, np.isin(part["source"], party.sources)) for part in journal.parts("plots")]
    m = Measurements.join([Measurements(**part) for part in placed])
    if not len(m):
        return None
    own = party.sources[0]
    rows = join_rows([rows_of(p, p["system"] == own) for p in journal.parts("rows")])
    place = np.full(int(m.plot.max()) + 1, -1)
    place[m.plot] = np.arange(len(m))
    rows = rows._replace(measurement=np.where(rows.measurement >= 0, place[rows.measurement], -1))
    found = assignments(m.plot, _fates(journal, own), [_confirmed(journal, own)], _conditions(journal, setup))
    return Tracked([rows], m, found)


def _fates(journal: Journal, own: int) -> Fates:
    number, which = np.zeros(0, np.int64), np.zeros(0, bool)
    none = Fates(number, number, which, which)  # amid a recording nothing may be known yet
    parts = [_chosen(p, p["system"] == own) for p in journal.parts("fates")]
    told = [none, *(Fates(*(p[name] for name in Fates._fields)) for p in parts)]
    return Fates(*(np.concatenate(column) for column in zip(*told, strict=True)))


def _confirmed(journal: Journal, own: int) -> _Index:
    parts = [p["track_id"][p["system"] == own] for p in journal.parts("confirmed")]
    return np.concatenate([np.zeros(0, np.int64), *parts])


def _conditions(journal: Journal, setup: Setup) -> list[ConditionFound]:
    told = journal.all("conditions")
    out = []
    for s, sensor in enumerate(setup.sensors):
        law = plot_law(setup.config.tracker, sensor.kind)
        q, at = len(law.degraded), np.zeros(0, np.int64) if told is None else np.flatnonzero(told["source"] == s)
        time, probs = (np.zeros(0), np.zeros((0, q))) if told is None else (told["time"][at], told["probs"][at, :q])
        out.append(ConditionFound(law, History(time, probs)))
    return out


def _chosen(columns: dict[str, npt.NDArray[Any]], keep: npt.NDArray[np.bool_]) -> dict[str, npt.NDArray[Any]]:
    return {name: values[keep] for name, values in columns.items()}
