"""What is believed after a measurement, as a density: moments, modes, medians."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt
from jaxtyping import Float

from saltus.filters.moments.belief import Points
from saltus.filters.moments.closure import Density
from saltus.models import DiffusionSensor

__all__ = ["MomentPosterior"]

_Array = npt.NDArray[np.float64]

_MESH = 4001  # points at which a distribution function is looked at
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
        """Median of every coordinate, from the modes' distribution functions through their points."""
        from scipy.interpolate import PchipInterpolator

        out = np.empty((len(self.points.points), self.points.points.shape[-1]))
        for run, axis in np.ndindex(*out.shape):
            lines = []
            for mode in range(self.points.log_probs.shape[1]):
                place, inverse = np.unique(self.points.points[run, mode, :, axis], return_inverse=True)
                mass = np.bincount(inverse, weights=self.points.weights[run, mode], minlength=len(place))
                level = np.cumsum(mass) - 0.5 * mass
                lines.append((self.probs[run, mode], PchipInterpolator(place, level, extrapolate=False), place))
            y = np.linspace(min(line[2][0] for line in lines), max(line[2][-1] for line in lines), _MESH)
            total = np.zeros(_MESH)
            for prob, level_at, place in lines:
                total += prob * np.where(y < place[0], 0.0, np.where(y > place[-1], 1.0, np.nan_to_num(level_at(y))))
            out[run, axis] = np.interp(0.5, np.maximum.accumulate(total), y)
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
