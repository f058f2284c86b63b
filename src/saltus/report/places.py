"""Where plots, tracks and sites lie on the page: one conformal plane about the sensors."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from saltus.records import Kind, Plots
from saltus.report.columns import numbers

if TYPE_CHECKING:
    import pyarrow as pa

    from saltus.geo import Plane, Site

__all__ = ["plane_about", "plot_positions", "project", "site_of"]

_FARTHEST = 3.0e6  # m from the plane's centre; what lies beyond is no radar picture and would spoil the scale


def plot_positions(plots: Plots, sites: Mapping[str, "Site"]) -> npt.NDArray[np.float64]:
    """Return latitude and longitude in rad, shape (N, 2), NaN where the report or its site gives none.

    Reports without height are placed as if at the height of their site: at most some tenths of a mile too far out.
    """
    out = np.column_stack([plots.latitude, plots.longitude])
    todo, moves = np.isnan(out).any(axis=1), np.isfinite(plots.observer_latitude)
    for k, source in enumerate(plots.sources):
        site = site_of(str(source.system), source.system.name, sites)
        if site is not None:
            _place(out, plots, todo & ~moves & (plots.source == k), site)
    _place(out, plots, todo & moves, None)
    return out


def _place(out: npt.NDArray[np.float64], plots: Plots, which: npt.NDArray[np.bool_], fixed: "Site | None") -> None:
    """Write the positions of reports seen from one site, or (None) each from its own observer."""
    from saltus.geo import Sites, polar_to_geodetic

    plane = plots.kind == Kind.PLANE
    slant = np.where(plane, np.hypot(plots.x, plots.y), plots.range)
    azimuth = np.where(plane, np.arctan2(plots.x, plots.y), plots.azimuth)
    with np.errstate(invalid="ignore"):
        which = which & np.isfinite(slant) & np.isfinite(azimuth) & (slant >= 0) & (slant < _FARTHEST)
    if which.any():
        part, plane = plots.take(which), plane[which]
        site = fixed or Sites(part.observer_latitude, part.observer_longitude, part.observer_height)
        height = np.where(plane | np.isnan(part.altitude), site.height, part.altitude)
        place = polar_to_geodetic(slant[which], azimuth[which], height, site)
        out[which] = np.column_stack([place[0], place[1]])


def site_of(system: str, name: str, sites: Mapping[str, "Site"]) -> "Site | None":
    """Find a system's site by its designation, its name, or because there is only one."""
    for key in (system, name):
        if key and key in sites:
            return sites[key]
    return next(iter(sites.values())) if len(sites) == 1 else None


def plane_about(
    plots: Plots, position: npt.NDArray[np.float64], tracks: "pa.Table", sites: Mapping[str, "Site"]
) -> "Plane":
    """Centre the plane on the sites in use, else on the usable plots, else on the tracks."""
    from saltus.geo import Plane

    used = [site_of(str(s.system), s.system.name, sites) for s in plots.sources]
    places = [(s.latitude, s.longitude) for s in used if s is not None] or list(position[plots.reason == 0])
    if not places or not np.isfinite(places).any():
        places = list(np.radians(np.column_stack([numbers(tracks, "latitude"), numbers(tracks, "longitude")])))
    lat, lon = np.array(places or [(0.0, 0.0)], np.float64).T
    toward = np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    toward = toward[np.isfinite(toward).all(axis=1)]
    x, y, z = np.median(toward, axis=0) if len(toward) else (1.0, 0.0, 0.0)
    return Plane(float(np.arctan2(z, np.hypot(x, y))), float(np.arctan2(y, x)))


def project(plane: "Plane", lat: npt.NDArray[np.float64], lon: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Project what can be projected; NaN elsewhere."""
    xy = np.full((len(lat), 2), np.nan)
    good = np.isfinite(lat) & np.isfinite(lon) & (np.abs(lat) <= np.pi / 2)
    if good.any():
        xy[good] = plane.forward(lat[good], lon[good])
    with np.errstate(invalid="ignore"):
        xy[~(np.hypot(xy[:, 0], xy[:, 1]) < _FARTHEST)] = np.nan
    return xy
