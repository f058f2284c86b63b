"""Frames of a container to data blocks: the definition, whose compiled twin lies in native/asterix_frames.cpp."""

from array import array
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.framing.containers import Container

__all__ = ["HEADER", "Bytes", "Known", "Scan", "find", "holds", "scan", "scan_view"]

HEADER = 3  # bytes of category and length before the records of a block
Bytes = memoryview | bytes
Array = npt.NDArray[np.uint8]
Known = npt.NDArray[np.bool_]
_SHORT, _BAD = "short", "bad"


class Scan(NamedTuple):
    """Blocks in the order of the bytes, and where they stopped."""

    offset: npt.NDArray[np.int64]  # of the block in the bytes
    length: npt.NDArray[np.int32]  # header included
    category: npt.NDArray[np.uint8]
    clock: npt.NDArray[np.float64]  # s, as the frame says, NaN where it does not
    channel: npt.NDArray[np.int32]
    frame: npt.NDArray[np.int64]  # where the block's frame begins
    position: int  # of the first byte not understood
    broken: bool  # there is no frame there; else it goes on beyond the bytes at hand
    frames: int  # whole frames
    foreign: int  # of these, whole ones without blocks
    foreign_at: int  # where the first of them begins, -1 = none


class _Frame(NamedTuple):
    blocks: list[tuple[int, int]]  # (offset, length)
    stop: int
    clock: float
    channel: int


def scan(data: Array, start: int, stop: int, container: Container, known: Known) -> Scan:
    """Take the blocks of the frames in data[start:stop], up to the first place where there is no frame.

    Args:
        data: bytes.
        start: where a frame begins.
        stop: end of the bytes at hand.
        container: how frames are built.
        known: (256,) categories believed in a container that only its blocks hold together.
    """
    return scan_view(data.data, start, stop, container, known)


def scan_view(data: Bytes, start: int, stop: int, container: Container, known: Known) -> Scan:
    """`scan` of bytes."""
    offset, length, frame = array("q"), array("i"), array("q")
    clock, channel = array("d"), array("i")
    position, frames, foreign, foreign_at, broken = start, 0, 0, -1, False
    while position < stop:
        found = _frame(data, position, stop, container, known)
        if isinstance(found, str):
            broken = found == _BAD
            break
        for at, size in found.blocks:
            offset.append(at)
            length.append(size)
            frame.append(position)
            clock.append(found.clock)
            channel.append(found.channel)
        if not found.blocks and found.stop > position:
            foreign += 1
            foreign_at = position if foreign_at < 0 else foreign_at
        frames += 1
        position = found.stop
    offsets = np.array(offset, np.int64)
    return Scan(
        offsets,
        np.array(length, np.int32),
        np.frombuffer(data, np.uint8)[offsets] if len(offsets) else np.zeros(0, np.uint8),
        np.array(clock, np.float64),
        np.array(channel, np.int32),
        np.array(frame, np.int64),
        position,
        broken,
        frames,
        foreign,
        foreign_at,
    )


def holds(data: Array, start: int, stop: int, container: Container, known: Known, count: int) -> bool:
    """Whether so many frames with blocks follow each other from `start`, or fewer up to `stop` exactly."""
    view, position = data.data, start
    for _ in range(count):
        found = _frame(view, position, stop, container, known)
        if isinstance(found, str) or not found.blocks:
            return False
        position = found.stop
        if position == stop:
            return True
    return True


def find(data: Array, start: int, last: int, stop: int, container: Container, known: Known, count: int) -> int:
    """First position from `start` up to `last` from where frames hold, -1 where there is none."""
    for position in range(start, min(last + 1, stop)):
        if holds(data, position, stop, container, known, count):
            return position
    return -1


def _frame(data: Bytes, position: int, stop: int, c: Container, known: Known) -> _Frame | str:
    """Measure the frame at `position`, or say that it is short of bytes or none."""
    while position < stop and data[position] == c.idle:
        position += 1
    if position == stop and c.idle >= 0:
        return _SHORT
    opening = data[position : min(position + len(c.opening), stop)]
    if bytes(opening) != c.opening[: len(opening)]:
        return _BAD
    first = position + c.header
    if c.checked:
        return _checked(data, position, stop, c, known)
    if first + (HEADER if c.length_at < 0 else 0) > stop:
        return _SHORT
    if c.length_at < 0:
        size = _big(data, first + 1)
        if not known[data[first]]:
            return _BAD
    else:
        at = position + c.length_at
        size = data[at] | data[at + 1] << 8 if c.little else _big(data, at)
        size -= c.header + c.trailer if c.whole else 0
    if size <= HEADER:
        return _BAD
    end = first + size
    if end + c.trailer > stop:
        return _SHORT
    if c.fill >= 0 and any(data[k] != c.fill for k in range(end, end + c.trailer)):
        return _BAD
    blocks = _chain(data, first, end)
    if not blocks and c.fill < 0:
        return _BAD
    return _Frame(blocks, end + c.trailer, _clock(data, position, end, c), _channel(data, position, c))


def _chain(data: Bytes, start: int, stop: int) -> list[tuple[int, int]]:
    """Blocks that fill these bytes exactly; none where they do not."""
    blocks = []
    while start < stop:
        size = _big(data, start + 1) if start + HEADER <= stop else 0
        if size <= HEADER or start + size > stop:
            return []
        blocks.append((start, size))
        start += size
    return blocks


def _checked(data: Bytes, position: int, stop: int, c: Container, known: Known) -> _Frame | str:
    """A frame that ends behind the block where its check sum comes out."""
    crc = _crc(data, position, min(position + c.header, stop), 0xFFFF)
    at = position + c.header
    blocks = []
    while at + HEADER + c.trailer <= stop:
        size = _big(data, at + 1)
        if size <= HEADER or not known[data[at]]:
            return _BAD
        if at + size + c.trailer > stop:
            return _SHORT
        blocks.append((at, size))
        crc = _crc(data, at, at + size, crc)
        at += size
        if (crc ^ 0xFFFF) == data[at] | data[at + 1] << 8:
            return _Frame(blocks, at + c.trailer, float("nan"), -1)
        if at - position > 0xFFFF:
            return _BAD
    return _SHORT


def _crc(data: Bytes, start: int, stop: int, crc: int) -> int:
    """Go on with the check sum of polynomial x^16 + x^12 + x^5 + 1, least significant bit first (ISO/IEC 13239)."""
    for byte in data[start:stop]:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x8408 if crc & 1 else 0)
    return crc


def _clock(data: Bytes, position: int, end: int, c: Container) -> float:
    if c.clock_at < 0:
        return float("nan")
    at = position + c.clock_at if c.clock_at < c.header else end + c.clock_at - c.header
    value = int.from_bytes(data[at : at + c.clock_bytes], "little" if c.clock_little else "big")
    return value * c.clock_step


def _channel(data: Bytes, position: int, c: Container) -> int:
    return -1 if c.channel_at < 0 else _big(data, position + c.channel_at)


def _big(data: Bytes, at: int) -> int:
    return data[at] << 8 | data[at + 1]
