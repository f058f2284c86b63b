"""Lines for people on what a run could not do, and how to mend it."""

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from saltus.engine import Result, Setup
from saltus.engine.learn import sigmas
from saltus.errors import DataError
from saltus.records import REASONS, System
from saltus.run.seen import Seen
from saltus.times import utc

__all__ = ["called", "refuse_unusable", "set_up", "without_tracks"]

_MANY = 100  # positions of a source that should have made a track


def set_up(setup: Setup, unplaced: Mapping[System, int]) -> list[str]:
    """Say what the setup lacks.

    Args:
        setup: of the sources.
        unplaced: number of reports of each source that are relative to a site not known.
    """
    lines = []
    for sensor in setup.sensors:
        if unplaced.get(sensor.source.system):
            lines.append(_site_wanted(sensor.source.system, unplaced[sensor.source.system]))
        if np.isfinite(sensor.appeared) and set(field for _, field, _ in sigmas(sensor)) - set(sensor.given):
            used = ", ".join(f"{label} {getattr(sensor.noise, f) * unit:.4g}" for label, f, unit in sigmas(sensor))
            lines.append(
                f"{sensor.name}: it first reported at {utc(sensor.appeared)}, after noise had been learnt: {used} "
                "is used, whatever its reports say. Configure it in a [[sensor]] table, learn a setup (saltus setup) "
                "from a time in which it reports, or make the first stretch longer ([setup] seconds)."
            )
        if sensor.heard and np.isnan(sensor.told_period):
            lines.append(
                f"{sensor.name}: the recording does not tell the update period; {sensor.period:.3g} s is assumed. "
                "Give period (s) in its [[sensor]] table."
            )
    return lines


def _site_wanted(system: System, count: int) -> str:
    """Say that a source's site must be configured."""
    keys = f"sac = {system.sac}, sic = {system.sic}" if system.category is not None else f'name = "{system.name}"'
    keys += f', channel = "{system.channel}"' if system.channel else ""
    moving = "" if system.category is not None else " A sensor that moves tells its own place: see observer_latitude."
    return (
        f"{system}: {count} reports are relative to a site whose position is not configured. Give it in a file "
        f"named with --config: a [[sensor]] table with {keys}, latitude, longitude (degrees), height (m).{moving}"
    )


def without_tracks(result: Result) -> list[str]:
    """Say which sources gave many positions and no track."""
    sensors, count, on = result.setup.sensors, result.outcome.placed, result.outcome.tracked
    return [
        f"{sensors[s].name}: {count[s]} reports and no track: is its update period {sensors[s].period:.3g} s? "
        "Give period (s) in its [[sensor]] table."
        for s in np.flatnonzero((count >= _MANY) & (on == 0))
    ]


def called(setup: Setup) -> dict[str, str]:
    """Return what people read for each designation: the name as configured, told apart where two are the same."""
    names: dict[str, str] = {}
    for sensor in setup.sensors:
        system = str(sensor.source.system)
        names[system] = f"{sensor.name} ({system})" if sensor.name in names.values() else sensor.name
    return names


def refuse_unusable(seen: Seen) -> None:
    """Refuse a recording of which nothing can be tracked.

    Raises:
        DataError: there is no usable report, or each is relative to a site not configured.
    """
    if not seen.usable:
        wanted = [_site_wanted(system, count) for system, count in seen.unplaced.items()]
        raise DataError(_nothing_left(seen.reasons, [*seen.problems, *wanted]))


def _nothing_left(counts: npt.NDArray[np.int64], problems: Sequence[str]) -> str:
    """Say why none of the reports can be tracked."""
    if not counts.any():
        return "the inputs hold no target report. " + " ".join(problems)
    listed = ", ".join(f"{counts[k]} {REASONS[k]}" for k in np.argsort(-counts) if k and counts[k])
    if counts[REASONS.index("system track")] == counts.sum():
        listed += " (another system's tracks are shown by saltus info and never tracked again)"
    return " ".join([f"no report can be tracked: {listed}.", *problems])
