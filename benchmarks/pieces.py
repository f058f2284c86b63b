"""Does `saltus track` write the same bytes in pieces of any size, and killed and resumed, on real recordings?

    python benchmarks/pieces.py FOLDER... [--kills 20] [--seed 1] [-o FILE.json]

Each FOLDER holds recordings (.ast, .pcap) and sensors.toml. They are tracked in one piece, in pieces of 1 000 and of
50 000 reports, in pieces of one report in their first five minutes, and by runs that are killed (SIGKILL) at random
moments and resumed until they come through. Prints which of tracks.parquet, assignments.parquet,
identifications.parquet and biases.json differ from those of the one piece. Of a run that ends in the middle it prints
how many rows of the whole one that were known by then are in it, unchanged (but for `time_to` of identifications).
"""

import argparse
import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq

TABLES = ("tracks.parquet", "assignments.parquet", "identifications.parquet", "biases.json")
_MINUTES = 300.0  # s of data fed one by one
_EVERY = "60"  # s of data between two states


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    rng, lines = np.random.default_rng(given.seed), []
    for folder in given.folders:
        for name, differ in _compared(folder, given.kills, rng):
            lines.append({"recording": folder.name, "run": name, "different": differ})
            print(f"{folder.name:28} {name:40} {', '.join(differ) or 'the same bytes'}", flush=True)
    if given.output:
        given.output.write_text(json.dumps(lines, indent=2) + "\n")
    sys.exit(any(line["different"] for line in lines))


def _compared(folder: Path, kills: int, rng: np.random.Generator) -> list[tuple[str, list[str]]]:
    inputs = [str(f) for f in sorted(folder.iterdir()) if f.suffix in (".ast", ".pcap")]
    inputs += ["--config", str(folder / "sensors.toml"), "--no-report"]
    out = []
    with tempfile.TemporaryDirectory() as place:
        whole, began = Path(place) / "whole", time.perf_counter()
        _track([*inputs, "-o", str(whole)])
        seconds = time.perf_counter() - began
        for chunk in ("1000", "50000"):
            _track([*inputs, "-o", f"{place}/{chunk}", "--chunk", chunk])
            out.append((f"--chunk {chunk}", _different(whole, Path(place) / chunk)))
        start = json.loads((whole / "summary.json").read_text())["time_from"]
        out.append(("ended in the middle", _changed(inputs, whole, Path(place) / "half")))
        end = datetime.fromtimestamp(start + _MINUTES, UTC).isoformat()
        _track([*inputs, "-o", f"{place}/short", "--to", end])
        _track([*inputs, "-o", f"{place}/ones", "--to", end, "--chunk", "1"])
        out.append(("five minutes, --chunk 1", _different(Path(place) / "short", Path(place) / "ones")))
        out.append((f"killed {kills} times and resumed", sorted(_killed(inputs, whole, kills, seconds, rng))))
    return out


def _changed(inputs: Sequence[str], whole: Path, half: Path) -> list[str]:
    """Track up to the middle; return what was known by then and is otherwise, with the shares that stay."""
    told = json.loads((whole / "summary.json").read_text())
    middle = 0.5 * (told["time_from"] + told["time_to"])
    _track([*inputs, "-o", str(half), "--to", datetime.fromtimestamp(middle, UTC).isoformat()])
    out = []
    for name in ("tracks", "identifications"):
        early, then = (_known(folder / f"{name}.parquet", middle) for folder in (whole, half))
        print(f"  {name}: {len(early & then)} of {len(early)} rows known by the middle stay", flush=True)
        if early - then:
            out.append(f"{name}.parquet")
    return out


def _known(path: Path, time: float) -> set[tuple[object, ...]]:
    """Rows known before a time."""
    table = pq.read_table(path)
    table = table.filter(pc.less(table["time_known"], time))
    return set(
        zip(
            *(
                column.to_pylist()
                for name, column in zip(table.column_names, table.columns, strict=True)
                if name != "time_to"
            ),
            strict=True,
        )
    )


def _killed(inputs: Sequence[str], whole: Path, kills: int, seconds: float, rng: np.random.Generator) -> set[str]:
    """Track, killed so often at random moments of a whole run's time, as many times as that takes; what differed."""
    differ: set[str] = set()
    done = 0
    while done < kills:
        with tempfile.TemporaryDirectory() as place:
            arguments = [*inputs, "-o", f"{place}/out", "--checkpoint", f"{place}/state", "--checkpoint-every", _EVERY]
            while _ended(arguments, float(rng.uniform(0.1, 1.0) * seconds) if done < kills else None):
                done += 1
            differ |= set(_different(whole, Path(place) / "out"))
    return differ


def _ended(arguments: Sequence[str], seconds: float | None) -> bool:
    """Go on with a run and kill it after so long; return whether it was."""
    run = subprocess.Popen(_command([*arguments, "--resume"]), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        code = run.wait(seconds)
    except subprocess.TimeoutExpired:
        run.send_signal(signal.SIGKILL)
        run.wait()
        return True
    if code:
        raise SystemExit(f"saltus track ended with {code}")
    return False


def _track(arguments: Sequence[str]) -> None:
    subprocess.run(_command(arguments), stdout=subprocess.DEVNULL, check=True)


def _command(arguments: Sequence[str]) -> list[str]:
    return [sys.executable, "-m", "saltus", "track", *arguments]


def _different(a: Path, b: Path) -> list[str]:
    return [name for name in TABLES if (a / name).read_bytes() != (b / name).read_bytes()]


if __name__ == "__main__":
    main()
