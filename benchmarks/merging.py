"""Does what mixing throws away tell how far the multimode filter is from the exact answer?

    python benchmarks/merging.py [-o results.json] [--runs N] [--rows T]

For models of every kind, simulated from themselves: the mean distance of the multimode filter's mean from the exact
one in posterior standard deviations, the nats that merging lost per row and state, and rank correlations of the two,
over the rows of one model (of the loss of rows before, each counting 0.7 of the next) and over all models. The exact
answer is that of the 400 best histories, with eight modes and five states that of 4000 Rao-Blackwellised particles.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from saltus import Chain, Gaussian, HybridModel, PositionSensor, constant_velocity
from saltus.filters import MergingRule, exact_filter, imm_filter, particle_filter
from saltus.filters.merging import lost_by_merging
from saltus.models import OK, Condition, FaultySensor
from saltus.simulate import simulate_hybrid
from saltus.studies.fusion import matrices

TURN = Chain("turn", {"cruise": 0.3, "turn": 8.0}, sojourn={"cruise": 120.0, "turn": 20.0})
JAM = Chain("jam", {"ok": 30.0, "jammed": 300.0}, sojourn={"ok": 300.0, "jammed": 30.0})
BIAS = Chain("bias", {"ok": OK, "biased": Condition(bias=200.0)}, sojourn={"ok": 100.0, "biased": 30.0})
SIDE = Chain("side", {"none": 0.0, "left": -0.05, "right": 0.05}, sojourn={"none": 60.0, "left": 30.0, "right": 30.0})
LEVEL = Chain("level", {"calm": 1.0, "rough": 3.0}, stay=0.7, per=4.0)


def tracked(chains, sensor, dims=1, **motion):
    """Arrays of a target with constant velocity and what disturbs it, seen every 4 s."""
    motion = constant_velocity(dims, **({"accel": lambda turn: turn} | motion))
    prior = Gaussian([0.0, 200.0, 0.0, 0.0][: 2 * dims], np.diag([1e4] * 2 * dims))
    return HybridModel(chains, motion, {"s": sensor}, prior).compile(dt=4.0)._asdict()


def scalar(**changes):
    """Arrays of one state and two modes."""
    one = dict(F=[[[1.0]]], Q=[[[1.0]]], H=[[[1.0]]], R=[[[1.0]]], mean0=[0.0], cov0=[[1.0]], probs0=[0.5, 0.5])
    return one | {"trans": [[[0.95, 0.05], [0.05, 0.95]]]} | changes


def fusion(stay, back):
    """The fusion example with chains of its own."""
    cov0 = np.diag(np.square([0.1, 0.016, 100.0, 30.0, 3.0]))
    trans = [np.array([[stay, 1 - stay], [back, 1 - back]])] * 3
    return {**matrices("frozen")._asdict(), "trans": trans, "mean0": np.zeros(5), "cov0": cov0,
            "probs0": np.full((2, 2, 2), 1 / 8)}  # fmt: skip


MODELS = {
    "turn": tracked([TURN], PositionSensor(1, 30.0)),
    "turn, constant in an interval": tracked([TURN], PositionSensor(1, 30.0), kind="scan"),
    "turn in the plane": tracked([TURN], PositionSensor(2, 30.0), dims=2),
    "turn and jamming": tracked([TURN, JAM], PositionSensor(1, lambda jam: jam)),
    "turn and jamming in the plane": tracked([TURN, JAM], PositionSensor(2, lambda jam: jam), dims=2),
    "turn and bias": tracked([TURN, BIAS], FaultySensor(PositionSensor(1, 30.0), ["bias"])),
    "turns to both sides": tracked([SIDE], PositionSensor(2, 50.0), dims=2, accel=0.3, turn=lambda side: side),
    "levels of noise": tracked([LEVEL], PositionSensor(1, lambda level: 30 * level), accel=1.0),
    "outliers": scalar(R=[[[1.0]], [[100.0]]], trans=[[[0.9, 0.1], [0.9, 0.1]]], probs0=[0.9, 0.1]),
    "mild outliers": scalar(R=[[[1.0]], [[4.0]]], trans=[[[0.9, 0.1], [0.9, 0.1]]], probs0=[0.9, 0.1]),
    "drift to both sides": scalar(b=[[-1.0], [1.0]], Q=[[[0.1]]], R=[[[4.0]]]),
    "bias": scalar(d=[[0.0], [6.0]], Q=[[[0.3]]], trans=[[[0.95, 0.05], [0.2, 0.8]]], probs0=[0.8, 0.2]),
    "gain": scalar(H=[[[1.0]], [[-1.0]]], R=[[[0.5]]], trans=[[[0.9, 0.1], [0.3, 0.7]]], mean0=[3.0], cov0=[[4.0]]),
    "decay": scalar(F=[[[1.0]], [[0.5]]], R=[[[9.0]]], mean0=[5.0], cov0=[[4.0]]),
    "fusion": fusion(0.8, 0.2),
    "fusion, slow chains": fusion(0.97, 0.1),
}


def measured(arrays, runs, rows, rng):
    """Mean distance, mean loss per row and state, and the rank correlation over rows."""
    z = simulate_hybrid(**arrays, n_steps=rows, batch=runs, rng=rng).z
    est = imm_filter(z, **arrays, per_mode=True)
    if np.size(arrays["probs0"]) == 8:
        exact = particle_filter(z, **arrays, n_particles=4000, rng=rng)
    else:
        exact = exact_filter(z, **arrays, rule=MergingRule(most=400))
    gap = (est.mean - exact.mean)[..., None]
    off = np.sqrt((gap.swapaxes(-1, -2) @ np.linalg.solve(exact.cov, gap))[..., 0, 0])
    lost = lost_by_merging(est, **{name: arrays[name] for name in ("trans", "mean0", "cov0", "probs0")})
    recent = np.stack([lost[:, : k + 1] @ 0.7 ** np.arange(k, -1, -1) for k in range(rows)], axis=1)
    together = spearmanr(recent.ravel(), off.ravel())[0]
    return {"distance": off.mean(), "lost": lost.mean() / est.mean.shape[-1], "rows": together}


def main():
    """Measure every model, print a table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--rows", type=int, default=40)
    args = parser.parse_args()
    rng, found = np.random.default_rng(3), {}
    print(f"{'model':<32} {'distance, sd':>12} {'nats a row and state':>21} {'rank correlation of rows':>25}")
    for name, arrays in MODELS.items():
        row = {key: float(value) for key, value in measured(arrays, args.runs, args.rows, rng).items()}
        print(f"{name:<32} {row['distance']:>12.3f} {row['lost']:>21.3f} {row['rows']:>25.2f}", flush=True)
        found[name] = row
    distance, lost = ([row[key] for row in found.values()] for key in ("distance", "lost"))
    over = float(spearmanr(distance, lost)[0])
    print(f"rank correlation over {len(found)} models: {over:.2f}")
    if args.output:
        record = {"runs": args.runs, "rows": args.rows, "models": found, "over_models": over}
        args.output.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
