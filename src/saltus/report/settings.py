"""What the summary says of the run itself, in words and units that people read."""

from collections.abc import Mapping
from datetime import UTC, datetime

__all__ = ["UNITS", "readable"]

# Units of the settings whose names carry none, as endings that `title` writes out.
UNITS: dict[str, dict[str, str]] = {
    "intake": {"hold": "s", "wild": "s"},
    "setup": {"seconds": "s", "gap": "s", "far": "m"},
    "periods": {"shortest": "s", "longest": "s", "accel": "mps2"},
    "tracker": {
        "clutter_density": "perm2",
        "clutter_density_azimuth": "perrad",
        "max_speed": "mps",
        "split_range": "m",
        "split_azimuth": "deg",
        "outlier_azimuth": "deg",
        "outlier_range": "m",
        "outlier_xy": "m",
        "degraded_sojourn": "s",
        "height_prior": "m",
        "sigma_pressure": "m",
    },
    "filter": {
        "accel_h": "mps2",
        "sojourn_h": "s",
        "turn_rate": "degps",
        "turn_sojourn": "s",
        "accel_v": "mps2",
        "sojourn_v": "s",
        "accel_time": "s",
    },
    "systems": {
        "split_offset": "m",
        "hysteresis": "nats",
        "every": "s",
        "window": "s",
        "offset_time": "s",
        "spacing": "s",
        "speed": "mps",
        "track_sigma": "m",
        "track_memory": "s",
        "silent": "s",
        "rows_kept": "s",
        "lately": "s",
    },
    "registration": {
        "sigma_offset": "m",
        "sigma_azimuth": "deg",
        "sigma_range": "m",
        "sigma_time": "s",
        "scatter": "m",
        "block": "s",
        "interval": "s",
        "memory": "s",
    },
}
_WHOLE = {"coast_seconds": "coast_s"}  # names that end in a word for their unit
_TIMES = ("time_from", "time_to")


def readable(summary: Mapping[str, object]) -> dict[str, object]:
    """Return the summary with its times as UTC text, its plane in short and the unit of each setting in its name."""
    out = dict(summary)
    for name in _TIMES:
        seconds = out.get(name)
        if isinstance(seconds, int | float):
            out[name] = f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M:%S} UTC"
    plane = out.get("plane")
    if isinstance(plane, Mapping):  # in short: the whole sentence would fill the page
        out["plane"] = {"projection": str(plane["projection"]).split(",")[0]} | {
            f"centre_{axis}_deg": round(float(plane[axis]), 5) for axis in ("latitude", "longitude")
        }
    settings = out.get("settings")
    if isinstance(settings, Mapping):
        out["settings"] = {str(key): _with_units(str(key), part) for key, part in settings.items()}
    return out


def _with_units(group: str, part: object) -> object:
    if not isinstance(part, Mapping):
        return part
    units = UNITS.get(group, {})
    return {_WHOLE.get(key) or (f"{key}_{units[key]}" if key in units else key): v for key, v in part.items()}
