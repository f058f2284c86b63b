"""The compiled twins: the batch recursion and the store of a Bank, on the arrays of their definitions."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from saltus.compiled import native_module
from saltus.errors import ModelError, SaltusError
from saltus.filters.align import Aligned, covariances, finite
from saltus.filters.backend import instruction_set, thread_count
from saltus.filters.estimates import Estimates, allocate
from saltus.filters.particles import Merged, Tables
from saltus.filters.refusals import NotPositive, not_finite, of_runs, place, too_far
from saltus.filters.steps import Belief

__all__ = ["NativeStore", "Run", "filter_native"]

_Array = npt.NDArray[np.float64]
_Rows = npt.NDArray[np.intp]
_Modes = npt.NDArray[np.int64]

_NOT_POSITIVE, _INFINITE, _DOUBTFUL, _NOT_FINITE = 1, 2, 4, 16  # bits of the kernel's status
_WRITTEN = ("probs", "mean", "cov", "log_likelihood", "nis", "n_observed", "mode_means", "mode_covs")


@dataclass(frozen=True, slots=True)
class Run:
    """How the compiled recursion goes over the rows, and what it writes."""

    per_mode: bool = False  # also every mode's mean and covariance
    every: bool = True  # all rows, not the last only
    num_threads: int | None = None  # None chooses
    reported: int | None = None  # only the first components of the state; None is all
    from_first: bool = False  # the prior holds at the first row, and arrays over intervals begin with the second
    map: _Array | None = None  # from the first row on the state is map @ state, its last m components the measured ones


def filter_native(z: _Array, aligned: Callable[[bool], Aligned], run: Run) -> Estimates:
    """Run the compiled recursion.

    Args:
        z: the measurements with their NaN, (*batch, T, m).
        aligned: aligns the other arguments; True leaves the elements of large arrays to the kernel.
        run: its settings.
    """
    out, faults, status = _run(z, aligned(True), run)
    if status & (_DOUBTFUL | _INFINITE):  # read every element: raises, or makes nearly symmetric covariances symmetric
        out, faults, status = _run(z, aligned(False), run)
    bad = np.flatnonzero(faults[:, 0])
    if len(bad):
        first, batch = int(bad[0]), z.shape[:-2]
        where = tuple(int(i) for i in np.unravel_index(first, batch)) if batch else ()
        refused = (faults[:, 0] != 0).reshape(batch)
        raise of_runs(_refusal(faults[first], z[where], len(faults) - len(bad), where, int(faults[first, 1])), refused)
    return out


def _refusal(fault: _Modes, z: _Array, others: int, run: tuple[int, ...] = (), row: int | None = None) -> SaltusError:
    """What a fault of the kernel means, with the (T, m) it happened in and the row to name."""
    kind, at, component = (int(i) for i in fault)
    if kind == _NOT_POSITIVE:
        return NotPositive(place(run, row, component), component)
    if kind == _NOT_FINITE:
        return not_finite(place(run, row))
    return too_far(place(run, row, component), float(z[at, component]), others)


def _refused_row(fault: _Modes, z: _Array) -> SaltusError:
    """The same for the rows of a bank, (k, m), each of them a run of its own."""
    run = int(fault[1])
    return of_runs(_refusal(fault, z, 0, (run,)), np.arange(len(z)) == run)


def _run(z: _Array, model: Aligned, run: Run) -> tuple[Estimates, _Modes, int]:
    native = native_module()
    if native is None:
        raise ModelError("there is no compiled kernel here.")
    batch, (n_steps, m) = z.shape[:-2], z.shape[-2:]
    sizes, n, runs = model.sizes, model.cov0.shape[-1], prod(z.shape[:-2])
    reported = n if run.reported is None else run.reported
    out = allocate(batch, n_steps if run.every else 1, n_steps, sizes, reported, run.per_mode)
    faults = np.zeros((runs, 3), np.int64)
    if runs == 0:
        return out, faults, 0
    work = float(runs) * n_steps * prod(sizes) * n * n * (n + m)
    described = {"reported": reported, "from_first": run.from_first, "map": run.map}
    status = native.imm_filter(
        instruction_set(),
        np.ascontiguousarray(z.reshape((runs, n_steps, m))),
        _described(model, batch) | described,
        {name: getattr(out, name) for name in _WRITTEN} | {"faults": faults},
        run.every,
        thread_count(run.num_threads, work),
    )
    return out, faults, status


def _described(model: Aligned, batch: tuple[int, ...]) -> dict[str, object]:
    def runs(a: _Array | None) -> object:
        return None if a is None else _by_run(a, batch)

    return {
        "n": model.cov0.shape[-1],
        "sizes": list(model.sizes),
        "F": runs(model.F),
        "b": runs(model.b),
        "Q": runs(model.Q),
        "H": runs(model.H),
        "d": runs(model.d),
        "R": runs(model.R),
        "mean0": runs(model.mean0),
        "cov0": runs(model.cov0),
        "log_probs0": runs(model.log_probs0),
        "trans": [runs(t) for t in model.trans],
    }


def _by_run(a: _Array, batch: tuple[int, ...]) -> _Array | tuple[_Array, npt.NDArray[np.int64]]:
    """One leading axis for all runs, of length 1 where all share it; with row numbers where only some axes do."""
    given, rest = a.shape[: len(batch)], a.shape[len(batch) :]
    flat = np.ascontiguousarray(a.reshape((prod(given), *rest)))
    if given == batch or prod(given) == 1:
        return flat
    rows = np.broadcast_to(np.arange(prod(given), dtype=np.int64).reshape(given), batch)
    return flat, rows.ravel()


class NativeStore:
    """The beliefs of a Bank in the lanes of the compiled kernel: the twin of `bank.NumpyStore`."""

    def __init__(self, n: int, sizes: tuple[int, ...], capacity: int, isa: str = "") -> None:
        """Make room for `capacity` rows, in lanes of the instruction set `isa` (by default the one in use)."""
        native = native_module()
        if native is None:
            raise ModelError("there is no compiled kernel here.")
        self._n, self._sizes, self._isa = n, sizes, isa or instruction_set()
        self._lanes = native.Bank(self._isa, n, list(sizes), capacity)

    def grow(self, capacity: int) -> None:
        """Make room for more rows."""
        self._lanes.grow(capacity)

    def read(self, rows: _Rows) -> Belief:
        """Return copies of the rows' beliefs."""
        lead = (len(rows), *self._sizes)
        belief = Belief(np.empty(lead), np.empty((*lead, self._n)), np.empty((*lead, self._n, self._n)))
        self._lanes.read(rows, *belief)
        return belief

    def write(self, rows: _Rows, belief: Belief) -> None:
        """Overwrite rows."""
        lead, n = (len(rows), *self._sizes), self._n
        shapes = (lead, (*lead, n), (*lead, n, n))
        self._lanes.write(rows, *(_full(a, shape) for a, shape in zip(belief, shapes, strict=True)))

    def take(self, rows: _Rows) -> "NativeStore":
        """Return a store whose rows 0..k-1 are copies of `rows`."""
        store = NativeStore(self._n, self._sizes, len(rows), self._isa)
        store.copy_from(np.arange(len(rows)), self, rows)
        return store

    def copy_from(self, rows: _Rows, other: "NativeStore", other_rows: _Rows) -> None:
        """Overwrite rows with those of another store."""
        self._lanes.copy_from(rows, other._lanes, other_rows)

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
        if self._step(rows, trans, F, b, Q, mode) == _DOUBTFUL:
            for c, t in enumerate(trans):
                finite(f"trans[{c}]", 0.0 if t is None else t)
            F, b, Q = finite("F", F), None if b is None else finite("b", b), covariances("Q", finite("Q", Q))
            if self._step(rows, trans, F, b, Q, mode) == _DOUBTFUL:
                raise ModelError("Q is not positive semidefinite. Give covariances, never factors or precisions.")

    def _step(
        self,
        rows: _Rows,
        trans: Sequence[_Array | None],
        F: _Array,
        b: _Array | None,
        Q: _Array,
        mode: _Modes | None,
    ) -> int:
        drift = None if b is None else _looked_up(b, mode)
        return int(self._lanes.step(rows, trans, _looked_up(F, mode), drift, _looked_up(Q, mode)))

    def measure(
        self, rows: _Rows, z: _Array, H: _Array, d: _Array | None, R: _Array, mode: _Modes | None = None, *, write: bool
    ) -> tuple[_Array, _Array]:
        """Return d2 and log f(z); condition the rows when `write`."""
        d2, log_f = np.empty(len(rows)), np.empty(len(rows))
        fault = self._measure(rows, z, (H, d, R), mode, d2, log_f, write=write)
        if fault[0] == _DOUBTFUL:
            model = finite("H", H), None if d is None else finite("d", d), covariances("R", finite("R", R))
            fault = self._measure(rows, z, model, mode, d2, log_f, write=write)
        if fault[0] == _DOUBTFUL:
            raise ModelError("R is not positive semidefinite. Give covariances, never factors or precisions.")
        if fault[0]:
            raise _refused_row(fault, z)
        return d2, log_f

    def _measure(
        self,
        rows: _Rows,
        z: _Array,
        model: tuple[_Array, _Array | None, _Array],
        mode: _Modes | None,
        d2: _Array,
        log_f: _Array,
        *,
        write: bool,
    ) -> _Modes:
        """Write d2 and log f(z); return what is wrong, and where."""
        H, d, R = model
        offset = None if d is None else _looked_up(d, mode)
        return np.array(
            self._lanes.measure(rows, write, z, _looked_up(H, mode), offset, _looked_up(R, mode), d2, log_f)
        )

    def moments(self, rows: _Rows) -> tuple[_Array, _Array, _Array]:
        """Return mean, covariance and mode probabilities of rows."""
        k, n = len(rows), self._n
        mean, cov, probs = np.empty((k, n)), np.empty((k, n, n)), np.empty((k, *self._sizes))
        self._lanes.moments(rows, mean, cov, probs)
        return mean, cov, probs

    def expand(self, rows: _Rows, now: _Modes, trans: _Array, z: _Array, tables: Tables) -> tuple[_Array, _Array]:
        """Return P(next mode | row, z) and log f(z | row)."""
        law, log_f = np.empty((len(rows), len(trans))), np.empty(len(rows))
        F, b, Q, H, d, R = tables
        same = tables.same(len(trans))
        fault = self._lanes.expand(rows, now, same, trans, z, F, b, Q, H, d, R, law, log_f)
        if fault[0]:
            raise _refused_row(np.array(fault), z)
        return law, log_f

    def merged(self, rows: _Rows, weights: _Array, labels: _Modes, n_labels: int) -> Merged:
        """Return total weight, mean and covariance of the rows of each label."""
        n = self._n
        out = Merged(np.empty(n_labels), np.empty((n_labels, n)), np.empty((n_labels, n, n)))
        self._lanes.merge(rows, weights, labels, *out)
        return out

    def merge(self, rows: _Rows, copies: "NativeStore", start: _Rows, log_weights: _Array) -> None:
        """Overwrite rows with mixtures of another store's rows 0, 1, ..., a group each."""
        self._lanes.merge_copies(rows, copies._lanes, start, log_weights)


def _looked_up(table: _Array, mode: _Modes | None) -> Any:
    """A table with the row of it that each row of the bank takes."""
    return table if mode is None or len(table) == 1 else (np.ascontiguousarray(table), mode)


def _full(a: _Array, shape: tuple[int, ...]) -> _Array:
    return a if a.shape == shape else np.broadcast_to(a, shape)
