"""Stretches of a recording whose blocks are in order of time: what is out of order, and by how much.

Blocks of several sensors may lag behind each other, each by its own buffer; that is no step. A stretch ends where all
that follows is older than what was before: recordings joined in another order, a buffer written over from its middle.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from saltus.io.clock import SORTING_WINDOW

__all__ = ["Stretch", "Stretches", "order_words"]

_LASTING, _AT_END = 50, 10  # blocks in a row, all older than those before, by which a stretch has ended
_Times = npt.NDArray[np.float64]
_Numbers = npt.NDArray[np.int64]


@dataclass(slots=True)
class Stretch:
    """Blocks in order of time but for `lag`.

    Attributes:
        start: number of its first block in the recording.
        at: byte where it begins.
        first: s, UTC: the time of its first block.
        stop: number of the block after its last.
        time_from: s, the least time in it.
        time_to: s, the greatest.
        lag: s by which the blocks of one source are behind those of others, at most.
    """

    start: int
    at: int
    first: float
    stop: int = 0
    time_from: float = np.inf
    time_to: float = -np.inf
    lag: float = 0.0


class Stretches:
    """Finds stretches as blocks come, in memory that does not grow."""

    def __init__(self) -> None:
        self.found: list[Stretch] = []
        self._newest: dict[int, float] = {}  # of each source
        self._rest: tuple[_Numbers, _Times, _Numbers, _Numbers] | None = None  # blocks at the end that are all behind
        self._n = 0

    def add(self, at: _Numbers, time: _Times, source: _Numbers) -> None:
        """Take further blocks, in the order recorded.

        Args:
            at: byte of each, (N,).
            time: s, UTC, NaN = tells none, (N,).
            source: what tells sources apart, (N,).
        """
        number = np.arange(self._n, self._n + len(at))
        self._n += len(at)
        told = np.isfinite(time)
        columns = at[told], time[told], source[told], number[told]
        if self._rest is not None:
            columns = tuple(np.concatenate(pair) for pair in zip(self._rest, columns, strict=True))  # type: ignore[assignment]  # four arrays
        self._rest = self._take(*columns, last=False)

    def finish(self) -> list[Stretch]:
        """The stretches, when no more blocks come."""
        if self._rest is not None and len(self._rest[0]):
            self._take(*self._rest, last=True)
        self._rest = None
        if self.found:
            self.found[-1].stop = self._n
        return self.found

    def _take(
        self, at: _Numbers, time: _Times, source: _Numbers, number: _Numbers, *, last: bool
    ) -> tuple[_Numbers, _Times, _Numbers, _Numbers]:
        """Count blocks; return those at the end of which it is open whether they begin a stretch."""
        begin = 0
        while begin < len(time):
            if not self.found:
                self._open(number[begin], at[begin], time[begin])
            newest = np.maximum.accumulate(np.append(self.found[-1].time_to, time[begin:]))[:-1]
            ahead = np.flatnonzero(time[begin:] >= newest - SORTING_WINDOW)
            edges = np.concatenate([[-1], ahead, [len(time) - begin]])
            behind = np.diff(edges) - 1  # blocks in a row that are all behind
            behind[-1] += (_LASTING - _AT_END) if last else 0
            cut = int(np.argmax(behind >= _LASTING)) if (behind >= _LASTING).any() else len(behind) - 1
            stop = begin + int(edges[cut]) + 1
            self._count(time[begin:stop], source[begin:stop], newest[: stop - begin])
            if behind[cut] < _LASTING:
                if last:
                    self._count(time[stop:], source[stop:], newest[stop - begin :])
                    stop = len(time)
                return at[stop:], time[stop:], source[stop:], number[stop:]
            self.found[-1].stop = int(number[stop])
            self._open(number[stop], at[stop], time[stop])
            begin = stop
        return at[begin:], time[begin:], source[begin:], number[begin:]

    def _open(self, number: np.int64, at: np.int64, time: np.float64) -> None:
        self.found.append(Stretch(int(number), int(at), float(time)))
        self._newest = {}

    def _count(self, time: _Times, source: _Numbers, newest: _Times) -> None:
        """Widen the stretch; a block that is late in its own source tells no lag."""
        if not len(time):
            return
        now = self.found[-1]
        now.time_from, now.time_to = min(now.time_from, float(time.min())), max(now.time_to, float(time.max()))
        for key in np.unique(source).tolist():
            mine = np.flatnonzero(source == key)
            own = np.maximum.accumulate(np.append(self._newest.get(key, -np.inf), time[mine]))
            right = time[mine] >= own[:-1] - SORTING_WINDOW
            lags = (newest[mine] - time[mine])[right]
            now.lag = max(now.lag, float(lags.max(initial=0.0, where=np.isfinite(lags))))
            self._newest[key] = float(own[-1])


def order_words(stretches: Sequence[Stretch]) -> tuple[str, ...]:
    """What is out of order, in words; none where nothing is."""
    said = []
    for before, after in pairwise(stretches):
        back = before.time_to - after.first
        said.append(f"from byte {after.at} on older than what is before, by {back:.0f} s")
    lag = max((s.lag for s in stretches), default=0.0)
    if lag > SORTING_WINDOW:
        said.append(f"blocks of some sources come up to {lag:.1f} s after those of others")
    return tuple(said)
