"""Kill what writes a folder of outputs at every call of the file system, and at random moments.

    python tests/crashing.py [--of track|files] [--kills N] [--seed S] [--way exchange|in-place]

Two runs of `saltus track` over one recording differ in their window of time (or two sets of small files, written in a
moment, differ in a byte). Over the outputs of one, the other is killed (SIGKILL); what
is left must be the whole of one set or the other, byte for byte. Where names cannot be exchanged files may be missing
until the next reader comes, and there is never one of each. The run after that removes every leftover. One process
imports the program once and forks for each kill. It prints one line of JSON, and fails when any folder was mixed.
"""

import argparse
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from saltus.io import publish
from saltus.io.asterix_write import write_cat048
from saltus.io.write import output_directory
from saltus.run import command, track_files

# What changes a folder; `saltus.io.publish` tells the exchange of two names as os.rename. Reads are no crash points.
CALLS = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.chmod", "os.chown", "shutil.rmtree")
SITE = """date = 2025-06-01
[[sensor]]
sac = 25
sic = 1
latitude = 48.0
longitude = 11.0
height = 500.0
period = 4.0
"""
SETS = {"long": None, "short": "10:01:20"}  # --to; the short run has one file less, the report


class Runs:
    """The two runs, a folder for their outputs, and what each leaves when nobody kills it."""

    def __init__(self, folder: Path, way: str, of: str) -> None:
        self.folder, self.out, self.way, self.of = folder, folder / "place" / "out", way, of
        self.out.parent.mkdir()
        self.record()
        command.time.perf_counter = lambda: 0.0  # a run's outputs tell how long it took
        self.whole = {}
        for name in SETS:
            self.run(name)
            self.whole[name] = self.contents()
        (self.out / "mine.txt").write_text("notes")

    def record(self) -> None:
        """Write the recording and the configuration."""
        folder = self.folder
        (folder / "sensors.toml").write_text(SITE)
        time_of_day = 36000.0 + 4.0 * np.arange(40)
        rng = np.random.default_rng(3)
        write_cat048(
            folder / "radar.ast",
            sac=25,
            sic=1,
            time_of_day=time_of_day,
            range_m=50e3 + 200.0 * (time_of_day - time_of_day[0]) + rng.normal(0.0, 35.0, 40),
            azimuth_rad=1.0 + rng.normal(0.0, 8e-4, 40),
            altitude_m=np.full(40, 9144.0),
        )

    def run(self, name: str) -> None:
        """Fill the folder."""
        if self.of == "files":
            with output_directory(self.out, "track") as folder:
                for file in ("a", "b", "c") if name == "long" else ("b", "c", "d"):
                    (folder / file).write_text(name)
            return
        track_files(
            [self.folder / "radar.ast"],
            self.out,
            self.folder / "sensors.toml",
            time_to=SETS[name],
            report=name == "long",
        )

    def contents(self) -> dict[str, bytes]:
        """Read the set."""
        files = [p for p in self.out.iterdir() if p.is_file() and p.name != "mine.txt" and p.name[0] != "."]
        return {p.name: p.read_bytes() for p in files}

    def which(self) -> str:
        """Say which set is in the folder, wholly or in part."""
        found = self.contents()
        for name, whole in self.whole.items():
            if found == whole:
                return name
        parts = [name for name, whole in self.whole.items() if found.items() <= whole.items()]
        return f"part of {parts[0]}" if parts and self.way == "in-place" else f"mixed {sorted(found)}"

    def left(self) -> list[str]:
        """Name what killed runs have left beside and in the folder."""
        return sorted(p.name for p in self.out.parent.rglob(".*") if p.name != publish.MANIFEST)


def child(runs: Runs, name: str, kill_at: int | None) -> int:
    """Fork, and run there until the call `kill_at`; return the process."""
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        if runs.way == "in-place":
            os.chdir(runs.out)
        calls = [0]

        def count(event: str, arguments: tuple[object, ...]) -> None:
            if event in CALLS:
                calls[0] += 1
                if calls[0] == kill_at:
                    os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(count)
        runs.run(name)
        status = 0
    finally:
        os._exit(status)


def killed(runs: Runs, name: str, *, at: int | None = None, after: float | None = None) -> bool:
    """Kill the run at a call or after some seconds; return whether it was still there to be killed."""
    pid = child(runs, name, at)
    if after is not None:
        time.sleep(after)
        os.kill(pid, signal.SIGKILL)
    _, status = os.waitpid(pid, 0)
    if not os.WIFSIGNALED(status) and os.waitstatus_to_exitcode(status):
        raise RuntimeError(f"the run {name!r} failed by itself")
    return os.WIFSIGNALED(status)


def judge(runs: Runs, old: str, new: str, found: dict[str, int]) -> None:
    """Look at what a kill left, as it is and as the next reader sees it."""
    seen = runs.which()
    publish.settle(runs.out)
    settled = runs.which()
    words = {old: "old", new: "new", f"part of {old}": "part", f"part of {new}": "part"}
    found[words.get(seen, "mixed")] += 1
    if settled not in (old, new) or seen.startswith("mixed") or (runs.out / "mine.txt").read_text() != "notes":
        found["mixed"] += 1
        print(f"{old} -> {new}: left {seen}, then {settled}", file=sys.stderr)


def crash(folder: Path, of: str, way: str, kills: int, seed: int) -> dict[str, object]:
    """Kill at every call and at random moments; return how often what was left."""
    runs = Runs(folder, way, of)
    names, found, points = list(SETS), dict.fromkeys(("old", "new", "part", "mixed", "not killed"), 0), 0
    runs.run(names[0])
    rng, spent = np.random.default_rng(seed), []
    k = 0
    while True:
        old = next(n for n in names if runs.which() == n)
        new = names[1 - names.index(old)]
        k += 1
        if not killed(runs, new, at=k):
            break
        points += 1
        judge(runs, old, new, found)
    for _ in range(3):
        began = time.monotonic()
        os.waitpid(child(runs, "long", None), 0)
        spent.append(time.monotonic() - began)
    for _ in range(kills):
        old = next(n for n in names if runs.which() == n)
        new = names[1 - names.index(old)]
        alive = killed(runs, new, after=rng.uniform(0.0, max(spent)))
        found["not killed"] += not alive
        judge(runs, old, new, found)
    os.waitpid(child(runs, "long", None), 0)
    return {"of": of, "way": way, "crash points": points, "random kills": kills, **found, "left behind": runs.left()}


def main() -> None:
    """Read the options, kill, and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--of", choices=["track", "files"], default="track")
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--way", choices=["exchange", "in-place"], default="exchange")
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp())
    silent = os.open(os.devnull, os.O_WRONLY)
    said = os.dup(1)
    os.dup2(silent, 1)  # what the runs say
    try:
        result = crash(folder, given.of, given.way, given.kills, given.seed)
    finally:
        os.dup2(said, 1)
        shutil.rmtree(folder)
    print(json.dumps(result))
    if result["mixed"] or result["left behind"]:
        sys.exit(1)


if __name__ == "__main__":
    main()
