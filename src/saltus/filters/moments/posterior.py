"""What is believed after a measurement, as a density: moments, modes, medians."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from saltus.filters.moments.belief import Points
from saltus.filters.moments.closure import Density
from saltus.models import DiffusionSensor
from saltus.shapes import Float

__all__ = ["MomentPosterior"]

_Array = npt.NDArray[np.float64]

_MESH = 4001  # points at which a distribution function is looked at
_LIGHT = 1e-7  # share of the heaviest line below which one does not matter
_ROUNDS = 24  # of the search for a mode, each halving its mesh


@dataclass(frozen=True, slots=True, eq=False)
class MomentPosterior:
    """The posterior of B runs at one time: the density predicted by the closure, times the likelihood.

    Attributes:
        points: the same law as weighted points, from which moments are taken.
        predicted: the closure's densities before the measurement.
        sensor, z, dt: what multiplied them; z is NaN where nothing was measured.
        log_evidence: log f(z | past) of every run.
    """

    points: Points
    predicted: Density
    sensor: DiffusionSensor
    z: Float[np.ndarray, "b m"]
    dt: float
    log_evidence: Float[np.ndarray, " b"]

    @property
    def probs(self) -> Float[np.ndarray, "b s"]:
        """Probabilities of the modes."""
        return np.asarray(np.exp(self.points.log_probs))

    def mode_means(self) -> Float[np.ndarray, "b s n"]:
        """Means given the modes."""
        return np.asarray((self.points.weights[..., None] * self.points.points).sum(axis=2))

    def mode_covs(self) -> Float[np.ndarray, "b s n n"]:
        """Covariances given the modes."""
        off = self.points.points - self.mode_means()[:, :, None]
        return np.asarray((self.points.weights[..., None] * off).swapaxes(-1, -2) @ off)

    def mean(self) -> Float[np.ndarray, "b n"]:
        """Least-squares estimate: the mean over modes and states."""
        return np.asarray((self.probs[..., None] * self.mode_means()).sum(axis=1))

    def moment(self, alpha: Sequence[int], mode: int | None = None) -> Float[np.ndarray, " b"]:
        """Central moment <(y - M)^alpha>, given a mode or over all."""
        joint = self._joint(mode)
        mean = np.einsum("bsq,bsqn->bn", joint, self.points.points)
        off = self.points.points - mean[:, None, None]
        return np.asarray((joint * np.prod(off ** np.asarray(alpha), axis=-1)).sum(axis=(1, 2)))

    def log_pdf(self, y: Float[np.ndarray, "*_b q n"], mode: int | None = None) -> Float[np.ndarray, "b q"]:
        """Log density at states, given a mode or over all modes; y (q, n), or (b, q, n) per run."""
        n_runs, n_modes = self.points.log_probs.shape
        at = np.broadcast_to(y, (n_runs, *np.shape(y)[-2:]))
        value = self.predicted.log_pdf(np.repeat(at[:, None], n_modes, axis=1))
        seen = [self.sensor.log_likelihood(s, self.z[:, None], at, self.dt) for s in range(n_modes)]
        joint = value + np.stack(seen, axis=1) + self.predicted.law.log_probs[..., None]
        joint = joint - self.log_evidence[:, None, None]
        if mode is not None:
            return np.asarray(joint[:, mode] - self.points.log_probs[:, mode, None])
        with np.errstate(divide="ignore"):
            return np.asarray(np.logaddexp.reduce(joint, axis=1))

    def mode(self, *, joint: bool = False) -> Float[np.ndarray, "b n"]:
        """State of greatest density over all modes, or of the most probable pair of mode and state.

        Searched from the best of the points on a mesh that is halved again and again.
        """
        n_runs, _, _, n = self.points.points.shape
        candidates = self.points.points.reshape(n_runs, -1, n)
        value = self._height(candidates, joint)
        best = candidates[np.arange(n_runs), value.argmax(axis=-1)]
        size = np.sqrt(np.diagonal(self.mode_covs(), axis1=-2, axis2=-1).max(axis=1)) / 2
        ways = np.array(list(product((-1.0, -0.5, 0.0, 0.5, 1.0), repeat=n)))
        for _ in range(_ROUNDS):
            near = best[:, None] + size[:, None] * ways
            best = near[np.arange(n_runs), self._height(near, joint).argmax(axis=-1)]
            size = size / 2
        return np.asarray(best)

    def median(self) -> Float[np.ndarray, "b n"]:
        """Median of every coordinate, from distribution functions along the lines of points that vary it alone."""
        joint = self.probs[..., None] * self.points.weights
        n_runs, n_modes, count, n = self.points.points.shape
        grid = (n_modes, *(round(count ** (1 / n)),) * n)
        out = np.empty((n_runs, n))
        for run, axis in np.ndindex(n_runs, n):
            y = np.moveaxis(self.points.points[run, ..., axis].reshape(grid), 1 + axis, -1)
            mass = np.moveaxis(joint[run].reshape(grid), 1 + axis, -1)
            out[run, axis] = _middle(y.reshape(-1, grid[-1]), mass.reshape(-1, grid[-1]))
        return out

    def _joint(self, mode: int | None) -> _Array:
        if mode is None:
            return np.asarray(self.probs[..., None] * self.points.weights)
        given = np.zeros_like(self.points.weights)
        given[:, mode] = self.points.weights[:, mode]
        return given

    def _height(self, y: _Array, joint: bool) -> _Array:
        if not joint:
            return self.log_pdf(y)
        n_modes = self.points.log_probs.shape[1]
        each = [self.log_pdf(y, s) + self.points.log_probs[:, s, None] for s in range(n_modes)]
        return np.asarray(np.max(each, axis=0))


def _middle(y: Float[np.ndarray, "lines q"], mass: Float[np.ndarray, "lines q"]) -> float:
    """Median of what lies on lines of points, spread between them; y increases along each line."""
    from scipy.interpolate import PchipInterpolator

    weight = mass.sum(axis=-1)
    heavy = weight > _LIGHT * weight.max()
    y, mass = y[heavy], mass[heavy]
    mesh = np.linspace(y.min(), y.max(), _MESH)
    total = np.zeros(_MESH)
    for place, part in zip(y, mass, strict=True):
        level = PchipInterpolator(place, np.cumsum(part) - 0.5 * part)
        total += np.where(mesh > place[-1], part.sum(), np.where(mesh < place[0], 0.0, level(mesh)))
    return float(np.interp(0.5 * total[-1], np.maximum.accumulate(total), mesh))
