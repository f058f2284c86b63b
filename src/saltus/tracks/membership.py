"""To which system track each local track belongs, and when: decisions as segments of time."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.identify import Episodes
from saltus.shapes import Float, Int

__all__ = ["Segments", "segments"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]

_PART, _BIRTH, _JOIN = 0, 1, 2  # the order of what happens at one time


class Segments(NamedTuple):
    """Each local track's time, cut where it moves from one system track to another; sorted by track, then by time."""

    track: Int[np.ndarray, " s"]  # local track, numbered through all systems
    time_from: Float[np.ndarray, " s"]  # s
    time_to: Float[np.ndarray, " s"]  # s; the next segment begins there
    system_track: Int[np.ndarray, " s"]  # from 1, in the order of their beginnings
    probability: Float[np.ndarray, " s"]  # that the local track is the system track's object; 1 of the first one

    def at(self, track: Int[np.ndarray, " n"], time: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
        """Return the segment of local tracks at times within their lives."""
        if not len(self.track):
            return np.zeros(len(track), np.int64)
        start = float(self.time_from.min())
        life = float(self.time_to.max()) - start + 1.0
        axis = self.track * life + (self.time_from - start)
        at = track * life + np.clip(time - start, 0.0, life - 0.5)
        return np.asarray(np.searchsorted(axis, at, side="right") - 1)


class _Event(NamedTuple):
    time: float
    kind: int
    a: int
    b: int


class _Groups:
    """System tracks as sets of local tracks; the older one survives when two meet, measured ones first."""

    def __init__(self, begin: _Array, end: _Array, foreign: npt.NDArray[np.bool_]) -> None:
        n = len(begin)
        self._begin, self._end, self._foreign = begin, end, foreign
        self._closed = np.zeros(n, bool)
        self._of = np.zeros(n, np.int64)  # system track of each local track born, 0 none
        self._since = begin.copy()
        self._links: set[tuple[int, int]] = set()
        self._next = 1
        self.found: list[tuple[int, float, float, int]] = []

    def birth(self, k: int) -> None:
        self._of[k] = self._next
        self._next += 1

    def join(self, a: int, b: int, now: float) -> None:
        self._links.add((a, b))
        x, y = sorted((int(self._of[a]), int(self._of[b])), key=lambda of: (self._unmeasured(of), of))
        if x != y:
            self._move(np.flatnonzero(self._of == y), x, now)

    def part(self, a: int, b: int, now: float) -> None:
        """Take a link away: what hangs together with the first member of the system track keeps it."""
        self._links.discard((a, b))
        members = np.flatnonzero(self._of == self._of[a])
        parts = self._components(members.tolist())
        oldest = min(members.tolist(), key=lambda k: (self._foreign[k], self._begin[k], k))
        for part in parts:
            if oldest not in part:
                self._move(np.array(sorted(part)), self._next, now)
                self._next += 1

    def _unmeasured(self, of: int) -> bool:
        return bool(self._foreign[self._of == of].all())

    def _components(self, members: list[int]) -> list[set[int]]:
        parts: list[set[int]] = []
        for k in members:
            linked = {k} | {y for x, y in self._links if x == k} | {x for x, y in self._links if y == k}
            touching = [p for p in parts if p & linked]
            parts = [p for p in parts if not p & linked] + [{k}.union(*touching, linked & set(members))]
        return parts

    def _move(self, members: _Index, to: int, now: float) -> None:
        for k in members.tolist():
            if now >= self._end[k]:
                self._close(k)
            elif now > self._since[k]:
                self.found.append((k, float(self._since[k]), now, int(self._of[k])))
                self._since[k] = now
            self._of[k] = to

    def _close(self, k: int) -> None:
        if not self._closed[k] and self._end[k] >= self._since[k]:
            self.found.append((k, float(self._since[k]), float(self._end[k]), int(self._of[k])))
        self._closed[k] = True

    def close(self) -> None:
        """End all lives."""
        for k in np.flatnonzero(self._of).tolist():
            self._close(k)


def segments(
    begin: _Array,
    ready: _Array,
    end: _Array,
    episodes: Episodes,
    settle: float,
    *,
    foreign: npt.NDArray[np.bool_] | None = None,
) -> Segments:
    """Cut the lives of local tracks at the decisions about them.

    Two local tracks that are one object belong to one system track, the older one's, from the decision on; when the
    decision is taken back while both live, the one that does not hang together with the oldest local track gets a new
    system track. A track that ends takes nothing with it. A decision within `settle` seconds of the later track's
    confirmation holds from that track's beginning.

    Args:
        begin: first report of each local track, (K,), s.
        ready: its confirmation, (K,), s.
        end: its last report, (K,), s.
        episodes: which tracks were one object, and when.
        settle: s.
        foreign: which are another centre's, (K,); a number stays with the tracks that have measurements. None: none is.
    """
    groups = _Groups(begin, end, np.zeros(len(begin), bool) if foreign is None else foreign)
    for event in sorted(_events(ready, end, episodes, settle)):
        if event.kind == _BIRTH:
            groups.birth(event.a)
        elif event.kind == _JOIN:
            now = event.time
            later = event.a if ready[event.a] >= ready[event.b] else event.b
            groups.join(event.a, event.b, float(begin[later]) if now <= ready[later] else now)
        else:
            groups.part(event.a, event.b, event.time)
    groups.close()
    if not groups.found:
        none = np.zeros(0)
        return Segments(none.astype(np.int64), none, none, none.astype(np.int64), none)
    track, since, until, of = (np.array(column) for column in zip(*sorted(groups.found), strict=True))
    first = begin if foreign is None else begin + np.where(foreign, np.ptp(begin) + 1.0, 0.0)
    return Segments(track, since, until, _numbered(of, since), _probability(track, since, until, of, first, episodes))


def _events(ready: _Array, end: _Array, episodes: Episodes, settle: float) -> Iterable[_Event]:
    for k, time in enumerate(ready.tolist()):
        if np.isfinite(time):
            yield _Event(time, _BIRTH, k, k)
    for a, b, since, until, _ in zip(*episodes, strict=True):
        born = float(max(ready[a], ready[b]))
        if not np.isfinite(born) or until < born:
            continue
        yield _Event(born if since <= born + settle else float(since), _JOIN, int(a), int(b))
        if until < min(end[a], end[b]):  # both live on: a change of mind
            yield _Event(max(float(until), born if since <= born + settle else float(since)), _PART, int(a), int(b))


def _numbered(of: _Index, since: _Array) -> _Index:
    """Number system tracks from 1 in the order of their beginnings."""
    names, place = np.unique(of, return_inverse=True)
    first = np.full(len(names), np.inf)
    np.minimum.at(first, place, since)
    rank = np.empty(len(names), np.int64)
    rank[np.lexsort((names, first))] = np.arange(1, len(names) + 1)
    return np.asarray(rank[place])


def _probability(track: _Index, since: _Array, until: _Array, of: _Index, begin: _Array, episodes: Episodes) -> _Array:
    """Of each segment: 1 of the oldest local track, else that of its best link while the segment lasts."""
    out = np.ones(len(track))
    oldest: dict[int, int] = {}
    for k in np.argsort(begin[track], kind="stable").tolist():
        oldest.setdefault(int(of[k]), int(track[k]))
    for s in range(len(track)):
        if oldest[int(of[s])] == track[s]:
            continue
        mine = (episodes.a == track[s]) | (episodes.b == track[s])
        mine &= (episodes.time_from <= until[s]) & (episodes.time_to >= since[s])
        if mine.any():
            out[s] = float(np.clip(episodes.probability[mine].max(), 0.0, 1.0))
    return out
