"""Many multimode filters at once: rows that are added, stepped, scored, updated and removed as arrays."""

from collections.abc import Mapping, Sequence
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError, NumericalError
from saltus.filters.backend import MOST_MODES, MOST_STATES, Backend, use_native
from saltus.filters.particles import Merged, Tables
from saltus.filters.steps import Belief
from saltus.filters.store import NumpyStore, Store
from saltus.shapes import Float, Int

__all__ = ["Bank"]

_Rows = npt.NDArray[np.intp]
_Modes = npt.NDArray[np.int64]
_Array = npt.NDArray[np.float64]
_MOST_LOG = 1e-6  # of a law that sums to 1, for rounding


class Bank:
    """Beliefs of many tracks (or particles) in rows of common arrays.

    All rows share the number of states `n` and the chains' sizes; their matrices may differ: `F`, `Q`, `H`, `R`
    are `(k|1, M1|1, ..., MC|1, rows, cols)` for the `k` rows addressed, and so are `b`, `d` with one trailing axis.
    `trans[c]` is `(Mc, Mc)`, `(k, Mc, Mc)` or None for a chain that cannot switch.

    With `mode`, row i looks its matrices up: arrays are tables `(M|1, rows, cols)` and row i takes `table[mode[i]]`.
    That is for particles, rows of a bank without chains whose joint mode is known (`expand`, `merged`).

    A row number is valid from `add` until `remove`; freed rows are used again. Every method refuses, with a ModelError,
    rows that are not in use, and those that change rows refuse one named twice.
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
        self._used, self._mark = np.zeros(capacity, bool), np.zeros(capacity, np.intp)

    def __len__(self) -> int:
        """Number of rows in use."""
        return self._capacity - len(self._free)

    def add(self, belief: Belief) -> Int[np.ndarray, " k"]:
        """Store beliefs with one leading axis (k, M1, ..., MC[, n[, n]]) and return their row numbers.

        Raises:
            ModelError: another shape.
            DataError: a mean or covariance that is not finite, or a log-probability that is none.
        """
        count = len(belief.log_probs)
        belief = self._belief(belief, count)
        while len(self._free) < count:
            self._grow()
        rows = np.array([self._free.pop() for _ in range(count)], dtype=np.intp)
        self._used[rows] = True
        self._store.write(rows, belief)
        return rows

    def remove(self, rows: _Rows) -> None:
        """Free rows."""
        rows = self._distinct(rows)
        self._used[rows] = False
        self._free.extend(rows.tolist())

    def read(self, rows: _Rows) -> Belief:
        """Return copies of the rows' beliefs."""
        return self._store.read(self._in_use(rows))

    def write(self, rows: _Rows, belief: Belief) -> None:
        """Overwrite rows; errors as `add`."""
        self._store.write(self._distinct(rows), self._belief(belief, len(rows)))

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Return what `restore` goes on from: the beliefs of all rows, and the free ones in the order of their use."""
        beliefs = self._store.read(np.arange(self._capacity))
        for part in beliefs:
            part[~self._used] = 0.0  # what a free row holds is nobody's
        return {**beliefs._asdict(), "free": np.array(self._free, np.int64)}

    def restore(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Hold what `state` gave, of a bank of the same states and chains: the same rows under the same numbers."""
        self._capacity, self._free = len(state["log_probs"]), np.asarray(state["free"]).tolist()
        self._used, self._mark = np.ones(self._capacity, bool), np.zeros(self._capacity, np.intp)
        self._used[self._free] = False
        self._store = _make_store(self.n, self.sizes, self._capacity, self.backend)
        beliefs = Belief(*(np.asarray(state[name]) for name in Belief._fields))
        self._store.write(np.arange(self._capacity), self._belief(beliefs, self._capacity))

    def widened(self, more: int) -> "Bank":
        """Return a bank of the same rows with further states behind the others, N(0, 1) and independent of them."""
        bank, held = Bank(self.n + more, self.sizes, backend=self.backend), self.state()
        n, behind = self.n, [(0, 0)] * (1 + len(self.sizes))
        covs = np.pad(held["covs"], [*behind, (0, more), (0, more)])
        covs[..., np.arange(n, n + more), np.arange(n, n + more)] = 1.0
        bank.restore(held | {"means": np.pad(held["means"], [*behind, (0, more)]), "covs": covs})
        return bank

    def take(self, rows: _Rows) -> "Bank":
        """Return a new bank whose rows 0..k-1 are copies of `rows` (repeats allowed: hypotheses, resampling)."""
        rows = self._in_use(rows)
        bank = Bank.__new__(Bank)  # nothing to check again, and no room to make twice
        bank.n, bank.sizes, bank.backend = self.n, self.sizes, self.backend
        bank._store, bank._capacity, bank._free = self._store.take(rows), len(rows), []
        bank._used, bank._mark = np.ones(len(rows), bool), np.zeros(len(rows), np.intp)
        return bank

    def put(self, rows: _Rows, other: "Bank", other_rows: _Rows) -> None:
        """Overwrite `rows` with copies of another bank's rows."""
        if (self.n, self.sizes) != (other.n, other.sizes) or len(rows) != len(other_rows):
            raise ModelError(
                f"rows are copied between banks of one kind, as many as there are: {len(rows)} of n={self.n}, "
                f"sizes={self.sizes} and {len(other_rows)} of n={other.n}, sizes={other.sizes} do not go together."
            )
        self._store.copy_from(self._distinct(rows), other._store, other._in_use(other_rows))

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
        """Mix and propagate rows over their intervals (no row twice).

        Raises:
            ModelError: arrays that do not fit.
        """
        self._store.step(self._distinct(rows), trans, F, b, Q, mode)

    def score(
        self, rows: _Rows, z: _Array, H: _Array, d: _Array | None, R: _Array, *, mode: _Modes | None = None
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """Return gate distance d2 and log f(z) of measurement z[i] for row rows[i] (repeats allowed).

        d2 is the squared Mahalanobis distance to the mixture's predicted measurement; NaN components count not. Where a
        distance overflows log f is -inf.

        Raises:
            ModelError: arrays that do not fit.
            DataError: inf in z.
            NumericalError: a measured component has neither noise nor uncertainty, or a prediction has overflowed.
        """
        rows = self._in_use(rows)
        return self._store.measure(rows, _measured(z, len(rows)), H, d, R, mode, write=False)

    def update(
        self, rows: _Rows, z: _Array, H: _Array, d: _Array | None, R: _Array, *, mode: _Modes | None = None
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """Condition row rows[i] on z[i] (no row twice); return d2 and log f(z) as `score` does.

        Raises:
            ModelError: arrays that do not fit.
            DataError: inf in z, or a z so far from its prediction that the distance overflows.
            NumericalError: a measured component has neither noise nor uncertainty, or a prediction has overflowed.
                Either names a run i, which is row rows[i]; `error.runs` says it as well. After it rows that could not
                be conditioned are undefined in the native store; the NumPy store leaves all as they were.
        """
        rows = self._distinct(rows)
        return self._store.measure(rows, _measured(z, len(rows)), H, d, R, mode, write=True)

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
        rows = self._distinct(rows)
        if copies is self or (copies.n, copies.sizes) != (self.n, self.sizes):
            raise ModelError("copies are rows of another bank of the same n and chains: bank.take(...).")
        copies._in_use(np.arange(len(log_weights)))
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
        near = log_weights - top[group]  # as linalg.normalised: an outlier's weights sum to 1 too
        log_sum = np.log(np.add.reduceat(np.exp(near), start[:-1]))
        log_posterior = np.asarray(near - log_sum[group])
        self._store.merge(rows, copies._store, start, log_posterior)
        return top + log_sum, log_posterior

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

        Where every next mode's distance overflows log f is -inf, and the law that of `trans`.

        Raises:
            DataError: inf in z.
            NumericalError: a measured component has neither noise nor uncertainty, or a prediction has overflowed.
        """
        rows = self._in_use(rows)
        return self._store.expand(rows, now, trans, _measured(z, len(rows)), tables)

    def merged(self, rows: _Rows, weights: _Array, labels: _Modes, n_labels: int) -> Merged:
        """Return total weight, mean and covariance of the rows of each label, particles of a bank without chains."""
        return self._store.merged(self._in_use(rows), weights, labels, n_labels)

    def moments(
        self, rows: _Rows
    ) -> tuple[Float[np.ndarray, "k n"], Float[np.ndarray, "k n n"], Float[np.ndarray, "k *_sizes"]]:
        """Return mean, covariance and mode probabilities of rows."""
        return self._store.moments(self._in_use(rows))

    def _in_use(self, rows: _Rows) -> _Rows:
        """Return the rows as an index.

        Raises:
            ModelError: one was never added, or has been removed.
        """
        index = np.asarray(rows)
        if not index.size:
            return index.astype(np.intp)
        if index.ndim != 1 or index.dtype.kind not in "iu":
            raise ModelError(f"rows are a list of whole numbers (k,), got {index.dtype} of shape {index.shape}.")
        index = index.astype(np.intp, copy=False)
        if index.min() >= 0 and index.max() < self._capacity and self._used[index].all():
            return index
        for row in index:
            if not 0 <= row < self._capacity or not self._used[row]:
                break
        raise ModelError(
            f"row {row} is not in this bank: it was never added, or has been removed. Rows are from add()."
        )

    def _distinct(self, rows: _Rows) -> _Rows:
        """Return the rows as an index.

        Raises:
            ModelError: one is not in use, or is named twice.
        """
        index = self._in_use(rows)
        order = np.arange(len(index))
        self._mark[index] = order
        if (self._mark[index] != order).any():
            twice = index[self._mark[index] != order][0]
            raise ModelError(f"row {twice} is named twice: what should become of it? Name every row once.")
        return index

    def _belief(self, belief: Belief, count: int) -> Belief:
        lead = (count, *self.sizes)
        arrays = []
        for name, a, core in zip(Belief._fields, belief, ((), (self.n,), (self.n, self.n)), strict=True):
            a = np.asarray(a, dtype=np.float64)
            if a.shape != (*lead, *core):
                raise ModelError(f"{name} of a belief has shape {a.shape}; in this bank it is {(*lead, *core)}.")
            sound = a <= _MOST_LOG if name == "log_probs" else np.isfinite(a)
            if not sound.all():
                where = [int(i) for i in np.argwhere(~sound)[0]]
                raise DataError(f"{name}{where} of a belief is {a[tuple(where)]}.")
            arrays.append(a)
        return Belief(*arrays)

    def _grow(self) -> None:
        old = self._capacity
        self._capacity = max(8, 2 * old)
        self._store.grow(self._capacity)
        self._used, self._mark = np.resize(self._used, self._capacity), np.zeros(self._capacity, np.intp)
        self._used[old:] = False
        self._free.extend(range(self._capacity - 1, old - 1, -1))


def _measured(z: _Array, k: int) -> _Array:
    """Check the measurements of k rows.

    Raises:
        ModelError: another shape.
        DataError: an infinite one.
    """
    z = np.asarray(z, dtype=np.float64)
    if z.ndim != 2 or len(z) != k or z.shape[1] == 0:
        raise ModelError(f"z has shape {z.shape}; it is (k, m) with one measurement for each of {k} rows addressed.")
    if np.isinf(z).any():
        where = [int(i) for i in np.argwhere(np.isinf(z))[0]]
        raise DataError(f"z{where} is infinite. A missing component is NaN.")
    return z


def _make_store(n: int, sizes: tuple[int, ...], capacity: int, backend: Backend | None) -> Store:
    fits = n <= MOST_STATES and prod(sizes) <= MOST_MODES
    if use_native(backend) and (backend == "native" or fits):
        from saltus.filters.native import NativeStore

        return NativeStore(n, sizes, capacity)
    return NumpyStore(n, sizes, capacity)
