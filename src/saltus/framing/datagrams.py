"""Datagrams of a live feed to data blocks: what a capture of them would give, without one."""

import struct
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from saltus.framing.chunk import Chunk
from saltus.framing.network import Passed
from saltus.framing.twins import Scanner, scanner

__all__ = ["Datagrams"]

_RAW_IP = 101  # link type of packets without a frame around them
_HEADER = 16 + 20 + 8  # bytes before a payload: of the capture's record, of IPv4, of UDP
_LONGEST = 65507  # bytes of a payload


class Datagrams:
    """Cuts the payloads of UDP datagrams into blocks as they come: plain blocks, or frames of a recorder's container.

    A payload is plain ASTERIX, or frames of `ioss`, `ioss-seq`, `oradis` or `hdlc`, as in captures: the same code reads
    both.
    """

    def __init__(self, using: Scanner | None = None) -> None:
        """Begin.

        Args:
            using: scanners; None chooses.
        """
        self._packets = (using or scanner()).packets()
        self._packets.begin(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 1 << 18, _RAW_IP))
        self._n = 0

    @property
    def passed(self) -> Mapping[str, int]:
        """Datagrams without ASTERIX, and those that end within a block."""
        counts = {"no ASTERIX": 0, "ends within a block": 0}
        for (kind, _), (n, _) in self._packets.passed.items():
            counts["ends within a block" if kind in (Passed.TORN, Passed.CUT) else "no ASTERIX"] += n
        return {what: n for what, n in counts.items() if n}

    def feed(self, payloads: Sequence[bytes], time: npt.ArrayLike, channel: npt.ArrayLike | None = None) -> Chunk:
        """Take the next datagrams.

        Args:
            payloads: of N datagrams, whole.
            time: when each came, s, UTC, (N,).
            channel: number of the connection that brought each, (N,); None = one alone.

        Returns:
            Their blocks; `Chunk.at` counts datagrams from the first that was ever given.

        Raises:
            ValueError: a payload is longer than a datagram can be, or columns differ in length.
        """
        when = np.asarray(time, np.float64)
        lines = np.full(len(payloads), -1, np.int32) if channel is None else np.asarray(channel, np.int32)
        if when.shape != (len(payloads),) or lines.shape != when.shape:
            raise ValueError(f"{len(payloads)} payloads, times of shape {when.shape}, channels of shape {lines.shape}.")
        longest = max(map(len, payloads), default=0)
        if longest > _LONGEST:
            raise ValueError(f"a payload of {longest} bytes: datagrams hold {_LONGEST} at most.")
        data = np.frombuffer(b"".join(map(_packet, payloads)), np.uint8)
        begin = np.cumsum([0, *(len(p) + _HEADER for p in payloads)])
        taken = self._packets.scan(data, 0, len(data), 0)
        which = np.searchsorted(begin, taken.at, side="right") - 1
        self._n += len(payloads)
        return Chunk(
            data,
            taken.offset,
            taken.length,
            taken.category,
            when[which],
            taken.cut,
            which + self._n - len(payloads),
            lines[which],
            True,
        )


def _packet(payload: bytes) -> bytes:
    """A record of a capture that holds a payload in UDP in IPv4."""
    size = len(payload) + 28
    return (
        struct.pack("<IIII", 0, 0, size, size)
        + struct.pack(">BBHHHBBHII", 0x45, 0, size, 0, 0, 64, 17, 0, 1, 1)
        + struct.pack(">HHHH", 1, 1, size - 20, 0)
        + payload
    )
