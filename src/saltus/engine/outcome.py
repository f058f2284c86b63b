"""What became of every report, as a table written piece by piece and in figures."""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.engine.journal import Journal
from saltus.engine.spool import Place, Spool, Stored
from saltus.engine.tally import BEARING, ELSEWHERE, POSITION, SPLIT, Tally
from saltus.records import Plots, Source
from saltus.tracks.output import Fate, assignment_table

__all__ = ["Outcome", "outcome"]

_Index = npt.NDArray[np.int64]
_AT_ONCE = 1 << 20  # reports looked at together


class Outcome(NamedTuple):
    """What became of the reports of a run."""

    stored: Stored  # columns of assignments.parquet
    used: int
    reasons: dict[str, int]  # why others were not, and how many
    confirmed: int  # tracks that are published
    never_confirmed: int  # tracks that were not
    placed: _Index  # (S,): reports with a position of each source
    tracked: _Index  # (S,): of those, the ones on confirmed tracks
    longest: int  # most reports with a position on a local track
    begun: int  # local tracks with more than one


def outcome(
    journal: Journal,
    told: Tally,
    track: npt.NDArray[np.int32],
    sources: tuple[Source, ...],
    files: Sequence[str],
    place: Place,
) -> Outcome:
    """Write the table.

    Args:
        journal: of a session that has ended.
        told: of the journal.
        track: published track of each report, 0 none, (N,).
        sources: of the reports.
        files: they came from.
        place: to write into.
    """
    rest, nowhere = _unpublished(told, track)
    spool, begin, reasons, used = Spool(place, "assignments"), 0, Counter[str](), 0
    for part in journal.parts("reports"):
        own = slice(begin, begin + len(part["time"]))
        begin = own.stop
        plots = Plots.build(len(part["time"]), sources, tuple(files), part | {"reason": told.reason[own]})
        system, ids = told.system[own], told.track[own]
        alone = np.zeros(len(ids), bool)
        for k, count in enumerate(rest):
            mine = system == k
            alone[mine] = np.where(ids[mine] > 0, count[ids[mine]], nowhere) == 1
        bits = told.bits[own]
        fate = Fate(system >= 0, (bits & BEARING) > 0, (bits & SPLIT) > 0, (bits & ELSEWHERE) > 0, alone)
        table = assignment_table(plots, track[own].astype(np.int64), fate)
        spool.write(table)
        used += table.num_rows - table["track_id"].null_count
        reasons.update(table["reason"].drop_null().to_pylist())
    lengths = _lengths(told)
    return Outcome(
        spool.stored(),
        used,
        dict(reasons),
        len(np.unique(track[track > 0])),
        sum(int((count[1:] > 0).sum()) for count in rest),
        told.source,
        told.tracked,
        max((int(count.max(initial=0)) for count in lengths), default=0),
        sum(int((count > 1).sum()) for count in lengths),
    )


def _unpublished(told: Tally, track: npt.NDArray[np.int32]) -> tuple[list[_Index], int]:
    """Return how many reports each local track of each system has that are on no published one, and those on none."""
    counts = _counted(told, lambda own: track[own] == 0)
    return counts, sum(int(count[0]) for count in counts)


def _lengths(told: Tally) -> list[_Index]:
    """Return how many reports with a position each local track of each system has."""
    return [count[1:] for count in _counted(told, lambda own: (told.bits[own] & POSITION) > 0)]


def _counted(told: Tally, which: Callable[[slice], npt.NDArray[np.bool_]]) -> list[_Index]:
    """Count the placed reports of each local track of each system, of those that a slice is told to have."""
    size = int(told.track.max(initial=0)) + 1
    counts = [np.zeros(size, np.int64) for _ in told.parties]
    for begin in range(0, len(told.track), _AT_ONCE):
        own = slice(begin, begin + _AT_ONCE)
        chosen = which(own)
        for k, count in enumerate(counts):
            count += np.bincount(told.track[own][chosen & (told.system[own] == k)], minlength=size)
    return counts
