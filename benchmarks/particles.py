"""What a particle costs, on the fusion example: 8 modes, 5 states, 3 measured components.

    python benchmarks/particles.py [-o results.json] [--particles N] [--rows T]

Rao-Blackwellised particles with the optimal proposal: microseconds per particle and row, in the kernel (by call) and
in all, next to the multimode filter's time per track and row with the same model, in the same run. Then how far the
particle filter's mean is from that of ten times as many particles, against the error it states.
"""

import argparse
import json
import platform
import time
from pathlib import Path

import numpy as np

from saltus.filters import imm_filter, particle_filter
from saltus.filters.backend import system_report
from saltus.filters.native import NativeStore
from saltus.simulate import simulate_hybrid
from saltus.studies.fusion import matrices

CALLS = ("expand", "copy_from", "step", "measure", "merged")
REPEATS = 5


def model():
    """The fusion example at one distance, chains drawn from their law."""
    cov0 = np.diag(np.square([0.1, 0.016, 100.0, 30.0, 3.0]))
    trans = [np.array([[0.8, 0.2], [0.2, 0.8]])] * 3
    return {**matrices("frozen")._asdict(), "trans": trans, "mean0": np.zeros(5), "cov0": cov0,
            "probs0": np.full((2, 2, 2), 1 / 8)}  # fmt: skip


def timed_calls():
    """Let every kernel call of a bank add its time to the table returned."""
    spent = dict.fromkeys(CALLS, 0.0)
    for name in CALLS:
        plain = getattr(NativeStore, name)

        def timed(*args, _plain=plain, _name=name, **kwargs):
            began = time.perf_counter()
            result = _plain(*args, **kwargs)
            spent[_name] += time.perf_counter() - began
            return result

        setattr(NativeStore, name, timed)
    return spent


def costs(arrays, n_particles, rows):
    """Microseconds per particle and row by kernel call and in all, and of imm_filter per track and row: the best."""
    spent = timed_calls()
    z = simulate_hybrid(**arrays, n_steps=rows, rng=np.random.default_rng(0), batch=4096).z
    best = {}
    for _ in range(REPEATS):
        for name in CALLS:
            spent[name] = 0.0
        began = time.perf_counter()
        particle_filter(z[0], **arrays, n_particles=n_particles, rng=np.random.default_rng(1), backend="native")
        total = time.perf_counter() - began
        began = time.perf_counter()
        imm_filter(z, **arrays, backend="native", num_threads=1)
        imm = (time.perf_counter() - began) / (4096 * rows)
        found = {**spent, "kernel": sum(spent.values()), "all": total}
        found = {name: 1e6 * value / (n_particles * rows) for name, value in found.items()} | {"imm_filter": 1e6 * imm}
        best = {name: min(value, best.get(name, np.inf)) for name, value in found.items()}
    return best


def accuracy(arrays, n_particles, rows=50):
    """Distance of the mean from that of ten times as many particles, and the error stated: root mean squares."""
    z = simulate_hybrid(**arrays, n_steps=rows, rng=np.random.default_rng(0)).z[0]
    small = particle_filter(z, **arrays, n_particles=n_particles, rng=np.random.default_rng(1))
    large = particle_filter(z, **arrays, n_particles=10 * n_particles, rng=np.random.default_rng(2))
    gap = (small.mean - large.mean)[..., None]
    distance = np.sqrt((gap.swapaxes(-1, -2) @ np.linalg.solve(large.cov, gap))[..., 0, 0])
    return {
        "distance_rms": float(np.sqrt(np.mean(distance**2))),
        "error_rms": float(np.sqrt(np.mean(small.error**2))),
        "within": float(np.mean(distance <= small.error)),
        "effective": float(small.effective.mean()),
    }


def main():
    """Measure, print a table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--particles", type=int, default=10_000)
    parser.add_argument("--rows", type=int, default=100)
    args = parser.parse_args()
    arrays = model()
    cost, found = costs(arrays, args.particles, args.rows), accuracy(arrays, args.particles)
    machine = f"{platform.machine()}, Python {platform.python_version()}, NumPy {np.__version__}, one core"
    print(f"{machine}; {system_report().get('instruction set', 'no kernel')}")
    print(f"{args.particles} particles, {args.rows} rows; best of {REPEATS}")
    for name, value in cost.items():
        print(f"{name:>12}  {value:.3f} us")
    print(
        f"mean within {found['distance_rms']:.4f} posterior sd (rms) of ten times as many particles; stated "
        f"{found['error_rms']:.4f} at 95 %, kept in {100 * found['within']:.0f} % of rows; "
        f"{100 * found['effective']:.0f} % of the particles count"
    )
    if args.output:
        record = {"machine": machine, "particles": args.particles, "rows": args.rows, "us": cost, **found}
        args.output.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
