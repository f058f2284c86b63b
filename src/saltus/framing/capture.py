"""Packet captures to data blocks: the definition, whose compiled twin lies in native/asterix_frames.cpp.

Classic pcap (both byte orders, micro- and nanoseconds) and pcapng; Ethernet with VLAN tags, Linux cooked, raw IP and
loopback; IPv4 and IPv6 with extension headers, fragments put together; UDP. What is passed over is counted by protocol.
"""

import struct
from array import array
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.framing.containers import ASSIGNED, CONTAINERS, assigned
from saltus.framing.network import Passed, joined, network, ticks_of
from saltus.framing.scan import HEADER, Bytes, scan_view

__all__ = ["INSIDE", "MAGIC", "PCAPNG", "Capture", "Taken"]

# magic number as it lies in the file -> (byte order, clock ticks per second)
CLASSIC = {
    b"\xa1\xb2\xc3\xd4": (">", 1e6),
    b"\xd4\xc3\xb2\xa1": ("<", 1e6),
    b"\xa1\xb2\x3c\x4d": (">", 1e9),
    b"\x4d\x3c\xb2\xa1": ("<", 1e9),
}
PCAPNG = b"\x0a\x0d\x0d\x0a"
MAGIC = (*CLASSIC, PCAPNG)
LEAST, MOST = 14, 1 << 18  # bytes of a packet: an Ethernet header, and what capture programs allow

_UDP = 17
_EXTENSIONS, _AUTHENTICATION, _FRAGMENT = (0, 43, 60), 51, 44  # next headers of IPv6
_WAITING, _LARGEST = 64, 1 << 17  # datagrams whose parts are waited for, and bytes of their parts
INSIDE = tuple(c for c in CONTAINERS if c.name in ("ioss", "ioss-seq", "oradis", "hdlc"))  # of one payload


class Taken(NamedTuple):
    """Blocks of the packets of a piece of a capture."""

    offset: npt.NDArray[np.int64]  # in the bytes; from `stop` on in `extra`
    length: npt.NDArray[np.int32]
    category: npt.NDArray[np.uint8]
    clock: npt.NDArray[np.float64]  # s, UTC
    channel: npt.NDArray[np.int32]  # index into `Capture.channels`
    cut: npt.NDArray[np.bool_]
    at: npt.NDArray[np.int64]  # where the packet lies that completed it
    extra: bytes  # datagrams put together
    position: int  # of the first byte not understood
    last: int  # where the last whole packet begins, -1 = none
    broken: bool  # there is no packet there; else it goes on beyond the bytes at hand


class _Rows:
    """Blocks as they are found."""

    def __init__(self, stop: int) -> None:
        self.offset, self.length, self.at = array("q"), array("i"), array("q")
        self.clock, self.channel, self.cut = array("d"), array("i"), array("b")
        self.category = array("B")
        self.extra = bytearray()
        self.stop = stop

    def add(self, data: Bytes, offset: int, length: int, where: tuple[int, int, float, int], cut: bool) -> None:
        shift, at, clock, channel = where
        self.offset.append(offset + shift)
        self.length.append(length)
        self.category.append(data[offset])
        self.clock.append(clock)
        self.channel.append(channel)
        self.cut.append(cut)
        self.at.append(at)


class Capture:
    """Takes packets apart; keeps what lasts from one piece of a capture to the next."""

    def __init__(self) -> None:
        self.passed: dict[tuple[int, int], tuple[int, int]] = {}  # (Passed, number) -> how many, byte of the first
        self.channels: list[bytes] = []  # addresses and ports: source, destination, source port, destination port
        self._order, self._ticks, self._link, self._classic = "<", 1e6, 1, True
        self._interfaces: list[tuple[int, float, float]] = []  # link type, ticks per second, offset in s
        self._parts: dict[bytes, dict[int, bytes]] = {}
        self._seen: dict[bytes, int] = {}
        self._known = assigned()
        self._base = 0

    def begin(self, head: bytes) -> int:
        """Read the magic number of a capture; return how long its header is, 24 or 0 bytes.

        Args:
            head: the first 24 bytes.
        """
        self._interfaces = []
        self._classic = head[:4] in CLASSIC
        if self._classic:
            self._order, self._ticks = CLASSIC[head[:4]]
            self._link = struct.unpack(self._order + "I", head[20:24])[0] & 0xFFFF
        return 24 if self._classic else 0

    def scan(self, array: npt.NDArray[np.uint8], start: int, stop: int, base: int) -> Taken:
        """Take the blocks of the packets in array[start:stop]; `base` is the byte of the file where it begins."""
        data = array.data
        self._base, rows = base, _Rows(stop)
        position, last, broken = start, -1, False
        while position < stop:
            size = self._record(data, position, stop)
            if size <= 0:
                broken = size < 0
                break
            for link, clock, first, end, whole in self._frames(data, position, size):
                self._packet(rows, data, (first, end), link, clock, whole)
            last, position = position, position + size
        numbers = (
            np.array(rows.offset, np.int64),
            np.array(rows.length, np.int32),
            np.array(rows.category, np.uint8),
            np.array(rows.clock, np.float64),
            np.array(rows.channel, np.int32),
            np.array(rows.cut, np.bool_),
            np.array(rows.at, np.int64),
        )
        return Taken(*numbers, bytes(rows.extra), position, last, broken)

    def record(self, array: npt.NDArray[np.uint8], position: int, stop: int) -> int:
        """Size of the record or pcapng block at `position`: 0 when bytes are lacking, -1 when it is none."""
        return self._record(array.data, position, stop)

    def finish(self) -> None:
        """Count the parts that no others came to."""
        for parts in self._parts.values():
            self._pass(Passed.MISSING, 0, -1, len(parts))
        self._parts = {}

    def _record(self, data: Bytes, position: int, stop: int) -> int:
        left = stop - position
        if left < 4:
            return 0
        if self._classic:
            if bytes(data[position : position + 4]) in MAGIC:
                return -1
            if left < 16:
                return 0
            _, fraction, size, _ = struct.unpack(self._order + "4I", data[position : position + 16])
            if not LEAST <= size <= MOST or fraction >= self._ticks:
                return -1
            return 0 if 16 + size > left else 16 + size
        if left < 12:
            return 0
        if bytes(data[position : position + 4]) == PCAPNG:
            self._order = ">" if bytes(data[position + 8 : position + 12]) == b"\x1a\x2b\x3c\x4d" else "<"
        size = struct.unpack(self._order + "I", data[position + 4 : position + 8])[0]
        if size < 12 or size % 4 or size > 4 * MOST:
            return -1
        if size > left:
            return 0
        again = struct.unpack(self._order + "I", data[position + size - 4 : position + size])[0]
        return size if again == size else -1

    def _frames(self, data: Bytes, position: int, size: int) -> Iterator[tuple[int, float, int, int, bool]]:
        """Yield (link type, time, start, stop, whole) of the packet in a record, if it holds one."""
        order = self._order
        if self._classic:
            seconds, fraction, _, original = struct.unpack(order + "4I", data[position : position + 16])
            first, end = position + 16, position + size
            yield self._link, seconds + fraction / self._ticks, first, end, end - first >= original
            return
        kind = struct.unpack(order + "I", data[position : position + 4])[0]
        body, end = position + 8, position + size - 4
        if bytes(data[position : position + 4]) == PCAPNG:
            self._interfaces = []
        elif kind == 1 and end - body >= 8:
            link = struct.unpack(order + "H", data[body : body + 2])[0]
            self._interfaces.append((link, *ticks_of(bytes(data[body + 8 : end]), order)))
        elif kind == 6 and end - body >= 20:
            number, high, low, kept, original = struct.unpack(order + "5I", data[body : body + 20])
            if number < len(self._interfaces):
                link, ticks, shift = self._interfaces[number]
                stop = min(body + 20 + kept, end)
                yield link, (high << 32 | low) / ticks + shift, body + 20, stop, stop - body - 20 >= original
        elif kind == 3 and end - body >= 4 and self._interfaces:
            original = struct.unpack(order + "I", data[body : body + 4])[0]
            stop = min(body + 4 + original, end)
            yield self._interfaces[0][0], float("nan"), body + 4, stop, stop - body - 4 >= original

    def _packet(
        self,
        rows: _Rows,
        data: Bytes,
        span: tuple[int, int],
        link: int,
        clock: float,
        whole: bool,
    ) -> None:
        """Take the blocks out of one frame, or count why there are none."""
        first, end = span
        ip, kind, number = network(data, first, end, link)
        if ip < 0:
            self._pass(kind, number, self._base + first, 1)
            return
        version = data[ip] >> 4 if ip < end else 0
        if version == 4:
            self._ipv4(rows, data, (ip, end), clock, whole)
        elif version == 6:
            self._ipv6(rows, data, (ip, end), clock, whole)
        else:
            self._pass(Passed.BROKEN, 0, self._base + first, 1)

    def _ipv4(self, rows: _Rows, data: Bytes, span: tuple[int, int], clock: float, whole: bool) -> None:
        ip, end = span
        header = (data[ip] & 15) * 4
        if header < 20 or ip + header > end:
            self._pass(Passed.BROKEN, 0, self._base + ip, 1)
            return
        total = data[ip + 2] << 8 | data[ip + 3]
        stop = min(end, ip + total) if total >= header else end
        flags = data[ip + 6] << 8 | data[ip + 7]
        addresses = bytes(data[ip + 12 : ip + 20])
        if flags & 0x3FFF:
            key = b"4" + addresses + bytes(data[ip + 4 : ip + 6]) + bytes(data[ip + 9 : ip + 10])
            part = (flags & 0x1FFF) * 8, ip + header, stop, not flags & 0x2000
            self._fragment(rows, data, part, (key, addresses, data[ip + 9]), clock)
        elif data[ip + 9] != _UDP:
            self._pass(Passed.PROTOCOL, data[ip + 9], self._base + ip, 1)
        else:
            self._udp(rows, data, (ip + header, stop), addresses, (0, 0, clock), whole)

    def _ipv6(self, rows: _Rows, data: Bytes, span: tuple[int, int], clock: float, whole: bool) -> None:
        ip, end = span
        if ip + 40 > end:
            self._pass(Passed.BROKEN, 0, self._base + ip, 1)
            return
        size = data[ip + 4] << 8 | data[ip + 5]
        stop = min(end, ip + 40 + size) if size else end
        addresses = bytes(data[ip + 8 : ip + 40])
        protocol, at = data[ip + 6], ip + 40
        while at + 8 <= stop and (protocol in _EXTENSIONS or protocol == _AUTHENTICATION):
            step = (data[at + 1] + 2) * 4 if protocol == _AUTHENTICATION else (data[at + 1] + 1) * 8
            protocol, at = data[at], at + step
        if protocol == _FRAGMENT and at + 8 <= stop:
            place = data[at + 2] << 8 | data[at + 3]
            if place & 0xFFF9:
                key = b"6" + addresses + bytes(data[at + 4 : at + 8])
                part = place & 0xFFF8, at + 8, stop, not place & 1
                self._fragment(rows, data, part, (key, addresses, data[at]), clock)
                return
            protocol, at = data[at], at + 8
        if protocol != _UDP:
            self._pass(Passed.PROTOCOL, protocol, self._base + ip, 1)
        else:
            self._udp(rows, data, (at, stop), addresses, (0, 0, clock), whole)

    def _fragment(
        self,
        rows: _Rows,
        data: Bytes,
        part: tuple[int, int, int, bool],
        datagram: tuple[bytes, bytes, int],
        clock: float,
    ) -> None:
        """Keep one part of a datagram; take its blocks when no other is missing."""
        place, start, stop, last = part
        key, addresses, protocol = datagram
        if protocol != _UDP:
            self._pass(Passed.PROTOCOL, protocol, self._base + start, 1)
            return
        parts = self._parts.pop(key, {})
        parts[place] = bytes(data[start:stop])
        if last:
            parts[-1] = b""  # marks that the end has come
        self._parts[key] = parts
        if sum(map(len, parts.values())) > _LARGEST:
            self._pass(Passed.BROKEN, 0, self._base + start, len(self._parts.pop(key)))
            return
        whole = joined(parts)
        if whole is not None:
            del self._parts[key]
            shift = rows.stop + len(rows.extra)
            rows.extra += whole
            self._udp(rows, whole, (0, len(whole)), addresses, (shift, self._base + start, clock), True)
        elif len(self._parts) > _WAITING:
            oldest = next(iter(self._parts))
            self._pass(Passed.MISSING, 0, self._base + start, len(self._parts.pop(oldest)))

    def _udp(
        self,
        rows: _Rows,
        data: Bytes,
        span: tuple[int, int],
        addresses: bytes,
        where: tuple[int, int, float],
        whole: bool,
    ) -> None:
        start, stop = span
        if start + 8 > stop:
            self._pass(Passed.CUT if not whole else Passed.BROKEN, 0, where[1] or self._base + start, 1)
            return
        size = data[start + 4] << 8 | data[start + 5]
        end = stop if size < 8 else start + size
        cut = end > stop
        key = addresses + bytes(data[start : start + 4])
        shift, at, clock = where
        at = at if shift else self._base + start + 8
        channel = self._seen.get(key, len(self.channels))
        if not self._payload(rows, data, (start + 8, min(end, stop)), (shift, at, clock, channel), cut):
            self._pass(Passed.PORT, data[start + 2] << 8 | data[start + 3], at, 1)
        elif channel == len(self.channels):
            self._seen[key] = channel
            self.channels.append(key)

    def _payload(
        self, rows: _Rows, data: Bytes, span: tuple[int, int], where: tuple[int, int, float, int], cut: bool
    ) -> bool:
        """Take the blocks of one payload; False when it is no ASTERIX."""
        start, stop = span
        blocks, position = [], start
        while position + HEADER <= stop:
            size = data[position + 1] << 8 | data[position + 2]
            if size <= HEADER or position + size > stop:
                break
            blocks.append((position, size))
            position += size
        torn = position < stop
        if torn and not cut:
            for inside in INSIDE:
                found = scan_view(data, start, stop, inside, self._known)
                if found.position == stop and len(found.offset):
                    blocks = list(zip(found.offset.tolist(), found.length.tolist(), strict=True))
                    torn = False
                    break
        if torn and not (start < stop and data[start] in ASSIGNED and (blocks or cut)):
            return False
        if not blocks and not torn:
            return False
        for offset, size in blocks:
            self._add(rows, data, offset, size, where, cut=False)
        if torn:
            self._pass(Passed.CUT if cut else Passed.TORN, 0, where[1], 1)
            if cut and position + HEADER < stop and data[position] in ASSIGNED:
                self._add(rows, data, position, stop - position, where, cut=True)
        return True

    def _add(
        self, rows: _Rows, data: Bytes, offset: int, size: int, where: tuple[int, int, float, int], *, cut: bool
    ) -> None:
        shift, at, clock, channel = where
        rows.add(data, offset, size, (shift, at if shift else self._base + offset, clock, channel), cut)

    def _pass(self, kind: int, number: int, at: int, count: int) -> None:
        before, first = self.passed.get((int(kind), number), (0, at))
        self.passed[int(kind), number] = before + count, first
