"""Ratios of pairs at looks, for people to see: of a long run those of every second look, fourth, eighth."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.identify import Evidence

__all__ = ["Told"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]


class _Look(NamedTuple):
    number: int
    pairs: _Index
    time: _Array
    llr: _Array


class Told:
    """Keeps what looks said."""

    def __init__(self, most: int) -> None:
        """Begin with nothing said; `most`: ratios kept."""
        self._most, self._n, self._rows = most, 0, 0
        self._looks: list[_Look] = []
        self.every = 1  # of so many looks one is kept

    def add(self, pairs: _Index, time: _Array, llr: _Array) -> None:
        """Take the ratios of a look: of pairs (p, 2), as of times (p,), s, in nats (p,)."""
        if self._n % self.every == 0:
            self._looks.append(_Look(self._n, pairs, time, llr))
            self._rows += len(time)
        self._n += 1
        while self._rows > self._most and len(self._looks) > 1:
            self.every *= 2
            self._looks = [look for look in self._looks if look.number % self.every == 0]
            self._rows = sum(len(look.time) for look in self._looks)

    def evidence(self) -> Evidence:
        """Return everything kept, by pair and time."""
        none = np.zeros(0)
        looks = [_Look(0, np.zeros((0, 2), np.int64), none, none), *self._looks]
        ends, time, llr = (np.concatenate(columns) for columns in list(zip(*looks, strict=True))[1:])
        width = int(ends.max(initial=0)) + 1
        named, pair = np.unique(ends[:, 0] * width + ends[:, 1], return_inverse=True)
        order = np.lexsort((time, pair))
        return Evidence(np.stack(np.divmod(named, width), axis=-1), pair[order], time[order], llr[order])
