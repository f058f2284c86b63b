r"""Nonlinear sensors in the recursion: each mode's measurement as an affine function of its state.

    h(x) = y + C (x - m) + e,   cov e = Omega,

about a Gaussian N(m, P). "extended": the tangent, y = h(m), C = dh/dx(m), Omega = 0. "cubature": the regression of h
on x under N(m, P), with moments by the third-degree spherical-radial rule (2n points m +- sqrt(n) L e_i, P = L L'):
y = E h, C = cov(h, x) P^-1, Omega = cov h - C P C', which is never negative. Both then are linear updates in the
Joseph form of `steps.condition`. All modes, runs and tracks at once; angles never leave the sensor's `residual`.

Source: Arasaratnam and Haykin (2009), Cubature Kalman filters, IEEE Trans. Automatic Control 54(6), for the points;
Garcia-Fernandez, Svensson, Morelande and Sarkka (2015), Posterior linearization filter, IEEE Trans. Signal Processing
63(20), for the regression repeated about the posterior; with tangents this is the iterated extended Kalman filter,
that is Gauss-Newton steps towards the posterior mode (Bell and Cathey 1993).
"""

from collections.abc import Callable
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from saltus.errors import ModelError, NumericalError
from saltus.filters import steps
from saltus.linalg import gaussian_terms
from saltus.models import BoundSensor
from saltus.shapes import Bool, Float

__all__ = ["Affine", "Linearisation", "cholesky", "linearise", "sensor_joint", "sensor_update"]

Linearisation: TypeAlias = Literal["extended", "cubature"]

_HALVINGS = 5  # of a Gauss-Newton step
_DEAD = 1e-14  # part of a variance, left by the components before it, that counts as round-off


class Affine(NamedTuple):
    """z = y + C (x - about) + e, with cov e = R of the sensor plus Omega of the linearisation."""

    about: Float[np.ndarray, "*lead n"]
    y: Float[np.ndarray, "*lead m"]
    C: Float[np.ndarray, "*lead m n"]
    R: Float[np.ndarray, "*_r m m"]


def linearise(
    means: Float[np.ndarray, "*lead n"],
    covs: Float[np.ndarray, "*lead n n"],
    sensor: BoundSensor,
    method: Linearisation = "extended",
) -> Affine:
    """Replace a sensor by an affine one about N(means, covs).

    Args:
        means: (*lead, M1, ..., MC, n).
        covs: (*lead, M1, ..., MC, n, n); "extended" does not look at them.
        sensor: bound to the model, and at one time (`sensor.at(t)`).
        method: "extended" or "cubature".

    Raises:
        ModelError: the method has another name.
        NumericalError: the sensor has no derivative at a mean.
    """
    R = sensor.noise()
    if method == "extended":
        return Affine(means, sensor.h(means), sensor.jacobian(means), R)
    if method != "cubature":
        raise ModelError(f'linearise is "extended" or "cubature", not {method!r}.')
    n = means.shape[-1]
    L = cholesky(covs)
    offsets = np.sqrt(n) * np.moveaxis(L, -1, 0)  # (n, *lead, n): points first, so that mode axes stay where they were
    centre = sensor.h(means)
    up = sensor.residual(sensor.h(means + offsets), centre)
    down = sensor.residual(sensor.h(means - offsets), centre)
    shift = (up + down).sum(0) / (2 * n)
    # cov(x, h) = L B and P = L L': hence C = B' L^-1 and C P C' = B' B, and cov h - B' B is what even terms leave.
    B = np.moveaxis(up - down, 0, -2) / (2 * np.sqrt(n))
    even = np.moveaxis((up + down) / 2 - shift, 0, -2) / np.sqrt(n)
    C = np.swapaxes(np.linalg.solve(np.swapaxes(_regular(L), -1, -2), B), -1, -2)
    return Affine(means, centre + shift, C, R + np.swapaxes(even, -1, -2) @ even)


def sensor_joint(
    means: Float[np.ndarray, "*lead n"],
    covs: Float[np.ndarray, "*lead n n"],
    sensor: BoundSensor,
    method: Linearisation = "extended",
) -> steps.Joint:
    """Predict state and measurement together, as `steps.measure` does for matrices; feeds `steps.condition`.

    Angles of its y lie on no particular branch: bring them near a measurement with `sensor.residual` first, or use
    `sensor_update`.

    Args:
        means: predicted, (*lead, M1, ..., MC, n).
        covs: predicted, (*lead, M1, ..., MC, n, n).
        sensor: bound to the model, and at one time (`sensor.at(t)`).
        method: "extended" or "cubature".

    Raises:
        ModelError: the method has another name.
        NumericalError: the sensor has no derivative at a mean.
    """
    return _predict(means, covs, linearise(means, covs, sensor, method))


def sensor_update(
    means: Float[np.ndarray, "*lead n"],
    covs: Float[np.ndarray, "*lead n n"],
    sensor: BoundSensor,
    z: Float[np.ndarray, "*_z m"],
    seen: Bool[np.ndarray, "*_z m"],
    *,
    method: Linearisation = "extended",
    iterations: int = 1,
) -> tuple[steps.Joint, steps.Conditioned]:
    """Condition each mode on a measurement, linearised about its prediction and then about its own posterior.

    Repeated tangents are Gauss-Newton steps for V(x) = |z - h(x)|^2_R + |x - m|^2_P, twice the negative log posterior.
    Close to the observer a full step may jump far away, so of a step and its halves that one is taken which lowers V
    most. The log-likelihood is that of the last linearisation; for tangents at the posterior mode this is Laplace's
    approximation of log f(z).

    Args:
        means: predicted, (*lead, M1, ..., MC, n).
        covs: predicted, (*lead, M1, ..., MC, n, n).
        sensor: bound to the model, and at one time (`sensor.at(t)`).
        z: measurement, with axes of length 1 for the modes, (*lead, 1, ..., 1, m).
        seen: which components were measured, like z.
        method: "extended" or "cubature".
        iterations: number of linearisations; 1 is the plain update.

    Returns:
        The joint prediction, its y on the branch of angles nearest z, and the posterior.

    Raises:
        ModelError: the method has another name.
        NumericalError: an innovation covariance is not positive definite, the sensor has no derivative at a mean, or
            (tangents taken anew) a sensor's R is singular.
    """
    first = _predict(means, covs, _near(linearise(means, covs, sensor, method), sensor, z, seen))
    done = steps.condition(first, z, seen)
    if iterations == 1:
        return first, done

    def step(x: Float[np.ndarray, "*lead n"], to: Float[np.ndarray, "*lead n"]) -> Float[np.ndarray, "*lead n"]:
        return _shortened(x, to, lambda at: _misfit(at, means, covs, sensor, z, seen)) if method == "extended" else to

    x = means
    for _ in range(iterations - 1):
        x = step(x, done.mean)
        again = _near(linearise(x, done.cov, sensor, method), sensor, z, seen)
        done = steps.condition(_predict(means, covs, again), z, seen)
    return first, done._replace(mean=step(x, done.mean))


def cholesky(covs: Float[np.ndarray, "*lead n n"]) -> Float[np.ndarray, "*lead n n"]:
    """Return lower triangular L with L L' = P, for singular P too: columns of components without spread are zero."""
    scale = np.sqrt(np.diagonal(covs, axis1=-2, axis2=-1))
    unit = np.where(scale > 0, scale, 1.0)
    scaled = covs / (unit[..., :, None] * unit[..., None, :])
    try:
        L = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        L = _semidefinite(scaled)
    return np.asarray(unit[..., :, None] * L)


def _semidefinite(P: Float[np.ndarray, "*lead n n"]) -> Float[np.ndarray, "*lead n n"]:
    """Cholesky's columns one by one; a pivot at round-off ends its column."""
    L = np.zeros_like(P)
    for j in range(P.shape[-1]):
        rest = P[..., :, j] - (L[..., :, :j] @ L[..., j, :j, None])[..., 0]
        pivot = rest[..., j]
        alive = pivot > _DEAD * P.shape[-1]
        column = rest / np.sqrt(np.where(alive, pivot, 1.0))[..., None]
        L[..., j:, j] = np.where(alive[..., None], column[..., j:], 0.0)
    return L


def _regular(L: Float[np.ndarray, "*lead n n"]) -> Float[np.ndarray, "*lead n n"]:
    """L with a one where a column is zero: nothing varies along it, so any value serves in L^-1 times such a column."""
    return np.asarray(L + np.eye(L.shape[-1]) * (np.diagonal(L, axis1=-2, axis2=-1) == 0.0)[..., None])


def _near(
    affine: Affine, sensor: BoundSensor, z: Float[np.ndarray, "*_z m"], seen: Bool[np.ndarray, "*_z m"]
) -> Affine:
    """Move y to the branch of angles nearest z, so that plain differences are the sensor's."""
    return affine._replace(y=np.where(seen, z - sensor.residual(z, affine.y), affine.y))


def _misfit(
    x: Float[np.ndarray, "*lead n"],
    means: Float[np.ndarray, "*lead n"],
    covs: Float[np.ndarray, "*lead n n"],
    sensor: BoundSensor,
    z: Float[np.ndarray, "*_z m"],
    seen: Bool[np.ndarray, "*_z m"],
) -> Float[np.ndarray, "*lead"]:
    """Twice the negative log posterior of states x, but for a constant."""
    u = np.linalg.solve(_regular(cholesky(covs)), (x - means)[..., None])[..., 0]
    nu = np.where(seen, sensor.residual(z, sensor.h(x)), 0.0)
    unseen = np.eye(z.shape[-1]) * ~seen[..., None]
    R = sensor.noise() * (seen[..., :, None] & seen[..., None, :]) + unseen
    try:
        return np.asarray(gaussian_terms(nu, np.broadcast_to(R, (*nu.shape, nu.shape[-1])))[0] + np.sum(u * u, axis=-1))
    except np.linalg.LinAlgError as error:
        raise NumericalError(
            "an iterated update weighs what is left of a measurement by R^-1, but R is singular. "
            "Give every measured component a positive variance, or use iterations=1."
        ) from error


def _shortened(
    x: Float[np.ndarray, "*lead n"],
    to: Float[np.ndarray, "*lead n"],
    misfit: Callable[[Float[np.ndarray, "*lead n"]], Float[np.ndarray, "*lead"]],
) -> Float[np.ndarray, "*lead n"]:
    """The point of least misfit among the ends of the whole step from x, half of it, a quarter, ..., and x itself."""
    points = np.stack([*(x + (to - x) * 0.5**halved for halved in range(_HALVINGS + 1)), x])
    best = np.argmin(np.stack([misfit(point) for point in points]), axis=0)
    return np.asarray(np.take_along_axis(points, best[None, ..., None], axis=0)[0])


def _predict(means: Float[np.ndarray, "*lead n"], covs: Float[np.ndarray, "*lead n n"], affine: Affine) -> steps.Joint:
    """The linear joint prediction, with y carried from the point of linearisation to the predicted mean."""
    moved = (affine.C @ (means - affine.about)[..., None])[..., 0]
    return steps.measure(means, covs, affine.C, None, affine.R)._replace(y=affine.y + moved)
