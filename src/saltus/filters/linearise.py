r"""Nonlinear sensors in the recursion: each mode's measurement as an affine function of its state.

    h(x) = y + C (x - m) + e,   cov e = Omega,

about a Gaussian N(m, P). "extended": the tangent, y = h(m), C = dh/dx(m), Omega = 0. "cubature": the regression of h
on x under N(m, P), with moments by the third-degree spherical-radial rule (2n points m +- sqrt(n) L e_i, P = L L'):
y = E h, C = cov(h, x) P^-1, Omega = cov h - C P C', which is never negative. Both then are linear updates in the
Joseph form of `steps.condition`. All modes, runs and tracks at once; angles never leave the sensor's `residual`.

Source: Arasaratnam and Haykin (2009), Cubature Kalman filters, IEEE Trans. Automatic Control 54(6), for the points;
Garcia-Fernandez, Svensson, Morelande and Sarkka (2015), Posterior linearization filter, IEEE Trans. Signal Processing
63(20), for the regression repeated about the posterior; with tangents this is the iterated extended Kalman filter,
that is Gauss-Newton steps towards the posterior mode (Bell and Cathey 1993). Raitoharju, Svensson, Garcia-Fernandez and
Piche (2018), Damped posterior linearization filter, IEEE Signal Processing Letters, for damping it; the cost that must
fall is another one here.
"""

from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from saltus.errors import ModelError, NumericalError
from saltus.filters import steps
from saltus.linalg import cholesky, gaussian_terms
from saltus.models import BoundSensor
from saltus.shapes import Bool, Float

__all__ = ["Affine", "Linearisation", "linearise", "sensor_joint", "sensor_update"]

Linearisation: TypeAlias = Literal["extended", "cubature"]

_HALVINGS = 5  # of the way to the posterior before
_GAIN = 0.01  # nats, that is a seventh of a standard deviation, below which the plain update is kept


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

    Linearising anew about the posterior may jump far away, and a posterior mode may be a bad place for a tangent. What
    is lowered is the free energy of the Gaussian q = N(x, P+) that an update gives,

        V = E_q[|z - h|^2_R + |x - m|^2_P]/2 - log det(P+)/2 = KL(q, exact posterior) + constant,

    its first term by sigma points of q. Of the way to the posterior before, that one of 1, 1/2, 1/4, ... is gone that
    lowers V most, and the last posterior is taken where its V is 0.01 nats below the plain update's. Each mode goes
    its own way. So no iteration leaves a posterior farther from the exact one, as far as sigma points see it.

    Args:
        means: predicted, (*lead, M1, ..., MC, n).
        covs: predicted, (*lead, M1, ..., MC, n, n).
        sensor: bound to the model, and at one time (`sensor.at(t)`).
        z: measurement, with axes of length 1 for the modes, (*lead, 1, ..., 1, m).
        seen: which components were measured, like z.
        method: "extended" or "cubature".
        iterations: number of linearisations, at most; 1 is the plain update.

    Returns:
        The joint prediction, its y on the branch of angles nearest z, and the posterior.

    Raises:
        ModelError: the method has another name.
        NumericalError: an innovation covariance is not positive definite, the sensor has no derivative at a mean, or
            (tangents taken anew) a sensor's R is singular.
    """
    prior = _Prior(means, covs, sensor, z, seen)
    first, done = _updated(prior, means, covs, method)
    if iterations > 1:
        done = _iterated(prior, method, iterations - 1, _Trial(means, covs, *done, _free_energy(prior, first, done)))
    return first, done


def _regular(L: Float[np.ndarray, "*lead n n"]) -> Float[np.ndarray, "*lead n n"]:
    """L with a one where a column is zero: nothing varies along it, so any value serves in L^-1 times such a column."""
    return np.asarray(L + np.eye(L.shape[-1]) * (np.diagonal(L, axis1=-2, axis2=-1) == 0.0)[..., None])


def _near(
    affine: Affine, sensor: BoundSensor, z: Float[np.ndarray, "*_z m"], seen: Bool[np.ndarray, "*_z m"]
) -> Affine:
    """Move y to the branch of angles nearest z, so that plain differences are the sensor's."""
    return affine._replace(y=np.where(seen, z - sensor.residual(z, affine.y), affine.y))


class _Prior(NamedTuple):
    """What an update starts from."""

    means: Float[np.ndarray, "*lead n"]
    covs: Float[np.ndarray, "*lead n n"]
    sensor: BoundSensor
    z: Float[np.ndarray, "*_z m"]
    seen: Bool[np.ndarray, "*_z m"]


def _updated(
    prior: _Prior, about: Float[np.ndarray, "*lead n"], cov: Float[np.ndarray, "*lead n n"], method: Linearisation
) -> tuple[steps.Joint, steps.Conditioned]:
    """The update by the sensor linearised about N(about, cov)."""
    affine = _near(linearise(about, cov, prior.sensor, method), prior.sensor, prior.z, prior.seen)
    prediction = _predict(prior.means, prior.covs, affine)
    return prediction, steps.condition(prediction, prior.z, prior.seen)


class _Trial(NamedTuple):
    """A posterior, the Gaussian about which the sensor was linearised for it, and its free energy."""

    about: Float[np.ndarray, "*lead n"]
    about_cov: Float[np.ndarray, "*lead n n"]
    mean: Float[np.ndarray, "*lead n"]
    cov: Float[np.ndarray, "*lead n n"]
    loglik: Float[np.ndarray, "*lead"]
    d2: Float[np.ndarray, "*lead"]
    energy: Float[np.ndarray, "*lead"]


def _iterated(prior: _Prior, method: Linearisation, times: int, plain: _Trial) -> steps.Conditioned:
    """Linearise anew about the posterior, or part of the way to it, as long as that lowers the free energy."""
    now = plain
    for _ in range(times):
        start = now
        for halved in range(_HALVINGS + 1):
            part = 0.5**halved
            about = start.about + part * (start.mean - start.about)
            about_cov = start.about_cov + part * (start.cov - start.about_cov)
            prediction, done = _updated(prior, about, about_cov, method)
            again = _Trial(about, about_cov, *done, _free_energy(prior, prediction, done))
            now = _chosen(np.asarray(again.energy < now.energy), again, now)
        if (now.energy == start.energy).all():
            break
    now = _chosen(np.asarray(now.energy < plain.energy - _GAIN), now, plain)
    return steps.Conditioned(now.mean, now.cov, now.loglik, now.d2)


def _chosen(taken: Bool[np.ndarray, "*lead"], new: _Trial, old: _Trial) -> _Trial:
    """Fields of `new` where `taken`, else of `old`."""
    extra = [np.ndim(value) - taken.ndim for value in new]
    masks = [taken[(..., *(None,) * axes)] for axes in extra]
    return _Trial(*(np.where(mask, a, b) for mask, a, b in zip(masks, new, old, strict=True)))


def _free_energy(prior: _Prior, prediction: steps.Joint, done: steps.Conditioned) -> Float[np.ndarray, "*lead"]:
    """V of an update's posterior, but for a constant; det P+ / det P is det R / det S of its linearisation."""
    n, sensor, seen = done.mean.shape[-1], prior.sensor, prior.seen
    root = _regular(cholesky(prior.covs))
    u = np.linalg.solve(root, (done.mean - prior.means)[..., None])[..., 0]
    L = cholesky(done.cov)
    spread, offsets = np.linalg.solve(root, L), np.sqrt(n) * np.moveaxis(L, -1, 0)
    x = done.mean + np.concatenate([offsets, -offsets])
    nu = np.where(seen, sensor.residual(prior.z, sensor.h(x)), 0.0)
    try:
        misfit = gaussian_terms(nu, np.broadcast_to(_of_seen(sensor.noise(), seen), (*nu.shape, nu.shape[-1])))[0]
    except np.linalg.LinAlgError as error:
        raise NumericalError(
            "an iterated update weighs what is left of a measurement by R^-1, but R is singular. "
            "Give every measured component a positive variance, or use iterations=1."
        ) from error
    noise = prediction.Y[..., n:]
    R = noise @ noise.swapaxes(-1, -2)
    log_ratio = [np.linalg.slogdet(_of_seen(a, seen))[1] for a in (prediction.S, R)]
    distance = np.sum(u * u, axis=-1) + np.sum(spread * spread, axis=(-1, -2))
    return np.asarray(0.5 * (misfit.mean(0) + distance + log_ratio[0] - log_ratio[1]))


def _of_seen(S: Float[np.ndarray, "*lead m m"], seen: Bool[np.ndarray, "*_z m"]) -> Float[np.ndarray, "*out m m"]:
    """A covariance of measurements with rows and columns of the unit matrix where a component is missing."""
    return np.asarray(S * (seen[..., :, None] & seen[..., None, :]) + np.eye(S.shape[-1]) * ~seen[..., None])


def _predict(means: Float[np.ndarray, "*lead n"], covs: Float[np.ndarray, "*lead n n"], affine: Affine) -> steps.Joint:
    """The linear joint prediction, with y carried from the point of linearisation to the predicted mean."""
    moved = (affine.C @ (means - affine.about)[..., None])[..., 0]
    return steps.measure(means, covs, affine.C, None, affine.R)._replace(y=affine.y + moved)
