"""Bayes' rule for densities of a closure, in logs, by quadrature.

u+_a = u-_0 <y^a g> / sum_r u-_0 <g>   (equation (G) of the moment-filter notes, section 5)

The nodes of the closure find where the posterior lies; a second pass places them there, and more passes follow where
the likelihood is much narrower than the prediction. What is returned is not a density of the closure but the one
predicted times the likelihood, as weighted points: nothing is lost by fitting it again.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError
from saltus.filters.moments.basis import Rule
from saltus.filters.moments.belief import Points, root_of
from saltus.filters.moments.closure import Closing, Density
from saltus.filters.observation import impossible, innovation_nis
from saltus.linalg import normalised, symmetric
from saltus.models import DiffusionSensor
from saltus.shapes import Float

__all__ = ["Updated", "update"]

_Array = npt.NDArray[np.float64]

_WIDEN = 1.3  # of the next pass's nodes against the covariance found
_PASSES = 5  # after the first; one unless the likelihood is very narrow
_LOG_FLOOR = float(np.log(1e-10))


class Updated(NamedTuple):
    """The posterior, log f(z | past), the normalised innovation, and runs whose posterior had no sense."""

    points: Points
    log_likelihood: Float[np.ndarray, " b"]
    nis: Float[np.ndarray, " b"]
    failed: npt.NDArray[np.bool_]


def update(
    closing: Closing,
    density: Density,
    weights: Float[np.ndarray, "b s q"],
    sensor: DiffusionSensor,
    z: _Array,
    dt: float,
    row: int = 0,
) -> Updated:
    """Condition densities on one measurement of every run.

    Args:
        closing: the closure that made them.
        density: the predicted densities.
        weights: their probabilities on the closure's nodes.
        sensor: what is measured.
        z: (b, m); NaN is missing.
        dt: interval, s, for increments.
        row: number of the measurement, for the message of an error.

    Raises:
        DataError: a measurement is impossible at every node of a mode.
    """
    law = density.law
    y = closing.places(law.mean, law.root)
    joint = np.exp(law.log_probs)[..., None] * weights
    nis = innovation_nis(sensor, z, dt, [(y[:, s], joint[:, s]) for s in range(joint.shape[1])])
    log_g = _log_likelihoods(sensor, z, y, dt)
    _possible(sensor, z, y, log_g, row)
    top = log_g.max(axis=-1, keepdims=True)
    first = weights * np.exp(log_g - top)
    if closing.name == "hermite" and not closing.protected:
        points, log_l, failed = _raw(law.log_probs, y, first, top)
        return Updated(points, log_l, nis, failed)
    weights, root, mean = np.maximum(first, 0.0), law.root, law.mean
    for k in range(_PASSES):
        mean, root, narrow = _placed(closing.rule if k == 0 else closing.near, y, weights, root)
        y = closing.places(mean, root, closing.near)
        log_w = _log_weights(closing, density, root, y, _log_likelihoods(sensor, z, y, dt))
        top = log_w.max(axis=-1, keepdims=True)
        weights = np.exp(log_w - top)
        if not narrow:
            break
    total = weights.sum(axis=-1, keepdims=True)
    points, log_l = _weighed(law.log_probs, y, weights / total, np.log(total[..., 0]) + top[..., 0])
    return Updated(points, log_l, nis, np.zeros(len(z), dtype=bool))


def _possible(sensor: DiffusionSensor, z: _Array, y: _Array, log_g: _Array, row: int) -> None:
    """Refuse a measurement whose distance from every node of a mode overflows."""
    lost = np.argwhere(~np.isfinite(log_g).any(axis=-1))
    if len(lost):
        run, mode = (int(i) for i in lost[0])
        told = impossible(sensor, z[run], [(mode, y[run, mode])], run, row)
        raise DataError(
            f"{told} is impossible wherever mode {mode} may be.\nCheck its unit, or give NaN for an outlier."
        )


def _placed(rule: Rule, y: _Array, w: _Array, root: _Array) -> tuple[_Array, _Array, bool]:
    """Where to put the nodes next, and whether those at hand were too coarse for what they found.

    Nodes at distance d see a Gaussian of deviation s with an error of exp(-2 (pi s / d)^2), 1e-5 where s = 0.75 d.
    """
    share = (w / w.sum(axis=-1, keepdims=True))[..., None]
    mean = (share * y).sum(axis=2)
    off = (y - mean[:, :, None]) @ np.linalg.inv(root).swapaxes(-1, -2)
    cov = symmetric((share * off).swapaxes(-1, -2) @ off)
    line = np.unique(rule.nodes[:, 0])
    d = line[len(line) // 2] - line[len(line) // 2 - 1]
    narrow = np.linalg.eigvalsh(cov)[..., 0] < (0.75 * d) ** 2
    wide = _WIDEN * root @ root_of(cov + 0.25 * d**2 * narrow[..., None, None] * np.eye(cov.shape[-1]))
    return mean, wide, bool(narrow.any())


def _log_weights(closing: Closing, density: Density, root: _Array, y: _Array, log_g: _Array) -> _Array:
    """Log of density times likelihood times each node's share of the plane."""
    law = density.law
    xi = (y - law.mean[:, :, None]) @ np.linalg.inv(law.root).swapaxes(-1, -2)
    value, sign = density.log_value(xi)
    stretch = np.log(np.diagonal(root, axis1=-2, axis2=-1) / np.diagonal(law.root, axis1=-2, axis2=-1)).sum(-1)
    return np.where(sign > 0, value + closing.near.log_weights + stretch[..., None] + log_g, -np.inf)


def _log_likelihoods(sensor: DiffusionSensor, z: _Array, y: _Array, dt: float) -> _Array:
    return np.stack([sensor.log_likelihood(s, z[:, None], y[:, s], dt) for s in range(y.shape[1])], axis=1)


def _weighed(log_probs: _Array, y: _Array, weights: _Array, log_l: _Array) -> tuple[Points, _Array]:
    """Posterior probabilities of the modes; none falls below 1e-10, from where it could hardly return."""
    posterior, total = normalised(log_probs + log_l, (1,))
    posterior, _ = normalised(np.maximum(posterior, _LOG_FLOOR), (1,))
    return Points(posterior, y, weights), total[:, 0]


def _raw(log_probs: _Array, y: _Array, w: _Array, top: _Array) -> tuple[Points, _Array, npt.NDArray[np.bool_]]:
    """The posterior with signed weights; where it makes no sense its positive part is taken, and the run has failed."""
    total = w.sum(axis=-1)
    safe = np.where(total > 0, total, 1.0)[..., None]
    mean = (w[..., None] * y).sum(axis=2) / safe
    off = y - mean[:, :, None]
    cov = ((w / safe)[..., None] * off).swapaxes(-1, -2) @ off
    sound = (total > 0) & (np.linalg.eigvalsh(symmetric(cov))[..., 0] > 0)
    w = np.where(sound[..., None], w, np.maximum(w, 0.0) + 1e-290)
    total = w.sum(axis=-1)
    points, log_l = _weighed(log_probs, y, w / total[..., None], np.log(total) + top[..., 0])
    return points, log_l, ~sound.all(axis=-1)
