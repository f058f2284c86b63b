"""What a run of the tracker found, in numbers: `summary.json`, and the lines on the screen."""

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from saltus.engine import Result
from saltus.engine.learn import sigmas
from saltus.engine.setup import SensorSetup
from saltus.records import Kind
from saltus.text import say, shown
from saltus.tracks.health import degraded_intervals, nis_interval
from saltus.tracks.noise import LEAST

__all__ = ["noise_rows", "show_summary", "summarise", "why_no_track"]

_DOUBTFUL_NIS = 3.0  # of two degrees of freedom
_TOO_SMALL_NIS = 0.3
_FAR_OFF = 30.0  # factor between a configured standard deviation and the estimate of it
_UNITS = {
    "sigma_range_m": "σ of range, m",
    "sigma_azimuth_deg": "σ of azimuth, °",
    "sigma_elevation_deg": "σ of elevation, °",
    "sigma_range_rate_mps": "σ of range rate, m/s",
    "sigma_xy_m": "σ of position, m",
    "sigma_time_s": "σ of time stamps, s",
}


def summarise(inputs: Sequence[Path], result: Result, problems: Sequence[str]) -> dict[str, object]:
    """Count reports, tracks and reasons, and state every source's noise.

    Args:
        inputs: files read.
        result: of the run; where states are of several systems, what may last between those widens their innovations.
        problems: lines for the user.
    """
    became, figures, (first, last) = result.outcome, result.figures, result.span
    read, hours = len(result.reason), (last - first) / 3600.0
    noise = _noise_table(result)
    return {
        "version": version("saltus"),
        "inputs": [shown(Path(p).name) for p in inputs],
        "plane": _plane(result),
        "time_from": first,
        "time_to": last,
        "reports": {"read": read, "used": became.used, "unused": read - became.used},
        "reasons": dict(sorted(became.reasons.items(), key=lambda row: -row[1])),
        "tracks": {
            "confirmed": became.confirmed,
            "confirmed_per_hour": round(became.confirmed / hours, 1) if hours > 0 else None,
            "never_confirmed": became.never_confirmed,
            "updates": figures.updates,
            "coasted": figures.coasted,
        },
        "noise": noise,
        "faults": _fault_table(result),
        "problems": [*problems, *_doubts(noise, several=len(result.whole.systems) > 1)],
    }


def why_no_track(result: Result) -> str:
    """Say in one line why no track was confirmed: few reports, a short time, none near, or too few in a row."""
    settings, sensors, became = result.setup.config.tracker, result.setup.sensors, result.outcome
    hits, scans, placed = settings.confirm_hits, settings.confirm_scans, int(became.placed.sum())
    period = min((sensors[s].period for s in np.flatnonzero(became.placed)), default=np.inf)
    said, span = f"no track: none got {hits} reports in {scans} update periods", result.span[1] - result.span[0]
    ask = "is the update period another (period in its [[sensor]] table), or a unit wrong (NM for m, feet for m)?"
    if placed < hits:
        return f"{said}; {placed} reports with a position can be tracked."
    if span < (hits - 1) * period:
        return f"{said} of {period:.3g} s; the reports last {span:.3g} s. Track a longer time; {ask}"
    if became.longest < 2:
        return (
            f"{said} of {period:.3g} s; no report has another near it within that time, at up to "
            f"{settings.max_speed:g} m/s (max_speed): {ask}"
        )
    return f"{said} of {period:.3g} s; the longest of {became.begun} begun got {became.longest}: {ask}"


def _plane(result: Result) -> dict[str, object]:
    """Say what x_m and y_m of the tracks are."""
    latitude, longitude = np.degrees([result.setup.plane.latitude, result.setup.plane.longitude])
    return {
        "projection": "stereographic, WGS-84, of scale 1 at the centre; x_m to the east and y_m to the north there",
        "latitude": float(latitude),
        "longitude": float(longitude),
    }


def _noise_table(result: Result) -> dict[str, object]:
    """State for each source what was configured, estimated and used, and whether the innovations agree."""
    table: dict[str, object] = {}
    for s, sensor in enumerate(result.setup.sensors):
        n, total = int(result.figures.nis_updates[s]), float(result.figures.nis[s])
        row: dict[str, object] = {"system": str(sensor.source.system)}
        for label, field, scale in sigmas(sensor):
            row[label] = {
                "configured": _rounded(sensor.given.get(field, np.nan) * scale),
                "estimated": _rounded(getattr(sensor.estimate, field) * scale),
                "used": _rounded(getattr(sensor.noise, field) * scale),
            }
        row["lasting"] = _lasting(sensor)
        row["update_period_s"] = _rounded(sensor.period)
        row["nis_mean"] = _rounded(total / n if n else np.nan)
        row["nis_expected"] = 2.0
        row["nis_interval"] = [_rounded(edge) for edge in nis_interval(n)]
        row["nis_updates"] = n
        table[sensor.name if sensor.name not in table else f"{sensor.name} ({sensor.source.system})"] = row
    return table


def _lasting(sensor: SensorSetup) -> dict[str, object] | None:
    """State what of a source's errors lasts, how long, and what told it; None where nothing does."""
    noise, scale = sensor.noise, 180.0 / np.pi if sensor.kind != Kind.PLANE else 1.0
    if not noise.lasting:
        return None
    told = "told by its tracks" if sensor.estimate.lasting_told and "lasting" not in sensor.given else "assumed"
    return {
        "sigma_lasting": {
            "configured": _rounded(sensor.given.get("lasting", np.nan) * scale),
            "estimated": _rounded(sensor.estimate.lasting * scale),
            "used": _rounded(noise.lasting * scale),
        },
        "unit": "m" if sensor.kind == Kind.PLANE else "degrees",
        "correlation_time_s": _rounded(noise.lasting_time),
        "correlation_time": "configured" if "lasting_time" in sensor.given else told,
        "lasting_scale_distance_m": _rounded(noise.lasting_distance),
        "gain_nats_per_report": _rounded(sensor.estimate.lasting_gain),
    }


def _fault_table(result: Result) -> dict[str, object]:
    """State for each source how many of its plots were faulty, and when it was degraded."""
    table: dict[str, object] = {}
    for s, (sensor, condition) in enumerate(zip(result.setup.sensors, result.conditions, strict=True)):
        law, faults = condition.law, result.figures.faults[s]
        n = int(faults.sum())
        counts = {name: int(faults[1 + c]) for c, name in enumerate(law.components)}
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
                for d in degraded_intervals(condition.history, law)
            ],
        }
    return table


def noise_rows(summary: dict[str, Any]) -> dict[str, object]:
    """Lay the noise table out for people: a row for each source and quantity, the same columns in all."""
    rows: dict[str, object] = {}
    for name, row in summary["noise"].items():
        figures = {"update_period_s": row["update_period_s"], "nis": row["nis_mean"]}
        for label, unit in _UNITS.items():
            if label in row:
                rows[f"{name}, {unit}"] = {**row[label], **figures}
        lasting = row["lasting"]
        if lasting is not None:
            unit = "m" if lasting["unit"] == "m" else "°"
            told = f"for τ {lasting['correlation_time_s']} s, {lasting['correlation_time']}"
            rows[f"{name}, σ of errors that last ({told}), {unit}"] = {**lasting["sigma_lasting"], **figures}
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
        sigmas += _said_of_lasting(row["lasting"])
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


def _said_of_lasting(lasting: dict[str, Any] | None) -> str:
    """Say what of a source's errors lasts, and how long."""
    if lasting is None:
        return ""
    said = f"; beside it errors of {lasting['sigma_lasting']['used']} {lasting['unit']} last"
    if lasting["lasting_scale_distance_m"] is not None:
        said += f" (1.4 times as large at {lasting['lasting_scale_distance_m']:g} m from the sensor)"
    return f"{said}, correlation time {lasting['correlation_time_s']} s ({lasting['correlation_time']})"


def _said_of_faults(name: str, row: dict[str, Any]) -> str:
    """One line on a source's faults."""
    kinds = ", ".join(f"{count} in {what}" for what, count in row["flagged"].items())
    lasting = sum(d["to"] - d["from"] for d in row["degraded"])
    conditions = ", ".join(dict.fromkeys(d["condition"] for d in row["degraded"]))
    times = f"{len(row['degraded'])} times, {lasting:.0f} s in all ({conditions})" if row["degraded"] else "never"
    return f"faults of {name}: {row['flagged_plots']} of {row['judged_plots']} plots ({kinds}); degraded {times}"
