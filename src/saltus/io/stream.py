"""A recording of any size, a piece at a time: blocks by category, editions told by what comes first, times going on."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from saltus.framing import Framer, read_chunks
from saltus.io.blocks import Blocks, credible, joined
from saltus.io.editions import Chosen, choose_edition
from saltus.io.found import Found, find

__all__ = ["PIECE", "Stream"]

PIECE = 1 << 21  # bytes: what is decoded at once


class Stream:
    """One file as pieces; `told` and `chosen` say afterwards what was met."""

    def __init__(self, path: Path, editions: Mapping[int, str], framing: str | None = None) -> None:
        """Begin a file.

        Args:
            path: the file.
            editions: category -> edition; categories not named are guessed where they occur first.
            framing: one of `saltus.framing.NAMES`; None has it guessed.
        """
        self.path = path
        self.chosen: dict[int, Chosen] = {}
        self._editions = editions
        self._framer = Framer(path.name, credible, framing=framing)
        self.told = self._framer.told

    def pieces(
        self,
        *,
        whole: bool = False,
        most: int | None = None,
        progress: Callable[[str, float], None] | None = None,
    ) -> Iterator[dict[int, tuple[Blocks, npt.NDArray[np.int64]]]]:
        """Yield for each category its blocks, and the number of each among the blocks of the piece.

        Args:
            whole: the file is one piece.
            most: bytes read at all.
            progress: called with the file's name and the share read.
        """
        chunks = read_chunks(self.path, self._framer, piece=PIECE, most=most, progress=progress)
        for some in [list(chunks)] if whole else ([chunk] for chunk in chunks):
            blocks = joined(some)
            found = {}
            for number in np.unique(blocks.category).tolist():
                place = np.flatnonzero(blocks.category == number)
                found[number] = blocks.take(place), place
                if number not in self.chosen:
                    asked = self._editions.get(number)
                    self.chosen[number] = choose_edition(number, found[number][0], asked, self.path.name)
            yield found

    def records(self, piece: Mapping[int, tuple[Blocks, npt.NDArray[np.int64]]]) -> dict[int, Found]:
        """The records of a piece by category, of those whose edition is known, with what the categories take."""
        return {
            number: find(number, self.chosen[number].edition, blocks, place)
            for number, (blocks, place) in piece.items()
            if self.chosen[number].edition
        }
