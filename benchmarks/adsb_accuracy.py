"""How well does `saltus track` follow aircraft that send their own position, and does it see manoeuvres where none are?

    python benchmarks/adsb_accuracy.py RECORDING.ast REFERENCE.parquet --config sensors.toml

RECORDING holds CAT021 reports of one source; REFERENCE is a Parquet table of the same reports with what they say of
their velocity and the tracker does not use: `time` (UTC s), `icao24`, `gs_kt`, `track_deg`, and `pa`, the position's
accuracy category, of which 5 and better are taken. Tracked with default settings, and once more with exact time stamps
(`sigma_time = 0`, in a table of its own: sensors.toml must not name the source). Prints one table.
"""

import argparse
import contextlib
import io
import json
import tempfile
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from saltus import io as recordings
from saltus.config import load_config
from saltus.run import track_files

Array = npt.NDArray[np.float64]

_KNOT = 1852.0 / 3600.0
_TICK = 128.0  # per s: resolution of the time of day
_ACCURATE = 5  # of the position's accuracy category
_GROUPS = (("airborne, above 100 kt", 100.0, np.inf), ("on the ground, 5 to 100 kt", 5.0, 100.0))


def main() -> None:
    """Run both settings and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("reference", type=Path)
    parser.add_argument("--config", type=Path, required=True)
    options = parser.parse_args()
    config = load_config(options.config)
    system = recordings.read([options.recording], date=config.date, editions=config.editions).plots.sources[0].system
    exact = f"\n[[sensor]]\ncategory = 21\nsac = {system.sac}\nsic = {system.sic}\nsigma_time = 0.0\n"
    print(f"{'':44}{'speed error, kt':>22}{'course, degrees':>20}{'P(manoeuvre)':>14}")
    print(f"{'':36}{'reports':>8}{'median':>11}{'95 %':>11}{'median':>10}{'95 %':>10}{'above 1/2':>14}")
    for name, extra in (("default", ""), ("time stamps exact", exact)):
        figures, noise = tracked(options.recording, options.reference, options.config.read_text() + extra)
        print(f"{name}: {noise}")
        for group, low, high in _GROUPS:
            print(line(group, figures, low, high))


def tracked(recording: Path, reference: Path, config: str) -> tuple[dict[str, Array], str]:
    """Track, and join confirmed updates with what the aircraft said of itself at the same time."""
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        path = Path(folder) / "sensors.toml"
        path.write_text(config)
        track_files([recording], Path(folder) / "out", path, report=False)
        rows = pq.read_table(Path(folder) / "out" / "tracks.parquet")
        summary = json.loads((Path(folder) / "out" / "summary.json").read_text())
    said = pq.read_table(reference, columns=["time", "icao24", "gs_kt", "track_deg", "pa"])
    speed, accurate = column(said, "gs_kt"), column(said, "pa") >= _ACCURATE
    usable = np.flatnonzero(np.isfinite(speed) & accurate)
    of = {k: int(n) for n, k in zip(usable, keys(said, usable), strict=True)}
    mine = np.flatnonzero(rows["status"].to_numpy(zero_copy_only=False) == "confirmed")
    at = np.array([of.get(k, -1) for k in keys(rows, mine)])
    mine, at = mine[at >= 0], at[at >= 0]
    if not len(at):
        raise SystemExit(
            f"no update has the address and time of a row of {reference}: is the date of --config another?"
        )
    course = column(rows, "course_deg")[mine] - column(said, "track_deg")[at]
    ((_, noise),) = summary["noise"].items()
    shown = ", ".join(f"{k} {v['used']}" for k, v in noise.items() if k.startswith("sigma"))
    return {
        "said": speed[at],
        "speed": column(rows, "speed_mps")[mine] / _KNOT - speed[at],
        "course": (course + 180.0) % 360.0 - 180.0,
        "p": column(rows, "p_manoeuvre_h")[mine],
    }, f"{shown}, NIS {noise['nis_mean']}"


def column(table: pa.Table, name: str) -> Array:
    """Return a column as numbers."""
    return np.asarray(table[name].to_numpy(zero_copy_only=False), np.float64)


def keys(table: pa.Table, rows: npt.NDArray[np.int64]) -> list[tuple[str, int]]:
    """Return address and time of rows, which name a report."""
    time = np.rint(column(table, "time")[rows] * _TICK).astype(np.int64).tolist()
    return list(zip(table["icao24"].take(rows).to_pylist(), time, strict=True))


def line(group: str, figures: dict[str, Array], low: float, high: float) -> str:
    """Return one line of the table."""
    at = (figures["said"] > low) & (figures["said"] <= high)
    speed, course = np.abs(figures["speed"][at]), np.abs(figures["course"][at])
    cells = [f"{np.nanmedian(v):{w}.2f}{np.nanquantile(v, 0.95):{w}.1f}" for v, w in ((speed, 11), (course, 10))]
    return f"  {group:34}{at.sum():8d}{''.join(cells)}{100.0 * (figures['p'][at] > 0.5).mean():12.0f} %"


if __name__ == "__main__":
    main()
