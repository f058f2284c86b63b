"""What a run keeps of the reports that it was given: counts, and some of them to be drawn."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from saltus.config import Config
from saltus.engine.learn import usable
from saltus.engine.setup import site_of
from saltus.records import REASONS, Contents, Plots, Recording, System

__all__ = ["Seen"]

_DRAWN = 120_000  # reports kept at most; of more, every second, fourth, eighth ... one
_SITE_UNKNOWN = REASONS.index("site unknown")


@dataclass(slots=True)
class Seen:
    """Reports as they were read, in memory that does not grow with them.

    Attributes:
        n: reports so far.
        reasons: number of reports by reason, index into `REASONS`.
        unplaced: number of reports of each source that are relative to a site not configured.
        usable: whether there was a report that can be tracked.
        newest: time of the newest usable report, s.
        problems: lines of the reader.
        contents: of what was read so far.
        every: of so many reports one is kept.
    """

    config: Config
    n: int = 0
    reasons: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(REASONS), np.int64))
    unplaced: dict[System, int] = field(default_factory=dict)
    usable: bool = False
    newest: float = -np.inf
    problems: tuple[str, ...] = ()
    contents: tuple[Contents, ...] = ()
    every: int = 1
    _kept: list[Plots] = field(default_factory=list)

    def add(self, recording: Recording) -> None:
        """Take the next piece of a recording, or a whole one."""
        plots = recording.plots
        self.problems = tuple(dict.fromkeys((*self.problems, *recording.problems)))
        self.contents = recording.contents or self.contents
        sites = [site_of(self.config.site_for(s.system)) for s in plots.sources]
        good = usable(plots, sites)
        lost = (plots.reason == 0) & ~good
        self.reasons += np.bincount(np.where(lost, _SITE_UNKNOWN, plots.reason), minlength=len(REASONS))
        for s, count in enumerate(np.bincount(plots.source[lost], minlength=len(plots.sources)).tolist()):
            if count:
                self.unplaced[plots.sources[s].system] = self.unplaced.get(plots.sources[s].system, 0) + count
        if good.any():
            self.usable = True
            self.newest = max(self.newest, float(plots.time[good].max()))
        self._keep(plots)

    def sample(self) -> tuple[Plots, npt.NDArray[np.int64]]:
        """Return the reports kept, and the number of each in the order read."""
        if not self._kept:
            return Plots.build(0, (), (), {}), np.zeros(0, np.int64)
        return Plots.concat(self._kept, same_files=True), np.arange(0, self.n, self.every)

    def _keep(self, plots: Plots) -> None:
        self._kept.append(plots.take(np.arange(-self.n % self.every, len(plots), self.every)))
        self.n += len(plots)
        while -(-self.n // self.every) > _DRAWN:
            self.every *= 2
            some = Plots.concat(self._kept, same_files=True)
            self._kept = [some.take(np.arange(0, len(some), 2))]
