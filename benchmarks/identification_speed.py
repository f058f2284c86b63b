"""How long do two systems with as many tracks each take to be identified with each other?

    python benchmarks/identification_speed.py [-o results.json]

Aircraft of random place and course, all seen by both systems for a minute: a radar (50 m, every 4 s) and one of 20 m
every 5 s, both at times of their own, with an offset of 10 m between them that the ratio allows for. Timed on one core:
the pairs within reach (a tree), their multimode ratios row by row (the kernel), the assignment with margins of the last
ratios, and instead of that all decisions of the minute (one every 4 s). The answer is compared with the truth.
"""

import argparse
import json
import os
import platform
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from saltus.identify import (
    DecisionSettings,
    LocalTracks,
    PairSettings,
    as_evidence,
    candidate_pairs,
    decide_pairs,
    filled,
    pair_ratios,
)
from saltus.identify.assignment import best_with_margins

REACH = 2000.0  # m: six standard deviations of both errors and an offset, and more
SIDES = {"en route, 400 km x 400 km": 400e3, "dense, 150 km x 150 km": 150e3}


class Row(NamedTuple):
    """One line of the table; times in s."""

    scene: str
    tracks: int
    rows: int
    pairs: int
    candidates: float
    ratios: float
    assignment: float
    decisions: float
    identified: float
    false: int


def main() -> None:
    """Time the scenes and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, help="write the table as JSON")
    parser.add_argument("--tracks", type=int, default=2000, help="of each system")
    parser.add_argument("--repeat", type=int, default=5, help="the fastest of so many counts")
    options = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    rows = [measured(scene, side, options.tracks, options.repeat) for scene, side in SIDES.items()]
    print(f"{platform.machine()}, {platform.system()}, NumPy {np.__version__}, one core; s")
    print(
        f"{'scene':28}{'tracks':>12}{'pairs':>8}{'tree':>7}{'ratios':>8}{'assign':>8}{'sum':>7}{'decide':>8}"
        f"{'found':>8}{'false':>7}"
    )
    for r in rows:
        total = r.candidates + r.ratios + r.assignment
        print(
            f"{r.scene:28}{f'2 x {r.tracks}':>12}{r.pairs:8d}{r.candidates:7.3f}{r.ratios:8.3f}{r.assignment:8.3f}"
            f"{total:7.3f}{r.decisions:8.3f}{r.identified:8.4f}{r.false:7d}"
        )
    if options.output:
        options.output.write_text(json.dumps([r._asdict() for r in rows], indent=2) + "\n")


def measured(scene: str, side: float, n: int, repeat: int) -> Row:
    """Time each step, and compare what was declared with the truth."""
    a, b = simulated(side, n, np.random.default_rng(0))
    settings = PairSettings(
        offset_cov=100.0 * np.eye(2), region_cov=side**2 / 12.0 * np.eye(2), speed_sigma=150.0, accel_time=4.0
    )
    odds = -np.log(n)
    system = np.repeat([0, 1], n)
    best = np.full(4, np.inf)
    for _ in range(repeat):
        clock = [time.perf_counter()]
        pairs = candidate_pairs(a, b, settings, reach=REACH)
        clock.append(time.perf_counter())
        ratios = pair_ratios(a, b, pairs, settings)
        clock.append(time.perf_counter())
        chosen, margin = best_with_margins(pairs[:, 0], pairs[:, 1], filled(ratios)[:, -1] + odds)
        clock.append(time.perf_counter())
        decide_pairs(as_evidence(ratios, pairs + np.array([0, n])), system, DecisionSettings(prior=1.0 / (n + 1)))
        clock.append(time.perf_counter())
        best = np.minimum(best, np.diff(clock))
    declared = pairs[chosen[margin > np.log(999.0)]]
    right = int((declared[:, 0] == declared[:, 1]).sum())
    return Row(scene, n, len(a.time) + len(b.time), len(pairs), *best.tolist(), right / n, len(declared) - right)


def simulated(side: float, n: int, rng: np.random.Generator) -> tuple[LocalTracks, LocalTracks]:
    """Tracks of both systems, numbered alike."""
    place, course = rng.uniform(0.0, side, (n, 2)), rng.uniform(0.0, 2 * np.pi, n)
    velocity = rng.uniform(120.0, 250.0, n)[:, None] * np.stack([np.sin(course), np.cos(course)], axis=-1)
    systems = []
    for sd, period, offset in ((50.0, 4.0, np.zeros(2)), (20.0, 5.0, np.array([8.0, -6.0]))):
        count = int(60.0 / period)
        when = rng.uniform(0.0, period, (n, 1)) + period * np.arange(count)
        z = place[:, None] + velocity[:, None] * when[..., None] + offset + sd * rng.normal(size=(n, count, 2))
        R = np.broadcast_to(sd**2 * np.eye(2), (n * count, 2, 2))
        systems.append(LocalTracks(np.repeat(np.arange(n), count), when.ravel(), z.reshape(-1, 2), R))
    return systems[0], systems[1]


if __name__ == "__main__":
    main()
