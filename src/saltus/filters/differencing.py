"""The recursion for coloured measurement noise by differencing: the definition in NumPy.

The measurement is part of a Markov process, y_k = Phi_yx x_{k-1} + Phi_yy y_{k-1} + e_y with e_y correlated with the
state's noise, and its previous value is known: the steps are mix, joint (with all blocks of N) and condition, in the
dimension of the state alone. After a gap the missing part of y is carried with the state until it is measured again.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError, NumericalError
from saltus.filters import steps
from saltus.filters.align import Aligned, align
from saltus.filters.coloured_model import Augmented, Differenced
from saltus.filters.estimates import Estimates, allocate
from saltus.filters.refusals import check_finite

__all__ = ["Samples", "aligned_samples", "filter_differenced", "known_exactly", "measured", "read", "start"]

_Array = npt.NDArray[np.float64]
_Index = tuple[slice | int, ...]


def known_exactly(where: str, B: _Array, m: int, n_chains: int) -> NumericalError:
    """The error of a measured component that was known exactly, with the first interval that brings one no noise.

    Args:
        where: run, row and component.
        B: covariance of the noise of s, (T?, M1|1, ..., MC|1, n+p, n+p); its last m components are measured.
        m: number of measured components.
        n_chains: C.
    """
    none = np.argwhere(np.diagonal(B, axis1=-2, axis2=-1)[..., -m:] <= 0)
    time, source = B.ndim - n_chains - 3, ""
    if len(none):
        timed = time >= 0 and B.shape[time] > 1
        interval = f"the interval before row {none[0, time] + 1}" if timed else "any interval"
        source = f" Component {none[0, -1]} gets no noise in {interval}."
    return NumericalError(
        f"{where}: an innovation covariance is not positive definite: a measured component repeats what is known "
        f"exactly.{source} Two samples at one time, or noise_G = 0 where the state brings no noise either. Drop the "
        "repeated sample, or give the noise a diffusion."
    )


class Samples(NamedTuple):
    """The measurements with their first row, and the model in the shapes of `align` for rows 1..K."""

    z: _Array  # (*batch, K+1, m), NaN where missing
    seen: npt.NDArray[np.bool_]
    complete: npt.NDArray[np.bool_]  # (K+1,): every component of every run is seen
    aligned: Aligned

    @property
    def first(self) -> tuple[int, ...]:
        """Index of the first run and row: H and R are common to all."""
        return (0,) * (self.z.ndim - 1)


def measured(z: npt.ArrayLike) -> _Array:
    """Read z, (*batch, K+1, m).

    Raises:
        DataError: fewer than two rows, or no component.
    """
    a = np.asarray(z, dtype=np.float64)
    if a.ndim < 2 or a.shape[-2] < 2 or a.shape[-1] == 0:
        raise DataError(f"z has shape {a.shape}; it is (*batch, K+1, m): the first sample, and K >= 1 rows after it.")
    return a


def aligned_samples(
    z: _Array,
    model: Augmented,
    trans: Sequence[npt.ArrayLike],
    probs0: npt.ArrayLike,
    R: npt.ArrayLike | None,
    *,
    defer: bool = False,
) -> Aligned:
    """Align a model in the shapes of rows 1..K; `defer` leaves the elements of z to the compiled kernel.

    Raises:
        ModelError: a shape or a law that cannot be.
        DataError: inf in z, NaN or inf elsewhere.
    """
    (m, _), modes = model.H.shape, (1,) * len(trans)
    if z.shape[-1] != m:
        raise ModelError(f"z has {z.shape[-1]} components, but H {model.H.shape} measures {m}.")
    if not defer and np.isinf(z).any():
        raise DataError(f"z{[int(i) for i in np.argwhere(np.isinf(z))[0]]} is infinite. A missing component is NaN.")
    aligned = align(
        z[..., 1:, :],
        F=model.F,
        Q=model.Q,
        H=np.concatenate([model.H, model.L], axis=-1).reshape(*modes, m, -1),
        R=np.zeros((*modes, m, m)) if R is None else R,
        trans=trans,
        mean0=model.mean0,
        cov0=model.cov0,
        probs0=probs0,
        b=model.b,
        d=None,
        defer=defer,
    )
    if aligned.R.shape[z.ndim - 2] != 1:
        raise ModelError("the white part R of the noise must not vary in time here.")
    return aligned


def read(z: _Array, aligned: Aligned) -> Samples:
    """Say what of z is seen."""
    seen = ~np.isnan(z)
    return Samples(z, seen, np.asarray(seen.all(axis=(*range(z.ndim - 2), -1))), aligned)


def filter_differenced(data: Samples, moves: Differenced, n: int, *, per_mode: bool, every: bool) -> Estimates:
    """Filter the state, its first n components, and what of the noise is not seen, from the first sample on.

    Returns:
        Estimates of x with one row per row of z, the first included, or the last row only.

    Raises:
        NumericalError: an innovation covariance is not positive definite.
    """
    n_rows, batch, sizes = data.z.shape[-2], data.z.shape[:-2], data.aligned.sizes
    out = allocate(batch, n_rows if every else 1, n_rows, sizes, n, per_mode)
    out.n_observed[...] = data.seen.sum(-1)[..., -out.n_observed.shape[-1] :]
    runs = (slice(None),) * (data.z.ndim - 2)
    belief, log_f, d2 = start(data, moves.T[: moves.n_kept] if data.complete[0] else moves.T)
    belief = _pin(belief, data, 0, moves.n_kept)
    for k in range(n_rows):
        if k > 0:
            belief, log_f, d2 = _step(data, moves, belief, k - 1)
        out.log_likelihood[..., k] = log_f
        if not every and k < n_rows - 1:
            continue
        at: _Index = (*runs, k if every else 0)
        out.probs[at], out.nis[at] = np.exp(belief.log_probs), d2
        means, covs = belief.means[..., :n], belief.covs[..., :n, :n]
        out.mean[at], out.cov[at] = steps.collapse(belief.log_probs, means, covs, len(data.aligned.trans))
        check_finite(out.mean[at], out.cov[at], k)
        if out.mode_means is not None and out.mode_covs is not None:
            out.mode_means[at], out.mode_covs[at] = means, covs
    return out


def start(data: Samples, A: _Array) -> tuple[steps.Belief, _Array, _Array]:
    """Condition the prior of a = (x, u) on the first sample, and map it: s = A a. Return belief, log f(z_0), NIS.

    S = [H L] P0 [H L]' + R, per mode; the modes are reweighed by N(z_0; [H L] a_0, S).
    """
    prior, first = data.aligned, partial(_row, 0, data.z.ndim - 2)
    p, m = A.shape[0], data.z.shape[-1]
    lead = (*data.z.shape[:-2], *prior.sizes)
    N = np.zeros((*first(prior.R).shape[:-2], p + m, p + m))
    N[..., p:, p:] = first(prior.R)
    n = prior.mean0.shape[-1]
    mean0, cov0 = np.broadcast_to(prior.mean0, (*lead, n)), np.broadcast_to(prior.cov0, (*lead, n, n))
    prediction = steps.joint(mean0, cov0, A, None, first(prior.H), None, N)
    log_probs0 = np.broadcast_to(prior.log_probs0, lead)
    belief, log_f, d2 = _updated(log_probs0, prediction, data, 0)
    return belief._replace(covs=np.broadcast_to(belief.covs, (*lead, p, p))), log_f, d2


def _updated(log_probs: _Array, prediction: steps.Joint, data: Samples, k: int) -> tuple[steps.Belief, _Array, _Array]:
    """Condition on row k of z; return belief, log f and NIS."""
    seen, n_chains = data.seen[..., k, :], len(data.aligned.trans)
    z = np.where(seen, data.z[..., k, :], 0.0)
    d2 = steps.mixture_nis(log_probs, prediction, z, seen, n_chains)
    return *steps.update(log_probs, prediction, z, seen, n_chains, k), d2


def _step(data: Samples, moves: Differenced, belief: steps.Belief, k: int) -> tuple[steps.Belief, _Array, _Array]:
    """Take the belief from row k of z to row k + 1.

    The belief is of (x, E u) where all of row k was seen, and of (x, E u, y) otherwise; so is the result.
    """
    model, kept = data.aligned, moves.n_kept
    at = partial(_row, k, data.z.ndim - 2)
    log_probs, means, covs = steps.mix(*belief, [None if t is None else at(t) for t in model.trans])
    Phi, B = at(moves.Phi), at(moves.B)
    into = slice(kept) if data.complete[k + 1] else slice(None)  # rows of s that go on
    A, C = Phi[..., into, :], Phi[..., kept:, :]
    b = None if moves.b is None else at(moves.b)
    d = None if b is None else b[..., kept:]
    b = None if b is None else b[..., into]
    if data.complete[k]:  # y_{k-1} is a known input
        before = _per_mode(data, k)[0][..., None]
        b = (A[..., kept:] @ before)[..., 0] + (0.0 if b is None else b)
        d = (C[..., kept:] @ before)[..., 0] + (0.0 if d is None else d)
        A, C = A[..., :kept], C[..., :kept]
    order = np.r_[np.arange(Phi.shape[-1])[into], np.arange(kept, Phi.shape[-1])]
    prediction = steps.joint(means, covs, A, b, C, d, B[..., order[:, None], order])
    belief, log_f, d2 = _updated(log_probs, prediction, data, k + 1)
    return _pin(belief, data, k + 1, kept), log_f, d2


def _pin(belief: steps.Belief, data: Samples, k: int, kept: int) -> steps.Belief:
    """Give what was measured its value and no variance, which rounding must not make uncertain again.

    The variance of the rest is rounded up: x and y move together in a gap, and rounding must not make them more alike
    than they can be.
    """
    if data.complete[k]:
        return belief
    z, seen = _per_mode(data, k)
    free = np.concatenate([np.ones((*seen.shape[:-1], kept)), ~seen], axis=-1)
    means = belief.means.copy()
    means[..., kept:] = np.where(seen, z, means[..., kept:])
    up = np.where(np.arange(free.shape[-1]) < kept, 1.0, 1.0 + 2.0**-48)
    factors = free[..., :, None] * free[..., None, :] * (np.diag(up - 1.0) + 1.0)
    return belief._replace(means=means, covs=belief.covs * factors)


def _per_mode(data: Samples, k: int) -> tuple[_Array, npt.NDArray[np.bool_]]:
    """Row k of z, 0 where missing, and what of it was seen, with one axis of length 1 per chain."""
    z, seen = data.z[..., k, :], data.seen[..., k, :]
    shape = z.shape[:-1] + (1,) * len(data.aligned.trans) + z.shape[-1:]
    return np.where(seen, z, 0.0).reshape(shape), seen.reshape(shape)


def _row(k: int, axis: int, a: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return np.asarray(np.take(a, k if a.shape[axis] > 1 else 0, axis=axis))
