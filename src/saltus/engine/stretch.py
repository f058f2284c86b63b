"""The first stretch of reports, from which the setup is learnt."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from saltus.engine.intake import joined_plots
from saltus.records import Plots
from saltus.tracks.setup_settings import SetupSettings

__all__ = ["Stretch"]

_Index = npt.NDArray[np.int64]


class Stretch:
    """Collects usable reports in order of time until there are enough."""

    def __init__(self, settings: SetupSettings) -> None:
        """Begin with none."""
        self._settings = settings
        self._plots: list[Plots] = []
        self._number: list[_Index] = []
        self._count = np.zeros(0, np.int64)  # reports of each source
        self._last, self._heard = np.inf, 0.0  # s: time of the last report, and how long there were any

    def add(self, plots: Plots, number: _Index) -> int:
        """Take reports; return how many of them complete the stretch, one more than there are where none does.

        The stretch is complete with the first report by which every source present gave enough, or time is up
        (`SetupSettings`).
        """
        if not len(plots):
            return 1
        settings = self._settings
        gaps = np.diff(plots.time, prepend=min(self._last, float(plots.time[0])))
        heard = np.cumsum(np.append(self._heard, np.minimum(gaps, settings.gap)))[1:]  # one by one, whatever the pieces
        size = max(len(self._count), int(plots.source.max()) + 1)
        seen = np.zeros((len(plots), size), np.int64)
        seen[np.arange(len(plots)), plots.source] = 1
        count = np.cumsum(seen, axis=0) + np.pad(self._count, (0, size - len(self._count)))
        many, some = (((count >= n) | (count == 0)).all(axis=1) for n in (settings.reports, settings.fewest))
        enough = many | (some & (heard >= settings.seconds)) | (heard >= settings.longest * settings.seconds)
        stop = int(enough.argmax()) + 1 if enough.any() else len(plots) + 1
        taken = min(stop, len(plots))
        self._plots.append(plots.take(slice(0, taken)))
        self._number.append(number[:taken])
        self._count, self._heard = count[taken - 1], float(heard[taken - 1])
        self._last = float(plots.time[taken - 1])
        return stop

    def collected(self) -> tuple[Plots, _Index] | None:
        """Return everything so far, None without any."""
        return (joined_plots(self._plots), np.concatenate(self._number)) if self._plots else None

    def state(self) -> dict[str, Any]:
        """Return what `restore` goes on from."""
        found = self.collected()
        if found is None:
            return {}
        plots, number = found
        columns = {name: getattr(plots, name) for name in Plots.column_names()}
        return {"columns": columns, "number": number}

    def restore(self, state: Mapping[str, Any], like: Plots) -> None:
        """Go on from what `state` gave; `like` names sources and files."""
        if state:
            columns = {name: np.array(values) for name, values in state["columns"].items()}
            self.add(Plots(like.sources, like.files, **columns), np.array(state["number"]))
