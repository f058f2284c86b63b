"""The one recursion, step by step: mix, propagate, measure, condition, reweigh, collapse.

The definition in NumPy. Every function takes any leading axes (runs, tracks), then one axis per chain, then the
state's: `log_probs (*lead, M1, ..., MC)`, `means (*lead, M1, ..., MC, n)`, `covs (*lead, M1, ..., MC, n, n)`.
No chain at all is the Kalman filter. Nothing is mutated; covariances stay positive semidefinite because every
update is a sum of squares.

Source: fusion of measurement channels under switching, sections 4 and 5 of the theory notes (Detkov 2023,
equations 3.1-3.15, corrected); Blom and Bar-Shalom (1988) for the interacting multiple model.
"""

from collections.abc import Sequence
from math import prod
from typing import NamedTuple

import numpy as np

from saltus.errors import NumericalError
from saltus.linalg import gaussian_terms, logsumexp, quadratic_form, symmetric
from saltus.shapes import Bool, Float

__all__ = [
    "FLOOR",
    "NOT_POSITIVE",
    "Belief",
    "Conditioned",
    "Joint",
    "collapse",
    "condition",
    "joint",
    "measure",
    "mix",
    "mixture_nis",
    "propagate",
    "reweigh",
]

NOT_POSITIVE = (
    "an innovation covariance S = H P H' + R is not positive definite: some measured component has "
    "neither noise nor uncertainty. Give every measured component a positive variance in R."
)
FLOOR = 1e-290  # keeps the moments of a mode of probability zero defined, and touches nothing else
_LOG_2PI = float(np.log(2.0 * np.pi))


class Belief(NamedTuple):
    """What a filter carries now: log P(modes), and a Gaussian per joint mode."""

    log_probs: Float[np.ndarray, "*modes"]  # (*lead, M1, ..., MC)
    means: Float[np.ndarray, "*modes n"]
    covs: Float[np.ndarray, "*modes n n"]


class Joint(NamedTuple):
    """The joint prediction of state and measurement: x+ = A x + b + e, y = C x + d + f, cov[e; f] = N."""

    mean: Float[np.ndarray, "*lead p"]  # of x+
    y: Float[np.ndarray, "*lead m"]
    U: Float[np.ndarray, "*lead p m"]  # cov(x+, y)
    S: Float[np.ndarray, "*lead m m"]  # cov(y)
    cov: Float[np.ndarray, "*lead n n"]  # of x, before the step
    A: Float[np.ndarray, "*_a p n"]
    C: Float[np.ndarray, "*_c m n"]
    N: Float[np.ndarray, "*_n pm pm"]


class Conditioned(NamedTuple):
    """A Gaussian conditioned on a measurement."""

    mean: Float[np.ndarray, "*lead n"]
    cov: Float[np.ndarray, "*lead n n"]
    loglik: Float[np.ndarray, "*lead"]  # log f(z), nats; counts observed components only
    d2: Float[np.ndarray, "*lead"]  # squared Mahalanobis distance of the innovation


def mix(
    log_probs: Float[np.ndarray, "*modes"],
    means: Float[np.ndarray, "*modes n"],
    covs: Float[np.ndarray, "*modes n n"],
    trans: Sequence[Float[np.ndarray, "*_t _ _"] | None],
) -> Belief:
    r"""Advance the chains one interval and match moments, one chain axis at a time.

    For an axis with trans[i, j] = P(next = j | now = i):

        Q_j = sum_i trans_ij P_i,   mu_ij = trans_ij P_i / Q_j,   x_j = sum_i mu_ij x_i,
        R_j = sum_i mu_ij [R_i + (x_i - x_j)(x_i - x_j)'],

    then the next axis. By total expectation and covariance this equals the sum over all joint modes exactly, with
    no subtraction. Cost O(M (M1 + ... + MC)) instead of O(M^2).

    Args:
        log_probs: log P(modes), (*lead, M1, ..., MC); -inf is an unreachable mode.
        means: (*lead, M1, ..., MC, n).
        covs: (*lead, M1, ..., MC, n, n).
        trans: one matrix per chain, (Mc, Mc) or (*lead, Mc, Mc), or None for a chain that cannot switch.
    """
    n_chains = len(trans)
    for c, t in enumerate(trans):
        if t is not None:
            axis = log_probs.ndim - n_chains + c
            log_probs, means, covs = _mix_axis(log_probs, means, covs, t, axis, n_chains)
    return Belief(log_probs, means, covs)


def _mix_axis(
    log_probs: Float[np.ndarray, "*modes"],
    means: Float[np.ndarray, "*modes n"],
    covs: Float[np.ndarray, "*modes n n"],
    trans: Float[np.ndarray, "*_t i j"],
    axis: int,
    n_chains: int,
) -> Belief:
    n = means.shape[-1]
    # The mixed axis goes last among the modes; the transition matrix then broadcasts over the others.
    lp = np.moveaxis(log_probs, axis, -1)
    x = np.moveaxis(means, axis, -2)
    P = np.moveaxis(covs, axis, -3)
    t = trans.reshape(trans.shape[:-2] + (1,) * (n_chains - 1) + trans.shape[-2:])
    top = np.max(lp, axis=-1, keepdims=True)
    top = np.where(np.isfinite(top), top, 0.0)
    joint_ij = t * np.exp(lp - top)[..., None]
    with np.errstate(divide="ignore"):
        lq = np.log(joint_ij.sum(-2)) + top
    mu = joint_ij + FLOOR
    mu_t = (mu / mu.sum(-2, keepdims=True)).swapaxes(-1, -2)  # (..., j, i)
    xj = mu_t @ x
    spread = x[..., None, :, :] - xj[..., :, None, :]  # (..., j, i, n)
    Pj = (mu_t @ P.reshape((*P.shape[:-2], n * n))).reshape((*xj.shape, n))
    Pj = Pj + (mu_t[..., None] * spread).swapaxes(-1, -2) @ spread
    return Belief(np.moveaxis(lq, -1, axis), np.moveaxis(xj, -2, axis), np.moveaxis(symmetric(Pj), -3, axis))


def propagate(
    mean: Float[np.ndarray, "*lead n"],
    cov: Float[np.ndarray, "*lead n n"],
    A: Float[np.ndarray, "*_a n n"],
    b: Float[np.ndarray, "*_b n"] | None,
    Q: Float[np.ndarray, "*_q n n"],
) -> tuple[Float[np.ndarray, "*out n"], Float[np.ndarray, "*out n n"]]:
    """Return A x + b and A P A' + Q: the move to a later time without a measurement."""
    moved = (A @ mean[..., None])[..., 0]
    return moved if b is None else moved + b, quadratic_form(A, cov) + Q


def joint(
    mean: Float[np.ndarray, "*lead n"],
    cov: Float[np.ndarray, "*lead n n"],
    A: Float[np.ndarray, "*_a p n"],
    b: Float[np.ndarray, "*_b p"] | None,
    C: Float[np.ndarray, "*_c m n"],
    d: Float[np.ndarray, "*_d m"] | None,
    N: Float[np.ndarray, "*_n pm pm"],
) -> Joint:
    """Predict state and measurement together.

    x+ = A x + b + e,   y = C x + d + f,   cov[e; f] = N:
    U = A P C' + N_ef,   S = C P C' + N_ff.

    White measurement noise after propagation is A = I, C = H, N = diag(0, R); coloured noise by differencing has
    all blocks. A need not be square: differencing takes the measured part in after a gap and drops it when known.
    """
    n = A.shape[-2]
    moved = (A @ mean[..., None])[..., 0]
    y = (C @ mean[..., None])[..., 0]
    U = A @ cov @ C.swapaxes(-1, -2) + N[..., :n, n:]
    S = quadratic_form(C, cov) + N[..., n:, n:]
    return Joint(moved if b is None else moved + b, y if d is None else y + d, U, S, cov, A, C, N)


def measure(
    mean: Float[np.ndarray, "*lead n"],
    cov: Float[np.ndarray, "*lead n n"],
    H: Float[np.ndarray, "*_h m n"],
    d: Float[np.ndarray, "*_d m"] | None,
    R: Float[np.ndarray, "*_r m m"],
) -> Joint:
    """Return `joint` for white measurement noise: z = H x + d + v, cov v = R."""
    n, m = mean.shape[-1], R.shape[-1]
    N = np.zeros((*R.shape[:-2], n + m, n + m))
    N[..., n:, n:] = R
    return joint(mean, cov, np.eye(n), None, H, d, N)


def condition(
    prediction: Joint,
    z: Float[np.ndarray, "*_z m"],
    seen: Bool[np.ndarray, "*_z m"],
) -> Conditioned:
    """Condition the joint prediction on the measurement, in Joseph form.

    nu = z - y,  K = U S^-1,  x = x+ + K nu,  P = (A - K C) P (A - K C)' + [I -K] N [I -K]'

    A component not seen has its column of U and its nu zero and its row and column of S those of the unit matrix, so
    it changes nothing and costs no branch.

    Raises:
        NumericalError: an innovation covariance is not positive definite.
    """
    mean, y, U, S, P, A, C, N = prediction
    n, m = mean.shape[-1], z.shape[-1]
    on = seen.astype(float)
    nu = np.where(seen, z - y, 0.0)
    both = on[..., :, None] * on[..., None, :]
    off = np.eye(m) * (1.0 - on)[..., None]
    S = S * both + off
    U = U * on[..., None, :]
    try:
        d2, logdet, L_inv = gaussian_terms(nu, S)
    except np.linalg.LinAlgError as error:
        raise NumericalError(NOT_POSITIVE) from error
    K = U @ L_inv.swapaxes(-1, -2) @ L_inv  # columns of components not seen are zero, so C and N need no mask
    gain = np.concatenate([np.broadcast_to(np.eye(n), (*K.shape[:-1], n)), -K], axis=-1)
    cov = quadratic_form(A - K @ C, P) + quadratic_form(gain, N)
    loglik = np.asarray(-0.5 * (d2 + logdet + _LOG_2PI * on.sum(-1)))
    return Conditioned(mean + (K @ nu[..., None])[..., 0], cov, loglik, d2)


def reweigh(
    log_probs: Float[np.ndarray, "*modes"], loglik: Float[np.ndarray, "*modes"], n_chains: int
) -> tuple[Float[np.ndarray, "*modes"], Float[np.ndarray, "*lead"]]:
    """Apply Bayes' rule to the modes, in logs throughout: a 10^4-sigma outlier flattens nothing.

    Returns:
        log P(modes | z), normalised, and log f(z) = logsumexp(log P + loglik).
    """
    axes = tuple(range(log_probs.ndim - n_chains, log_probs.ndim))
    total = np.asarray(log_probs + loglik)
    evidence = logsumexp(total, axes)
    return np.asarray(total - evidence), evidence.reshape(evidence.shape[: evidence.ndim - n_chains])


def collapse(
    log_probs: Float[np.ndarray, "*modes"],
    means: Float[np.ndarray, "*modes n"],
    covs: Float[np.ndarray, "*modes n n"],
    n_chains: int,
) -> tuple[Float[np.ndarray, "*lead n"], Float[np.ndarray, "*lead n n"]]:
    """Return mean and covariance of the mixture: sum P x and sum P [R + (x - mean)(x - mean)']."""
    lead = log_probs.shape[: log_probs.ndim - n_chains]
    n = means.shape[-1]
    n_modes = prod(log_probs.shape[len(lead) :])  # spelt out: -1 cannot be told where lead holds no run
    p = np.exp(log_probs).reshape((*lead, 1, n_modes))
    x = means.reshape((*lead, n_modes, n))
    mean = p @ x
    spread = x - mean
    cov = (p @ covs.reshape((*lead, n_modes, n * n))).reshape((*lead, n, n))
    cov = cov + (p.swapaxes(-1, -2) * spread).swapaxes(-1, -2) @ spread
    return mean[..., 0, :], symmetric(cov)


def mixture_nis(
    log_probs: Float[np.ndarray, "*modes"],
    prediction: Joint,
    z: Float[np.ndarray, "*lead m"],
    seen: Bool[np.ndarray, "*lead m"],
    n_chains: int,
) -> Float[np.ndarray, "*lead"]:
    """Return the squared Mahalanobis distance of z to the mixture's predicted measurement.

    nu = z - sum P y,   S = sum P [S + (y - mean y)(y - mean y)'],   d2 = nu' S^-1 nu over the components seen.
    """
    S = np.broadcast_to(prediction.S, prediction.y.shape + prediction.y.shape[-1:])
    y_mean, y_cov = collapse(log_probs, prediction.y, S, n_chains)
    on = seen.astype(float)
    y_cov = y_cov * on[..., :, None] * on[..., None, :] + np.eye(z.shape[-1]) * (1.0 - on)[..., None]
    return gaussian_terms(np.where(seen, z - y_mean, 0.0), y_cov)[0]
