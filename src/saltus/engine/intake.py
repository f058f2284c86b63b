"""Reports in order of arrival become reports in order of time; what comes too late, or at a wild time, is refused."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.records import REASONS, Plots, Source
from saltus.tracks.setup_settings import IntakeSettings

__all__ = ["Arrived", "Intake", "Leap", "joined_plots", "numbered"]

_Index = npt.NDArray[np.int64]

_LATE, _JUMP = REASONS.index("out of order"), REASONS.index("clock jump")


class Arrived(NamedTuple):
    """What an intake lets go: usable reports in order of time with their numbers, and the numbers it refuses."""

    plots: Plots
    number: _Index
    refused: _Index
    reason: npt.NDArray[np.int8]  # of those refused


class Leap(NamedTuple):
    """A source's clock leapt ahead for good."""

    source: int
    before: float  # newest time of all reports until then, s
    after: float  # s
    followed: bool  # whether time went on from there; else another source went on at the old time


def joined_plots(parts: Sequence[Plots]) -> Plots:
    """Join reports whose sources and files are numbered alike; the last part names them."""
    columns = {name: np.concatenate([getattr(p, name) for p in parts]) for name in Plots.column_names()}
    return Plots(parts[-1].sources, parts[-1].files, **columns)


def numbered(index: npt.NDArray[np.int32], names: Sequence[Any], known: list[Any]) -> _Index:
    """Number what reports name, sources or files, as `known` does; what is new goes behind, as it first occurs."""
    of = np.full(len(names) + 1, -1)
    values, first = np.unique(index, return_index=True)
    for k in values[np.argsort(first)].tolist():
        if k >= 0:
            key = names[k].system if isinstance(names[k], Source) else names[k]
            keys = [n.system if isinstance(n, Source) else n for n in known]
            if key not in keys:
                known.append(names[k])
                keys.append(key)
            of[k] = keys.index(key)
    return np.asarray(of[index], np.int64)


class Intake:
    """Holds reports back until none is to be expected before them.

    A report is let go when one `hold` seconds later has come; one that is then still older is out of order. A report
    `wild` seconds ahead of all before is in doubt until `for_good` of its source agree: then time goes on from there,
    unless another source meanwhile reported at the old time. Every report is judged by those that came before it, so
    it does not matter in which pieces they come.
    """

    def __init__(self, settings: IntakeSettings) -> None:
        """Begin with nothing held."""
        self._hold, self._settings, self._newest = settings.hold, settings, -np.inf
        self._held: list[tuple[Plots, _Index]] = []
        self._doubted: dict[int, list[tuple[Plots, int, float]]] = {}  # by source: report, number, time
        self._contradicted: set[int] = set()  # sources in doubt while another reports at the old time
        self._refused: list[tuple[int, int]] = []
        self.leaps: list[Leap] = []

    def add(self, plots: Plots, number: _Index) -> Arrived:
        """Take usable reports in order of arrival."""
        before = np.maximum.accumulate(np.append(self._newest, plots.time))
        ahead = plots.time - before[:-1]
        calm = self._hold == 0.0 or (
            not self._doubted and bool((ahead[np.isfinite(ahead)] <= self._settings.wild).all())
        )
        if calm:
            late = plots.time < before[:-1] - self._hold
            self._refused += [(int(k), _LATE) for k in number[late]]
            self._held.append((plots.take(~late), number[~late]))
            self._newest = float(before[-1])
        else:
            for k in range(len(plots)):
                self._judge(plots.take(slice(k, k + 1)), int(number[k]))
        return self._released(plots, self._newest - self._hold)

    def end(self, like: Plots) -> Arrived:
        """Let everything go; `like` names sources and files."""
        for source in list(self._doubted):
            self._settle(source)
        return self._released(like, np.inf)

    def _judge(self, one: Plots, number: int) -> None:
        """Judge a report where a clock is in doubt."""
        time, source = float(one.time[0]), int(one.source[0])
        if np.isfinite(self._newest) and time > self._newest + self._settings.wild:
            doubted = self._doubted.setdefault(source, [])
            if doubted and abs(time - doubted[-1][2]) > self._settings.wild:
                self._refuse(source)
                doubted = self._doubted.setdefault(source, [])
            doubted.append((one, number, time))
            if len(doubted) >= self._settings.for_good:
                self._settle(source)
            return
        if source in self._doubted:
            self._refuse(source)
        self._contradicted |= set(self._doubted)
        if time < self._newest - self._hold:
            self._refused.append((number, _LATE))
        else:
            self._held.append((one, np.array([number])))
            self._newest = max(self._newest, time)

    def _settle(self, source: int) -> None:
        """Decide about a clock that leapt."""
        doubted, followed = self._doubted[source], source not in self._contradicted
        self.leaps.append(Leap(source, self._newest, doubted[0][2], followed))
        if not followed:
            self._refuse(source)
            return
        del self._doubted[source]
        for one, number, time in doubted:
            self._held.append((one, np.array([number])))
            self._newest = max(self._newest, time)

    def _refuse(self, source: int) -> None:
        self._refused += [(number, _JUMP) for _, number, _ in self._doubted.pop(source)]
        self._contradicted.discard(source)

    def _released(self, like: Plots, until: float) -> Arrived:
        held = [(like.take(slice(0, 0)), np.zeros(0, np.int64)), *self._held]
        plots, number = (
            joined_plots([*(p for p, _ in held), like.take(slice(0, 0))]),
            np.concatenate([n for _, n in held]),
        )
        order = np.lexsort((number, plots.time))
        go = plots.time[order] <= until
        stay = np.sort(order[~go])
        self._held = [(plots.take(stay), number[stay])] if len(stay) else []
        refused = np.array(self._refused, np.int64).reshape(-1, 2)
        self._refused = []
        return Arrived(plots.take(order[go]), number[order[go]], refused[:, 0], refused[:, 1].astype(np.int8))

    def state(self) -> dict[str, Any]:
        """Return what `restore` goes on from."""
        held = {str(k): _columns(*part) for k, part in enumerate(self._held)}
        doubted = {
            str(source): {str(k): _columns(one, np.array([number])) for k, (one, number, _) in enumerate(parts)}
            for source, parts in self._doubted.items()
        }
        contradicted = np.array(sorted(self._contradicted), np.int64)
        return {"newest": np.array(self._newest), "held": held, "doubted": doubted, "contradicted": contradicted}

    def restore(self, state: Mapping[str, Any], like: Plots) -> None:
        """Go on from what `state` gave; `like` names sources and files."""
        self._newest = float(state["newest"])
        self._contradicted = set(state["contradicted"].tolist())
        self._held = [_plots(part, like) for part in _listed(state.get("held", {}))]
        self._doubted = {
            int(source): [(p, int(n[0]), float(p.time[0])) for p, n in (_plots(part, like) for part in _listed(parts))]
            for source, parts in state.get("doubted", {}).items()
        }


def _listed(parts: Mapping[str, Any]) -> list[Any]:
    return [parts[str(k)] for k in range(len(parts))]


def _columns(plots: Plots, number: _Index) -> dict[str, npt.NDArray[Any]]:
    return {"number": number, **{name: getattr(plots, name) for name in Plots.column_names()}}


def _plots(columns: Mapping[str, npt.NDArray[Any]], like: Plots) -> tuple[Plots, _Index]:
    own = {name: np.array(columns[name]) for name in Plots.column_names()}
    return Plots(like.sources, like.files, **own), np.array(columns["number"])
