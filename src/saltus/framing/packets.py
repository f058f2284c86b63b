"""Where the records of a packet capture go on after bytes that are none."""

from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from saltus.framing.capture import LEAST, MOST
from saltus.framing.guess import CHAIN
from saltus.framing.twins import Packets

__all__ = ["next_packet"]

_DAY = 86400  # s: packets of one recording lie this close


def next_packet(data: npt.NDArray[np.uint8], start: int, last: int, packets: Packets, stamp: bytes) -> int:
    """First place from `start` up to `last` from where records follow each other, -1 where there is none.

    Args:
        data: the bytes at hand.
        start: first place.
        last: last place.
        packets: the capture, which knows its form.
        stamp: first word of the last good record, if any: of a classic capture its time is near the next's.
    """
    stop = len(data)
    for place in _candidates(data, start, min(last, stop - 16), stamp).tolist():
        position = place
        for _ in range(CHAIN):
            size = packets.record(data, position, stop)
            if size <= 0:
                break
            position += size
        if size > 0 or (position == stop and position > place):
            return int(place)
    return -1


def _candidates(data: npt.NDArray[np.uint8], start: int, last: int, stamp: bytes) -> npt.NDArray[np.intp]:
    """Places whose first words could be those of a record of either kind of capture and byte order."""
    if last < start:
        return np.zeros(0, np.intp)
    b = data[start : last + 16].astype(np.uint32)
    big = b[:-3] << 24 | b[1:-2] << 16 | b[2:-1] << 8 | b[3:]
    little = b[3:] << 24 | b[2:-1] << 16 | b[1:-2] << 8 | b[:-3]
    n = last - start + 1
    good = np.zeros(n, np.bool_)
    orders: tuple[tuple[npt.NDArray[Any], Literal["big", "little"]], ...] = ((big, "big"), (little, "little"))
    for words, order in orders:
        first, second, third, fourth = (words[k : k + n] for k in (0, 4, 8, 12))
        near = np.ones(n, np.bool_)
        if stamp:
            time = int.from_bytes(stamp, order)
            near = np.abs(first.astype(np.int64) - time) < _DAY
        classic = near & (third >= LEAST) & (third <= MOST) & (fourth >= third) & (second < 10**9)
        blocks = (first == 6) & (second >= 32) & (second % 4 == 0) & (second <= 4 * MOST)
        good |= classic | blocks
    return np.flatnonzero(good) + start
