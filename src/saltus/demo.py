"""The demonstration: simulate two radars, write ASTERIX, track the files, compare with the truth."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from saltus.evaluate import FalseTracks, Reference, TrackScores, false_tracks, track_scores
from saltus.evaluate.matching import match_rows
from saltus.evaluate.reference import each_time_once
from saltus.evaluate.tables import read_reference, tracks_of
from saltus.io.asterix_write import write_cat048
from saltus.io.write import output_directory, write_table, write_text
from saltus.simulate import Observations, observe
from saltus.simulate.scene import DURATION, Aircraft, RadarStation, demo_aircraft, demo_plane, demo_radars

if TYPE_CHECKING:
    from rich.table import Table

__all__ = ["Score", "Simulated", "run_demo", "score_demo", "write_demo"]

_DATE = "2025-06-01"
_MIDNIGHT = np.datetime64(_DATE).astype("datetime64[s]").astype(np.int64).item()
_START = 10 * 3600.0  # s after midnight: the scene's time 0
_FILES = ("radar_a.ast", "radar_b.ast")
_SCENE = (*_FILES, "sensors.toml", "truth.parquet")  # other commands read these: tracking them again leaves them
_CUTOFF = 1000.0  # m: no track follows an aircraft from further away
_SETTLED = 30.0  # s after a manoeuvre, from which flight counts as steady


class Simulated(NamedTuple):
    """What was written, and which aircraft each plot came from."""

    files: tuple[Path, ...]
    config: Path
    labels: tuple[npt.NDArray[np.int64], ...]  # per file, per record of CAT048: index of the aircraft, -1 = clutter


class Score(NamedTuple):
    """The tracks against the truth; arrays have one entry per aircraft."""

    tracks: TrackScores
    false: FalseTracks
    n_plots: npt.NDArray[np.int64]
    rmse: npt.NDArray[np.float64]  # m, horizontal, of confirmed rows; NaN without any
    p_turning: float  # mean probability of a horizontal manoeuvre while the aircraft turns or changes speed
    p_straight: float  # and 30 s or more after it has ceased


def run_demo(output: Path, seed: int) -> None:
    """Simulate a scene into OUTPUT, track it as any recording, print how well that went.

    Args:
        output: directory for radar_a.ast, radar_b.ast, sensors.toml, truth.parquet and the tracker's results, which
            appear together.
        seed: of the noise, the misses and the clutter.

    Raises:
        DataError: the output cannot be written.
    """
    from rich.console import Console

    from saltus.progress import progress_bar
    from saltus.run import Options, write_tracks
    from saltus.summary import show_summary

    console = Console(highlight=False)
    console.print(f"Two radars, {len(demo_aircraft())} aircraft, {DURATION / 60:.0f} minutes, seed {seed}.")
    with progress_bar() as bar, output_directory(output, "track", kept=_SCENE) as folder:
        simulated = _write_scene(folder, seed)
        summary, lines = write_tracks(simulated.files, folder, bar, Options(simulated.config))
    show_summary(summary, output, True, lines)
    tracks, assignments = (_table_of(output / f"{name}.parquet") for name in ("tracks", "assignments"))
    truth = read_reference(output / "truth.parquet")
    score = score_demo(tracks, assignments, simulated.labels, truth)
    console.print(_table(score))
    for line in _summary(score):
        console.print(line, soft_wrap=True)
    files = ", ".join(sorted(p.name for p in output.iterdir() if p.is_file() and not p.name.startswith(".")))
    console.print(f"Written to {output}: {files}", soft_wrap=True)


def _table_of(path: Path) -> pa.Table:
    with path.open("rb") as file:
        return pq.read_table(file)


def write_demo(output: Path, seed: int) -> Simulated:
    """Simulate the radars and write their recordings, the configuration and the truth.

    Raises:
        DataError: the output cannot be written.
    """
    with output_directory(output, "scene") as folder:
        labels = _write_scene(folder, seed).labels
    return Simulated(tuple(output / name for name in _FILES), output / "sensors.toml", labels)


def _write_scene(folder: Path, seed: int) -> Simulated:
    aircraft, plane, stations = demo_aircraft(), demo_plane(), demo_radars()
    trajectories = [a.trajectory for a in aircraft]
    labels = []
    streams = np.random.default_rng(seed).spawn(len(stations))
    for name, station, rng in zip(_FILES, stations, streams, strict=True):
        seen = observe(station.radar, trajectories, plane, 0.0, DURATION, rng)
        _write_recording(folder / name, station, seen, aircraft)
        labels.append(seen.target)
    write_text(folder / "sensors.toml", _configuration(stations))
    write_table(folder / "truth.parquet", _truth(aircraft))
    return Simulated(tuple(folder / name for name in _FILES), folder / "sensors.toml", tuple(labels))


def _write_recording(path: Path, station: RadarStation, seen: Observations, aircraft: Sequence[Aircraft]) -> None:
    """Write one radar's plots with the codes of their aircraft; clutter (target -1) takes the last entry, none."""
    write_cat048(
        path,
        sac=station.sac,
        sic=station.sic,
        time_of_day=_START + seen.time,
        range_m=seen.slant,
        azimuth_rad=seen.azimuth,
        altitude_m=seen.altitude,
        icao24=np.array([*(a.icao24 for a in aircraft), -1])[seen.target],
        mode3a=np.array([*(a.mode3a for a in aircraft), -1])[seen.target],
        callsign=np.array([*(a.name if a.icao24 >= 0 else "" for a in aircraft), ""])[seen.target],
        north_marker_times=_START + station.radar.north_times(0.0, DURATION),
    )


def _configuration(stations: Sequence[RadarStation]) -> str:
    lines = ["# The demonstration's radars. Their noise is left for the tracker to estimate.", f"date = {_DATE}"]
    for station in stations:
        site = station.radar.site
        lines += [
            "",
            "[[sensor]]",
            f'name = "{station.name}"',
            f"sac = {station.sac}",
            f"sic = {station.sic}",
            f"latitude = {np.degrees(site.latitude):.8f}",
            f"longitude = {np.degrees(site.longitude):.8f}",
            f"height = {site.height:.1f}",
        ]
    lines += [
        "",
        "# A third horizontal mode: one aircraft turns at 2.5 g.",
        "[filter]",
        "accel_h = [0.15, 4.0, 25.0]  # m/s^2, steady motion first",
        "sojourn_h = [120.0, 25.0, 15.0]  # s, mean stay in each mode",
    ]
    return "\n".join(lines) + "\n"


def _truth(aircraft: Sequence[Aircraft]) -> pa.Table:
    """Every aircraft's state each second: degrees, metres, m/s true east, north and up, as in tracks.parquet."""
    plane, seconds = demo_plane(), np.arange(DURATION + 1)
    tables = []
    for craft in aircraft:
        motion = craft.trajectory.at(seconds)
        state = np.stack([motion.position, motion.velocity], axis=-1)[:, :2].reshape(-1, 4)
        true = plane.to_true(state, np.zeros((len(state), 4, 4)), motion.position[:, 2])
        columns = {
            "target_id": pa.array([craft.name] * len(state)),
            "time": _MIDNIGHT + _START + seconds,
            "latitude": np.degrees(true.latitude),
            "longitude": np.degrees(true.longitude),
            "altitude": motion.position[:, 2],
            "ve": true.velocity[:, 0],
            "vn": true.velocity[:, 1],
            "vu": motion.velocity[:, 2],
            "turning": motion.turning,
            "mode3a": pa.array([f"{craft.mode3a:04o}"] * len(state)),
            "icao24": pa.array([f"{craft.icao24:06x}" if craft.icao24 >= 0 else None] * len(state), pa.string()),
        }
        tables.append(pa.table(columns).filter(pa.array(np.isfinite(motion.position[:, 0]))))
    return pa.concat_tables(tables)


def score_demo(
    tracks: pa.Table, assignments: pa.Table, labels: Sequence[npt.NDArray[np.int64]], truth: Reference
) -> Score:
    """Compare tracks with the truth: how plots were joined, and how near confirmed rows are to what they follow.

    Args:
        tracks: columns of tracks.parquet.
        assignments: columns of assignments.parquet.
        labels: of `Simulated`.
        truth: where the aircraft were.
    """
    label, track = _labelled(assignments, labels)
    sure = tracks.filter(pc.equal(tracks["status"], "confirmed"))
    sure = sure.take(each_time_once(sure["track_id"].to_numpy(), sure["time"].to_numpy()))
    rows, p = tracks_of(sure, statuses=("confirmed",)), sure["p_manoeuvre_h"].to_numpy()
    target, error = match_rows(rows, truth, cutoff=_CUTOFF)
    turning, steady = truth.turned(target, rows.time), ~truth.turned(target, rows.time, _SETTLED)
    confirmed = np.unique(rows.id)
    aircraft = [craft.name for craft in demo_aircraft()]
    squares = [np.square(error[target == truth.names.index(name)]).sum(axis=-1) for name in aircraft]
    return Score(
        tracks=track_scores(track, label, confirmed=confirmed),
        false=false_tracks(track, label, duration=DURATION, confirmed=confirmed),
        n_plots=np.bincount(label[label >= 0], minlength=len(aircraft)),
        rmse=np.array([np.sqrt(s.mean()) if len(s) else np.nan for s in squares]),
        p_turning=_mean(p[(target >= 0) & turning]),
        p_straight=_mean(p[(target >= 0) & steady]),
    )


def _labelled(
    assignments: pa.Table, labels: Sequence[npt.NDArray[np.int64]]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Aircraft and track of every report; -1 for clutter and for reports no track used."""
    files = {Path(name).name: k for k, name in enumerate(_FILES)}
    source = np.array([files[Path(name).name] for name in assignments.column("source").to_pylist()], np.int64)
    record = assignments.column("record").to_numpy()
    label = np.full(len(record), -1, np.int64)
    for k, known in enumerate(labels):
        label[source == k] = known[record[source == k]]
    return label, assignments.column("track_id").fill_null(-1).to_numpy().astype(np.int64)


def _mean(values: npt.NDArray[np.float64]) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _table(score: Score) -> "Table":
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in ("aircraft", "what it does", "mode"):
        table.add_column(name)
    for name in ("plots", "tracks", "on tracks", "RMSE, m"):
        table.add_column(name, justify="right")
    at = {int(k): i for i, k in enumerate(score.tracks.objects)}
    for k, craft in enumerate(demo_aircraft()):
        if k in at:
            n_tracks, share = score.tracks.per_object_tracks[at[k]], score.tracks.per_object_completeness[at[k]]
            cells = [str(score.n_plots[k]), str(n_tracks), f"{100 * share:.1f} %", f"{score.rmse[k]:.0f}"]
        else:
            cells = [str(score.n_plots[k]), "-", "-", "-"]
        table.add_row(craft.name, craft.doing, "S" if craft.icao24 >= 0 else "A/C", *cells)
    return table


def _summary(score: Score) -> list[str]:
    s, f = score.tracks, score.false
    rmse = score.rmse[np.isfinite(score.rmse)]
    spread = (
        f"{rmse.min():.0f} to {rmse.max():.0f} m, median {np.median(rmse):.0f} m" if len(rmse) else "no confirmed track"
    )
    return [
        f"Plots of aircraft on confirmed tracks: {100 * s.completeness:.2f} %. "
        f"Plots on a track of their own aircraft: {100 * s.purity:.2f} %. Tracks per aircraft: {s.fragmentation:.2f}.",
        f"False confirmed tracks: {f.n_false}, that is {f.per_hour:.0f} per hour (95 %: {f.low:.0f} to {f.high:.0f}).",
        f"Horizontal RMSE: {spread}.",
        f"Probability of horizontal manoeuvre: {score.p_turning:.2f} turning, {score.p_straight:.2f} in steady flight.",
    ]
