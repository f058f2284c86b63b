"""`saltus track`: recordings in, tracks, assignments, summary and report out."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from saltus import io
from saltus.config import Config, SensorConfig, load_config
from saltus.errors import DataError
from saltus.geo import Site
from saltus.io.write import output_directory, write_json, write_table
from saltus.progress import Progress, progress_bar
from saltus.records import REASONS, Kind, Plots, Recording, Source
from saltus.run.identified import (
    address_lines,
    bias_tables,
    conflict_lines,
    identification_summary,
    identification_table,
    system_lines,
    systems_found,
)
from saltus.run.pipeline import Identified, track_plots
from saltus.summary import Sensors, Tracked, health_of, noise_rows, show_summary, summarise, why_no_track
from saltus.times import parse_time, time_window
from saltus.tracks.output import assignment_table, innovation_table, track_table
from saltus.tracks.rows import Rows, join_rows

__all__ = ["parse_time", "track_files", "track_recording", "write_tracks"]

_UNKNOWN_HEIGHT = (300.0, 300.0)  # m: mean and standard deviation of a site's height where none is given
_REPORT = "report.html"
_MANY = 100  # positions of a source that should have made a track
_NO_PERIOD = 4.0  # s: update period where the recording does not tell


def track_files(
    inputs: Sequence[Path],
    output: Path,
    config_path: Path | None = None,
    date_text: str | None = None,
    identity: str = "use",
    time_from: str | None = None,
    time_to: str | None = None,
    *,
    report: bool = True,
    framing: str | None = None,
) -> dict[str, object]:
    """Track recordings and write `tracks.parquet`, `assignments.parquet`, `summary.json` and `report.html`.

    Args:
        inputs: recordings; several are merged by time.
        output: directory to write into; its files appear together at the end, or not at all.
        config_path: TOML configuration.
        date_text: YYYY-MM-DD of the recording; wins over the configuration's.
        identity: "use" or "ignore" the codes that plots carry.
        time_from: first time used, HH:MM[:SS] of the recording's day or ISO 8601, UTC.
        time_to: last time used.
        report: whether to write the report; without it, the report of an earlier run is removed.
        framing: of ASTERIX recordings, one of `saltus.framing.NAMES`; None has it guessed.

    Returns:
        The summary, as written.

    Raises:
        DataError: an input cannot be read, or nothing in it can be tracked.
        ModelError: the configuration is wrong.
    """
    with progress_bar() as bar, output_directory(output, "track") as folder:
        summary, lines = write_tracks(
            inputs, folder, bar, config_path, date_text, identity, time_from, time_to, report, framing
        )
    show_summary(summary, output, report, lines)
    return summary


def write_tracks(
    inputs: Sequence[Path],
    folder: Path,
    bar: Progress,
    config_path: Path | None = None,
    date_text: str | None = None,
    identity: str = "use",
    time_from: str | None = None,
    time_to: str | None = None,
    report: bool = True,
    framing: str | None = None,
) -> tuple[dict[str, object], Sequence[str]]:
    """Track recordings as `track_files` does, into a folder whose files another has yet to publish.

    Returns:
        The summary, and lines on what the systems have in common: `show_summary` says both.
    """
    began = time.perf_counter()
    config = load_config(config_path, date=date_text, framing=framing)
    recording = io.read(
        inputs,
        date=config.date,
        editions=config.editions,
        framing=config.framing,
        progress=bar.reading,
        settings=config.reading,
    )
    decoded = time.perf_counter()
    plots, sensors, problems = _prepare(recording, config, time_from, time_to)
    tracked, whole = track_plots(plots, recording.tracks, sensors, config, bar, use_identity=identity == "use")
    tracks, gates = _tables(tracked, plots, config)
    assigned = assignment_table(plots, tracked.measurements, tracked.assignments)
    done = time.perf_counter()
    called = _called(plots.sources, sensors.names)
    found = len(tracked.assignments.confirmed)
    problems += [
        *(_without_tracks(plots, sensors, tracked) if found else [why_no_track(sensors, tracked, config.tracker)]),
        *address_lines(whole, called),
        *conflict_lines(whole, called),
    ]
    several = len(whole.systems) > 1
    summary = summarise(inputs, plots, sensors, tracked, tracks, assigned, problems, several=several)
    summary["systems"] = identification_summary(whole)
    summary["settings"] = {
        "identity": identity,
        **{name: asdict(getattr(config, name)) for name in ("tracker", "filter", "systems", "registration")},
    }
    summary["seconds"] = {"decoding": round(decoded - began, 2), "tracking": round(done - decoded, 2)}
    _write(folder, tracks, assigned, whole, summary)
    if report:
        from saltus.report import write_report

        sites = {str(s.system): site for s, site in zip(plots.sources, sensors.sites, strict=True) if site}
        write_report(
            folder / _REPORT,
            tracks=tracks,
            plots=plots,
            assignments=assigned,
            innovations=gates,
            summary={**summary, "noise": noise_rows(summary)},
            sites=sites,
            sensors=health_of(sensors, tracked),
            systems=systems_found(whole, config.systems, called),
            names=called,
        )
    return summary, system_lines(whole, called)


def track_recording(
    recording: Recording, config: Config, bar: Progress | None = None
) -> tuple[Plots, pa.Table, pa.Table]:
    """Track a recording in memory as `track_files` does, identities used.

    Args:
        recording: as read, or changed since.
        config: sites, noise and settings.
        bar: where to show progress.

    Returns:
        The reports with the reasons why some are not used; the columns of `tracks.parquet`; those of
        `assignments.parquet`, one row for each report in the same order.
    """
    plots, sensors, _ = _prepare(recording, config, None, None)
    tracked, _ = track_plots(plots, recording.tracks, sensors, config, bar or Progress(), use_identity=True)
    tracks, _ = _tables(tracked, plots, config)
    return plots, tracks, assignment_table(plots, tracked.measurements, tracked.assignments)


def _prepare(
    recording: Recording, config: Config, time_from: str | None, time_to: str | None
) -> tuple[Plots, Sensors, list[str]]:
    """Mark what cannot be used, and gather what is known of the sensors."""
    plots, problems = recording.plots, list(recording.problems)
    reason = plots.reason.copy()
    usable = (reason == 0) & np.isfinite(plots.time)
    if usable.any():
        first, last = time_window(time_from, time_to, float(plots.time[usable].min()), float(plots.time[usable].max()))
        early = plots.time < (-np.inf if time_from is None else first)
        late = plots.time > (np.inf if time_to is None else last)
        reason[early | late] = REASONS.index("outside time window")  # whatever else was wrong with them
    sensors = _sensors(plots.sources, recording, config)
    for s, source in enumerate(plots.sources):
        needs = (plots.source == s) & np.isin(plots.kind, (Kind.POLAR, Kind.PLANE, Kind.BEARING)) & (reason == 0)
        needs &= np.isnan(plots.observer_latitude)
        if sensors.sites[s] is None and needs.any():
            reason[needs] = REASONS.index("site unknown")
            problems.append(_site_wanted(source, int(needs.sum())))
        if (reason[plots.source == s] == 0).any() and np.isnan(sensors.told_periods[s]):
            problems.append(
                f"{sensors.names[s]}: the recording does not tell the update period; {_NO_PERIOD} s is assumed. "
                "Give period (s) in its [[sensor]] table."
            )
    plots = replace(plots, reason=reason)
    if not (reason == 0).any():
        raise DataError(_nothing_left(plots, problems))
    return plots, sensors, problems


def _called(sources: Sequence[Source], names: Sequence[str]) -> dict[str, str]:
    """Return what people read for each designation: the name as configured, told apart where two are the same."""
    called: dict[str, str] = {}
    for source, name in zip(sources, names, strict=True):
        system = str(source.system)
        called[system] = f"{name} ({system})" if name in called.values() else name
    return called


def _site_wanted(source: Source, count: int) -> str:
    system = source.system
    keys = f"sac = {system.sac}, sic = {system.sic}" if system.category is not None else f'name = "{system.name}"'
    moving = "" if system.category is not None else " A sensor that moves tells its own place: see observer_latitude."
    return (
        f"{system}: {count} reports are relative to a site whose position is not configured. Give it in a file "
        f"named with --config: a [[sensor]] table with {keys}, latitude, longitude (degrees), height (m).{moving}"
    )


def _without_tracks(plots: Plots, sensors: Sensors, tracked: Tracked) -> list[str]:
    """Say which sources gave many positions and no track."""
    m, found = tracked.measurements, tracked.assignments
    placed = np.isfinite(m.position[:, 0])
    count = np.bincount(m.source[placed], minlength=len(plots.sources))
    on = np.bincount(m.source[placed & np.isin(found.track_id, found.confirmed)], minlength=len(plots.sources))
    return [
        f"{sensors.names[s]}: {count[s]} reports and no track: is its update period {sensors.periods[s]:.3g} s? "
        "Give period (s) in its [[sensor]] table."
        for s in np.flatnonzero((count >= _MANY) & (on == 0))
    ]


def _nothing_left(plots: Plots, problems: Sequence[str]) -> str:
    if not len(plots):
        return "the inputs hold no target report. " + " ".join(problems)
    counts = np.bincount(plots.reason, minlength=len(REASONS))
    listed = ", ".join(f"{counts[k]} {REASONS[k]}" for k in np.argsort(-counts) if k and counts[k])
    if (plots.reason == REASONS.index("system track")).all():
        listed += " (another system's tracks are shown by saltus info and never tracked again)"
    return " ".join([f"no report can be tracked: {listed}.", *problems])


def _sensors(sources: Sequence[Source], recording: Recording, config: Config) -> Sensors:
    sites: list[Site | None] = []
    configured: list[dict[str, float]] = []
    periods, waits, told_periods, names, told_systems = [], [], [], [], []
    for source in sources:
        sensor = config.site_for(source.system)
        sites.append(None if sensor is None else _site(sensor))
        found = [c.update_period for c in recording.contents if c.system == source.system]
        told = [p for p in found if np.isfinite(p) and p > 0]
        given = None if sensor is None else sensor.period
        told_periods.append(given or (float(np.median(told)) if told else np.nan))
        periods.append(_NO_PERIOD if np.isnan(told_periods[-1]) else told_periods[-1])
        waits.append(max(periods[-1], source.traits.rest_period))
        configured.append({} if sensor is None else _noise(sensor, periods[-1]))
        names.append(sensor.name if sensor is not None and sensor.name else str(source.system))
        told_systems.append("" if sensor is None else sensor.system)
    return Sensors(sites, configured, periods, waits, told_periods, names, told_systems)


def _site(sensor: SensorConfig) -> Site | None:
    if sensor.latitude is None or sensor.longitude is None:
        return None
    latitude, longitude = np.radians([sensor.latitude, sensor.longitude])
    height, sigma = _UNKNOWN_HEIGHT if sensor.height is None else (sensor.height, 0.0)
    return Site(float(latitude), float(longitude), height, sigma)


def _noise(sensor: SensorConfig, period: float) -> dict[str, float]:
    """Return the fields of Noise that a configuration gives.

    Of errors with the correlation a^|k| between reports k periods apart, a = exp(-period / correlation_time), the mean
    of many has (1 + a)/(1 - a) times the variance of as many independent ones: their inflation.
    """
    azimuth, elevation = (
        None if sigma is None else float(np.radians(sigma)) for sigma in (sensor.sigma_azimuth, sensor.sigma_elevation)
    )
    given = {
        "range": sensor.sigma_range,
        "azimuth": azimuth,
        "elevation": elevation,
        "xy": sensor.sigma_xy,
        "altitude": sensor.sigma_altitude,
        "time": 0.0 if sensor.sigma_time is None and sensor.sigma_xy is not None else sensor.sigma_time,
        "inflation": sensor.correlation_time and float(1.0 / np.tanh(0.5 * period / sensor.correlation_time)),
    }
    return {field: value for field, value in given.items() if value is not None}


def _tables(tracked: Tracked, plots: Plots, config: Config) -> tuple[pa.Table, pa.Table]:
    """Return the rows of tracks that were confirmed at some time, in time order, and their gates."""
    plane = tracked.plane
    tracks = [track_table(rows, plane, config.tracker.sigma_pressure) for rows in _chunks(tracked.rows)]
    gates = [innovation_table(rows, plane, [str(s.system) for s in plots.sources]) for rows in _chunks(tracked.rows)]
    confirmed = pa.array(tracked.assignments.confirmed)
    tables = []
    for parts in (tracks, gates):
        table = pa.concat_tables(parts)
        table = table.filter(pc.is_in(table["track_id"], value_set=confirmed))
        tables.append(table.sort_by([("time", "ascending"), ("track_id", "ascending")]))
    return tables[0], tables[1]


def _chunks(rows: Sequence[Rows], size: int = 200) -> Iterator[Rows]:
    """Join the rows of some slices at a time; one empty chunk where there are none."""
    for k in range(0, max(1, len(rows)), size):
        yield join_rows(rows[k : k + size])


def _write(folder: Path, tracks: pa.Table, assigned: pa.Table, whole: Identified, summary: dict[str, object]) -> None:
    write_table(folder / "tracks.parquet", tracks)
    write_table(folder / "assignments.parquet", assigned)
    write_table(folder / "identifications.parquet", identification_table(whole))
    write_json(folder / "biases.json", bias_tables(whole))
    write_json(folder / "summary.json", summary)
