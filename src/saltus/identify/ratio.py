"""The likelihood ratio of "one object" against "two objects" from measurements of two systems at their own times.

Three Kalman filters per pair: the joint one takes every measurement, the own filters those of their system. They lie
on one axis and are conditioned together; a measurement that is not a filter's own is a missing one to it. Because the
joint hypothesis filters measurements and not tracks, the process noise common to both systems needs no correction.

Source: identification of measurements by different observing systems, Chervakov, Bogdanov and Zhironkin (2016); the
rule there compares quadratic forms with a constant, which leaves out the determinants kept here.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError
from saltus.filters.steps import condition, measure, propagate
from saltus.models import discretise
from saltus.models.checks import FloatArray, covariance, numbers
from saltus.shapes import Float

__all__ = ["RatioTerms", "identification_llr", "identification_terms"]

_LOG_2PI = float(np.log(2.0 * np.pi))
_TAKES = np.array([[True, True], [True, False], [False, True]])  # [joint, own 0, own 1] x system


class RatioTerms(NamedTuple):
    """The cumulative ratio, and what each measurement gave under both hypotheses."""

    llr: Float[np.ndarray, "*pairs k"]  # log f(z_1..z_k | one object) - log f(z_1..z_k | two), nats
    d2_same: Float[np.ndarray, "*pairs k"]  # nu' S^-1 nu in the joint filter
    d2_different: Float[np.ndarray, "*pairs k"]  # and in the own filter of the measurement's system
    logdet_same: Float[np.ndarray, "*pairs k"]  # log det S, likewise
    logdet_different: Float[np.ndarray, "*pairs k"]


class _Problem(NamedTuple):
    """Checked arguments with all their leading axes."""

    intervals: FloatArray  # (*pairs, K)
    system: npt.NDArray[np.int64]  # (*pairs, K)
    z: FloatArray  # (*pairs, K, m), 0 where not seen
    seen: npt.NDArray[np.bool_]  # (*pairs, K, m)
    H: FloatArray  # (2, m, n)
    R: tuple[FloatArray, FloatArray]  # each (*pairs, K, m, m)
    means: FloatArray  # (*pairs, 3, n)
    covs: FloatArray  # (*pairs, 3, n, n)


def identification_llr(
    times: npt.ArrayLike,
    system: npt.ArrayLike,
    z: npt.ArrayLike,
    *,
    F: npt.ArrayLike,
    G: npt.ArrayLike,
    H: npt.ArrayLike,
    R: Sequence[npt.ArrayLike] | npt.NDArray[np.float64],
    t0: float,
    prior_same: Sequence[npt.ArrayLike],
    prior_other: Sequence[npt.ArrayLike],
) -> Float[np.ndarray, "*pairs k"]:
    """Return the cumulative log-likelihood ratio of "one object" against "two objects".

    Objects move by dx = F x dt + G dW and are measured as z = H x + v, cov v = R[system]. With one object both systems
    see the first; with two, system 0 sees the first and system 1 the other, and the two are independent:

        llr_k = llr_(k-1) + [(d2 + log det S) of the own filter - (d2 + log det S) of the joint filter] / 2,
        nu = z - H x,  S = H P H' + R,  d2 = nu' S^-1 nu

    Many pairs at once have leading axes; pairs with fewer rows are filled up with rows of NaN at their last time.

    Args:
        times: s, not decreasing along the last axis, none before t0, (*pairs, K) or (K,).
        system: 0 or 1, the system of each row, (*pairs, K) or (K,).
        z: measurements, (*pairs, K, m); NaN is a missing component.
        F: drift, 1/s, (n, n) or (*pairs, n, n).
        G: diffusion, state unit / sqrt(s), (n, q) or (*pairs, n, q).
        H: (m, n), or (2, m, n), one for each system.
        R: noise covariance of system 0 and of system 1, each (m, m), or (*pairs, K, m, m) where it changes from row to
            row; rows of the other system are then not used, but must be covariances.
        t0: time of both priors, s.
        prior_same: mean (n,) or (*pairs, n) and covariance (n, n) or (*pairs, n, n) of the common, or first, object.
        prior_other: the same of the other object: the region where it could be. The ratio depends on it, because two
            objects close to each other are a coincidence, and the less probable the larger that region.

    Returns:
        The ratio after each row, nats, (*pairs, K). Positive speaks for one object.

    Raises:
        DataError: times that decrease or lie before t0, a system that is not 0 or 1, inf in z.
        ModelError: shapes that do not fit, or a covariance that is none.
        NumericalError: a measured component has neither noise nor uncertainty.

    Source: Chervakov, Bogdanov and Zhironkin (2016), the recursion of four quadratic forms, with the determinants.
    """
    return identification_terms(
        times, system, z, F=F, G=G, H=H, R=R, t0=t0, prior_same=prior_same, prior_other=prior_other
    ).llr


def identification_terms(
    times: npt.ArrayLike,
    system: npt.ArrayLike,
    z: npt.ArrayLike,
    *,
    F: npt.ArrayLike,
    G: npt.ArrayLike,
    H: npt.ArrayLike,
    R: Sequence[npt.ArrayLike] | npt.NDArray[np.float64],
    t0: float,
    prior_same: Sequence[npt.ArrayLike],
    prior_other: Sequence[npt.ArrayLike],
) -> RatioTerms:
    """Return the ratio of `identification_llr` with the quadratic forms and determinants that it is made of.

    Arguments and errors are those of `identification_llr`. A row without any component has zeros.
    """
    drift, diffusion = numbers(F, "F"), numbers(G, "G")
    p = _read(times, system, z, H, R, t0, (prior_same, prior_other))
    means, covs = p.means, p.covs
    logliks, d2s = [], []
    for k in range(p.system.shape[-1]):
        A, Q = discretise(drift, diffusion, p.intervals[..., k])
        means, covs = propagate(means, covs, A[..., None, :, :], None, Q[..., None, :, :])
        first = (p.system[..., k] == 0)[..., None, None, None]
        C = np.where(first, p.H[0], p.H[1])
        N = np.where(first, p.R[0][..., k, None, :, :], p.R[1][..., k, None, :, :])
        seen = np.moveaxis(_TAKES[:, p.system[..., k]], 0, -1)[..., None] & p.seen[..., k, None, :]
        rows = np.broadcast_to(p.z[..., k, None, :], seen.shape)
        means, covs, loglik, d2 = condition(measure(means, covs, C, None, N), rows, seen)
        logliks.append(loglik)
        d2s.append(d2)
    loglik, d2 = np.stack(logliks, axis=-2), np.stack(d2s, axis=-2)  # (*pairs, K, 3)
    counted = p.seen.sum(-1) * _LOG_2PI
    d2_same, d2_different = d2[..., 0], d2[..., 1] + d2[..., 2]
    same, different = loglik[..., 0], loglik[..., 1] + loglik[..., 2]
    llr = np.cumsum(same - different, axis=-1)
    return RatioTerms(
        llr, d2_same, d2_different, -2 * same - d2_same - counted, -2 * different - d2_different - counted
    )


def _read(
    times: npt.ArrayLike,
    system: npt.ArrayLike,
    z: npt.ArrayLike,
    H: npt.ArrayLike,
    R: Sequence[npt.ArrayLike] | npt.NDArray[np.float64],
    t0: float,
    priors: tuple[Sequence[npt.ArrayLike], Sequence[npt.ArrayLike]],
) -> _Problem:
    rows = np.asarray(z, dtype=np.float64)
    if rows.ndim < 2 or rows.shape[-1] == 0 or rows.shape[-2] == 0:
        raise DataError(f"z has shape {rows.shape}; it is (*pairs, K, m) with K and m at least 1.")
    if np.isinf(rows).any():
        where = [int(i) for i in np.argwhere(np.isinf(rows))[0]]
        raise DataError(f"z{where} is infinite. A missing component is NaN.")
    *pairs, n_rows, m = rows.shape
    per_row = (*pairs, n_rows)
    seen = ~np.isnan(rows)
    C = numbers(H, "H")
    n = C.shape[-1] if C.ndim else 0
    if C.shape not in ((m, n), (2, m, n)):
        raise ModelError(f"H has shape {C.shape}; z has {m} component(s), so it is ({m}, n) or (2, {m}, n).")
    C = np.broadcast_to(C, (2, m, n))
    if len(R) != 2:
        raise ModelError(f"R must be two covariances, of system 0 and of system 1: R=(R0, R1); got {len(R)}.")
    noise = [_fit(f"R[{s}]", covariance(a, f"R[{s}]"), (*per_row, m, m)) for s, a in enumerate(R)]
    (first_mean, first_cov), (other_mean, other_cov) = (
        _prior(name, prior, tuple(pairs), n) for name, prior in zip(("prior_same", "prior_other"), priors, strict=True)
    )
    return _Problem(
        intervals=_intervals(times, t0, per_row),
        system=_systems(system, per_row),
        z=np.where(seen, rows, 0.0),
        seen=seen,
        H=C,
        R=(noise[0], noise[1]),
        means=np.stack([first_mean, first_mean, other_mean], axis=-2),
        covs=np.stack([first_cov, first_cov, other_cov], axis=-3),
    )


def _intervals(times: npt.ArrayLike, t0: float, per_row: tuple[int, ...]) -> FloatArray:
    t = np.asarray(times, dtype=np.float64)
    if not (np.isfinite(t).all() and np.isfinite(t0)):
        raise DataError("times and t0 must be finite. A row to be left out has NaN in z and the time before it.")
    t = _fit("times", t, per_row)
    dt = np.diff(t, axis=-1, prepend=np.full((*t.shape[:-1], 1), t0))
    if (dt < 0).any():
        where = [int(i) for i in np.argwhere(dt < 0)[0]]
        before = f"t0 = {t0:.9g}" if where[-1] == 0 else f"{t[(*where[:-1], where[-1] - 1)]:.9g}"
        raise DataError(f"times{where} = {t[tuple(where)]:.9g} s comes before {before} s. Sort the rows by time.")
    return np.asarray(dt)


def _systems(system: npt.ArrayLike, per_row: tuple[int, ...]) -> npt.NDArray[np.int64]:
    given = np.asarray(system)
    wrong = ~np.isin(given, (0, 1))
    if wrong.any():
        where = [int(i) for i in np.argwhere(wrong)[0]]
        raise DataError(f"system{where} is {given[tuple(where)]}; a pair has the systems 0 and 1.")
    return _fit("system", given, per_row).astype(np.int64)


def _prior(name: str, prior: Sequence[npt.ArrayLike], pairs: tuple[int, ...], n: int) -> tuple[FloatArray, FloatArray]:
    if len(prior) != 2:
        raise ModelError(f"{name} must be (mean, cov), got {len(prior)} value(s).")
    mean, cov = numbers(prior[0], f"mean of {name}"), covariance(prior[1], f"covariance of {name}")
    return _fit(f"mean of {name}", mean, (*pairs, n)), _fit(f"covariance of {name}", cov, (*pairs, n, n))


def _fit(name: str, a: npt.NDArray[np.generic], shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    try:
        return np.broadcast_to(np.asarray(a, dtype=np.float64), shape)
    except ValueError:
        raise ModelError(f"{name} has shape {a.shape}, which does not fit {shape}: (*pairs, ...) of z.") from None
