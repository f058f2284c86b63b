"""The multimode filter over arrays: the recursion of `steps` along time, vectorised over every leading axis."""

from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from saltus.filters import steps
from saltus.filters.align import Aligned, align, array, transitions
from saltus.filters.backend import Backend, check_settings, fits_kernel, use_native
from saltus.filters.estimates import Estimates, allocate
from saltus.filters.refusals import check_finite

__all__ = ["filter_aligned", "imm_filter"]

_Array = npt.NDArray[np.float64]
_Index = tuple[slice | int, ...]


def imm_filter(
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
    b: npt.ArrayLike | None = None,
    d: npt.ArrayLike | None = None,
    per_mode: bool = False,
    keep: Literal["all", "last"] = "all",
    backend: Backend | None = None,
    num_threads: int | None = None,
) -> Estimates:
    """Filter measurements of a system whose matrices depend on hidden Markov chains.

    x_k = F x_{k-1} + b + w,   z_k = H x_k + d + v,   cov w = Q, cov v = R,   mode at k applies to (t_{k-1}, t_k]:
    mix, propagate, measure, condition, reweigh (fusion notes, section 4). With `trans=[]` it is the Kalman filter.

    Shapes are read from the right, C = len(trans): model arrays are (*batch, T|1, M1|1, ..., MC|1, rows, cols).
    Leading axes may be absent: ndim C+2 (C+1 for b, d) is constant, one more time varying, more is per run.

    Args:
        z: measurements, (*batch, T, m); NaN is a missing component.
        F: transition matrices, (..., n, n), over (t_{k-1}, t_k].
        Q: process noise covariances, (..., n, n).
        H: measurement matrices, (..., m, n).
        R: measurement noise covariances, (..., m, m).
        trans: one matrix per chain, trans[c][i, j] = P(next = j | now = i); (Mc, Mc), (T, Mc, Mc) or per run.
        mean0: prior mean one interval *before* z[0]; (n,), per mode (M1|1, ..., n), or per run.
        cov0: its covariance; (n, n), per mode, or per run.
        probs0: prior law of the modes, (M1, ..., MC), or per run; sums to 1.
        b: known input, (..., n).
        d: known measurement offset, (..., m).
        per_mode: also return every mode's mean and covariance.
        keep: "all" rows, or the "last" row only (T axis of length 1) with the log-likelihood of every row.
        backend: "numpy" for this definition, "native" for its compiled twin; None chooses.
        num_threads: threads for the compiled twin; None takes the cores this process may use. Results are the same.

    Returns:
        Estimates with rows at the times of z.

    Raises:
        ModelError: a shape or a law that cannot be; the message says how it was read and how to mend it.
        DataError: inf in z, NaN or inf elsewhere.
        NumericalError: an innovation covariance is not positive definite: less than (8 eps)^2 of the squares that a
            component's variance is the sum of is left after the components before it, so that it is known without
            error, as by two measurements without noise that must agree. Within rounding of that bound the two backends
            may differ: one refuses what the other answers. With noise in every component they refuse the same.

    Source: Detkov (2023), equations 3.1-3.15 as corrected in the fusion notes; Blom and Bar-Shalom (1988).
    """
    check_settings(keep, num_threads)
    z, cov0, trans = array("z", z), array("cov0", cov0), transitions(trans)

    def aligned(defer: bool) -> Aligned:
        return align(z, F=F, Q=Q, H=H, R=R, trans=trans, mean0=mean0, cov0=cov0, probs0=probs0, b=b, d=d, defer=defer)

    if use_native(backend) and (backend == "native" or fits_kernel(cov0, z, trans)):
        from saltus.filters.native import Run, filter_native

        run = Run(per_mode=per_mode, every=keep == "all", num_threads=num_threads)
        return filter_native(z, aligned, run)
    return filter_aligned(aligned(False), per_mode=per_mode, every=keep == "all")


def filter_aligned(model: Aligned, *, per_mode: bool, every: bool, first: int = 0) -> Estimates:
    """Filter by the definition; rows are counted from `first` in messages."""
    n_chains, n_steps, batch = len(model.trans), model.z.shape[-2], model.z.shape[:-2]
    lead, n = (*batch, *model.sizes), model.cov0.shape[-1]
    belief = steps.Belief(
        np.broadcast_to(model.log_probs0, lead),
        np.broadcast_to(model.mean0, (*lead, n)),
        np.broadcast_to(model.cov0, (*lead, n, n)),
    )
    out = allocate(batch, n_steps if every else 1, n_steps, model.sizes, n, per_mode)
    out.n_observed[...] = model.seen.sum(-1)[..., -out.n_observed.shape[-1] :]
    rows: tuple[slice, ...] = (slice(None),) * len(batch)
    for k in range(n_steps):
        wanted = every or k == n_steps - 1
        with np.errstate(over="ignore", invalid="ignore"):  # what has overflowed is refused, with its run and row
            belief, log_f, d2 = _step(model, belief, k, n_chains, wanted, first)
            out.log_likelihood[..., k] = log_f
            if not wanted:
                continue
            at: _Index = (*rows, k if every else 0)
            out.mean[at], out.cov[at] = steps.collapse(*belief, n_chains)
        check_finite(out.mean[at], out.cov[at], k + first)
        out.probs[at], out.nis[at] = np.exp(belief.log_probs), d2
        if out.mode_means is not None and out.mode_covs is not None:
            out.mode_means[at], out.mode_covs[at] = belief.means, belief.covs
    return out


def _step(
    model: Aligned, belief: steps.Belief, k: int, n_chains: int, want_nis: bool, first: int
) -> tuple[steps.Belief, _Array, _Array | float]:
    at = partial(_row, k, model.z.ndim - 2)
    trans = [None if t is None else at(t) for t in model.trans]
    log_probs, means, covs = steps.mix(*belief, trans)
    means, covs = steps.propagate(means, covs, at(model.F), None if model.b is None else at(model.b), at(model.Q))
    z, seen = at(model.z), at(model.seen)
    if not seen.any():
        zero = np.zeros(model.z.shape[:-2])
        return steps.Belief(log_probs, means, covs), zero, zero
    prediction = steps.measure(means, covs, at(model.H), None if model.d is None else at(model.d), at(model.R))
    d2 = steps.mixture_nis(log_probs, prediction, z, seen, n_chains) if want_nis else 0.0
    belief, log_f = steps.update(log_probs, prediction, z, seen, n_chains, k + first)
    return belief, log_f, d2


def _row(k: int, axis: int, a: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return np.asarray(np.take(a, k if a.shape[axis] > 1 else 0, axis=axis))
