"""Boats seen by a ferry: does the fusion beat its best sensor, and what are the chains of faults worth?

    python benchmarks/autoferry.py FOLDER

FOLDER holds scenarioN_detections.json and scenarioN_groundTruth.json of the Autoferry sensor fusion dataset. Each
scenario is tracked with radar alone, with lidar alone, with all four sensors, and with all of them by a tracker
without chains of faults; every run is scored at the same epochs of the truth, a missing track counting as 20 m. The
cameras give bearings alone and cannot be tracked by themselves. Harder cases are made of the same recordings: an
outage (the lidar silent for a third of the time), jamming (in that third errors of 20 m on both axes are added to the
lidar's, or to the radar's), and false detections (one detection in ten of radar and lidar moved by 20 m to one side or
another). Prints one table and writes it as JSON.
"""

import argparse
import contextlib
import importlib.util
import io
import json
import sys
import tempfile
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from saltus.run import track_files
from saltus.score import score_files

_EXAMPLES = Path(__file__).parents[1] / "examples"
_WITHOUT = "plot_outlier = 0.0\ndegraded_noise = 1.0\n"
_ALL = ("lidar", "radar", "ir", "eo")
_SHARE, _ASTRAY = 0.1, 20.0  # of the detections that are made false; m


class Row(NamedTuple):
    """One run against the truth."""

    scenario: str
    case: str
    sensors: str
    chains: bool
    rmse_missing20_m: float
    rmse_m: float
    completeness: float
    bias_east_m: float
    bias_north_m: float
    nees: float


def main() -> None:
    """Run everything and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="folder with the scenarios' JSON files")
    parser.add_argument("--json", type=Path, default=Path(__file__).with_name("results_autoferry.json"))
    given = parser.parse_args()
    example = _example()
    rows: list[Row] = []
    for path in sorted(given.folder.glob("scenario*_detections.json"), key=lambda p: int(_number(p))):
        detections = json.loads(path.read_text(encoding="utf-8"))
        truth = json.loads((given.folder / f"scenario{_number(path)}_groundTruth.json").read_text(encoding="utf-8"))
        rows += scenario(_number(path), example, detections, example.truth_table(truth))
    print(shown(rows))
    given.json.write_text(json.dumps([row._asdict() for row in rows], indent=1) + "\n", encoding="utf-8")


def scenario(name: str, example: ModuleType, detections: list[dict], truth: pa.Table) -> list[Row]:
    """Track and score one scenario in all cases."""
    tables = {only: example.measurement_table(detections, only) for only in (("radar",), ("lidar",), _ALL)}
    cases: list[tuple[str, tuple[str, ...], Callable[[pa.Table], pa.Table], bool]] = [
        ("as it is", ("radar",), lambda t: t, True),
        ("as it is", ("lidar",), lambda t: t, True),
        ("as it is", _ALL, lambda t: t, True),
        ("as it is", _ALL, lambda t: t, False),
        ("lidar silent", _ALL, silent, True),
        ("lidar silent", _ALL, silent, False),
        ("lidar jammed", ("radar",), lambda t: t, True),
        ("lidar jammed", ("lidar",), lambda t: jammed(t, "lidar"), True),
        ("lidar jammed", _ALL, lambda t: jammed(t, "lidar"), True),
        ("lidar jammed", _ALL, lambda t: jammed(t, "lidar"), False),
        ("radar jammed", ("radar",), lambda t: jammed(t, "radar"), True),
        ("radar jammed", ("lidar",), lambda t: t, True),
        ("radar jammed", _ALL, lambda t: jammed(t, "radar"), True),
        ("radar jammed", _ALL, lambda t: jammed(t, "radar"), False),
        ("false detections", ("radar",), astray, True),
        ("false detections", ("lidar",), astray, True),
        ("false detections", _ALL, astray, True),
        ("false detections", _ALL, astray, False),
    ]
    return [run(name, case, only, change(tables[only]), truth, chains) for case, only, change, chains in cases]


def silent(table: pa.Table) -> pa.Table:
    """Take the lidar away for the middle third of the time."""
    return table.filter((np.array(table["source"]) != "lidar") | ~_middle(table))


def jammed(table: pa.Table, source: str) -> pa.Table:
    """Add large errors to all detections of a sensor in the middle third of the time."""
    mine = np.flatnonzero((np.array(table["source"]) == source) & _middle(table))
    return _moved(table, mine, _ASTRAY * np.random.default_rng(3).standard_normal((len(mine), 2)))


def astray(table: pa.Table) -> pa.Table:
    """Move some detections of radar and lidar; the same ones whatever else is in the table."""
    for source, seed in (("radar", 1), ("lidar", 2)):
        mine = np.flatnonzero(np.array(table["source"]) == source)
        rng = np.random.default_rng(seed)
        moved = mine[rng.uniform(size=len(mine)) < _SHARE]
        angle = rng.uniform(0.0, 2.0 * np.pi, len(moved))
        table = _moved(table, moved, _ASTRAY * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    return table


def _middle(table: pa.Table) -> np.ndarray:
    time = table["time"].to_numpy()
    low, high = time.min() + np.ptp(time) * np.array([1 / 3, 2 / 3])
    return (time >= low) & (time <= high)


def _moved(table: pa.Table, which: np.ndarray, by: np.ndarray) -> pa.Table:
    for name, step in zip(("x_m", "y_m"), by.T, strict=True):
        values = table[name].to_numpy(zero_copy_only=False).copy()
        values[which] += step
        at = table.schema.get_field_index(name)
        table = table.set_column(at, name, pa.array(values, pa.float64(), from_pandas=True))
    return table


def run(name: str, case: str, only: tuple[str, ...], table: pa.Table, truth: pa.Table, chains: bool) -> Row:
    """Track one table and score it."""
    with tempfile.TemporaryDirectory() as text, contextlib.redirect_stdout(io.StringIO()):
        folder = Path(text)
        pq.write_table(table, folder / "measurements.parquet")
        pq.write_table(truth, folder / "truth.parquet")
        (folder / "boats.toml").write_text(settings(chains), encoding="utf-8")
        with contextlib.redirect_stderr(io.StringIO()):
            track_files([folder / "measurements.parquet"], folder / "out", folder / "boats.toml", report=False)
        score_files(folder / "out", folder / "truth.parquet", folder / "score.json", 20.0)
        score = json.loads((folder / "score.json").read_text(encoding="utf-8"))
    figures = {key: score[key] if score[key] is not None else float("nan") for key in Row._fields[4:]}
    return Row(name, case, "all" if only == _ALL else ",".join(only), chains, **figures)


def settings(chains: bool) -> str:
    """The example's configuration, with chains of faults or without."""
    text = (_EXAMPLES / "autoferry.toml").read_text(encoding="utf-8")
    if not chains:
        lines = [line for line in text.splitlines() if not line.startswith(("plot_outlier", "degraded"))]
        text = "\n".join(lines).replace("[tracker]\n", "[tracker]\n" + _WITHOUT)
    tomllib.loads(text)
    return text


def shown(rows: list[Row]) -> str:
    """The table as text, and what was asked for."""
    head = ("scenario", "case", "sensors", "chains", "RMSE, m", "of tracks", "complete", "bias e, n, m", "NEES")
    lines = [
        f"{head[0]:9}{head[1]:18}{head[2]:9}{head[3]:8}{head[4]:>9}{head[5]:>11}{head[6]:>10}{head[7]:>15}{head[8]:>7}"
    ]
    for r in rows:
        bias = f"{r.bias_east_m:.1f}, {r.bias_north_m:.1f}"
        lines.append(
            f"{r.scenario:9}{r.case:18}{r.sensors:9}{'yes' if r.chains else 'no':8}{r.rmse_missing20_m:9.2f}"
            f"{r.rmse_m:11.2f}{r.completeness:10.1%}{bias:>15}{r.nees:7.2f}"
        )
    lines.append("")
    for case in dict.fromkeys(r.case for r in rows):
        for name in dict.fromkeys(r.scenario for r in rows):
            mine = [r for r in rows if (r.case, r.scenario) == (case, name)]
            alone = [r.rmse_missing20_m for r in mine if r.sensors != "all"]
            fused = {r.chains: r.rmse_missing20_m for r in mine if r.sensors == "all"}
            best = f", best sensor alone {min(alone):.2f}" if alone else ""
            gain = 1.0 - fused[True] / fused[False]
            lines.append(f"{case}, scenario {name}: fusion {fused[True]:.2f}{best}; {gain:+.0%} against no chains")
    return "\n".join(lines)


def _number(path: Path) -> str:
    return path.name.removeprefix("scenario").split("_")[0]


def _example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("autoferry_to_table", _EXAMPLES / "autoferry_to_table.py")
    if spec is None or spec.loader is None:
        sys.exit("examples/autoferry_to_table.py is missing")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    main()
