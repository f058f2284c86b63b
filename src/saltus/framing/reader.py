"""Files to chunks of blocks, a piece at a time: memory does not grow with the file."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

from saltus.framing.chunk import Chunk
from saltus.framing.framer import Framer

__all__ = ["PIECE", "read_chunks"]

PIECE = 1 << 24  # bytes read at once


def read_chunks(
    path: Path,
    framer: Framer,
    *,
    piece: int = PIECE,
    most: int | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Iterator[Chunk]:
    """Yield the blocks of a file.

    Args:
        path: the file.
        framer: made for it; tells afterwards what was met.
        piece: bytes read at once.
        most: bytes read at all; the framer takes what follows for yet to come.
        progress: called with the file's name and the share read.
    """
    with path.open("rb") as file:
        size, done = os.fstat(file.fileno()).st_size, 0
        while data := file.read(piece if most is None else min(piece, most - done)):
            done += len(data)
            yield from framer.feed(data)
            if progress is not None:
                progress(path.name, done / max(size, done))
        if most is None or done < most or done == size:
            yield from framer.finish()
        else:
            framer.stop()
