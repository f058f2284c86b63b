"""Draws from a hybrid model given as arrays: modes, states, measurements."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError

__all__ = ["HybridDraws", "simulate_hybrid"]

Array = npt.NDArray[np.float64]


class HybridDraws(NamedTuple):
    """Independent runs of a hybrid model over T steps."""

    modes: npt.NDArray[np.int64]  # (batch, T, C): state of each chain
    states: Array  # (batch, T, n)
    z: Array  # (batch, T, m)


def simulate_hybrid(
    *,
    F: npt.ArrayLike,
    Q: npt.ArrayLike,
    H: npt.ArrayLike,
    R: npt.ArrayLike,
    trans: Sequence[npt.ArrayLike],
    mean0: npt.ArrayLike,
    cov0: npt.ArrayLike,
    probs0: npt.ArrayLike,
    n_steps: int,
    rng: np.random.Generator,
    batch: int = 1,
    b: npt.ArrayLike | None = None,
    d: npt.ArrayLike | None = None,
) -> HybridDraws:
    """Draw runs of x_k = F x_{k-1} + b + w,  z_k = H x_k + d + v, with modes of independent Markov chains.

    The prior holds one interval before the first measurement, and arrays are read as by `imm_filter`: with
    C = len(trans), a model array has C + 2 axes (vectors C + 1), one more in front when it varies in time, and
    axes of length 1 for the chains it does not depend on. Covariances may be singular.

    Args:
        F: transition matrices, (T|1, M1|1, ..., n, n).
        Q: covariances of w, (T|1, M1|1, ..., n, n).
        H: measurement matrices, (T|1, M1|1, ..., m, n).
        R: covariances of v, (T|1, M1|1, ..., m, m).
        trans: C matrices, trans[c][i, j] = P(next = j | now = i), (Mc, Mc) or (T, Mc, Mc).
        mean0: (n,) or per mode (M1|1, ..., n).
        cov0: (n, n) or per mode (M1|1, ..., n, n).
        probs0: joint law of the modes, (M1, ..., MC).
        n_steps: T.
        rng: source of randomness.
        batch: number of runs.
        b: (T|1, M1|1, ..., n), or None.
        d: (T|1, M1|1, ..., m), or None.

    Raises:
        ModelError: a shape that fits no reading, probabilities that are none, a covariance that is none.
    """
    n, m = np.shape(F)[-1], np.shape(H)[-2]
    chains = [_transitions(f"trans[{c}]", t, n_steps) for c, t in enumerate(trans)]
    sizes = tuple(t.shape[-1] for t in chains)
    transition, gain = _read("F", F, sizes, n_steps, (n, n)), _read("H", H, sizes, n_steps, (m, n))
    root_q = _root("Q", _read("Q", Q, sizes, n_steps, (n, n)))
    root_r = _root("R", _read("R", R, sizes, n_steps, (m, m)))
    drift = _read("b", np.zeros((1,) * len(sizes) + (n,)) if b is None else b, sizes, n_steps, (n,))
    offset = _read("d", np.zeros((1,) * len(sizes) + (m,)) if d is None else d, sizes, n_steps, (m,))
    mode = _draw_initial(probs0, sizes, batch, rng)
    start = _pick(_prior("mean0", mean0, sizes, (n,)), 0, mode)
    x = start + _draw(_pick(_root("cov0", _prior("cov0", cov0, sizes, (n, n))), 0, mode), rng)
    modes, states, z = np.empty((batch, n_steps, len(sizes)), np.int64), np.empty((batch, n_steps, n)), []
    for k in range(n_steps):
        for c, t in enumerate(chains):
            mode[:, c] = _next(t[k % len(t)], mode[:, c], rng)
        x = _times(_pick(transition, k, mode), x) + _pick(drift, k, mode) + _draw(_pick(root_q, k, mode), rng)
        z.append(_times(_pick(gain, k, mode), x) + _pick(offset, k, mode) + _draw(_pick(root_r, k, mode), rng))
        modes[:, k], states[:, k] = mode, x
    return HybridDraws(modes, states, np.stack(z, axis=1) if z else np.empty((batch, 0, m)))


def _read(name: str, value: npt.ArrayLike, sizes: tuple[int, ...], n_steps: int, core: tuple[int, ...]) -> Array:
    """Give a model array all its axes: (T|1, M1|1, ..., core)."""
    a = np.asarray(value, np.float64)
    full = (n_steps, *sizes, *core)
    if a.ndim == len(full) - 1:
        a = a[None]
    loose = len(full) - len(core)
    fits = a.ndim == len(full) and a.shape[loose:] == core
    if not fits or any(have not in (1, want) for have, want in zip(a.shape, full, strict=True)):
        raise ModelError(
            f"{name} has shape {np.shape(value)}, but is read as (T|1, one axis per chain, ...) = {full}. "
            f"Reshape it so that absent axes have length 1."
        )
    if not np.isfinite(a).all():
        raise ModelError(f"{name} holds NaN or infinity.")
    return a


def _prior(name: str, value: npt.ArrayLike, sizes: tuple[int, ...], core: tuple[int, ...]) -> Array:
    a = np.asarray(value, np.float64)
    shared = a.ndim == len(core)
    return _read(name, a.reshape((1,) * len(sizes) + a.shape) if shared else a, sizes, 1, core)


def _transitions(name: str, value: npt.ArrayLike, n_steps: int) -> Array:
    """Transition matrices of one chain, (T|1, M, M)."""
    t = np.asarray(value, np.float64)
    t = t[None] if t.ndim == 2 else t
    if t.ndim != 3 or t.shape[1] != t.shape[2] or t.shape[0] not in (1, n_steps):
        raise ModelError(f"{name} has shape {np.shape(value)}; it is (M, M), or (T, M, M) with T = {n_steps}.")
    if not (np.all(t >= 0.0) and np.allclose(t.sum(axis=-1), 1.0, atol=1e-9)):
        raise ModelError(f"{name}: rows must be probabilities that sum to 1; they sum to {t.sum(axis=-1)}.")
    return t


def _root(name: str, cov: Array) -> Array:
    """Symmetric square root of PSD matrices, singular ones too."""
    values, vectors = np.linalg.eigh(cov)
    limit = 1e-9 * np.abs(values).max(axis=-1, keepdims=True)
    if np.any(values < -limit) or not np.allclose(cov, np.swapaxes(cov, -1, -2), rtol=1e-9, atol=0.0):
        raise ModelError(f"{name} is not a covariance: least eigenvalue {values.min():g}, or not symmetric.")
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]) @ np.swapaxes(vectors, -1, -2))


def _draw_initial(
    probs0: npt.ArrayLike, sizes: tuple[int, ...], batch: int, rng: np.random.Generator
) -> npt.NDArray[np.int64]:
    p = np.asarray(probs0, np.float64)
    if p.shape != sizes or np.any(p < 0.0) or not np.isclose(p.sum(), 1.0, atol=1e-9):
        raise ModelError(f"probs0 must have shape {sizes} and sum to 1; it has {p.shape} and sums to {p.sum():g}.")
    flat = rng.choice(p.size, size=batch, p=p.ravel() / p.sum())
    return (
        np.stack(np.unravel_index(flat, sizes), axis=-1).astype(np.int64) if sizes else np.empty((batch, 0), np.int64)
    )


def _next(trans: Array, now: npt.NDArray[np.int64], rng: np.random.Generator) -> npt.NDArray[np.int64]:
    bounds = np.cumsum(trans, axis=-1)[now]
    bounds[:, -1] = 1.0
    return np.asarray((rng.uniform(size=(len(now), 1)) >= bounds).sum(axis=-1))


def _pick(array: Array, k: int, mode: npt.NDArray[np.int64]) -> Array:
    """Rows of a (T|1, M1|1, ..., core) array for each run's modes: (batch, *core)."""
    now = array[k % len(array)]
    index = tuple(mode[:, c] if now.shape[c] > 1 else np.zeros(len(mode), np.int64) for c in range(mode.shape[1]))
    return now[index] if index else np.broadcast_to(now, (len(mode), *now.shape))


def _times(matrix: Array, vector: Array) -> Array:
    return np.asarray((matrix @ vector[..., None])[..., 0])


def _draw(root: Array, rng: np.random.Generator) -> Array:
    return _times(root, rng.standard_normal(root.shape[:-1]))
