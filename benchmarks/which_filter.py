"""Which filter? Accuracy against time, for every filter in the package that estimates a state.

    python benchmarks/which_filter.py [-o results.json] [--figure PICTURE.png] [--trials N]

Three problems: the fusion example (linear, 8 modes, 5 states), a double well with a hidden mode (one state, case a1 of
the moment-filter notes), and range and bearing of a point drawn to one of two goals (two states, case c). The error of
the mean in posterior standard deviations (rms over runs, rows and components) and of the mode probabilities, against a
reference of many times the effort; microseconds per measurement of one run, vectorised over the runs, one core.
"""

import argparse
import json
import platform
import time
from pathlib import Path

import numpy as np

from saltus import DiffusionSensor, GridFilter, MomentFilter, ParticleFilter, SwitchingSDE
from saltus.filters import GPB1, GPB2, GaussianSumFilter, MergingRule, exact_filter, imm_filter, particle_filter
from saltus.simulate import simulate_diffusion, simulate_hybrid
from saltus.studies.fusion import matrices

RULES = {"GPB1": GPB1, "GPB2": GPB2, "30 best histories": MergingRule(most=30)}


def linear(trials):
    """The fusion example, chains drawn from their law, and its filters."""
    arrays = {
        **matrices("frozen")._asdict(),
        "trans": [np.array([[0.8, 0.2], [0.2, 0.8]])] * 3,
        "mean0": np.zeros(5),
        "cov0": np.diag(np.square([0.1, 0.016, 100.0, 30.0, 3.0])),
        "probs0": np.full((2, 2, 2), 1 / 8),
    }
    z = simulate_hybrid(**arrays, n_steps=40, rng=np.random.default_rng(0), batch=trials).z

    def rng():
        return np.random.default_rng(1)

    filters = {"IMM": lambda: imm_filter(z, **arrays, num_threads=1)}
    filters |= {name: lambda rule=rule: exact_filter(z, **arrays, rule=rule) for name, rule in RULES.items()}
    filters |= {
        f"{n} Rao-Blackwellised particles": lambda n=n: particle_filter(z, **arrays, n_particles=n, rng=rng())
        for n in (100, 1000)
    }
    return z.shape[:2], filters, lambda: particle_filter(z, **arrays, n_particles=20_000, rng=np.random.default_rng(2))


def double_well(y):
    """Drift to -1 or 1."""
    return 2 * (y - y**3)


def leaving(y):
    """Rate of leaving the second mode, 1/s."""
    return 0.2 + 0.6 * y[..., 0] ** 2 / (1 + y[..., 0] ** 2)


def well():
    """Case a1."""
    model = SwitchingSDE(drift=[double_well, lambda y: 0.5 - y], diffusion=[0.8, 0.6],
                         intensity={(0, 1): 0.3, (1, 0): leaving}, probs0=[0.5, 0.5])  # fmt: skip
    return model, DiffusionSensor(h=[lambda y: y] * 2, R=[0.64] * 2), 0.2 * np.arange(1, 41), GridFilter(cells=640)


def range_bearing(y):
    """Range and bearing from the origin."""
    return np.stack([np.hypot(y[..., 0], y[..., 1]), np.arctan2(y[..., 1], y[..., 0])], axis=-1)


def goals():
    """Case c."""
    goal = np.array([[1.5, 0.0], [0.0, 1.5]])
    model = SwitchingSDE(drift=[lambda y: -0.6 * (y - goal[0]), lambda y: -0.6 * (y - goal[1])], diffusion=[0.35, 0.8],
                         intensity={(0, 1): 0.3, (1, 0): 0.5}, probs0=[0.5, 0.5], mean0=[1.2, 0.3],
                         cov0=0.36 * np.eye(2))  # fmt: skip
    R = np.diag([0.12**2, 0.6**2])
    sensor = DiffusionSensor(h=[range_bearing] * 2, R=[R, R], angular=(1,))
    return model, sensor, 0.25 * np.arange(1, 31), GridFilter(cells=150, estimate_error=False)


def diffusion(trials, problem, cells):
    """A switching diffusion and its filters."""
    model, sensor, times, reference = problem()
    z = simulate_diffusion(model, sensor, times, rng=np.random.default_rng(0), batch=trials).z
    filters = {f"grid, {n} cells": GridFilter(cells=n, estimate_error=False) for n in cells}
    filters |= {"moments, order 2": MomentFilter(order=2, closure="gaussian")}
    filters |= {"moments, order 4": MomentFilter(), "moments, order 6": MomentFilter(order=6)}
    filters |= {"Gaussian sum, 4": GaussianSumFilter()}
    filters |= {f"{n} particles": ParticleFilter(n) for n in (400, 1600)}
    filters |= {"1600 particles, auxiliary": ParticleFilter(1600, proposal="auxiliary")}

    def run(f):
        return f.run(model, sensor, z, times, rng=np.random.default_rng(1))

    return z.shape[:2], {name: lambda f=f: run(f) for name, f in filters.items()}, lambda: run(reference)


def measured(name, problem):
    """Rows (problem, filter, mean error, probability error, microseconds)."""
    (trials, steps), filters, reference = problem
    best = reference()
    rows = []
    for title, run in filters.items():
        spent = np.inf
        for _ in range(2):
            began = time.process_time()
            est = run()
            spent = min(spent, time.process_time() - began)
        gap = (est.mean - best.mean)[..., None]
        square = (gap.swapaxes(-1, -2) @ np.linalg.solve(best.cov, gap))[..., 0, 0] / gap.shape[-2]
        rms = float(np.sqrt(square.mean()))
        probs = float(np.sqrt(np.square(est.probs - best.probs).mean()))
        rows.append([name, title, rms, probs, 1e6 * spent / trials / steps])
        print(f"{name:<24}  {title:<34}  {rms:>8.4f}  {probs:>8.4f}  {rows[-1][-1]:>9.2f}", flush=True)
    return rows


def draw(rows, path):
    """Error against time, a panel per problem."""
    from saltus.studies.style import BLUE, INK, new_figure, save

    names = list(dict.fromkeys(row[0] for row in rows))
    with new_figure(3.2 * len(names), "Which filter? Error against time") as figure:
        for axes, name in zip(figure.subplots(len(names), 1), names, strict=True):
            own = sorted((row for row in rows if row[0] == name), key=lambda row: row[4])
            axes.loglog([row[4] for row in own], [row[2] for row in own], "o", color=BLUE, ms=6)
            for i, row in enumerate(own):
                axes.annotate(row[1], (row[4], row[2]), (7, (-11, 5)[i % 2]), textcoords="offset points", fontsize=8.5,
                              color=INK)  # fmt: skip
            left, right = min(row[4] for row in own), max(row[4] for row in own)
            axes.set_xlim(left / 1.6, right * (right / left) ** 0.35)
            axes.set_ylim(min(row[2] for row in own) / 1.8, 1.8 * max(row[2] for row in own))
            axes.set_title(name, fontsize=10, fontweight="normal")
            axes.set_ylabel("error of the mean, sd")
        axes.set_xlabel("time per measurement of one run, µs")
        save(figure, path)


def main():
    """Measure, print a table, write JSON and a picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--trials", type=int, default=60)
    args = parser.parse_args()
    machine = f"{platform.machine()}, Python {platform.python_version()}, NumPy {np.__version__}, one core"
    print(machine)
    print(f"{'problem':<24}  {'filter':<34}  {'mean, sd':>8}  {'probs':>8}  {'us/step':>9}")
    rows = measured("linear, 8 modes, n = 5", linear(args.trials))
    rows += measured("double well, n = 1", diffusion(args.trials, well, (60, 320)))
    rows += measured("range-bearing, n = 2", diffusion(max(10, args.trials // 3), goals, (75,)))
    if args.output:
        head = ("problem", "filter", "mean_err", "prob_err", "us_per_step")
        record = {
            "machine": machine,
            "trials": args.trials,
            "rows": [dict(zip(head, row, strict=True)) for row in rows],
        }
        args.output.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    if args.figure:
        draw(rows, args.figure)


if __name__ == "__main__":
    main()
