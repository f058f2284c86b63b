"""Trajectories made of legs: straight, turning, accelerating, climbing; exact at any time."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError

__all__ = ["Leg", "Motion", "Trajectory", "coordinated_turn", "radar_paper_trajectory"]

Array = npt.NDArray[np.float64]


class Motion(NamedTuple):
    """A trajectory sampled at T times; NaN and False where the object is not there."""

    time: Array  # (T,), s
    position: Array  # (T, 3): x, y, altitude, m
    velocity: Array  # (T, 3), m/s
    turning: npt.NDArray[np.bool_]  # (T,): the leg up to this time turns or changes speed
    climbing: npt.NDArray[np.bool_]  # (T,): the leg up to this time accelerates vertically


@dataclass(frozen=True, slots=True)
class Leg:
    """A stretch of constant turn rate, acceleration along the course and vertical acceleration.

    `climb` sets the vertical rate (m/s) at the leg's beginning; None goes on with the rate there is.

    Raises:
        ModelError: a value is not finite, or the duration is not positive.
    """

    duration: float  # s
    turn_rate: float = 0.0  # rad/s, to the right positive
    acceleration: float = 0.0  # m/s^2, along the course
    climb: float | None = None  # m/s, up positive
    climb_acceleration: float = 0.0  # m/s^2

    def __post_init__(self) -> None:
        """Refuse what cannot be flown."""
        values = (self.duration, self.turn_rate, self.acceleration, self.climb or 0.0, self.climb_acceleration)
        if not np.all(np.isfinite(values)) or self.duration <= 0.0:
            raise ModelError(f"a leg needs finite values and a duration above 0 s, got {self}.")


def coordinated_turn(angle: float, lateral_acceleration: float, speed: float, climb: float | None = None) -> Leg:
    """Return the leg that turns by an angle (rad, right positive) at a lateral acceleration (m/s^2) and speed (m/s).

    rate = acceleration / speed.

    Raises:
        ModelError: angle, acceleration or speed is zero.
    """
    if angle == 0.0 or lateral_acceleration == 0.0 or speed <= 0.0:
        raise ModelError(
            f"a turn needs an angle, a lateral acceleration and a speed, got {angle}, {lateral_acceleration}, {speed}."
        )
    rate = np.copysign(lateral_acceleration / speed, angle)
    return Leg(float(angle / rate), turn_rate=float(rate), climb=climb)


@dataclass(frozen=True, slots=True)
class Trajectory:
    """An object's way: where it starts, and the legs it flies one after the other.

    Positions are x east, y north (of a plane) and altitude; the course counts from y, clockwise.

    Raises:
        ModelError: there is no leg, or a value is not finite.
    """

    position: tuple[float, float, float]  # m
    course: float  # rad
    speed: float  # m/s
    legs: tuple[Leg, ...]
    climb: float = 0.0  # m/s
    start: float = 0.0  # s

    def __post_init__(self) -> None:
        """Refuse what is not a trajectory."""
        if not self.legs:
            raise ModelError("a trajectory needs at least one leg: Trajectory(..., legs=(Leg(60.0),)).")
        if not np.all(np.isfinite((*self.position, self.course, self.speed, self.climb, self.start))):
            raise ModelError(f"a trajectory must start at finite values, got {self}.")

    @property
    def end(self) -> float:
        """Time at which the last leg ends, s."""
        return self.start + sum(leg.duration for leg in self.legs)

    def at(self, times: npt.ArrayLike) -> Motion:
        """Sample at any times (T,), in s; a time between two legs belongs to the earlier one."""
        t = np.asarray(times, np.float64).reshape(-1)
        knots, starts = self._knots()
        leg = np.clip(np.searchsorted(knots, t, side="left") - 1, 0, len(self.legs) - 1)
        position, velocity = _fly(starts[leg], t - knots[leg])
        there = (t >= self.start) & (t <= knots[-1])
        turning = np.array([x.turn_rate != 0.0 or x.acceleration != 0.0 for x in self.legs])[leg]
        climbing = np.array([x.climb_acceleration != 0.0 for x in self.legs])[leg]
        absent = np.where(there, 0.0, np.nan)[:, None]
        return Motion(t, position + absent, velocity + absent, turning & there, climbing & there)

    def _knots(self) -> tuple[Array, Array]:
        """Times of the legs' beginnings and the last end; state and rates at each beginning."""
        knots = self.start + np.cumsum([0.0, *(leg.duration for leg in self.legs)])
        x, y, z = self.position
        course, speed, climb = self.course, self.speed, self.climb
        starts = []
        for leg in self.legs:
            climb = climb if leg.climb is None else leg.climb
            row = [x, y, z, course, speed, climb, leg.turn_rate, leg.acceleration, leg.climb_acceleration]
            starts.append(row)
            (x, y, z), (_, _, climb) = (v[0] for v in _fly(np.array([row]), np.array([leg.duration])))
            course += leg.turn_rate * leg.duration
            speed += leg.acceleration * leg.duration
        return knots, np.array(starts)


def _fly(state: Array, t: Array) -> tuple[Array, Array]:
    """Position and velocity after t seconds of constant rates.

    With north + i east as a complex number, c the course, w the turn rate and theta = w t:
    p(t) = p(0) + e^{ic} (v t E0(theta) + a t^2 E1(theta)),  Ek = integral over [0, 1] of u^k e^{i theta u}.
    """
    x, y, z, course, speed, climb, rate, accel, climb_accel = state.T
    theta = rate * t
    heading = np.exp(1j * course)
    step = heading * (speed * t * _e0(theta) + accel * t**2 * _e1(theta))
    v = (speed + accel * t) * heading * np.exp(1j * theta)
    position = np.stack([x + step.imag, y + step.real, z + climb * t + climb_accel * t**2 / 2], axis=-1)
    return position, np.stack([v.imag, v.real, climb + climb_accel * t], axis=-1)


def _e0(theta: Array) -> npt.NDArray[np.complex128]:
    return np.asarray(np.exp(0.5j * theta) * np.sinc(theta / (2.0 * np.pi)))


def _e1(theta: Array) -> npt.NDArray[np.complex128]:
    # By parts; for small angles by the series, which does not cancel.
    small = np.abs(theta) < 0.5
    turn = 1j * np.where(small, 1.0, theta)
    closed = (np.exp(turn) - (np.exp(turn) - 1.0) / turn) / turn
    term, series = np.ones_like(turn), np.full_like(turn, 0.5)
    for k in range(1, 14):
        term = term * 1j * np.where(small, theta, 0.0) / k
        series = series + term / (k + 2)
    return np.where(small, series, closed)


def radar_paper_trajectory() -> Motion:
    """Return the published radar example's trajectory at its 81 scans, 10 s apart.

    A start at (195, 142, 9) km, 600 m/s; coordinated turns of 143 degrees at 30 m/s^2 in the intervals ending at
    scans 33-37 (left) and 62-66 (right); vertical acceleration of 20 m/s^2 in those ending at 18-21 (+ - - +) and
    48-51 (- + + -): two kilometres up, later down, and back. Otherwise straight and level.

    Source: Zhuk, Kozheshkurt, Yuzefovich (2009), Fig. 3 (drawn only; the numbers are ours).
    """
    period, accel, rate = 10.0, 20.0, 0.05
    up_and_back = tuple(Leg(period, climb_acceleration=sign * accel) for sign in (1, -1, -1, 1))
    down_and_back = tuple(Leg(period, climb_acceleration=-leg.climb_acceleration) for leg in up_and_back)
    legs = (
        Leg(17 * period),
        *up_and_back,
        Leg(11 * period),
        Leg(5 * period, turn_rate=-rate),
        Leg(10 * period),
        *down_and_back,
        Leg(10 * period),
        Leg(5 * period, turn_rate=rate),
        Leg(14 * period),
    )
    course = np.radians(90.0 - 214.0)  # 214 degrees counter-clockwise from x
    way = Trajectory((195e3, 142e3, 9e3), float(course), 600.0, legs)
    return way.at(period * np.arange(81))
