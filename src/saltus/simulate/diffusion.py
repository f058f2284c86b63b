"""Draws of a switching diffusion: modes, states and measurements."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.models import DiffusionSensor, SwitchingSDE

__all__ = ["DiffusionDraws", "advance", "simulate_diffusion"]

_Array = npt.NDArray[np.float64]


class DiffusionDraws(NamedTuple):
    """Independent runs of a switching diffusion, seen at T times."""

    modes: npt.NDArray[np.int64]  # (batch, T)
    states: _Array  # (batch, T, n)
    z: _Array  # (batch, T, m)


class _Noise(NamedTuple):
    """All that a run draws, made beforehand: a run's numbers depend on its own generator alone."""

    start: _Array  # (batch, n)
    first: _Array  # (batch,) uniform
    motion: _Array  # (batch, T, substeps, w)
    switch: _Array  # (batch, T, substeps) uniform
    anew: _Array  # (batch, T, substeps, n)
    seen: _Array  # (batch, T, m)


def simulate_diffusion(
    model: SwitchingSDE,
    sensor: DiffusionSensor,
    times: npt.ArrayLike,
    *,
    rng: np.random.Generator | Sequence[np.random.Generator],
    batch: int = 1,
    t0: float = 0.0,
    substeps: int = 50,
) -> DiffusionDraws:
    """Draw runs by small Euler-Maruyama steps; in a step of length s a switch r -> l happens with rate nu_rl.

    P(leave r in s) = 1 - exp(-nu_r s), to l in proportion to nu_rl;  weak error of order s.

    Args:
        model: the diffusion.
        sensor: what is measured; if continuous, z holds the increments over the intervals.
        times: times of the measurements, (T,), s, increasing, after t0.
        rng: one source of randomness for all runs, or one for each run, and then as many runs.
        batch: number of runs drawn from one source.
        t0: when the prior holds, s.
        substeps: Euler steps per interval.

    Raises:
        ModelError: times do not increase, or model and sensor do not fit.
    """
    t = np.asarray(times, dtype=np.float64)
    dts = np.diff(t, prepend=t0)
    if t.ndim != 1 or not len(t) or not dts.min() >= 0 or substeps < 1:
        raise ModelError(f"need times (T,) that increase from t0 = {t0:g} s, and substeps >= 1: {t[:5]}, {substeps}.")
    m, n = sensor.check(model.means0), model.n_state
    noise = _drawn(model, (len(t), substeps), m, rng, batch)
    mode = np.searchsorted(np.cumsum(model.probs0)[:-1], noise.first, side="right")
    roots = _root(np.asarray(model.covs0))
    x = model.means0[mode] + np.einsum("bij,bj->bi", roots[mode], noise.start)
    modes, states, z = (
        np.empty((len(x), len(t)), np.int64),
        np.empty((len(x), len(t), n)),
        np.zeros((len(x), len(t), m)),
    )
    for k, dt in enumerate(dts):
        for i in range(substeps):
            if sensor.continuous:
                z[:, k] += _expected(sensor, mode, x, m) * (dt / substeps)
            moved = x + _step(model, mode, x, noise.motion[:, k, i], dt / substeps)
            mode, x = _switched(model, mode, x, moved, noise.switch[:, k, i], noise.anew[:, k, i], dt / substeps)
        modes[:, k], states[:, k] = mode, x
        z[:, k] += _measured(sensor, mode, x, noise.seen[:, k], dt)
    return DiffusionDraws(modes, states, z)


def advance(
    model: SwitchingSDE, mode: npt.NDArray[np.int64], x: _Array, dt: float, substeps: int, rng: np.random.Generator
) -> tuple[npt.NDArray[np.int64], _Array]:
    """Move states (k, n) and their modes (k,) over an interval by Euler-Maruyama steps, as `simulate_diffusion` does.

    Args:
        model: the diffusion.
        mode: mode of each state.
        x: states.
        dt: interval, s.
        substeps: Euler steps.
        rng: source of randomness.
    """
    width = max(model.diffusion_at(i, model.means0[i]).shape[-1] for i in range(model.n_modes))
    for _ in range(substeps):
        moved = x + _step(model, mode, x, rng.standard_normal((len(x), width)), dt / substeps)
        uniform, anew = rng.uniform(size=len(x)), rng.standard_normal(x.shape)
        mode, x = _switched(model, mode, x, moved, uniform, anew, dt / substeps)
    return mode, x


def _drawn(
    model: SwitchingSDE,
    steps: tuple[int, int],
    m: int,
    rng: np.random.Generator | Sequence[np.random.Generator],
    batch: int,
) -> _Noise:
    n = model.n_state
    widths = [model.diffusion_at(mode, model.means0[mode]).shape[-1] for mode in range(model.n_modes)]

    def draw(source: np.random.Generator, runs: int) -> _Noise:
        return _Noise(
            source.standard_normal((runs, n)),
            source.uniform(size=runs),
            source.standard_normal((runs, *steps, max(widths))),
            source.uniform(size=(runs, *steps)),
            source.standard_normal((runs, *steps, n)),
            source.standard_normal((runs, steps[0], m)),
        )

    if isinstance(rng, np.random.Generator):
        return draw(rng, batch)
    if not isinstance(rng, Sequence) or not all(isinstance(source, np.random.Generator) for source in rng):
        raise ModelError(f"rng must be one generator or a list of them, got {rng!r}: np.random.default_rng(seed).")
    return _Noise(*(np.concatenate(parts) for parts in zip(*(draw(source, 1) for source in rng), strict=True)))


def _step(model: SwitchingSDE, mode: npt.NDArray[np.int64], x: _Array, noise: _Array, dt: float) -> _Array:
    moved = np.empty_like(x)
    for r in range(model.n_modes):
        own = mode == r
        if own.any():
            b = model.diffusion_at(r, x[own])
            push = np.einsum("bnw,bw->bn", b, noise[own, : b.shape[-1]])
            moved[own] = model.drift_at(r, x[own]) * dt + push * np.sqrt(dt)
    return moved


def _switched(
    model: SwitchingSDE,
    mode: npt.NDArray[np.int64],
    before: _Array,
    x: _Array,
    uniform: _Array,
    noise: _Array,
    dt: float,
) -> tuple[npt.NDArray[np.int64], _Array]:
    """Switch where the uniform number falls below the probability to leave; a restored state is drawn anew."""
    target = mode.copy()
    for r in range(model.n_modes):
        own = np.flatnonzero(mode == r)
        ways = [s for s in model.switches if s[0] == r]
        if not len(own) or not ways:
            continue
        rates = np.stack([model.rate(way, before[own]) for way in ways], axis=-1)
        total = rates.sum(-1, keepdims=True)
        leave = -np.expm1(-total * dt)
        bounds = np.cumsum(np.divide(rates, total, out=np.zeros_like(rates), where=total > 0), axis=-1) * leave
        which = (uniform[own, None] >= bounds).sum(-1)
        for i, way in enumerate(ways):
            gone = own[which == i]
            law = model.restored(way)
            target[gone] = way[1]
            if law is not None and len(gone):
                x[gone] = law[0] + noise[gone] @ _root(law[1]).T
    return target, x


def _expected(sensor: DiffusionSensor, mode: npt.NDArray[np.int64], x: _Array, m: int) -> _Array:
    h = np.empty((len(x), m))
    for r in range(sensor.n_modes):
        own = mode == r
        if own.any():
            h[own] = sensor.h_at(r, x[own])
    return h


def _measured(sensor: DiffusionSensor, mode: npt.NDArray[np.int64], x: _Array, noise: _Array, dt: float) -> _Array:
    R = np.empty((*noise.shape, noise.shape[-1]))
    for r in range(sensor.n_modes):
        own = mode == r
        R[own] = sensor.noise_at(r, x[own])
    v = np.einsum("bij,bj->bi", np.linalg.cholesky(R), noise)
    if sensor.continuous:
        return np.asarray(v * np.sqrt(dt))
    expected = _expected(sensor, mode, x, noise.shape[-1])
    return sensor.residual(expected + v, np.zeros_like(v)) if sensor.angular else expected + v


def _root(cov: _Array) -> _Array:
    """Symmetric square root of covariances, singular ones too."""
    values, vectors = np.linalg.eigh(cov)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :] @ vectors.swapaxes(-1, -2))
