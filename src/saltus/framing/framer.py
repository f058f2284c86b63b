"""Bytes of a recording, in pieces of any size, to blocks: framings are recognised, gaps bridged, all of it told."""

import ipaddress
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError
from saltus.framing.chunk import Chunk
from saltus.framing.containers import ASSIGNED, CONTAINERS, Container, assigned, container
from saltus.framing.guess import HEAD, Credible, begins_capture, guess
from saltus.framing.packets import next_packet
from saltus.framing.resume import View, admitted, lying, next_frame, next_framing, overlong
from saltus.framing.rff import clock_order, start_of
from saltus.framing.scan import HEADER, Scan
from saltus.framing.told import Told
from saltus.framing.twins import Scanner, scanner

__all__ = ["NAMES", "Framer"]

NAMES = (*(c.name for c in CONTAINERS), "pcap", "pcapng")
_CAPTURES = ("pcap", "pcapng")
_BACK = 64  # blocks that are held back until what follows them is seen
_LONGEST = 1 << 16  # bytes of a block, and more
_Bytes = npt.NDArray[np.uint8]


class Framer:
    """Cuts one recording into blocks as its bytes come; what comes out does not depend on how they were cut.

    `told` says what was met: framings, gaps, packets passed over.
    """

    def __init__(
        self, name: str, credible: Credible, *, framing: str | None = None, using: Scanner | None = None
    ) -> None:
        """Begin a recording.

        Args:
            name: of the recording, for messages.
            credible: what the definitions say of a block.
            framing: one of `NAMES`; None has it guessed.
            using: scanners; None chooses.

        Raises:
            DataError: there is no framing of that name.
        """
        if framing is not None and framing not in NAMES:
            raise DataError(f"{name}: framing {framing!r} is not known; choose one of {', '.join(NAMES)}.")
        self.told = Told(name)
        self._credible, self._asked = credible, framing
        self._scanner = using or scanner()
        self._packets = self._scanner.packets()
        self._buffer: _Bytes = np.zeros(0, np.uint8)
        self._base = self._place = self._keep = 0  # byte of the file where the buffer begins; in it: next, still needed
        self._mode: Container | str = ""
        self._known = assigned()
        self._longest = np.zeros(256, np.int32)  # bytes of the blocks of each category so far
        self._origin: float | None = None  # s, UTC, from which the container's clock counts
        self._gap = self._previous = -1  # bytes of the file: where frames ended, where the last packet begins
        self._resumed = self._begun = -1  # where frames were last found again, where another framing last began
        self._stamp = b""  # its first word, the time of a classic capture
        self._lines: dict[int, int] = {}  # channel in the frames -> its number

    def feed(self, data: bytes | memoryview | _Bytes) -> Iterator[Chunk]:
        """Take the next bytes; yield the blocks that are settled by now."""
        piece = data if isinstance(data, np.ndarray) else np.frombuffer(data, np.uint8)
        yield from self._go_on(piece, final=False)

    def finish(self) -> Iterator[Chunk]:
        """Yield the blocks that are left when no more bytes come."""
        yield from self._go_on(np.zeros(0, np.uint8), final=True)
        self._packets.finish()
        self._place = len(self._buffer)
        self.stop()

    def stop(self) -> None:
        """Close the account where the blocks yielded so far end; more bytes would follow."""
        self.told.end(self._base + self._place, self._packets.passed, self.channels)

    @property
    def channels(self) -> list[str]:
        """Names of the channels so far, in the order of their numbers."""
        lines = [f"board {line >> 8} line {line & 255}" for line in self._lines]
        return [_ends(key) for key in self._packets.channels] or lines

    def _go_on(self, piece: _Bytes, *, final: bool) -> Iterator[Chunk]:
        rest = self._buffer[self._keep :]
        self._buffer = piece if not len(rest) else np.concatenate([rest, piece]) if len(piece) else rest
        self._base, self._place, self._keep = self._base + self._keep, self._place - self._keep, 0
        before: tuple[int, ...] = ()
        while self._place < len(self._buffer) and before != self._state():
            before = self._state()
            if not self._mode:
                if not final and len(self._buffer) < HEAD:
                    return
                self._choose(final)
            view = View(self._buffer, final, self._known, self._scanner, self._credible)
            if self._gap >= 0:
                yield from self._resume(view)
            elif isinstance(self._mode, Container):
                yield from self._frames(view, self._mode)
            else:
                yield from self._capture(view)

    def _state(self) -> tuple[int, ...]:
        return self._base + self._place, self._gap, int(self._known.sum()), len(self.told.segments)

    def _choose(self, final: bool) -> None:
        """Settle the framing by the first bytes."""
        head = self._buffer[:HEAD]
        guesses = guess(head, final and len(self._buffer) <= HEAD, self._scanner, self._credible)
        self.told.guesses = guesses
        name = self._asked or (guesses[0].name if guesses[0].share else "plain")
        self.told.asked(name if self._asked else None)
        found = container(name)
        self._begin(name, 0, found.file_header if found else 0)

    def _begin(self, name: str, place: int, header: int) -> None:
        """Go on in a framing whose file header of so many bytes, or whose first frame, lies here."""
        self.told.begin(name, self._base + place)
        self._gap, self._previous, self._stamp, self._origin = -1, -1, b"", None
        head = self._buffer[place : place + max(header, 24)].tobytes()
        found = container(name)
        if found is None:
            if not begins_capture(self._buffer, place) or len(head) < (24 if name == "pcap" else 12):
                raise DataError(self._no_capture(place))
            self._mode, self._place = "capture", place + self._packets.begin(head)
            return
        self._mode, self._place = found, min(place + header, len(self._buffer))
        if found.name == "rff":
            self._origin = start_of(head) if header else None
            self._mode = clock_order(self._buffer, self._place, found, self._scanner)

    def _no_capture(self, place: int) -> str:
        where = f"{self.told.name}: byte {self._base + place}"
        if begins_capture(self._buffer, place):
            return f"{where}: the capture ends within its header."
        return f"{where}: there begins no packet capture; leave --framing out to have the framing guessed."

    def _frames(self, view: View, c: Container) -> Iterator[Chunk]:
        """Take the frames of a container as far as they go."""
        n, start = len(view.data), self._place
        found = self._scanner.scan(view.data, start, n, c, view.known)
        waits = not view.final and not (found.broken and found.position <= view.last)
        settled = self._settled(view, found, start, c) if waits else n
        count = int(np.searchsorted(found.frame, settled))
        astray = None
        if c.weak:
            astray = overlong(view, found, count, c, self._longest)
            if astray is None and not waits and found.position < n:
                astray = lying(view, found, c, _BACK, others=not self._asked)
        yield from self._emit(found, count if astray is None else astray.block, c)
        if astray is not None:
            self._place = int(found.offset[astray.block])
            yield from self._ended(view, astray.position)
            self._place = self._keep = astray.position
            if astray.framing:
                self._begun = self._base + astray.position
                self._begin(astray.framing, astray.position, astray.header)
            return
        self._place = self._keep = settled if waits else found.position
        if waits or found.position == n:
            return
        if (view.data[found.position :] == c.idle).all():
            self._place = n
            return
        met = admitted(view, found.position, c) if c.weak else []
        if met:
            self._known[met] = True
        else:
            yield from self._resume(view, short=not found.broken)

    def _settled(self, view: View, found: Scan, start: int, c: Container) -> int:
        """Up to where frames are right whatever follows."""
        if not c.weak:
            return found.position
        enough = int(np.searchsorted(found.frame, view.last - _LONGEST))
        count = min(enough, len(found.frame) - _BACK)
        return int(found.frame[count]) if count > 0 else start

    def _emit(self, found: Scan, count: int, c: Container) -> Iterator[Chunk]:
        """Yield the first blocks of a scan."""
        if found.foreign and count == len(found.offset):
            self.told.foreign(found.foreign, self._base + found.foreign_at)
        if not count:
            return
        lines, channel = np.unique(found.channel[:count], return_inverse=True)
        numbers = [-1 if v < 0 else self._lines.setdefault(v, len(self._lines)) for v in lines.tolist()]
        undated = c.name == "rff" and self._origin is None
        clock = np.full(count, np.nan) if undated else found.clock[:count] + (self._origin or 0.0)
        offset = found.offset[:count]
        yield self._counted(
            Chunk(
                self._buffer,
                offset,
                found.length[:count],
                found.category[:count],
                clock,
                np.zeros(count, np.bool_),
                offset + self._base,
                np.array(numbers, np.int32)[channel],
                self._origin is not None,
            )
        )

    def _cut(self, offset: int, length: int) -> Chunk:
        """One block of which only the whole records count."""
        return self._counted(
            Chunk(
                self._buffer,
                np.array([offset], np.int64),
                np.array([length], np.int32),
                self._buffer[offset : offset + 1].copy(),
                np.full(1, np.nan),
                np.ones(1, np.bool_),
                np.array([offset + self._base], np.int64),
                np.full(1, -1, np.int32),
                self._origin is not None,
            )
        )

    def _counted(self, chunk: Chunk) -> Chunk:
        self.told.count(chunk)
        return chunk

    def _capture(self, view: View) -> Iterator[Chunk]:
        """Take the packets of a capture as far as they go."""
        found = self._packets.scan(view.data, self._place, len(view.data), self._base)
        data = view.data
        if found.extra:
            data = np.concatenate([data, np.frombuffer(found.extra, np.uint8)])
        if len(found.offset):
            columns = found.offset, found.length, found.category, found.clock, found.cut, found.at, found.channel
            yield self._counted(Chunk(data, *columns, True))
        if found.last >= 0:
            self._previous = self._base + found.last
            self._stamp = data[found.last : found.last + 4].tobytes()
        self._place = found.position
        self._keep = min(self._place, max(self._previous - self._base, 0))
        ended = found.position == len(view.data)
        if not ended and (view.final or (found.broken and found.position <= view.last)):
            yield from self._resume(view, short=not found.broken)

    def _resume(self, view: View, *, short: bool = False) -> Iterator[Chunk]:
        """Find where frames go on, of this framing or another; or skip what can be judged.

        Args:
            view: the bytes at hand.
            short: the last frame may only be cut off by the end of the recording.
        """
        place, c = self._place, self._mode
        if isinstance(c, Container):
            own, name = next_frame(view, place, c), c.name
        else:
            place = max(self._previous + 16 - self._base, 0) if self._gap < 0 <= self._previous else place
            place = max(place, self._resumed + 1 - self._base)  # twice at one place had no end
            own, name = next_packet(view.data, place, view.last, self._packets, self._stamp), "pcap"
        last = own if own >= 0 else view.last
        other = None if self._asked else next_framing(view, place, last, name, short=short)
        if other is not None and self._base + other[0] > self._begun:  # twice at one place had no end
            self._begun = self._base + other[0]
            yield from self._ended(view, other[0])
            self._begin(other[1], other[0], other[2])
        elif own >= 0:
            yield from self._ended(view, own)
            self._place = self._keep = own
            self._resumed = self._base + own
        elif view.final:
            yield from self._ended(view, len(view.data), short=short)
            self._place = len(view.data)
        else:
            self._gap = self._base + place if self._gap < 0 else self._gap
            self._place = self._keep = max(place, view.last + 1)

    def _ended(self, view: View, stop: int, *, short: bool = False) -> Iterator[Chunk]:
        """Tell of the bytes up to `stop` that hold no frame; yield the whole records of the block that begins them."""
        begin = self._gap if self._gap >= 0 else self._base + self._place
        fresh, self._gap = self._gap < 0, -1
        end, last = self._base + stop, stop == len(view.data) and view.final
        if begin >= end:
            if begin > end:
                self.told.tell("packets whose length lies", f"byte {end}: a packet begins within the one before it.")
            return
        c, offset = self._mode, self._place
        if not isinstance(c, Container) or not fresh:
            self.told.gap(begin, end, last=last)
            return
        offset += c.header
        while short and offset + HEADER < stop and HEADER < view.size(offset) <= stop - offset:
            yield self._cut(offset, view.size(offset))
            offset += view.size(offset)
        said, there = view.size(offset), stop - offset - (0 if last else c.trailer)
        known = offset + HEADER < stop and int(view.data[offset]) in ASSIGNED
        if last and known and said > there:
            self.told.truncated(self._base + offset, int(view.data[offset]), said, there)
            yield self._cut(offset, there)
        elif not last and known and said > there > HEADER and view.records(offset, offset + there):
            self.told.lie(self._base + offset, int(view.data[offset]), said, there)
            yield self._cut(offset, there)
        else:
            self.told.gap(begin, end, last=last)


def _ends(key: bytes) -> str:
    """Source and destination of a datagram."""
    half = (len(key) - 4) // 2
    source, target = (ipaddress.ip_address(key[k : k + half]) for k in (0, half))
    ports = (int.from_bytes(key[k : k + 2], "big") for k in (2 * half, 2 * half + 2))
    return "{} > {}".format(
        *(f"{a}:{p}" if a.version == 4 else f"[{a}]:{p}" for a, p in zip((source, target), ports, strict=True))
    )
