"""Where a bank keeps its rows, and what can be done to them: the definition, in NumPy arrays."""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.filters import steps
from saltus.filters.align import covariances, finite
from saltus.filters.memoryless import merge_copies
from saltus.filters.particles import Merged, Tables, expanded, merged
from saltus.filters.steps import Belief

__all__ = ["NumpyStore", "Store"]

_Rows = npt.NDArray[np.intp]
_Modes = npt.NDArray[np.int64]
_Array = npt.NDArray[np.float64]


@runtime_checkable
class Store(Protocol):
    """What a bank asks of it: row numbers are checked before. Two stores that meet are of one kind."""

    def grow(self, capacity: int) -> None:
        """Make room for more rows."""
        ...

    def read(self, rows: _Rows) -> Belief:
        """Return copies of the rows' beliefs."""
        ...

    def write(self, rows: _Rows, belief: Belief) -> None:
        """Overwrite rows."""
        ...

    def take(self, rows: _Rows) -> "Store":
        """Return a store whose rows 0..k-1 are copies of `rows`."""
        ...

    def copy_from(self, rows: _Rows, other: Any, other_rows: _Rows) -> None:
        """Overwrite rows with those of another store."""
        ...

    def step(
        self,
        rows: _Rows,
        trans: Sequence[_Array | None],
        F: _Array,
        b: _Array | None,
        Q: _Array,
        mode: _Modes | None = None,
    ) -> None:
        """Mix and propagate rows."""
        ...

    def measure(
        self, rows: _Rows, z: _Array, H: _Array, d: _Array | None, R: _Array, mode: _Modes | None = None, *, write: bool
    ) -> tuple[_Array, _Array]:
        """Return d2 and log f(z); condition the rows when `write`."""
        ...

    def moments(self, rows: _Rows) -> tuple[_Array, _Array, _Array]:
        """Return mean, covariance and mode probabilities of rows."""
        ...

    def expand(self, rows: _Rows, now: _Modes, trans: _Array, z: _Array, tables: Tables) -> tuple[_Array, _Array]:
        """Return P(next mode | row, z) and log f(z | row)."""
        ...

    def merged(self, rows: _Rows, weights: _Array, labels: _Modes, n_labels: int) -> Merged:
        """Return total weight, mean and covariance of the rows of each label."""
        ...

    def merge(self, rows: _Rows, copies: Any, start: _Rows, log_weights: _Array) -> None:
        """Overwrite rows with mixtures of another store's rows 0, 1, ..., a group each."""
        ...


class NumpyStore:
    """Rows of NumPy arrays, (capacity, M1, ..., MC[, n[, n]]): the definition."""

    def __init__(self, n: int, sizes: tuple[int, ...], capacity: int) -> None:
        """Make room for `capacity` rows."""
        self._sizes, self._n_chains = sizes, len(sizes)
        self._log_probs = np.zeros((capacity, *sizes))
        self._means = np.zeros((capacity, *sizes, n))
        self._covs = np.zeros((capacity, *sizes, n, n))

    def grow(self, capacity: int) -> None:
        """Make room for more rows."""
        self._log_probs = _enlarged(self._log_probs, capacity)
        self._means = _enlarged(self._means, capacity)
        self._covs = _enlarged(self._covs, capacity)

    def read(self, rows: _Rows) -> Belief:
        """Return copies of the rows' beliefs."""
        return Belief(self._log_probs[rows], self._means[rows], self._covs[rows])

    def write(self, rows: _Rows, belief: Belief) -> None:
        """Overwrite rows."""
        self._log_probs[rows], self._means[rows], self._covs[rows] = belief

    def take(self, rows: _Rows) -> "NumpyStore":
        """Return a store whose rows 0..k-1 are copies of `rows`."""
        store = NumpyStore(self._means.shape[-1], self._sizes, 0)
        store._log_probs, store._means, store._covs = self.read(rows)
        return store

    def copy_from(self, rows: _Rows, other: "NumpyStore", other_rows: _Rows) -> None:
        """Overwrite rows with those of another store."""
        self.write(rows, other.read(other_rows))

    def step(
        self,
        rows: _Rows,
        trans: Sequence[_Array | None],
        F: _Array,
        b: _Array | None,
        Q: _Array,
        mode: _Modes | None = None,
    ) -> None:
        """Mix and propagate rows."""
        n = self._means.shape[-1]
        F = self._read("F", F, len(rows), (n, n), mode)
        Q = covariances("Q", self._read("Q", Q, len(rows), (n, n), mode))
        b = None if b is None else self._read("b", b, len(rows), (n,), mode)
        self._check_chains(trans, len(rows))
        log_probs, means, covs = steps.mix(*self.read(rows), trans)
        self.write(rows, Belief(log_probs, *steps.propagate(means, covs, F, b, Q)))

    def measure(
        self, rows: _Rows, z: _Array, H: _Array, d: _Array | None, R: _Array, mode: _Modes | None = None, *, write: bool
    ) -> tuple[_Array, _Array]:
        """Return d2 and log f(z); condition the rows when `write`."""
        m, n = z.shape[-1], self._means.shape[-1]
        H = self._read("H", H, len(rows), (m, n), mode)
        R = covariances("R", self._read("R", R, len(rows), (m, m), mode))
        d = None if d is None else self._read("d", d, len(rows), (m,), mode)
        log_probs, means, covs = self.read(rows)
        seen = ~np.isnan(z)
        z = np.where(seen, z, 0.0)
        prediction = steps.measure(means, covs, H, d, R)
        d2 = steps.mixture_nis(log_probs, prediction, z, seen, self._n_chains)
        if not write:
            return d2, steps.score(log_probs, prediction, z, seen, self._n_chains)
        belief, log_f = steps.update(log_probs, prediction, z, seen, self._n_chains)
        self.write(rows, belief)
        return d2, log_f

    def moments(self, rows: _Rows) -> tuple[_Array, _Array, _Array]:
        """Return mean, covariance and mode probabilities of rows."""
        belief = self.read(rows)
        mean, cov = steps.collapse(*belief, self._n_chains)
        return mean, cov, np.exp(belief.log_probs)

    def expand(self, rows: _Rows, now: _Modes, trans: _Array, z: _Array, tables: Tables) -> tuple[_Array, _Array]:
        """Return P(next mode | row, z) and log f(z | row)."""
        return expanded(self._means[rows], self._covs[rows], now, trans, z, tables)

    def merged(self, rows: _Rows, weights: _Array, labels: _Modes, n_labels: int) -> Merged:
        """Return total weight, mean and covariance of the rows of each label."""
        return merged(self._means[rows], self._covs[rows], weights, labels, n_labels)

    def merge(self, rows: _Rows, copies: "NumpyStore", start: _Rows, log_weights: _Array) -> None:
        """Overwrite rows with mixtures of another store's rows 0, 1, ..., a group each."""
        self.write(rows, merge_copies(copies.read(np.arange(len(log_weights))), start, log_weights))

    def _read(self, name: str, a: npt.ArrayLike, k: int, core: tuple[int, ...], mode: _Modes | None) -> _Array:
        """Check a model array (k|1, M1|1, ..., MC|1, *core), or look it up where it is a table by mode.

        Raises:
            ModelError: another shape, or no array of numbers.
            DataError: NaN or inf.
        """
        found = finite(name, a)
        modes = found.shape[1 : 1 + self._n_chains]
        fits = found.ndim == 1 + self._n_chains + len(core) and found.shape[1 + self._n_chains :] == core
        if not (fits and all(given in (1, size) for given, size in zip(modes, self._sizes, strict=False))):
            raise ModelError(
                f"{name} has shape {found.shape}; read from the right it is {('k|1', *self._sizes, *core)}."
            )
        if mode is not None and len(found) > 1:
            return np.asarray(found[mode])
        if len(found) not in (1, k):
            raise ModelError(f"{name} has shape {found.shape}, for {k} rows; give one for all, or one for each.")
        return found

    def _check_chains(self, trans: Sequence[_Array | None], k: int) -> None:
        if len(trans) != self._n_chains:
            raise ModelError(
                f"one transition matrix (or None) per chain is needed: {self._n_chains}, not {len(trans)}."
            )
        for c, t in enumerate(trans):
            if t is not None and np.shape(t) not in ((self._sizes[c],) * 2, (k, self._sizes[c], self._sizes[c])):
                raise ModelError(f"trans[{c}] has shape {np.shape(t)}, for a chain of {self._sizes[c]} states.")


def _enlarged(a: _Array, rows: int) -> _Array:
    out = np.zeros((rows, *a.shape[1:]))
    out[: len(a)] = a
    return out
