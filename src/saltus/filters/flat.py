"""A model with its runs on one axis and its chains merged into one, for filters that go through joint modes."""

from dataclasses import dataclass
from functools import reduce
from math import prod

import numpy as np
import numpy.typing as npt

from saltus.filters.align import Aligned

__all__ = ["Flat", "Matrices", "flatten"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]
Matrices = tuple[_Array, _Array | None, _Array, _Array, _Array | None, _Array]  # F, b, Q, H, d, R


@dataclass(frozen=True, slots=True, eq=False)
class Flat:
    """B runs, T rows, M joint modes in C order; model arrays (B|1, T|1, D, ...) with D distinct rows for the modes.

    Attributes:
        z: (B, T, m), 0 where missing.
        seen: (B, T, m).
        chains: transition matrices, (B|1, T|1, Mc, Mc), or None for a chain that cannot switch.
        sizes: number of states of each chain.
        arrays: F, b, Q, H, d, R, each (B|1, T|1, D, ...).
        rows: for each of them, which of its D rows a mode uses, (M,).
        log_probs0: (B|1, M).
        mean0: (B|1, M|1, n).
        cov0: (B|1, M|1, n, n).
    """

    z: _Array
    seen: npt.NDArray[np.bool_]
    chains: tuple[_Array | None, ...]
    sizes: tuple[int, ...]
    arrays: tuple[_Array | None, ...]
    rows: tuple[_Index, ...]
    log_probs0: _Array
    mean0: _Array
    cov0: _Array

    @property
    def n_runs(self) -> int:
        """B."""
        return len(self.z)

    @property
    def n_steps(self) -> int:
        """T."""
        return int(self.z.shape[1])

    @property
    def n_modes(self) -> int:
        """M."""
        return prod(self.sizes)

    def trans(self, k: int) -> _Array:
        """Joint transition matrix of row k, (B|1, M, M): the Kronecker product of the chains'."""
        matrices = [
            np.eye(size)[None] if chain is None else chain[:, k if chain.shape[1] > 1 else 0]
            for chain, size in zip(self.chains, self.sizes, strict=True)
        ]
        return np.asarray(reduce(_kron, matrices, np.ones((1, 1, 1))))

    def tables(self, k: int) -> tuple[_Array | None, ...]:
        """F, b, Q, H, d, R of row k, (B|1, D, ...) each."""
        return tuple(None if a is None else a[:, k if a.shape[1] > 1 else 0] for a in self.arrays)

    def matrices(self, k: int, modes: _Index) -> Matrices:
        """F, b, Q, H, d, R of row k for columns of modes, (B|1, len(modes)|1, ...) each."""
        taken = [
            a if a is None or a.shape[1] == 1 else a[:, rows[modes]]
            for a, rows in zip(self.tables(k), self.rows, strict=True)
        ]
        F, b, Q, H, d, R = taken
        if F is None or Q is None or H is None or R is None:
            raise TypeError("F, Q, H and R are always there")
        return F, b, Q, H, d, R


def flatten(model: Aligned) -> Flat:
    """Merge runs into one axis and chains into one axis, without spelling out what does not depend on them."""
    batch, sizes = model.z.shape[:-2], model.sizes
    n_batch, C = len(batch), len(sizes)
    named = (model.F, model.b, model.Q, model.H, model.d, model.R)
    arrays = tuple(None if a is None else _distinct(_runs(a, batch), 2, C) for a in named)
    rows = tuple(_which(a.shape[n_batch + 1 : n_batch + 1 + C] if a is not None else sizes, sizes) for a in named)
    mean0, cov0 = (_prior(_runs(a, batch), C, sizes) for a in (model.mean0, model.cov0))
    return Flat(
        z=model.z.reshape(-1, *model.z.shape[-2:]),
        seen=model.seen.reshape(-1, *model.seen.shape[-2:]),
        chains=tuple(None if t is None else _runs(t, batch) for t in model.trans),
        sizes=sizes,
        arrays=arrays,
        rows=rows,
        log_probs0=_distinct(_runs(model.log_probs0, batch), 1, C),
        mean0=mean0,
        cov0=cov0,
    )


def _runs(a: _Array, batch: tuple[int, ...]) -> _Array:
    """One leading axis for all runs, of length 1 where all share it."""
    given, rest = a.shape[: len(batch)], a.shape[len(batch) :]
    if prod(given) == 1:
        return a.reshape(1, *rest)
    return np.broadcast_to(a, (*batch, *rest)).reshape(-1, *rest)


def _distinct(a: _Array, lead: int, n_chains: int) -> _Array:
    axes = a.shape[lead : lead + n_chains]
    return a.reshape(*a.shape[:lead], prod(axes), *a.shape[lead + n_chains :])


def _prior(a: _Array, n_chains: int, sizes: tuple[int, ...]) -> _Array:
    if prod(a.shape[1 : 1 + n_chains]) > 1:
        a = np.broadcast_to(a, (len(a), *sizes, *a.shape[1 + n_chains :]))
    return _distinct(a, 1, n_chains)


def _which(axes: tuple[int, ...], sizes: tuple[int, ...]) -> _Index:
    """The row of a flattened array that each joint mode uses."""
    table = np.arange(prod(axes), dtype=np.int64).reshape(axes)
    return np.broadcast_to(table, sizes).reshape(-1).copy()


def _kron(a: _Array, b: _Array) -> _Array:
    p, q = a.shape[-1], b.shape[-1]
    return np.asarray(np.einsum("...ij,...kl->...ikjl", a, b).reshape(-1, p * q, p * q))
