"""Where plots that belong to no track are to be expected: clutter and targets not yet seen.

New targets appear where targets are: on the apron, in the circuit, at the heights flown there. A flat density over all
that a source covers would take a parked aircraft's neighbour, first seen, for a faulty plot of the parked one.
"""

from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from jaxtyping import Float

from saltus.tracks.measurements import Measurements
from saltus.tracks.slices import shortest_share

__all__ = ["Background", "background", "flat"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]

# Of a source's plots, so many are clutter or new targets: anywhere in what it covers, and where others are.
_ANYWHERE, _AMONG = 0.1, 0.05
_CELL, _LAYER = 500.0, 50.0  # m: plots are counted in blocks of three cells each way
_HEIGHT_SPAN = 15_000.0  # m: heights of what appears anywhere spread over this


class Background(NamedTuple):
    """Expected density of clutter and new targets at each measurement."""

    plane: Float[np.ndarray, " n"]  # per m^2 and scan
    height: Float[np.ndarray, " n"]  # of their heights there, per m; flat where the measurement has none


def background(m: Measurements, periods: npt.NDArray[np.float64]) -> Background:
    """Estimate the density at every measurement from all plots of its source.

    beta(x) = 0.1 n / A + 0.05 n(x) / a per m^2 and scan

    with n the source's plots per scan, A the circle of two deviations of its longer axis, and n(x) the mean number of
    other plots of the same scan in a square of area a, where there is one: sum k (k - 1) / sum k over the numbers k of
    plots in the square at a time, so that a lone target is none of its own others. Heights are flat in the first term;
    in the second they have the density of all in the square, the target's own included.

    Args:
        m: all measurements.
        periods: update period of each source, s.
    """
    plane, height = np.full(len(m), np.nan), np.full(len(m), 1.0 / _HEIGHT_SPAN)
    for source, period in enumerate(periods.tolist()):
        own = np.flatnonzero((m.source == source) & np.isfinite(m.position[:, 0]))
        if not len(own):
            continue
        cell = np.floor(m.position[own, :2] / _CELL).astype(np.int64)
        even = _ANYWHERE * m.density(source, period)
        near = _AMONG * _others(cell, m.time[own], shortest_share(m, source), period) / (3.0 * _CELL) ** 2
        plane[own] = even + near
        known = np.flatnonzero(np.isfinite(m.position[own, 2]))
        layer = np.floor(m.position[own[known], 2] / _LAYER).astype(np.int64)
        share = _around(np.column_stack([cell[known], layer])) / _around(cell[known]) / (3.0 * _LAYER)
        height[own[known]] = (even / _HEIGHT_SPAN + near[known] * share) / (even + near[known])
    return Background(plane, height)


def flat(n: int, density: float) -> Background:
    """Return a density (per m^2 and scan) that is the same at n measurements, with heights as everywhere."""
    return Background(np.full(n, density), np.full(n, 1.0 / _HEIGHT_SPAN))


def _others(cell: _Index, time: _Array, share: float, period: float) -> _Array:
    """Return how many other plots per scan there are in the block of 3 x 3 cells about each plot's, where there is one.

    No target has two plots in a share of the period. Where targets report at times of their own, what others have in it
    they have in every such share; of a radar, or where all report at one time, they have no more in a scan.
    """
    key, step = _keys(cell)
    names, place = np.unique(key, return_inverse=True)
    number = np.floor((time - time.min()) / (share * period)).astype(np.int64)
    block = key + step[:, None]  # blocks that each plot lies in, by their middle cells
    at = np.minimum(np.searchsorted(names, block), len(names) - 1)
    counted = names[at] == block
    when = np.broadcast_to(number, block.shape)[counted]
    both, k = np.unique(at[counted] * (number.max() + 1) + when, return_counts=True)
    of = both // (number.max() + 1)
    pairs = np.bincount(of, k * (k - 1.0), len(names)) / np.bincount(of, k, len(names))
    in_turn = share < 0.5 < len(np.unique(time)) / len(time)
    return np.asarray(pairs[place] / (share if in_turn else 1.0))


def _around(cell: _Index) -> _Array:
    """Return how many points lie in the block of three cells each way about each point's (n, d)."""
    if not len(cell):
        return np.zeros(0)
    key, step = _keys(cell)
    names, place, count = np.unique(key, return_inverse=True, return_counts=True)
    wanted = names + step[:, None]
    found = np.minimum(np.searchsorted(names, wanted), len(names) - 1)
    return np.asarray(np.where(names[found] == wanted, count[found], 0).sum(axis=0)[place], np.float64)


def _keys(cell: _Index) -> tuple[_Index, _Index]:
    """Return one number for each cell (n, d), and what a neighbour's differs by, itself included."""
    low = cell.min(axis=0) - 1
    size = cell.max(axis=0) - low + 2
    stride = np.append(np.cumprod(size[::-1])[::-1][1:], 1)
    step = np.array(list(product((-1, 0, 1), repeat=len(size)))) @ stride
    return (cell - low) @ stride, step
