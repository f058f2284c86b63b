"""Data blocks of a recording as they are walked, and what the definitions say of one."""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from saltus.framing import Framer, Told, read_chunks
from saltus.framing.guess import HEAD, guess
from saltus.framing.twins import scanner
from saltus.io.layout import Malformed, categories, layout

__all__ = ["Block", "credible", "looks_like_asterix", "read_blocks"]


class Block(NamedTuple):
    """One data block: its records are `data[3:]`."""

    category: int
    offset: int  # of the header in the file
    data: bytes
    clock: float  # s, UTC or after midnight, when it was recorded; NaN where that is not told
    cut: bool  # the file ends within it, or its length lies


def read_blocks(
    path: Path, framing: str | None, progress: Callable[[str, float], None] | None
) -> tuple[list[Block], Told, bool]:
    """Cut a file into blocks.

    Args:
        path: the file.
        framing: its name; None has it guessed.
        progress: called with the file's name and the share read.

    Returns:
        The blocks, what was met, and whether every clock tells the date.
    """
    framer = Framer(path.name, credible, framing=framing)
    blocks, dated = [], True
    for chunk in read_chunks(path, framer, progress=progress):
        data, dated = chunk.data.tobytes(), dated and chunk.dated
        columns = chunk.category, chunk.at, chunk.offset, chunk.length, chunk.clock, chunk.cut
        for category, at, offset, length, clock, cut in zip(*(c.tolist() for c in columns), strict=True):
            blocks.append(Block(category, at, data[offset : offset + length], clock, cut))
    return blocks, framer.told, dated


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
    editions = categories().get(category)
    if editions is None:
        return None
    return bool(records) and any(_parses(category, edition, records) for edition in reversed(editions))


def _parses(category: int, edition: str, records: bytes) -> bool:
    position = 0
    try:
        while position < len(records):
            _, spans, position = layout(category, edition).walk(records, position, len(records))
            if "010" not in spans:
                return False
    except Malformed:
        return False
    return True
