"""What a run sums up of its published states, as they go by."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.engine.spool import Place, Spool, Stored
from saltus.tracks.health import Health, flagged, sensor_health
from saltus.tracks.lifecycle import COASTED
from saltus.tracks.rows import ConditionFound, Rows

__all__ = ["Figures", "RunFigures"]

_Index = npt.NDArray[np.int64]
_FAULTS = 4  # kinds at most, none among them


class Figures(NamedTuple):
    """Sums over the rows of a run; arrays over sources are (S,)."""

    updates: int  # published rows that reports made
    coasted: int  # and others
    nis: npt.NDArray[np.float64]  # sum of the normalised innovations squared
    nis_updates: _Index  # of so many rows
    faults: _Index  # (S, 4): judged reports by their likeliest fault, 0 none
    judged: Stored  # each of these: `source`, `time`, `fault`

    def health(self, names: Sequence[str], conditions: Sequence[ConditionFound]) -> list[Health]:
        """Return the faults of each source over time; `names` are those of the sources."""
        source, time, fault = (np.asarray(column) for column in self.judged.table().columns)
        return sensor_health(names, conditions, source, time, fault)


class RunFigures:
    """Adds up."""

    def __init__(self, n_sources: int, place: Place) -> None:
        """Begin with nothing."""
        self._updates = self._coasted = 0
        self._nis, self._n = np.zeros(n_sources), np.zeros(n_sources, np.int64)
        self._faults = np.zeros((n_sources, _FAULTS), np.int64)
        self._judged = Spool(place, "judged")
        self._write(np.zeros(0, np.int32), np.zeros(0), np.zeros(0, np.int8))

    def add(self, rows: Rows, published: npt.NDArray[np.bool_]) -> None:
        """Take rows, and whether their tracks are published."""
        coasted, n = rows.status == COASTED, len(self._n)
        self._coasted += int(np.sum(coasted & published))
        self._updates += int(np.sum(~coasted & published))
        told = np.isfinite(rows.d2) & (rows.source >= 0)
        self._nis += np.bincount(rows.source[told], rows.d2[told], minlength=n)
        self._n += np.bincount(rows.source[told], minlength=n)
        at = np.flatnonzero(published & (rows.measurement >= 0) & np.isfinite(rows.p_fault))
        fault = flagged(rows.p_fault[at], rows.fault[at])
        np.add.at(self._faults, (rows.source[at], fault), 1)
        if len(at):
            self._write(rows.source[at], rows.time[at], fault)

    def _write(self, source: npt.NDArray[np.int32], time: npt.NDArray[np.float64], fault: npt.NDArray[np.int8]) -> None:
        self._judged.write(pa.table({"source": source, "time": time, "fault": fault}))

    def found(self) -> Figures:
        """Return the sums."""
        return Figures(self._updates, self._coasted, self._nis, self._n, self._faults, self._judged.stored())
