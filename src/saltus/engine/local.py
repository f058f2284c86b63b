"""One system's reports through its tracker."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from saltus.engine.setup import Setup
from saltus.tracks.local import Party
from saltus.tracks.measurements import Measurements
from saltus.tracks.rows import ConditionFound, Fed
from saltus.tracks.tracker import Tracker

__all__ = ["LocalTracking"]


class LocalTracking:
    """The tracker of one system, and the sources it listens to; it knows nothing of other systems."""

    def __init__(self, setup: Setup, party: Party) -> None:
        """Begin without tracks."""
        settings, filters = setup.config.tracker, setup.config.filter
        self._own = np.array(party.sources)
        self._tracker = Tracker(settings, filters, setup.tracker(party), use_identity=setup.use_identity)

    def adopt(self, setup: Setup, party: Party) -> Fed:
        """Go on under another setup; return what was still to be told under the one before."""
        fed = self._tracker.end()
        self._own = np.array(party.sources)
        self._tracker.adopt(setup.tracker(party))
        return fed

    def own(self, m: Measurements) -> npt.NDArray[np.intp]:
        """Return the places of the system's own measurements."""
        return np.flatnonzero(np.isin(m.source, self._own))

    def feed(self, m: Measurements) -> Fed:
        """Take measurements of all systems in order of time; slices that end before the last of them are complete."""
        return self._tracker.feed(m.take(self.own(m)), float(m.time.max(initial=-np.inf)))

    def end(self) -> Fed:
        """Tell what waits."""
        return self._tracker.end()

    def drained(self) -> list[ConditionFound]:
        """Take what was found of the condition of each source since the last time; of others' nothing."""
        return self._tracker.drained()

    def referred(self) -> npt.NDArray[np.int64]:
        """Return the numbers of the plots whose fate may still be told, or told again."""
        return self._tracker.referred()

    def state(self) -> dict[str, Any]:
        """Return what `restore` goes on from."""
        return self._tracker.state()

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from what `state` gave."""
        self._tracker.restore(state)
