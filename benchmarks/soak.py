"""Simulated hours through the program: do memory and time per report grow with the length of a recording?

    .venv/bin/python benchmarks/soak.py [--hours 1 4 12 24] [--targets 12] [--json FILE]

Each length is one process of `saltus track --no-report`; its CPU time includes the start.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from saltus.io.asterix_write import write_cat048

SITE = """date = 2025-06-01
[[sensor]]
sac = 25
sic = 1
latitude = 48.0
longitude = 11.0
height = 500.0
period = 4.0
"""
PERIOD = 4.0  # s


def record(path: Path, hours: float, targets: int, rng: np.random.Generator) -> int:
    """Write a radar's plots of aircraft that come and go for `hours`; return how many."""
    azimuth = 2.0 * np.pi * (np.arange(targets) + 0.5) / targets
    time = np.arange(0.0, 3600.0 * hours, PERIOD)[:, None] + azimuth * PERIOD / (2.0 * np.pi)
    # Each flies outward from 20 km and is gone for 60 s every quarter of an hour, when the next one follows.
    since = np.mod(time + 900.0 * np.arange(targets) / targets, 900.0)
    seen = (since > 60.0) & (rng.random(time.shape) < 0.97)
    slant = 20e3 + 150.0 * since + rng.normal(0.0, 50.0, time.shape)
    angle = azimuth + rng.normal(0.0, 1e-3, time.shape)
    order = np.argsort(time[seen])
    write_cat048(
        path,
        sac=25,
        sic=1,
        time_of_day=np.mod(time[seen][order], 86400.0),
        range_m=slant[seen][order],
        azimuth_rad=np.mod(angle[seen][order], 2.0 * np.pi),
        altitude_m=np.full(int(seen.sum()), 9144.0),
    )
    return int(seen.sum())


def track(folder: Path, hours: float, targets: int) -> dict[str, float]:
    """Track one length in a process of its own."""
    n = record(folder / "radar.ast", hours, targets, np.random.default_rng(0))
    (folder / "a.toml").write_text(SITE)
    command = [sys.executable, "-m", "saltus", "track", folder / "radar.ast", "-o", folder / "out"]
    code = (
        "import resource, subprocess, sys; subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL);"
        "u = resource.getrusage(resource.RUSAGE_CHILDREN); print(u.ru_utime + u.ru_stime, u.ru_maxrss)"
    )
    arguments = [*command, "--config", folder / "a.toml", "--no-report"]
    done = subprocess.run([sys.executable, "-c", code, *arguments], check=True, capture_output=True, text=True)
    seconds, kilobytes = (float(word) for word in done.stdout.split())
    return {"hours": hours, "reports": n, "cpu_s": seconds, "peak_mb": kilobytes / 1024.0}


def main() -> None:
    """Run the lengths and print one row for each."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--hours", type=float, nargs="+", default=[1.0, 4.0, 12.0, 24.0])
    parser.add_argument("--targets", type=int, default=12)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    rows = []
    print("| hours | reports | CPU, s | us a report | peak, MB |\n|---|---|---|---|---|")
    for hours in given.hours:
        with tempfile.TemporaryDirectory() as name:
            row = track(Path(name), hours, given.targets)
        rows.append(row)
        per = 1e6 * row["cpu_s"] / row["reports"]
        print(f"| {hours:g} | {row['reports']} | {row['cpu_s']:.1f} | {per:.0f} | {row['peak_mb']:.0f} |", flush=True)
    if given.json is not None:
        given.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
