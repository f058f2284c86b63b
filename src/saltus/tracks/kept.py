"""Measurements that tracks refer to after their slice is over: one for each row of the bank."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from saltus.tracks.measurements import Measurements

__all__ = ["Kept"]

_Index = npt.NDArray[np.intp]


class Kept:
    """One measurement of each row of the bank, the last one noted."""

    def __init__(self) -> None:
        """Make an empty table."""
        self._columns: dict[str, npt.NDArray[Any]] = {}

    def of(self, rows: _Index) -> Measurements:
        """Return the measurements kept for rows."""
        return Measurements(**{name: column[rows] for name, column in self._columns.items()})

    def note(self, rows: _Index, m: Measurements, index: _Index) -> None:
        """Keep measurements `index` of `m` for rows."""
        size = int(rows.max(initial=-1)) + 1
        for name, column in m.columns().items():
            old = self._columns.get(name, column[:0])
            if size > len(old):
                grown = np.zeros((max(size, 2 * len(old), 64), *column.shape[1:]), column.dtype)
                grown[: len(old)] = old
                self._columns[name] = old = grown
            old[rows] = column[index]

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Return the columns by name: what `restore` goes on from."""
        return self._columns

    def restore(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Go on from columns that `state` gave."""
        self._columns = {name: np.array(column) for name, column in state.items()}
