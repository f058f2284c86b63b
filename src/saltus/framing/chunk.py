"""What framing yields: blocks of a piece of a recording, as arrays over one buffer."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

__all__ = ["Chunk", "Segment"]


class Chunk(NamedTuple):
    """Data blocks in the order recorded; the records of block k are data[offset[k] + 3 : offset[k] + length[k]]."""

    data: npt.NDArray[np.uint8]  # the bytes, contiguous; put-together datagrams lie behind those of the file
    offset: npt.NDArray[np.int64]  # of the block's header in `data`
    length: npt.NDArray[np.int32]  # header included; of a cut block what there is
    category: npt.NDArray[np.uint8]
    clock: npt.NDArray[np.float64]  # s when it was recorded: UTC if `dated`, else after midnight; NaN = not told
    cut: npt.NDArray[np.bool_]  # the recording ends within it, or its length lies: only its whole records count
    at: npt.NDArray[np.int64]  # byte of the file where it begins (of a put-together datagram: its last part)
    channel: npt.NDArray[np.int32]  # index into the channels of the `Framer`, -1 = one channel alone
    dated: bool

    def __len__(self) -> int:
        """Number of blocks."""
        return len(self.offset)


class Segment(NamedTuple):
    """A stretch of a file in one framing."""

    framing: str  # its name
    start: int  # byte
    stop: int
    n_blocks: int
    share: float  # of its bytes, that its frames explain
