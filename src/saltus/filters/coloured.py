"""Filters for coloured measurement noise: measurement differencing, and augmentation of the state.

Both take arrays, begin with the first sample, take gaps, and give the same posterior. Differencing is the recursion of
`saltus.filters.differencing` or its compiled twin; augmentation is `imm_filter` on the state with the noise's own.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from saltus.filters.align import Aligned
from saltus.filters.backend import Backend, check_settings, fits_kernel, use_native
from saltus.filters.coloured_model import Augmented, Differenced, augment, difference, factored
from saltus.filters.differencing import aligned_samples, filter_differenced, known_exactly, measured, read, start
from saltus.filters.estimates import Estimates
from saltus.filters.imm import filter_aligned
from saltus.filters.refusals import NotPositive

__all__ = ["after_first", "augmented_filter", "coloured_filter", "of_state", "run_augmented", "run_differenced"]

_Array = npt.NDArray[np.float64]
_Keep = Literal["all", "last"]


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
    keep: _Keep = "all",
    backend: Backend | None = None,
    num_threads: int | None = None,
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
        keep: "all" rows, or the "last" row only (T axis of length 1) with the log-likelihood of every row.
        backend: "numpy" for the definition, "native" for its compiled twin; None chooses.
        num_threads: threads for the compiled twin; None takes the cores this process may use. Results are the same.

    Returns:
        Estimates of x with rows 1..K; log_likelihood_start is log f(z[0]).

    Raises:
        ModelError: a shape or a law that cannot be; the message says how it was read and how to mend it.
        DataError: inf in z, NaN or inf elsewhere, negative intervals, fewer than two rows.
        NumericalError: a measured component was already known exactly.

    Source: Detkov (2023), equations 21-28, in the corrected form of the notes on coloured measurement noise,
    section 3, with the start from the first sample and gaps.
    """
    samples = measured(z)
    described = augment(
        F=F, G=G, noise_F=noise_F, noise_G=noise_G, H=H, dt=dt, n_steps=samples.shape[-2] - 1,
        n_chains=len(trans), mean0=mean0, cov0=cov0, noise_cov0=noise_cov0,
    )  # fmt: skip
    return after_first(
        run_differenced(
            samples, described, trans, probs0, per_mode=per_mode, keep=keep, backend=backend, num_threads=num_threads
        )
    )


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
    keep: _Keep = "all",
    backend: Backend | None = None,
    num_threads: int | None = None,
) -> Estimates:
    """Filter the same measurements with the noise appended to the state: n + m dimensions in every mode.

    a = (x, w),   z = [H I] a + v,  cov v = R

    Arguments, results and errors are those of `coloured_filter`. In addition R, (M1|1, ..., m, m), is the white part of
    the noise; absent means none, and then both filters agree.
    """
    samples = measured(z)
    described = augment(
        F=F, G=G, noise_F=noise_F, noise_G=noise_G, H=H, dt=dt, n_steps=samples.shape[-2] - 1,
        n_chains=len(trans), mean0=mean0, cov0=cov0, noise_cov0=noise_cov0,
    )  # fmt: skip
    return run_augmented(
        samples, described, trans, probs0, R=R, per_mode=per_mode, keep=keep, backend=backend, num_threads=num_threads
    )


def run_augmented(
    z: npt.ArrayLike,
    model: Augmented,
    trans: Sequence[npt.ArrayLike],
    probs0: npt.ArrayLike,
    *,
    R: npt.ArrayLike | None = None,
    per_mode: bool = False,
    keep: _Keep = "all",
    backend: Backend | None = None,
    num_threads: int | None = None,
) -> Estimates:
    """Filter the augmented state from its first sample on; the estimates are those of x, in rows 1..K.

    Raises:
        ModelError, DataError, NumericalError: as `augmented_filter`.
    """
    whole, n = measured(z), model.n_state

    def aligned(defer: bool) -> Aligned:
        return aligned_samples(whole, model, trans, probs0, R, defer=defer)

    if _runs_native(whole, model, trans, keep, backend, num_threads):
        from saltus.filters.native import Run, filter_native

        run = Run(per_mode, keep == "all", num_threads, reported=n, from_first=True)
        return after_first(filter_native(whole, aligned, run))
    data = read(whole, aligned(False))
    first, log_start, _ = start(data, np.eye(model.F.shape[-1]))
    later = data.aligned._replace(log_probs0=first.log_probs, mean0=first.means, cov0=first.covs)
    done = filter_aligned(later, per_mode=per_mode, every=keep == "all", first=1)
    return replace(of_state(done, n), log_likelihood_start=log_start)


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
    keep: _Keep = "all",
    backend: Backend | None = None,
    num_threads: int | None = None,
) -> Estimates:
    """Filter the state, and what of the noise is not seen, from the first sample on.

    Returns:
        Estimates of x with one row per row of z, the first included, or the last row only.

    Raises:
        ModelError, DataError, NumericalError: as `coloured_filter`.
    """
    whole, n = measured(z), model.n_state
    moves = difference(model)
    differenced = model._replace(F=moves.Phi, Q=moves.B, b=moves.b)

    def aligned(defer: bool) -> Aligned:
        return aligned_samples(whole, differenced, trans, probs0, None, defer=defer)

    try:
        if _runs_native(whole, model, trans, keep, backend, num_threads):
            return _differenced_native(whole, aligned, model, moves, (per_mode, keep == "all", num_threads, n))
        data = read(whole, aligned(False))
        steps = moves._replace(Phi=data.aligned.F, B=data.aligned.Q, b=data.aligned.b)
        return filter_differenced(data, steps, n, per_mode=per_mode, every=keep == "all")
    except NotPositive as error:
        told = known_exactly(error.where, moves.B, whole.shape[-1], len(trans))
        told.runs = error.runs
        raise told from error


def _differenced_native(
    z: _Array,
    aligned: Callable[[bool], Aligned],
    model: Augmented,
    moves: Differenced,
    settings: tuple[bool, bool, int | None, int],
) -> Estimates:
    """Run the compiled twin of `filter_differenced`, which takes the noise in parts."""
    from saltus.filters.native import Run, filter_native

    noise = factored(model, moves)

    def in_parts(defer: bool) -> Aligned:
        whole = aligned(defer)
        return whole._replace(Q=noise.reshape((1,) * (whole.Q.ndim - noise.ndim) + noise.shape))

    return filter_native(z, in_parts, Run(*settings, from_first=True, map=moves.T))


def _runs_native(
    z: _Array,
    model: Augmented,
    trans: Sequence[npt.ArrayLike],
    keep: _Keep,
    backend: Backend | None,
    num_threads: int | None,
) -> bool:
    check_settings(keep, num_threads)
    return use_native(backend) and (backend == "native" or fits_kernel(model.F, z, trans))


def after_first(est: Estimates) -> Estimates:
    """Drop the row of the first sample, unless only the last is there; its likelihood becomes log_likelihood_start."""
    lead = est.mean.ndim - 2
    first = int(est.mean.shape[-2] == est.log_likelihood.shape[-1])

    def rest(a: _Array, first: int = first) -> _Array:
        return a[(slice(None),) * lead + (slice(first, None),)]

    return replace(
        est,
        probs=rest(est.probs),
        mean=rest(est.mean),
        cov=rest(est.cov),
        log_likelihood=rest(est.log_likelihood, 1),
        log_likelihood_start=np.asarray(est.log_likelihood[..., 0]),
        nis=rest(est.nis),
        n_observed=rest(est.n_observed),
        mode_means=None if est.mode_means is None else rest(est.mode_means),
        mode_covs=None if est.mode_covs is None else rest(est.mode_covs),
    )
