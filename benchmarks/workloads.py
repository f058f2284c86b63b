"""The models the speed benchmark filters: arrays of `imm_filter`, and measurements simulated from them."""

from dataclasses import dataclass
from functools import reduce

import numpy as np
import numpy.typing as npt

__all__ = ["EIGHT_MODES", "TWO_MODES", "Workload", "flat", "multiply_adds", "product"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Workload:
    """A hybrid model on arrays, shared by all tracks and constant in time."""

    name: str
    F: Array  # (M1|1, ..., MC|1, n, n)
    Q: Array
    H: Array
    R: Array
    trans: tuple[Array, ...]

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of states of each chain."""
        return tuple(len(t) for t in self.trans)

    @property
    def n(self) -> int:
        """Number of continuous states."""
        return self.F.shape[-1]

    @property
    def m(self) -> int:
        """Number of measured components."""
        return self.R.shape[-1]

    def arguments(self) -> dict[str, object]:
        """Everything `imm_filter` takes but the measurements."""
        return {
            "F": self.F,
            "Q": self.Q,
            "H": self.H,
            "R": self.R,
            "trans": list(self.trans),
            "mean0": np.zeros(self.n),
            "cov0": np.eye(self.n),
            "probs0": np.full(self.sizes, 1.0 / np.prod(self.sizes)),
        }

    def measurements(self, batch: int, n_steps: int) -> Array:
        """Simulate the first mode of every chain, (batch, T, m)."""
        rng = np.random.default_rng(7)
        first = (0,) * len(self.sizes)
        F, Q, H, R = (np.broadcast_to(a, (*self.sizes, *a.shape[-2:]))[first] for a in (self.F, self.Q, self.H, self.R))
        x = rng.normal(size=(batch, self.n))
        root, z = np.linalg.cholesky(Q), np.empty((batch, n_steps, self.m))
        for k in range(n_steps):
            x = x @ F.T + rng.normal(size=x.shape) @ root.T
            z[:, k] = x @ H.T + rng.normal(size=(batch, self.m)) @ np.linalg.cholesky(R).T
        return z


def _sticky(size: int) -> Array:
    return np.full((size, size), 0.1 / max(1, size - 1)) + np.eye(size) * (0.9 - 0.1 / max(1, size - 1))


def product(name: str, sizes: tuple[int, ...], n: int, m: int) -> Workload:
    """A stable random motion whose noise depends on the first chain, sensors whose noise depends on the others."""
    rng = np.random.default_rng(n)
    F = 0.9 * np.linalg.qr(rng.normal(size=(n, n)))[0]
    lift = [tuple(s if i == c else 1 for i in range(len(sizes))) for c, s in enumerate(sizes)]
    Q = np.linspace(0.05, 1.0, sizes[0]).reshape((*lift[0], 1, 1)) * np.eye(n)
    R = np.eye(m).reshape((*(1 for _ in sizes), m, m))
    for c in range(1, len(sizes)):
        worse = np.zeros((m, m))
        worse[(c - 1) % m, (c - 1) % m] = 1.0
        R = R + np.linspace(0.0, 9.0, sizes[c]).reshape((*lift[c], 1, 1)) * worse
    ones = tuple(1 for _ in sizes)
    H = rng.normal(size=(*ones, m, n))
    return Workload(name, F.reshape((*ones, n, n)), Q, H, R, tuple(_sticky(s) for s in sizes))


def flat(w: Workload) -> Workload:
    """The same model under one chain, the Kronecker product of all."""
    modes = int(np.prod(w.sizes))

    def merged(a: Array) -> Array:
        return np.broadcast_to(a, (*w.sizes, *a.shape[-2:])).reshape((modes, *a.shape[-2:]))

    return Workload(f"{w.name}, one flat chain", *map(merged, (w.F, w.Q, w.H, w.R)), (reduce(np.kron, w.trans),))


TWO_MODES = product("2 modes, n=4, m=2", (2,), 4, 2)
EIGHT_MODES = product("8 modes (2x2x2), n=5, m=3", (2, 2, 2), 5, 3)


def multiply_adds(w: Workload) -> float:
    """Floating-point operations of one track-step with keep="last", counted from native/step.hpp and measure.hpp.

    A fused multiply-add counts two; exponentials and divisions count as the polynomial's operations and one.
    """
    n, m, modes = w.n, w.m, int(np.prod(w.sizes))
    tri, wide = n * (n + 1) // 2, n + m
    factor = n * (n - 1) // 2 + (n - 1) * n * (n + 1) // 3 + 2 * n
    propagate = factor + 2 * n * n + n * n * (n - 1) + n * n + 2 * tri * n + tri
    rows = [n + a + 1 for a in range(m)]  # of y: what may differ from zero
    innovation = m * (2 * n + 1) + m * n * (n - 1) + sum(rows[a] + 2 * sum(rows[: a + 1]) for a in range(m))
    sweep = sum(3 * rows[a] for a in range(1, m)) + 9 * m
    for a in range(m):
        sweep += (m - 1 - a) * (4 * rows[a] + 3)  # the components after it
        sweep += sum(2 * (n + a if a else i + 1) + 2 * rows[a] + 3 for i in range(n))  # the state
    measure = factor + innovation + sweep + n * wide + 2 * tri * wide
    law = 45
    mixing = 0.0
    for size in w.sizes:
        if size == 2:
            mixing += modes / 2 * (11 * tri + 7 * n + 22)
        else:
            mixing += modes * size * (2 * n + 2 * n + 4 * tri + 5)
    return modes * (propagate + measure + law) + mixing
