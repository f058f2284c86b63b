"""How well does `saltus track` follow real aircraft, judged by what they themselves downlink?

    python benchmarks/tracking_accuracy.py RECORDING.ast REFERENCE.parquet --config sensors.toml

Tracks the recording in processes of their own (whose time and memory are taken) with identities used and ignored,
then judges by them: the Mode S address says whose plot is whose, I048/230 whether it was airborne, and BDS 5,0 (true
track angle, roll angle and ground speed, taken from the reference table) where the aircraft was going.

The reference is a Parquet table of the same reports: `time` (UTC s), `rho_nm`, `theta_deg`, `bds50_track_deg`,
`bds50_roll_deg`, `bds50_gs_kt`. Intervals are 95 % bootstrap intervals over aircraft. Prints one table and writes
the same as JSON.
"""

import argparse
import json
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from saltus import io
from saltus.config import load_config
from saltus.evaluate import track_scores
from saltus.evaluate.plots import KNOT, downlinked, followed
from saltus.records import Plots

_MIN_PLOTS, _MIN_TRACK, _MIN_SPEED = 10, 5, 100.0  # airborne plots of an aircraft, plots of a track, kt
_REPLICATES = 400

_STATISTICS: dict[str, Callable[[npt.NDArray[np.float64]], float]] = {
    "median": lambda v: float(np.median(v)),
    "95th percentile": lambda v: float(np.quantile(v, 0.95)),
    "RMS": lambda v: float(np.sqrt(np.mean(np.square(v)))),
}
_WANTED = {
    ("course error", "straight", "median"): "<= 0.16",
    ("course error", "straight", "95th percentile"): "<= 1.0",
    ("ground-speed error", "straight", "median"): "<= 1.3",
    ("ground-speed error", "straight", "RMS"): "<= 3.5",
    ("course error", "turning", "median"): "<= 2.0",
    ("course error", "turning", "95th percentile"): "<= 5.5",
}

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


class Figure(NamedTuple):
    """One line of the table."""

    name: str
    value: float
    low: float = np.nan
    high: float = np.nan
    wanted: str = ""
    count: str = ""


class Run(NamedTuple):
    """The program's tables, joined to the reports of the recording, and what the run cost."""

    plots: Plots
    track: Index  # of each report, -1 none
    course: Array  # degrees, of the row that the report updated; NaN none
    speed: Array  # m/s
    seconds: float
    memory: float  # bytes


def track(recording: Path, config: Path, identity: str) -> Run:
    """Run the program and read what it wrote."""
    with tempfile.TemporaryDirectory() as folder:
        code = "from saltus.cli import main; main()"
        options = ["--config", str(config), "--identity", identity, "--no-report", "-o", folder]
        began = time.perf_counter()
        subprocess.run([sys.executable, "-c", code, "track", str(recording), *options], check=True, stdout=sys.stderr)
        seconds = time.perf_counter() - began
        memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024.0
        rows, assigned = (pq.read_table(Path(folder) / f"{name}.parquet") for name in ("tracks", "assignments"))
    settings = load_config(config)
    plots = io.read([recording], date=settings.date, editions=settings.editions).plots
    plots = plots.take(plots.reason == 0)
    own = {key: k for k, key in enumerate(pairs(assigned, "category", "record"))}
    categories = [s.system.category for s in plots.sources]
    at = [own[categories[s], r] for s, r in zip(plots.source.tolist(), plots.record.tolist(), strict=True)]
    found = followed(plots, rows, assigned.take(at))
    return Run(plots, np.where(found.track > 0, found.track, -1), found.course, found.speed, seconds, memory)


def pairs(table: pa.Table, first: str, second: str) -> list[tuple[object, ...]]:
    return list(zip(table[first].to_pylist(), table[second].to_pylist(), strict=True))


def estimate(
    name: str,
    parts: Sequence[Array],
    statistic: Callable[[Array], float],
    wanted: str = "",
    unit: str = "plots",
) -> Figure:
    """A statistic of all parts (one per aircraft) joined, with its bootstrap interval over the parts."""
    parts = [p for p in parts if len(p)]
    joined = np.concatenate([np.zeros(0), *parts])
    rng = np.random.default_rng(0)
    draws = [
        statistic(np.concatenate([parts[k] for k in rng.integers(0, len(parts), len(parts))]))
        for _ in range(_REPLICATES if parts else 0)
    ]
    low, high = np.quantile(draws, [0.025, 0.975]) if draws else (np.nan, np.nan)
    count = f"{len(joined)} {unit}" + (f", {len(parts)} aircraft" if unit != "aircraft" else "")
    return Figure(name, statistic(joined) if len(joined) else np.nan, low, high, wanted, count)


def association(run: Run) -> list[Figure]:
    """Purity, completeness, tracks per aircraft; airborne, and apart from it on the ground."""
    plots, figures = run.plots, []
    confirmed = np.unique(run.track[run.track >= 0])
    for where, on_ground in (("airborne", 0), ("ground", 1)):
        label = np.where((plots.on_ground == on_ground) & (plots.icao24 >= 0), plots.icao24, -1).astype(np.int64)
        score = track_scores(run.track, label, confirmed=confirmed, min_plots=_MIN_PLOTS)
        owner = majority(run.track, label)
        pure = [
            (owner[mine] == aircraft).astype(float)
            for aircraft in np.unique(label[label >= 0])
            for mine in [(label == aircraft) & (run.track >= 0)]
        ]
        covered = [(run.track[label == aircraft] >= 0).astype(float) for aircraft in score.objects]
        tracks = [np.array([float(n)]) for n in score.per_object_tracks]
        limits = (">= 99.8 %", ">= 98 %", "<= 1.2") if on_ground == 0 else ("", "", "")
        percent, number = (lambda v: 100.0 * float(v.mean())), (lambda v: float(v.mean()))
        judged = [
            estimate(f"purity, {where}, %", pure, percent, limits[0]),
            estimate(f"completeness, {where}, %", covered, percent, limits[1]),
            estimate(f"confirmed tracks per aircraft, {where}", tracks, number, limits[2], "aircraft"),
        ]
        again = (100.0 * score.purity, 100.0 * score.completeness, score.fragmentation)
        np.testing.assert_allclose([f.value for f in judged], again, rtol=1e-9)  # two ways of counting
        figures += judged
    named = np.unique(run.track[(run.track >= 0) & (plots.icao24 >= 0)])
    figures.append(
        Figure("confirmed tracks", len(confirmed), count=f"{len(confirmed) - len(named)} without any address")
    )
    return figures


def majority(track: Index, label: Index) -> Index:
    """The label that most labelled plots of each plot's track have, -1 none; the lowest wins a tie."""
    owner = np.full(len(track), -1, np.int64)
    for number in np.unique(track[(track >= 0) & (label >= 0)]):
        names, counts = np.unique(label[(track == number) & (label >= 0)], return_counts=True)
        owner[track == number] = names[counts.argmax()]
    return owner


def motion(run: Run, reference: Path) -> list[Figure]:
    """Errors of course and ground speed against the aircraft's own, in straight flight and in turns."""
    truth = downlinked(run.plots, reference)
    numbers, counts = np.unique(run.track[run.track >= 0], return_counts=True)
    long = np.isin(run.track, numbers[counts >= _MIN_TRACK])
    good = long & np.isfinite(truth.course + truth.speed + run.course) & (truth.speed > _MIN_SPEED * KNOT)
    off = np.abs((run.course - truth.course + 180.0) % 360.0 - 180.0)
    slow = np.abs(run.speed - truth.speed) / KNOT
    figures = []
    for where, stretch in (("straight", truth.straight), ("turning", truth.turning)):
        mine = good & stretch
        aircraft = np.unique(run.plots.icao24[mine])
        for name, error, unit in (("course error", off, "degrees"), ("ground-speed error", slow, "kt")):
            parts = [error[mine & (run.plots.icao24 == a)] for a in aircraft]
            figures += [
                estimate(f"{name}, {where}, {word}, {unit}", parts, statistic, _WANTED.get((name, where, word), ""))
                for word, statistic in _STATISTICS.items()
            ]
    return figures


def cost(run: Run) -> list[Figure]:
    """Time and memory of the program's own process, decoding and imports included."""
    return [
        Figure("wall time, s", run.seconds, wanted="<= 60", count=f"{len(run.plots)} plots"),
        Figure("peak memory, MB", run.memory / 1e6, wanted="<= 1000"),
    ]


def shown(figures: Sequence[Figure], title: str) -> str:
    """The table as text."""
    lines = [("figure", "value", "95 % interval", "wanted", "counted")]
    for f in figures:
        interval = f"{f.low:.4g} to {f.high:.4g}" if np.isfinite(f.low) else ""
        lines.append((f.name, f"{f.value:.5g}", interval, f.wanted, f.count))
    widths = [max(len(line[k]) for line in lines) for k in range(5)]
    text = ["  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines]
    return "\n".join([title, "", text[0], "-" * max(map(len, text)), *text[1:]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path, help="CAT048 recording")
    parser.add_argument("reference", type=Path, help="Parquet table of the same reports with BDS 5,0")
    parser.add_argument("--config", type=Path, required=True, help="sensors.toml of the recording")
    parser.add_argument("--identity", choices=["use", "ignore", "both"], default="both")
    parser.add_argument(
        "--json", type=Path, default=Path(__file__).with_name("results_tracking.json"), help="where to write"
    )
    given = parser.parse_args()
    found = json.loads(given.json.read_text()) if given.json.exists() else {}
    machine = f"{platform.machine()}, Python {platform.python_version()}, NumPy {version('numpy')}"
    for identity in ["use", "ignore"] if given.identity == "both" else [given.identity]:
        run = track(given.recording, given.config, identity)
        figures = [*association(run), *motion(run, given.reference), *cost(run)]
        title = f"saltus {version('saltus')} track {given.recording.name}, identity {identity} ({machine})"
        print(shown(figures, title), end="\n\n")
        rows = [{k: None if v != v else v for k, v in f._asdict().items()} for f in figures]
        found[f"tracking_accuracy_{identity}"] = {"what": title, "figures": rows}
    given.json.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
