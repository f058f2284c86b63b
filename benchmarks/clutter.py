"""How many confirmed tracks are false, where clutter is heavy: a surface radar, boats, the simulated demonstration.

    python benchmarks/clutter.py --airport FOLDER --boats joyridedata.mat

FOLDER holds `smr.ast`, `mlat.ast`, `adsb_v023.ast` and `sensors.toml` of one airport. A surface-radar track counts as
false when most of its updates have no target of multilateration or ADS-B within 150 m: vehicles and parked aircraft
without a working transponder are among them, with reflections and fixed echoes. A boat track counts as false when most
of its updates lie farther than 100 m from the reference. The demonstration's truth is known. Prints one table.
"""

import argparse
import contextlib
import io
import json
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow.parquet as pq

from saltus.demo import run_demo
from saltus.evaluate import FalseTracks, false_tracks
from saltus.evaluate.reference import make_reference
from saltus.geo import Plane, geodetic_to_ecef
from saltus.run import track_files

BOATS = """
date = 2017-05-18
[[sensor]]
name = "boats"
latitude = 63.44
longitude = 10.40
height = 0.0
[tracker]
max_speed = 30.0
clutter_density = 1e-8
[filter]
accel_h = [0.05, 1.0]
sojourn_h = [60.0, 20.0]
"""


class Row(NamedTuple):
    """One line of the table."""

    scene: str
    hours: float
    reports: int
    confirmed: int
    false: FalseTracks


def main() -> None:
    """Run what was asked for and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--airport", type=Path, help="folder with smr.ast, mlat.ast, adsb_v023.ast, sensors.toml")
    parser.add_argument("--boats", type=Path, help="joyridedata.mat")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        rows = [demonstration(Path(folder) / "demo")]
        if options.airport:
            rows.append(surface(options.airport, Path(folder) / "surface"))
        if options.boats:
            rows.append(boats(options.boats, Path(folder)))
    print(f"{'scene':34}{'hours':>7}{'reports':>9}{'confirmed':>11}{'false':>7}{'false/h':>9}{'95 % interval':>18}")
    for row in rows:
        false = row.false
        interval = f"{false.low:.1f} to {false.high:.1f}"
        print(
            f"{row.scene:34}{row.hours:7.2f}{row.reports:9d}{row.confirmed:11d}{false.n_false:7d}"
            f"{false.per_hour:9.1f}{interval:>18}"
        )


def surface(folder: Path, output: Path) -> Row:
    """Track the surface radar, and judge it by what multilateration and ADS-B track."""
    config = folder / "sensors.toml"
    summary = track_files([folder / "smr.ast"], output, config, report=False)
    track_files([folder / "mlat.ast", folder / "adsb_v023.ast"], output / "referee", config, report=False)
    tracks, referee = _updates(output), _updates(output / "referee")
    plane = Plane(float(np.radians(tracks["latitude"][0])), float(np.radians(tracks["longitude"][0])))
    return _judge("surface radar, nothing near", summary, tracks, _near_referee(tracks, referee, plane, 150.0))


def boats(mat: Path, folder: Path) -> Row:
    """Track the boats' radar, and judge it by the reference of the one known boat."""
    from scipy.io import loadmat

    data = loadmat(mat)
    time = data["time"].ravel()
    lines = ["time,x_m,y_m,source"]
    for t, z in zip(time, data["Z"].ravel(), strict=True):
        lines += [f"{float(t)},{x},{y},boats" for x, y in np.asarray(z, float).reshape(2, -1).T.tolist()]
    (folder / "boats.csv").write_text("\n".join(lines) + "\n")
    (folder / "boats.toml").write_text(BOATS)
    summary = track_files([folder / "boats.csv"], folder / "boats", folder / "boats.toml", report=False)
    tracks = _updates(folder / "boats")
    plane = Plane(*np.radians([63.44, 10.40]).tolist())
    latitude, longitude = plane.inverse(np.stack(list(data["Xgt"][:2]), axis=-1))
    truth = make_reference(np.zeros(len(time)), time, latitude, longitude)
    where = truth.at(np.zeros(len(tracks["time"]), np.intp), tracks["time"]).place
    ours = geodetic_to_ecef(np.radians(tracks["latitude"]), np.radians(tracks["longitude"]), 0.0)
    return _judge("boats, farther than 100 m", summary, tracks, np.linalg.norm(ours - where, axis=-1) < 100.0)


def demonstration(output: Path) -> Row:
    """Run the demonstration and judge it by its own truth."""
    run_demo(output, seed=0)
    summary = json.loads((output / "summary.json").read_text())
    tracks, truth = _updates(output), pq.read_table(output / "truth.parquet").to_pydict()
    referee = {name: np.array(truth[name], float) for name in ("time", "latitude", "longitude")}
    plane = Plane(float(np.radians(tracks["latitude"][0])), float(np.radians(tracks["longitude"][0])))
    return _judge("demonstration, two radars", summary, tracks, _near_referee(tracks, referee, plane, 2000.0))


def _updates(output: Path) -> dict[str, np.ndarray]:
    table = pq.read_table(output / "tracks.parquet")
    kept = table.filter(np.array(table["status"]) != "coasted")
    return {name: kept[name].to_numpy() for name in ("track_id", "time", "latitude", "longitude")}


def _near_referee(
    tracks: dict[str, np.ndarray], referee: dict[str, np.ndarray], plane: Plane, reach: float, window: float = 3.0
) -> np.ndarray:
    """Whether an update has a referee's position within `reach` m and `window` s."""
    ours = plane.forward(np.radians(tracks["latitude"]), np.radians(tracks["longitude"]))
    theirs = plane.forward(np.radians(referee["latitude"]), np.radians(referee["longitude"]))
    order = np.argsort(referee["time"])
    time, theirs = referee["time"][order], theirs[order]
    first = np.searchsorted(time, tracks["time"] - window)
    last = np.searchsorted(time, tracks["time"] + window)
    near = [
        bool((np.linalg.norm(theirs[a:b] - xy, axis=-1) < reach).any())
        for a, b, xy in zip(first, last, ours, strict=True)
    ]
    return np.array(near)


def _judge(scene: str, summary: dict, tracks: dict[str, np.ndarray], near: np.ndarray) -> Row:
    duration = summary["time_to"] - summary["time_from"]
    false = false_tracks(tracks["track_id"], np.where(near, 0, -1), duration=duration)
    return Row(scene, duration / 3600.0, summary["reports"]["read"], len(np.unique(tracks["track_id"])), false)


if __name__ == "__main__":
    main()
