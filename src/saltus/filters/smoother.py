"""The multimode smoother over arrays."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.filters import steps
from saltus.filters.align import align
from saltus.filters.backend import Backend, check_settings, use_native
from saltus.filters.estimates import Estimates
from saltus.filters.smooth import Passed, forward, smooth, smooth_lag

__all__ = ["imm_smoother", "smoothed_estimates"]

_Array = npt.NDArray[np.float64]


def imm_smoother(
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
    lag: int | None = None,
    floor: float = 0.5,
    per_mode: bool = False,
    backend: Backend | None = None,
    num_threads: int | None = None,
) -> Estimates:
    """Estimate every row from all measurements, or from those up to `lag` rows later.

    The model, its shapes and the prior's time are those of `imm_filter`. Going back, a row's later measurements are one
    message in each mode, (c, a, B) at the filter's Gaussian (x, R): log probability log P + c, mean x + R a, covariance
    R - R B R; see `saltus.filters.smooth`. Exact for one mode (the Rauch-Tung-Striebel answer) and for chains that
    cannot switch; else the mixtures that switches make are matched to one Gaussian message a mode.

    Args:
        z: measurements, (*batch, T, m); NaN is a missing component.
        F: transition matrices, as in `imm_filter`, and so are the following.
        Q: process noise covariances.
        H: measurement matrices.
        R: measurement noise covariances.
        trans: one transition matrix per chain.
        mean0: prior mean one interval before z[0].
        cov0: its covariance.
        probs0: prior law of the modes.
        b: known input.
        d: known measurement offset.
        lag: rows; None = all rows. The last `lag` rows have what there is.
        floor: share of the mean curvature that a message keeps at least, in (0, 1]: 1 leaves out what separated futures
            take from it, which costs a few per cent in the honesty of covariances and saves half the time.
        per_mode: also return every mode's mean and covariance.
        backend: as in `imm_filter`.
        num_threads: as in `imm_filter`.

    Returns:
        Estimates of the smoothed rows, with `pairs` and `chain_probs`; log-likelihoods, nis and n_observed are the
        filter's. Means and covariances of modes of probability zero mean nothing.

    Raises:
        ModelError, DataError, NumericalError: as `imm_filter`; a lag or a floor that cannot be is a ModelError.

    Source: smoothing notes, section 2; fixed lag: section 3; `chain_probs`: section 6.
    """
    check_settings("all", num_threads)
    if lag is not None and (not isinstance(lag, int) or isinstance(lag, bool) or lag < 0):
        raise ModelError(f"lag is a whole number of rows from 0, or None for all rows: {lag!r}.")
    if not 0.0 < floor <= 1.0:
        raise ModelError(f"floor is a share above 0 and at most 1: {floor!r}.")
    if backend == "native":
        use_native(backend)
        raise ModelError('the smoother has no compiled twin yet: leave backend out, or write backend="numpy".')
    model = align(z, F=F, Q=Q, H=H, R=R, trans=trans, mean0=mean0, cov0=cov0, probs0=probs0, b=b, d=d)
    n_observed = model.seen.sum(-1).astype(float)
    return smoothed_estimates(forward(model), n_observed, lag=lag, floor=floor, per_mode=per_mode)


def smoothed_estimates(
    passed: Passed, n_observed: _Array, *, lag: int | None, floor: float, per_mode: bool
) -> Estimates:
    """Go back over a filter's rows, and return what is found as Estimates.

    Args:
        passed: of the filter.
        n_observed: number of components measured, (*batch, T).
        lag: rows, or None for all.
        floor: of the guard.
        per_mode: keep every mode's mean and covariance.
    """
    found = smooth(passed, floor=floor) if lag is None else smooth_lag(passed, lag, floor=floor)
    n_chains, time = passed.n_chains, passed.log_f.ndim - 1
    mean, cov = steps.collapse(found.log_probs, found.means, found.covs, n_chains)
    probs = np.exp(found.log_probs)
    pairs = tuple(
        _of_one(probs, time + 1 + c, n_chains) if pair is None else pair for c, pair in enumerate(found.pairs)
    )

    def rows_last(a: _Array) -> _Array:
        return np.moveaxis(a, 0, time)

    pairs = tuple(rows_last(pair) for pair in pairs)
    return Estimates(
        probs=rows_last(probs),
        mean=rows_last(mean),
        cov=rows_last(cov),
        log_likelihood=rows_last(passed.log_f),
        log_likelihood_start=np.zeros(passed.log_f.shape[1:]),
        nis=rows_last(passed.nis),
        n_observed=n_observed,
        mode_means=rows_last(found.means) if per_mode else None,
        mode_covs=rows_last(found.covs) if per_mode else None,
        pairs=pairs,
        chain_probs=tuple(pair.sum(axis=-2) for pair in pairs),
    )


def _of_one(probs: _Array, axis: int, n_chains: int) -> _Array:
    """Pairs of a chain that cannot switch: its marginal law on the diagonal."""
    others = tuple(a for a in range(probs.ndim - n_chains, probs.ndim) if a != axis)
    marginal = probs.sum(axis=others)
    return np.asarray(marginal[..., None] * np.eye(marginal.shape[-1]))
