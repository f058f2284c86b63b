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
from saltus.models import Finding
from saltus.shapes import Bool, Float, Int

__all__ = [
    "Merged",
    "Tables",
    "effective_size",
    "expanded",
    "generator",
    "group_error",
    "merged",
    "systematic",
    "thinned",
]

_Array = npt.NDArray[np.float64]
_Modes = npt.NDArray[np.int64]
_UNEXPLAINED = 1e-7  # probability of a measurement that far from every mode's prediction
_FAR = 600.0  # nats from the lightest particle that is sure to stay; beyond, a weight counts as this


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
    done = steps.condition(prediction, np.where(seen, z, 0.0)[:, None], seen[:, None], n_runs=1)
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


def thinned(
    log_weights: Float[np.ndarray, "groups k"], n: int, rng: np.random.Generator
) -> tuple[Int[np.ndarray, "groups n"], Float[np.ndarray, "groups n"]]:
    """Choose n different particles of k in each group, and weigh them so that expectations stay what they are.

    With c such that sum_i min(w_i / c, 1) = n, particle i is chosen with probability min(w_i / c, 1), by one uniform
    number per group, and then weighs max(w_i, c): the heavy ones stay as they are, the others are drawn without
    repetition. Of all unbiased ways to choose n, this changes weights least. However light, a particle is kept while
    there is room, so that what looked hopeless is still there when later measurements ask for it.

    Args:
        log_weights: any scale, the same for all of a group; -inf weighs nothing.
        n: how many to keep.
        rng: source of randomness.

    Returns:
        Numbers of those chosen, in order, and their log-weights. Where fewer than n weigh anything, others fill the
        places, at -inf.

    Source: Fearnhead and Clifford (2003), On-line inference for hidden Markov models via particle filters, JRSS B
    65(4), section 3.2.
    """
    if log_weights.shape[1] < n:
        rest = np.full((len(log_weights), n - log_weights.shape[1]), -np.inf)
        chosen, kept = thinned(np.concatenate([log_weights, rest], axis=1), n, rng)
        return np.where(np.isfinite(kept), chosen, 0), kept
    k = log_weights.shape[1]
    ascending = np.sort(log_weights, axis=1)
    last = ascending[:, k - n, None]  # the nth greatest: none lighter than it is sure
    scarce = ~np.isfinite(last)  # fewer than n weigh anything: all of them stay
    scale = np.where(scarce, 0.0, last)
    w = np.exp(np.clip(ascending - scale, -_FAR, _FAR))
    below = np.cumsum(w, axis=1)
    places = np.arange(1, k + 1) + n - k  # for the lightest 1, 2, ... when all the others stay
    fits = (places > 0) & (w * places <= below * (1 + 1e-12))
    at = k - 1 - np.argmax(fits[:, ::-1], axis=1)[:, None]
    log_c = np.where(scarce, -np.inf, np.log(np.take_along_axis(below, at, 1) / places[at]) + scale)
    with np.errstate(invalid="ignore"):  # -inf less -inf, where all stay
        sure = np.where(scarce, np.isfinite(log_weights), np.exp(np.minimum(log_weights - log_c, 0.0)))
    ends = np.ceil(np.cumsum(sure, axis=1) - rng.uniform(size=(len(sure), 1)))
    taken = np.diff(np.clip(ends, 0, n), axis=1, prepend=0) > 0
    if taken.sum(axis=1).min() == n:
        chosen = np.nonzero(taken)[1].reshape(-1, n)
        return chosen, np.maximum(np.take_along_axis(log_weights, chosen, 1), log_c)
    chosen = np.argsort(~taken, axis=1, kind="stable")[:, :n]
    kept = np.maximum(np.take_along_axis(log_weights, chosen, 1), log_c)
    return chosen, np.where(np.take_along_axis(taken, chosen, 1), kept, -np.inf)


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


def stated_error(
    error: Float[np.ndarray, "*rows"],
    d2: Float[np.ndarray, "*rows"],
    n_observed: Float[np.ndarray, "*rows"],
    drawn: Bool[np.ndarray, "*rows"],
) -> tuple[Float[np.ndarray, "*rows"], tuple[Finding, ...]]:
    """Take an error for a bound as long as the measurements are such as the model makes.

    Independent groups agree on what none of them has. A measurement that lies far from what every mode expects may
    rest on states or modes that no particle went through, however alike the groups: from the first such row on, of a
    probability below 1e-7 under each mode's Gaussian prediction, the error is infinite, that is, nothing is claimed.

    Args:
        error: of `group_error`, (..., T).
        d2: squared distance of the measurements from the nearest mode's prediction, (..., T).
        n_observed: components measured, (..., T).
        drawn: whether anything was left to chance by then, (..., T): where nothing was, groups are exact.

    Returns:
        The error, and a finding that names the first row of the first run concerned.
    """
    from scipy.special import chdtrc

    far = (n_observed > 0) & (chdtrc(np.maximum(n_observed, 1.0), d2) < _UNEXPLAINED)
    since = np.logical_or.accumulate(far, axis=-1) & drawn
    if not since.any():
        return error, ()
    *run, row = (int(i) for i in np.argwhere(since)[0])
    runs = int(since.any(-1).sum())
    where = f"row {row}" + (f" of run {', '.join(map(str, run))}" if since.ndim > 1 else "")
    more = f" ({runs} runs have such rows)" if runs > 1 else ""
    message = (
        "a measurement until here lies where no mode expects one, and particles may have missed what explains it: from "
        f"here on nothing is claimed of the error{more}. Give the model a mode that makes such measurements."
    )
    return np.where(since, np.inf, error), (Finding("unexplained", where, message),)


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
