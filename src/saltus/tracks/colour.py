"""Errors that last, as states of the filters: whose they are, one row of a table for every track.

    z = p + L u + white,   u+ = a u + sqrt(1 - a^2) xi,   a = exp(-dt / tau),   var u = var xi = 1

u is one state of a radar's azimuth, two of a source of positions; it is the same error in report after report of one
source on one track, so the filter learns it like position and velocity, and what it cannot tell from these stays in the
covariance. A track has room for few such states; a source takes what is free when it first reports the track, or what
belongs to one long silent. Where nothing is free its lasting errors are taken for noise.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.tracks.settings import TrackerSettings

__all__ = ["NO_SOURCE", "Colour", "Colours", "inflation"]

NO_SOURCE = -1

_Array = npt.NDArray[np.float64]
_Rows = npt.NDArray[np.intp]
_Sources = npt.NDArray[np.int32]


def inflation(dt: npt.ArrayLike, tau: npt.ArrayLike) -> _Array:
    """Return how often the variance of lasting errors counts where each report's is taken for independent of others'.

    Of errors with the correlation a^|k| between reports k intervals dt apart, a = exp(-dt / tau), the mean of many has
    (1 + a) / (1 - a) = coth(dt / 2 tau) times the variance of as many independent ones.

    Args:
        dt: intervals, s; inf: a report by itself.
        tau: correlation times, s.
    """
    return np.asarray(1.0 / np.tanh(0.5 * np.asarray(dt) / np.asarray(tau)))


class Colour(NamedTuple):
    """The lasting errors of one source."""

    states: int = 0  # 0 none, 1 of an azimuth, 2 of positions
    time: float = 60.0  # correlation time tau, s
    inflation: float = 1.0  # of their variance, where they are taken for noise


class Colours:
    """The sources that the states of lasting errors belong to, for each row of a bank; rows are numbered as there."""

    def __init__(self, sources: Sequence[Colour], settings: TrackerSettings) -> None:
        """Begin without rows; the number of states is what all sources need, up to the settings' most."""
        self._silence = settings.lasting_silence
        self.slots = 0
        self.owner = np.zeros((0, 0), np.int32)  # (rows, slots): source
        self.heard = np.zeros((0, 0))  # (rows, slots): when it last reported the track, s
        self.adopt(sources, settings)

    def adopt(self, sources: Sequence[Colour], settings: TrackerSettings) -> None:
        """Go on with more sources; those known keep their numbers."""
        self._states = np.array([s.states for s in sources], np.intp)
        self._time = np.array([s.time for s in sources])
        self._inflation = np.array([s.inflation for s in sources])
        more = min(settings.lasting_states, int(self._states.sum())) - self.slots
        if more > 0:
            self.slots += more
            self.owner = np.pad(self.owner, ((0, 0), (0, more)), constant_values=NO_SOURCE)
            self.heard = np.pad(self.heard, ((0, 0), (0, more)), constant_values=-np.inf)

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Return what `restore` goes on from."""
        return {"owner": self.owner, "heard": self.heard}

    def restore(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Hold what `state` gave, of the same sources."""
        self.owner, self.heard = np.array(state["owner"]), np.array(state["heard"])

    def empty(self, k: int) -> "Colours":
        """Return a table of k rows whose states are nobody's."""
        table = self.take(np.zeros(0, np.intp))
        table._reserve(k)
        return table

    def take(self, rows: _Rows) -> "Colours":
        """Return the table of copies of rows, numbered from 0."""
        copy = Colours.__new__(Colours)
        copy._silence, copy._states, copy._time, copy._inflation = (
            self._silence,
            self._states,
            self._time,
            self._inflation,
        )
        copy.slots, copy.owner, copy.heard = self.slots, self.owner[rows], self.heard[rows]
        return copy

    def put(self, rows: _Rows, other: "Colours", other_rows: _Rows) -> None:
        """Overwrite rows with those of a table of copies."""
        self._reserve(int(rows.max(initial=-1)) + 1)
        self.owner[rows], self.heard[rows] = other.owner[other_rows], other.heard[other_rows]

    def claim_each(self, sources: _Sources, time: _Array, effect: _Array) -> _Array:
        """Let every row be reported by a source of its own (`claim`); return how states enter (`columns`).

        Args:
            sources: of the rows, (k,).
            time: (k,), s.
            effect: L of each measurement, (k, 2, 2).
        """
        out = np.zeros((len(sources), 2, self.slots))
        for s in np.unique(sources).tolist():
            own = np.flatnonzero(sources == s)
            part = self.take(own)
            part.claim(s, time[own])
            self.put(own, part, np.arange(len(own)))
            out[own] = part.columns(s, effect[own])
        return out

    def claim(self, source: int, time: _Array) -> None:
        """Note that a source reports every row, at times (k,); give it states where it has none and enough are free.

        Free is what belongs to nobody, and to sources not heard for so many of their correlation times that nothing of
        their errors is known any more. A state is never taken from a source that may come back to it.
        """
        size = int(self._states[source]) if self.slots else 0
        if not size:
            return
        without = ~(self.owner == source).any(axis=1)
        if without.any():
            silent = time[:, None] - self.heard > self._silence * self._time[self.owner]
            self.owner[without[:, None] & (self.owner >= 0) & silent] = NO_SOURCE
            free = self.owner == NO_SOURCE
            order = np.cumsum(free, axis=1)
            gets = (without & (free.sum(axis=1) >= size))[:, None] & free & (order <= size)
            self.owner[gets] = source
        own = self.owner == source
        self.heard = np.where(own, np.maximum(self.heard, time[:, None]), self.heard)

    def fade(self, dt: _Array, before: "_Sources") -> _Array:
        """Return a (k, slots) over intervals dt (k,), of rows whose states belonged to `before`; 0: none is known."""
        a = np.exp(-dt[:, None] / self._time[self.owner])
        return np.where((self.owner == before) & (self.owner >= 0), a, 0.0)

    def columns(self, source: int, effect: _Array) -> _Array:
        """Return how the states of rows enter measurements of a source, (k, 2, slots).

        Args:
            source: which.
            effect: L of each measurement, (k, 2, 2).
        """
        own = self.owner == source
        which = np.maximum(np.cumsum(own, axis=1) - 1, 0)
        columns = np.take_along_axis(effect, np.broadcast_to(which[:, None], (len(own), 2, self.slots)), axis=2)
        return np.where(own[:, None], columns, 0.0)

    def carried(self, source: int, effect: _Array) -> _Array:
        """Return the covariance of lasting errors that states of rows stand for, (k, 2, 2); 0 where there are none.

        Args:
            source: which.
            effect: L of each measurement, (k, 2, 2).
        """
        own = (self.owner == source).any(axis=1)
        return np.where(own[:, None, None], effect @ effect.swapaxes(1, 2), 0.0)

    def again(self, source: int) -> float:
        """Return how many more times the variance of lasting errors counts where it is taken for noise.

        Of as many independent ones so many reports would tell more; gates do without it.
        """
        return float(self._inflation[source] - 1.0) if len(self._inflation) else 0.0

    def correlation(self, sources: _Sources, dt: _Array) -> _Array:
        """Return a (k,) of the lasting errors of sources over intervals dt (k,), s."""
        return np.exp(-dt / self._time[sources]) if len(self._time) else np.zeros(len(dt))

    def rate(self, sources: _Sources) -> _Array:
        """Return 1 / tau of the lasting errors of sources, 1/s."""
        return 1.0 / self._time[sources] if len(self._time) else np.zeros(len(sources))

    def _reserve(self, size: int) -> None:
        more = max(size, 2 * len(self.owner)) - len(self.owner)
        if size > len(self.owner):
            self.owner = np.pad(self.owner, ((0, more), (0, 0)), constant_values=NO_SOURCE)
            self.heard = np.pad(self.heard, ((0, more), (0, 0)), constant_values=-np.inf)
