"""How much memory does reading take, against the size of a recording?

    .venv/bin/python benchmarks/reading_memory.py [--megabytes 50 200 500] [--json FILE]

A radar's CAT048 reports of 60 aircraft, 39 bytes each, are written piece by piece. Each way of reading them is a
process of its own, whose peak of resident memory is told, and its CPU time, the start included.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from saltus.asterix.codec import Column
from saltus.asterix.encode import blocks, encode
from saltus.asterix.layout import layout

AIRCRAFT, TURN, PER_BLOCK = 60, 4.0, 10
FORM = layout(48, "1.32")
WAYS = {
    "start of Python and Saltus": "from saltus.io import read; import saltus.io.asterix",
    "read: all reports in memory": "from saltus.io import read; n = len(read([path]).plots)",
    "read_in_order: chunks in order of time": (
        "from saltus.io import read_in_order; n = sum(len(r.plots) for r in read_in_order([path]))"
    ),
    "saltus info --full": "from pathlib import Path; from saltus.info import show_info; show_info([path], full=True)",
    "saltus convert, to Parquet": (
        "from saltus.convert import convert_files; convert_files([path], path.with_suffix('.parquet'))"
    ),
}
CHILD = """
import contextlib, io, resource, sys
from pathlib import Path
path, n = Path(sys.argv[1]), 0
with contextlib.redirect_stdout(io.StringIO()):
    exec(sys.argv[2])
used = resource.getrusage(resource.RUSAGE_SELF)
print(n, used.ru_maxrss / 1024.0, used.ru_utime + used.ru_stime)
"""


def piece(first: float, scans: int, rng: np.random.Generator) -> bytes:
    """Blocks of some scans of the radar."""
    n = AIRCRAFT * scans
    who = np.tile(np.arange(AIRCRAFT), scans)
    azimuth = 65536 * who // AIRCRAFT
    time = first + TURN * np.repeat(np.arange(scans), AIRCRAFT) + TURN * who / AIRCRAFT
    held = {
        "010/SAC": np.full(n, 25),
        "010/SIC": np.full(n, 1),
        "140": np.round(time % 86400.0 * 128).astype(np.int64),
        "020/TYP": np.full(n, 5),
        "040/RHO": 2560 + (np.arange(n) // AIRCRAFT * 7 + who * 311) % 40000 + rng.integers(0, 3, n),
        "040/THETA": azimuth + rng.integers(0, 9, n),
        "070/MODE3A": 0o1000 + who,
        "090/FL": np.full(n, 1200),
        "220": 0x400000 + who,
        "240": np.array([f"SAL{k:04d}" for k in who], "S8"),
        "161/TRN": who,
        "042/X": rng.integers(-9000, 9000, n),
        "042/Y": rng.integers(-9000, 9000, n),
        "200/GSP": rng.integers(0, 2000, n),
        "200/HDG": rng.integers(0, 65536, n),
        "170/CNF": np.zeros(n, np.int64),
        "230/STAT": np.zeros(n, np.int64),
    }
    records = encode(FORM, {path: Column(values, None, None) for path, values in held.items()})
    return blocks(48, records, np.arange(0, n, PER_BLOCK)).data


def write(path: Path, megabytes: float) -> None:
    """Write a recording of about this size."""
    rng, first, scans = np.random.default_rng(0), 0.0, 500
    with path.open("wb") as file:
        while file.tell() < megabytes * 1e6:
            file.write(piece(first, scans, rng))
            first += scans * TURN


def measured(path: Path, code: str) -> tuple[int, float, float]:
    """Reports, peak MB and CPU seconds of one way of reading."""
    done = subprocess.run([sys.executable, "-c", CHILD, str(path), code], check=True, capture_output=True, text=True)
    n, peak, seconds = done.stdout.split()
    return int(n), float(peak), float(seconds)


def main() -> None:
    """Print one row for each size and way."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--megabytes", type=float, nargs="+", default=[50.0, 200.0, 500.0])
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    rows = []
    print("| MB | how | reports | peak, MB | CPU, s |\n|---|---|---|---|---|")
    for megabytes in given.megabytes:
        with tempfile.TemporaryDirectory() as name:
            path = Path(name) / "radar.ast"
            write(path, megabytes)
            for how, code in WAYS.items():
                n, peak, seconds = measured(path, code)
                rows.append(
                    {"mb": path.stat().st_size / 1e6, "how": how, "reports": n, "peak_mb": peak, "cpu_s": seconds}
                )
                size = path.stat().st_size / 1e6
                print(f"| {size:.0f} | {how} | {n or ''} | {peak:.0f} | {seconds:.1f} |", flush=True)
    if given.json is not None:
        given.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
