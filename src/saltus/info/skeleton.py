"""A configuration to begin with: what the recordings tell of their systems, and what is to be filled in."""

import datetime
from collections.abc import Sequence

import numpy as np

from saltus.records import Contents, Kind, Recording, System

__all__ = ["skeleton"]

_DAY = 86400.0  # s
_TO_FILL = "# latitude = 0.0                 # degrees north, WGS-84: needed, its reports are relative to its site"


def skeleton(recording: Recording) -> str:
    """Return sensors.toml: accepted as it stands, with comments where something is missing."""
    lines = [
        f"# What saltus info found in {', '.join(f.file for f in recording.files) or 'the tables'}.",
        *_date(recording),
    ]
    reported = [c for c in recording.contents if c.n_reports and c.edition != ""] + _tables(recording)
    for contents in _each_system(reported):
        lines += ["", *_sensor(contents, recording, reported)]
    editions = {c.system.category: c.edition for c in recording.contents if c.edition}
    if editions:
        lines += [
            "",
            "[editions]",
            *(f'{number} = "{edition}"' for number, edition in sorted(editions.items(), key=str)),
        ]
    return "\n".join(lines) + "\n"


def _date(recording: Recording) -> list[str]:
    first = min((c.time_from for c in recording.contents if np.isfinite(c.time_from)), default=float("nan"))
    if not np.isfinite(first) or first < 10 * _DAY:
        return ["# date = 2024-01-31              # of the first record: the recording tells the time of day only"]
    day = datetime.datetime.fromtimestamp(first, datetime.UTC).date()
    return [f"date = {day}"]


def _tables(recording: Recording) -> list[Contents]:
    return [c for c in recording.contents if c.n_reports and c.edition == "" and c.system.category is None]


def _each_system(some: Sequence[Contents]) -> list[Contents]:
    """One of each system, the first."""
    return list({str(c.system): c for c in reversed(some)}.values())[::-1]


def _sensor(contents: Contents, recording: Recording, reported: Sequence[Contents]) -> list[str]:
    system = contents.system
    lines = ["[[sensor]]" + (f"                       # {contents.words}" if contents.words else "")]
    if system.category is not None:
        lines += [f"sac = {system.sac}", f"sic = {system.sic}", f"category = {system.category}"]
    name = str(system).replace("\\", "\\\\").replace('"', '\\"')
    lines.append(f'name = "{name}"')
    lines += _site(system, recording)
    told = [c.update_period for c in reported if c.system == system and np.isfinite(c.update_period)]
    period = float(np.median(told)) if told else float("nan")
    if 0.0 < period <= 3600.0:
        lines.append(f"period = {period:.6g}")
    else:
        lines.append("# period = 4.0                   # s between two reports of one target: not told")
    return lines


def _site(system: System, recording: Recording) -> list[str]:
    """Where a system stands, as it says itself; what is needed and not told is left to fill in."""
    same = (c.site for c in recording.contents if (c.system.sac, c.system.sic) == (system.sac, system.sic))
    site = next((s for s in same if s is not None), None)
    if site is not None and system.category is not None:
        latitude, longitude, height = site
        lines = [f"latitude = {np.degrees(latitude):.8f}", f"longitude = {np.degrees(longitude):.8f}"]
        return [*lines, f"height = {height:.1f}"] if np.isfinite(height) else lines
    plots = recording.plots
    mine = [k for k, s in enumerate(plots.sources) if s.system == system]
    kinds = plots.kind[np.isin(plots.source, mine) & np.isnan(plots.observer_latitude)]
    if not np.isin(kinds, (Kind.POLAR, Kind.PLANE, Kind.BEARING)).any():
        return []
    return [_TO_FILL, "# longitude = 0.0", "# height = 0.0                   # m above mean sea level"]
