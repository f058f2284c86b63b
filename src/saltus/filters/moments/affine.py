"""The moment equations (D) in closed form: affine drift, constant noise and rates make them linear.

d/dt u_a = P <L psi_a> - nu u_a + sum_r nu_r (u_a of r, or u_0 of r times the moment of the restored law): no closure,
integrated by a Taylor series about an origin that each run chooses for itself.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.filters.moments.basis import Basis, basis, gaussian_points, normal_nodes
from saltus.filters.moments.belief import Moments, Points, root_of
from saltus.linalg import symmetric
from saltus.models import DiffusionSensor, SwitchingSDE
from saltus.shapes import Float

__all__ = ["Affine", "affine", "is_affine", "predict_affine"]

_Array = npt.NDArray[np.float64]

_DEGREE = 14  # of the Taylor series, over substeps that the equations' rates make shorter than 1
_LINEAR = 1e-9


class Affine(NamedTuple):
    """Drift F y + c, noise B and rates of every mode."""

    F: Float[np.ndarray, "s n n"]
    c: Float[np.ndarray, "s n"]
    B: Float[np.ndarray, "s n n"]
    rates: Float[np.ndarray, "s s"]  # from, to; diagonal 0
    restored: dict[tuple[int, int], tuple[_Array, _Array]]


def affine(model: SwitchingSDE) -> Affine | None:
    """Read a model's drift as F y + c; None unless it is affine, and noise and rates constant.

    Functions are judged by their values at distances of 1 to 30 standard deviations of the start on all axes and
    diagonals.
    """
    x, centre, spread = _probes(model)
    parts = [_affine_map(partial(model.drift_at, s), x, centre, spread) for s in range(model.n_modes)]
    found = [part for part in parts if part is not None]
    if len(found) < len(parts):
        return None
    F, c = np.stack([part[0] for part in found]), np.stack([part[1] for part in found])
    fields = [model.covariance_at(mode, x) for mode in range(model.n_modes)]
    rates = {switch: model.rate(switch, x) for switch in model.switches}
    if any(np.ptp(f, axis=0).max() > _LINEAR * np.abs(f).max() for f in [*fields, *rates.values()]):
        return None
    nu = np.zeros((model.n_modes, model.n_modes))
    for switch, rate in rates.items():
        nu[switch] = rate[0]
    laws = {switch: law for switch in model.switches if (law := model.restored(switch)) is not None}
    return Affine(F, c, np.stack([f[0] for f in fields]), nu, laws)


def is_affine(sensor: DiffusionSensor, model: SwitchingSDE) -> bool:
    """Whether a sensor measures an affine function of the state with constant noise."""
    x, centre, spread = _probes(model)
    maps = [_affine_map(partial(sensor.h_at, s), x, centre, spread) for s in range(model.n_modes)]
    return all(part is not None for part in maps) and not any(callable(R) for R in sensor.R)


def _probes(model: SwitchingSDE) -> tuple[_Array, _Array, _Array]:
    """States on all axes and diagonals, their centre, and a unit of length for every axis."""
    n, centre = model.n_state, model.means0.mean(axis=0)
    spread = np.sqrt(np.diagonal(model.covs0, axis1=-2, axis2=-1).max(axis=0)) + 1e-9
    ways = np.concatenate([np.eye(n), np.ones((1, n)), np.where(np.arange(n) % 2, -1.0, 1.0)[None]])
    steps = np.concatenate([size * ways for size in (1, -1, 2.5, -2.5, 7, -7, 30, -30)])
    return centre + spread * steps, centre, spread


def _affine_map(
    of: Callable[[_Array], _Array], x: _Array, centre: _Array, spread: _Array
) -> tuple[_Array, _Array] | None:
    """F and c of a function F y + c; None if it is none."""
    at = of(centre)
    F = ((of(centre + spread * np.eye(len(centre))) - at) / spread[:, None]).T
    c = at - F @ centre
    found = of(x)
    return None if np.abs(found - x @ F.T - c).max() > _LINEAR * (np.abs(found).max() + 1e-300) else (F, c)


def predict_affine(model: Affine, order: int, start: Points, dt: float) -> Moments:
    """Moments after an interval, exact up to rounding."""
    n = model.F.shape[-1]
    of = basis(n, order)
    weights = np.exp(start.log_probs)[..., None] * start.weights
    origin = np.einsum("bsq,bsqn->bn", weights, start.points)
    scale = np.sqrt(np.einsum("bsq,bsqn->n", weights, np.square(start.points - origin[:, None, None])) / len(weights))
    scale = np.maximum(scale + np.sqrt(dt * model.B.diagonal(axis1=-2, axis2=-1).max(0)), 1e-300)
    z = (start.points - origin[:, None, None]) / scale
    u = of.moments(z.reshape(-1, *z.shape[2:]), weights.reshape(-1, weights.shape[-1])).reshape(*z.shape[:2], -1)
    u = _evolved(model, of, u, origin, scale, dt)
    return _whitened(of, u, origin, scale)


def _evolved(model: Affine, of: Basis, u: _Array, origin: _Array, scale: _Array, dt: float) -> _Array:
    n, n_modes = len(scale), len(model.F)
    slopes = [of.derivative(i) for i in range(n)]
    steep = model.F * scale / scale[:, None]
    push = (np.einsum("sij,bj->bsi", model.F, origin) + model.c) / scale
    wide = model.B / (scale[:, None] * scale)
    # psi -> L psi without the push, in the basis itself: exact, since an affine drift never raises the order.
    L = np.zeros((n_modes, *slopes[0].shape))
    for i in range(n):
        for j in range(n):
            L += steep[:, i, j, None, None] * (slopes[i] @ of.multiplication(j))
            L += 0.5 * wide[:, i, j, None, None] * (slopes[i] @ slopes[j])
    exits = model.rates.sum(axis=1)
    kept = model.rates.copy()
    clumps = {}
    for switch, law in model.restored.items():
        kept[switch] = 0.0
        clumps[switch] = _gaussian_moments(of, law, origin, scale)

    def change(v: _Array) -> _Array:
        rate = np.einsum("bsa,sca->bsc", v, L) - exits[:, None] * v + np.einsum("bra,rs->bsa", v, kept)
        for i in range(n):
            rate += push[..., i, None] * (v @ slopes[i].T)
        for (source, target), moments in clumps.items():
            rate[:, target] += model.rates[source, target] * v[:, source, :1] * moments
        return np.asarray(rate)

    size = of.order * (np.abs(steep).sum(-1).max() + np.abs(push).max()) + of.order**2 * np.abs(wide).max()
    n_steps = max(1, int(np.ceil(dt * (size + 2 * exits.max()) / 2)))
    for _ in range(n_steps):
        term = u
        for k in range(1, _DEGREE + 1):
            term = change(term) * (dt / n_steps / k)
            u = u + term
    return u


def _gaussian_moments(of: Basis, law: tuple[_Array, _Array], origin: _Array, scale: _Array) -> _Array:
    points, weight = gaussian_points(*law, of.order // 2 + 1)
    return np.asarray(np.einsum("g,bga->ba", weight, of.evaluate((points - origin[:, None]) / scale)))


def _whitened(of: Basis, u: _Array, origin: _Array, scale: _Array) -> Moments:
    """Hermite moments about the origin turned into those of the whitened variable."""
    n = len(scale)
    mass = u[..., 0]
    v = u / mass[..., None]
    first = v[..., 1 : n + 1][..., np.argsort(np.argmax(of.indices[1 : n + 1], axis=-1))]
    second = np.zeros((*first.shape, n))
    for i, a in enumerate(of.indices.tolist()):
        if sum(a) == 2:
            axes = [j for j, k in enumerate(a) for _ in range(k)]
            value = np.sqrt(2.0) * v[..., i] + 1.0 if 2 in a else v[..., i]
            second[..., axes[0], axes[1]] = second[..., axes[1], axes[0]] = value
    cov = symmetric((second - first[..., :, None] * first[..., None, :]) * scale[:, None] * scale)
    mean, root = origin[:, None] + first * scale, root_of(cov)
    nodes, weight = normal_nodes(n, of.order + 1)
    off = scale * nodes + origin[:, None, None] - mean[:, :, None]
    xi = off @ np.linalg.inv(root).swapaxes(-1, -2)
    turn = of.evaluate(xi).swapaxes(-1, -2) @ (weight[:, None] * of.evaluate(nodes))
    h = (turn @ v[..., None])[..., 0]
    h[..., 0] = 1.0
    h[..., (of.degree == 1) | (of.degree == 2)] = 0.0
    return Moments(np.log(np.maximum(mass / mass.sum(-1, keepdims=True), 1e-290)), mean, root, h)
