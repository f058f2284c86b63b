"""Where a recording goes on after bytes that are no frame."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.framing.capture import MAGIC
from saltus.framing.containers import CONTAINERS, Container
from saltus.framing.guess import CHAIN, ENOUGH, Credible, begins_capture, sensible
from saltus.framing.scan import HEADER, Known, Scan
from saltus.framing.twins import Scanner

__all__ = ["LOOK", "Astray", "View", "admitted", "lying", "next_frame", "next_framing"]

LOOK = 1 << 19  # bytes that must be at hand behind a place before it is judged, unless the recording ends
_UNKNOWN, _RUN = 32, 1 << 18  # blocks, and bytes, of unassigned categories in a row
_Bytes = npt.NDArray[np.uint8]


class View(NamedTuple):
    """The bytes at hand and what judges them."""

    data: _Bytes
    final: bool  # the recording ends with them
    known: Known
    scanner: Scanner
    credible: Credible

    @property
    def last(self) -> int:
        """The last place that can be judged."""
        return len(self.data) - (1 if self.final else LOOK)

    def records(self, start: int, stop: int) -> bool | None:
        """What the definitions say of the block data[start:stop]."""
        return self.credible(int(self.data[start]), self.data[start + HEADER : stop].tobytes())

    def size(self, at: int) -> int:
        """What the block at a place says of its length; 0 where no header is left."""
        return int(self.data[at + 1]) << 8 | int(self.data[at + 2]) if at + HEADER <= len(self.data) else 0


def admitted(view: View, position: int, c: Container) -> list[int]:
    """Unassigned categories of the blocks at `position` that are real, since they lead to believable frames.

    Real are also four in a row of one category, and any up to the very end of the recording.
    """
    met: list[int] = []
    data, at = view.data, position
    while at + HEADER <= len(data) and len(met) < _UNKNOWN and at - position < _RUN:
        size, category = view.size(at), int(data[at])
        if size <= HEADER or at + size + c.trailer > len(data):
            return []
        if view.known[category]:
            return met if met and _stands(view, at, c) else []
        met.append(category)
        at += size + c.trailer
        if met[-4:] == [category] * 4:
            return met
    return met if at == len(data) and view.final and len(met) >= CHAIN else []


def _stands(view: View, position: int, c: Container) -> bool:
    """Whether believable frames of a container begin here, as few as are left."""
    held = view.scanner.holds(view.data, position, len(view.data), c, view.known, CHAIN)
    if c.weak:
        return held and sensible(_window(view, position), 0, c, view.credible)
    return held


def _window(view: View, position: int) -> _Bytes:
    return view.data[position : position + LOOK]


class Astray(NamedTuple):
    """A block that hides what begins within it."""

    block: int  # its number
    position: int  # where the next frame, or a recording of another framing, begins
    framing: str = ""  # the other framing, and
    header: int = 0  # the size of its file header


def lying(view: View, found: Scan, c: Container, back: int, *, others: bool) -> Astray | None:
    """The block whose false length led astray to `found.position`, and where the next one begins.

    Looked for among the last blocks that follow no definition. One that its recording's end cuts off may also hide
    where a recording of another framing begins, if `others` are wanted.
    """
    first = len(found.offset)
    lowest = max(0, first - back)
    while first > lowest and view.records(*_span(found, first - 1)) is not True:
        first -= 1
    last, position = found.position - 1, -1
    if first < len(found.offset):
        position = _within(view, int(found.offset[first]) + 1, last, c)
    if others and len(found.offset):  # few bytes of another header in a block's last item hurt no definition
        start = int(found.offset[min(first, len(found.offset) - 1)]) + 1
        other = next_framing(view, start, last, c.name)
        if other is not None and (position < 0 or other[0] < position):
            return Astray(int(np.searchsorted(found.offset, other[0])) - 1, *other)
    return None if position < 0 else Astray(int(np.searchsorted(found.offset, position)) - 1, position)


def overlong(view: View, found: Scan, count: int, c: Container, longest: npt.NDArray[np.int32]) -> Astray | None:
    """The first block longer than all of its category before it that hides believable ones, and where these begin.

    A false length may lead to where another block begins, by accident, and nothing breaks.

    Args:
        view: the bytes at hand.
        found: what was found in them.
        count: blocks of it that are judged.
        c: the container.
        longest: (256,) greatest length of the blocks so far of each category; grows.
    """
    k = 0
    while k < count:
        longer = np.flatnonzero(found.length[k:count] > longest[found.category[k:count]])
        if not len(longer):
            break
        k += int(longer[0])
        start, stop = _span(found, k)
        if view.records(start, stop) is not True:
            position = _within(view, start + 1, stop - 1, c)
            if position >= 0:
                return Astray(k, position)
        longest[found.category[k]] = stop - start
    return None


def _within(view: View, start: int, last: int, c: Container) -> int:
    """The first place from `start` up to `last` from where frames are believable, -1 = none."""
    position, last = start - 1, min(last, view.last)
    while True:
        position = view.scanner.find(view.data, position + 1, last, len(view.data), c, view.known, CHAIN)
        if position < 0 or sensible(_window(view, position), 0, c, view.credible):
            return position


def _span(found: Scan, k: int) -> tuple[int, int]:
    start = int(found.offset[k])
    return start, start + int(found.length[k])


def next_frame(view: View, start: int, c: Container) -> int:
    """Where frames of this container go on, from `start`; -1 = not in the bytes that can be judged."""
    position = start - 1
    while True:
        position = view.scanner.find(view.data, position + 1, view.last, len(view.data), c, view.known, CHAIN)
        if position < 0 or not c.weak or sensible(_window(view, position), 0, c, view.credible):
            break
    if position < 0 and view.final:
        position = _single(view, max(start, len(view.data) - LOOK), c)
    return position


def _single(view: View, start: int, c: Container) -> int:
    """The first single frame near the end of the recording whose blocks follow a definition."""
    n, position = len(view.data), start - 1
    while True:
        position = view.scanner.find(view.data, position + 1, n, n, c, view.known, 1)
        if position < 0:
            return -1
        frame = view.scanner.scan(
            view.data[: min(position + LOOK, n)], position, min(position + LOOK, n), c, view.known
        )
        follows = int(frame.frame[1]) if len(frame.frame) > 1 else frame.position
        believed = not c.weak or follows >= n - HEADER or bool(view.known[view.data[follows]])
        if believed and len(frame.offset) and view.records(*_span(frame, 0)) is True:
            return position


def next_framing(
    view: View, start: int, last: int, current: str, *, short: bool = False
) -> tuple[int, str, int] | None:
    """Where another framing than the current one begins, up to `last`: place, name, and size of its file header.

    Where the last frame may only be cut `short`, a container must begin in its place; with a file header,
    also behind less than a block's header.
    """
    best: tuple[int, str, int] | None = None
    for c in CONTAINERS:
        if c.name != current:
            behind = HEADER - 1 if c.file_header else 0
            furthest = start + behind if short else last if best is None else best[0] - 1
            place = _other(view, start, furthest + c.file_header, c)
            header = c.file_header if place - c.file_header >= start else 0
            if 0 <= place - header <= furthest:
                best = place - header, c.name, header
    text = view.data[start : last + 12].tobytes()
    for magic in MAGIC:
        at = text.find(magic)
        while at >= 0:
            name = begins_capture(view.data, start + at)
            if name and start + at <= (last if best is None else best[0]):
                best = start + at, name, 0
                break
            at = text.find(magic, at + 1)
    return best


def _other(view: View, start: int, last: int, c: Container) -> int:
    """Where another container begins; one that only blocks hold together must hold for longer."""
    count = ENOUGH if c.weak else CHAIN
    position = start - 1
    while True:
        stop = min(last, view.last)
        position = view.scanner.find(view.data, position + 1, stop, len(view.data), c, view.known, count)
        if position < 0 or not c.weak or sensible(_window(view, position), 0, c, view.credible):
            return position
