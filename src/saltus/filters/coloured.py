"""The multimode filter for coloured measurement noise: measurement differencing inside the one recursion.

The measurement is part of a Markov process, y_k = Phi_yx x_{k-1} + Phi_yy y_{k-1} + e_y with e_y correlated with the
state's noise, and its previous value is known: the steps are mix, joint (with all blocks of N) and condition, in the
dimension of the state alone. After a gap the missing part of y is carried with the state until it is measured again.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError, NumericalError
from saltus.filters import steps
from saltus.filters.align import Aligned, align
from saltus.filters.backend import Backend
from saltus.filters.coloured_model import Augmented, Differenced, augment, difference
from saltus.filters.estimates import Estimates
from saltus.filters.imm import imm_filter

__all__ = ["after_first", "augmented_filter", "coloured_filter", "of_state", "run_augmented", "run_differenced"]

_Array = npt.NDArray[np.float64]
_Index = tuple[slice | int, ...]

_NO_NOISE = (
    "an innovation covariance is not positive definite: a measured component repeats what is known exactly. Two "
    "samples at one time, or noise_G = 0 where the state brings no noise either. Drop the repeated sample, or give "
    "the noise a diffusion."
)


def coloured_filter(
    z: npt.ArrayLike,
    *,
    F: npt.ArrayLike,
    G: npt.ArrayLike,
    noise_F: npt.ArrayLike,
    noise_G: npt.ArrayLike,
    H: npt.ArrayLike,
    dt: npt.ArrayLike,
    trans: Sequence[npt.ArrayLike],
    mean0: npt.ArrayLike,
    cov0: npt.ArrayLike,
    noise_cov0: npt.ArrayLike,
    probs0: npt.ArrayLike,
    per_mode: bool = False,
) -> Estimates:
    """Filter measurements whose errors are a Markov process, by differencing: the state keeps its dimension.

    dx = F x dt + G dW,   y = H x + w,   dw = noise_F w dt + noise_G dW';   mode at k holds over (t_{k-1}, t_k]:

        y~ = Phi_yx x + Phi_yy y_{k-1},        U = Phi_xx P Phi_yx' + B_xy,   S = Phi_yx P Phi_yx' + B_yy,
        K = U S^-1,   x+ = Phi_xx x + K (y_k - y~),   P+ = (Phi_xx - K Phi_yx) P (.)' + [I -K] B [I -K]'

    per mode after mixing. With C = len(trans) chains, matrices have one axis per chain (length 1 where they do not
    depend on it), then rows and columns. w is continuous when its chain switches: only its dynamics change. The
    posterior is that of `augmented_filter`, gaps included.

    Args:
        z: measurements, (*batch, K+1, m); NaN is a missing component. Row 0 is the first sample.
        F: (M1|1, ..., n, n), 1/s, continuous time.
        G: (M1|1, ..., n, q), state unit / sqrt(s).
        noise_F: (M1|1, ..., m, m), 1/s.
        noise_G: (M1|1, ..., m, r), measurement unit / sqrt(s).
        H: (m, n), the same in every mode.
        dt: interval between rows, s; one for all, or (K,).
        trans: one matrix per chain, trans[c][i, j] = P(next = j | now = i); (Mc, Mc), (K, Mc, Mc) or per run.
        mean0: mean of x *at* z[0], before it is seen; (n,), per mode (M1|1, ..., n), or per run.
        cov0: its covariance; (n, n), per mode, or per run.
        noise_cov0: covariance of w at z[0], independent of x; (m, m), per mode (M1|1, ..., m, m), or per run.
        probs0: law of the modes at z[0], (M1, ..., MC), or per run.
        per_mode: also return every mode's mean and covariance.

    Returns:
        Estimates of x with rows 1..K; log_likelihood_start is log f(z[0]).

    Raises:
        ModelError: a shape or a law that cannot be; the message says how it was read and how to mend it.
        DataError: inf in z, NaN or inf elsewhere, negative intervals, fewer than two rows.
        NumericalError: a measured component was already known exactly.

    Source: Detkov (2023), equations 21-28, in the corrected form of the notes on coloured measurement noise,
    section 3, with the start from the first sample and gaps.
    """
    measured = _measured(z)
    described = augment(
        F=F, G=G, noise_F=noise_F, noise_G=noise_G, H=H, dt=dt, n_steps=measured.shape[-2] - 1,
        n_chains=len(trans), mean0=mean0, cov0=cov0, noise_cov0=noise_cov0,
    )  # fmt: skip
    return after_first(run_differenced(measured, described, trans, probs0, per_mode=per_mode))


def augmented_filter(
    z: npt.ArrayLike,
    *,
    F: npt.ArrayLike,
    G: npt.ArrayLike,
    noise_F: npt.ArrayLike,
    noise_G: npt.ArrayLike,
    H: npt.ArrayLike,
    dt: npt.ArrayLike,
    trans: Sequence[npt.ArrayLike],
    mean0: npt.ArrayLike,
    cov0: npt.ArrayLike,
    noise_cov0: npt.ArrayLike,
    probs0: npt.ArrayLike,
    R: npt.ArrayLike | None = None,
    per_mode: bool = False,
) -> Estimates:
    """Filter the same measurements with the noise appended to the state: n + m dimensions in every mode.

    a = (x, w),   z = [H I] a + v,  cov v = R

    Arguments, results and errors are those of `coloured_filter`. In addition R, (M1|1, ..., m, m), is the white part of
    the noise; absent means none, and then both filters agree.
    """
    measured = _measured(z)
    described = augment(
        F=F, G=G, noise_F=noise_F, noise_G=noise_G, H=H, dt=dt, n_steps=measured.shape[-2] - 1,
        n_chains=len(trans), mean0=mean0, cov0=cov0, noise_cov0=noise_cov0,
    )  # fmt: skip
    return run_augmented(measured, described, trans, probs0, R=R, per_mode=per_mode)


def run_augmented(
    z: npt.ArrayLike,
    model: Augmented,
    trans: Sequence[npt.ArrayLike],
    probs0: npt.ArrayLike,
    *,
    R: npt.ArrayLike | None = None,
    per_mode: bool = False,
    backend: Backend | None = None,
) -> Estimates:
    """Filter the augmented state from its first sample on; the estimates are those of x.

    Raises:
        ModelError, DataError, NumericalError: as `augmented_filter`.
    """
    data = _read(z, model, trans, probs0, R)
    first, log_start, _ = _start(data, np.eye(model.F.shape[-1]))
    done = imm_filter(
        data.z[..., 1:, :],
        F=model.F,
        Q=model.Q,
        b=model.b,
        H=data.aligned.H[data.first],
        R=data.aligned.R[data.first],
        trans=trans,
        mean0=first.means,
        cov0=first.covs,
        probs0=np.exp(first.log_probs),
        per_mode=per_mode,
        backend=backend,
    )
    return replace(of_state(done, model.n_state), log_likelihood_start=log_start)


def of_state(est: Estimates, n: int) -> Estimates:
    """Keep the first n components, those of x."""
    return replace(
        est,
        mean=est.mean[..., :n],
        cov=est.cov[..., :n, :n],
        mode_means=None if est.mode_means is None else est.mode_means[..., :n],
        mode_covs=None if est.mode_covs is None else est.mode_covs[..., :n, :n],
    )


def run_differenced(
    z: npt.ArrayLike,
    model: Augmented,
    trans: Sequence[npt.ArrayLike],
    probs0: npt.ArrayLike,
    *,
    per_mode: bool = False,
) -> Estimates:
    """Filter the state, and what of the noise is not seen, from the first sample on.

    Returns:
        Estimates of x with one row per row of z, the first included.

    Raises:
        ModelError, DataError, NumericalError: as `coloured_filter`.
    """
    data = _read(z, model, trans, probs0, None)
    moves = difference(model._replace(F=data.aligned.F, Q=data.aligned.Q, b=data.aligned.b))
    out, n = _allocate(data, model.n_state, per_mode), model.n_state
    runs = (slice(None),) * (data.z.ndim - 2)
    try:
        belief, log_f, d2 = _start(data, moves.T[: moves.n_kept] if data.complete[0] else moves.T)
        belief = _pin(belief, data, 0, moves.n_kept)
        for k in range(data.z.shape[-2]):
            if k > 0:
                belief, log_f, d2 = _step(data, moves, belief, k - 1)
            at: _Index = (*runs, k)
            out.probs[at], out.log_likelihood[at], out.nis[at] = np.exp(belief.log_probs), log_f, d2
            means, covs = belief.means[..., :n], belief.covs[..., :n, :n]
            out.mean[at], out.cov[at] = steps.collapse(belief.log_probs, means, covs, len(trans))
            if out.mode_means is not None and out.mode_covs is not None:
                out.mode_means[at], out.mode_covs[at] = means, covs
    except NumericalError as error:
        raise NumericalError(_NO_NOISE) from error
    return out


def after_first(est: Estimates) -> Estimates:
    """Drop the row of the first sample; its log-likelihood becomes log_likelihood_start."""
    lead = est.mean.ndim - 2

    def rest(a: _Array) -> _Array:
        return a[(slice(None),) * lead + (slice(1, None),)]

    return replace(
        est,
        probs=rest(est.probs),
        mean=rest(est.mean),
        cov=rest(est.cov),
        log_likelihood=rest(est.log_likelihood),
        log_likelihood_start=np.asarray(est.log_likelihood[..., 0]),
        nis=rest(est.nis),
        n_observed=rest(est.n_observed),
        mode_means=None if est.mode_means is None else rest(est.mode_means),
        mode_covs=None if est.mode_covs is None else rest(est.mode_covs),
    )


class _Data(NamedTuple):
    """The measurements with their first row, and the model in the shapes of `align` for rows 1..K."""

    z: _Array  # (*batch, K+1, m), NaN where missing
    seen: npt.NDArray[np.bool_]
    complete: npt.NDArray[np.bool_]  # (K+1,): every component of every run is seen
    aligned: Aligned

    @property
    def first(self) -> tuple[int, ...]:
        """Index of the first run and row: H and R are common to all."""
        return (0,) * (self.z.ndim - 1)


def _measured(z: npt.ArrayLike) -> _Array:
    a = np.asarray(z, dtype=np.float64)
    if a.ndim < 2 or a.shape[-2] < 2 or a.shape[-1] == 0:
        raise DataError(f"z has shape {a.shape}; it is (*batch, K+1, m): the first sample, and K >= 1 rows after it.")
    if np.isinf(a).any():
        raise DataError(f"z{[int(i) for i in np.argwhere(np.isinf(a))[0]]} is infinite. A missing component is NaN.")
    return a


def _read(
    z: npt.ArrayLike, model: Augmented, trans: Sequence[npt.ArrayLike], probs0: npt.ArrayLike, R: npt.ArrayLike | None
) -> _Data:
    whole = _measured(z)
    (m, _), modes = model.H.shape, (1,) * len(trans)
    if whole.shape[-1] != m:
        raise ModelError(f"z has {whole.shape[-1]} components, but H {model.H.shape} measures {m}.")
    aligned = align(
        whole[..., 1:, :],
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
    )
    if aligned.R.shape[whole.ndim - 2] != 1:
        raise ModelError("the white part R of the noise must not vary in time here.")
    seen = ~np.isnan(whole)
    complete = np.asarray(seen.all(axis=(*range(whole.ndim - 2), -1)))
    return _Data(whole, seen, complete, aligned)


def _start(data: _Data, A: _Array) -> tuple[steps.Belief, _Array, _Array]:
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
    done = steps.condition(prediction, *_per_mode(data, 0))
    log_probs0 = np.broadcast_to(prior.log_probs0, lead)
    d2 = _nis(log_probs0, prediction, data, 0)
    log_probs, log_f = steps.reweigh(log_probs0, done.loglik, len(prior.sizes))
    return steps.Belief(log_probs, done.mean, np.broadcast_to(done.cov, (*lead, p, p))), log_f, d2


def _nis(log_probs: _Array, prediction: steps.Joint, data: _Data, k: int) -> _Array:
    seen = data.seen[..., k, :]
    z = np.where(seen, data.z[..., k, :], 0.0)
    return steps.mixture_nis(log_probs, prediction, z, seen, len(data.aligned.trans))


def _step(data: _Data, moves: Differenced, belief: steps.Belief, k: int) -> tuple[steps.Belief, _Array, _Array]:
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
    done = steps.condition(prediction, *_per_mode(data, k + 1))
    d2 = _nis(log_probs, prediction, data, k + 1)
    log_probs, log_f = steps.reweigh(log_probs, done.loglik, len(model.trans))
    return _pin(steps.Belief(log_probs, done.mean, done.cov), data, k + 1, kept), log_f, d2


def _pin(belief: steps.Belief, data: _Data, k: int, kept: int) -> steps.Belief:
    """Give what was measured its exact value and no variance: rounding must not make it uncertain again."""
    if data.complete[k]:
        return belief
    z, seen = _per_mode(data, k)
    free = np.concatenate([np.ones((*seen.shape[:-1], kept)), ~seen], axis=-1)
    means = belief.means.copy()
    means[..., kept:] = np.where(seen, z, means[..., kept:])
    return belief._replace(means=means, covs=belief.covs * (free[..., :, None] * free[..., None, :]))


def _per_mode(data: _Data, k: int) -> tuple[_Array, npt.NDArray[np.bool_]]:
    """Row k of z, 0 where missing, and what of it was seen, with one axis of length 1 per chain."""
    z, seen = data.z[..., k, :], data.seen[..., k, :]
    shape = z.shape[:-1] + (1,) * len(data.aligned.trans) + z.shape[-1:]
    return np.where(seen, z, 0.0).reshape(shape), seen.reshape(shape)


def _allocate(data: _Data, n: int, per_mode: bool) -> Estimates:
    batch, sizes = data.z.shape[:-2], data.aligned.sizes
    rows = (*batch, data.z.shape[-2])
    return Estimates(
        probs=np.empty((*rows, *sizes)),
        mean=np.empty((*rows, n)),
        cov=np.empty((*rows, n, n)),
        log_likelihood=np.empty(rows),
        log_likelihood_start=np.zeros(batch),
        nis=np.empty(rows),
        n_observed=data.seen.sum(-1).astype(float),
        mode_means=np.empty((*rows, *sizes, n)) if per_mode else None,
        mode_covs=np.empty((*rows, *sizes, n, n)) if per_mode else None,
    )


def _row(k: int, axis: int, a: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return np.asarray(np.take(a, k if a.shape[axis] > 1 else 0, axis=axis))
