"""Turn a scenario of the Autoferry sensor fusion dataset into a measurement table and a truth table.

    python examples/autoferry_to_table.py DETECTIONS.json TRUTH.json -o DIR [--only radar,lidar,ir,eo]

writes DIR/measurements.parquet, for `saltus track`, and DIR/truth.parquet, for `saltus score`. Radar and lidar give
x_m, y_m (east, north of the own ship), the cameras azimuth_deg; the own ship's place goes with every row. The dataset:
Helgesen et al. (2022), Ocean Engineering, https://github.com/Autoferry/sensor_fusion_dataset (CC0-1.0).
"""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from saltus.geo import ecef_to_geodetic, geodetic_to_ecef, local_basis

SENSORS = {1: "lidar", 2: "radar", 3: "ir", 4: "eo"}
BEARINGS = ("ir", "eo")
ORIGIN = (63.4389029083, 10.39908278, 39.923)  # of the Piren frame: degrees, degrees, m

Array = npt.NDArray[np.float64]


def main(detections: Path, truth: Path, output: Path, only: Sequence[str]) -> None:
    """Write both tables, or end with one line that says which file is not as it should be."""
    unknown = sorted(set(only) - set(SENSORS.values()))
    if unknown:
        sys.exit(f"--only {','.join(only)}: no sensor {unknown[0]!r}; there are {', '.join(SENSORS.values())}.")
    table = made(
        detections, "detections", "scans {sensorID, time, ownshipPosition, measurement}", measurement_table, only
    )
    true = made(truth, "truth", "lists of targets {targetID, time, position}", truth_table)
    output.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, output / "measurements.parquet")
    pq.write_table(true, output / "truth.parquet")
    counts = {name: table["source"].to_pylist().count(name) for name in only}
    print(f"{output}/measurements.parquet: " + ", ".join(f"{n} of {name}" for name, n in counts.items()))


def made(path: Path, what: str, entries: str, table: Callable[..., pa.Table], *more: Sequence[str]) -> pa.Table:
    """Make a table of a JSON file."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        sys.exit(f"{path}: {error.strerror}.")
    except ValueError as error:
        sys.exit(f"{path}: no JSON, or a part of it: {error}.")
    wanted = f"{what}: a list of {entries} is wanted"
    if not isinstance(content, list) or not content:
        sys.exit(f"{path}: {wanted}, and this is {'empty' if not content else 'none'}.")
    try:
        return table(content, *more)
    except (KeyError, TypeError, ValueError) as error:
        sys.exit(f"{path}: {wanted}, and an entry of this is another ({type(error).__name__}: {error}).")


def measurement_table(detections: Sequence[dict], only: Sequence[str] = tuple(SENSORS.values())) -> pa.Table:
    """Return one row per detection; a scan without any leaves none."""
    columns: dict[str, list[object]] = {name: [] for name in ("time", "source", "kind", "x_m", "y_m", "azimuth_deg")}
    ship: list[tuple[float, float]] = []
    for scan in detections:
        name = SENSORS[scan["sensorID"]]
        if name not in only:
            continue
        found = bearings(scan["measurement"]) if name in BEARINGS else positions(scan["measurement"])
        for row in found:
            columns["time"].append(scan["time"])
            columns["source"].append(name)
            columns["kind"].append("bearing" if name in BEARINGS else "plane")
            columns["x_m"].append(None if name in BEARINGS else row[0])
            columns["y_m"].append(None if name in BEARINGS else row[1])
            columns["azimuth_deg"].append(np.degrees(row[0]) % 360.0 if name in BEARINGS else None)
            ship.append(scan["ownshipPosition"])
    north, east = np.asarray(ship, np.float64).reshape(-1, 2).T
    numbers = {name: pa.array(columns[name], pa.float64()) for name in ("time", "x_m", "y_m", "azimuth_deg")}
    texts = {name: pa.array(columns[name], pa.string()) for name in ("source", "kind")}
    origin = zip(("origin_latitude", "origin_longitude", "origin_height_m"), ORIGIN, strict=True)
    frame = {name: np.full(len(east), value) for name, value in origin}
    return pa.table(numbers | texts | {"observer_x_m": east, "observer_y_m": north} | frame)


def positions(measurement: Sequence) -> Array:
    """East and north, (M, 2), of a row of norths and a row of easts; a single detection is a flat pair.

    Two detections make 2 x 2 numbers: a row is a coordinate there too, never a detection.
    """
    values = np.asarray(measurement, np.float64)
    return np.zeros((0, 2)) if not values.size else values.reshape(2, -1)[::-1].T


def bearings(measurement: float | Sequence[float]) -> Array:
    """Bearings, (M, 1), rad from north, clockwise; a single one is a bare number."""
    return np.asarray(measurement, np.float64).reshape(-1, 1)


def truth_table(truth: Sequence[Sequence[dict]]) -> pa.Table:
    """Return each target's distinct epochs: time, target_id, latitude, longitude, and x_m, y_m from the origin.

    The truth lists, for every scan, the newest fix of each target; a fix that is listed again is written once.
    """
    fixes = {(t["targetID"], t["time"]): t["position"] for targets in truth for t in targets}
    keys = sorted(fixes)
    north, east, down = np.array([fixes[k] for k in keys], np.float64).T
    latitude, longitude, height = np.radians(ORIGIN[0]), np.radians(ORIGIN[1]), ORIGIN[2]
    offset = np.stack([east, north, -down], axis=-1) @ local_basis(latitude, longitude)
    lat, lon, _ = ecef_to_geodetic(geodetic_to_ecef(latitude, longitude, height) + offset)
    return pa.table(
        {
            "time": [t for _, t in keys],
            "target_id": pa.array([str(k) for k, _ in keys], pa.string()),
            "latitude": np.degrees(lat),
            "longitude": np.degrees(lon),
            "x_m": east,
            "y_m": north,
        }
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Autoferry scenario to measurement and truth tables.")
    parser.add_argument("detections", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--only", default=",".join(SENSORS.values()), help="sensors to write, separated by commas")
    given = parser.parse_args()
    main(given.detections, given.truth, given.output, given.only.split(","))
