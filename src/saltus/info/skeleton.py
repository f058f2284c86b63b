"""A configuration to begin with: what the recordings tell of their systems, and what is to be filled in."""

import datetime
from collections.abc import Sequence

import numpy as np

from saltus.info.inventory import Inventory, Line
from saltus.records import System

__all__ = ["skeleton"]

_DAY = 86400.0  # s
_TO_FILL = "# latitude = 0.0                 # degrees north, WGS-84: needed, its reports are relative to its site"


def skeleton(inventory: Inventory) -> str:
    """Return sensors.toml: accepted as it stands, with comments where something is missing."""
    every = list(inventory.lines.values())
    files = ", ".join(dict.fromkeys(line.contents.file for line in every))
    lines = [f"# What saltus info found in {files}.", *_date(every)]
    systems: dict[System, list[Line]] = {}
    for line in every:
        if line.contents.n_reports:
            systems.setdefault(line.contents.system, []).append(line)
    for system, some in systems.items():
        lines += ["", *_sensor(system, some, every)]
    editions = {line.contents.system.category: line.contents.edition for line in every if line.contents.edition}
    if editions:
        lines += ["", "[editions]", *(f'{number} = "{editions[number]}"' for number in sorted(editions, key=str))]
    return "\n".join(lines) + "\n"


def _date(every: Sequence[Line]) -> list[str]:
    times = [line.contents.time_from for line in every if np.isfinite(line.contents.time_from)]
    first = min(times, default=float("nan"))
    if not np.isfinite(first) or first < 10 * _DAY:
        return ["# date = 2024-01-31              # of the first record: the recording tells the time of day only"]
    return [f"date = {datetime.datetime.fromtimestamp(first, datetime.UTC).date()}"]


def _sensor(system: System, some: Sequence[Line], every: Sequence[Line]) -> list[str]:
    words = some[0].contents.words
    lines = ["[[sensor]]" + (f"                       # {words}" if words else "")]
    if system.category is not None:
        lines += [f"sac = {system.sac}", f"sic = {system.sic}", f"category = {system.category}"]
    if system.channel:
        lines.append(f'channel = "{system.channel}"')
    name = str(system).replace("\\", "\\\\").replace('"', '\\"')
    lines.append(f'name = "{name}"')
    lines += _site(system, some, every)
    told = [line.contents.update_period for line in some if np.isfinite(line.contents.update_period)]
    period = float(np.median(told)) if told else float("nan")
    if 0.0 < period <= 3600.0:
        lines.append(f"period = {period:.6g}")
    else:
        lines.append("# period = 4.0                   # s between two reports of one target: not told")
    return lines


def _site(system: System, some: Sequence[Line], every: Sequence[Line]) -> list[str]:
    """Where a system stands, as it says itself; what is needed and not told is left to fill in."""
    same = (line.contents for line in every if line.contents.system.category is not None)
    sites = [c.site for c in same if (c.system.sac, c.system.sic) == (system.sac, system.sic) and c.site is not None]
    if sites:
        latitude, longitude, height = sites[0]
        lines = [f"latitude = {np.degrees(latitude):.8f}", f"longitude = {np.degrees(longitude):.8f}"]
        return [*lines, f"height = {height:.1f}"] if np.isfinite(height) else lines
    if not any(line.needs_site for line in some):
        return []
    return [_TO_FILL, "# longitude = 0.0", "# height = 0.0                   # m above mean sea level"]
