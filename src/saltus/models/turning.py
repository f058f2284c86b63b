"""Motion in a circle at a known rate: linear in position and velocity, with closed forms over any interval."""

from math import factorial
from typing import Literal

import numpy as np
import numpy.typing as npt

from saltus.models.checks import FloatArray

__all__ = ["turning"]

_TERMS = 12  # of the series for |u| <= 1: 1/27! < 1e-28 is dropped


def turning(
    dt: FloatArray, turn: FloatArray, noise: FloatArray, kind: Literal["scan", "white"]
) -> tuple[FloatArray, FloatArray]:
    """Return F and Q of the state (x, vx, y, vy) that turns clockwise at `turn`, x east and y north.

    With p = x + iy the motion is dp = v dt, dv = (i w v + a) dt, w = -turn. Over dt, u = w dt, and with
    s = sin(u)/u, c = (1 - cos u)/u^2, k = (u - sin u)/u^3 (their limits at u = 0):

        F = [[1, dt (s + iuc)], [0, exp(iu)]];
        "scan", a constant in the frame of the interval: Q = noise^2 g g*, g = (dt^2 (c + iuk), dt (s + iuc));
        "white": Q = noise [[2 dt^3 k, dt^2 (c - iuk)], [dt^2 (c + iuk), dt]];

    a complex entry alpha + i beta stands for [[alpha, -beta], [beta, alpha]] on the two axes. For turn = 0 it is
    constant velocity.

    Args:
        dt: intervals, s; broadcasts with `turn` and `noise`.
        turn: rate of turn, rad/s, positive to the right.
        noise: of each axis: standard deviation in m/s^2 ("scan") or spectral density in m^2/s^3 ("white").
        kind: the law of the acceleration besides the turn.

    Source: the coordinated turn with known rate; F and Q integrated here, the integrands being powers of s times
    exp(iws).
    """
    dt, turn, noise = np.broadcast_arrays(dt, turn, noise)
    u = np.asarray(-turn * dt)  # of no axes, arithmetic leaves a number
    s, c, k = np.sinc(u / np.pi), 0.5 * np.sinc(0.5 * u / np.pi) ** 2, _kappa(u)
    moved, zero = dt * (s + 1j * u * c), np.zeros_like(dt)
    F = _on_axes(np.ones_like(dt), moved, zero, np.exp(1j * u))
    if kind == "scan":
        far = dt**2 * (c + 1j * u * k)
        cross = far * moved.conj()
        Q = _on_axes(np.abs(far) ** 2, cross, cross.conj(), np.abs(moved) ** 2) * (noise**2)[..., None, None]
    else:
        cross = dt**2 * (c - 1j * u * k)
        Q = _on_axes(2 * dt**3 * k, cross, cross.conj(), dt) * noise[..., None, None]
    return F, Q


def _kappa(u: FloatArray) -> FloatArray:
    """Return (u - sin u)/u^3 without cancellation: sum_j (-1)^j u^(2j) / (2j + 3)! where |u| <= 1."""
    small, large = np.minimum(u**2, 1.0), np.maximum(np.abs(u), 1.0)
    series = np.zeros_like(u)
    for j in range(_TERMS - 1, -1, -1):
        series = series * small + (-1) ** j / factorial(2 * j + 3)
    return np.where(np.abs(u) <= 1.0, series, (large - np.sin(large)) / large**3)


def _on_axes(pp: npt.ArrayLike, pv: npt.ArrayLike, vp: npt.ArrayLike, vv: npt.ArrayLike) -> FloatArray:
    """Real matrices (..., 4, 4) over (x, vx, y, vy) from complex entries over (position, velocity)."""
    block = np.stack([pp, pv, vp, vv], axis=-1).reshape(*np.shape(pp), 2, 2)
    along, across = block.real, block.imag
    return np.concatenate(
        [np.concatenate([along, -across], axis=-1), np.concatenate([across, along], axis=-1)], axis=-2
    )
