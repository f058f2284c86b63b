"""The latest reports of one system's local tracks, as identification sees them, while its reports go by."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.identify import LocalTracks
from saltus.tracks.encounters import SystemTracks
from saltus.tracks.local import LocalSystem, Misfit, Stated
from saltus.tracks.measurements import Measurements

__all__ = ["Reported", "Window"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]
_LONG_AGO = 3600.0  # s without a report after which a track's misfit is forgotten: no track coasts that long


class Reported(NamedTuple):
    """Reports of one system, in the order of time, and what its tracker made of each."""

    m: Measurements
    track: _Index  # local track, 0 none
    updated: npt.NDArray[np.bool_]  # whether the tracker published a row of it; without, what follows is 0
    mean: _Array  # (n, 6): state after it
    cov: _Array  # (n, 6, 6)
    status: npt.NDArray[np.int8]
    known: _Array  # s: when that was known

    @property
    def velocity(self) -> _Array:
        """Of the target after each report, 0 where the tracker said nothing, (n, 2), m/s."""
        return np.where(self.updated[:, None], self.mean[:, [1, 3]], 0.0)

    def take(self, at: npt.NDArray[np.intp]) -> "Reported":
        """Return those selected."""
        return Reported._make([self.m.take(at), *(column[at] for column in self[1:])])


class _Rows(NamedTuple):
    track: _Index
    time: _Array
    z: _Array
    R: _Array
    velocity: _Array
    ray: _Array
    known: _Array
    heard: _Array  # known, and the track confirmed
    codes: _Index


class Window:
    """Local tracks with as many of their reports as a look needs: the columns of `local_system`, in bounded memory."""

    def __init__(self, name: str, confirmed: _Index, ready: _Array, *, use_identity: bool) -> None:
        """Begin without reports.

        Args:
            name: of the system.
            confirmed: numbers of the tracks that are confirmed at some time, sorted.
            ready: when each was, s.
            use_identity: whether addresses and codes may be looked at.
        """
        self._name, self._confirmed, self._ready, self._use_identity = name, confirmed, ready, use_identity
        self._stated, self._misfit = Stated(), Misfit()
        none, number = np.zeros(0), np.zeros(0, np.int64)
        pair, square = np.zeros((0, 2)), np.zeros((0, 2, 2))
        self._rows = _Rows(number, none, pair, square, pair, pair, none, none, np.zeros((0, 2), np.int64))
        self._latest = self._rows
        self.known = (np.inf, -np.inf)  # s: when the first row was, and the last

    def take(self, new: Reported) -> None:
        """Take the reports that come next."""
        m, velocity = new.m, new.velocity
        at = np.flatnonzero(np.isin(new.track, self._confirmed) & np.isfinite(m.position[:, 0]))
        at = at[np.lexsort((m.time[at], new.track[at]))]
        track, time, z = new.track[at], m.time[at], m.position[at, :2]
        R = self._stated.covariance(m, at, velocity[at], track)
        R = R * self._misfit.factor(track, time, z, R)[:, None, None]
        if len(time):
            self._stated.forget(float(time.max()) - _LONG_AGO)
            self._misfit.forget(float(time.max()) - _LONG_AGO)
        ready = self._ready[np.searchsorted(self._confirmed, track)]
        known = np.where(new.updated[at], new.known[at], ready)
        codes = np.column_stack([m.icao24[at], m.mode3a[at]]).astype(np.int64)
        codes = codes if self._use_identity else np.full_like(codes, -1)
        rows = _Rows(track, time, z, R, velocity[at], m.ray[at], known, np.maximum(known, ready), codes)
        self._latest = rows
        self._rows = _Rows._make(np.concatenate(columns) for columns in zip(self._rows, rows, strict=True))
        self.known = (
            min(self.known[0], float(known.min(initial=np.inf))),
            max(self.known[1], float(known.max(initial=-np.inf))),
        )

    @property
    def latest(self) -> LocalTracks:
        """The rows taken last; tracks are places among those confirmed."""
        r = self._latest
        return LocalTracks(np.searchsorted(self._confirmed, r.track), r.time, r.z, r.R)

    def forget(self, since: float, heard: float) -> None:
        """Forget reports before `since` that were known, and their tracks confirmed, at `heard`, s."""
        kept = (self._rows.time >= since) | (self._rows.heard > heard)
        if 2 * int(kept.sum()) < len(kept):
            self._rows = _Rows._make(column[kept] for column in self._rows)

    def system(self, now: float, since: float, heard: float) -> LocalSystem:
        """Return local tracks with their reports up to `now`, without those that `forget` would forget."""
        r = self._rows
        at = np.flatnonzero((r.time <= now) & ((r.time >= since) | (r.heard > heard)))
        at = at[np.lexsort((r.time[at], r.track[at]))]
        ids, track = np.unique(r.track[at], return_inverse=True)
        ready = self._ready[np.searchsorted(self._confirmed, ids)]
        none = np.full(len(ids), -1)
        view = SystemTracks(LocalTracks(track, r.time[at], r.z[at], r.R[at]), r.velocity[at], r.ray[at], none)
        labels, number = ("",) * len(ids), np.zeros(len(at), np.int64)
        return LocalSystem(self._name, view, none, labels, ready, ids, number, np.nan, r.known[at], r.codes[at])
