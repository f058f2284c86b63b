"""Many multimode filters at once: rows that are added, stepped, scored, updated and removed as arrays."""

from collections.abc import Mapping, Sequence
from math import prod
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError, NumericalError
from saltus.filters import steps
from saltus.filters.backend import MOST_MODES, MOST_STATES, Backend, use_native
from saltus.filters.memoryless import merge_copies
from saltus.filters.particles import Merged, Tables, expanded, merged
from saltus.filters.steps import Belief
from saltus.shapes import Float, Int

__all__ = ["Bank", "NumpyStore"]

_Rows = npt.NDArray[np.intp]
_Modes = npt.NDArray[np.int64]
_Array = npt.NDArray[np.float64]


class Bank:
    """Beliefs of many tracks (or particles) in rows of common arrays.

    All rows share the number of states `n` and the chains' sizes; their matrices may differ: `F`, `Q`, `H`, `R`
    are `(k|1, M1|1, ..., MC|1, rows, cols)` for the `k` rows addressed, and so are `b`, `d` with one trailing axis.
    `trans[c]` is `(Mc, Mc)`, `(k, Mc, Mc)` or None for a chain that cannot switch.

    With `mode`, row i looks its matrices up: arrays are tables `(M|1, rows, cols)` and row i takes `table[mode[i]]`.
    That is for particles, rows of a bank without chains whose joint mode is known (`expand`, `merged`).

    A row number is valid from `add` until `remove`; freed rows are used again.
    """

    def __init__(self, n: int, sizes: tuple[int, ...], capacity: int = 64, backend: Backend | None = None) -> None:
        """Make an empty bank.

        Args:
            n: number of continuous states.
            sizes: number of states of each chain; () is a bank of Kalman filters.
            capacity: rows to allocate; the bank grows by doubling.
            backend: "numpy" for the definition, "native" for its compiled twin; None chooses.
        """
        if n < 1 or any(s < 1 for s in sizes):
            raise ModelError(f"a Bank needs n >= 1 and chains of at least one state, got n={n}, sizes={sizes}.")
        self.n, self.sizes, self.backend = n, tuple(sizes), backend
        self._store = _make_store(n, self.sizes, capacity, backend)
        self._capacity = capacity
        self._free: list[int] = list(range(capacity - 1, -1, -1))

    def __len__(self) -> int:
        """Number of rows in use."""
        return self._capacity - len(self._free)

    def add(self, belief: Belief) -> Int[np.ndarray, " k"]:
        """Store beliefs with one leading axis (k, M1, ..., MC[, n[, n]]) and return their row numbers."""
        count = len(belief.log_probs)
        while len(self._free) < count:
            self._grow()
        rows = np.array([self._free.pop() for _ in range(count)], dtype=np.intp)
        self.write(rows, belief)
        return rows

    def remove(self, rows: _Rows) -> None:
        """Free rows."""
        self._free.extend(int(r) for r in rows)

    def read(self, rows: _Rows) -> Belief:
        """Return copies of the rows' beliefs."""
        return self._store.read(rows)

    def write(self, rows: _Rows, belief: Belief) -> None:
        """Overwrite rows."""
        self._store.write(rows, belief)

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Return what `restore` goes on from: the beliefs of all rows, and the free ones in the order of their use."""
        return {**self.read(np.arange(self._capacity))._asdict(), "free": np.array(self._free, np.int64)}

    def restore(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Hold what `state` gave, of a bank of the same states and chains: the same rows under the same numbers."""
        self._capacity, self._free = len(state["log_probs"]), np.asarray(state["free"]).tolist()
        self._store = _make_store(self.n, self.sizes, self._capacity, self.backend)
        self.write(np.arange(self._capacity), Belief(*(np.asarray(state[name]) for name in Belief._fields)))

    def take(self, rows: _Rows) -> "Bank":
        """Return a new bank whose rows 0..k-1 are copies of `rows` (repeats allowed: hypotheses, resampling)."""
        bank = Bank.__new__(Bank)  # nothing to check again, and no room to make twice
        bank.n, bank.sizes, bank.backend = self.n, self.sizes, self.backend
        bank._store, bank._capacity, bank._free = self._store.take(rows), len(rows), []
        return bank

    def put(self, rows: _Rows, other: "Bank", other_rows: _Rows) -> None:
        """Overwrite `rows` with copies of another bank's rows."""
        self._store.copy_from(rows, other._store, other_rows)

    def step(
        self,
        rows: _Rows,
        trans: Sequence[_Array | None],
        F: _Array,
        b: _Array | None,
        Q: _Array,
        *,
        mode: _Modes | None = None,
    ) -> None:
        """Mix and propagate rows over their intervals (no row twice)."""
        self._store.step(rows, trans, F, b, Q, mode)

    def score(
        self, rows: _Rows, z: _Array, H: _Array, d: _Array | None, R: _Array, *, mode: _Modes | None = None
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """Return gate distance d2 and log f(z) of measurement z[i] for row rows[i] (repeats allowed).

        d2 is the squared Mahalanobis distance to the mixture's predicted measurement; NaN components count not.

        Raises:
            NumericalError: an innovation covariance is not positive definite.
        """
        return self._store.measure(rows, z, H, d, R, mode, write=False)

    def update(
        self, rows: _Rows, z: _Array, H: _Array, d: _Array | None, R: _Array, *, mode: _Modes | None = None
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """Condition row rows[i] on z[i] (no row twice); return d2 and log f(z) as `score` does.

        Raises:
            NumericalError: an innovation covariance is not positive definite; what the rows hold is then undefined.
        """
        return self._store.measure(rows, z, H, d, R, mode, write=True)

    def merge(
        self, rows: _Rows, copies: "Bank", start: _Rows, log_weights: _Array
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " c"]]:
        """Make of row rows[i] the mixture of the copies start[i] to start[i + 1] - 1, mode by mode, by moments.

        The one update by hypotheses. Each was carried out on a copy of its row (`take`): predicted to its own
        measurement's time and conditioned on it, or on none. Hypotheses of one row exclude each other; how many there
        are may differ from row to row. With l_c = log w_c of a group's copies,

        log f = log sum_c exp l_c,   P(c) = exp(l_c - log f),   P_j = sum_c P(c) P_cj,   x_j, R_j as in `merge_copies`.

        Args:
            rows: k rows, none twice.
            copies: another bank of the same kind; its rows 0, 1, ... are the copies, c of them.
            start: where each group begins, (k + 1,), from 0 to c, ascending: every row has a hypothesis.
            log_weights: log P(hypothesis) + log f(its measurement | hypothesis), (c,), or -inf.

        Returns:
            log f of each row, and the logarithms of the hypotheses' posterior probabilities.

        Raises:
            ModelError: groups and copies do not fit.
            NumericalError: all hypotheses of a row are impossible. No row has then been changed.

        Source: theory notes on fusion, sections 4 and 5, with a memoryless chain on each measurement.
        """
        size = np.diff(start)
        if len(start) != len(rows) + 1 or start[0] != 0 or start[-1] != len(log_weights) or (size < 1).any():
            raise ModelError(
                f"groups of copies begin at start (k + 1,), ascending from 0 to the number of copies: got {len(rows)} "
                f"rows, {len(log_weights)} copies and start from {start[:1]} to {start[-1:]}."
            )
        if not len(rows):
            return np.zeros(0), np.zeros(0)
        group = np.repeat(np.arange(len(rows)), size)
        top = np.maximum.reduceat(log_weights, start[:-1])
        if not np.isfinite(top).all():
            raise NumericalError(
                f"row {rows[np.argmin(np.isfinite(top))]}: no hypothesis is possible. Give one of them a finite weight."
            )
        log_f = top + np.log(np.add.reduceat(np.exp(log_weights - top[group]), start[:-1]))
        log_posterior = np.asarray(log_weights - log_f[group])
        self._store.merge(rows, copies._store, start, log_posterior)
        return log_f, log_posterior

    def expand(
        self, rows: _Rows, now: _Modes, trans: _Array, z: _Array, tables: Tables
    ) -> tuple[Float[np.ndarray, "k modes"], Float[np.ndarray, " k"]]:
        """Return P(next mode | row, z) and log f(z | row) of particles; the rows stay as they are.

        P_j ~ trans[now, j] N(z; H_j (F_j x + b_j) + d_j, H_j (F_j P F_j' + Q_j) H_j' + R_j)

        Args:
            rows: of a bank without chains.
            now: present joint mode of each row, (k,).
            trans: P(next = j | now = i), (M, M).
            z: measurement of each row, (k, m); NaN is a missing component.
            tables: matrices by mode, (M|1, ...) each.

        Raises:
            NumericalError: an innovation covariance is not positive definite.
        """
        return self._store.expand(rows, now, trans, z, tables)

    def merged(self, rows: _Rows, weights: _Array, labels: _Modes, n_labels: int) -> Merged:
        """Return total weight, mean and covariance of the rows of each label, particles of a bank without chains."""
        return self._store.merged(rows, weights, labels, n_labels)

    def moments(
        self, rows: _Rows
    ) -> tuple[Float[np.ndarray, "k n"], Float[np.ndarray, "k n n"], Float[np.ndarray, "k *_sizes"]]:
        """Return mean, covariance and mode probabilities of rows."""
        return self._store.moments(rows)

    def _grow(self) -> None:
        old = self._capacity
        self._capacity = max(8, 2 * old)
        self._store.grow(self._capacity)
        self._free.extend(range(self._capacity - 1, old - 1, -1))


@runtime_checkable
class _Store(Protocol):
    """Where a bank keeps its rows, and what can be done to them. Two stores that meet are of one kind."""

    def grow(self, capacity: int) -> None: ...
    def read(self, rows: _Rows) -> Belief: ...
    def write(self, rows: _Rows, belief: Belief) -> None: ...
    def take(self, rows: _Rows) -> "_Store": ...
    def copy_from(self, rows: _Rows, other: Any, other_rows: _Rows) -> None: ...
    def step(
        self,
        rows: _Rows,
        trans: Sequence[_Array | None],
        F: _Array,
        b: _Array | None,
        Q: _Array,
        mode: _Modes | None = None,
    ) -> None: ...
    def measure(
        self, rows: _Rows, z: _Array, H: _Array, d: _Array | None, R: _Array, mode: _Modes | None = None, *, write: bool
    ) -> tuple[_Array, _Array]: ...
    def moments(self, rows: _Rows) -> tuple[_Array, _Array, _Array]: ...
    def expand(self, rows: _Rows, now: _Modes, trans: _Array, z: _Array, tables: Tables) -> tuple[_Array, _Array]: ...
    def merged(self, rows: _Rows, weights: _Array, labels: _Modes, n_labels: int) -> Merged: ...
    def merge(self, rows: _Rows, copies: Any, start: _Rows, log_weights: _Array) -> None: ...


def _make_store(n: int, sizes: tuple[int, ...], capacity: int, backend: Backend | None) -> _Store:
    fits = n <= MOST_STATES and prod(sizes) <= MOST_MODES
    if use_native(backend) and (backend == "native" or fits):
        from saltus.filters.native import NativeStore

        return NativeStore(n, sizes, capacity)
    return NumpyStore(n, sizes, capacity)


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
        log_probs, means, covs = steps.mix(*self.read(rows), trans)
        F, Q, b = _looked_up(F, mode), _looked_up(Q, mode), None if b is None else _looked_up(b, mode)
        self.write(rows, Belief(log_probs, *steps.propagate(means, covs, F, b, Q)))

    def measure(
        self, rows: _Rows, z: _Array, H: _Array, d: _Array | None, R: _Array, mode: _Modes | None = None, *, write: bool
    ) -> tuple[_Array, _Array]:
        """Return d2 and log f(z); condition the rows when `write`."""
        H, R, d = _looked_up(H, mode), _looked_up(R, mode), None if d is None else _looked_up(d, mode)
        log_probs, means, covs = self.read(rows)
        seen = ~np.isnan(z)
        z = np.where(seen, z, 0.0)
        shape = (len(rows),) + (1,) * self._n_chains + z.shape[-1:]
        prediction = steps.measure(means, covs, H, d, R)
        done = steps.condition(prediction, z.reshape(shape), seen.reshape(shape))
        d2 = steps.mixture_nis(log_probs, prediction, z, seen, self._n_chains)
        log_probs, log_f = steps.reweigh(log_probs, done.loglik, self._n_chains)
        if write:
            self.write(rows, Belief(log_probs, done.mean, done.cov))
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


def _looked_up(table: _Array, mode: _Modes | None) -> _Array:
    return table if mode is None or len(table) == 1 else table[mode]


def _enlarged(a: _Array, rows: int) -> _Array:
    out = np.zeros((rows, *a.shape[1:]))
    out[: len(a)] = a
    return out
