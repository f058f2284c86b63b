"""Probabilities of a grid over an interval: exp(G dt) in the way that suits the grid."""

from collections.abc import Callable
from math import ceil
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from saltus.filters.grid.generator import Generator
from saltus.models import exponential
from saltus.shapes import Float

__all__ = ["Propagator", "dense", "split", "uniformised"]

_Array = npt.NDArray[np.float64]
Propagator: TypeAlias = Callable[[_Array], _Array]

_TAIL = 1e-13  # probability of the jumps that are left out
_SPLIT = 0.1  # largest rate of switching times substep
_COUPLED = 0.5  # largest coupling of the axes times substep
_MOST_STEPS = 32
_MOST_JUMPS = 60.0  # per pass of uniformisation: exp(-60) is far from underflow


def uniformised(change: Callable[[_Array], _Array], fastest: float, dt: float) -> Propagator:
    """exp(G dt) = sum_j Poisson(j; c dt) (I + G / c)^j: every term is positive and keeps probability.

    Args:
        change: p -> p G, (b, s, *cells).
        fastest: c, not below the largest rate of leaving a cell, 1/s.
        dt: interval, s.
    """
    passes = max(1, ceil(fastest * dt / _MOST_JUMPS))
    mean = fastest * dt / passes

    def propagate(p: _Array) -> _Array:
        for _ in range(passes):
            term, weight, left = p, np.exp(-mean), 1.0
            total = weight * p
            left -= weight
            j = 0
            while left > _TAIL and j < 400:
                j += 1
                term = term + change(term) / fastest
                weight *= mean / j
                left -= weight
                total = total + weight * term
            p = total + max(left, 0.0) * term
        return p

    return propagate if fastest * dt > 0 else _same


def _same(p: _Array) -> _Array:
    return p


def dense(rates: Generator, dt: float) -> Propagator:
    """The whole transition matrix of a grid with one axis."""
    from scipy.linalg import expm

    shape = rates.up[0].shape
    unit = np.eye(int(np.prod(shape))).reshape(-1, *shape)
    G = (rates.transport(unit, 0) + rates.switching(unit)).reshape(len(unit), -1)
    step = _stochastic(expm(G * dt))

    def propagate(p: _Array) -> _Array:
        return np.asarray((p.reshape(len(p), -1) @ step).reshape(p.shape))

    return propagate


def split(rates: Generator, dt: float) -> Propagator:
    """Axis by axis and switching by itself, in symmetric (Strang) order: second order in the substep."""
    n_steps = max(1, ceil(rates.exit_rate() * dt / _SPLIT), ceil(rates.coupling * dt / _COUPLED))
    n_steps = min(n_steps, _MOST_STEPS)
    h = dt / n_steps
    apart = rates.coupling > 0  # the axes do not commute
    first = _along(_moved(rates, 0, h / 2 if apart else h), 0)
    second = _along(_moved(rates, 1, h), 1)
    half, whole = _switching(rates, h / 2), _switching(rates, h)

    def propagate(p: _Array) -> _Array:
        p = half(p)
        for i in range(n_steps):
            p = second(first(p))
            if apart:
                p = first(p)
            p = whole(p) if i < n_steps - 1 else half(p)
        return p

    return propagate


def _lines(rates: Generator, axis: int) -> Float[np.ndarray, "s lines n n"]:
    """Generators of all lines along an axis; one for all where they are equal."""
    up, down = (np.moveaxis(a[axis], 1 + axis, -1) for a in (rates.up, rates.down))  # (s, lines, n)
    if np.ptp(up, axis=1).max() <= 1e-12 * up.max() and np.ptp(down, axis=1).max() <= 1e-12 * down.max():
        up, down = up[:, :1], down[:, :1]
    n = up.shape[-1]
    G = np.zeros((*up.shape, n))
    i = np.arange(n)
    G[..., i, i] = -(up + down)
    G[..., i[:-1], i[1:]] = up[..., :-1]
    G[..., i[1:], i[:-1]] = down[..., 1:]
    return G


def _moved(rates: Generator, axis: int, dt: float) -> Float[np.ndarray, "s lines n n"]:
    """Transition matrices of the lines along an axis."""
    velocity = rates.velocity[axis]
    if velocity is None:
        return _stochastic(exponential(_lines(rates, axis) * dt))
    return _shifted(np.moveaxis(velocity, 1 + axis, -1), dt)


def _shifted(velocity: Float[np.ndarray, "s lines n"], dt: float) -> Float[np.ndarray, "s lines n n"]:
    """Matrices that carry each cell to where the drift takes it (cells / s; Heun's rule), shared by two cells there."""
    n = velocity.shape[-1]
    at = np.arange(n, dtype=np.float64)
    there = np.clip(at + dt * velocity, 0, n - 1)
    low = np.minimum(there.astype(np.int64), n - 2)
    share = there - low
    ahead = np.take_along_axis(velocity, low, -1) * (1 - share) + np.take_along_axis(velocity, low + 1, -1) * share
    to = np.clip(at + 0.5 * dt * (velocity + ahead), 0, n - 1)
    low = np.minimum(to.astype(np.int64), n - 2)
    step = np.zeros((*velocity.shape, n))
    np.put_along_axis(step, low[..., None], (1 - (to - low))[..., None], axis=-1)
    np.put_along_axis(step, low[..., None] + 1, (to - low)[..., None], axis=-1)
    return step


def _along(step: Float[np.ndarray, "s lines n n"], axis: int) -> Propagator:
    def propagate(p: _Array) -> _Array:
        moved = np.moveaxis(p, 2 + axis, -1)  # (b, s, lines, n)
        return (
            np.moveaxis((moved[..., None, :] @ step)[..., 0, :], -1, 2 + axis) if step.shape[1] > 1 else shared(moved)
        )

    def shared(moved: _Array) -> _Array:
        return np.asarray(np.moveaxis(moved @ step[:, 0], -1, 2 + axis))

    return propagate


def _switching(rates: Generator, dt: float) -> Propagator:
    if any(switch.law is not None for switch in rates.switches):
        return uniformised(rates.switching, rates.exit_rate(), dt)
    n_modes, cells = len(rates.up[0]), rates.up[0].shape[1:]
    G = np.zeros((*cells, n_modes, n_modes))
    for switch in rates.switches:
        G[..., switch.source, switch.target] += switch.rate
        G[..., switch.source, switch.source] -= switch.rate
    if np.ptp(G.reshape(-1, n_modes**2), axis=0).max() <= 1e-12 * np.abs(G).max():
        G = G[(slice(None, 1),) * len(cells)]
    step = np.moveaxis(_stochastic(exponential(G * dt)), (-2, -1), (0, 1)).copy()  # (s, s, *cells)

    def propagate(p: _Array) -> _Array:
        moved = p[:, 0, None] * step[0]
        for mode in range(1, n_modes):
            moved += p[:, mode, None] * step[mode]
        return np.asarray(moved)

    return propagate


def _stochastic(step: _Array) -> _Array:
    """Remove what round-off leaves: entries below 0, rows that sum to almost 1."""
    step = np.maximum(step, 0.0)
    return np.asarray(step / step.sum(axis=-1, keepdims=True))
