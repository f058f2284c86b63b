"""Coloured noise three ways: by differencing, by augmentation, and taken for white. What each costs and gives.

    python benchmarks/coloured.py [-o results.json] [--recordings FOLDER]

Simulated: position(s) and velocities of a point whose acceleration has two levels, and whose noise has two; 4 modes,
at n = 2, m = 1 and n = 4, m = 2. RMSE, NEES and time per step of one run (batch of 256 on one core, the definition in
NumPy and the compiled kernel) at several correlation times of the noise. Then the two ways in the kernel alone: time
per step with all rows kept and with the last only, samples complete, and with one sample in a thousand missing, or one
in five. Augmentation is `imm_filter` on the augmented state. Contenders take turns; the fastest of several counts, in
processor time. FOLDER holds `mlat.ast`, `adsb_v023.ast` and `sensors.toml` of an
airport: multilateration is filtered with ADS-B as truth, its noise as `saltus diagnose noise` finds it, or white of
the same strength.
"""

import argparse
import json
import platform
import time
from pathlib import Path

import numpy as np

from saltus.evaluate import nees
from saltus.filters import IMM, imm_filter
from saltus.filters.coloured import run_augmented, run_differenced
from saltus.filters.coloured_model import augment
from saltus.linalg import block_diagonal
from saltus.models import (
    ColouredSensor,
    Gaussian,
    HybridModel,
    LinearSensor,
    constant_velocity,
    discretise,
    first_order,
)
from saltus.simulate import simulate_hybrid

BATCH, STEPS, DT = 256, 100, 1.0
LONG = 1000  # steps where the kernel alone is timed, so that the call costs nothing
ACCEL, LEVEL = np.array([0.1, 2.0]), np.array([1.0, 4.0])  # (m/s^2)^2 / Hz, m
TRANS = [np.array([[0.95, 0.05], [0.1, 0.9]])] * 2
TAUS = (0.2, 1.0, 5.0, 25.0, 125.0)
PROBS0 = np.full((2, 2), 0.25)


def description(axes, tau):
    """Continuous model of `axes` axes, as arguments of `coloured_filter`."""
    F = np.kron(np.eye(axes), [[0.0, 1.0], [0.0, 0.0]])
    G = np.kron(np.eye(axes), [[0.0], [1.0]])
    return {
        "F": F.reshape(1, 1, 2 * axes, 2 * axes),
        "G": G * np.sqrt(ACCEL).reshape(2, 1, 1, 1),
        "noise_F": (-np.eye(axes) / tau).reshape(1, 1, axes, axes),
        "noise_G": np.eye(axes) * (LEVEL * np.sqrt(2.0 / tau)).reshape(1, 2, 1, 1),
        "H": np.kron(np.eye(axes), [1.0, 0.0]),
        "mean0": np.zeros(2 * axes),
        "cov0": np.kron(np.eye(axes), np.diag([100.0, 25.0])),
        "noise_cov0": np.eye(axes) * np.square(LEVEL).reshape(1, 2, 1, 1),
    }


def simulated(axes, tau, missing, n_steps=STEPS):
    """Truth (B, K, n) and measurements (B, K+1, m) of the augmented model."""
    d = description(axes, tau)
    a = augment(**d, dt=DT, n_steps=n_steps, n_chains=2)
    shape = (n_steps + 1, 2, 2, 3 * axes, 3 * axes)
    F, Q = np.broadcast_to(a.F, shape).copy(), np.broadcast_to(a.Q, shape).copy()
    F[0], Q[0] = np.eye(3 * axes), 0.0
    trans = [np.concatenate([np.eye(2)[None], np.broadcast_to(t, (n_steps, 2, 2))]) for t in TRANS]
    H = np.concatenate([a.H, a.L], axis=1)
    rng = np.random.default_rng(1)
    draws = simulate_hybrid(
        F=F, Q=Q, H=H.reshape(1, 1, axes, -1), R=np.zeros((1, 1, axes, axes)), trans=trans, mean0=a.mean0,
        cov0=a.cov0, probs0=PROBS0, n_steps=n_steps + 1, rng=rng, batch=BATCH,
    )  # fmt: skip
    z = draws.z.copy()
    z[rng.random(z.shape) < missing] = np.nan
    return d, a, draws.states[:, 1:, : 2 * axes], z


def taken_for_white(d, z, backend):
    """The multimode filter with white noise of the same variance, from the first sample on."""
    Phi, Q = discretise(d["F"], d["G"], DT)
    rows, n, m = z.shape[1], Phi.shape[-1], z.shape[-1]
    F = np.broadcast_to(Phi, (rows, *Phi.shape)).copy()
    Q = np.broadcast_to(Q, (rows, *Q.shape)).copy()
    F[0], Q[0] = np.eye(n), 0.0
    trans = [np.concatenate([np.eye(2)[None], np.broadcast_to(t, (rows - 1, 2, 2))]) for t in TRANS]
    return imm_filter(
        z, F=F, Q=Q, H=d["H"].reshape(1, 1, m, n), R=d["noise_cov0"], trans=trans, mean0=d["mean0"], cov0=d["cov0"],
        probs0=PROBS0, backend=backend, num_threads=1,
    )  # fmt: skip


def timed(runs, repeats=3):
    """Results, and seconds of processor time, the least of each: contenders take turns."""
    best, results = np.full(len(runs), np.inf), [None] * len(runs)
    for _ in range(repeats):
        for i, run in enumerate(runs):
            began = time.process_time()
            results[i] = run()
            best[i] = min(best[i], time.process_time() - began)
    return results, best


def compare(axes, tau, missing):
    d, a, truth, z = simulated(axes, tau, missing)
    ways = {
        "differencing": (
            2 * axes,
            lambda backend: run_differenced(z, a, TRANS, PROBS0, backend=backend, num_threads=1),
        ),
        "augmentation": (3 * axes, lambda backend: run_augmented(z, a, TRANS, PROBS0, backend=backend, num_threads=1)),
        "taken for white": (2 * axes, lambda backend: taken_for_white(d, z, backend)),
    }
    rows = []
    for name, (dimension, run) in ways.items():
        (est, _), cost = timed([lambda way=run, b=backend: way(b) for backend in ("numpy", "native")])
        error = truth - est.mean[:, -STEPS:]
        honesty = nees(error, est.cov[:, -STEPS:]).mean() / (2 * axes)
        position = float(np.sqrt(np.square(error[..., ::2]).mean()))
        speed = float(np.sqrt(np.square(error[..., 1::2]).mean()))
        rows.append(
            [axes, tau, missing, name, dimension, position, speed, float(honesty), *(1e6 * cost / BATCH / STEPS)]
        )
    return rows


def in_kernel(axes):
    """Microseconds per step of differencing and of augmentation in the compiled kernel, and their ratio."""
    rows = []
    for missing in (0.0, 0.001, 0.2):
        _, a, _, z = simulated(axes, 5.0, missing, LONG)
        later, n = np.ascontiguousarray(z[:, 1:]), 3 * axes
        H, R = np.concatenate([a.H, a.L], axis=1).reshape(1, 1, axes, n), np.zeros((1, 1, axes, axes))
        for keep in ("all", "last"):
            settings = {"keep": keep, "backend": "native", "num_threads": 1}
            model = {"F": a.F, "Q": a.Q, "H": H, "R": R, "trans": TRANS, "mean0": a.mean0, "cov0": a.cov0}
            runs = [
                lambda s=settings, z=z, a=a: run_differenced(z, a, TRANS, PROBS0, **s),
                lambda s=settings, m=model, z=later: imm_filter(z, **m, probs0=PROBS0, **s),
            ]
            cost = 1e6 * timed(runs, repeats=7)[1] / BATCH / LONG
            rows.append([2 * axes, axes, missing, keep, *cost, cost[0] / cost[1]])
    return rows


def recorded(folder):
    """Filter multilateration with ADS-B as truth, noise coloured or white; the better process noise for each."""
    from saltus.config import load_config
    from saltus.diagnose import fit_noise
    from saltus.diagnose.residuals import from_recordings

    config = load_config(folder / "sensors.toml")
    rows = []
    for phase in ("ground", "air"):
        found = from_recordings([folder / "mlat.ast"], [folder / "adsb_v023.ast"], config, phase)
        fits = [fit_noise(found.times, v, found.labels) for v in found.values.T]
        for name in ("white", "coloured"):
            tried = [measured(found, fits, name == "coloured", q) for q in (0.1, 1.0, 10.0)]
            rows.append([phase, name, *max(tried, key=lambda row: row[-1])])
    return rows


def measured(found, fits, coloured, q):
    """Process noise, RMSE, NEES and NIS per degree of freedom, log-likelihood per report, over the longest series."""
    tau, sigma, white = (np.array([getattr(f, k).value for f in fits]) for k in ("tau", "sigma", "white"))
    H = np.kron(np.eye(2), [1.0, 0.0])
    extra = np.diag(white**2) if white.any() else None
    sensor = (
        ColouredSensor(H, first_order(tau, sigma, dims=2, white=extra))
        if coloured
        else LinearSensor(H, np.diag(sigma**2 + white**2))
    )
    errors, covs, nis, level = [], [], [], []
    limit = 6 * np.hypot(sigma, white)
    for label in np.unique(found.labels)[np.argsort(-np.unique(found.labels, return_counts=True)[1])][:8]:
        at = np.flatnonzero((found.labels == label) & (np.abs(found.values) < limit).all(-1))[:400]
        z = (found.reference + found.values - [f.bias for f in fits])[at]
        start = np.array([z[0, 0], 0.0, z[0, 1], 0.0])
        cov0 = block_diagonal(*(np.diag([1e6, 1e4]) for _ in range(2)))
        motion = constant_velocity(dims=2, accel=q, kind="white")
        model = HybridModel([], motion, {"mlat": sensor}, Gaussian(start, cov0))
        est = IMM(model).run([(t, "mlat", row) for t, row in zip(found.times[at], z, strict=True)])
        errors.append((found.reference[at] - est.mean[:, ::2])[10:])
        covs.append(est.cov[10:, ::2, ::2])
        nis.append(est.nis[10:])
        level.append(est.log_likelihood[10:])
    e, P = np.concatenate(errors), np.concatenate(covs)
    return q, float(np.sqrt(np.square(e).mean())), float(nees(e, P).mean() / 2), float(
        np.concatenate(nis).mean() / 2), float(np.concatenate(level).mean())  # fmt: skip


def table(head, rows):
    text = [[f"{c:.3g}" if isinstance(c, float) else str(c) for c in row] for row in (head, *rows)]
    wide = [max(map(len, column)) for column in zip(*text, strict=True)]
    for row in text:
        print("  ".join(c.rjust(w) for c, w in zip(row, wide, strict=True)))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--recordings", type=Path)
    args = parser.parse_args()
    rows = [row for axes in (1, 2) for tau in TAUS for row in compare(axes, tau, 0.0)]
    rows += [row for axes in (1, 2) for row in compare(axes, 5.0, 0.2)]
    print(f"{platform.machine()}, Python {platform.python_version()}, NumPy {np.__version__}, one core")
    head = ["axes", "tau_s", "missing", "way", "dimension", "rmse_x", "rmse_v", "nees/n", "us_numpy", "us_kernel"]
    table(head, rows)
    results = {"simulated": [dict(zip(head, row, strict=True)) for row in rows]}
    rows = [row for axes in (1, 2) for row in in_kernel(axes)]
    head = ["n", "m", "missing", "keep", "us_differencing", "us_augmentation", "ratio"]
    table(head, rows)
    results["kernel"] = [dict(zip(head, row, strict=True)) for row in rows]
    if args.recordings:
        rows = recorded(args.recordings)
        head = ["phase", "noise", "accel", "rmse_m", "nees/2", "nis/2", "log_f_per_report"]
        table(head, rows)
        results["recordings"] = [dict(zip(head, row, strict=True)) for row in rows]
    if args.output:
        args.output.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
