"""What lies around the data blocks of a recording: the table of containers.

A container is frames one after the other, each a header, one data block or several, and a trailer. A data block is one
byte of category, two bytes of length (header included, most significant first) and its records. Packet captures are
no such container: `saltus.framing.capture`.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

__all__ = ["ASSIGNED", "CONTAINERS", "Container", "assigned", "container"]

# Categories that EUROCONTROL has assigned: an accidental byte is one of them in one case of eight.
ASSIGNED = frozenset(
    (
        *(1, 2, 4, 7, 8, 9, 10, 11, 15, 16, 17, 18, 19, 20, 21, 23, 25, 30, 31, 32, 34, 48, 62, 63, 65),
        *(129, 150, 204, 205, 238, 240, 247, 252),
    )
)


class Container(NamedTuple):
    """One container: how its frames are built, and what is known of their time.

    The length of a frame is told by two bytes at `length_at`, by its block, or by the check sum behind it.
    """

    name: str
    words: str  # for people
    file_header: int = 0  # bytes before the first frame
    header: int = 0  # bytes of each frame before its blocks
    trailer: int = 0  # and after them
    length_at: int = -1  # in the header; -1: the frame holds one block, whose own length counts
    little: bool = False  # that length is least significant byte first
    whole: bool = True  # it counts the whole frame, else the blocks alone
    fill: int = -1  # every byte of the trailer; -1: any
    opening: bytes = b""  # first bytes of the header
    idle: int = -1  # a byte that may stand between frames
    checked: bool = False  # the frame ends where the sum over it, ISO/IEC 13239 16 bit, comes out
    clock_at: int = -1  # in the header, or in the trailer counted from the header's end; -1: no clock
    clock_bytes: int = 0
    clock_step: float = 0.0  # s
    clock_little: bool = False
    channel_at: int = -1  # two bytes in the header that tell lines apart

    @property
    def weak(self) -> bool:
        """Whether only the blocks' own lengths hold it together: chance alone makes a chain now and then."""
        return self.length_at < 0 and not self.checked


CONTAINERS = (
    Container("plain", "plain ASTERIX"),
    Container("gps", "GPS recorder", file_header=2200, trailer=10, clock_at=6, clock_bytes=3, clock_step=1 / 128),
    Container(
        "ioss",
        "FINAL/IOSS",
        header=8,
        trailer=4,
        length_at=0,
        fill=0xA5,
        clock_at=5,
        clock_bytes=3,
        clock_step=0.01,
        channel_at=2,
    ),
    Container(
        "ioss-seq",
        "FINAL/IOSS with sequence numbers",
        header=12,
        trailer=4,
        length_at=0,
        fill=0xA5,
        clock_at=9,
        clock_bytes=3,
        clock_step=0.01,
        channel_at=6,
    ),
    Container("oradis", "ORADIS", header=6, length_at=0),
    Container(
        "rff",
        "RFF",
        file_header=128,
        header=6,
        length_at=4,
        little=True,
        whole=False,
        clock_at=0,
        clock_bytes=4,
        clock_step=1e-3,
    ),
    Container("hdlc", "HDLC", header=2, trailer=2, opening=b"\x01\x03", idle=0x7E, checked=True),
)


def container(name: str) -> Container | None:
    """The container of a name, None when there is none."""
    return next((c for c in CONTAINERS if c.name == name), None)


def assigned() -> npt.NDArray[np.bool_]:
    """Tell for each byte whether it is an assigned category, (256,)."""
    known = np.zeros(256, np.bool_)
    known[list(ASSIGNED)] = True
    return known
