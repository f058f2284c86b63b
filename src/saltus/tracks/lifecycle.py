"""Birth, confirmation, coasting and death of tracks: one array element per bank row."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.tracks.settings import TrackerSettings

__all__ = ["COASTED", "CONFIRMED", "NO_CODE", "SEED", "STATUS", "TENTATIVE", "Birth", "Lifecycle"]

_Array = npt.NDArray[np.float64]
_Rows = npt.NDArray[np.intp]

SEED, TENTATIVE, CONFIRMED, COASTED = 0, 1, 2, 3
STATUS = ("tentative", "tentative", "confirmed", "coasted")
NO_CODE = -1
_VAGUE, _VAGUER = 500.0, 3.0  # m, and of a sensor's own: what says nothing any more
_SLACK = 0.6  # of a period: how late a plot may come before it counts as missed


class Birth(NamedTuple):
    """What new tracks take over from their first plots."""

    time: _Array  # (k,), s
    period: _Array  # (k,), s
    plot: npt.NDArray[np.int64]  # (k,): its number
    mean: _Array  # (k, 6)
    cov: _Array  # (k, 6, 6)


class Lifecycle:
    """Identity number, status, last state, plot history and codes of every track; row numbers are the bank's."""

    def __init__(self, settings: TrackerSettings) -> None:
        """Make an empty table."""
        self._settings = settings
        self.next_id = 1
        self.active = np.zeros(0, bool)
        self.id = np.zeros(0, np.int64)
        self.status = np.zeros(0, np.int8)
        self.time = np.zeros(0)  # of the last update, s
        self.located = np.zeros(0)  # of the last one that was more than a bearing, s
        self.mean = np.zeros((0, 6))  # state then: x, vx, y, vy, z, vz in the plane
        self.cov = np.zeros((0, 6, 6))
        self.period = np.zeros(0)  # shortest update period of the sources that saw the track, s
        self.history = np.zeros(0, np.uint64)  # bit k: a plot k expected scans ago
        self.coasted = np.zeros(0, np.int64)  # coasted rows published since the last update
        self.p_fault = np.zeros(0)  # probability that the last plot was faulty, NaN where nothing told
        self.has_altitude = np.zeros(0, bool)
        self.sigma_altitude = np.zeros(0)  # standard deviation of the last altitude used, m
        self.icao24 = np.zeros(0, np.int32)
        self.mode3a = np.zeros(0, np.int16)
        self.plot = np.zeros(0, np.int64)  # number of the last plot
        self.source = np.zeros(0, np.int32)  # of the last plot
        self.sound_time = np.zeros(0)  # of the last plot that was not faulty, s
        self.sound_source = np.zeros(0, np.int32)  # of that plot
        self.callsign = np.zeros(0, "U8")  # "" none

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Return the columns by name: what `restore` goes on from."""
        return {name: column for name, column in vars(self).items() if isinstance(column, np.ndarray)}

    def restore(self, state: Mapping[str, npt.NDArray[Any]], next_id: int) -> None:
        """Go on from columns that `state` gave, with the number of the next track."""
        for name in self.state():
            setattr(self, name, np.array(state[name]))
        self.next_id = next_id

    def rows(self) -> _Rows:
        """Return the rows in use."""
        return np.flatnonzero(self.active)

    def begin(self, rows: _Rows, birth: Birth) -> None:
        """Start tracks of one plot in rows just added to the bank."""
        self._reserve(int(rows.max()) + 1 if len(rows) else 0)
        self.active[rows] = True
        self.id[rows] = self.next_id + np.arange(len(rows))
        self.next_id += len(rows)
        self.status[rows] = SEED
        self.time[rows], self.period[rows], self.plot[rows] = birth[:3]
        self.mean[rows], self.cov[rows] = birth[3:]
        self.located[rows] = birth.time
        self.history[rows] = 1
        self.coasted[rows] = 0
        self.p_fault[rows] = np.nan
        self.has_altitude[rows] = False
        self.sigma_altitude[rows] = 0.0
        self.icao24[rows] = self.mode3a[rows] = NO_CODE
        self.callsign[rows] = ""

    def renew(self, rows: _Rows) -> None:
        """Make new tracks of rows begun wrongly: of their last plot alone, and of its time and codes."""
        self.id[rows] = self.next_id + np.arange(len(rows))
        self.next_id += len(rows)
        self.status[rows] = SEED
        self.history[rows] = 1

    def hit(
        self,
        rows: _Rows,
        time: _Array,
        period: _Array,
        plot: npt.NDArray[np.int64],
        sound: npt.NDArray[np.bool_] | None = None,
    ) -> None:
        """Enter a plot for each row; confirm what has M plots of the last N expected, if this one is sound."""
        settings = self._settings
        self.period[rows] = np.minimum(self.period[rows], period)
        scans = np.rint((time - self.located[rows]) / self.period[rows])
        shift = np.clip(scans, 1, 63).astype(np.uint64)
        self.history[rows] = (self.history[rows] << shift) | np.uint64(1)
        window = np.uint64((1 << settings.confirm_scans) - 1)
        hits = np.bitwise_count(self.history[rows] & window)
        enough = (hits >= settings.confirm_hits) & (True if sound is None else sound)
        self.status[rows] = np.where(enough | (self.status[rows] == CONFIRMED), CONFIRMED, TENTATIVE)
        self.time[rows] = np.maximum(self.time[rows], time)
        self.located[rows] = np.maximum(self.located[rows], time)
        self.coasted[rows] = 0
        self.plot[rows] = plot

    def heard_altitude(self, rows: _Rows, used: npt.NDArray[np.bool_], variance: _Array) -> None:
        """Note for each row whether its plot's altitude was used, and how good it was, m^2."""
        self.has_altitude[rows] |= used
        self.sigma_altitude[rows[used]] = np.sqrt(variance[used])

    def knows_altitude(self, rows: _Rows, cov: _Array) -> npt.NDArray[np.bool_]:
        """Say which altitudes are worth telling, of states with covariances (k, 6, 6).

        Those told once, until their standard deviation exceeds 500 m, or three times that of what tells them.
        """
        limit = np.maximum(_VAGUE, _VAGUER * self.sigma_altitude[rows])
        return np.asarray(self.has_altitude[rows] & (cov[:, 4, 4] <= limit**2))

    def sighted(self, rows: _Rows, time: _Array) -> None:
        """Enter a bearing for each row: it moves the state, and neither confirms the track nor keeps it alive."""
        self.time[rows] = np.maximum(self.time[rows], time)
        self.coasted[rows] = 0

    def overdue(self, now: float) -> _Rows:
        """Return the rows that have missed too much by `now`: coasted out, or not confirmable any more."""
        settings, rows = self._settings, self.rows()
        patience = (settings.confirm_scans - settings.confirm_hits + 1) * self.period[rows]
        limit = np.where(self.status[rows] == CONFIRMED, self._coast_limit(rows), patience)
        return rows[now - self.located[rows] > limit + _SLACK * self.period[rows]]

    def too_fast(self) -> _Rows:
        """Return the rows, past their first plot, that move faster than any target by three deviations of speed."""
        rows = self.rows()
        rows = rows[self.status[rows] != SEED]
        speed = np.hypot(self.mean[rows, 1], self.mean[rows, 3])
        deviation = np.sqrt(self.cov[rows, 1, 1] + self.cov[rows, 3, 3])
        return np.asarray(rows[speed - 3.0 * deviation > self._settings.max_speed])

    def repeated(self) -> _Rows:
        """Return the rows, past their first plot, whose address an older or surer row has: one aircraft, one track."""
        rows = self.rows()
        rows = rows[(self.status[rows] != SEED) & (self.icao24[rows] >= 0)]
        if len(set(self.icao24[rows].tolist())) == len(rows):
            return np.zeros(0, np.intp)
        rows = rows[np.lexsort((self.id[rows], -self.status[rows]))]
        _, first = np.unique(self.icao24[rows], return_index=True)
        return np.delete(rows, first)

    def holds(self, icao24: npt.NDArray[np.int32]) -> npt.NDArray[np.bool_]:
        """Say which addresses a row past its first plot has already."""
        rows = self.rows()
        taken = set(self.icao24[rows[self.status[rows] != SEED]].tolist())
        return np.array([code >= 0 and code in taken for code in icao24.tolist()], bool)

    def to_coast(self, now: float) -> tuple[_Rows, _Array]:
        """Count and return confirmed rows that missed one more plot by `now`, and the time it was expected."""
        rows = self.rows()
        rows = rows[self.status[rows] == CONFIRMED]
        wait = (self.coasted[rows] + 1) * self.period[rows]
        late = (now - self.time[rows] > wait + _SLACK * self.period[rows]) & (wait <= self._coast_limit(rows))
        rows, expected = rows[late], (self.time[rows] + wait)[late]
        self.coasted[rows] += 1
        return rows, expected

    def _coast_limit(self, rows: _Rows) -> _Array:
        return np.maximum(self._settings.coast_scans * self.period[rows], self._settings.coast_seconds)

    def end(self, rows: _Rows) -> None:
        """Forget rows."""
        self.active[rows] = False

    def _reserve(self, size: int) -> None:
        old = len(self.active)
        if size <= old:
            return
        grown = max(size, 2 * old, 64)
        for name, column in self.state().items():
            bigger = np.zeros((grown, *column.shape[1:]), column.dtype)
            bigger[:old] = column
            setattr(self, name, bigger)
