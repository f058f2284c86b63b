"""A recording of any size, a piece at a time: blocks by category, editions told by what comes first, times going on."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from saltus.framing import Chunk, Framer, read_chunks
from saltus.io.blocks import Blocks, credible, joined
from saltus.io.categories import CATEGORIES
from saltus.io.columns import Category
from saltus.io.editions import SAMPLE, Chosen, choose_edition
from saltus.io.found import Found, find

__all__ = ["PIECE", "Stream"]

PIECE = 1 << 21  # bytes: what is decoded at once


class Stream:
    """One file as pieces; `told` and `chosen` say afterwards what was met."""

    def __init__(
        self,
        path: Path,
        editions: Mapping[int, str],
        framing: str | None = None,
        chosen: Mapping[int, Chosen] | None = None,
        apart: Iterable[tuple[int, int]] = (),
        named: Iterable[tuple[int, int]] = (),
    ) -> None:
        """Begin a file.

        Args:
            path: the file.
            editions: category -> edition; categories not named are guessed by the blocks that come first.
            framing: one of `saltus.framing.NAMES`; None has it guessed.
            chosen: guesses that stand, of an earlier reading.
            apart: SAC and SIC of sources that an earlier reading has found to be several, one on each channel.
            named: SAC and SIC of sources that a configuration tells apart by channel.
        """
        self.path = path
        self.chosen: dict[int, Chosen] = dict(chosen or {})
        self.changed = False  # a guess did not last: records before were read by another edition
        self.n_blocks: Counter[int] = Counter()
        self._editions = editions
        self._settled = set(self.chosen)
        self._sample: dict[int, Blocks] = {}
        self._framer = Framer(path.name, credible, framing=framing)
        self.told = self._framer.told
        self.named: frozenset[tuple[int, int]] = frozenset(named)
        self.apart: frozenset[tuple[int, int]] = self.named.union(apart)
        self.found_apart: frozenset[tuple[int, int]] = frozenset()  # others that turned out to be several

    @property
    def channels(self) -> list[str]:
        """Names of the channels so far."""
        return self._framer.channels

    def pieces(
        self,
        *,
        most: int | None = None,
        blocks: tuple[int, int] | None = None,
        progress: Callable[[str, float], None] | None = None,
    ) -> Iterator[dict[int, tuple[Blocks, npt.NDArray[np.int64]]]]:
        """Yield for each category its blocks, and the number of each among the blocks of the piece.

        Args:
            most: bytes read at all.
            blocks: number of the first block taken, and of the first that is not; None = all.
            progress: called with the file's name and the share read.
        """
        chunks = read_chunks(self.path, self._framer, piece=PIECE, most=most, progress=progress)
        pieces = map(joined, _grouped(chunks))
        for some in pieces if blocks is None else _between(pieces, *blocks):
            found = {}
            for number in np.unique(some.category).tolist():
                place = np.flatnonzero(some.category == number)
                found[number] = some.take(place), place
                self.n_blocks[number] += len(place)
                if number not in self._settled:
                    self._choose(number, found[number][0])
            yield found

    def _choose(self, number: int, blocks: Blocks) -> None:
        """Choose the edition of a category, and again as long as few blocks have told it."""
        asked, known = self._editions.get(number), self._sample.pop(number, None)
        some = blocks if known is None else joined([known, blocks])
        chosen = choose_edition(number, some, asked, self.path.name)
        if number not in self.chosen or self.chosen[number].edition != chosen.edition:
            self.changed |= number in self.chosen
            self.chosen[number] = chosen
        if asked is None and len(some) < SAMPLE:
            self._sample[number] = some.copied()
        else:
            self._settled.add(number)

    def records(
        self, piece: Mapping[int, tuple[Blocks, npt.NDArray[np.int64]]], categories: Mapping[int, Category] = CATEGORIES
    ) -> dict[int, Found]:
        """The records of a piece by category, of those whose edition is known, with what the categories take."""
        return {
            number: find(categories[number], self.chosen[number].edition, blocks, place)
            for number, (blocks, place) in piece.items()
            if self.chosen[number].edition
        }


def _between(pieces: Iterable[Blocks], start: int, stop: int) -> Iterator[Blocks]:
    """The blocks from one number up to another."""
    before = 0
    for blocks in pieces:
        number = before + np.arange(len(blocks))
        before += len(blocks)
        if before > start:
            yield blocks.take(np.flatnonzero((number >= start) & (number < stop)))
        if before >= stop:
            return


def _grouped(chunks: Iterable[Chunk]) -> Iterator[list[Chunk]]:
    """Chunks together until they are worth decoding, or hold much memory."""
    some: list[Chunk] = []
    blocks = held = 0
    for chunk in chunks:
        if some and chunk.dated != some[-1].dated:
            yield some
            some, blocks, held = [], 0, 0
        held += 0 if some and some[-1].data is chunk.data else chunk.data.nbytes
        blocks += int(chunk.length.sum())
        some.append(chunk)
        if blocks >= PIECE // 2 or held >= 4 * PIECE:
            yield some
            some, blocks, held = [], 0, 0
    if some:
        yield some
