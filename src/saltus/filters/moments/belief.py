"""What the moment filter carries: weighted points after a measurement, moments before it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.filters.moments.basis import Basis, convolved
from saltus.linalg import symmetric
from saltus.shapes import Float

__all__ = ["Cloud", "Moments", "Points", "add_noise", "moments_of", "root_of"]

_Array = npt.NDArray[np.float64]
Cloud = tuple[_Array, _Array]  # points (b|1, q, n) and their joint probabilities (b, q)

_EMPTY = 1e-290
_FAR = 1e6  # standard deviations; only signed weights get there, and their moments are worthless


class Points(NamedTuple):
    """A law by weighted points: B runs, S modes, Q points."""

    log_probs: Float[np.ndarray, "b s"]
    points: Float[np.ndarray, "b s q n"]
    weights: Float[np.ndarray, "b s q"]  # given the mode; sum to 1; of either sign in the raw Hermite closure

    def clouds(self) -> list[Cloud]:
        """Points and joint probabilities of every mode."""
        joint = np.exp(self.log_probs)[..., None] * self.weights
        return [(self.points[:, s], joint[:, s]) for s in range(joint.shape[1])]


class Moments(NamedTuple):
    """A law by its moments: the mean, a root of the covariance, and the Hermite moments of root^-1 (y - mean)."""

    log_probs: Float[np.ndarray, "b s"]
    mean: Float[np.ndarray, "b s n"]
    root: Float[np.ndarray, "b s n n"]
    h: Float[np.ndarray, "b s a"]  # h = 1, 0, ..., 0 up to order 2

    @property
    def cov(self) -> Float[np.ndarray, "b s n n"]:
        """Covariances."""
        return np.asarray(self.root @ self.root.swapaxes(-1, -2))


def root_of(cov: Float[np.ndarray, "*lead n n"]) -> Float[np.ndarray, "*lead n n"]:
    """Lower Cholesky factors of covariances, floored where rounding or signed weights left none."""
    if cov.shape[-1] == 1:
        return np.asarray(np.sqrt(np.maximum(cov, 1e-300)))
    try:
        return np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(symmetric(cov))
        floor = 1e-12 * np.maximum(np.abs(values).max(-1, keepdims=True), 1e-290)
        mended = vectors * np.maximum(values, floor)[..., None, :] @ vectors.swapaxes(-1, -2)
        return np.linalg.cholesky(symmetric(mended))


def moments_of(of: Basis, clouds: Sequence[Sequence[Cloud]]) -> Moments:
    """Moments of laws given as clouds of points, several for each mode.

    Args:
        of: the basis, up to the order wanted.
        clouds: for every mode the clouds that make up its part.
    """
    parts = [_moments_of_mode(of, own) for own in clouds]
    mass = np.stack([p[0] for p in parts], axis=1)
    mass = mass / mass.sum(axis=1, keepdims=True)
    mean, root, h = (np.stack([p[i] for p in parts], axis=1) for i in (1, 2, 3))
    return Moments(np.log(np.maximum(mass, _EMPTY)), mean, root, h)


def _moments_of_mode(of: Basis, clouds: Sequence[Cloud]) -> tuple[_Array, _Array, _Array, _Array]:
    n_runs = len(clouds[0][1])
    y = np.concatenate([np.broadcast_to(c[0], (n_runs, *c[0].shape[1:])) for c in clouds], axis=1)
    w = np.concatenate([c[1] for c in clouds], axis=1)
    mass = w.sum(axis=-1)
    shares = w / np.where(np.abs(mass) > _EMPTY, mass, 1.0)[:, None]
    empty = np.abs(mass) <= _EMPTY
    if empty.any():
        shares[empty] = 1.0 / shares.shape[1]
    mean = np.einsum("bq,bqn->bn", shares, y)
    off = y - mean[:, None]
    root = root_of(symmetric(np.swapaxes(off * shares[..., None], -1, -2) @ off))
    n = y.shape[-1]
    xi = off / root[:, None, 0] if n == 1 else off @ np.linalg.inv(root).swapaxes(-1, -2)
    h = of.moments(np.clip(xi, -_FAR, _FAR), shares)
    h[:, 0] = 1.0
    h[:, (of.degree == 1) | (of.degree == 2)] = 0.0
    return mass, mean, root, h


def add_noise(of: Basis, law: Moments, cov: Float[np.ndarray, "s n n"]) -> Moments:
    """Moments of y + e with independent e ~ N(0, cov), per mode: exact at every order."""
    root = root_of(symmetric(law.cov + cov))
    A = np.linalg.solve(root, law.root) if root.shape[-1] > 1 else law.root / root
    return law._replace(root=root, h=convolved(of, law.h, A))
