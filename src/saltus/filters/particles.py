"""Particles: what is done with them as arrays, whatever they hold.

A Rao-Blackwellised particle is a Gaussian given a history of modes; its next mode is drawn from what its Kalman filters
for every mode say of the measurement. Functions here are the definition that the compiled bank repeats.

Source: Doucet, de Freitas, Murphy and Russell (2000) for the Rao-Blackwellised filter; Kitagawa (1996) for systematic
resampling; Box (1954), Some theorems on quadratic forms I, Annals of Mathematical Statistics 25, theorem 3.1, for the
law of the error.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.filters import steps
from saltus.linalg import symmetric
from saltus.shapes import Float, Int

__all__ = ["Merged", "Tables", "effective_size", "expanded", "generator", "group_error", "merged", "systematic"]

_Array = npt.NDArray[np.float64]
_Modes = npt.NDArray[np.int64]


class Tables(NamedTuple):
    """Matrices of one step by joint mode, (M|1, ...) each: x+ = F x + b + w, z = H x+ + d + v."""

    F: _Array
    b: _Array | None
    Q: _Array
    H: _Array
    d: _Array | None
    R: _Array

    def same(self, n_modes: int) -> _Modes:
        """For each mode the first whose F, b and Q are equal to its own, (M,)."""
        moves = [a for a in (self.F, self.b, self.Q) if a is not None and len(a) > 1]
        if not moves:
            return np.zeros(n_modes, np.int64)
        rows = np.concatenate([a.reshape(n_modes, -1) for a in moves], axis=1)
        _, first, which = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        return np.asarray(first[which.reshape(-1)], np.int64)


class Merged(NamedTuple):
    """Rows merged by label: total weight, mean and covariance; zeros where a label has no weight."""

    mass: Float[np.ndarray, " labels"]
    means: Float[np.ndarray, "labels n"]
    covs: Float[np.ndarray, "labels n n"]


def expanded(
    means: Float[np.ndarray, "k n"],
    covs: Float[np.ndarray, "k n n"],
    now: Int[np.ndarray, " k"],
    trans: Float[np.ndarray, "modes modes"],
    z: Float[np.ndarray, "k m"],
    tables: Tables,
) -> tuple[Float[np.ndarray, "k modes"], Float[np.ndarray, " k"]]:
    """Return P(next mode | particle, z) and log f(z | particle): see `Bank.expand`."""
    F, b, Q, H, d, R = tables
    k, M, n = len(means), len(trans), means.shape[-1]
    spread = np.broadcast_to(means[:, None], (k, M, n)), np.broadcast_to(covs[:, None], (k, M, n, n))
    x, P = steps.propagate(*spread, F, b, Q)
    seen = ~np.isnan(z)
    with np.errstate(divide="ignore"):
        law = np.log(trans)[now]
    prediction = steps.measure(x, P, H, d, R)
    done = steps.condition(prediction, np.where(seen, z, 0.0)[:, None], seen[:, None])
    law, log_f = steps.reweigh(law, done.loglik, 1)
    return np.exp(law), log_f


def merged(
    means: Float[np.ndarray, "k n"],
    covs: Float[np.ndarray, "k n n"],
    weights: Float[np.ndarray, " k"],
    labels: Int[np.ndarray, " k"],
    n_labels: int,
) -> Merged:
    """Return total weight, mean and covariance of the particles of each label, the spread of their means included."""
    n = means.shape[-1]
    mass = np.bincount(labels, weights, n_labels)
    share = weights / np.where(mass > 0, mass, 1.0)[labels]

    def total(values: _Array) -> _Array:
        return np.stack([np.bincount(labels, share * column, n_labels) for column in values.T], axis=-1)

    centre = total(means)
    gap = means - centre[labels]
    whole = covs + gap[:, :, None] * gap[:, None, :]
    return Merged(mass, centre, symmetric(total(whole.reshape(-1, n * n)).reshape(n_labels, n, n)))


def systematic(weights: Float[np.ndarray, "groups n"], rng: np.random.Generator) -> Int[np.ndarray, "groups n"]:
    """Draw as many particles as there are, in each group by itself, by one uniform number per group.

    Particle i is taken as often as there are points (u + k) / n, k = 0 .. n-1, in its piece of the cumulated weights:
    n w_i times on average, never off by 1 or more.

    Args:
        weights: not negative, any positive sum in each group.
        rng: source of randomness.

    Returns:
        Numbers of the particles taken, within their group and in order.
    """
    groups, n = weights.shape
    bounds = np.cumsum(weights, axis=1)
    bounds /= bounds[:, -1:]
    ends = np.ceil(n * bounds - rng.uniform(size=(groups, 1))).astype(np.int64)
    ends[:, -1] = n
    times = np.diff(np.clip(ends, 0, n), axis=1, prepend=0)
    return np.repeat(np.tile(np.arange(n), groups), times.ravel()).reshape(groups, n)


def effective_size(weights: Float[np.ndarray, "groups n"]) -> Float[np.ndarray, " groups"]:
    """Return (sum w)^2 / sum w^2: n for equal weights, 1 when one particle has them all."""
    return np.asarray(weights.sum(-1) ** 2 / np.square(weights).sum(-1))


def group_error(
    group_means: Float[np.ndarray, "*rows groups n"], covs: Float[np.ndarray, "*rows n n"], confidence: float = 0.95
) -> Float[np.ndarray, "*rows"]:
    r"""Bound the distance of the mean over independent groups from the exact mean, in posterior standard deviations.

    With x_g the groups' means, u_g = P^-1/2 x_g and S their covariance over G: the squared distance
    (x - x_exact)' P^-1 (x - x_exact) is a sum of squares of Gaussians with covariance S, and is taken for
    tr S times an F variable with nu and nu (G - 1) degrees of freedom, nu = (tr S)^2 / tr S^2 (unbiased estimates).

    Args:
        group_means: means of independent filters.
        covs: posterior covariances; a singular one counts the directions it has.
        confidence: probability that the distance is within the bound.

    Source: Box (1954), theorem 3.1; for n = 1 this is Student's t interval.
    """
    from scipy.special import fdtri

    G = group_means.shape[-2]
    off = group_means - group_means.mean(-2, keepdims=True)
    values, vectors = np.linalg.eigh(covs)
    floor = 1e-12 * values[..., -1:]
    scale = np.where(values > floor, 1.0 / np.sqrt(np.maximum(values, np.maximum(floor, 1e-300))), 0.0)
    white = (off @ vectors) * scale[..., None, :]
    S = white.swapaxes(-1, -2) @ white / (G - 1)
    trace, square = np.trace(S, axis1=-2, axis2=-1), np.sum(S * S, axis=(-1, -2))
    nu = 1.0
    if G > 2:
        unbiased = (G - 1) ** 2 / ((G + 1) * (G - 2)) * (square - trace**2 / (G - 1))
        squared = trace**2 - 2 / (G - 1) * np.maximum(unbiased, 0.0)  # (tr S)^2 is too large by its own variance
        n = group_means.shape[-1]
        ratio = np.divide(squared, unbiased, out=np.ones_like(trace), where=unbiased > 0)
        nu = np.clip(ratio, 1.0, n)
    return np.asarray(np.sqrt(trace / G * fdtri(nu, nu * (G - 1), confidence)))


def generator(rng: np.random.Generator | None) -> np.random.Generator:
    """Return the source of randomness.

    Raises:
        ModelError: there is none, or it is something else.
    """
    if rng is None:
        raise ModelError("a particle filter draws: pass rng=np.random.default_rng(seed).")
    if not isinstance(rng, np.random.Generator):
        raise ModelError(f"rng must be a generator, got {rng!r}: pass rng=np.random.default_rng(seed).")
    return rng
