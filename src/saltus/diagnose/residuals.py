"""Where residuals come from: a table, or two recordings of the same aircraft."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.config import Config
from saltus.errors import DataError
from saltus.geo import Site
from saltus.io.cells import numbers, refuse, texts, times
from saltus.io.sheet import read_sheet
from saltus.records import Kind, Plots
from saltus.shapes import Float
from saltus.text import cut
from saltus.tracks.measurements import default_noise, make_plane, place_plots

__all__ = ["Phase", "Residuals", "from_recordings", "from_table"]

Phase = Literal["all", "air", "ground"]
_Array = npt.NDArray[np.float64]

_SAME = 1e-6  # m: residuals below this are rounding
_BRACKET = 3.0  # s: reference reports further apart are not interpolated between
_HEIGHT = (5000.0, 3500.0)  # m: of targets that do not tell it


class Residuals(NamedTuple):
    """Errors (or positions) of the components of one sensor."""

    names: tuple[str, ...]
    times: Float[np.ndarray, " n"]  # s
    values: Float[np.ndarray, "n m"]  # NaN where absent
    labels: npt.NDArray[np.int64]  # (N,): which object or pass
    unit: str
    reference: Float[np.ndarray, "n m"] | None = None  # positions the residuals were taken from, where known


def from_table(path: Path, columns: Sequence[str], series: str | None) -> Residuals:
    """Read residuals from a CSV or Parquet table with a column `time` (seconds, or anything ISO 8601).

    Raises:
        DataError: a column is missing or holds no numbers; the message lists what there is.
    """
    wanted = ["time", *columns] + ([series] if series is not None else [])
    sheet = read_sheet(path, wanted)
    missing = [name for name in wanted if name not in sheet.columns]
    if missing:
        there = ", ".join(cut(name, 40) for name in [*sheet.columns, *sheet.unused])
        raise DataError(f"{path}: no column {missing[0]!r}; there are {there}.")
    faults: list[str] = [*sheet.problems]
    values = [times(path, sheet.columns["time"], faults)]
    values += [numbers(path, name, sheet.columns[name], faults) for name in columns]
    if series is not None:
        labels = texts(path, series, sheet.columns[series], faults).which
    else:
        labels = np.zeros(sheet.n_rows, np.int64)
    refuse(path, faults)
    return _distinct(Residuals(tuple(columns), values[0], np.stack(values[1:], axis=-1), labels, ""))


def from_recordings(
    inputs: Sequence[Path], reference: Sequence[Path], config: Config, phase: Phase = "all"
) -> Residuals:
    """Subtract the reference's position, interpolated at the time of each report of the same Mode S address.

    Both are placed in one plane; the residuals are east and north in m. Reference reports more than 3 s apart are not
    interpolated between. `phase` keeps the reports said to be in the air, or on the ground.

    Raises:
        DataError: a file cannot be read, a site is not configured, no address occurs in both, or both say the same.
    """
    seen, truth = (config.read(paths).plots for paths in (inputs, reference))
    if phase != "all":
        seen = seen.take(seen.on_ground == (1 if phase == "ground" else 0))
    both = Plots.concat([seen, truth])
    sites = [_site(both, s, config) for s in range(len(both.sources))]
    noise = {s: default_noise(source) for s, source in enumerate(both.sources)}
    plane = make_plane(both, sites)
    a, b = (place_plots(p, plane, _own(p, both, sites), noise, _HEIGHT) for p in (seen, truth))
    times, values, labels, known = [], [], [], []
    for address in np.intersect1d(a.icao24[a.icao24 >= 0], b.icao24[b.icao24 >= 0]):
        mine, theirs = np.flatnonzero(a.icao24 == address), np.flatnonzero(b.icao24 == address)
        expected = _interpolated(a.time[mine], b.time[theirs], b.position[theirs, :2])
        good = np.isfinite(expected).all(-1) & np.isfinite(a.position[mine, :2]).all(-1)
        times.append(a.time[mine][good])
        values.append((a.position[mine, :2] - expected)[good])
        known.append(expected[good])
        labels.append(np.full(int(good.sum()), address, np.int64))
    if not times or not sum(map(len, times)):
        raise DataError("no Mode S address is in both the recording and the reference at the same time.")
    if np.nanmax(np.abs(np.concatenate(values))) < _SAME:
        raise DataError(
            f"all {sum(map(len, times))} residuals are 0: is {', '.join(map(str, reference))} the same recording? "
            "A reference is another, better one of the same aircraft."
        )
    found = Residuals(
        ("east", "north"),
        np.concatenate(times),
        np.concatenate(values),
        np.concatenate(labels),
        "m",
        np.concatenate(known),
    )
    return _distinct(found)


def _site(plots: Plots, s: int, config: Config) -> Site | None:
    source = plots.sources[s]
    sensor = config.site_for(source.system)
    if sensor is not None and sensor.latitude is not None and sensor.longitude is not None:
        latitude, longitude = np.radians([sensor.latitude, sensor.longitude])
        return Site(float(latitude), float(longitude), 0.0 if sensor.height is None else sensor.height, 0.0)
    at = (plots.source == s) & (plots.reason == 0)
    if np.isin(plots.kind[at], (Kind.POLAR, Kind.PLANE, Kind.BEARING)).any():
        raise DataError(f"{source.system}: its site is not configured; give a [[sensor]] table with --config.")
    return None


def _own(plots: Plots, both: Plots, sites: Sequence[Site | None]) -> list[Site | None]:
    """The sites of the sources of one of the two recordings."""
    place = {source.system: site for source, site in zip(both.sources, sites, strict=True)}
    return [place[source.system] for source in plots.sources]


def _interpolated(t: _Array, known: _Array, xy: _Array) -> _Array:
    """Positions at times t, (N, 2); NaN where the two reports around t are too far apart."""
    after = np.clip(np.searchsorted(known, t), 1, max(len(known) - 1, 1))
    if len(known) < 2:
        return np.full((len(t), 2), np.nan)
    before = after - 1
    gap = known[after] - known[before]
    inside = (gap > 0) & (gap <= _BRACKET) & (t >= known[before]) & (t <= known[after])
    share = np.where(inside, (t - known[before]) / np.where(gap > 0, gap, 1.0), np.nan)
    return np.asarray(xy[before] + share[:, None] * (xy[after] - xy[before]))


def _distinct(r: Residuals) -> Residuals:
    """In time order, without repeated times of one object."""
    order = np.lexsort((r.times, r.labels))
    t, label = r.times[order], r.labels[order]
    fresh = np.concatenate([[True], (np.diff(label) != 0) | (np.diff(t) > 0)]) & np.isfinite(t)
    kept = order[fresh]
    known = None if r.reference is None else r.reference[kept]
    return r._replace(times=r.times[kept], values=r.values[kept], labels=r.labels[kept], reference=known)
