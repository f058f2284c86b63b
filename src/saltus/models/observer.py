"""Where a sensor stands and where it looks, in the frame of the state."""

from dataclasses import dataclass

import numpy.typing as npt

from saltus.errors import ModelError
from saltus.models.checks import numbers, same

__all__ = ["Observer"]


@dataclass(frozen=True, slots=True, eq=False)
class Observer:
    """Position, velocity and heading of a sensor, at the time of a measurement.

    Args:
        position: m east, north(, up) of the state's origin, (dims,). Leading axes, where there are any, broadcast
            against those of the states.
        velocity: m/s, like position; absent means at rest. Only a range rate depends on it.
        heading: direction from which the sensor counts azimuth, rad clockwise from north, () or leading axes.
            0 where azimuths count from north already.

    Raises:
        ModelError: a number is not finite, or the shapes do not fit.
    """

    position: npt.ArrayLike
    velocity: npt.ArrayLike | None = None
    heading: npt.ArrayLike = 0.0

    def __post_init__(self) -> None:
        put = object.__setattr__
        position = numbers(self.position, "Observer position")
        if not position.ndim or position.shape[-1] not in (2, 3):
            raise ModelError(
                f"Observer position must be (2,) or (3,): east, north(, up) in m; got shape {position.shape}."
            )
        put(self, "position", position)
        put(self, "heading", numbers(self.heading, "Observer heading"))
        if self.velocity is None:
            return
        velocity = numbers(self.velocity, "Observer velocity")
        if velocity.shape[-1:] != position.shape[-1:]:
            raise ModelError(
                f"Observer velocity must have the components of position, got {velocity.shape} and {position.shape}."
            )
        put(self, "velocity", velocity)

    def __eq__(self, other: object) -> bool:
        return same(self, other)
