"""The reports of a journal once more, in order of time, with what trackers made of each: so many at a time."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.engine.journal import Journal
from saltus.engine.tally import Tally
from saltus.tracks.kinematics import Moments
from saltus.tracks.measurements import Measurements
from saltus.tracks.rows import Rows
from saltus.tracks.window import Reported

__all__ = ["Replayed", "replayed", "rows_of"]

_Columns = dict[str, npt.NDArray[Any]]
_AT_ONCE = 8192  # reports
_UPDATE = ("measurement", "mean", "cov", "status", "time_known")


class Replayed(NamedTuple):
    """Reports that follow each other."""

    systems: list[Reported]  # of each system of the tally
    until: float  # none to come is earlier, s


def replayed(journal: Journal, tally: Tally, *, states: bool) -> Iterator[Replayed]:
    """Yield all placed reports, so many at a time.

    Args:
        journal: of a session that has ended.
        tally: of it.
        states: whether covariances of tracks are wanted.
    """
    updates = _Updates(journal, states=states)
    for part in journal.parts("plots"):
        whole = Measurements(**part)
        for begin in range(0, len(whole), _AT_ONCE):
            m = whole.take(np.arange(begin, min(begin + _AT_ONCE, len(whole))))
            found = updates.of(m.plot, int(tally.rows[m.plot].sum(dtype=np.int64)))
            reported, system = Reported(m, tally.track[m.plot].astype(np.int64), *found), tally.system[m.plot]
            each = [reported.take(np.flatnonzero(system == k)) for k in range(len(tally.parties))]
            yield Replayed(each, float(m.time.max()))


class _Updates:
    """Rows of updates, found for each report as they come; they follow in the journal some time after the report."""

    def __init__(self, journal: Journal, *, states: bool) -> None:
        names = [name for name in _UPDATE if states or name != "cov"]
        self._parts = journal.parts("rows", names)
        self._states = states
        self._waiting: _Columns | None = None

    def of(self, plot: npt.NDArray[np.int64], count: int) -> tuple[npt.NDArray[Any], ...]:
        """Return for each report whether there is a row of it; the state after it, its status and when it was known.

        Args:
            plot: numbers of the reports.
            count: of their rows.
        """
        n, order = len(plot), np.argsort(plot, kind="stable")
        there, cov = np.zeros(n, bool), np.zeros((n, 6, 6) if self._states else (n, 0, 0))
        empty: list[npt.NDArray[Any]] = [np.zeros((n, 6)), cov, np.zeros(n, np.int8), np.zeros(n)]
        states = dict(zip(_UPDATE[1:], empty, strict=True))
        parts, met, waiting = [] if self._waiting is None else [self._waiting], 0, []
        while True:
            for part in parts:
                place = np.minimum(np.searchsorted(plot[order], part["measurement"]), max(n - 1, 0))
                mine = plot[order][place] == part["measurement"]
                at = order[place[mine]]
                there[at] = True
                for name in part.keys() & states.keys():
                    states[name][at] = part[name][mine]
                met += len(at)
                waiting.append({name: values[~mine] for name, values in part.items()})
            if met >= count:
                break
            part = next(self._parts)
            some = part["measurement"] >= 0
            parts = [{name: values[some] for name, values in part.items()}]
        self._waiting = {name: np.concatenate([w[name] for w in waiting]) for name in waiting[0]} if waiting else None
        return there, *states.values()


def rows_of(columns: _Columns, keep: npt.NDArray[np.bool_] | npt.NDArray[np.integer]) -> Rows:
    """Return rows of the journal that are selected."""
    moments = Moments(*(columns[name][keep] for name in Moments._fields))
    return Rows(moments=moments, **{name: columns[name][keep] for name in Rows._fields if name != "moments"})
