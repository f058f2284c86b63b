"""`make fuzz`: mutate inputs for as long as wanted: by chance, or guided by coverage, which needs atheris.

    python tests/fuzz/long.py --seconds 3600 --seed 1 [--bytes 1e7] [--target csv ...] [--guided]

Prints a line for each target and writes every input that failed to tests/fuzz/corpus, named by its target: kept there,
`make test` reads it ever after.
"""

import argparse
import gc
import hashlib
import random
import sys
import tempfile
import time
from pathlib import Path
from types import FunctionType

sys.path.insert(0, str(Path(__file__).parent))

from fuzzing import CORPUS, Failed, Target, check, mutated
from targets import targets


def keep(target: Target, content: bytes, failure: Failed, seen: set[str]) -> None:
    """Write an input that failed in a way not seen before."""
    what = str(failure).split("\n")[0][:60]
    print(f"FAILED {what}: {failure}".replace("\n", " ")[:400], flush=True)
    if what not in seen:
        seen.add(what)
        CORPUS.mkdir(exist_ok=True)
        (CORPUS / f"{target.name}--{hashlib.sha256(content).hexdigest()[:12]}{target.suffix}").write_bytes(content)


def by_chance(chosen: list[Target], seconds: float, most: float, seed: int) -> int:
    """Mutate every target in turn until the time or the bytes are used up; return how many inputs failed."""
    draw = random.Random(seed)
    tally = {target.name: [0, 0, 0, 0, 0] for target in chosen}  # inputs, read, bytes fed, bytes mutated, failures
    seen: set[str] = set()
    end = time.monotonic() + seconds
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        while time.monotonic() < end and sum(row[3] for row in tally.values()) < most:
            for target in chosen:
                content, changed = mutated(draw, target)
                row = tally[target.name]
                row[0], row[2], row[3] = row[0] + 1, row[2] + len(content), row[3] + changed
                try:
                    row[1] += check(target, content, Path(folder)) == "read"
                except Failed as failure:
                    row[4] += 1
                    keep(target, content, failure, seen)
    print(f"{'target':<12}{'inputs':>9}{'read':>9}{'MB fed':>9}{'bytes mutated':>15}{'failures':>10}")
    for name, row in [*tally.items(), ("all", [sum(c) for c in zip(*tally.values(), strict=True)])]:
        print(f"{name:<12}{row[0]:>9}{row[1]:>9}{row[2] / 1e6:>9.1f}{row[3]:>15}{row[4]:>10}")
    return sum(row[4] for row in tally.values())


def guided(target: Target, seconds: float, seed: int) -> None:
    """Let atheris mutate one target, guided by the branches of saltus that its inputs reach; a failure ends it."""
    import atheris

    folder = Path(tempfile.mkdtemp())
    grown = Path("build/fuzz") / target.name
    grown.mkdir(parents=True, exist_ok=True)
    for k, content in enumerate(target.seeds):
        check(target, content, folder)  # imports what it needs
        (grown / f"seed-{k}").write_bytes(content)
    for function in gc.get_objects():
        if isinstance(function, FunctionType) and (function.__module__ or "").startswith("saltus."):
            atheris.instrument_func(function)

    def one(content: bytes) -> None:
        try:
            check(target, content, folder)
        except Failed as failure:
            keep(target, content, failure, set())
            raise

    options = [f"-max_total_time={seconds:.0f}", f"-seed={seed}", "-max_len=40000", "-print_final_stats=1", str(grown)]
    atheris.Setup([sys.argv[0], *options], one)
    atheris.Fuzz()


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--bytes", type=float, default=float("inf"), help="bytes mutated after which to stop")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--target", nargs="*", help="targets; all by default")
    parser.add_argument("--guided", action="store_true", help="with atheris, one target")
    parser.add_argument("--list", action="store_true", help="print the targets")
    given = parser.parse_args()
    known = targets()
    if given.list:
        print(" ".join(known))
        return
    chosen = [known[name] for name in given.target or known]
    if given.guided:
        guided(chosen[0], given.seconds, given.seed)
    elif by_chance(chosen, given.seconds, given.bytes, given.seed):
        sys.exit(1)


if __name__ == "__main__":
    main()
