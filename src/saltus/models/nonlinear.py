"""Sensors that measure a function of the state of your own, and what all nonlinear sensors share."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.geo import wrap
from saltus.models.chain import Chain
from saltus.models.checks import FloatArray, covariance, numbers, probability, same
from saltus.models.dependence import Matrix, fixed, is_fixed, resolve
from saltus.models.observer import Observer
from saltus.models.sensors import at_time
from saltus.shapes import Float

__all__ = ["FunctionSensor", "checked_offset", "wrapped_difference"]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FunctionSensor:
    """Any function of the state.

    z = function(x) + offset + v,  cov v = R

    Args:
        function: takes states (..., n), returns (..., m); it is called with any leading axes. Models that are to be
            pickled need a function with a name of its own, not a lambda.
        R: noise covariance, (m, m); may depend on chains and on `t` (see `saltus.models.dependence`).
        derivative: takes states (..., n), returns (..., m, n); absent, central differences are taken.
        angles: components in rad whose differences are wrapped.
        offset: bias, (m,); may depend on chains and on `t`; absent means 0.
        scale: steps of the differences, relative to each state's size or 1, whichever is larger.
        prob_detection: probability that an object present is reported.

    Raises:
        ModelError: R is no covariance, or shapes do not fit.
    """

    function: Callable[[FloatArray], npt.ArrayLike]
    R: Matrix
    derivative: Callable[[FloatArray], npt.ArrayLike] | None = None
    angles: tuple[int, ...] = ()
    offset: Matrix | None = None
    scale: float = 1e-5
    prob_detection: float = 1.0

    def __post_init__(self) -> None:
        put = object.__setattr__
        probability(self.prob_detection, "prob_detection")
        put(self, "angles", tuple(self.angles))
        if is_fixed(self.R):
            R = covariance(self.R, "FunctionSensor R")
            put(self, "R", R)
            if self.offset is not None and is_fixed(self.offset):
                put(self, "offset", checked_offset(self.offset, R.shape[-1], "FunctionSensor"))
            if self.angles and not 0 <= min(self.angles) <= max(self.angles) < R.shape[-1]:
                raise ModelError(f"FunctionSensor angles {self.angles} are not among {R.shape[-1]} components.")

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    def h(self, x: npt.ArrayLike) -> Float[np.ndarray, "*lead m"]:
        """Expected measurement of states (..., n)."""
        state = np.asarray(x, dtype=np.float64)
        z = np.asarray(self.function(state), dtype=np.float64)
        m = fixed(self.R, "FunctionSensor R").shape[-1] if is_fixed(self.R) else z.shape[-1]
        if z.shape != (*state.shape[:-1], m):
            raise ModelError(
                f"FunctionSensor function returned shape {z.shape} for states {state.shape}; it must keep leading axes "
                f"and return as many components as R has: {(*state.shape[:-1], m)}."
            )
        return z if self.offset is None else z + fixed(self.offset, "FunctionSensor offset")

    def jacobian(self, x: npt.ArrayLike) -> Float[np.ndarray, "*lead m n"]:
        """Derivative of h at states (..., n): the one given, or central differences."""
        state = np.asarray(x, dtype=np.float64)
        if self.derivative is not None:
            return np.asarray(self.derivative(state), dtype=np.float64)
        n = state.shape[-1]
        step = self.scale * np.maximum(np.abs(state), 1.0)
        moves = np.moveaxis(step[..., None] * np.eye(n), -1, 0)  # (n, ..., n)
        change = self.residual(self.h(state + moves), self.h(state - moves))
        return np.asarray(np.moveaxis(change, 0, -1) / (2 * step[..., None, :]))

    def residual(self, z: npt.ArrayLike, z_pred: npt.ArrayLike) -> Float[np.ndarray, "*lead m"]:
        """Difference of measurements, angles in [-pi, pi)."""
        return wrapped_difference(z, z_pred, self.angles)

    def bind(self, chains: Sequence[Chain], n_state: int) -> "FunctionSensor":
        """Replace functions of chains by arrays with one mode axis per chain."""
        del n_state
        R = resolve(self.R, chains, "FunctionSensor R", 2, ("t",))
        offset = None
        if self.offset is not None:
            offset = resolve(self.offset, chains, "FunctionSensor offset", 1, ("t",))
        return replace(self, R=R, offset=offset)

    def at(self, t: float, observer: Observer | None = None) -> "FunctionSensor":
        """The bound sensor at a time; it has no observer."""
        if observer is not None:
            raise ModelError("FunctionSensor has no observer: use PolarSensor, or a sensor class of your own.")
        if is_fixed(self.R) and (self.offset is None or is_fixed(self.offset)):
            return self
        return replace(self, R=at_time(self.R, t), offset=None if self.offset is None else at_time(self.offset, t))

    def noise(self) -> FloatArray:
        """Noise covariance R with mode axes."""
        return fixed(self.R, "FunctionSensor R")


def wrapped_difference(z: npt.ArrayLike, z_pred: npt.ArrayLike, angles: Sequence[int]) -> FloatArray:
    """Difference of measurements (..., m), those components that are angles brought to [-pi, pi)."""
    change = np.asarray(z, dtype=np.float64) - np.asarray(z_pred, dtype=np.float64)
    if angles:
        at = list(angles)
        change[..., at] = wrap(change[..., at])
    return change


def checked_offset(offset: Matrix, m: int, what: str) -> FloatArray:
    """Refuse an offset that has not one finite entry per measured component."""
    array = numbers(offset, f"{what} offset")
    if array.shape[-1:] != (m,):
        raise ModelError(f"{what} offset must have one entry per measured component ({m},), got {array.shape}.")
    return array
