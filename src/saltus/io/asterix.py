"""Read ASTERIX recordings in every framing that `saltus.framing` knows.

Target reports are taken from CAT010, CAT021 and CAT048, system tracks from CAT062, the antenna's turns from CAT034;
one file of this folder says what becomes of the items of each. Records of other categories are counted.

The record index counts the records of its category in the file from 0, status messages included. Of a block that
breaks off or does not follow its definition the leading whole records are used and counted; what follows in it
cannot be told apart, so it counts as no record, and a problem names its byte.
"""

import datetime
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from saltus.errors import DataError
from saltus.framing import Told
from saltus.framing.told import framing_words
from saltus.io.assemble import Assembler
from saltus.io.blocks import Blocks
from saltus.io.dating import Clock
from saltus.io.found import Found
from saltus.io.index import block_times, index_blocks
from saltus.io.part import Part, join_parts
from saltus.io.sheet import refuse_size
from saltus.io.stream import Stream
from saltus.io.stretches import Stretches, order_words
from saltus.records import Contents, FileContents, Plots, System

__all__ = ["about_file", "channels_apart", "index_blocks", "pieces_of", "read_asterix", "read_pieces", "told_dateless"]

PER_REPORT = 250.0  # bytes that a report takes until it is merged, measured; see docs/formats.md
_BEGINNING = 1 << 22  # bytes that tell whether channels are sensors
_TOLD = 8  # problems of one kind told one by one


def read_asterix(
    path: Path,
    *,
    date: datetime.date | None,
    editions: Mapping[int, str],
    framing: str | None = None,
    most: int | None = None,
    memory: float = np.inf,
    apart: Iterable[tuple[int, int]] = (),
    progress: Callable[[str, float], None] | None = None,
) -> Part:
    """Read one recording: its reports are held, its bytes and items a piece at a time.

    Args:
        path: the file.
        date: of the first record; None = by the capture clock, else 1970-01-01.
        editions: category -> edition; categories not named are guessed.
        framing: one of `saltus.framing.NAMES`; None has it guessed.
        most: bytes read, from the beginning; None = all.
        memory: bytes that its reports may take until they are merged.
        apart: SAC and SIC of sources that are told apart by channel.
        progress: called with the file's name and the fraction read.

    Raises:
        DataError: the file is empty, holds no record, or too many reports, or an edition does not exist or is plainly
            not the file's.
    """
    stream = Stream(path, editions, framing, named=apart)
    parts: list[Part] = []
    n = 0
    for part in pieces_of(stream, date, most=most, progress=progress):
        n += len(part.plots)
        refuse_size(path, n * PER_REPORT, memory, f"more than {n} reports")
        parts.append(part)
    if stream.changed or stream.found_apart:  # now that all is known of its editions and sources
        again = Stream(path, editions, framing, stream.chosen, stream.found_apart, stream.named)
        parts = list(pieces_of(again, date, most=most, progress=progress))
    return join_parts(parts)


def read_pieces(
    path: Path,
    *,
    date: datetime.date | None,
    editions: Mapping[int, str],
    framing: str | None = None,
    most: int | None = None,
    apart: Iterable[tuple[int, int]] = (),
    progress: Callable[[str, float], None] | None = None,
) -> Iterator[Part]:
    """Read one recording as `read_asterix` does, a piece at a time: memory does not grow with it.

    Args:
        path: the file.
        date: of the first record; None = by the capture clock, else 1970-01-01.
        editions: category -> edition; categories not named are guessed by the blocks that come first.
        framing: one of `saltus.framing.NAMES`; None has it guessed.
        most: bytes read, from the beginning; None = all.
        apart: SAC and SIC of sources that are told apart by channel; others are where the beginning says so.
        progress: called with the file's name and the fraction read.

    Yields:
        Pieces with records, and last a part without reports: what could not be read, and how the file is framed.
    """
    named = frozenset(apart)
    found = channels_apart(Stream(path, editions, framing, named=named), date)
    return pieces_of(Stream(path, editions, framing, None, found, named), date, most=most, progress=progress)


def channels_apart(stream: Stream, date: datetime.date | None) -> frozenset[tuple[int, int]]:
    """SAC and SIC of sources that the channel tells apart: those named, and what the beginning of a recording says.

    Args:
        stream: the recording, not begun.
        date: of its first record.
    """
    if stream.path.stat().st_size:
        for _ in pieces_of(stream, date, most=_BEGINNING):
            pass
    return stream.apart | stream.found_apart


def pieces_of(
    stream: Stream,
    date: datetime.date | None,
    *,
    most: int | None = None,
    blocks: tuple[int, int] | None = None,
    before: Mapping[int, int] | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Iterator[Part]:
    """Read a recording whose editions may be chosen already, or the blocks from one number up to another.

    Args:
        stream: the recording, not begun.
        date: of the first record read.
        most: bytes read.
        blocks: number of the first block read, and of the first that is not; None = all.
        before: records of each category before the first block read.
        progress: called with the file's name and the fraction read.

    Yields:
        As `read_pieces`.
    """
    path, name = stream.path, stream.path.name
    if not path.stat().st_size:
        raise DataError(f"{path}: byte 0: the file is empty.")
    clock, broken, order = Clock(date, name), _Broken(name), Stretches()
    assembler = Assembler(name, clock, before, stream.apart)
    first: dict[int, int] = {}  # byte of the first block of each category
    empty = True
    for piece in stream.pieces(most=most, blocks=blocks, progress=progress):
        for number, (some, _) in piece.items():
            first.setdefault(number, int(some.at[0]))
        found = stream.records(piece)
        for number, held in found.items():
            broken.add(piece[number][0], held)
        if any(len(f) for f in found.values()):
            empty = False
            notes = {n: (c.note,) if c.note else () for n, c in stream.chosen.items()}
            part = assembler.part(found, notes, stream.channels, dated=all(some.dated for some, _ in piece.values()))
            index = block_times(piece, assembler.read, assembler.times)
            order.add(index.at, index.time, index.category.astype(np.int64) << 16 | index.source)
            yield part
    unread = {n: f"{stream.n_blocks[n]} blocks; {stream.chosen[n].note}" for n in first if not stream.chosen[n].edition}
    unread = dict(sorted(unread.items()))
    problems = _problems(name, stream, unread, first, broken)
    if not empty and clock.dateless:
        problems.append(told_dateless(name))
    if empty and not unread:
        said = f" {problems[0]}" if problems else ""
        raise DataError(f"{path}: no ASTERIX record could be read: wrong format, category or edition?{said}")
    lines = tuple(_unread(name, number, note) for number, note in unread.items())
    problems += clock.problems
    problems += assembler.same_code.problems(name, stream.channels, stream.apart, stream.named)
    stream.found_apart = assembler.same_code.apart() - stream.apart
    file = replace(about_file(path, stream.told, most), order=order_words(order.finish()))
    yield Part(Plots.build(0, (), (name,), {}), None, lines, tuple(problems), True, clock.captured, file)


def told_dateless(name: str) -> str:
    """That a recording tells no date."""
    return f"{name}: no date given: times count from 1970-01-01; give --date YYYY-MM-DD."


class _Broken:
    """Blocks that do not follow their edition: the first in words, the others counted."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._first: list[tuple[int, str]] = []
        self._n = 0

    def add(self, blocks: Blocks, held: Found) -> None:
        """Take note of the faults of some records."""
        said = _told(self._name, blocks, held)
        self._n += len(said)
        self._first = sorted([*self._first, *said])[:_TOLD]

    def texts(self) -> list[str]:
        """The first faults, and how many more there are."""
        more = self._n - len(self._first)
        last = [f"{self._name}: {more} more blocks do not follow their definition."] if more else []
        return [text for _, text in self._first] + last


def _problems(
    name: str, stream: Stream, unread: Mapping[int, str], first: Mapping[int, int], broken: _Broken
) -> list[str]:
    """What could not be read of a file, in the order in which it is told."""
    problems = list(stream.told.problems)
    over = ", ".join(f"{n} of {what}" for what, n in stream.told.passed.items())
    if over:
        n = sum(stream.told.passed.values())
        problems.append(f"{name}: {n} packets passed over, without ASTERIX: {over}.")
    problems += [f"{name}: byte {first[n]}: category {n} is not read: {note}" for n, note in unread.items()]
    return problems + broken.texts()


def about_file(path: Path, told: Told, most: int | None) -> FileContents:
    """How the file is framed, in words."""
    size = path.stat().st_size
    others = ", ".join(f"{g.name} {g.share:.0%}" for g in told.guesses[1:] if g.share >= 0.005)
    framing = []
    for k, segment in enumerate(told.segments):
        where = f"from byte {segment.start} on, " if len(told.segments) > 1 else ""
        rest = f"; others: {others}" if others and not k else ""
        framing.append(f"{framing_words(segment.framing)} ({where}explains {segment.share:.1%}{rest})")
    read = size if most is None else min(size, most)
    return FileContents(path.name, size, read, tuple(framing), told.passed, tuple(told.channels))


def _unread(name: str, number: int, note: str) -> Contents:
    """The line of a category that is there and cannot be read."""
    nan = float("nan")
    return Contents(name, System(number, None, None), "", 0, 0, nan, nan, nan, {}, {}, {}, (note,))


def _told(name: str, blocks: Blocks, held: Found) -> list[tuple[int, str]]:
    """Faults in words, with the byte of the file."""
    whole = np.bincount(held.records.block, minlength=len(blocks))
    form, faults = held.layout, held.faults
    said = []
    for k, index in enumerate(faults.block.tolist()):
        if not blocks.cut[index]:
            byte = int(blocks.at[index] + faults.offset[k] - blocks.offset[index])
            what = (
                f"{name}: byte {byte}: block of category {form.category} (edition {form.edition}): {faults.text(k)}; "
            )
            kept = (
                "the record is used without it."
                if faults.record[k] >= 0
                else f"{whole[index]} whole records of it are used."
            )
            said.append((byte, what + kept))
    return said
