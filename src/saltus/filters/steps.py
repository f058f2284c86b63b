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

from saltus.filters.refusals import NotPositive, check_evidence, of_runs, place
from saltus.linalg import NOTHING, cholesky, normalised, symmetric
from saltus.shapes import Bool, Float

__all__ = [
    "FLOOR",
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
    "score",
    "update",
]

_LOG_2PI = float(np.log(2.0 * np.pi))
_ROUNDING = 8.0 * float(np.finfo(np.float64).eps)  # of a row, below which what is left of it is rounding
_BLUR = 4.0 * float(np.finfo(np.float64).eps)  # of a mean, by which rounding may part it from another
FLOOR = 1e-290  # keeps the moments of a mode of probability zero defined, and touches nothing else


class Belief(NamedTuple):
    """What a filter carries now: log P(modes), and a Gaussian per joint mode."""

    log_probs: Float[np.ndarray, "*modes"]  # (*lead, M1, ..., MC)
    means: Float[np.ndarray, "*modes n"]
    covs: Float[np.ndarray, "*modes n n"]


class Joint(NamedTuple):
    """The joint prediction of state and measurement: x+ = mean + X u, y + Y u, of independent sources u ~ N(0, I)."""

    mean: Float[np.ndarray, "*lead p"]  # of x+
    y: Float[np.ndarray, "*lead m"]
    X: Float[np.ndarray, "*_x p sources"]
    Y: Float[np.ndarray, "*_y m sources"]

    @property
    def U(self) -> Float[np.ndarray, "*lead p m"]:
        """The covariance of x+ and y, X Y'."""
        return np.asarray(self.X @ self.Y.swapaxes(-1, -2))

    @property
    def S(self) -> Float[np.ndarray, "*lead m m"]:
        """The covariance of y, Y Y'."""
        return symmetric(self.Y @ self.Y.swapaxes(-1, -2))


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
    spread = np.where(np.abs(spread) > _BLUR * np.abs(x[..., None, :, :]), spread, 0.0)  # else rounding parts them
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
    """Return A x + b and (A L)(A L)' + Q, P = L L': the move to a later time without a measurement."""
    moved = (A @ mean[..., None])[..., 0]
    root = A @ cholesky(cov)
    return moved if b is None else moved + b, _squares(root) + Q


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

    x+ = A x + b + e,   y = C x + d + f,   cov[e; f] = N;   P = L L',  N = [B_e; B_f] [B_e; B_f]':
    X = [A L  B_e],   Y = [C L  B_f].

    White measurement noise after propagation is A = I, C = H, N = diag(0, R); coloured noise by differencing has
    all blocks. A need not be square: differencing takes the measured part in after a gap and drops it when known.
    """
    p, L, B = A.shape[-2], cholesky(cov), cholesky(N)
    moved = (A @ mean[..., None])[..., 0]
    y = (C @ mean[..., None])[..., 0]
    sources = _beside(A @ L, B[..., :p, :]), _beside(C @ L, B[..., p:, :])
    return Joint(moved if b is None else moved + b, y if d is None else y + d, *sources)


def measure(
    mean: Float[np.ndarray, "*lead n"],
    cov: Float[np.ndarray, "*lead n n"],
    H: Float[np.ndarray, "*_h m n"],
    d: Float[np.ndarray, "*_d m"] | None,
    R: Float[np.ndarray, "*_r m m"],
) -> Joint:
    """Return `joint` for white measurement noise: z = H x + d + v, cov v = R."""
    L, y = cholesky(cov), (H @ mean[..., None])[..., 0]
    X = np.concatenate([L, np.zeros((*L.shape[:-1], R.shape[-1]))], axis=-1)
    return Joint(mean, y if d is None else y + d, X, _beside(H @ L, cholesky(R)))


def _beside(a: Float[np.ndarray, "*_a r p"], b: Float[np.ndarray, "*_b r q"]) -> Float[np.ndarray, "*both r pq"]:
    lead = np.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    return np.concatenate([np.broadcast_to(part, (*lead, *part.shape[-2:])) for part in (a, b)], axis=-1)


def condition(
    prediction: Joint,
    z: Float[np.ndarray, "*_z m"],
    seen: Bool[np.ndarray, "*_z m"],
    *,
    n_runs: int = 0,
    row: int | None = None,
) -> Conditioned:
    """Condition the joint prediction on the measurement, one component after the other.

    With c the row of Y of the component in hand, nu its innovation, s = c c', for x+ and the components after it:

        K = X c' / s,   x+ <- x+ + K nu,   X <- X - K c,   d2 <- d2 + nu^2 / s,   in the end P+ = X X'

    Gram-Schmidt on the rows of Y, and what it does to X: the sources of x+ that are left are those orthogonal to what
    was measured. With K the gain of all components X = [A - K C  I  -K] [L; B] is Joseph's form, a sum of squares, and
    each s is a pivot of S. No S is formed or inverted: two measurements of one thing, each 10^8 times as precise as
    its prediction, still leave the second its own information. A component not seen has its row of Y and its nu zero,
    so it changes nothing and costs no branch.

    Args:
        prediction: of `joint` or `measure`.
        z: measurement, with axes of length 1 for the modes.
        seen: which components were measured, like z.
        n_runs: number of leading axes that count runs, and
        row: number of the row: for the message of an error.

    Raises:
        NumericalError: a component has neither noise nor uncertainty of its own.
    """
    mean, y, X, Y = prediction
    m, lead = z.shape[-1], np.broadcast_shapes(y.shape[:-1], Y.shape[:-2], z.shape[:-1])
    nu = np.broadcast_to(np.where(seen, z - y, 0.0), (*lead, m))
    rows = np.broadcast_to(Y * seen[..., None], (*lead, *Y.shape[-2:]))
    X = np.broadcast_to(X, (*lead, *X.shape[-2:]))
    swept = _sweep(np.concatenate([rows, X], axis=-2), np.concatenate([nu, np.zeros(X.shape[:-1])], axis=-1), seen)
    if swept.empty.any():
        first = [int(i) for i in np.argwhere(swept.empty)[0]]
        refused = swept.empty.any(axis=tuple(range(n_runs, swept.empty.ndim)))
        raise of_runs(NotPositive(place(first[:n_runs], row, first[-1]), first[-1]), refused)
    # What is known exactly has no variance: what rounding left of it would be believed by the next exact measurement.
    left, whole = (np.sum(np.square(part), axis=-1) for part in (swept.rows, X))
    rows = np.where((left <= _ROUNDING**2 * whole)[..., None], 0.0, swept.rows)
    loglik = np.asarray(-0.5 * (swept.d2 + swept.logdet + _LOG_2PI * seen.sum(-1)))
    return Conditioned(mean - swept.left, _squares(rows), loglik, swept.d2)


class _Swept(NamedTuple):
    rows: Float[np.ndarray, "*lead p sources"]  # those after the first m, orthogonal to them
    left: Float[np.ndarray, "*lead p"]
    d2: Float[np.ndarray, "*lead"]
    logdet: Float[np.ndarray, "*lead"]
    empty: Bool[np.ndarray, "*lead m"]  # nothing but rounding is left of a row that was seen


def _sweep(
    rows: Float[np.ndarray, "*lead mp sources"], left: Float[np.ndarray, "*lead mp"], seen: Bool[np.ndarray, "*_z m"]
) -> _Swept:
    """Take the first m rows out of all after them, one after the other, and their share out of `left`."""
    m = seen.shape[-1]
    dead = np.maximum(_ROUNDING**2 * np.sum(np.square(rows[..., :m, :]), axis=-1), NOTHING)
    d2, logdet, empty = np.zeros(left.shape[:-1]), np.zeros(left.shape[:-1]), []
    for a in range(m):
        c, nu, on = rows[..., 0, :], left[..., 0], seen[..., a]
        s = np.sum(np.square(c), axis=-1)
        empty.append(on & (s <= dead[..., a]))
        s = np.where(on & (s > 0), s, 1.0)
        with np.errstate(over="ignore"):
            d2, logdet = d2 + np.square(nu / np.sqrt(s)), logdet + np.log(s)
        share = (rows[..., 1:, :] @ c[..., None])[..., 0] / s[..., None]
        rows, left = rows[..., 1:, :] - share[..., None] * c[..., None, :], left[..., 1:] - share * nu[..., None]
    return _Swept(rows, left, d2, logdet, np.stack(empty, axis=-1))


def _squares(root: Float[np.ndarray, "*lead n q"]) -> Float[np.ndarray, "*lead n n"]:
    return symmetric(root @ root.swapaxes(-1, -2))


def reweigh(
    log_probs: Float[np.ndarray, "*modes"], loglik: Float[np.ndarray, "*modes"], n_chains: int
) -> tuple[Float[np.ndarray, "*modes"], Float[np.ndarray, "*lead"]]:
    """Apply Bayes' rule to the modes, in logs throughout: no outlier flattens them.

    Returns:
        log P(modes | z), whose exponentials sum to 1, and log f(z) = log sum exp(log P + loglik).
    """
    axes = tuple(range(log_probs.ndim - n_chains, log_probs.ndim))
    log_probs, evidence = normalised(np.asarray(log_probs + loglik), axes)
    return log_probs, evidence.reshape(evidence.shape[: evidence.ndim - n_chains])


def update(
    log_probs: Float[np.ndarray, "*modes"],
    prediction: Joint,
    z: Float[np.ndarray, "*lead m"],
    seen: Bool[np.ndarray, "*lead m"],
    n_chains: int,
    row: int | None = None,
) -> tuple[Belief, Float[np.ndarray, "*lead"]]:
    """Condition every mode on a measurement, and reweigh the modes; returns the belief and log f(z).

    Raises:
        DataError: the measurement of a run is too far from what every mode predicts.
        NumericalError: a component has neither noise nor uncertainty, or the prediction has overflowed.
    """
    shape = z.shape[:-1] + (1,) * n_chains + z.shape[-1:]
    done = condition(prediction, z.reshape(shape), seen.reshape(shape), n_runs=z.ndim - 1, row=row)
    log_probs, log_f = reweigh(log_probs, done.loglik, n_chains)
    check_evidence(log_f, prediction.y, prediction.Y, z, seen, row)
    return Belief(log_probs, done.mean, done.cov), log_f


def score(
    log_probs: Float[np.ndarray, "*modes"],
    prediction: Joint,
    z: Float[np.ndarray, "*lead m"],
    seen: Bool[np.ndarray, "*lead m"],
    n_chains: int,
) -> Float[np.ndarray, "*lead"]:
    """Return log f(z), -inf where the distance overflows.

    Raises:
        NumericalError: a component has neither noise nor uncertainty, or the prediction has overflowed.
    """
    shape = z.shape[:-1] + (1,) * n_chains + z.shape[-1:]
    done = condition(prediction, z.reshape(shape), seen.reshape(shape), n_runs=z.ndim - 1)
    _, log_f = reweigh(log_probs, done.loglik, n_chains)
    check_evidence(np.where(log_f == -np.inf, 0.0, log_f), prediction.y, prediction.Y, z, seen)
    return log_f


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
    lead = log_probs.shape[: log_probs.ndim - n_chains]
    (m, sources), n_modes = prediction.Y.shape[-2:], prod(log_probs.shape[len(lead) :])
    p = np.exp(log_probs).reshape(*lead, n_modes, 1)
    y = np.broadcast_to(prediction.y, (*log_probs.shape, m)).reshape(*lead, n_modes, m)
    Y = np.broadcast_to(prediction.Y, (*log_probs.shape, m, sources)).reshape(*lead, n_modes, m, sources)
    mean = np.sum(p * y, axis=-2)
    # Every mode is a source of its own, and so is its distance from the mean.
    roots = np.concatenate([Y, (y - mean[..., None, :])[..., None]], axis=-1) * np.sqrt(p)[..., None]
    rows = np.moveaxis(roots, -2, -3).reshape(*lead, m, n_modes * (sources + 1))
    return np.asarray(_sweep(rows * seen[..., None], np.where(seen, z - mean, 0.0), seen).d2)
