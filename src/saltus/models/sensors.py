"""What sensors measure: one frozen dataclass each, independent of any filter."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.models.chain import Chain
from saltus.models.checks import FloatArray, axes, covariance, numbers, probability, same
from saltus.models.dependence import Matrix, TimeDependent, fixed, is_fixed, resolve
from saltus.models.observer import Observer
from saltus.shapes import Float

__all__ = ["BoundSensor", "LinearSensor", "Measured", "PositionSensor", "Sensor", "at_time"]


class Measured(NamedTuple):
    """z = H x + d + v, cov v = R, with mode axes (T?, M1|1, ..., MC|1, ...)."""

    H: FloatArray  # (..., m, n)
    R: FloatArray  # (..., m, m)
    d: FloatArray | None  # (..., m)


@runtime_checkable
class Sensor(Protocol):
    """What a HybridModel and filters ask of a sensor."""

    @property
    def prob_detection(self) -> float:
        """Probability that an object present is reported."""
        ...

    def h(self, x: npt.ArrayLike) -> Float[np.ndarray, "*lead m"]:
        """Expected measurement of states (..., n)."""
        ...

    def jacobian(self, x: npt.ArrayLike) -> Float[np.ndarray, "*lead m n"]:
        """Derivative of h at states (..., n)."""
        ...

    def residual(self, z: npt.ArrayLike, z_pred: npt.ArrayLike) -> Float[np.ndarray, "*lead m"]:
        """Difference of measurements (angles wrapped)."""
        ...

    def bind(self, chains: Sequence[Chain], n_state: int) -> "BoundSensor":
        """Arrays with one mode axis per chain, for a state of dimension n."""
        ...


@runtime_checkable
class BoundSensor(Sensor, Protocol):
    """A sensor of one model: what depends on chains is an array with mode axes, and broadcasts against states.

    A HybridModel keeps sensors in this form. LinearSensor is one, and every other that a filter linearises.
    """

    def at(self, t: float, observer: Observer | None = None) -> "BoundSensor":
        """The sensor at a time, with the observer of that time if it moves: nothing then depends on time."""
        ...

    def noise(self) -> FloatArray:
        """Noise covariance R, (M1|1, ..., MC|1, m, m), of a sensor at a time."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class LinearSensor:
    """A linear measurement.

    z = H x + d + v,  cov v = R

    Each may depend on chains and on `t` (see `saltus.models.dependence`).

    Args:
        H: (m, n).
        R: noise covariance, (m, m).
        d: offset, (m,); absent means 0.
        prob_detection: probability that an object present is reported.

    Raises:
        ModelError: shapes do not fit, or R is no covariance.
    """

    H: Matrix
    R: Matrix
    d: Matrix | None = None
    prob_detection: float = 1.0

    def __post_init__(self) -> None:
        put = object.__setattr__
        probability(self.prob_detection, "prob_detection")
        if is_fixed(self.H):
            put(self, "H", numbers(self.H, "LinearSensor H"))
            if np.ndim(fixed(self.H, "LinearSensor H")) < 2:
                raise ModelError(
                    f"LinearSensor H must be a matrix (m, n), got shape {np.shape(fixed(self.H, 'H'))}.\n"
                    "One measured component: H[None, :]."
                )
        if is_fixed(self.R):
            put(self, "R", covariance(self.R, "LinearSensor R"))
        if self.d is not None and is_fixed(self.d):
            put(self, "d", numbers(self.d, "LinearSensor d"))
        if is_fixed(self.H):
            m = fixed(self.H, "LinearSensor H").shape[-2]
            for name, value in (("R", self.R), ("d", self.d)):
                if value is not None and is_fixed(value) and np.shape(fixed(value, name))[-1:] != (m,):
                    expected = f"({m}, {m})" if name == "R" else f"({m},)"
                    raise ModelError(
                        f"LinearSensor {name} must have shape {expected} to go with H, "
                        f"got {np.shape(fixed(value, name))}."
                    )

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    def h(self, x: npt.ArrayLike) -> Float[np.ndarray, "*lead m"]:
        """Expected measurement H x + d of states (..., n)."""
        z: FloatArray = np.einsum("...mn,...n->...m", fixed(self.H, "LinearSensor H"), np.asarray(x, dtype=np.float64))
        return z if self.d is None else z + fixed(self.d, "LinearSensor d")

    def jacobian(self, x: npt.ArrayLike) -> Float[np.ndarray, "*lead m n"]:
        """H, for every state (..., n)."""
        H, lead = fixed(self.H, "LinearSensor H"), np.shape(x)[:-1]
        return np.broadcast_to(H, (*np.broadcast_shapes(H.shape[:-2], lead), *H.shape[-2:]))

    def residual(self, z: npt.ArrayLike, z_pred: npt.ArrayLike) -> Float[np.ndarray, "*lead m"]:
        """Plain difference."""
        return np.asarray(z, dtype=np.float64) - np.asarray(z_pred, dtype=np.float64)

    def bind(self, chains: Sequence[Chain], n_state: int) -> "LinearSensor":
        """Replace functions and tables by arrays with one mode axis per chain."""
        H = resolve(self.H, chains, "LinearSensor H", 2, ("t",))
        R = resolve(self.R, chains, "LinearSensor R", 2, ("t",))
        d = None if self.d is None else resolve(self.d, chains, "LinearSensor d", 1, ("t",))
        bound = replace(self, H=H, R=R, d=d)
        if not isinstance(H, TimeDependent) and H.shape[-1] != n_state:
            raise ModelError(f"LinearSensor H has {H.shape[-1]} columns, but the state has {n_state} components.")
        return bound

    def at(self, t: float, observer: Observer | None = None) -> "LinearSensor":
        """The sensor at one time; it has no observer."""
        if observer is not None:
            raise ModelError("a linear sensor has no observer: leave it out, or put its place into the offset d.")
        if not any(isinstance(value, TimeDependent) for value in (self.H, self.R, self.d)):
            return self
        d = None if self.d is None else at_time(self.d, t)
        return replace(self, H=at_time(self.H, t), R=at_time(self.R, t), d=d)

    def noise(self) -> FloatArray:
        """Noise covariance R with mode axes."""
        return fixed(self.R, "LinearSensor R")

    def measured(self, t: FloatArray | None) -> Measured:
        """Matrices of a bound sensor; one per time (T,) where a function asks for `t`."""
        d = None if self.d is None else _at(self.d, "LinearSensor d", t)
        H, R = _at(self.H, "LinearSensor H", t), _at(self.R, "LinearSensor R", t)
        return Measured(H, covariance(R, "LinearSensor R"), d)


@dataclass(frozen=True, slots=True, eq=False)
class PositionSensor:
    """Position along each axis, of a state ordered axis by axis with the position first.

    z = (x, y, ...) + v,  cov v = diag(sigma^2)

    Args:
        dims: number of axes.
        sigma: standard deviation, m, for all axes or per axis (dims,); may depend on chains.
        prob_detection: probability that an object present is reported.

    Raises:
        ModelError: sigma is not positive or does not fit the number of axes.
    """

    dims: int
    sigma: Matrix
    prob_detection: float = 1.0

    def __post_init__(self) -> None:
        probability(self.prob_detection, "prob_detection")
        axes("axes", self.dims)
        if is_fixed(self.sigma):
            object.__setattr__(self, "sigma", self._positive(numbers(self.sigma, "PositionSensor sigma")))

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    @property
    def R(self) -> Float[np.ndarray, "*lead m m"]:
        """Noise covariance diag(sigma^2)."""
        return self._covariance(fixed(self.sigma, "PositionSensor sigma"))

    def h(self, x: npt.ArrayLike) -> Float[np.ndarray, "*lead m"]:
        """Positions of states (..., n)."""
        state = np.asarray(x, dtype=np.float64)
        return state[..., :: self._stride(state.shape[-1])]

    def jacobian(self, x: npt.ArrayLike) -> Float[np.ndarray, "*lead m n"]:
        """Rows of the unit matrix, for every state (..., n)."""
        *lead, n = np.shape(x)
        return np.broadcast_to(self._rows(n), (*lead, self.dims, n))

    def residual(self, z: npt.ArrayLike, z_pred: npt.ArrayLike) -> Float[np.ndarray, "*lead m"]:
        """Plain difference."""
        return np.asarray(z, dtype=np.float64) - np.asarray(z_pred, dtype=np.float64)

    def bind(self, chains: Sequence[Chain], n_state: int) -> LinearSensor:
        """The linear sensor this is, for a state of dimension n."""
        sigma = fixed(resolve(self.sigma, chains, "PositionSensor sigma", (self.dims,)), "sigma")
        R = self._covariance(self._positive(sigma))
        return LinearSensor(self._rows(n_state), R, None, self.prob_detection).bind(chains, n_state)

    def _positive(self, sigma: FloatArray) -> FloatArray:
        if sigma.ndim < 2 and sigma.shape not in ((), (1,), (self.dims,)):
            raise ModelError(
                f"PositionSensor sigma must be a number or one per axis ({self.dims},), got {sigma.shape}."
            )
        if sigma.size and sigma.min() <= 0:
            raise ModelError(f"PositionSensor sigma must be positive metres, got {sigma.min():g}.")
        return sigma

    def _covariance(self, sigma: FloatArray) -> FloatArray:
        sigma = np.broadcast_to(sigma, (*sigma.shape[:-1], self.dims))
        return sigma[..., :, None] ** 2 * np.eye(self.dims)

    def _stride(self, n: int) -> int:
        if n % self.dims:
            raise ModelError(
                f"PositionSensor over {self.dims} axes does not fit a state of {n} components; "
                "use LinearSensor with an explicit H."
            )
        return n // self.dims

    def _rows(self, n: int) -> FloatArray:
        return np.asarray(np.eye(n)[:: self._stride(n)])


def at_time(value: Matrix, t: float) -> Matrix:
    """Evaluate a bound value that may depend on time at one time: (M1|1, ..., MC|1, *core)."""
    return value.at(np.array([t]), np.zeros(1))[0] if isinstance(value, TimeDependent) else value


def _at(value: Matrix, what: str, t: FloatArray | None) -> FloatArray:
    if isinstance(value, TimeDependent):
        return value.at(t, np.zeros(1 if t is None else len(t)))
    return fixed(value, what)
