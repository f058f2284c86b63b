"""A recording through a session: fed in pieces, saved on the way, taken up again."""

import hashlib
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from saltus.config import Config
from saltus.engine import Result, Session
from saltus.engine.checkpoint import begin_anew, has_checkpoint
from saltus.errors import DataError
from saltus.progress import Progress
from saltus.records import Contents, Plots, Recording
from saltus.run.problems import refuse_unusable
from saltus.run.seen import Seen

__all__ = ["Feeding", "Followed", "fingerprint", "follow", "told_periods"]

_CHUNK, _OFTEN = 10_000, 1_000  # reports fed at a time, and where states are saved in between


@dataclass(frozen=True, slots=True)
class Feeding:
    """How a recording is fed.

    Attributes:
        chunk: reports fed at a time; 0: as is best.
        folder: where states are saved, if they are.
        every: s of data between two.
        resume: whether to go on from the state in `folder`.
    """

    chunk: int = 0
    folder: Path | None = None
    every: float = 600.0
    resume: bool = False

    @property
    def size(self) -> int:
        """Reports fed at a time, at most."""
        return self.chunk or (_CHUNK if self.folder is None else _OFTEN)


class Followed(NamedTuple):
    """What became of a recording."""

    result: Result
    seen: Seen
    lines: list[str]  # on how it came about


def follow(
    pieces: Iterable[Recording],
    config: Config,
    bar: Progress,
    feeding: Feeding | None = None,
    told: Mapping[str, Any] | None = None,
    *,
    use_identity: bool = True,
    span: tuple[float, float] = (np.nan, np.nan),
) -> Followed:
    """Track a recording.

    Args:
        pieces: of it, reports in order of time from first to last, all usable or marked; a whole recording is one.
        config: what is configured.
        bar: shows progress.
        feeding: in which pieces, and whether states are saved.
        told: what must be the same where a run is taken up again.
        use_identity: whether addresses and codes count.
        span: first and last time of the recording, s, to show how far the run is; NaN: not known.

    Raises:
        DataError: nothing can be tracked, or the state saved is of other inputs.
    """
    feeding, told = feeding or Feeding(), dict(told or {})
    session, lines = _session(config, bar, feeding, told, use_identity=use_identity)
    seen, foreign = Seen(config), _Foreign()
    begin, saved, newest = session.reports, session.notes.get("time", -np.inf), -np.inf
    with _interruptible(feeding.folder is not None) as interrupted:
        for piece in pieces:
            before, plots = seen.n, piece.plots
            seen.add(piece)
            foreign.add(piece.tracks)
            session.tell_periods(told_periods(seen.contents))
            for start, stop in _cuts(len(plots), feeding.size, begin - before):
                newest = max(
                    newest, float(plots.time[start:stop].max(where=plots.reason[start:stop] == 0, initial=-np.inf))
                )
                tracks = foreign.until(newest)
                if before + stop <= begin:
                    continue  # fed before the state was saved
                session.feed(plots.take(slice(start, stop)), tracks)
                bar.working("tracking", _share(newest, span))
                due, stopped = np.isfinite(newest) and newest >= saved + feeding.every, interrupted()
                if feeding.folder is not None and (stopped or due):
                    session.save(feeding.folder, {"inputs": told, "time": newest})
                    saved = newest
                if stopped:
                    raise KeyboardInterrupt(f"the state is saved in {feeding.folder}; go on from there with --resume")
    refuse_unusable(seen)
    session.feed(Plots.build(0, (), (), {}), foreign.until(np.inf))
    return Followed(session.finish(), seen, lines)


def fingerprint(paths: Sequence[Path]) -> dict[str, str]:
    """Return a digest of the content of each file, by name."""
    found = {}
    for path in paths:
        with path.open("rb") as file:
            found[str(path)] = hashlib.file_digest(file, "blake2b").hexdigest()[:32]
    return found


def _session(
    config: Config, bar: Progress, feeding: Feeding, told: dict[str, Any], *, use_identity: bool
) -> tuple[Session, list[str]]:
    """Open a session, or take one up again."""
    folder = feeding.folder
    if feeding.resume and folder is not None and has_checkpoint(folder):
        session = Session.restore(folder, bar)
        changed = _changed(session.notes.get("inputs", {}), told)
        if changed:
            raise DataError(
                f"{folder}: the state saved there is of another run: changed since are {', '.join(changed)}. Give "
                "the same inputs and options, or begin anew without --resume."
            )
        return session, [f"went on from report {session.reports} of the state in {folder}."]
    lines = []
    if folder is not None:
        begin_anew(folder)
        if feeding.resume:
            lines.append(f"{folder} holds no state yet: begun from the first report.")
    session = Session.open(config, use_identity=use_identity, hold=0.0, folder=folder, bar=bar, running=False)
    return session, lines


def _changed(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Name what differs."""
    out = []
    for name in dict.fromkeys([*before, *now]):
        a, b = before.get(name), now.get(name)
        if isinstance(a, dict) and isinstance(b, dict):
            out += _changed(a, b)
        elif a != b:
            out.append(name)
    return out


def told_periods(contents: Sequence[Contents]) -> dict[str, float]:
    """Return the update period of each source that the readers tell, s."""
    found: dict[str, list[float]] = {}
    for line in contents:
        if np.isfinite(line.update_period) and line.update_period > 0:
            found.setdefault(str(line.system), []).append(line.update_period)
    return {name: float(np.median(told)) for name, told in found.items()}


def _cuts(n: int, size: int, begin: int) -> Iterator[tuple[int, int]]:
    """Cut `n` reports into pieces of `size`, and at `begin` if that lies among them."""
    edges = sorted({*range(0, n, size), n, *([begin] if 0 < begin < n else [])})
    return pairwise(edges)


def _share(now: float, span: tuple[float, float]) -> float:
    """How far a time lies in a span."""
    first, last = span
    return (now - first) / (last - first) if np.isfinite(now) and last > first else 0.0


class _Foreign:
    """Another centre's tracks that wait for the reports of their time."""

    def __init__(self) -> None:
        self._waiting: pa.Table | None = None

    def add(self, tracks: pa.Table | None) -> None:
        """Take the tracks that a reader gives, in whatever order."""
        parts = [t for t in (self._waiting, tracks) if t is not None]
        if parts:
            self._waiting = pa.concat_tables(parts).sort_by("time")

    def until(self, now: float) -> pa.Table | None:
        """Let those up to a time go."""
        if self._waiting is None:
            return None
        time = self._waiting["time"].to_numpy(zero_copy_only=False)
        n = int(np.searchsorted(time, now, side="right"))
        ready, self._waiting = self._waiting.slice(0, n), self._waiting.slice(n)
        return ready


@contextmanager
def _interruptible(wanted: bool) -> Iterator[Callable[[], bool]]:
    """Give a function that says whether Ctrl-C was pressed, where a piece may be finished first; twice ends at once."""
    pressed: list[int] = []
    if not wanted or threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return

    def note(number: int, frame: object) -> None:
        if pressed:
            raise KeyboardInterrupt
        pressed.append(number)

    before = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(pressed)
    finally:
        signal.signal(signal.SIGINT, before)
