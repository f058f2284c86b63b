"""Recordings in order of time, a chunk at a time: memory does not grow with them.

    pieces = read_in_order([...])
    pieces.span                              s, UTC: what the index of all files tells of their times
    for recording in pieces:
        recording.plots                      the next reports, none older than those of the chunk before
        recording.contents, problems         of what was read so far, and first met in this chunk
    recording.contents, problems, files      of everything, in the last chunk, which has no reports

Every ASTERIX file is indexed first (`saltus.io.index`): its stretches in order of time are then read side by side, each
from its place, and what lies in a stretch out of order is held as long as its lag asks for; so are rows of tables.
"""

import datetime
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.errors import DataError
from saltus.io.asterix import PER_REPORT, about_file, channels_apart, pieces_of, told_dateless
from saltus.io.clock import DAY, SORTING_WINDOW, ClockJudge, OrderFaults
from saltus.io.contents import Tally
from saltus.io.dating import Clock
from saltus.io.index import TIMED, index_pieces
from saltus.io.merge import LIMITS, completed, credible_times, mark_order, mark_values, next_day, shift, told_next_day
from saltus.io.part import Part, printable
from saltus.io.stream import Stream
from saltus.io.stretches import Stretch, Stretches, order_words
from saltus.io.table import read_table_pieces, times_of_rows
from saltus.io.told import Progress, Told
from saltus.records import REASONS, Contents, FileContents, Plots, Recording, System
from saltus.text import shown

__all__ = ["InOrder", "Indexed", "Run", "asterix_runs", "table_run"]

_LATE, _DUPLICATE = REASONS.index("out of order"), REASONS.index("duplicate")


@dataclass(slots=True)
class Run:
    """What is read from one place on: a stretch of a recording, or a table."""

    file: int
    parts: Iterator[Part]
    start: float  # s: nothing in it is earlier
    lag: float  # s by which it is out of order
    is_last: bool = True  # of its file
    whole: bool = True  # it is the whole file
    newest: float = -np.inf
    begun: bool = False
    done: bool = False
    judges: dict[System, ClockJudge] = field(default_factory=dict)

    @property
    def horizon(self) -> float:
        """Nothing that it has yet to give is earlier, s."""
        if self.done:
            return np.inf
        return self.newest - self.lag - 2.0 * SORTING_WINDOW if self.begun else self.start

    def judge(self, system: System, time: npt.NDArray[np.float64]) -> OrderFaults:
        """Judge further times of a source."""
        return self.judges.setdefault(system, ClockJudge()).faults(time)


@dataclass(slots=True)
class Indexed:
    """What the index of one file tells."""

    name: str
    span: tuple[float, float]  # s, UTC, NaN where it tells no times
    plain: bool  # it tells no date
    runs: list[Run]
    problems: list[str] = field(default_factory=list)
    file: FileContents | None = None


def asterix_runs(path: Path, number: int, told: Told, progress: Progress | None) -> Indexed:
    """Index an ASTERIX recording; its stretches are read when they are wanted."""
    stream, clock, order = Stream(path, told.editions, told.framing), Clock(told.date, path.name), Stretches()
    for index in index_pieces(stream, clock, progress):
        order.add(index.at, index.time, index.category.astype(np.int64) << 16 | index.source)
    found = order.finish()
    captured = clock.captured and not clock.dateless
    apart = told.apart
    if len(stream.channels) > 1:
        apart = channels_apart(Stream(path, told.editions, told.framing, stream.chosen, (), apart), told.date)

    def stream_again() -> Stream:
        return Stream(path, told.editions, told.framing, stream.chosen, apart, told.apart)

    if len(found) < 2:
        start, lag = (found[0].time_from, found[0].lag) if found else (-np.inf, 0.0)
        span = (found[0].time_from, found[0].time_to) if found else (np.nan, np.nan)
        return Indexed(path.name, span, not captured, [Run(number, pieces_of(stream_again(), told.date), start, lag)])
    before = _records_before(stream_again(), found)
    runs = [
        Run(
            number,
            pieces_of(stream_again(), None if captured else _day(s.first), blocks=(s.start, s.stop), before=before[k]),
            s.time_from,
            s.lag,
            is_last=k == len(found) - 1,
            whole=False,
        )
        for k, s in enumerate(found)
    ]
    file = replace(about_file(path, stream.told, None), order=order_words(found))
    span = min(s.time_from for s in found), max(s.time_to for s in found)
    problems = [told_dateless(path.name)] if clock.dateless else []
    return Indexed(path.name, span, not captured, runs, problems, file)


def table_run(path: Path, number: int) -> Indexed:
    """Look through the times of a table, whose rows may stand in any order; its rows are read when they are wanted."""
    start, newest, lag = np.inf, -np.inf, 0.0
    low, high = LIMITS["time"]
    for time in times_of_rows(path):
        told = time[(time >= low) & (time <= high)]
        if len(told):
            before = np.maximum.accumulate(np.append(newest, told))[:-1]
            lag = max(lag, float((before - told).max(initial=0.0, where=np.isfinite(before))))
            start, newest = min(start, float(told.min())), max(newest, float(told.max()))
    run = Run(number, read_table_pieces(path), start if np.isfinite(start) else -np.inf, lag)
    span = (start, newest) if np.isfinite(start) else (np.nan, np.nan)
    return Indexed(path.name, span, False, [run])


def _day(time: float) -> datetime.date:
    return datetime.date(1970, 1, 1) + datetime.timedelta(days=int(time // DAY))


def _records_before(stream: Stream, found: Sequence[Stretch]) -> list[Counter[int]]:
    """Records of each category before each stretch."""
    counts = [Counter[int]() for _ in found]
    n = 0
    for piece in stream.pieces():
        for number, held in stream.records(piece, TIMED).items():
            block = n + piece[number][1][held.records.block]
            for count, stretch in zip(counts, found, strict=True):
                count[number] += int(np.count_nonzero(block < stretch.start))
        n += sum(len(place) for _, place in piece.values())
    return counts


class InOrder:
    """Merges runs in order of time."""

    def __init__(self, files: Sequence[Indexed], memory: float) -> None:
        """Begin.

        Args:
            files: what the index of each tells.
            memory: bytes that reports may take while they wait for others.

        """
        self._files, self._memory = files, memory
        self._names = tuple(shown(f.name) for f in files)
        self._later = next_day([f.span for f in files], [f.plain for f in files])
        self._runs = [run for f in files for run in f.runs]
        for run in self._runs:
            run.start += DAY if run.file in self._later else 0.0
        self._held: list[Plots] = []
        self._released = -np.inf
        self._tallies = [Tally() for _ in files]
        self._problems: dict[str, None] = {}
        self._about: list[FileContents | None] = [f.file for f in files]
        self._rejected: dict[tuple[int, System], Counter[int]] = {}
        self._spans: dict[tuple[int, System], tuple[float, float]] = {}

    @property
    def span(self) -> tuple[float, float]:
        """First and last time that the index of the files tells, s, UTC; NaN where it tells none."""
        spans = [np.add(f.span, DAY if k in self._later else 0.0) for k, f in enumerate(self._files)]
        told = np.array([s for s in spans if np.isfinite(s).all()]).reshape(-1, 2)
        return (float(told[:, 0].min()), float(told[:, 1].max())) if len(told) else (np.nan, np.nan)

    def __iter__(self) -> Iterator[Recording]:
        """Yield the reports in chunks, and last what was read."""
        while open_runs := [run for run in self._runs if not run.done]:
            run = min(open_runs, key=lambda r: r.horizon)
            part, before = self._next(run), len(self._problems)
            plots = None if part is None else self._taken(run, part)
            ready = self._release(min(r.horizon for r in self._runs))
            some = [p for p in (plots, *ready) if p is not None and len(p)]
            tracks = None if part is None else part.tracks
            if some or tracks is not None:
                yield self._chunk(some, tracks, list(self._problems)[before:])
        yield self._last()

    def _next(self, run: Run) -> Part | None:
        part = next(run.parts, None)
        run.begun = True
        if part is None:
            run.done = True
            return None
        return shift(part, DAY) if run.file in self._later else part

    def _taken(self, run: Run, part: Part) -> Plots:
        """Mark the reports of a piece, hold the usable ones, and return the others."""
        part = printable(part)
        lines = part.contents if run.is_last else tuple(c for c in part.contents if c.n_records)
        self._tallies[run.file].add(lines)
        plots = replace(part.plots, files=self._names, file=np.full(len(part.plots), run.file, np.int32))
        reason, again = mark_values(plots)
        problems = mark_order(plots, reason, again, run.file, run.judge) if part.in_order else []
        usable = (reason == 0) & (plots.time < self._released)
        reason[usable] = _LATE
        self._problems |= dict.fromkeys((*part.problems, *problems))
        if part.file is not None and run.whole:
            self._about[run.file] = part.file
        plots = replace(plots, reason=reason)
        usable = reason == 0
        if usable.any():
            run.newest = max(run.newest, float(plots.time[usable].max()))
            self._held.append(plots.take(usable))
        self._refuse()
        return plots.take(~usable)

    def _refuse(self) -> None:
        n = sum(map(len, self._held))
        if n * PER_REPORT > self._memory:
            lag = max((r for r in self._runs if r.begun and not r.done), key=lambda r: r.lag)
            raise DataError(
                f"{self._names[lag.file]}: some of its reports come {lag.lag:.0f} s after others of a later time: "
                f"{n} reports wait for them, about {n * PER_REPORT / 1e9:.3g} GB, and {self._memory / 1e9:.3g} GB are "
                "allowed. Sort a table by time, or give more as memory (bytes) in the table [reading] of the "
                "configuration."
            )

    def _release(self, horizon: float) -> list[Plots]:
        """Take what is held and earlier than all that is yet to come."""
        ready, rest = [], []
        for plots in self._held:
            early = plots.time < horizon
            if early.all():
                ready.append(plots)
            elif early.any():
                ready.append(plots.take(early))
                rest.append(plots.take(~early))
            else:
                rest.append(plots)
        self._held, self._released = rest, max(self._released, horizon)
        return ready

    def _chunk(self, some: list[Plots], tracks: pa.Table | None, problems: list[str]) -> Recording:
        """Sort reports; of those that came from several runs some are duplicates."""
        plots = Plots.concat(some, same_files=True) if some else Plots.build(0, (), self._names, {})
        plots = plots.sorted_by_time()
        reason, _ = mark_values(plots)
        plots = replace(plots, reason=np.where((plots.reason == 0) & (reason == _DUPLICATE), reason, plots.reason))
        for key, own in self._by_source(plots):
            self._rejected.setdefault(key, Counter()).update(own.reason[own.reason > 0].tolist())
            times = own.time[credible_times(own)]
            if len(times):
                low, high = self._spans.get(key, (np.inf, -np.inf))
                self._spans[key] = min(low, float(times.min())), max(high, float(times.max()))
        lines = tuple(line for tally in self._tallies for line in tally.lines())
        return Recording(plots, None if tracks is None else tracks.sort_by("time"), lines, tuple(problems))

    def _by_source(self, plots: Plots) -> Iterator[tuple[tuple[int, System], Plots]]:
        for file in np.unique(plots.file).tolist():
            for k, source in enumerate(plots.sources):
                mine = (plots.file == file) & (plots.source == k)
                if mine.any():
                    yield (file, source.system), plots.take(mine)

    def _last(self) -> Recording:
        contents: list[Contents] = []
        for k, tally in enumerate(self._tallies):
            for line in tally.lines():
                key = k, line.system
                contents.append(completed(line, self._rejected.get(key, {}), self._spans.get(key)))
        told = [p for f in self._files for p in f.problems] + told_next_day(self._names, self._later)
        empty = Plots.build(0, (), self._names, {})
        files = tuple(f for f in self._about if f is not None)
        return Recording(empty, None, tuple(contents), (*self._problems, *told), files)
