"""Motion along each axis of space, with closed forms over any interval: constant velocity, acceleration, Singer.

Constant velocity may turn in the plane of the first two axes. State order: the axes one after another, per axis
position, velocity (, acceleration): (x, vx, y, vy).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import factorial
from typing import Literal, NamedTuple

import numpy as np

from saltus.errors import ModelError
from saltus.models.chain import Chain
from saltus.models.checks import FloatArray, axes, intervals, numbers, same
from saltus.models.dependence import Matrix, fixed, is_fixed, resolve
from saltus.models.dynamics import LinearSDE, Step
from saltus.models.turning import turning

__all__ = ["ACCEL_TIME", "Motion", "constant_acceleration", "constant_velocity", "singer"]


ACCEL_TIME = 4.0  # s, that an acceleration lasts unless a model says otherwise


def constant_velocity(
    dims: int,
    accel: Matrix,
    kind: Literal["lasting", "white", "scan"] = "lasting",
    *,
    accel_time: Matrix | None = None,
    turn: Matrix | None = None,
) -> "Motion":
    """Constant velocity, disturbed by acceleration; state (x, vx) per axis.

    F = [[1, dt], [0, 1]];
    "lasting": Q = q [[dt^3/3, dt^2/2], [dt^2/2, dt]], q = accel^2 accel_time: accelerations that last a time, whatever
    the intervals between measurements;
    "white": the same with q = accel;
    "scan": Q = accel^2 g g', g = (dt^2/2, dt): acceleration constant within an interval, independent between them.

    The first two are consistent over divided intervals: a missed measurement, or a record without values, changes
    nothing. "scan" is not: over an interval of k periods it adds k times the variance of velocity that k intervals add,
    and ties velocity to position; it serves equal intervals. "lasting" adds as much to the velocity at dt = accel_time.
    With `turn`, the velocity turns besides, at a constant rate in the plane of the first two axes (`turning`).

    Args:
        dims: number of axes.
        accel: for all axes or per axis (dims,), and possibly depending on chains: standard deviation in m/s^2; for
            "white" the spectral density q in m^2/s^3.
        kind: the law of the acceleration.
        accel_time: of "lasting": s, for all axes or per axis, possibly depending on chains; by default `ACCEL_TIME`.
        turn: rate of turn, rad/s, from the second axis towards the first: to the right where x is east and y north;
            possibly depending on chains. Then the first two axes have equal acceleration.

    Raises:
        ModelError: accel is negative, or does not fit the number of axes; a turn without a plane to turn in; a time
            given for another kind.

    Source: Zhuk, Kozheshkurt and Yuzefovich (2009), horizontal and vertical models, for "scan".
    """
    if kind == "lasting":
        return Motion("velocity", dims, accel, ACCEL_TIME if accel_time is None else accel_time, turn)
    if kind not in ("scan", "white"):
        raise ModelError(f"constant_velocity: kind must be 'lasting', 'white' or 'scan', got {kind!r}.")
    if accel_time is not None:
        raise ModelError(f"constant_velocity: accel_time goes with kind='lasting', not with {kind!r}.")
    return Motion("velocity-scan" if kind == "scan" else "velocity-white", dims, accel, turn=turn)


def constant_acceleration(dims: int, jerk: Matrix) -> "Motion":
    """Constant acceleration, disturbed by white jerk; state (x, vx, ax) per axis.

    F = [[1, dt, dt^2/2], [0, 1, dt], [0, 0, 1]],  Q = jerk int_0^dt f f' ds,  f = (s^2/2, s, 1)

    Args:
        dims: number of axes.
        jerk: spectral density, m^2/s^5, for all axes or per axis (dims,), possibly depending on chains.

    Raises:
        ModelError: jerk is negative, or does not fit the number of axes.
    """
    return Motion("acceleration", dims, jerk)


def singer(dims: int, tau: Matrix, sigma: Matrix) -> "Motion":
    """Exponentially correlated acceleration; state (x, vx, ax) per axis.

    da = -a/tau dt + sigma sqrt(2/tau) dW: stationary, E a(t) a(t+s) = sigma^2 exp(-|s|/tau)

    Args:
        dims: number of axes.
        tau: correlation time, s, for all axes or per axis (dims,), possibly depending on chains.
        sigma: standard deviation of the acceleration, m/s^2, likewise.

    Raises:
        ModelError: tau is not positive, sigma negative, or they do not fit the number of axes.

    Source: Singer (1970); its covariance integrated anew, as power series where the closed form cancels.
    """
    return Motion("singer", dims, sigma, tau)


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """One law of motion for each of `dims` axes; made by constant_velocity, constant_acceleration or singer."""

    law: Literal["velocity", "velocity-white", "velocity-scan", "acceleration", "singer"]
    dims: int
    noise: Matrix
    tau: Matrix | None = None
    turn: Matrix | None = None

    def __post_init__(self) -> None:
        axes("axes", self.dims)
        words = _LAWS[self.law].words
        for field, word in (("noise", words[0]), ("tau", words[1])):
            value = getattr(self, field)
            if value is None or not is_fixed(value):
                continue
            array = numbers(value, word)
            if array.ndim < 2 and array.shape not in ((), (1,), (self.dims,)):
                raise ModelError(f"{word} must be a number or one per axis ({self.dims},), got {array.shape}.")
            if array.size and (array.min() < 0 or (field == "tau" and array.min() == 0)):
                sign = "positive" if field == "tau" else "not negative"
                raise ModelError(f"{word} must be {sign}, got {array.min():g}.")
            object.__setattr__(self, field, array)
        if self.turn is not None:
            self._check_turn()

    def _check_turn(self) -> None:
        if self.dims < 2:
            raise ModelError(f"a turn needs a plane: dims must be 2 or more, got {self.dims}.")
        if is_fixed(self.turn):
            object.__setattr__(self, "turn", numbers(self.turn, "turn"))
        for value, word in zip((self.noise, self.tau), _LAWS[self.law].words, strict=True):
            if value is not None and is_fixed(value):
                level = np.asarray(value)
                if level.ndim and level.shape[-1] > 1 and not np.array_equal(level[..., 0], level[..., 1]):
                    raise ModelError(f"{word} must be equal on the first two axes, in whose plane the velocity turns.")

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    def dimension(self) -> int:
        """Dimension of the state."""
        return self.dims * _LAWS[self.law].order

    def bind(self, chains: Sequence[Chain]) -> "Motion":
        """Replace functions and tables by arrays with one mode axis per chain."""
        noise_word, tau_word = _LAWS[self.law].words
        noise = resolve(self.noise, chains, noise_word, (self.dims,))
        tau = None if self.tau is None else resolve(self.tau, chains, tau_word, (self.dims,))
        turn = None if self.turn is None else resolve(self.turn, chains, "turn", ())
        return replace(self, noise=noise, tau=tau, turn=turn)

    def step(self, dt: FloatArray, t: FloatArray | None = None) -> Step:
        """Matrices over intervals, in closed form."""
        law = _LAWS[self.law]
        noise, tau = self._parameters()
        axes = max(noise.ndim, tau.ndim)
        step = intervals(dt)
        step = step.reshape(*step.shape, *(1,) * axes)
        with np.errstate(over="ignore", invalid="ignore"):
            F, Q = (_blocks(block, self.dims) for block in law.blocks(step, noise, tau))
        if not (np.isfinite(F).all() and np.isfinite(Q).all()):
            raise ModelError(
                f"{self.law} motion over {np.max(step):g} s overflows double precision. dt is in seconds: check its "
                "unit."
            )
        if self.turn is not None:
            kind: Literal["scan", "white"] = "scan" if self.law == "velocity-scan" else "white"
            level = _density(noise, tau) if self.law == "velocity" else noise
            plane = turning(step[..., 0], fixed(self.turn, "turn"), level[..., 0], kind)
            F, Q = (_with_plane(block, own) for block, own in zip((F, Q), plane, strict=True))
        return Step(F, Q, None)

    def sde(self) -> LinearSDE:
        """The same motion as a stochastic differential equation.

        Raises:
            ModelError: acceleration constant within a scan has none.
        """
        if self.law == "velocity-scan":
            raise ModelError(
                "acceleration constant within a scan is no white noise and has no stochastic differential equation.\n"
                "Use constant_velocity(..., kind='lasting')."
            )
        order = _LAWS[self.law].order
        noise, tau = self._parameters()
        shape = np.broadcast_shapes(noise.shape, tau.shape, (self.dims,))
        F, G = np.zeros((*shape, order, order)), np.zeros((*shape, order, 1))
        F[..., range(order - 1), range(1, order)] = 1.0
        if self.law == "singer":
            F[..., -1, -1] = -1 / tau
            G[..., -1, 0] = noise * np.sqrt(2 / tau)
        else:
            G[..., -1, 0] = np.sqrt(_density(noise, tau) if self.law == "velocity" else noise)
        drift, spread = _blocks(F, self.dims), _blocks(G, self.dims)
        if self.turn is not None:
            turn = fixed(self.turn, "turn")
            drift = np.broadcast_to(
                drift, (*np.broadcast_shapes(drift.shape[:-2], turn.shape), *drift.shape[-2:])
            ).copy()
            drift[..., 1, 3], drift[..., 3, 1] = turn, -turn
        return LinearSDE(drift, spread)

    def _parameters(self) -> tuple[FloatArray, FloatArray]:
        noise_word, tau_word = _LAWS[self.law].words
        noise = fixed(self.noise, noise_word)
        tau = np.ones(1) if self.tau is None else fixed(self.tau, tau_word)
        return np.atleast_1d(noise), np.atleast_1d(tau)


def _blocks(block: FloatArray, dims: int) -> FloatArray:
    """Block-diagonal matrices (..., dims rows, dims cols) from blocks (..., dims|1, rows, cols)."""
    rows, cols = block.shape[-2:]
    lead = block.shape[:-3]
    if dims == 1:
        return block[..., 0, :, :]
    result = np.zeros((*lead, dims, rows, dims, cols))
    for axis in range(dims):
        result[..., axis, :, axis, :] = block[..., axis % block.shape[-3], :, :]
    return result.reshape(*lead, dims * rows, dims * cols)


def _with_plane(block: FloatArray, plane: FloatArray) -> FloatArray:
    """Matrices (..., n, n) whose first two axes are replaced by (..., 4, 4)."""
    lead = np.broadcast_shapes(block.shape[:-2], plane.shape[:-2])
    result = np.broadcast_to(block, (*lead, *block.shape[-2:])).copy()
    result[..., :4, :4] = plane
    return result


def _matrix(rows: Sequence[Sequence[FloatArray | float]]) -> FloatArray:
    """Stack entries that broadcast against each other into matrices (..., rows, cols)."""
    shape = np.broadcast_shapes(*(np.shape(entry) for row in rows for entry in row))
    result = np.empty((*shape, len(rows), len(rows[0])))
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            result[..., i, j] = entry
    return result


def _density(accel: FloatArray, accel_time: FloatArray) -> FloatArray:
    """Spectral density of accelerations that last a time, m^2/s^3."""
    return accel**2 * accel_time


def _velocity(dt: FloatArray, accel: FloatArray, accel_time: FloatArray) -> tuple[FloatArray, FloatArray]:
    return _velocity_white(dt, _density(accel, accel_time), accel_time)


def _velocity_scan(dt: FloatArray, accel: FloatArray, _: FloatArray) -> tuple[FloatArray, FloatArray]:
    half = dt**2 / 2
    Q = _matrix([[half**2, half * dt], [half * dt, dt**2]]) * (accel**2)[..., None, None]
    return _matrix([[1.0, dt], [0.0, 1.0]]), Q


def _velocity_white(dt: FloatArray, density: FloatArray, _: FloatArray) -> tuple[FloatArray, FloatArray]:
    Q = _matrix([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) * density[..., None, None]
    return _matrix([[1.0, dt], [0.0, 1.0]]), Q


def _acceleration(dt: FloatArray, density: FloatArray, _: FloatArray) -> tuple[FloatArray, FloatArray]:
    Q = _matrix(
        [
            [dt**5 / 20, dt**4 / 8, dt**3 / 6],
            [dt**4 / 8, dt**3 / 3, dt**2 / 2],
            [dt**3 / 6, dt**2 / 2, dt],
        ]
    )
    return _matrix([[1.0, dt, dt**2 / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]]), Q * density[..., None, None]


def _singer(dt: FloatArray, sigma: FloatArray, tau: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Each entry is a power of dt times a function of u = dt/tau that tends to the constant-acceleration value."""
    u = dt / tau
    f13, p11, p12, p13, p22 = (_entire(u, entry) for entry in _SINGER)
    f23 = -np.expm1(-u) * tau
    p23, p33 = f23**2 / 2, -np.expm1(-2 * u) * tau / 2
    F = _matrix([[1.0, dt, f13 * dt**2], [0.0, 1.0, f23], [0.0, 0.0, np.exp(-u)]])
    p11, p12, p13, p22 = p11 * dt**5, p12 * dt**4, p13 * dt**3, p22 * dt**3
    Q = _matrix([[p11, p12, p13], [p12, p22, p23], [p13, p23, p33]])
    return F, Q * (2 * sigma**2 / tau)[..., None, None]


class _Entire(NamedTuple):
    """u^-power sum_k c_k u^k: the coefficients, and a closed form that is safe for u > 1."""

    power: int
    coefficient: Callable[[int], float]
    closed: Callable[[FloatArray], FloatArray]


# With e = exp(-u); each is the integral over (0, dt) of two rows of the impulse response
# ((u - 1 + e)/a^2, (1 - e)/a, e), a = 1/tau, divided by dt^power.
_SINGER = (
    _Entire(2, lambda k: (-1.0) ** k / factorial(k), lambda u: u + np.expm1(-u)),
    _Entire(
        5,
        lambda k: (-1.0) ** k * (4 * k - 2**k) / factorial(k) / 2,
        lambda u: (1 - np.exp(-2 * u) + 2 * u + 2 * u**3 / 3 - 2 * u**2 - 4 * u * np.exp(-u)) / 2,
    ),
    _Entire(
        4,
        lambda k: (-1.0) ** k * (2**k - 2 - 2 * k) / factorial(k) / 2,
        lambda u: (np.exp(-2 * u) + 1 - 2 * np.exp(-u) + 2 * u * np.exp(-u) - 2 * u + u**2) / 2,
    ),
    _Entire(
        3,
        lambda k: (-1.0) ** k * (2 * k - 2**k) / factorial(k) / 2,
        lambda u: (1 - np.exp(-2 * u) - 2 * u * np.exp(-u)) / 2,
    ),
    _Entire(
        3,
        lambda k: (-1.0) ** k * (4 - 2**k) / factorial(k) / 2,
        lambda u: (4 * np.exp(-u) - 3 - np.exp(-2 * u) + 2 * u) / 2,
    ),
)


def _entire(u: FloatArray, entry: _Entire) -> FloatArray:
    small, large = np.minimum(u, 1.0), np.maximum(u, 1.0)
    series = np.zeros_like(u)
    for k in range(entry.power + 26, entry.power - 1, -1):  # 2^30/30! < 1e-23 is dropped
        series = series * small + entry.coefficient(k)
    return np.where(u <= 1.0, series, entry.closed(large) / large**entry.power)


class _Law(NamedTuple):
    order: int  # states per axis
    words: tuple[str, str]  # what messages call `noise` and `tau`
    blocks: Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]


_LAWS = {
    "velocity": _Law(2, ("accel", "accel_time"), _velocity),
    "velocity-white": _Law(2, ("accel", ""), _velocity_white),
    "velocity-scan": _Law(2, ("accel", ""), _velocity_scan),
    "acceleration": _Law(3, ("jerk", ""), _acceleration),
    "singer": _Law(3, ("sigma", "tau"), _singer),
}
