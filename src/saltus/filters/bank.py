"""Many multimode filters at once: rows that are added, stepped, scored, updated and removed as arrays."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from jaxtyping import Float, Int

from saltus.errors import ModelError
from saltus.filters import steps
from saltus.filters.steps import Belief

__all__ = ["Bank"]

_Rows = npt.NDArray[np.intp]
_Array = npt.NDArray[np.float64]


class Bank:
    """Beliefs of many tracks (or particles) in rows of common arrays.

    All rows share the number of states `n` and the chains' sizes; their matrices may differ: `F`, `Q`, `H`, `R`
    are `(k|1, M1|1, ..., MC|1, rows, cols)` for the `k` rows addressed, and so are `b`, `d` with one trailing axis.
    `trans[c]` is `(Mc, Mc)`, `(k, Mc, Mc)` or None for a chain that cannot switch.

    A row number is valid from `add` until `remove`; freed rows are used again.
    """

    def __init__(self, n: int, sizes: tuple[int, ...], capacity: int = 64) -> None:
        """Make an empty bank.

        Args:
            n: number of continuous states.
            sizes: number of states of each chain; () is a bank of Kalman filters.
            capacity: rows to allocate; the bank grows by doubling.
        """
        if n < 1 or any(s < 1 for s in sizes):
            raise ModelError(f"a Bank needs n >= 1 and chains of at least one state, got n={n}, sizes={sizes}.")
        self.n, self.sizes = n, tuple(sizes)
        self._log_probs = np.zeros((capacity, *self.sizes))
        self._means = np.zeros((capacity, *self.sizes, n))
        self._covs = np.zeros((capacity, *self.sizes, n, n))
        self._free: list[int] = list(range(capacity - 1, -1, -1))

    def __len__(self) -> int:
        """Number of rows in use."""
        return len(self._log_probs) - len(self._free)

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
        return Belief(self._log_probs[rows], self._means[rows], self._covs[rows])

    def write(self, rows: _Rows, belief: Belief) -> None:
        """Overwrite rows."""
        self._log_probs[rows], self._means[rows], self._covs[rows] = belief

    def take(self, rows: _Rows) -> "Bank":
        """Return a new bank whose rows 0..k-1 are copies of `rows` (repeats allowed: hypotheses, resampling)."""
        bank = Bank(self.n, self.sizes, capacity=0)
        bank._log_probs, bank._means, bank._covs = self.read(rows)
        return bank

    def put(self, rows: _Rows, other: "Bank", other_rows: _Rows) -> None:
        """Overwrite `rows` with copies of another bank's rows."""
        self.write(rows, other.read(other_rows))

    def step(self, rows: _Rows, trans: Sequence[_Array | None], F: _Array, b: _Array | None, Q: _Array) -> None:
        """Mix and propagate rows over their intervals (no row twice)."""
        log_probs, means, covs = steps.mix(*self.read(rows), trans)
        self.write(rows, Belief(log_probs, *steps.propagate(means, covs, F, b, Q)))

    def score(
        self, rows: _Rows, z: _Array, H: _Array, d: _Array | None, R: _Array
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """Return gate distance d2 and log f(z) of measurement z[i] for row rows[i] (repeats allowed).

        d2 is the squared Mahalanobis distance to the mixture's predicted measurement; NaN components count not.
        """
        _, d2, log_f = self._condition(rows, z, H, d, R)
        return d2, log_f

    def update(
        self, rows: _Rows, z: _Array, H: _Array, d: _Array | None, R: _Array
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """Condition row rows[i] on z[i] (no row twice); return d2 and log f(z) as `score` does."""
        belief, d2, log_f = self._condition(rows, z, H, d, R)
        self.write(rows, belief)
        return d2, log_f

    def moments(
        self, rows: _Rows
    ) -> tuple[Float[np.ndarray, "k n"], Float[np.ndarray, "k n n"], Float[np.ndarray, "k *_sizes"]]:
        """Return mean, covariance and mode probabilities of rows."""
        belief = self.read(rows)
        mean, cov = steps.collapse(*belief, len(self.sizes))
        return mean, cov, np.exp(belief.log_probs)

    def _condition(
        self, rows: _Rows, z: _Array, H: _Array, d: _Array | None, R: _Array
    ) -> tuple[Belief, _Array, _Array]:
        log_probs, means, covs = self.read(rows)
        n_chains = len(self.sizes)
        seen = ~np.isnan(z)
        z = np.where(seen, z, 0.0)
        shape = (len(rows),) + (1,) * n_chains + z.shape[-1:]
        prediction = steps.measure(means, covs, H, d, R)
        done = steps.condition(prediction, z.reshape(shape), seen.reshape(shape))
        d2 = steps.mixture_nis(log_probs, prediction, z, seen, n_chains)
        log_probs, log_f = steps.reweigh(log_probs, done.loglik, n_chains)
        return Belief(log_probs, done.mean, done.cov), d2, log_f

    def _grow(self) -> None:
        old = len(self._log_probs)
        new = max(8, 2 * old)
        self._log_probs = _enlarged(self._log_probs, new)
        self._means = _enlarged(self._means, new)
        self._covs = _enlarged(self._covs, new)
        self._free.extend(range(new - 1, old - 1, -1))


def _enlarged(a: _Array, rows: int) -> _Array:
    out = np.zeros((rows, *a.shape[1:]))
    out[: len(a)] = a
    return out
