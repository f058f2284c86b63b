"""An index of the blocks of a recording: where each lies, what it is, and when."""

import datetime
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError
from saltus.io.blocks import Blocks
from saltus.io.categories import CATEGORIES
from saltus.io.dating import Clock, Read, read_records
from saltus.io.stream import Stream
from saltus.io.stretches import Stretch, Stretches

__all__ = ["BlockIndex", "Piece", "block_times", "index_blocks", "index_pieces"]

TIMED = {number: category.timed() for number, category in CATEGORIES.items()}
Piece = Mapping[int, tuple[Blocks, npt.NDArray[np.int64]]]


class BlockIndex(NamedTuple):
    """Data blocks in the order recorded, 23 bytes for each."""

    at: npt.NDArray[np.int64]  # byte of the file where it begins (of a datagram put together: its last part)
    length: npt.NDArray[np.int32]  # bytes, header included
    category: npt.NDArray[np.uint8]
    source: npt.NDArray[np.uint16]  # SAC and SIC of its first record, a byte each; 0 where no record is understood
    time: npt.NDArray[np.float64]  # s, UTC, of its last record that tells one; NaN = none does

    def __len__(self) -> int:
        """Number of blocks."""
        return len(self.at)

    def stretches(self) -> list[Stretch]:
        """Stretches of blocks in order of time."""
        found = Stretches()
        found.add(self.at, self.time, self.category.astype(np.int64) << 16 | self.source)
        return found.finish()


def index_blocks(
    path: Path | str,
    *,
    date: datetime.date | None = None,
    editions: Mapping[int, str] | None = None,
    framing: str | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> BlockIndex:
    """Find the blocks of an ASTERIX recording, and the time of each.

    Args:
        path: the file.
        date: of the first record; None = by the capture clock, else 1970-01-01.
        editions: category -> edition; categories not named are guessed.
        framing: one of `saltus.framing.NAMES`; None has it guessed.
        progress: called with the file's name and the fraction read.

    Raises:
        DataError: the file is empty or holds no block, or an edition is none.
    """
    stream = Stream(Path(path), editions or {}, framing)
    parts = list(index_pieces(stream, Clock(date, stream.path.name), progress))
    if not parts:
        raise DataError(f"{path}: no ASTERIX block in it.")
    return BlockIndex(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def index_pieces(
    stream: Stream, clock: Clock, progress: Callable[[str, float], None] | None = None
) -> Iterator[BlockIndex]:
    """Index a recording a piece at a time."""
    for piece in stream.pieces(progress=progress):
        found = stream.records(piece, TIMED)
        read = {number: read_records(TIMED[number], records) for number, records in found.items() if len(records)}
        yield block_times(piece, read, clock.times(read, dated=all(b.dated for b, _ in piece.values())))


def block_times(piece: Piece, read: Mapping[int, Read], times: Mapping[int, npt.NDArray[np.float64]]) -> BlockIndex:
    """Index the blocks of a piece whose records are read and dated."""
    n = sum(len(place) for _, place in piece.values())
    at, length = np.zeros(n, np.int64), np.zeros(n, np.int32)
    category, source = np.zeros(n, np.uint8), np.zeros(n, np.uint16)
    time = np.full(n, np.nan)
    for number, (blocks, place) in piece.items():
        at[place], length[place], category[place] = blocks.at, blocks.length, number
        if number in read:
            r = read[number]
            codes = np.array([(s.sac or 0) << 8 | (s.sic or 0) for s in r.systems], np.uint16)
            inside = place[r.found.records.block]
            source[inside[::-1]] = codes[r.system_of][::-1]  # the first record of each stays
            told = np.isfinite(times[number])
            time[inside[told]] = times[number][told]  # the last stays
    return BlockIndex(at, length, category, source, time)
