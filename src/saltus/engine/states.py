"""Published states of a whole run, piece by piece: of one system as its tracker gave them, of several fused."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.engine.identified import Identified
from saltus.engine.journal import Journal
from saltus.engine.replay import replayed, rows_of
from saltus.engine.setup import Setup
from saltus.engine.tally import Tally
from saltus.tracks.faults import plot_law
from saltus.tracks.membership import KnownSince
from saltus.tracks.rows import ConditionFound, Rows
from saltus.tracks.system_tracks import Fused, SystemTracking
from saltus.tracks.window import Reported

__all__ = ["FusedStates", "LocalStates", "Piece"]

_Mask = npt.NDArray[np.bool_]


class Piece(NamedTuple):
    """Rows that follow each other."""

    rows: Rows
    published: _Mask  # whether their tracks were confirmed at some time
    before: float  # no row to come is known before that, s


class LocalStates:
    """Of one system: the rows of its tracker.

    Attributes:
        track: published track of each report, 0 none; as `span`, complete when all pieces were yielded.
        span: first and last time of the reports placed, s.
    """

    def __init__(self, journal: Journal, told: Tally, conditions: Sequence[ConditionFound]) -> None:
        """Take the journal of a session that has ended; `conditions` are those that the tracker found."""
        self._journal, self._own, self._ever = journal, told.parties[0].party.sources[0], told.parties[0].ever
        self.track = np.where(np.isin(told.track, self._ever), told.track, 0).astype(np.int32)
        self.span, self._conditions = told.placed, conditions

    @property
    def conditions(self) -> Sequence[ConditionFound]:
        """What was found of the condition of each source."""
        return self._conditions

    def __iter__(self) -> Iterator[Piece]:
        """Yield the rows in the order in which they were published."""
        first = [
            part["time_known"].min(where=part["system"] == self._own, initial=np.inf)
            for part in self._journal.parts("rows", ["system", "time_known"])
        ]
        before = np.minimum.accumulate([np.inf, *first[:0:-1]])[::-1] if first else np.zeros(0)
        for part, known in zip(self._journal.parts("rows"), before.tolist(), strict=True):
            rows = rows_of(part, part["system"] == self._own)
            yield Piece(rows, np.isin(rows.track_id, self._ever), known)


class FusedStates:
    """Of several systems: those of system tracks, with what is known after the end of who belongs together.

    Attributes: as of `LocalStates`.
    """

    def __init__(self, journal: Journal, setup: Setup, told: Tally, whole: Identified) -> None:
        """Take the journal of a session that has ended.

        Args:
            journal: its journal.
            setup: of all sources.
            told: of the journal.
            whole: who is whom.
        """
        config, n = setup.config, len(told.parties)
        self._journal, self._told, self._known = journal, told, KnownSince(whole.changes)
        self._tracking = SystemTracking(
            [p.ids for p in told.parties],
            whole.registered[:n],
            whole.segments,
            [plot_law(config.tracker, sensor.kind) for sensor in setup.sensors],
            config.filter,
            config.tracker,
            config.systems,
            [s.of_tracker() for s in setup.sensors],
            use_identity=setup.use_identity,
        )
        self.track, self.span = np.zeros(len(told.track), np.int32), (np.inf, -np.inf)

    @property
    def conditions(self) -> Sequence[ConditionFound]:
        """What was found of the condition of each source."""
        return [ConditionFound(c.law, c.history) for c in self._tracking.conditions]

    def __iter__(self) -> Iterator[Piece]:
        """Yield the rows in the order in which they are made."""
        nothing: list[Reported] = []
        for stretch in replayed(self._journal, self._told, states=True):
            nothing = [reported.take(np.zeros(0, np.int64)) for reported in stretch.systems]
            yield self._piece(self._tracking.feed(stretch.systems, stretch.until))
        yield self._piece(self._tracking.feed(nothing, np.inf))

    def _piece(self, fused: Fused) -> Piece:
        rows = fused.rows
        self.track[fused.plot] = fused.track
        first, last = fused.time.min(initial=np.inf), fused.time.max(initial=-np.inf)
        self.span = (min(self.span[0], float(first)), max(self.span[1], float(last)))
        known = np.maximum(rows.time_known, self._known.at(rows.track_id, rows.time))
        return Piece(rows._replace(time_known=known), np.ones(len(rows.time), bool), fused.before)
