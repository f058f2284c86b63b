"""What a run of the tracker found, in numbers: `summary.json`, and the lines on the screen."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from saltus.geo import Plane, Site
from saltus.records import Kind, Plots
from saltus.text import say, shown
from saltus.tracks.health import Health, nis_interval, sensor_health
from saltus.tracks.measurements import Measurements, Noise
from saltus.tracks.noise import LEAST, NoiseEstimate
from saltus.tracks.rows import Assignments, Rows, join_rows
from saltus.tracks.settings import TrackerSettings

__all__ = [
    "SIGMAS",
    "Sensors",
    "Tracked",
    "health_of",
    "noise_rows",
    "reported_kind",
    "show_summary",
    "sigmas",
    "summarise",
    "why_no_track",
]

_DOUBTFUL_NIS = 3.0  # of two degrees of freedom
_TOO_SMALL_NIS = 0.3
_FAR_OFF = 30.0  # factor between a configured standard deviation and the estimate of it
_UNITS = {
    "sigma_range_m": "σ of range, m",
    "sigma_azimuth_deg": "σ of azimuth, °",
    "sigma_elevation_deg": "σ of elevation, °",
    "sigma_xy_m": "σ of position, m",
    "sigma_time_s": "σ of time stamps, s",
}
SIGMAS = {  # by what a source reports: label, field of Noise, unit
    Kind.POLAR: (("sigma_range_m", "range", 1.0), ("sigma_azimuth_deg", "azimuth", 180.0 / np.pi)),
    Kind.PLANE: (("sigma_xy_m", "xy", 1.0), ("sigma_time_s", "time", 1.0)),
    Kind.BEARING: (("sigma_azimuth_deg", "azimuth", 180.0 / np.pi),),
}


@dataclass(frozen=True, slots=True)
class Sensors:
    """What is known of each source of a recording, by source index."""

    sites: list[Site | None]
    configured: list[dict[str, float]]  # fields of Noise that the configuration gives
    periods: list[float]  # update period used, s
    waits: list[float]  # s without a report after which a target counts as missed
    told_periods: list[float]  # as configured or found in the recording, NaN where neither tells
    names: list[str]
    told_systems: list[str]  # system of each source as configured, "" where it is not


@dataclass(frozen=True, slots=True)
class Tracked:
    """Everything the tracker found."""

    rows: list[Rows]
    measurements: Measurements
    assignments: Assignments
    plane: Plane
    noise: dict[int, Noise]
    estimates: dict[int, NoiseEstimate]


def sigmas(plots: Plots, s: int) -> tuple[tuple[str, str, float], ...]:
    """Return the standard deviations that say how good the reports of a source are: label, field of Noise, unit."""
    kind, own = reported_kind(plots, s), plots.source == s
    measured = kind == Kind.POLAR and np.isfinite(plots.elevation[own & (plots.kind == Kind.POLAR)]).any()
    return SIGMAS[kind] + ((("sigma_elevation_deg", "elevation", 180.0 / np.pi),) if measured else ())


def reported_kind(plots: Plots, s: int) -> int:
    """What a source reports: polar where any report is, bearings where nothing else is, else plane positions."""
    kinds = plots.kind[(plots.source == s) & (plots.kind != Kind.NONE)]
    if (kinds == Kind.POLAR).any():
        return Kind.POLAR
    return Kind.BEARING if len(kinds) and (kinds == Kind.BEARING).all() else Kind.PLANE


def summarise(
    inputs: Sequence[Path],
    plots: Plots,
    sensors: Sensors,
    tracked: Tracked,
    tracks: pa.Table,
    assigned: pa.Table,
    problems: Sequence[str],
    *,
    several: bool = False,
) -> dict[str, object]:
    """Count reports, tracks and reasons, and state every source's noise.

    Args:
        inputs: files read.
        plots: reports in time order.
        sensors: what was known of the sources.
        tracked: what the tracker found.
        tracks: rows of tracks.parquet.
        assigned: rows of assignments.parquet.
        problems: lines for the user.
        several: whether states are of several systems: what may last between those widens their innovations.
    """
    used = int(pc.sum(pc.is_valid(assigned["track_id"])).as_py() or 0)
    reasons = pc.value_counts(assigned["reason"].drop_null()).to_pylist()
    status = np.array(tracks["status"])
    ids = tracked.assignments.track_id
    noise = _noise_table(plots, sensors, tracked)
    hours = float(np.ptp(tracked.measurements.time)) / 3600.0
    return {
        "version": version("saltus"),
        "inputs": [shown(Path(p).name) for p in inputs],
        "time_from": float(tracked.measurements.time[0]),
        "time_to": float(tracked.measurements.time[-1]),
        "reports": {"read": len(plots), "used": used, "unused": len(plots) - used},
        "reasons": {r["values"]: r["counts"] for r in sorted(reasons, key=lambda r: -r["counts"])},
        "tracks": {
            "confirmed": len(tracked.assignments.confirmed),
            "confirmed_per_hour": round(len(tracked.assignments.confirmed) / hours, 1) if hours > 0 else None,
            "never_confirmed": len(np.setdiff1d(ids[ids > 0], tracked.assignments.confirmed)),
            "updates": int((status != "coasted").sum()),
            "coasted": int((status == "coasted").sum()),
        },
        "noise": noise,
        "faults": _fault_table(health_of(sensors, tracked)),
        "problems": [*problems, *_doubts(noise, several=several)],
    }


def why_no_track(sensors: Sensors, tracked: Tracked, settings: TrackerSettings) -> str:
    """Say in one line why no track was confirmed: few reports, a short time, none near, or too few in a row."""
    m, hits, scans = tracked.measurements, settings.confirm_hits, settings.confirm_scans
    placed = np.isfinite(m.position[:, 0]) & np.isnan(m.bearing)
    reports = tracked.assignments.track_id[placed]
    reports = np.bincount(reports[reports > 0], minlength=1)
    period = min(sensors.periods[s] for s in np.unique(m.source[placed])) if placed.any() else np.inf
    said, span = f"no track: none got {hits} reports in {scans} update periods", float(np.ptp(m.time))
    ask = "is the update period another (period in its [[sensor]] table), or a unit wrong (NM for m, feet for m)?"
    if placed.sum() < hits:
        return f"{said}; {placed.sum()} reports with a position can be tracked."
    if span < (hits - 1) * period:
        return f"{said} of {period:.3g} s; the reports last {span:.3g} s. Track a longer time; {ask}"
    if reports.max() < 2:
        return (
            f"{said} of {period:.3g} s; no report has another near it within that time, at up to "
            f"{settings.max_speed:g} m/s (max_speed): {ask}"
        )
    return f"{said} of {period:.3g} s; the longest of {np.sum(reports > 1)} begun got {reports.max()}: {ask}"


def _noise_table(plots: Plots, sensors: Sensors, tracked: Tracked) -> dict[str, object]:
    """State for each source what was configured, estimated and used, and whether the innovations agree."""
    m = tracked.measurements
    updated = [(rows.measurement, rows.d2) for rows in tracked.rows]
    measurement = np.concatenate([np.zeros(0, np.intp), *(u[0] for u in updated)])
    d2 = np.concatenate([np.zeros(0), *(u[1] for u in updated)])
    table: dict[str, object] = {}
    for s, name in enumerate(sensors.names):
        at = (measurement >= 0) & (m.source[measurement] == s) & np.isfinite(d2)
        given, found, used = sensors.configured[s], tracked.estimates[s], tracked.noise[s]
        row: dict[str, object] = {"system": str(plots.sources[s].system)}
        for label, field, scale in sigmas(plots, s):
            row[label] = {
                "configured": _rounded(given.get(field, np.nan) * scale),
                "estimated": _rounded(getattr(found, field) * scale),
                "used": _rounded(getattr(used, field) * scale),
            }
        row["update_period_s"] = _rounded(sensors.periods[s])
        row["nis_mean"] = _rounded(float(d2[at].mean()) if at.any() else np.nan)
        row["nis_expected"] = 2.0
        row["nis_interval"] = [_rounded(edge) for edge in nis_interval(int(at.sum()))]
        row["nis_updates"] = int(at.sum())
        table[name if name not in table else f"{name} ({plots.sources[s].system})"] = row
    return table


def health_of(sensors: Sensors, tracked: Tracked) -> list[Health]:
    """Gather the faults that the tracker found, by source."""
    m, confirmed = tracked.measurements, tracked.assignments.confirmed
    rows = join_rows(tracked.rows)
    at = np.flatnonzero((rows.measurement >= 0) & np.isin(rows.track_id, confirmed))
    plot = rows.measurement[at]
    found = rows.p_fault[at], rows.fault[at]
    return sensor_health(sensors.names, tracked.assignments.sources, m.source[plot], m.time[plot], *found)


def _fault_table(sensors: Sequence[Health]) -> dict[str, object]:
    """State for each source how many of its plots were faulty, and when it was degraded."""
    table: dict[str, object] = {}
    for s, sensor in enumerate(sensors):
        n = len(sensor.time)
        counts = {name: int((sensor.fault == 1 + c).sum()) for c, name in enumerate(sensor.components)}
        table[sensor.name if sensor.name not in table else f"{sensor.name} ({s})"] = {
            "judged_plots": n,
            "flagged_plots": sum(counts.values()),
            "flagged_share": _rounded(sum(counts.values()) / n) if n else None,
            "flagged": counts,
            "degraded": [
                {
                    "from": d.time_from,
                    "to": d.time_to,
                    "condition": d.condition,
                    "probability": _rounded(d.probability),
                }
                for d in sensor.intervals
            ],
        }
    return table


def noise_rows(summary: dict[str, Any]) -> dict[str, object]:
    """Lay the noise table out for people: a row for each source and quantity, the same columns in all."""
    rows: dict[str, object] = {}
    for name, row in summary["noise"].items():
        for label, unit in _UNITS.items():
            if label in row:
                figures = {"update_period_s": row["update_period_s"], "nis": row["nis_mean"]}
                rows[f"{name}, {unit}"] = {**row[label], **figures}
    return rows


def _doubts(noise: dict[str, Any], *, several: bool) -> list[str]:
    """Say of which sources the innovations contradict the noise used."""
    return (
        [
            f"{name}: NIS {row['nis_mean']} where 2 is expected: the errors are larger than the noise used explains "
            "(a bias between sources, or errors that last). Covariances of its tracks are too small; set its sigma or "
            "correlation_time in the configuration."
            for name, row in noise.items()
            if row["nis_mean"] is not None and row["nis_mean"] > _DOUBTFUL_NIS and _telling(row)
        ]
        + [
            f"{name}: {why}; is a unit wrong (NM for m, radians for degrees), or sigma in the configuration?"
            for name, row in noise.items()
            for why in (() if _noise_free(row) else _implausible(row, several=several))
        ]
        + [
            f"{name}: its reports scatter by less than {LEAST} m, as no sensor's do: they carry no noise. "
            f"{label} {row[label]['used']} is used; set it in the configuration."
            for name, row in noise.items()
            for label in _noise_free(row)
        ]
    )


def _telling(row: dict[str, Any]) -> bool:
    """Say whether the mean NIS is further from 2 than four of its standard errors, 2 / sqrt(n)."""
    return bool(abs(row["nis_mean"] - 2.0) * np.sqrt(row["nis_updates"]) > 4.0 * 2.0)


def _noise_free(row: dict[str, Any]) -> list[str]:
    """Which deviations of a source, not configured, are too small to be a sensor's."""
    return [
        label
        for label in row
        if label.startswith("sigma") and label.endswith("_m") and row[label]["configured"] is None
        if row[label]["estimated"] is not None and row[label]["estimated"] < LEAST
    ]


def _implausible(row: dict[str, Any], *, several: bool) -> list[str]:
    """Say what of one source's noise cannot be as it is."""
    why = []
    nis = row["nis_mean"]
    if nis is not None and nis < _TOO_SMALL_NIS and _telling(row) and not several:
        why.append(f"NIS {nis} where 2 is expected: the errors are far smaller than the noise used")
    for label in (label for label in row if label.startswith("sigma")):
        configured, estimated = row[label]["configured"], row[label]["estimated"]
        if configured and estimated and max(configured / estimated, estimated / configured) > _FAR_OFF:
            why.append(f"{label} is configured as {configured} and its tracks say {estimated}")
    return why


def _rounded(value: float) -> float | None:
    return float(f"{value:.4g}") if np.isfinite(value) else None


def _or(value: float | None, otherwise: str) -> str:
    return otherwise if value is None else str(value)


def show_summary(summary: dict[str, Any], output: Path, report: bool, systems: Sequence[str] = ()) -> None:
    """Say on the screen what was done and where it lies; `systems`: lines on several systems."""
    reports, tracks = summary["reports"], summary["tracks"]
    say(f"{reports['read']} reports read, {reports['used']} on {tracks['confirmed']} confirmed tracks")
    for reason, count in summary["reasons"].items():
        say(f"  {count:>8} {reason}")
    for name, row in summary["noise"].items():
        if row["nis_mean"] is None and not any(row[label]["estimated"] for label in row if label.startswith("sigma")):
            continue  # no plots, or too few to say anything
        sigmas = ", ".join(
            f"{label} {row[label]['used']} (configured {_or(row[label]['configured'], 'none')}, "
            f"estimated {_or(row[label]['estimated'], 'unknown')})"
            for label in row
            if label.startswith("sigma")
        )
        low, high = row["nis_interval"]
        say(f"noise of {name}: {sigmas}; NIS {row['nis_mean']} (fits within {low:.2f} to {high:.2f})")
    for name, row in summary["faults"].items():
        if row["judged_plots"]:
            say(_said_of_faults(name, row))
    for line in systems:
        say(line)
    for problem in summary["problems"]:
        say(f"note: {problem}", err=True)
    seconds = summary["seconds"]
    say(f"decoding {seconds['decoding']} s, tracking {seconds['tracking']} s; written to {output}/")
    if report:
        say(f"open {output / 'report.html'}")


def _said_of_faults(name: str, row: dict[str, Any]) -> str:
    """One line on a source's faults."""
    kinds = ", ".join(f"{count} in {what}" for what, count in row["flagged"].items())
    lasting = sum(d["to"] - d["from"] for d in row["degraded"])
    conditions = ", ".join(dict.fromkeys(d["condition"] for d in row["degraded"]))
    times = f"{len(row['degraded'])} times, {lasting:.0f} s in all ({conditions})" if row["degraded"] else "never"
    return f"faults of {name}: {row['flagged_plots']} of {row['judged_plots']} plots ({kinds}); degraded {times}"
