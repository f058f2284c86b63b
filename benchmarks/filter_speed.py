"""How fast is the batch filter? Saltus against FilterPy, NumPy and JAX, and how its cost grows. Prints Markdown tables.

Every figure is the least of several repetitions of one call, in microseconds per track and step, in one process;
peers and Saltus keep mean, covariance and mode probabilities of every row, except where keep="last" is said. Ratios
within one run mean something, figures of different runs on a shared machine little.
"""

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import peers
from workloads import EIGHT_MODES, TWO_MODES, Array, Workload, flat, multiply_adds, product

from saltus import _native, imm_filter
from saltus.filters import Bank, Belief
from saltus.filters.backend import instruction_set

BATCHES = (1, 10, 100, 1000, 4096, 10_000, 100_000)
STEPS = 100
BUDGET = 1.0  # seconds spent on one figure
MOST_DOUBLES = 250_000_000  # of output, and of a peer's intermediate arrays

Row = dict[str, str | int | float]


def race(work: dict[Any, Callable[[], object]], budget: float = BUDGET) -> dict[Any, float]:
    """Seconds of the fastest repetition of each contender, taking turns: whatever else the machine does hits all."""
    best, spent = dict.fromkeys(work, float("inf")), dict.fromkeys(work, 0.0)
    for turn in range(40):
        for name, call in work.items():
            if turn > 2 and spent[name] > budget:
                continue
            start = time.perf_counter()
            result = call()
            seconds = time.perf_counter() - start
            del result  # outside the clock: giving memory back is not filtering
            best[name], spent[name] = min(best[name], seconds), spent[name] + seconds
    return best


def least(work: Callable[[], object], budget: float = BUDGET) -> float:
    """Seconds of the fastest repetition."""
    return race({"": work}, budget)[""]


def peak() -> float:
    """Fused multiply-adds this core does at most, in floating-point operations a second."""
    isa, rounds = instruction_set(), 2_000_000
    operations = rounds * 16 * _native.lanes(isa) * 2
    return operations / least(lambda: _native.multiply_adds(isa, rounds))


def saltus(w: Workload, z: Array, **options: object) -> Callable[[], object]:
    return partial(imm_filter, z, **w.arguments(), **options)


def row(workload: str, implementation: str, batch: int, threads: int, microseconds: float) -> Row:
    return {
        "workload": workload,
        "implementation": implementation,
        "batch": batch,
        "threads": threads,
        "us_per_track_step": round(microseconds, 5),
    }


def steps_for(batch: int, cost: float) -> int:
    """As many rows as a tenth of the budget allows at `cost` seconds a track-step, up to STEPS."""
    return int(np.clip(0.1 * BUDGET / (cost * batch), 2, STEPS))


def contenders(w: Workload, cores: int) -> dict[tuple[str, int], tuple[Callable[..., object], float, int]]:
    """Name and threads -> (maker of the work, seconds a track-step at most, largest batch)."""
    work = {
        ("saltus native", 1): (lambda z: saltus(w, z, backend="native", num_threads=1), 1e-6, 100_000),
        ("saltus native", 2): (lambda z: saltus(w, z, backend="native", num_threads=2), 1e-6, 100_000),
        ("saltus native keep=last", 1): (
            lambda z: saltus(w, z, backend="native", num_threads=1, keep="last"),
            1e-6,
            100_000,
        ),
        ("saltus numpy", 1): (lambda z: saltus(w, z, backend="numpy"), 3e-5, 10_000),
        ("numpy stacked", 1): (lambda z: peers.numpy_stacked(w, z), 2e-5, 10_000),
        ("filterpy", 1): (lambda z: peers.filterpy_imm(w, z), 1e-3, 10),
        ("jax vmap", cores): (lambda z: peers.jax_vmap(w, z), 1e-5, 10_000),
        ("jax unrolled", cores): (lambda z: peers.jax_unrolled(w, z), 1e-5, 10_000),
    }
    return work


def against_peers(w: Workload, cores: int) -> list[Row]:
    rows = []
    for batch in BATCHES:
        work, counts = {}, {}
        for key, (make, cost, largest) in contenders(w, cores).items():
            if batch > largest or (key[0].startswith("jax") and batch not in (1, 100, 4096, 10_000)):
                continue
            n_steps = STEPS if key[0].startswith(("saltus native", "jax")) else steps_for(batch, cost)
            counts[key] = min(n_steps, max(2, MOST_DOUBLES // (batch * 40)))
            work[key] = make(w.measurements(batch, counts[key]))
        for (name, threads), seconds in race(work).items():
            rows.append(row(w.name, name, batch, threads, seconds / batch / counts[name, threads] * 1e6))
    # The same answer, or the race means nothing.
    z = w.measurements(20, 5)
    reference = imm_filter(z, **w.arguments(), backend="numpy").mean
    for maker in (peers.numpy_stacked, peers.filterpy_imm, peers.jax_vmap, peers.jax_unrolled):
        np.testing.assert_allclose(maker(w, z)()(), reference, rtol=1e-9, atol=1e-9)
    return rows


def growth() -> list[Row]:
    """Cost with modes (product chains against one flat chain), states and steps; batch 4096, one thread."""
    rows, batch = [], 4096

    def add(w: Workload, label: str, n_steps: int = 20, **options: object) -> None:
        z = w.measurements(batch, n_steps)
        seconds = least(saltus(w, z, backend="native", num_threads=1, **options), 0.5)
        rows.append(row(w.name, label, batch, 1, seconds / batch / n_steps * 1e6))

    last = "saltus native keep=last"
    for sizes in ((2,), (2, 2), (2, 2, 2), (4, 4), (2, 2, 2, 2), (2, 4, 4), (4, 4, 4), (2, 2, 2, 2, 2, 2)):
        w = product(f"modes {'x'.join(map(str, sizes))}, n=4, m=2", sizes, 4, 2)
        add(w, last, keep="last")
        if len(sizes) > 1:
            add(flat(w), last, keep="last")
    for n in range(1, 13):
        add(product(f"2 modes, n={n}, m={min(n, 2)}", (2,), n, min(n, 2)), last, keep="last")
    for n_steps in (10, 100, 1000):
        w = product(f"2 modes, n=4, m=2, {n_steps} steps", (2,), 4, 2)
        add(w, last, n_steps, keep="last")
    return rows


def per_track() -> list[Row]:
    """F and Q for every track and row (irregular intervals of each), against matrices all share."""
    rows, batch, n_steps = [], 4096, 25
    for w in (TWO_MODES, EIGHT_MODES):
        z, shared = w.measurements(batch, n_steps), w.arguments()
        own = {k: np.broadcast_to(shared[k], (batch, n_steps, *shared[k].shape)).copy() for k in ("F", "Q")}
        models = {"shared": shared, "per track": {**shared, **own}}
        work = {
            (label, keep): partial(imm_filter, z, **model, backend="native", num_threads=1, keep=keep)
            for keep in ("last", "all")
            for label, model in models.items()
        }
        for (label, keep), seconds in race(work).items():
            us = seconds / batch / n_steps * 1e6
            rows.append(row(f"{w.name}, {label} F and Q", f"saltus native keep={keep}", batch, 1, us))
    return rows


def one_object() -> list[Row]:
    """A bank of one track: one step and one update, called from Python."""
    rows = []
    for w in (TWO_MODES, EIGHT_MODES):
        bank = Bank(w.n, w.sizes, backend="native")
        law = np.log(np.full((1, *w.sizes), 1.0 / np.prod(w.sizes)))
        mean, cov = np.zeros((1, *w.sizes, w.n)), np.broadcast_to(np.eye(w.n), (1, *w.sizes, w.n, w.n))
        track = bank.add(Belief(law, mean, cov))
        F, Q, H, R = (a[None] for a in (w.F, w.Q, w.H, w.R))
        z = np.zeros((1, w.m))

        def work(bank=bank, track=track, w=w, F=F, Q=Q, H=H, R=R, z=z) -> None:
            for _ in range(1000):
                bank.step(track, w.trans, F, None, Q)
                bank.update(track, z, H, None, R)

        rows.append(row(w.name, "saltus Bank step + update, one call each", 1, 1, least(work) / 1000 * 1e6))
    return rows


def find(rows: list[Row], workload: str, implementation: str, batch: int, threads: int | None = None) -> float:
    hits = [
        float(r["us_per_track_step"])
        for r in rows
        if (r["workload"], r["implementation"], r["batch"]) == (workload, implementation, batch)
        and threads in (None, r["threads"])
    ]
    return min(hits, default=float("nan"))


def table(header: list[str], lines: list[list[str]]) -> None:
    print("\n| " + " | ".join(header) + " |\n|" + "---|" * len(header))
    for line in lines:
        print("| " + " | ".join(line) + " |")


def number(x: float) -> str:
    return "" if np.isnan(x) else f"{x:.3g}" if x < 1000 else f"{x:.0f}"


def report_peers(rows: list[Row], w: Workload) -> None:
    names = list(dict.fromkeys((str(r["implementation"]), int(r["threads"])) for r in rows if r["workload"] == w.name))
    lines = [
        [
            f"{name}, {threads} thread{'s' * (threads > 1)}",
            *(number(find(rows, w.name, name, b, threads)) for b in BATCHES),
        ]
        for name, threads in names
        if not name.startswith("saltus Bank")
    ]
    print(f"\n## {w.name}: µs per track-step by batch")
    table(["", *map(str, BATCHES)], lines)


def report_ratios(rows: list[Row], top: float) -> None:
    lines = []
    for w in (TWO_MODES, EIGHT_MODES):
        one, two = (find(rows, w.name, "saltus native", 4096, t) for t in (1, 2))
        last = find(rows, w.name, "saltus native keep=last", 4096)
        jax = min(find(rows, w.name, f"jax {kind}", 4096) for kind in ("vmap", "unrolled"))
        shared, own = (
            find(rows, f"{w.name}, {kind} F and Q", "saltus native keep=last", 4096) for kind in ("shared", "per track")
        )
        lines.append(
            [
                w.name,
                number(find(rows, w.name, "filterpy", 10) / one),
                number(find(rows, w.name, "numpy stacked", 10_000) / one),
                number(jax / two),
                number(one / two),
                number(own / shared),
                f"{multiply_adds(w) / last / 1e3 / (top / 1e9) * 100:.0f} %",
            ]
        )
    print("\n## Ratios, batch 4096, everything kept (FilterPy at 10, NumPy at 10 000, where they are fastest)")
    table(
        ["", "FilterPy", "NumPy", "faster JAX / 2 threads", "2 threads", "per-track F, Q", "of FMA peak, keep=last"],
        lines,
    )


def report_rest(rows: list[Row]) -> None:
    known = {w.name for w in (TWO_MODES, EIGHT_MODES)}
    print("\n## Growth and other cases, µs per track-step")
    table(
        ["workload", "implementation", "batch", "µs"],
        [
            [str(r["workload"]), str(r["implementation"]), str(r["batch"]), number(float(r["us_per_track_step"]))]
            for r in rows
            if r["workload"] not in known or str(r["implementation"]).startswith("saltus Bank")
        ],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("benchmarks/results.json"))
    arguments = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    top = peak()
    print(f"{platform.machine()}, {cores} cores, instruction set {instruction_set()}, ", end="")
    print(f"NumPy {np.__version__}, FMA peak {top / 1e9:.1f} GFLOP/s on one core")
    rows = []
    for w in (TWO_MODES, EIGHT_MODES):
        rows += against_peers(w, cores)
        report_peers(rows, w)
    rows += one_object() + per_track() + growth()
    report_ratios(rows, max(top, peak()))
    report_rest(rows)
    arguments.output.write_text(json.dumps(rows, indent=1) + "\n")
    print(f"\n{len(rows)} rows written to {arguments.output}")


if __name__ == "__main__":
    main()
