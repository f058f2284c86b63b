"""Where plots that belong to no track are to be expected: clutter and targets not yet seen.

New targets appear where targets are: on the apron, in the circuit, at the heights flown there. A flat density over all
that a source covers would take a parked aircraft's neighbour, first seen, for a faulty plot of the parked one. So each
source has a map, made from a stretch of its plots; what comes later is looked up in it and changes nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.shapes import Float
from saltus.tracks.measurements import Measurements
from saltus.tracks.slices import shortest_share

__all__ = ["Background", "Density", "densities", "flat", "learn_background"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]

# Of a source's plots, so many are clutter or new targets: anywhere in what it covers, and where others are.
_ANYWHERE, _AMONG = 0.1, 0.05
_CELL, _LAYER = 500.0, 50.0  # m: plots are counted in blocks of three cells each way
_HEIGHT_SPAN = 15_000.0  # m: heights of what appears anywhere spread over this
_FAR = 1 << 19  # cells or layers from the middle of the map to its edge
_STEPS = (1, 1 << 21, 1 << 42)  # between neighbours along each axis, in the numbers of cells


class Density(NamedTuple):
    """Expected density of clutter and new targets at each measurement."""

    plane: Float[np.ndarray, " n"]  # per m^2 and scan
    height: Float[np.ndarray, " n"]  # of their heights there, per m; flat where the measurement has none


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """The map of one source.

    beta(x) = 0.1 n / A + 0.05 n(x) / a per m^2 and scan

    with n the source's plots per scan, A the circle of two deviations of its longer axis, and n(x) the mean number of
    other plots of the same scan in a square of area a, where there is one: sum k (k - 1) / sum k over the numbers k of
    plots in the square at a time, so that a lone target is none of its own others. Heights are flat in the first term;
    in the second they have the density of all in the square, the target's own included.
    """

    even: float  # first term, per m^2 and scan
    cell: _Index  # numbers of the cells that have plots, ascending
    near: _Array  # second term about each, per m^2 and scan
    known: _Array  # plots with a height in each
    layer: _Index  # numbers of the cells with layers that have plots, ascending
    count: _Array  # plots in each

    def at(self, position: _Array) -> Density:
        """Look up positions (n, 3): x, y, altitude (NaN unknown)."""
        cell = _number(np.floor(position[:, :2] / _CELL))
        near = _found(self.cell, self.near, cell[:, None])[:, 0]
        plane, height = self.even + near, np.full(len(position), 1.0 / _HEIGHT_SPAN)
        at = np.flatnonzero(np.isfinite(position[:, 2]))
        layer = _number(np.column_stack([np.floor(position[at, :2] / _CELL), np.floor(position[at, 2] / _LAYER)]))
        beside = _found(self.layer, self.count, layer[:, None] + _neighbours(3)).sum(axis=1)
        around = _found(self.cell, self.known, cell[at, None] + _neighbours(2)).sum(axis=1)
        share = np.maximum(beside, 1.0) / np.maximum(around, 1.0) / (3.0 * _LAYER)
        height[at] = (self.even / _HEIGHT_SPAN + near[at] * share) / plane[at]
        return Density(plane, height)


def learn_background(m: Measurements, source: int, period: float, *, polar: bool) -> Background:
    """Make the map of one source from a stretch of its plots.

    Args:
        m: the stretch.
        source: which source.
        period: its update period, s.
        polar: whether it measures range and azimuth.
    """
    own = np.flatnonzero((m.source == source) & np.isfinite(m.position[:, 0]))
    cell = _number(np.floor(m.position[own, :2] / _CELL))
    names, place = np.unique(cell, return_inverse=True)
    near = _AMONG * _others(names, cell, m.time[own], shortest_share(polar=polar), period) / (3.0 * _CELL) ** 2
    known = np.isfinite(m.position[own, 2])
    high = m.position[own[known]]
    layer = _number(np.column_stack([np.floor(high[:, :2] / _CELL), np.floor(high[:, 2] / _LAYER)]))
    layers, count = np.unique(layer, return_counts=True)
    heights = np.bincount(place[known], minlength=len(names)).astype(np.float64)
    return Background(_ANYWHERE * m.density(source, period), names, near, heights, layers, count.astype(np.float64))


def flat(density: float) -> Background:
    """Return a map of the same density (per m^2 and scan) everywhere, with heights as anywhere."""
    none, zero = np.zeros(0, np.int64), np.zeros(0)
    return Background(density, none, zero, zero, none, zero)


def densities(m: Measurements, maps: Sequence[Background]) -> Density:
    """Look every measurement up in the map of its source; bearings have none (NaN)."""
    out = Density(np.full(len(m), np.nan), np.full(len(m), 1.0 / _HEIGHT_SPAN))
    placed = np.isfinite(m.position[:, 0])
    for source in np.unique(m.source[placed]).tolist():
        own = np.flatnonzero(placed & (m.source == source))
        out.plane[own], out.height[own] = maps[source].at(m.position[own])
    return out


def _others(names: _Index, cell: _Index, time: _Array, share: float, period: float) -> _Array:
    """Return how many other plots per scan there are in the block of 3 x 3 cells about each cell named, where one is.

    No target has two plots in a share of the period. Where targets report at times of their own, what others have in it
    they have in every such share; of a radar, or where all report at one time, they have no more in a scan.
    """
    if not len(cell):
        return np.zeros(0)
    number = np.floor((time - time.min()) / (share * period)).astype(np.int64)
    block = cell[:, None] + _neighbours(2)  # blocks that each plot lies in, by their middle cells
    at = np.minimum(np.searchsorted(names, block), len(names) - 1)
    counted = names[at] == block
    when = np.broadcast_to(number[:, None], block.shape)[counted]
    both, k = np.unique(at[counted] * (number.max() + 1) + when, return_counts=True)
    of = both // (number.max() + 1)
    pairs = np.bincount(of, k * (k - 1.0), len(names)) / np.bincount(of, k, len(names))
    in_turn = share < 0.5 < len(np.unique(time)) / len(time)
    return np.asarray(pairs / (share if in_turn else 1.0))


def _number(place: _Array) -> _Index:
    """Return one number for each cell (n, d); what lies beyond the edge of the map counts as on it."""
    whole = np.clip(place, -_FAR, _FAR).astype(np.int64) + (1 << 20)
    return np.asarray(whole @ np.array(_STEPS[: place.shape[1]]))


def _neighbours(axes: int) -> _Index:
    """What the number of a neighbour, or the cell itself, differs by."""
    return np.asarray(np.array(list(product((-1, 0, 1), repeat=axes))) @ np.array(_STEPS[:axes]))


def _found(names: _Index, values: _Array, wanted: _Index) -> _Array:
    """Values of the cells wanted, 0 where a cell has no plots."""
    if not len(names):
        return np.zeros(wanted.shape)
    at = np.minimum(np.searchsorted(names, wanted), len(names) - 1)
    return np.where(names[at] == wanted, values[at], 0.0)
