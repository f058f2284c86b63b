"""How the continuous state moves: linear stochastic differential equations, and linear steps."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from saltus.errors import ModelError
from saltus.models.chain import Chain
from saltus.models.checks import FloatArray, covariance, intervals, numbers, same, unit_steps
from saltus.models.dependence import Matrix, TimeDependent, fixed, is_fixed, resolve
from saltus.models.exponential import discretise

__all__ = ["Dynamics", "LinearSDE", "LinearTransition", "Step"]


class Step(NamedTuple):
    """x+ = F x + b + w, cov w = Q: matrices over intervals, with mode axes (*dt, M1|1, ..., MC|1, ...)."""

    F: FloatArray  # (..., n, n)
    Q: FloatArray  # (..., n, n)
    b: FloatArray | None  # (..., n)


@runtime_checkable
class Dynamics(Protocol):
    """What a HybridModel asks of a description of motion."""

    def dimension(self) -> int:
        """Dimension n of the state; known once bound."""
        ...

    def bind(self, chains: Sequence[Chain]) -> "Dynamics":
        """Replace functions and tables by arrays with one mode axis per chain."""
        ...

    def step(self, dt: FloatArray, t: FloatArray | None) -> Step:
        """Matrices over intervals of length dt (T,) or () that end at t (T,) or None."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class LinearSDE:
    """A linear stochastic differential equation, discretised exactly over any interval.

    dx = (F x + drift) dt + G dW

    Each of the three may depend on chains (see `saltus.models.dependence`).

    Args:
        F: (n, n), 1/s.
        G: (n, q), state unit / sqrt(s).
        drift: constant part of the velocity of x, (n,); absent means 0.

    Raises:
        ModelError: shapes do not fit, or an entry is not finite.
    """

    F: Matrix
    G: Matrix
    drift: Matrix | None = None

    def __post_init__(self) -> None:
        put = object.__setattr__
        if is_fixed(self.F):
            put(self, "F", _square(numbers(self.F, "LinearSDE F"), "LinearSDE F"))
        for name, value, n_axes in (("G", self.G, 2), ("drift", self.drift, 1)):
            if value is not None and is_fixed(value):
                array = numbers(value, f"LinearSDE {name}")
                put(self, name, array)
                if is_fixed(self.F):
                    _fits(f"LinearSDE {name}", array, n_axes, fixed(self.F, "LinearSDE F").shape[-1])

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    def dimension(self) -> int:
        """Dimension of the state."""
        return int(fixed(self.F, "LinearSDE F").shape[-1])

    def bind(self, chains: Sequence[Chain]) -> "LinearSDE":
        """Replace functions and tables by arrays with one mode axis per chain."""
        drift = None if self.drift is None else resolve(self.drift, chains, "LinearSDE drift", 1)
        F, G = resolve(self.F, chains, "LinearSDE F", 2), resolve(self.G, chains, "LinearSDE G", 2)
        return replace(self, F=F, G=G, drift=drift)

    def step(self, dt: FloatArray, t: FloatArray | None = None) -> Step:
        """Matrices over intervals: Phi = exp(F dt), Q of `discretise`, b = int_0^dt exp(F s) drift ds."""
        F, G = fixed(self.F, "LinearSDE F"), fixed(self.G, "LinearSDE G")
        step = intervals(dt)
        if self.drift is None:
            step = step.reshape(*step.shape, *(1,) * (max(F.ndim, G.ndim) - 2))
            return Step(*discretise(F, G, step), None)
        drift = fixed(self.drift, "LinearSDE drift")
        n = F.shape[-1]
        # A constant input is one more state that never changes: exp of the bordered matrix holds its integral.
        lead = np.broadcast_shapes(F.shape[:-2], drift.shape[:-1])
        bordered = np.zeros((*lead, n + 1, n + 1))
        bordered[..., :n, :n], bordered[..., :n, n] = F, drift
        noise = np.concatenate([G, np.zeros((*G.shape[:-2], 1, G.shape[-1]))], axis=-2)
        step = step.reshape(*step.shape, *(1,) * max(len(lead), G.ndim - 2))
        Phi, Q = discretise(bordered, noise, step)
        return Step(Phi[..., :n, :n], Q[..., :n, :n], Phi[..., :n, n])


@dataclass(frozen=True, slots=True, eq=False)
class LinearTransition:
    """A linear step, for motion given in discrete time.

    x+ = F x + b + w,  cov w = Q

    Constant matrices are per step and serve equal intervals only (an interval of 0 is no step). Functions may ask for
    `dt` (s) and `t` (end of the interval, s) besides chains, and then serve any interval.

    Args:
        F: (n, n).
        Q: process noise covariance, (n, n).
        b: constant input, (n,); absent means 0.

    Raises:
        ModelError: shapes do not fit, or Q is no covariance.
    """

    F: Matrix
    Q: Matrix
    b: Matrix | None = None

    def __post_init__(self) -> None:
        put = object.__setattr__
        if is_fixed(self.F):
            put(self, "F", _square(numbers(self.F, "LinearTransition F"), "LinearTransition F"))
        if is_fixed(self.Q):
            put(self, "Q", covariance(self.Q, "LinearTransition Q"))
        if self.b is not None and is_fixed(self.b):
            put(self, "b", numbers(self.b, "LinearTransition b"))
        if is_fixed(self.F):
            n = fixed(self.F, "LinearTransition F").shape[-1]
            for name, value, n_axes in (("Q", self.Q, 2), ("b", self.b, 1)):
                if value is not None and is_fixed(value):
                    _fits(f"LinearTransition {name}", np.asarray(value), n_axes, n)

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    def dimension(self) -> int:
        """Dimension of the state."""
        F = self.F.at(np.zeros(1), np.ones(1)) if isinstance(self.F, TimeDependent) else self.F
        return int(fixed(F, "LinearTransition F").shape[-1])

    def bind(self, chains: Sequence[Chain]) -> "LinearTransition":
        """Replace functions and tables by arrays with one mode axis per chain."""
        words = ("t", "dt")
        F = resolve(self.F, chains, "LinearTransition F", 2, words)
        Q = resolve(self.Q, chains, "LinearTransition Q", 2, words)
        b = None if self.b is None else resolve(self.b, chains, "LinearTransition b", 1, words)
        return replace(self, F=F, Q=Q, b=b)

    def step(self, dt: FloatArray, t: FloatArray | None = None) -> Step:
        """Matrices over intervals; the identity and no noise where dt is 0."""
        step = intervals(dt)
        given = (self.F, self.Q, self.b)
        if not any(isinstance(value, TimeDependent) for value in given):
            remedy = "Describe the motion by LinearSDE, or let the functions ask for dt."
            unit_steps(step, "LinearTransition", remedy)
        moves = step > 0
        F = _over(self.F, "LinearTransition F", step, t, 2)
        F = np.where(_lead(moves, F), F, np.eye(F.shape[-1]))
        Q = _over(self.Q, "LinearTransition Q", step, t, 2)
        Q = covariance(np.where(_lead(moves, Q), Q, 0.0), "LinearTransition Q")
        if self.b is None:
            return Step(F, Q, None)
        b = _over(self.b, "LinearTransition b", step, t, 1)
        return Step(F, Q, np.where(_lead(moves, b), b, 0.0))


def _over(value: Matrix, what: str, dt: FloatArray, t: FloatArray | None, n_core: int) -> FloatArray:
    """One matrix per interval, (*dt, M1|1, ..., *core)."""
    if isinstance(value, TimeDependent):
        flat = value.at(None if t is None else t.reshape(-1), dt.reshape(-1))
        return numbers(flat.reshape(*dt.shape, *flat.shape[1:]), what)
    array = fixed(value, what)
    return np.broadcast_to(array, (*dt.shape, *array.shape))


def _lead(mask: np.ndarray, like: FloatArray) -> np.ndarray:
    return mask.reshape(*mask.shape, *(1,) * (like.ndim - mask.ndim))


def _square(array: FloatArray, what: str) -> FloatArray:
    if array.ndim < 2 or array.shape[-1] != array.shape[-2]:
        raise ModelError(f"{what} must be a square matrix (n, n), got shape {array.shape}.")
    return array


def _fits(what: str, array: FloatArray, n_axes: int, n: int) -> None:
    if array.ndim < n_axes or array.shape[array.ndim - n_axes] != n:
        expected = f"({n},)" if n_axes == 1 else f"({n}, q)" if what.endswith("G") else f"({n}, {n})"
        raise ModelError(f"{what} must have shape {expected} to go with F, got {array.shape}.")
