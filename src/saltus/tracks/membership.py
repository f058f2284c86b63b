"""To which system track each local track belongs: decisions, each of which holds backwards, as segments of time.

An *object* is what hangs together: local tracks joined by the links that decisions made between them. A link holds from
the time since which the evidence did not contradict it, mostly the beginning of the later track. Where it did, one of
both tracks went from one object over to another: it is cut there into two *pieces*, which may belong to different
objects. The same is done where a decision is taken back. Every piece gets a number when it becomes known, from one
counter; an object's number is the least of its pieces', measured ones first. So an object has one number from its first
report, and the number that a piece had before it was found to be a part of an older object is merged into that one's.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.shapes import Float, Int

__all__ = ["Change", "KnownSince", "Local", "Membership", "Merger", "Segments"]

_Array = npt.NDArray[np.float64]

_FOREIGN = 10**15  # numbers of another centre's tracks, which are never published, begin here


class Segments(NamedTuple):
    """Each local track's time, cut where it moves from one system track to another; sorted by track, then by time."""

    track: Int[np.ndarray, " s"]  # local track, numbered through all systems
    time_from: Float[np.ndarray, " s"]  # s
    time_to: Float[np.ndarray, " s"]  # s; the next segment begins there
    system_track: Int[np.ndarray, " s"]  # number of the object
    probability: Float[np.ndarray, " s"]  # that the local track is its object; 1 of the one that names it
    time_known: Float[np.ndarray, " s"]  # s: when that became known

    def at(self, track: Int[np.ndarray, " n"], time: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
        """Return the segment of local tracks at times within their lives."""
        if not len(self.track):
            return np.zeros(len(track), np.int64)
        start = float(self.time_from.min())
        life = float(self.time_to.max()) - start + 1.0
        axis = self.track * life + (self.time_from - start)
        at = track * life + np.clip(time - start, 0.0, life - 0.5)
        first = np.searchsorted(self.track, track)
        return np.asarray(np.maximum(np.searchsorted(axis, at, side="right") - 1, first))


class Merger(NamedTuple):
    """A local track's system track was found to be another one: its number is not used any more."""

    track: int  # local track
    number: int  # of the system track until then
    into: int
    time_from: float  # s: since when the local track was a part of it
    known: float  # s


class Change(NamedTuple):
    """From a time on, what a system track is made of is otherwise than was thought."""

    number: int  # of the system track
    time_from: float  # s
    known: float  # s


class Local(NamedTuple):
    """A local track."""

    begin: float  # s, of its first report
    system: int
    address: int = -1  # -1 unknown
    foreign: bool = False  # another centre's


class _Span(NamedTuple):
    begin: float
    number: int
    probability: float
    known: float


class _Piece(NamedTuple):
    track: int
    place: int  # among the pieces of its track


@dataclass(slots=True, eq=False)
class _Link:
    a: int
    b: int
    begin: float
    end: float  # inf while it holds
    probability: float


class Membership:
    """Objects as sets of pieces of local tracks, changed by what becomes known, in that order."""

    def __init__(self) -> None:
        """Begin without tracks."""
        self._local: dict[int, Local] = {}
        self._cuts: dict[int, list[float]] = {}  # where the pieces of each track begin
        self._number: dict[int, list[int]] = {}  # of each piece
        self._links: dict[int, list[_Link]] = {}
        self._spans: dict[int, list[_Span]] = {}  # what holds now
        self._ended: dict[int, float] = {}  # s: last report of each track that has
        self._next = {False: 1, True: _FOREIGN}
        self._touched: set[int] = set()  # tracks with news that nobody has taken
        self.mergers: list[Merger] = []
        self.changes: list[Change] = []

    def birth(self, k: int, local: Local, known: float) -> None:
        """A local track is confirmed."""
        self._local[k], self._links[k] = local, []
        number = self._numbered(k)
        self._cuts[k], self._number[k] = [local.begin], [number]
        self._spans[k] = [_Span(local.begin, number, 1.0, known)]
        self.changes.append(Change(number, local.begin, known))
        self._touched.add(k)

    def _numbered(self, k: int) -> int:
        foreign = self._local[k].foreign
        self._next[foreign] += 1
        return self._next[foreign] - 1

    def born_as(self, k: int) -> int:
        """Return the number that a local track got when it was confirmed."""
        return self._number[k][0]

    def join(self, a: int, b: int, since: float, known: float, probability: float) -> None:
        """Two local tracks are one object since a time.

        Links taken back that say otherwise since then give way: one of a track with another track of the same system.
        Where the evidence said otherwise before, or both have been parts of objects of different addresses, a track
        without an address went over from one object to the other.
        """
        both = max(self._local[a].begin, self._local[b].begin)
        since = max(since, both, self._held(a, b), self._held(b, a))
        touched = self._around(a, b)
        self._overrule(a, b, since)
        self._overrule(b, a, since)
        if since > both or self._clash(a, b, since):
            self._cut(self._mover(a, b), since)
        link = _Link(a, b, since, np.inf, probability)
        self._links[a].append(link)
        self._links[b].append(link)
        self._renew(touched | self._around(a, b), known)

    def part(self, a: int, b: int, at: float, known: float) -> None:
        """Two local tracks that live on are two objects, from a time on."""
        touched = self._around(a, b)
        for link in [x for x in self._links[a] if {x.a, x.b} == {a, b} and x.end == np.inf]:
            self._end(link, at)
        self._cut(self._mover(a, b), max(at, *(self._local[k].begin for k in (a, b))))
        self._renew(touched | self._around(a, b), known)

    def _held(self, a: int, b: int) -> float:
        """Return until when a was one object with another track of b's system, that ended and was never given up."""
        others = {x.b if x.a == a else x.a for x in self._links[a] if x.end == np.inf} - {b}
        system = self._local[b].system
        rivals = [k for k in others if self._local[k].system == system != self._local[a].system]
        return max((self._ended[k] for k in rivals if k in self._ended), default=-np.inf)

    def named(self, k: int, address: int) -> None:
        """A local track's address has become known, or is another one."""
        self._local[k] = self._local[k]._replace(address=address)

    def revived(self, k: int) -> None:
        """A local track thought to have ended has not."""
        self._ended.pop(k, None)

    def death(self, k: int, last: float) -> None:
        """A local track has ended, with a report at `last`, s."""
        self._ended[k] = last

    def _end(self, link: _Link, at: float) -> None:
        link.end = min(link.end, at)
        if link.end <= link.begin:
            self._links[link.a].remove(link)
            self._links[link.b].remove(link)

    def _overrule(self, a: int, b: int, since: float) -> None:
        """End a's links, taken back before, with other tracks of b's system that lived on."""
        for link in [x for x in self._links[a] if since < x.end < np.inf]:
            other = link.b if link.a == a else link.a
            if other != b and self._local[other].system == self._local[b].system:
                self._end(link, since)

    def _mover(self, a: int, b: int) -> int:
        """Return which of two tracks is the one that went over.

        Another centre's; one without an address; that has ended since; that hangs together with fewer; the later one.
        """

        def likely(k: int) -> tuple[bool, bool, bool, int, int]:
            local, held = self._local[k], sum(link.end == np.inf for link in self._links[k])
            return local.foreign, local.address < 0, k in self._ended, -held, self._number[k][0]

        return max((a, b), key=likely)

    def _cut(self, k: int, at: float) -> None:
        place = int(np.searchsorted(self._cuts[k], at))
        if place < len(self._cuts[k]) and self._cuts[k][place] == at:
            return
        self._cuts[k].insert(place, at)
        self._number[k].insert(place, self._numbered(k))

    def _clash(self, a: int, b: int, since: float) -> bool:
        """Say whether the objects of two tracks at a time have different addresses."""
        of = [{self._local[p.track].address for p in self._object(self._piece(k, since))} - {-1} for k in (a, b)]
        return bool(of[0] and of[1] and of[0] != of[1])

    def _piece(self, k: int, time: float) -> _Piece:
        return _Piece(k, max(int(np.searchsorted(self._cuts[k], time, side="right")) - 1, 0))

    def _reach(self, piece: _Piece) -> tuple[float, float]:
        cuts, last = self._cuts[piece.track], self._ended.get(piece.track, np.inf)
        return cuts[piece.place], min(cuts[piece.place + 1], last) if piece.place + 1 < len(cuts) else last

    def _beside(self, piece: _Piece) -> Iterable[_Piece]:
        """Pieces to which links lead from a piece."""
        begin, end = self._reach(piece)
        for link in self._links[piece.track]:
            low, high = max(begin, link.begin), min(end, link.end)
            other = link.b if link.a == piece.track else link.a
            if low < high:
                for place in range(len(self._cuts[other])):
                    first, last = self._reach(_Piece(other, place))
                    if max(first, low) < min(last, high):
                        yield _Piece(other, place)

    def _object(self, piece: _Piece) -> set[_Piece]:
        """Everything that hangs together with a piece."""
        found, open_ = {piece}, [piece]
        while open_:
            for near in self._beside(open_.pop()):
                if near not in found:
                    found.add(near)
                    open_.append(near)
        return found

    def _around(self, a: int, b: int) -> set[int]:
        """Tracks of the objects of all pieces of two tracks."""
        pieces = [_Piece(k, place) for k in (a, b) for place in range(len(self._cuts[k]))]
        return {p.track for piece in pieces for p in self._object(piece)}

    def _renew(self, tracks: set[int], known: float) -> None:
        """Find the numbers of tracks anew; note what is new since `known`."""
        self._touched |= tracks
        before = {k: self._spans[k] for k in tracks}
        names: dict[_Piece, _Piece] = {}
        for k in sorted(tracks):
            self._spans[k] = self._renewed(k, before[k], names, known)
        current = {spans[-1].number for k in tracks for spans in (self._spans[k],)}
        for k in sorted(tracks):
            old, new = before[k][-1], self._spans[k][-1]
            if old.number != new.number and old.number not in current and old.known < known:
                self.mergers.append(Merger(k, old.number, new.number, old.begin, known))

    def _renewed(self, k: int, before: list[_Span], names: dict[_Piece, _Piece], known: float) -> list[_Span]:
        out: list[_Span] = []
        for place in range(len(self._cuts[k])):
            piece = _Piece(k, place)
            if piece not in names:
                members = self._object(piece)
                names |= dict.fromkeys(members, min(members, key=self._rank))
            name, (begin, end) = names[piece], self._reach(piece)
            number, probability = self._number[name.track][name.place], self._probability(piece, name)
            starts = [begin, *(s.begin for s in before if begin < s.begin < end)]
            for start in starts:
                old = before[max(int(np.searchsorted([s.begin for s in before], start, side="right")) - 1, 0)]
                same = old.number == number
                if not same:
                    self.changes += [Change(n, start, known) for n in (old.number, number)]
                span = _Span(start, number, old.probability if same else probability, old.known if same else known)
                if not out or out[-1][1:] != span[1:]:
                    out.append(span)
        return out

    def _rank(self, piece: _Piece) -> tuple[bool, int]:
        return self._local[piece.track].foreign, self._number[piece.track][piece.place]

    def _probability(self, piece: _Piece, name: _Piece) -> float:
        """Return 1 of the track that names the object, else the probability of the best of its own links."""
        if piece.track == name.track:
            return 1.0
        begin, end = self._reach(piece)
        mine = [x.probability for x in self._links[piece.track] if max(begin, x.begin) < min(end, x.end)]
        return float(np.clip(max(mine, default=1.0), 0.0, 1.0))

    def current(self, k: int) -> int:
        """Return the number that a local track has now."""
        return self._spans[k][-1].number

    def news(self, end: _Array, since: float) -> tuple[Segments, list[Merger]]:
        """Take what became known after `since`; `end` is the time of the last report of each local track, s."""
        found, mergers = self.segments(end, self._touched), [m for m in self.mergers if m.known > since]
        self._touched = set()
        return Segments(*(column[found.time_known > since] for column in found)), mergers

    def segments(self, end: _Array, tracks: Collection[int] | None = None) -> Segments:
        """Return what holds now, of some local tracks or all; `end` is the time of the last report of each, s."""
        rows = []
        for k in sorted(self._spans if tracks is None else tracks):
            last = float(end[k])
            spans = [s for s in self._spans[k] if s.begin < last] or self._spans[k][:1]
            stops = [*(s.begin for s in spans[1:]), last]
            rows += [(k, s.begin, stop, s.number, s.probability, s.known) for s, stop in zip(spans, stops, strict=True)]
        if not rows:
            none, nobody = np.zeros(0), np.zeros(0, np.int64)
            return Segments(nobody, none, none, nobody, none, none)
        return Segments(*(np.array(column) for column in zip(*rows, strict=True)))


class KnownSince:
    """When it became known what system tracks are made of."""

    def __init__(self, changes: Sequence[Change]) -> None:
        """Take all changes of memberships."""
        of, since, known = (
            (np.array(column) for column in zip(*changes, strict=True)) if changes else (np.zeros(0),) * 3
        )
        order = np.lexsort((since, of))
        self._number, first = np.unique(of[order], return_index=True)
        self._since = np.split(since[order], first[1:])
        latest = np.split(known[order], first[1:])
        self._latest = [np.append(-np.inf, np.maximum.accumulate(known)) for known in latest]

    def at(self, number: Int[np.ndarray, " n"], time: _Array) -> _Array:
        """Return when it was known what system tracks are made of up to given times, (n,), s; -inf: always.

        Args:
            number: system tracks, (n,).
            time: up to which their reports count, (n,), s.
        """
        out = np.full(len(number), -np.inf)
        if not len(number):
            return out
        order = np.argsort(number, kind="stable")
        numbers, first = np.unique(number[order], return_index=True)
        for n, rows in zip(numbers.tolist(), np.split(order, first[1:]), strict=True):
            k = int(np.searchsorted(self._number, n))
            if k < len(self._number) and self._number[k] == n:
                out[rows] = self._latest[k][np.searchsorted(self._since[k], time[rows], side="right")]
        return out
