"""Matrices of intervals met before: clocks tick, so the same few intervals come back scan after scan."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.models import Chain, Motion

__all__ = ["Intervals", "Matrices"]

_Array = npt.NDArray[np.float64]

_MOST = 4096  # intervals remembered, some MB; then it begins anew


class Matrices(NamedTuple):
    """Matrices of k intervals."""

    F: _Array  # (k, M1|1, ..., MC|1, n, n)
    Q: _Array
    trans: list[_Array | None]  # (k, Mc, Mc) of each chain; None for one of a single state


class Intervals:
    """F, Q and transition matrices of motions and their chains, computed once for each length of interval.

    Behind a motion's states may come others that are no function of the interval alone: theirs are 0.
    """

    def __init__(self, parts: Sequence[tuple[Motion, Sequence[Chain], int]]) -> None:
        """Begin with the interval of length 0.

        Args:
            parts: motions, the chains that each is bound to, and the number of further states.
        """
        self._parts = parts
        self._known: _Array = np.zeros(0)  # ascending
        self._row: npt.NDArray[np.intp] = np.zeros(0, np.intp)  # of the columns, for each known interval
        self._columns: list[_Array] = []  # F, Q, transitions of each part; with room for more
        self._learn(np.zeros(1))

    def __len__(self) -> int:
        """Number of intervals remembered."""
        return len(self._known)

    def at(self, dt: _Array) -> tuple[Matrices, ...]:
        """Return the matrices over intervals dt (k,), s, of each part."""
        place = self._places(dt)
        if (place < 0).sum() > _MOST:  # more than is worth remembering
            return tuple(
                Matrices(*_wide(motion, dt, more), [None if len(c) == 1 else c.transition(dt) for c in chains])
                for motion, chains, more in self._parts
            )
        if (place < 0).any():
            if len(self._known) > _MOST:
                self._known, self._row = self._known[:0], self._row[:0]
                place[:] = -1
            self._learn(np.unique(dt[place < 0]))
            place = self._places(dt)
        columns = (column[place] for column in self._columns)
        return tuple(
            Matrices(next(columns), next(columns), [None if len(chain) == 1 else next(columns) for chain in chains])
            for _, chains, _ in self._parts
        )

    def _places(self, dt: _Array) -> npt.NDArray[np.intp]:
        """Rows of the columns that hold dt, -1 for none."""
        at = np.minimum(np.searchsorted(self._known, dt), len(self._known) - 1)
        return np.where(self._known[at] == dt, self._row[at], -1)

    def _learn(self, dt: _Array) -> None:
        new = []
        for motion, chains, more in self._parts:
            new += [*_wide(motion, dt, more), *(chain.transition(dt) for chain in chains if len(chain) > 1)]
        begin, end = len(self._known), len(self._known) + len(dt)
        if not self._columns or end > len(self._columns[0]):
            old, room = self._columns, max(2 * end, 64)
            self._columns = [np.empty((room, *column.shape[1:])) for column in new]
            for column, before in zip(self._columns, old, strict=False):
                column[:begin] = before[:begin]
        for column, values in zip(self._columns, new, strict=True):
            column[begin:end] = values
        at = np.searchsorted(self._known, dt)
        self._known, self._row = np.insert(self._known, at, dt), np.insert(self._row, at, np.arange(begin, end))


def _wide(motion: Motion, dt: _Array, more: int) -> tuple[_Array, _Array]:
    """Return F and Q, with rows and columns of 0 for further states."""
    F, Q = motion.step(dt)[:2]
    if more:
        beside = [(0, 0)] * (F.ndim - 2) + [(0, more)] * 2
        F, Q = np.pad(F, beside), np.pad(Q, beside)
    return F, Q
