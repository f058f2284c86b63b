"""Moments that do not change: equation (D) set to zero, for starts of which something is not known.

    d/dt u_a = P <L y^a> - P <nu y^a> + sum_r P_r <nu_r Q y^a>_r = 0

with the averages taken over the closure's density. A root may be the moments of no density; those are rejected. Where
no realisable root is found, and for maximum entropy, (D) is followed in pseudo-time, which keeps realisability.

Source: moment-filter notes, section 9 (reconstruction of the paper's lost (20)-(22)).
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import NumericalError
from saltus.filters.moments.basis import Basis
from saltus.filters.moments.belief import Moments
from saltus.filters.moments.closure import Closing, ClosureName
from saltus.filters.moments.flow import Flow, constant_noise, predict_by_flow
from saltus.filters.moments.rates import moment_rates
from saltus.filters.moments.realisable import margin
from saltus.filters.moments.recursion import first_moments
from saltus.models import SwitchingSDE
from saltus.shapes import Float

__all__ = ["Stationary", "stationary_moments"]

_Array = npt.NDArray[np.float64]

_STEPS = (0.3, 0.08, 0.02)  # of pseudo-time, coarse to fine, in units of the model's own time
_STILL = 4e-5  # change per unit of that time
_MOST_STEPS = 3_000
_FAR = 1e6  # standard deviation, in the state's unit, at which nothing will stand still
_NEWTON = 60
_ROOT = 1e-9
_NEGATIVE = 0.2  # part of a Hermite density below zero at which its moments are an artefact of the series
_PARTS = 30  # substeps while the start forgets its shape


class Stationary(NamedTuple):
    """Stationary moments of every mode.

    Attributes:
        probs, mean, cov: of the modes, (S,), (S, n), (S, n, n).
        h: Hermite moments of the whitened state, (S, A); the first is 1, those of order 1 and 2 are 0.
        residual: largest |d/dt u_a| left, in units of the start's standard deviations.
        rejected: roots that were moments of no density, or whose series is negative by more than a fifth.
        method: "newton" or "marching" in pseudo-time.
    """

    probs: Float[np.ndarray, " s"]
    mean: Float[np.ndarray, "s n"]
    cov: Float[np.ndarray, "s n n"]
    h: Float[np.ndarray, "s a"]
    residual: float
    rejected: int
    method: Literal["newton", "marching"]


def stationary_moments(
    model: SwitchingSDE,
    *,
    order: int = 4,
    closure: ClosureName = "maxent",
    keep_start: bool = False,
    nodes: int = 60,
) -> Stationary:
    """Moments that stand still.

    Args:
        model: an ergodic diffusion: a random walk has no stationary moments.
        order: highest order of the moments.
        closure: how moments become a density.
        keep_start: hold probabilities, means and covariances at the model's start, and find the higher moments only.
        nodes: quadrature nodes per axis.

    Raises:
        NumericalError: moments move without end.
    """
    order = 2 if closure == "gaussian" else order
    closing = Closing(closure, model.n_state, order, nodes, closure != "hermite", 1)
    start = first_moments(model, closing.basis, 1)
    problem = _Problem(model, closing, start, keep_start)
    rejected = 0
    if closure != "maxent":
        for x in problem.starts():
            root, residual = _newton(problem, x)
            if residual > _ROOT:
                continue
            law = problem.law(root)
            negative = -np.minimum(closing.closed(law)[1], 0.0).sum(axis=-1)
            if (margin(closing.basis, law.h) > 0).all() and (negative < _NEGATIVE).all():
                return _found(law, residual, rejected, "newton")
            rejected += 1
    if keep_start:
        if closure == "maxent":
            root, residual = _newton(problem, problem.starts()[0])
            if residual < 1e-4:
                return _found(problem.law(root), residual, rejected, "newton")
        raise NumericalError(
            "no realisable moments of higher order stand still with this mean and covariance.\n"
            "Start from the Gaussian, or let all moments be found (keep_start=False)."
        )
    law = _marched(model, closing.basis, nodes, start, "maxent" if order % 2 == 0 else closure)
    return _found(law, float(np.abs(problem.rates(law)).max()), rejected, "marching")


def _found(law: Moments, residual: float, rejected: int, method: Literal["newton", "marching"]) -> Stationary:
    return Stationary(np.exp(law.log_probs[0]), law.mean[0], law.cov[0], law.h[0], residual, rejected, method)


class _Problem:
    """Unknowns x = (P of all modes but one, means, roots of covariances, Hermite moments), and the rates to make 0."""

    def __init__(self, model: SwitchingSDE, closing: Closing, start: Moments, keep_start: bool) -> None:
        self.model, self.closing, self.start, self.keep_start = model, closing, start, keep_start
        self.high = closing.basis.degree >= 3
        self.lower = np.tril_indices(model.n_state)
        weights = np.asarray(model.probs0)
        self.origin = weights @ model.means0
        self.scale = np.sqrt(np.diagonal(model.covs0, axis1=-2, axis2=-1).mean(axis=0)) + 1e-9

    def starts(self) -> list[_Array]:
        """The model's start, and others about it."""
        first = self.pack(self.start)
        if self.keep_start:
            return [first]
        moved = []
        for shift, width in ((0.0, 0.6), (0.5, 0.7), (-0.5, 0.7), (0.2, 0.4), (1.0, 0.4), (-1.0, 0.4)):
            law = self.start
            mean = law.mean + shift * np.diagonal(law.root, axis1=-2, axis2=-1)
            moved.append(self.pack(law._replace(mean=mean, root=width * law.root)))
        return [first, *moved]

    def pack(self, law: Moments) -> _Array:
        high = law.h[0][:, self.high].ravel()
        if self.keep_start:
            return np.asarray(high)
        return np.concatenate([np.exp(law.log_probs[0, 1:]), law.mean[0].ravel(), self._roots(law).ravel(), high])

    def _roots(self, law: Moments) -> _Array:
        return np.asarray(law.root[0][:, self.lower[0], self.lower[1]])

    def law(self, x: _Array) -> Moments:
        s, n = self.start.log_probs.shape[1], self.model.n_state
        h = np.zeros_like(self.start.h)
        h[..., 0] = 1.0
        high = int(self.high.sum())
        h[0][:, self.high] = x[len(x) - s * high :].reshape(s, high)
        if self.keep_start:
            return self.start._replace(h=h)
        probs = np.concatenate([[1 - x[: s - 1].sum()], x[: s - 1]])
        mean = x[s - 1 : s - 1 + s * n].reshape(1, s, n)
        root = np.zeros((1, s, n, n))
        size = len(self.lower[0])
        root[0][:, self.lower[0], self.lower[1]] = x[s - 1 + s * n : s - 1 + s * (n + size)].reshape(s, size)
        return Moments(np.log(np.maximum(probs, 1e-290))[None], mean, root, h)

    def admissible(self, x: _Array) -> bool:
        law = self.law(x)
        positive = np.diagonal(law.root, axis1=-2, axis2=-1).min() > 1e-4 * self.scale.min()
        return bool(positive and law.log_probs.min() > -20 and np.isfinite(x).all() and np.abs(x).max() < 1e3)

    def rates(self, law: Moments) -> _Array:
        points = self.closing.points(law)
        return np.asarray(moment_rates(self.model, self.closing.basis, points, self.origin, self.scale)[0])

    def __call__(self, x: _Array) -> _Array:
        rates = self.rates(self.law(x))
        if self.keep_start:
            return np.asarray(rates[:, self.high].ravel())
        return np.concatenate([rates[1:, 0], rates[:, 1:].ravel()])


def _newton(problem: _Problem, x: _Array) -> tuple[_Array, float]:
    """Newton's iteration with halved steps; the root and the largest rate left."""
    f = problem(x)
    for _ in range(_NEWTON):
        if np.abs(f).max() <= _ROOT:
            break
        step = -np.linalg.lstsq(_jacobian(problem, x), f, rcond=None)[0]
        length = 1.0
        while length > 1e-4:
            tried = x + length * step
            if problem.admissible(tried):
                g = problem(tried)
                if np.linalg.norm(g) < (1 - 1e-4 * length) * np.linalg.norm(f):
                    x, f = tried, g
                    break
            length /= 2
        else:
            break
    return x, float(np.abs(f).max())


def _jacobian(f: Callable[[_Array], _Array], x: _Array) -> _Array:
    columns = []
    for i in range(len(x)):
        d = np.zeros_like(x)
        d[i] = 1e-5 * max(1.0, abs(x[i]))
        columns.append((f(x + d) - f(x - d)) / (2 * d[i]))
    return np.stack(columns, axis=-1)


def _marched(model: SwitchingSDE, of: Basis, nodes: int, start: Moments, closure: ClosureName) -> Moments:
    """Follow (D) until nothing moves."""
    closing = Closing(closure, model.n_state, of.order, nodes, True, 1)
    flow = Flow(model, of, closing.points, constant_noise(model))
    time = 1.0 / _slowest(model)
    law = predict_by_flow(flow, closing.points(start), time * _STEPS[0], _PARTS)
    for step in _STEPS:
        for _ in range(_MOST_STEPS):
            after = predict_by_flow(flow, closing.points(law), time * step, 1)
            moved, spread = _moved(law, after)
            law = after
            if moved < _STILL * step or not spread < _FAR:
                break
        else:
            break
        if not spread < _FAR:
            break
    else:
        return law
    raise NumericalError(
        "no stationary moments: they move on and on. A random walk, or a mode that is never left, has none.\n"
        "Take a wide Gaussian as the start instead."
    )


def _moved(before: Moments, after: Moments) -> tuple[float, float]:
    """Largest change of whitened moments and probabilities, and the largest standard deviation."""
    spread = np.sqrt(np.diagonal(after.cov, axis1=-2, axis2=-1))
    changes = (
        (after.mean - before.mean) / spread,
        (after.cov - before.cov) / np.square(spread).max(),
        np.exp(after.log_probs) - np.exp(before.log_probs),
        after.h - before.h,
    )
    return max(float(np.abs(change).max()) for change in changes), float(spread.max())


def _slowest(model: SwitchingSDE) -> float:
    """A rate typical of the model: steepness of the drift at the start, and rates of switching."""
    x, spread = model.means0, np.sqrt(np.diagonal(model.covs0, axis1=-2, axis2=-1))
    rates = []
    for mode in range(model.n_modes):
        slope = model.drift_at(mode, x[mode] + spread[mode]) - model.drift_at(mode, x[mode] - spread[mode])
        rates += [float(np.abs(slope / (2 * spread[mode] + 1e-300)).max()), float(model.exit_rate(mode, x[mode]))]
    return max(max(rates), 1e-3)
