"""What the page draws: tracks, plots and gates on one plane, thinned to what a browser moves smoothly."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from saltus.records import REASONS, Plots
from saltus.report.columns import encode, numbers, quantise, texts
from saltus.report.places import plane_about, plot_positions, project
from saltus.report.tables import show
from saltus.report.updates import Updates, vertical_chance

if TYPE_CHECKING:
    import pyarrow as pa

    from saltus.geo import Plane, Site

__all__ = ["MAX_PLOTS", "MAX_UPDATES", "assigned_tracks", "payload", "rows_within", "time_span", "within"]

MAX_PLOTS = 60_000
MAX_UPDATES = 150_000
_OUTSIDE = REASONS.index("outside time window")


def payload(
    updates: Updates,
    plots: Plots,
    track_id: npt.NDArray[np.float64],
    innovations: "pa.Table",
    sites: Mapping[str, "Site"],
    names: Mapping[str, str],
) -> tuple[dict[str, object], list[str]]:
    """Return what the page's script reads, and notes on what the page leaves out.

    Positions are metres east and north on a conformal plane about the sites, rounded to float32; times are seconds
    after `t0` (UTC).
    """
    position = plot_positions(plots, sites)
    plane = plane_about(plots, position, updates.table, sites)
    placed = [(names.get(key, key), site) for key, site in sites.items() if np.isfinite(site.latitude)]
    t0, t1 = time_span(plots, updates) or (0.0, 0.0)
    on_plots, plot_notes = _plots(plots, position, updates, track_id, plane, t0)
    on_tracks, track_notes = _tracks(updates, innovations, plane, t0)
    on_plots["sources"] = [names.get(str(s.system), str(s.system)) for s in plots.sources]
    drawn = {
        "t0": t0,
        "t1": t1,
        "sites": [{"name": name, **_point(plane, site)} for name, site in placed],
        "reasons": list(REASONS),
        "plots": on_plots,
        **on_tracks,
    }
    return drawn, plot_notes + track_notes


def _point(plane: "Plane", site: "Site") -> dict[str, float]:
    x, y = np.asarray(plane.forward(site.latitude, site.longitude)).reshape(2)
    return {"x": round(float(x), 1), "y": round(float(y), 1)}


def within(plots: Plots) -> npt.NDArray[np.bool_]:
    """Return which reports are inside the time window of the run; all where it had none."""
    return np.asarray(plots.reason != _OUTSIDE)


def rows_within(tracks: "pa.Table", plots: Plots) -> "pa.Table":
    """Return the rows of tracks up to the last usable report; all where there is none.

    Tracks may coast for a while past the end of the recording or of the time window: nothing is known of it.
    """
    import pyarrow.compute as pc

    usable = plots.time[(plots.reason == 0) & np.isfinite(plots.time)]
    return tracks.filter(pc.less_equal(tracks["time"], float(usable.max()))) if len(usable) else tracks


def time_span(plots: Plots, updates: Updates) -> tuple[float, float] | None:
    """Return the first and last time (s, UTC) of usable plots and tracks, or of all in the window; None without any."""
    for times in (np.concatenate([plots.time[plots.reason == 0], updates.time]), plots.time[within(plots)]):
        finite = times[np.isfinite(times)]
        if len(finite):
            return float(finite.min()), float(finite.max())
    return None


def assigned_tracks(
    plots: Plots, assignments: "pa.Table", number: npt.NDArray[np.int64] | None = None
) -> npt.NDArray[np.float64]:
    """Return each plot's track id, NaN for none: of the rows given, else matched by file, category and record."""
    if number is not None:
        return numbers(assignments.select(["track_id"]), "track_id")[number]
    ids, record = numbers(assignments, "track_id"), numbers(assignments, "record")
    time = numbers(assignments, "time")
    if np.array_equal(record, plots.record) and np.array_equal(time, plots.time, equal_nan=True):
        return ids  # already in the order of the plots
    category = numbers(assignments, "category")
    source = texts(assignments, "source")
    known = {
        (Path(source[i]).name, int(category[i]) if category[i] == category[i] else -1, int(record[i])): ids[i]
        for i in np.flatnonzero(np.isfinite(ids) & np.isfinite(record))
    }
    categories = [-1 if s.system.category is None else s.system.category for s in plots.sources]
    files = [Path(name).name for name in plots.files]
    keys = zip(plots.file.tolist(), plots.source.tolist(), plots.record.tolist(), strict=True)
    return np.array([known.get((files[f], categories[s], r), np.nan) for f, s, r in keys], np.float64)


def _plots(
    plots: Plots,
    position: npt.NDArray[np.float64],
    updates: Updates,
    track_id: npt.NDArray[np.float64],
    plane: "Plane",
    t0: float,
) -> tuple[dict[str, object], list[str]]:
    notes = []
    xy = project(plane, position[:, 0], position[:, 1])
    inside = within(plots)
    drawable = np.flatnonzero(inside & np.isfinite(xy).all(axis=1) & np.isfinite(plots.time))
    n_inside, where = int(inside.sum()), "" if inside.all() else " in the time window"
    if n_inside < len(plots):
        notes.append(f"Not drawn, as outside the time window: {show(len(plots) - n_inside)} reports.")
    if len(drawable) < n_inside:
        notes.append(f"Not drawn for want of a position or a time: {show(n_inside - len(drawable))} reports{where}.")
    every = -(-len(drawable) // MAX_PLOTS)
    if every > 1:
        notes.append(
            f"One report in {every} is drawn, of {show(len(drawable))}{where}; only the picture leaves the others out."
        )
        drawable = drawable[::every]
    id_of = np.array([row.id for row in updates.rows], np.float64)
    k = np.searchsorted(id_of, track_id[drawable]) if len(id_of) else np.zeros(len(drawable), np.intp)
    k = np.where(np.isfinite(track_id[drawable]), k, -1)
    reason = plots.reason[drawable]
    kind = np.where(reason != 0, 2, np.where(np.isfinite(track_id[drawable]), 0, 1))
    columns: dict[str, object] = {
        "every": max(every, 1),
        "t": encode(plots.time[drawable] - t0, "f4"),
        "x": encode(xy[drawable, 0], "f4"),
        "y": encode(xy[drawable, 1], "f4"),
        "altitude": encode(plots.altitude[drawable], "f4"),
        "mode3a": encode(plots.mode3a[drawable], "i2"),
        "source": encode(plots.source[drawable], "u1"),
        "reason": encode(reason, "u1"),
        "class": encode(kind, "u1"),  # 0 used, 1 on no track, 2 rejected
        "track": encode(k, "i4"),
    }
    return columns, notes


def _tracks(
    updates: Updates, innovations: "pa.Table", plane: "Plane", t0: float
) -> tuple[dict[str, object], list[str]]:
    notes = []
    n = len(updates.time)
    every = -(-n // MAX_UPDATES)
    keep = np.arange(n)
    if every > 1:
        within = keep - updates.starts[updates.track]
        keep = keep[(within % every == 0) | (keep == updates.starts[updates.track + 1] - 1)]
        notes.append(f"One track update in {every} is drawn, of {show(n)}; the time plots are as coarse.")
    table = updates.table.take(keep)
    deg = np.radians(1.0)
    xy = project(plane, deg * numbers(table, "latitude"), deg * numbers(table, "longitude"))
    first = np.searchsorted(keep, updates.starts)
    columns: dict[str, object] = {
        "tracks": [
            {"id": r.id, "label": r.label, "callsign": r.callsign, "icao24": r.icao24, "mode3a": r.mode3a}
            | {"first": int(first[k]), "end": int(first[k + 1]), "confirmed": r.confirmed}
            | {"n": r.n_updates, "duration": round(r.duration, 1), "man": round(r.manoeuvre_s, 1)}
            for k, r in enumerate(updates.rows)
        ],
        "updates": {
            "t": encode(updates.time[keep] - t0, "f4"),
            "x": encode(xy[:, 0], "f4"),
            "y": encode(xy[:, 1], "f4"),
            "altitude": encode(numbers(table, "altitude"), "f4"),
            "speed": encode(numbers(table, "speed_mps"), "f4"),
            "course": quantise(numbers(table, "course_deg"), 0.01, "u2"),
            "ph": quantise(numbers(table, "p_manoeuvre_h"), 0.004, "u1"),
            "pv": quantise(vertical_chance(table), 0.004, "u1"),
            "status": encode(updates.status[keep], "u1"),
        },
        "gates": _gates(table, updates.time[keep], innovations, plane),
    }
    return columns, notes


def _gates(
    table: "pa.Table", time: npt.NDArray[np.float64], innovations: "pa.Table", plane: "Plane"
) -> dict[str, object]:
    """Return the gate of each update drawn, NaN where it has none."""
    row_of = {key: i for i, key in enumerate(zip(numbers(table, "track_id").tolist(), time.tolist(), strict=True))}
    keys = zip(numbers(innovations, "track_id").tolist(), numbers(innovations, "time").tolist(), strict=True)
    pairs = np.array([(row_of[key], j) for j, key in enumerate(keys) if key in row_of], np.intp).reshape(-1, 2)
    deg = np.radians(1.0)
    lat, lon = numbers(innovations, "latitude"), numbers(innovations, "longitude")
    xy = project(plane, deg * lat[pairs[:, 1]], deg * lon[pairs[:, 1]])
    columns = {"x": xy[:, 0], "y": xy[:, 1]}
    for name, column in (("e", "gate_e"), ("n", "gate_n"), ("nis", "nis"), ("dof", "dof")):
        columns[name] = numbers(innovations, column)[pairs[:, 1]]
    out: dict[str, object] = {"any": bool(len(pairs))}
    for name, values in columns.items():
        full = np.full(len(time), np.nan)
        full[pairs[:, 0]] = values
        out[name] = encode(full, "f4")
    return out
