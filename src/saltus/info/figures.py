"""What the reports of one system say in a few figures: how many targets, where, how high."""

import numpy as np
import numpy.typing as npt

from saltus.records import Kind, Plots

__all__ = ["extents", "levels", "targets"]

_FT, _NM = 0.3048, 1852.0  # m
_MANY = 400  # reports from which on single wild ones are left out of an extent
_OUTER = 0.005  # of the reports beyond each end of an extent
_SECTORS = 36  # of azimuth, to see whether all of it is covered
_Array = npt.NDArray[np.float64]


def targets(plots: Plots) -> str:
    """How many targets there are, by what tells them apart best, and how many more by other codes."""
    told = []
    rest = np.ones(len(plots), np.bool_)
    for values, words in (
        (plots.icao24, "Mode S address"),
        (plots.mode3a, "Mode 3/A code"),
        (plots.local_id, "the system's own track numbers"),
    ):
        known = rest & (values >= 0)
        if known.any():
            told.append(f"{len(np.unique(values[known]))} by {words}")
            rest &= ~known
            if len(told) == 2:
                break
    left = int(np.count_nonzero(rest))
    if not told:
        return "cannot be told: no report carries an identity"
    more = f", {told[1]} of those without" if len(told) > 1 else ""
    return told[0] + more + (f"; {left} reports without identity" if left else "")


def extents(plots: Plots) -> list[str]:
    """Where the reports are, for each kind of position there is."""
    said = []
    ways = {Kind.POLAR: _polar, Kind.PLANE: _plane, Kind.GEODETIC: _geodetic, Kind.BEARING: _bearing}
    for kind, tell in ways.items():
        some = plots.take(plots.kind == kind)
        if len(some):
            said.append(tell(some))
    return said


def levels(plots: Plots) -> str:
    """Between which pressure altitudes the reports are, and how many are on the ground; empty when none says."""
    known = plots.altitude[np.isfinite(plots.altitude)] / _FT / 100
    said = []
    if len(known):
        low, high = _span(known)
        first, third = np.quantile(known, (0.25, 0.75))
        said.append(f"FL {low:.0f} to {high:.0f}, half of them FL {first:.0f} to {third:.0f}")
        said.append(f"{len(known) / len(plots):.0%} tell one")
    ground = np.count_nonzero(plots.on_ground == 1)
    if ground:
        said.append(f"{ground / len(plots):.0%} on the ground")
    return "; ".join(said)


def _span(values: _Array) -> tuple[float, float]:
    """Least and greatest, of many values without the outermost."""
    if len(values) < _MANY:
        return float(values.min()), float(values.max())
    low, high = np.quantile(values, (_OUTER, 1.0 - _OUTER))
    return float(low), float(high)


def _polar(plots: Plots) -> str:
    near, far = _span(plots.range[np.isfinite(plots.range)])
    return f"range {near / _NM:.1f} to {far / _NM:.1f} NM ({near / 1e3:.1f} to {far / 1e3:.1f} km), {_sector(plots)}"


def _bearing(plots: Plots) -> str:
    return f"bearings, {_sector(plots)}"


def _sector(plots: Plots) -> str:
    """The sector of azimuth without the widest gap."""
    azimuth = np.sort(np.degrees(plots.azimuth[np.isfinite(plots.azimuth)]) % 360.0)
    covered = len(np.unique((azimuth * _SECTORS / 360.0).astype(np.int64) % _SECTORS))
    if covered >= _SECTORS - 2:
        return "all round"
    gaps = np.diff(azimuth, append=azimuth[0] + 360.0)
    widest = int(np.argmax(gaps))
    return f"azimuth {azimuth[(widest + 1) % len(azimuth)]:.0f} to {azimuth[widest]:.0f} degrees"


def _plane(plots: Plots) -> str:
    (west, east), (south, north) = _span(plots.x / 1e3), _span(plots.y / 1e3)
    return f"x {west:.1f} to {east:.1f} km east, y {south:.1f} to {north:.1f} km north of its reference point"


def _geodetic(plots: Plots) -> str:
    south, north = _span(np.degrees(plots.latitude[np.isfinite(plots.latitude)]))
    west, east = _longitudes(np.degrees(plots.longitude[np.isfinite(plots.longitude)]))
    return f"latitude {south:.3f} to {north:.3f}, longitude {west:.3f} to {east:.3f} degrees"


def _longitudes(values: _Array) -> tuple[float, float]:
    """West and east ends: counted from the middle direction, so that 180 degrees is no border."""
    direction = np.exp(1j * np.radians(values)).sum()
    middle = float(np.degrees(np.angle(direction)))
    west, east = _span((values - middle + 180.0) % 360.0 - 180.0)
    return tuple((v + middle + 180.0) % 360.0 - 180.0 for v in (west, east))  # type: ignore[return-value]  # two
