"""What is published when it becomes known: rows of tracks, and what became of reports."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.engine.live import APART
from saltus.engine.setup import Setup
from saltus.geo import Plane
from saltus.records import REASONS, Plots
from saltus.tracks.output import ELSEWHERE, NOT_CONFIRMED, SPLIT, report_table, track_table
from saltus.tracks.rows import Fates, Fed, Rows, join_rows

__all__ = ["News", "Published"]

_Index = npt.NDArray[np.int64]
_Array = npt.NDArray[Any]

_COLUMNS = ("time", "source", "file", "record", "reason")


class Published(NamedTuple):
    """What became known with the reports fed."""

    tracks: pa.Table
    assignments: pa.Table
    identifications: pa.Table
    health: dict[str, Any]


class News:
    """Gathers what became known since it was last taken, and keeps what is needed of reports not decided yet."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self._number: _Index = np.zeros(0, np.int64)  # of the reports kept, ascending
        self._kept: dict[str, _Array] = {}
        self._like: Plots | None = None
        self._rows: list[Rows] = []
        self._fates: list[tuple[_Index, _Index, list[str]]] = []  # numbers, tracks, reasons

    def enter(self, plots: Plots, number: _Index) -> None:
        """Keep reports; those that cannot be used are decided."""
        self._like = plots.take(slice(0, 0))
        mine = {name: getattr(plots, name) for name in _COLUMNS}
        self._kept = {k: np.concatenate([self._kept[k], v]) if self._kept else v for k, v in mine.items()}
        self._number = np.concatenate([self._number, number])
        bad = plots.reason > 0
        self.refuse(number[bad], plots.reason[bad])

    def refuse(self, number: _Index, reason: npt.NDArray[np.int8]) -> None:
        """Reports that are not used."""
        self._kept_reason(number, reason)
        self._fates.append((number, np.zeros(len(number), np.int64), [""] * len(number)))

    def _kept_reason(self, number: _Index, reason: npt.NDArray[np.int8]) -> None:
        if len(number):
            self._kept["reason"][np.searchsorted(self._number, number)] = reason

    def tell(self, system: int, fed: Fed) -> None:
        """Take what the tracker of a system knows anew; the first system's tracks keep their numbers."""
        above = system * APART
        self._rows.append(fed.rows._replace(track_id=fed.rows.track_id + above))
        track = np.where(fed.fates.track_id > 0, fed.fates.track_id + above, 0)
        self._fates.append((fed.fates.plot, track, _reasons(fed.fates)))

    def taken(
        self, setup: Setup | None, referred: Sequence[_Index], named: Callable[[_Index], _Index] | None = None
    ) -> tuple[pa.Table, pa.Table]:
        """Return rows of tracks and fates of reports since the last time; keep only the reports referred to.

        Args:
            setup: that holds; None while there is none.
            referred: numbers of the reports whose fate may still be told; all are, while there is no setup.
            named: gives the numbers known now of tracks of several systems.
        """
        if named is not None:
            self._rows = [rows._replace(track_id=named(rows.track_id)) for rows in self._rows]
            self._fates = [
                (plot, np.where(track > 0, named(track), 0), reasons) for plot, track, reasons in self._fates
            ]
        rows, assigned = self._row_table(setup), self._fate_table()
        if setup is not None:
            stay = np.isin(self._number, np.concatenate([np.zeros(0, np.int64), *referred]))
            self._kept = {name: values[stay] for name, values in self._kept.items()}
            self._number = self._number[stay]
        self._rows, self._fates = [], []
        return rows, assigned

    def _row_table(self, setup: Setup | None) -> pa.Table:
        rows = join_rows(self._rows)
        plane = Plane(0.0, 0.0) if setup is None else setup.plane
        order = np.lexsort((rows.time, rows.track_id, rows.time_known))
        return track_table(rows.take(order), plane, 0.0 if setup is None else setup.config.tracker.sigma_pressure)

    def _fate_table(self) -> pa.Table:
        none = np.zeros(0, np.int64)
        number, track = (np.concatenate([none, *(f[k] for f in self._fates)]) for k in (0, 1))
        said = [reason for _, _, reasons in self._fates for reason in reasons]
        at = np.searchsorted(self._number, number)
        if self._like is None or not len(number):
            return report_table(Plots.build(0, (), (), {}), none, [])
        columns = {name: values[at] for name, values in self._kept.items()}
        plots = Plots.build(len(at), self._like.sources, self._like.files, columns)
        why = [text or REASONS[code] for text, code in zip(said, plots.reason.tolist(), strict=True)]
        return report_table(plots, track, why)

    def state(self) -> dict[str, Any]:
        """Return what `restore` goes on from; what is not taken yet is not kept."""
        return {"number": self._number, "kept": self._kept}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from what `state` gave."""
        self._number = np.array(state["number"])
        self._kept = {name: np.array(values) for name, values in state.get("kept", {}).items()}


def _reasons(fates: Fates) -> list[str]:
    """Why plots without a track have none."""
    why = np.select([fates.track_id > 0, fates.split, fates.elsewhere], ["", SPLIT, ELSEWHERE], NOT_CONFIRMED)
    return [str(text) for text in why]
