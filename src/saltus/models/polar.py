"""What radars and passive sensors measure: range, azimuth, elevation, range rate.

Azimuth counts from north, clockwise, where the first two axes of the state are east and north: atan2(east, north).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import index
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError, NumericalError
from saltus.geo import wrap
from saltus.models.chain import Chain
from saltus.models.checks import FloatArray, numbers, probability, same
from saltus.models.dependence import Matrix, fixed, is_fixed, resolve
from saltus.models.nonlinear import checked_offset, wrapped_difference
from saltus.models.observer import Observer
from saltus.models.sensors import at_time
from saltus.shapes import Float

__all__ = ["PolarSensor"]

_COMPONENTS = ("range", "azimuth", "elevation", "range_rate")
_ANGLES = ("azimuth", "elevation")


class _Sight(NamedTuple):
    """The line of sight from the observer to the state's position."""

    line: FloatArray  # (..., dims), m
    level: FloatArray  # (...,), its length over the ground
    length: FloatArray  # (...,)
    motion: FloatArray  # (..., dims), m/s relative to the observer; 0 where no range rate is measured


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PolarSensor:
    """Range, azimuth, elevation and range rate of an object, as many of them as have a standard deviation.

    With d = p - p_observer and w = v - v_observer, the measurement is, in this order,

        range = |d|,   azimuth = atan2(d_east, d_north) - heading,   elevation = atan2(d_up, |d_east, d_north|),
        range rate = d . w / |d|,

    plus `offset`, plus noise with cov v = diag(sigma^2). Range and azimuth make a radar; azimuth alone, or with
    elevation, a passive sensor. Every sigma and the offset may depend on chains and on `t`, each by itself
    (see `saltus.models.dependence`), so that a fault of the azimuth leaves the range alone.

    Args:
        sigma_range: m; in two dimensions the range is over the ground.
        sigma_azimuth: rad.
        sigma_elevation: rad; needs dims=3.
        sigma_range_rate: m/s, positive for an object that recedes; the state then has velocities.
        dims: axes of space, 2 (east, north) or 3 (east, north, up).
        axes: indices of the position components in the state; absent means a state ordered axis by axis, as in
            constant_velocity.
        velocities: indices of the velocity components; absent means that each follows its position.
        observer: where the sensor stands; absent means at the origin, at rest, heading north.
        offset: bias of the measured components, (m,), in m, rad, m/s; absent means 0.
        prob_detection: probability that an object present is reported.

    Raises:
        ModelError: nothing is measured, a sigma is not positive, or dims, axes and observer do not go together.
    """

    sigma_range: Matrix | None = None
    sigma_azimuth: Matrix | None = None
    sigma_elevation: Matrix | None = None
    sigma_range_rate: Matrix | None = None
    dims: int = 2
    axes: tuple[int, ...] | None = None
    velocities: tuple[int, ...] | None = None
    observer: Observer | None = None
    offset: Matrix | None = None
    prob_detection: float = 1.0

    def __post_init__(self) -> None:
        put = object.__setattr__
        probability(self.prob_detection, "prob_detection")
        if not isinstance(self.dims, int | np.integer) or self.dims not in (2, 3):
            raise ModelError(f"PolarSensor dims must be 2 (east, north) or 3 (east, north, up), got {self.dims!r}.")
        if not self.components:
            raise ModelError("PolarSensor measures nothing: give sigma_range, sigma_azimuth, ... of what it measures.")
        if self.sigma_elevation is not None and self.dims == 2:
            raise ModelError("PolarSensor measures elevation only in three dimensions: pass dims=3.")
        for name, places in (("axes", self.axes), ("velocities", self.velocities)):
            if places is not None:
                try:
                    put(self, name, tuple(index(i) for i in places))
                except TypeError:
                    told = f"PolarSensor {name} must be {self.dims} different indices, got {places!r}."
                    raise ModelError(told) from None
                if len(set(places)) != self.dims or len(places) != self.dims or min(places) < 0:
                    raise ModelError(f"PolarSensor {name} must be {self.dims} different indices, got {places}.")
        if self.observer is not None and np.shape(self.observer.position)[-1] != self.dims:
            raise ModelError(
                f"the observer's position has {np.shape(self.observer.position)[-1]} components, "
                f"but PolarSensor works in {self.dims} (dims={self.dims})."
            )
        for name, given in self._sigmas().items():
            if is_fixed(given):
                sigma = numbers(given, f"PolarSensor sigma_{name}")
                if sigma.size and sigma.min() <= 0:
                    raise ModelError(f"PolarSensor sigma_{name} must be positive, got {sigma.min():g}.")
                put(self, f"sigma_{name}", sigma)
        if self.offset is not None and is_fixed(self.offset):
            put(self, "offset", checked_offset(self.offset, len(self.components), "PolarSensor"))

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    @property
    def components(self) -> tuple[str, ...]:
        """Names of what is measured, in order."""
        return tuple(self._sigmas())

    @property
    def R(self) -> Float[np.ndarray, "*lead m m"]:
        """Noise covariance diag(sigma^2), with the mode axes of the sigmas."""
        sigmas = [fixed(sigma, f"PolarSensor sigma_{name}") for name, sigma in self._sigmas().items()]
        sigma = np.stack(np.broadcast_arrays(*sigmas), axis=-1)
        return np.asarray(sigma[..., :, None] ** 2 * np.eye(len(sigmas)))

    def h(self, x: npt.ArrayLike) -> Float[np.ndarray, "*lead m"]:
        """Expected measurement of states (..., n)."""
        sight = self._sight(np.asarray(x, dtype=np.float64))
        z = np.stack([self._expected(name, sight) for name in self.components], axis=-1)
        return z if self.offset is None else z + fixed(self.offset, "PolarSensor offset")

    def jacobian(self, x: npt.ArrayLike) -> Float[np.ndarray, "*lead m n"]:
        """Derivative of h at states (..., n).

        Raises:
            NumericalError: a position coincides with the observer, or is straight above it where angles are measured.
        """
        state = np.asarray(x, dtype=np.float64)
        sight = self._sight(state)
        angles = any(name in _ANGLES for name in self.components)
        if not ((sight.level if angles else sight.length) > 0).all():
            raise NumericalError(
                "an expected position coincides with the observer (or stands straight above it), where directions "
                "have no derivative. Start from a prior whose mean lies away from the observer."
            )
        at = self._indices(state.shape[-1])
        J = np.zeros((*sight.length.shape, len(self.components), state.shape[-1]))
        for row, name in enumerate(self.components):
            by_position, by_velocity = _derivative(name, sight)
            J[..., row, at] = by_position
            if by_velocity is not None:
                J[..., row, self._moving(at)] = by_velocity
        return J

    def residual(self, z: npt.ArrayLike, z_pred: npt.ArrayLike) -> Float[np.ndarray, "*lead m"]:
        """Difference of measurements, angles in [-pi, pi)."""
        return wrapped_difference(z, z_pred, [i for i, name in enumerate(self.components) if name in _ANGLES])

    def bind(self, chains: Sequence[Chain], n_state: int) -> "PolarSensor":
        """Replace functions and tables by arrays with one mode axis per chain."""
        at = self._indices(n_state)
        moving = self._moving(at)
        if self.sigma_range_rate is not None and (set(at) & set(moving) or max(moving) >= n_state):
            raise ModelError(
                f"PolarSensor measures range rate, but a state of {n_state} components with positions at {at} has no "
                f"velocities at {moving}; say where they are: velocities=(1, 3)."
            )
        bound: dict[str, Any] = {
            f"sigma_{name}": resolve(sigma, chains, f"PolarSensor sigma_{name}", (), ("t",))
            for name, sigma in self._sigmas().items()
        }
        if self.offset is not None:
            core = (len(self.components),)
            bound["offset"] = resolve(self.offset, chains, "PolarSensor offset", core, ("t",))
        return replace(self, **bound)

    def at(self, t: float, observer: Observer | None = None) -> "PolarSensor":
        """The bound sensor at a time, seen from `observer` if one is given."""
        values = {f"sigma_{name}": sigma for name, sigma in self._sigmas().items()} | {"offset": self.offset}
        moved: dict[str, Any] = {k: at_time(v, t) for k, v in values.items() if v is not None and not is_fixed(v)}
        if observer is not None:
            moved["observer"] = observer
        return replace(self, **moved) if moved else self

    def noise(self) -> FloatArray:
        """Noise covariance R with mode axes."""
        return self.R

    def _sigmas(self) -> dict[str, Matrix]:
        given = (self.sigma_range, self.sigma_azimuth, self.sigma_elevation, self.sigma_range_rate)
        return {name: sigma for name, sigma in zip(_COMPONENTS, given, strict=True) if sigma is not None}

    def _indices(self, n: int) -> list[int]:
        if self.axes is None and n % self.dims:
            raise ModelError(
                f"PolarSensor over {self.dims} axes does not fit a state of {n} components ordered axis by axis; "
                "say which are positions: axes=(0, 2)."
            )
        at = list(self.axes) if self.axes is not None else list(range(0, n, n // self.dims))
        if max(at) >= n:
            raise ModelError(f"PolarSensor axes {self.axes} do not fit a state of {n} components.")
        return at

    def _moving(self, at: list[int]) -> list[int]:
        return [i + 1 for i in at] if self.velocities is None else list(self.velocities)

    def _sight(self, state: FloatArray) -> _Sight:
        at = self._indices(state.shape[-1])
        line = state[..., at]
        motion = np.zeros_like(line) if self.sigma_range_rate is None else state[..., self._moving(at)]
        if self.observer is not None:
            line = line - np.asarray(self.observer.position)
            motion = motion - (0.0 if self.observer.velocity is None else np.asarray(self.observer.velocity))
        level = np.asarray(np.hypot(line[..., 0], line[..., 1]))
        length = level if self.dims == 2 else np.asarray(np.hypot(level, line[..., 2]))
        return _Sight(line, level, length, motion)

    def _expected(self, name: str, sight: _Sight) -> FloatArray:
        line = sight.line
        if name == "range":
            return sight.length
        if name == "elevation":
            return np.asarray(np.arctan2(line[..., 2], sight.level))
        if name == "range_rate":
            return np.asarray((line * sight.motion).sum(-1) / sight.length)
        azimuth = np.arctan2(line[..., 0], line[..., 1])
        return np.asarray(azimuth if self.observer is None else wrap(azimuth - np.asarray(self.observer.heading)))


def _derivative(name: str, sight: _Sight) -> tuple[FloatArray, FloatArray | None]:
    """Derivatives of one component by position (..., dims) and by velocity."""
    line, level, length = sight.line, sight.level[..., None], sight.length[..., None]
    if name == "range":
        return line / length, None
    if name == "azimuth":
        across = np.stack([line[..., 1], -line[..., 0]], axis=-1) / level**2
        return np.concatenate([across, np.zeros_like(line[..., 2:])], axis=-1), None
    if name == "elevation":
        return np.concatenate([-line[..., :2] * line[..., 2:] / level, level], axis=-1) / length**2, None
    rate = (line * sight.motion).sum(-1, keepdims=True) / length
    return sight.motion / length - rate * line / length**2, line / length
