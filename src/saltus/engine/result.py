"""What is known after the end: a function of the journal and the setup."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.engine.identified import (
    Identified,
    bias_tables,
    identification_table,
    local_systems,
    refuse_reference,
    together,
    trusted,
)
from saltus.engine.journal import Journal
from saltus.engine.live import Heard
from saltus.engine.setup import Setup
from saltus.records import Plots
from saltus.tracks.faults import History, plot_law
from saltus.tracks.kinematics import Moments
from saltus.tracks.local import Party
from saltus.tracks.measurements import Measurements
from saltus.tracks.noise import estimate_noise
from saltus.tracks.output import assignment_table, innovation_table, track_table
from saltus.tracks.rows import ConditionFound, Fates, Rows, Tracked, assignments, join_rows

__all__ = ["Result", "finished", "heard_so_far", "order_of_systems"]

_Index = npt.NDArray[np.int64]

_AT_ONCE = 50_000  # rows made into a table at a time


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """Tables and findings of a session."""

    tracks: pa.Table  # columns of tracks.parquet
    assignments: pa.Table  # columns of assignments.parquet, one row for each report in order of arrival
    identifications: pa.Table  # columns of identifications.parquet
    biases: dict[str, Any]  # as in biases.json
    health: dict[str, Any]
    gates: pa.Table  # of the updates, for the report
    reason: npt.NDArray[np.int8]  # of each report, index into `records.REASONS`
    setup: Setup
    tracked: Tracked
    whole: Identified


def finished(journal: Journal, setup: Setup, files: Sequence[str], health: dict[str, Any]) -> Result:
    """Make the tables of a session that has ended.

    Args:
        journal: everything that became known.
        setup: its last version.
        files: names of the files that reports came from.
        health: as told last.
    """
    plots, tracked = _reports(journal, setup, files), _all_tracked(journal, setup)
    foreign = journal.all("foreign")
    whole, joined = together(setup, tracked, plots, None if foreign is None else pa.table(foreign))
    setup = _with_estimates(setup, tracked)
    tracks, gates = _tables(joined, setup)
    return Result(
        tracks=tracks,
        assignments=assignment_table(plots, joined.measurements, joined.assignments),
        identifications=identification_table(whole),
        biases=bias_tables(whole),
        health=health,
        gates=gates,
        reason=plots.reason,
        setup=setup,
        tracked=joined,
        whole=whole,
    )


def heard_so_far(journal: Journal, setup: Setup) -> list[tuple[int, Heard]]:
    """Return the measurements and rows of each system, by its first source."""
    reports = journal.all("reports") or {"local_id": np.zeros(0, np.int64)}
    out = []
    for party in setup.parties():
        placed = [_chosen(part, np.isin(part["source"], party.sources)) for part in journal.parts("plots")]
        if any(len(part["plot"]) for part in placed):
            m, own = Measurements.join([Measurements(**part) for part in placed]), party.sources[0]
            rows = join_rows([_rows(_chosen(p, p["system"] == own)) for p in journal.parts("rows")])
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


def _with_estimates(setup: Setup, tracked: Mapping[Party, Tracked]) -> Setup:
    """Estimate, to be told, the noise of sources whose noise was not learnt: configured, or they appeared later."""
    sensors = list(setup.sensors)
    for party, t in tracked.items():
        found = t.assignments
        track = np.where(np.isin(found.track_id, found.confirmed), found.track_id, 0)
        for s in (s for s in party.sources if not sensors[s].estimate.n_windows):
            sensors[s] = replace(sensors[s], estimate=estimate_noise(t.measurements, track, s))
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
    rows = join_rows([_rows(_chosen(p, p["system"] == own)) for p in journal.parts("rows")])
    place = np.full(int(m.plot.max()) + 1, -1)
    place[m.plot] = np.arange(len(m))
    rows = rows._replace(measurement=np.where(rows.measurement >= 0, place[rows.measurement], -1))
    found = assignments(m.plot, _fates(journal, own), [_confirmed(journal, own)], _conditions(journal, setup))
    return Tracked([rows], m, found)


def _rows(columns: dict[str, npt.NDArray[Any]]) -> Rows:
    moments = Moments(*(columns[name] for name in Moments._fields))
    return Rows(moments=moments, **{name: columns[name] for name in Rows._fields if name != "moments"})


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


def _tables(tracked: Tracked, setup: Setup) -> tuple[pa.Table, pa.Table]:
    """Return the rows of tracks that were confirmed at some time, as they became known, and their gates."""
    rows = join_rows(tracked.rows)
    names = [str(s.source.system) for s in setup.sensors]
    at = np.flatnonzero(np.isin(rows.track_id, tracked.assignments.confirmed))
    at = at[np.lexsort((rows.time[at], rows.track_id[at], rows.time_known[at]))]
    parts = [rows.take(at[k : k + _AT_ONCE]) for k in range(0, max(1, len(at)), _AT_ONCE)]
    tracks = [track_table(part, setup.plane, setup.config.tracker.sigma_pressure) for part in parts]
    gates = [innovation_table(part, setup.plane, names) for part in parts]
    return pa.concat_tables(tracks), pa.concat_tables(gates)
