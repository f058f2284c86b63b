"""The data blocks of a recording in memory, and what the definitions say of one."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from saltus.asterix.codec import find_records
from saltus.asterix.layout import editions, layout
from saltus.framing import Chunk
from saltus.framing.guess import HEAD, guess
from saltus.framing.twins import scanner

__all__ = ["Blocks", "credible", "joined", "looks_like_asterix"]


@dataclass(frozen=True, slots=True)
class Blocks:
    """Data blocks over one buffer, as those of `saltus.framing.Chunk`."""

    data: npt.NDArray[np.uint8]
    offset: npt.NDArray[np.int64]
    length: npt.NDArray[np.int64]
    category: npt.NDArray[np.uint8]
    clock: npt.NDArray[np.float64]
    cut: npt.NDArray[np.bool_]
    at: npt.NDArray[np.int64]
    channel: npt.NDArray[np.int32]
    dated: bool  # every clock tells the date

    def __len__(self) -> int:
        """Number of blocks."""
        return len(self.offset)

    def take(self, index: npt.NDArray[np.generic]) -> "Blocks":
        """Select blocks by index or mask."""
        names = ("offset", "length", "category", "clock", "cut", "at", "channel")
        return replace(self, **{name: getattr(self, name)[index] for name in names})

    def copied(self) -> "Blocks":
        """The same blocks over a buffer that holds no others."""
        bodies = [self.data[o : o + n] for o, n in zip(self.offset.tolist(), self.length.tolist(), strict=True)]
        start = np.cumsum(self.length) - self.length
        return replace(self, data=np.concatenate(bodies) if bodies else self.data[:0], offset=start)


def joined(chunks: Sequence["Chunk | Blocks"]) -> Blocks:
    """The blocks of all chunks over one buffer."""
    buffers: list[npt.NDArray[np.uint8]] = []
    start, end = [], 0  # where the buffer of each chunk begins in that of all, and where the last ends
    for chunk in chunks:
        if not buffers or buffers[-1] is not chunk.data:
            buffers.append(chunk.data)
            end += len(chunk.data)
        start.append(end - len(chunk.data))

    def column(name: str) -> npt.NDArray[np.generic]:
        return np.concatenate([getattr(c, name) for c in chunks]) if chunks else np.zeros(0)

    offset = [c.offset + s for c, s in zip(chunks, start, strict=True)]
    return Blocks(
        buffers[0] if len(buffers) == 1 else np.concatenate(buffers or [np.zeros(0, np.uint8)]),
        np.concatenate(offset) if offset else np.zeros(0, np.int64),
        column("length").astype(np.int64),
        column("category").astype(np.uint8),
        column("clock").astype(np.float64),
        column("cut").astype(np.bool_),
        column("at").astype(np.int64),
        column("channel").astype(np.int32),
        bool(chunks) and all(c.dated for c in chunks),
    )


def looks_like_asterix(data: bytes) -> bool:
    """Tell whether the first bytes of a file are blocks for the better half, or open with one that parses."""
    head = np.frombuffer(data[:HEAD], np.uint8)
    if guess(head, len(head) < HEAD, scanner(), credible)[0].share >= 0.5:
        return True
    length = int.from_bytes(data[1:3], "big")
    return length <= len(data) and credible(data[0], data[3:length]) is True


@lru_cache(1 << 12)
def credible(category: int, records: bytes) -> bool | None:
    """Whether records all name their source (item 010) and parse in one edition; None: no definition is known."""
    known = editions(category)
    if not known:
        return None
    return bool(records) and any(_parses(category, edition, records) for edition in reversed(known))


def _parses(category: int, edition: str, records: bytes) -> bool:
    block = bytes(3) + records
    found = find_records(block, np.zeros(1, np.int64), np.array([len(block)]), layout(category, edition), strict=True)
    return not len(found.faults.code)
