"""A recording through a session: fed in pieces, saved on the way, taken up again."""

import hashlib
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.config import Config
from saltus.engine import Result, Session
from saltus.engine.checkpoint import begin_anew, has_checkpoint
from saltus.errors import DataError
from saltus.progress import Progress
from saltus.records import Recording

__all__ = ["Feeding", "fingerprint", "follow", "told_periods"]

_CHUNK, _OFTEN = 50_000, 1_000  # reports fed at a time, and where states are saved in between


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


def follow(
    recording: Recording,
    config: Config,
    bar: Progress,
    feeding: Feeding | None = None,
    told: Mapping[str, Any] | None = None,
    *,
    use_identity: bool = True,
) -> tuple[Result, list[str]]:
    """Track a recording.

    Args:
        recording: reports in order of time, all usable or marked.
        config: what is configured.
        bar: shows progress.
        feeding: in which pieces, and whether states are saved.
        told: what must be the same where a run is taken up again.
        use_identity: whether addresses and codes count.

    Returns:
        The result, and lines on how it came about.

    Raises:
        DataError: nothing can be tracked, or the state saved is of other inputs.
    """
    feeding, told = feeding or Feeding(), dict(told or {})
    session, lines = _session(recording, config, bar, feeding, told, use_identity=use_identity)
    plots, tracks = recording.plots, _by_time(recording.tracks)
    newest = np.maximum.accumulate(np.where(plots.reason == 0, plots.time, -np.inf))
    chunk = feeding.chunk or (_CHUNK if feeding.folder is None else _OFTEN)
    begin, saved = session.reports, session.notes.get("time", -np.inf)
    with _interruptible(feeding.folder is not None) as interrupted:
        for start in range(begin, len(plots), chunk):
            stop = min(start + chunk, len(plots))
            now = float(newest[stop - 1])
            session.feed(plots.take(slice(start, stop)), _between(tracks, start, stop, newest))
            bar.working("tracking", stop / len(plots))
            due, stopped = np.isfinite(now) and now >= saved + feeding.every, interrupted()
            if feeding.folder is not None and (stopped or (due and stop < len(plots))):
                session.save(feeding.folder, {"inputs": told, "time": now})
                saved = now
            if stopped:
                raise KeyboardInterrupt(f"the state is saved in {feeding.folder}; go on from there with --resume")
    return session.finish(), lines


def fingerprint(paths: Sequence[Path]) -> dict[str, str]:
    """Return a digest of the content of each file, by name."""
    found = {}
    for path in paths:
        with path.open("rb") as file:
            found[str(path)] = hashlib.file_digest(file, "blake2b").hexdigest()[:32]
    return found


def _session(
    recording: Recording, config: Config, bar: Progress, feeding: Feeding, told: dict[str, Any], *, use_identity: bool
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
    periods = told_periods(recording)
    session = Session.open(config, use_identity=use_identity, periods=periods, hold=0.0, folder=folder, bar=bar)
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


def told_periods(recording: Recording) -> dict[str, float]:
    """Return the update period of each source that the readers tell, s."""
    found: dict[str, list[float]] = {}
    for line in recording.contents:
        if np.isfinite(line.update_period) and line.update_period > 0:
            found.setdefault(str(line.system), []).append(line.update_period)
    return {name: float(np.median(told)) for name, told in found.items()}


def _by_time(tracks: pa.Table | None) -> pa.Table | None:
    if tracks is None:
        return None
    time = tracks["time"].to_numpy(zero_copy_only=False)
    return tracks.take(pa.array(np.argsort(time, kind="stable")))


def _between(tracks: pa.Table | None, start: int, stop: int, newest: npt.NDArray[np.float64]) -> pa.Table | None:
    """Another centre's tracks that came with reports: up to the newest time of these, the last ones with the last."""
    if tracks is None:
        return None
    time = tracks["time"].to_numpy(zero_copy_only=False)
    low = 0 if start == 0 else int(np.searchsorted(time, newest[start - 1], side="right"))
    high = len(time) if stop == len(newest) else int(np.searchsorted(time, newest[stop - 1], side="right"))
    return tracks.slice(low, high - low)


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
