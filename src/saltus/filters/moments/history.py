"""What a run of the moment filter returns: estimates, and a record of how well the closure did."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.filters.estimates import Estimates
from saltus.filters.moments.basis import Basis, basis
from saltus.filters.moments.belief import Points, moments_of
from saltus.filters.moments.closure import Tally
from saltus.filters.moments.posterior import MomentPosterior
from saltus.filters.moments.realisable import deviation
from saltus.filters.observation import Observation
from saltus.linalg import symmetric
from saltus.shapes import Bool, Float, Int

__all__ = ["Diagnostics", "Kept", "MomentHistory", "estimates_of", "kept", "recorded"]

_Array = npt.NDArray[np.float64]


class Diagnostics(NamedTuple):
    """How the closure did, per row.

    Attributes:
        deviation: J of every mode's posterior, its distance from a Gaussian in nats.
        order: of the moments in use.
        restarted: densities for which Newton's iteration began anew from the Gaussian.
        shrunk: densities whose moments were drawn towards the Gaussian's to be realisable.
        dropped: densities whose higher moments were given up.
        unrealisable: laws used although no density has their moments (raw Hermite only).
        failed: moments were unrealisable, or the posterior had a negative probability or a covariance that is none, and
            was mended.
        unsettled: adaptive order only: orders 4 and 6 still differed by more than the limit.
    """

    deviation: Float[np.ndarray, "*rows s"]
    order: Int[np.ndarray, "*rows"]
    restarted: Int[np.ndarray, "*rows"]
    shrunk: Int[np.ndarray, "*rows"]
    dropped: Int[np.ndarray, "*rows"]
    unrealisable: Int[np.ndarray, "*rows"]
    failed: Bool[np.ndarray, "*rows"]
    unsettled: Bool[np.ndarray, "*rows"]


class MomentHistory(NamedTuple):
    """Estimates, diagnostics, and the last posterior as a density (its runs flattened to one axis)."""

    estimates: Estimates
    diagnostics: Diagnostics
    posterior: MomentPosterior


class Kept(NamedTuple):
    """What is kept of a row: moments given the modes."""

    log_probs: Float[np.ndarray, "b s"]
    means: Float[np.ndarray, "b s n"]
    covs: Float[np.ndarray, "b s n n"]
    deviation: Float[np.ndarray, "b s"]
    log_likelihood: Float[np.ndarray, " b"]
    nis: Float[np.ndarray, " b"]


def kept(points: Points, log_likelihood: _Array, nis: _Array) -> Kept:
    """Reduce a row's points to what is returned of them."""
    of: Basis = basis(points.points.shape[-1], 4)
    law = moments_of(of, [[(points.points[:, s], points.weights[:, s])] for s in range(points.points.shape[1])])
    return Kept(points.log_probs, law.mean, law.cov, deviation(of, law.h), log_likelihood, nis)


def estimates_of(given: Observation, rows: Sequence[Kept], per_mode: bool) -> Estimates:
    """Collapse the modes and put all rows together."""
    probs, means, covs = np.exp(_rows(rows, "log_probs")), _rows(rows, "means"), _rows(rows, "covs")
    mean = (probs[..., None] * means).sum(axis=2)
    off = means - mean[:, :, None]
    spread = covs + off[..., :, None] * off[..., None, :]
    cov = symmetric((probs[..., None, None] * spread).sum(axis=2))

    def shaped(a: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return a.reshape(*given.batch, *a.shape[1:])

    return Estimates(
        probs=shaped(probs),
        mean=shaped(mean),
        cov=shaped(cov),
        log_likelihood=shaped(_rows(rows, "log_likelihood")),
        log_likelihood_start=np.zeros(given.batch),
        nis=shaped(_rows(rows, "nis")),
        n_observed=shaped(given.seen.sum(-1).astype(float)),
        mode_means=shaped(means) if per_mode else None,
        mode_covs=shaped(covs) if per_mode else None,
        chains=("mode",),
        times=given.times,
    )


def recorded(
    given: Observation,
    rows: Sequence[Kept],
    tallies: Sequence[Tally],
    failed: Sequence[npt.NDArray[np.bool_]],
    order: Int[np.ndarray, "b t"],
    unsettled: Bool[np.ndarray, "b t"],
) -> Diagnostics:
    """Put the record of all rows together."""

    def shaped(a: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return a.reshape(*given.batch, *a.shape[1:])

    counts = {name: shaped(np.stack([getattr(t, name) for t in tallies], axis=1)) for name in Tally._fields}
    return Diagnostics(
        deviation=shaped(_rows(rows, "deviation")),
        order=shaped(order),
        failed=shaped(np.stack(failed, axis=1)),
        unsettled=shaped(unsettled),
        **counts,
    )


def _rows(rows: Sequence[Kept], name: str) -> _Array:
    return np.stack([getattr(row, name) for row in rows], axis=1)
