"""One reading of array shapes for every backend: from the right, fixed by the number of chains.

With C = len(trans) chains, a model array is `(*batch, T|1, M1|1, ..., MC|1, rows, cols)`; leading axes may be
absent. ndim C+2 (rows, cols and one axis per chain) is constant, C+3 time varying, more is per run.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError

__all__ = ["Aligned", "align", "array", "covariances", "finite"]

_Array = npt.NDArray[np.float64]
_LARGE = 100_000  # elements above which reading an array once more is worth avoiding
_INDEFINITE = 1e-8  # of a variance: a pivot below minus this is no rounding
_DEAD = 1e-6  # of a variance: a pivot below this is not divided by, or rounding would grow to _INDEFINITE


class Aligned(NamedTuple):
    """Canonical inputs: every array carries all its axes, absent ones with length 1 (stride 0 when broadcast)."""

    z: _Array  # (*batch, T, m), 0 where missing
    seen: npt.NDArray[np.bool_]  # (*batch, T, m)
    F: _Array  # (*batch|1, T|1, M1|1, ..., n, n)
    Q: _Array
    H: _Array  # (..., m, n)
    R: _Array  # (..., m, m)
    b: _Array | None  # (..., n)
    d: _Array | None  # (..., m)
    trans: tuple[_Array | None, ...]  # (*batch|1, T|1, Mc, Mc); None = the chain cannot switch
    log_probs0: _Array  # (*batch|1, M1, ..., MC)
    mean0: _Array  # (*batch|1, M1|1, ..., n)
    cov0: _Array  # (*batch|1, M1|1, ..., n, n)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of states of each chain."""
        return self.log_probs0.shape[self.log_probs0.ndim - len(self.trans) :]


class _Reader:
    """Reads arguments one by one against the shapes that z, trans and cov0 fix."""

    def __init__(self, batch: tuple[int, ...], n_steps: int, sizes: tuple[int, ...], defer: bool) -> None:
        self.batch, self.n_steps, self.sizes, self.defer = batch, n_steps, sizes, defer

    def model(self, name: str, value: npt.ArrayLike, core: tuple[int, ...]) -> _Array:
        """Read a model array with trailing axes `core`: constant, time varying or per run."""
        a = array(name, value)
        a = a if self._deferred(a, core) else finite(name, a)
        n_modes, base = len(self.sizes), len(self.sizes) + len(core)
        expected = f"(*{self.batch}, {self.n_steps}|1, {_modes(self.sizes)}{_axes(core)})"
        if a.ndim < base:
            raise ModelError(
                f"{name} has shape {a.shape}; with {n_modes} chain(s) it is read from the right as {expected}, "
                f"which needs at least {base} axes. A matrix common to all modes: "
                f"{name}.reshape({(1,) * (base - len(core)) + a.shape[-len(core) :]})."
            )
        full = (*self.batch, self.n_steps, *self.sizes, *core)
        return self._fit(name, a, full, expected, exact=len(core))

    def covariance(self, name: str, value: npt.ArrayLike, core: tuple[int, ...]) -> _Array:
        """Read a model array of covariances."""
        value = array(name, value)
        a = self.model(name, value, core)
        return a if self._deferred(value, core) else covariances(name, a)

    def _deferred(self, value: _Array, core: tuple[int, ...]) -> bool:
        """Whether the elements are left to the compiled kernel: given per run, and too large to be read twice."""
        return self.defer and value.ndim > len(self.sizes) + 1 + len(core) and value.size > _LARGE

    def prior(self, name: str, value: npt.ArrayLike, core: tuple[int, ...]) -> _Array:
        """Read mean0 or cov0: shared, per mode, or per run."""
        a = finite(name, value)
        n_modes = len(self.sizes)
        expected = f"{core} shared, ({_modes(self.sizes)}{_axes(core)}) per mode, (*{self.batch}, ...) per run"
        if a.ndim == len(core):
            a = a.reshape((1,) * n_modes + a.shape)
        if a.ndim < n_modes + len(core):
            raise ModelError(
                f"{name} has shape {a.shape}, which is none of: {expected}. "
                f"Give one value per mode with an axis of length 1 for each chain it does not depend on."
            )
        return self._fit(name, a, (*self.batch, *self.sizes, *core), expected, exact=len(core))

    def plain(self, name: str, value: npt.ArrayLike, core: tuple[int, ...], timed: bool) -> _Array:
        """Read probs0 (core = sizes) or a transition matrix (core = (Mc, Mc), `timed`): no broadcast in core."""
        a = finite(name, value)
        lead = (*self.batch, self.n_steps) if timed else self.batch
        expected = f"{core}" + (f", ({self.n_steps}, {_axes(core)}) time varying" if timed else "") + " or per run"
        if a.ndim < len(core):
            raise ModelError(f"{name} has shape {a.shape}, expected {expected}.")
        return self._fit(name, a, (*lead, *core), expected, exact=len(core))

    def _fit(self, name: str, a: _Array, full: tuple[int, ...], expected: str, exact: int) -> _Array:
        if a.ndim > len(full):
            raise ModelError(f"{name} has {a.ndim} axes, {a.shape}, but is read as {expected}: drop leading axes.")
        a = a.reshape((1,) * (len(full) - a.ndim) + a.shape)
        loose = len(full) - exact
        bad = [i for i in range(loose) if a.shape[i] not in (1, full[i])]
        if bad or a.shape[loose:] != full[loose:]:
            raise ModelError(
                f"{name} has shape {a.shape[-max(1, len(a.shape)) :]} but is read from the right as {expected}. "
                f"Reshape it so that absent axes have length 1."
            )
        return a


def align(
    z: npt.ArrayLike,
    *,
    F: npt.ArrayLike,
    Q: npt.ArrayLike,
    H: npt.ArrayLike,
    R: npt.ArrayLike,
    trans: Sequence[npt.ArrayLike],
    mean0: npt.ArrayLike,
    cov0: npt.ArrayLike,
    probs0: npt.ArrayLike,
    b: npt.ArrayLike | None,
    d: npt.ArrayLike | None,
    defer: bool = False,
) -> Aligned:
    """Validate the arguments of a batch filter and give every array its full set of axes.

    With `defer`, the elements of z (NaN stays NaN, `seen` says nothing) and of large model arrays given per run are
    not looked at: the compiled kernel reports doubtful ones as it loads them, and its caller aligns again without.

    Raises:
        ModelError: a shape that fits no reading, probabilities that are none, a covariance that is none.
        DataError: inf in z, or NaN or inf elsewhere.
    """
    z_in, seen = _measurements(z, defer)
    m = z_in.shape[-1]
    cov0 = array("cov0", cov0)
    if cov0.ndim < 2:
        raise ModelError(f"cov0 has shape {cov0.shape}; it is a covariance matrix, (n, n), per mode or per run.")
    n = cov0.shape[-1]
    matrices = transitions(trans)
    for c, t in enumerate(matrices):
        if t.ndim < 2 or t.shape[-1] != t.shape[-2] or t.shape[-1] == 0:
            raise ModelError(f"trans[{c}] has shape {t.shape}; a transition matrix is square, (M, M).")
    reader = _Reader(z_in.shape[:-2], z_in.shape[-2], tuple(t.shape[-1] for t in matrices), defer)
    return Aligned(
        z=z_in,
        seen=seen,
        F=reader.model("F", F, (n, n)),
        Q=reader.covariance("Q", Q, (n, n)),
        H=reader.model("H", H, (m, n)),
        R=reader.covariance("R", R, (m, m)),
        b=None if b is None else reader.model("b", b, (n,)),
        d=None if d is None else reader.model("d", d, (m,)),
        trans=tuple(_transition(c, reader.plain(f"trans[{c}]", t, t.shape[-2:], True)) for c, t in enumerate(matrices)),
        log_probs0=_log_law("probs0", reader.plain("probs0", probs0, reader.sizes, False), len(matrices)),
        mean0=reader.prior("mean0", mean0, (n,)),
        cov0=covariances("cov0", reader.prior("cov0", cov0, (n, n))),
    )


def _measurements(z: npt.ArrayLike, defer: bool) -> tuple[_Array, npt.NDArray[np.bool_]]:
    z_in = array("z", z)
    if z_in.ndim < 2 or z_in.shape[-2] == 0 or z_in.shape[-1] == 0:
        raise DataError(f"z has shape {z_in.shape}; it is (*batch, T, m) with T and m at least 1.")
    if defer:
        return z_in, np.broadcast_to(np.True_, z_in.shape)
    if np.isinf(z_in).any():
        where = tuple(int(i) for i in np.argwhere(np.isinf(z_in))[0])
        raise DataError(f"z{list(where)} is infinite. A missing component is NaN.")
    seen = ~np.isnan(z_in)
    return np.where(seen, z_in, 0.0), seen


def transitions(trans: Sequence[npt.ArrayLike]) -> list[_Array]:
    """Read one matrix per chain.

    Raises:
        ModelError: it is no sequence, or holds what is no array of numbers.
    """
    if not isinstance(trans, Sequence | np.ndarray) or isinstance(trans, str):
        raise ModelError(f"trans is one transition matrix per chain, [matrix, ...], got {trans!r}; [] is no chain.")
    return [array(f"trans[{c}]", t) for c, t in enumerate(trans)]


def array(name: str, value: npt.ArrayLike) -> _Array:
    """Read an array of numbers.

    Raises:
        ModelError: it is ragged, or not of numbers.
    """
    try:
        if np.iscomplexobj(value):
            raise TypeError("it is complex")
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        shapes = dict.fromkeys(str(np.shape(v)) for v in _elements(value))
        if len(shapes) < 2:
            raise ModelError(f"{name} is not an array of numbers: {error}.") from None
        raise ModelError(
            f"{name} is not one array: its elements have the shapes {', '.join(shapes)}. All modes have one state "
            "vector and one measurement. Embed the smaller model in the larger: rows and columns of zeros in F and Q, "
            "columns of zeros in H, and a variance in cov0 for the states it does not have."
        ) from None


def _elements(value: object) -> Sequence[npt.ArrayLike]:
    """The elements of a list of lists, as deep as they can be told apart."""
    if not isinstance(value, list | tuple):
        return ()
    try:
        shapes = {np.shape(v) for v in value}
    except ValueError:  # ragged themselves
        return [inner for v in value for inner in _elements(v)]
    return value if len(shapes) > 1 else ()


def finite(name: str, value: npt.ArrayLike) -> _Array:
    """Read an array of finite numbers.

    Raises:
        ModelError: it is ragged, or not of numbers.
        DataError: NaN or inf.
    """
    a = array(name, value)
    if not np.isfinite(a).all():
        where = [int(i) for i in np.argwhere(~np.isfinite(a))[0]]
        raise DataError(f"{name}{where} is {a[tuple(where)]}; only z may hold NaN (a missing component).")
    return a


def covariances(name: str, a: _Array) -> _Array:
    """Check that matrices are covariances, and make them symmetric to the last bit.

    Eigenvalues are judged in units of each matrix's own variances: a small one beside a large one counts in full.

    Raises:
        ModelError: one is not symmetric or not positive semidefinite; the message has its index.
    """
    if a.shape[-1] == 1 and not (a < 0.0).any():
        return a.copy()
    swapped = a.swapaxes(-1, -2)
    sigma = np.sqrt(np.maximum(np.diagonal(a, axis1=-2, axis2=-1), 0.0))
    scale = sigma[..., :, None] * sigma[..., None, :]
    if (np.abs(a - swapped) > 1e-8 * scale).any():
        where = [int(i) for i in np.argwhere(np.abs(a - swapped) > 1e-8 * scale)[0]]
        raise ModelError(f"{name} is not symmetric at index {where}. A covariance equals its transpose.")
    a = 0.5 * (a + swapped)
    bad = _indefinite(a, scale)
    if bad.any():  # to be sure: over many small pivots rounding grows all the same
        unit = np.divide(a[bad], scale[bad], out=np.zeros_like(a[bad]), where=scale[bad] > 0)
        without = ((a[bad] != 0) & (scale[bad] == 0)).any(axis=(-1, -2))
        bad[bad] = without | (np.linalg.eigvalsh(unit)[..., 0] < -_INDEFINITE)
    if bad.any():
        where = [int(i) for i in np.argwhere(bad)[0]]
        at = f" at index {where}" if where else ""
        raise ModelError(f"{name} is not positive semidefinite{at}. Give covariances, never factors or precisions.")
    return a


def _indefinite(a: _Array, scale: _Array) -> npt.NDArray[np.bool_]:
    """Which matrices are no covariances, by their pivots in units of the variances."""
    unit = np.divide(a, scale, out=np.zeros_like(a), where=scale > 0)
    bad = np.asarray(((a != 0) & (scale == 0)).any(axis=(-1, -2)))
    try:  # mostly all are definite, which costs least to find
        np.linalg.cholesky(unit + _INDEFINITE * np.eye(a.shape[-1]))
        return bad
    except np.linalg.LinAlgError:
        pass
    for j in range(a.shape[-1]):
        pivot, rest = unit[..., j, j], unit[..., j + 1 :, j]
        bad |= pivot < -_INDEFINITE
        dead = pivot <= _DEAD
        others = np.diagonal(unit, axis1=-2, axis2=-1)[..., j + 1 :]
        most = 4.0 * (np.maximum(pivot, 0.0) + _INDEFINITE)[..., None] * (np.maximum(others, 0.0) + _INDEFINITE)
        bad |= dead & (np.square(rest) > most).any(axis=-1)
        share = np.where(dead[..., None], 0.0, rest) / np.where(dead, 1.0, pivot)[..., None]
        unit = unit - np.pad(share[..., :, None] * rest[..., None, :], [(0, 0)] * (a.ndim - 2) + [(j + 1, 0)] * 2)
    return bad


def _transition(c: int, t: _Array) -> _Array | None:
    sums = t.sum(-1)
    if (t < 0).any():
        where = [int(i) for i in np.argwhere(t < 0)[0]]
        raise ModelError(f"trans[{c}]{where} is {t[tuple(where)]:.6g}; a probability is at least 0.")
    if (np.abs(sums - 1.0) > 1e-6).any():
        off = np.abs(sums - 1.0)
        row = [int(i) for i in np.argwhere(off == off.max())[0]]
        raise ModelError(
            f"trans[{c}] rows must be probabilities that sum to 1: row {row[-1]} sums to {sums[tuple(row)]:.6g}. "
            "Give probabilities *from* each state: trans[i, j] = P(next = j | now = i)."
        )
    # Rows are made to sum to 1 to the last bit, or rounding in the caller's matrix would grow with every empty row.
    return None if (t == np.eye(t.shape[-1])).all() else t / sums[..., None]


def _log_law(name: str, p: _Array, n_chains: int) -> _Array:
    axes = tuple(range(p.ndim - n_chains, p.ndim))
    total = p.sum(axis=axes, keepdims=True)
    if (p < 0).any():
        raise ModelError(f"{name} holds {p.min():.6g}; a probability is at least 0.")
    off = np.abs(total - 1.0)
    if (off > 1e-6).any():
        raise ModelError(
            f"{name} must be probabilities that sum to 1 over all modes; a sum is {total.flat[off.argmax()]:.6g}."
        )
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(p / total))


def _axes(core: tuple[int, ...]) -> str:
    return ", ".join(str(s) for s in core)


def _modes(sizes: tuple[int, ...]) -> str:
    return "".join(f"{s}|1, " for s in sizes)
