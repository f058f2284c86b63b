"""Read ASTERIX recordings in every framing that `saltus.framing` knows.

Target reports are taken from CAT010, CAT021 and CAT048, system tracks from CAT062, the antenna's turns from CAT034;
one file of this folder says what becomes of the items of each. Records of other categories are counted.

The record index counts the records of its category in the file from 0, status messages included. Of a block that
breaks off or does not follow its definition the leading whole records are used and counted; what follows in it
cannot be told apart, so it counts as no record, and a problem names its byte.
"""

import datetime
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from saltus.errors import DataError
from saltus.framing import Told
from saltus.framing.told import framing_words
from saltus.io.assemble import assemble
from saltus.io.blocks import Blocks, read_blocks
from saltus.io.editions import choose_edition
from saltus.io.found import Found, find
from saltus.io.part import Part
from saltus.records import Contents, FileContents, Plots, System

__all__ = ["read_asterix"]

_TOLD = 8  # problems of one kind told one by one


def read_asterix(
    path: Path,
    *,
    date: datetime.date | None,
    editions: Mapping[int, str],
    framing: str | None = None,
    most: int | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Part:
    """Read one recording.

    Args:
        path: the file.
        date: of the first record; None = by the capture clock, else 1970-01-01.
        editions: category -> edition; categories not named are guessed.
        framing: one of `saltus.framing.NAMES`; None has it guessed.
        most: bytes read, from the beginning; None = all.
        progress: called with the file's name and the fraction read.

    Raises:
        DataError: the file is empty, holds no record, or an edition does not exist or is plainly not the file's.
    """
    name = path.name
    blocks, told = read_blocks(path, framing, progress, most)
    if not path.stat().st_size:
        raise DataError(f"{path}: byte 0: the file is empty.")
    problems = list(told.problems)
    over = ", ".join(f"{n} of {what}" for what, n in told.passed.items())
    if over:
        problems.append(f"{name}: {sum(told.passed.values())} packets passed over, without ASTERIX: {over}.")
    notes: dict[int, tuple[str, ...]] = {}
    found: dict[int, Found] = {}
    unread = []
    broken: list[tuple[int, str]] = []
    for number in np.unique(blocks.category).tolist():
        place = np.flatnonzero(blocks.category == number)
        mine = blocks.take(place)
        edition, note, _ = choose_edition(number, mine, editions.get(number), name)
        if edition:
            notes[number] = (note,) if note else ()
            found[number] = find(number, edition, mine, place)
            broken += _told(name, mine, found[number])
        else:
            unread.append(_unread(name, number, note))
            problems.append(f"{name}: byte {mine.at[0]}: category {number} is not read: {note}")
    broken.sort()
    problems += [text for _, text in broken[:_TOLD]]
    if len(broken) > _TOLD:
        problems.append(f"{name}: {len(broken) - _TOLD} more blocks do not follow their definition.")
    about = _about(path, told, most)
    if any(len(f) for f in found.values()):
        part = assemble(name, found, notes, problems, date if date or not blocks.dated else "capture clock")
        return part._replace(contents=(*part.contents, *unread), file=about)
    if not unread:
        said = f" {problems[0]}" if problems else ""
        raise DataError(f"{path}: no ASTERIX record could be read: wrong format, category or edition?{said}")
    return Part(Plots.build(0, (), (name,), {}), None, tuple(unread), tuple(problems), True, blocks.dated, about)


def _about(path: Path, told: Told, most: int | None) -> FileContents:
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
