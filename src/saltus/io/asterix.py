"""Read ASTERIX recordings in every framing that `saltus.framing` knows.

Target reports are taken from CAT010, CAT021 and CAT048, system tracks from CAT062, the antenna's turns from CAT034;
one file of this folder says what becomes of the items of each. Records of other categories are counted.

The record index counts the records of its category in the file from 0, status messages included. Of a block that
breaks off or does not follow its definition the leading whole records are used and counted; what follows in it
cannot be told apart, so it counts as no record, and a problem names its byte.
"""

import datetime
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from saltus.asterix.codec import Faults, find_records
from saltus.asterix.layout import editions as known_editions
from saltus.asterix.layout import layout
from saltus.errors import DataError
from saltus.io.assemble import Found, assemble
from saltus.io.blocks import Blocks, read_blocks
from saltus.io.categories import CATEGORIES
from saltus.io.columns import read_columns
from saltus.io.part import Part
from saltus.records import Contents, Plots, System

__all__ = ["read_asterix"]

_MOST = 1 << 16  # more than a block holds records
_SAMPLE = 200  # blocks looked at to tell the edition
_FITS, _ENOUGH = 0.5, 20  # an edition that parses less of this many blocks is not theirs
_SURELY = 0.9  # an edition that parses as much is theirs, where the one asked for is not
_TOLD = 8  # problems of one kind told one by one


def read_asterix(
    path: Path,
    *,
    date: datetime.date | None,
    editions: Mapping[int, str],
    framing: str | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Part:
    """Read one recording.

    Args:
        path: the file.
        date: of the first record; None = by the capture clock, else 1970-01-01.
        editions: category -> edition; categories not named are guessed.
        framing: one of `saltus.framing.NAMES`; None has it guessed.
        progress: called with the file's name and the fraction read.

    Raises:
        DataError: the file is empty, holds no record, or an edition does not exist or is plainly not the file's.
    """
    name = path.name
    blocks, told = read_blocks(path, framing, progress)
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
        edition, note = _edition(number, mine, editions.get(number), name)
        if edition:
            notes[number] = (note,) if note else ()
            held, faults = _parse(number, edition, mine, strict=False)
            found[number] = replace(held, sequence=place[held.records.block] * _MOST + held.records.number)
            broken += _told(name, mine, held, faults)
        else:
            unread.append(_unread(name, number, note))
            problems.append(f"{name}: byte {mine.at[0]}: category {number} is not read: {note}")
    broken.sort()
    problems += [text for _, text in broken[:_TOLD]]
    if len(broken) > _TOLD:
        problems.append(f"{name}: {len(broken) - _TOLD} more blocks do not follow their definition.")
    if any(len(f) for f in found.values()):
        part = assemble(name, found, notes, problems, date if date or not blocks.dated else "capture clock")
        return part._replace(contents=(*part.contents, *unread))
    if not unread:
        said = f" {problems[0]}" if problems else ""
        raise DataError(f"{path}: no ASTERIX record could be read: wrong format, category or edition?{said}")
    return Part(Plots.build(0, (), (name,), {}), None, tuple(unread), tuple(problems), True, blocks.dated)


def _edition(number: int, blocks: Blocks, asked: str | None, name: str) -> tuple[str, str]:
    """Choose the edition: as asked, or the one whose definitions parse most of a sample; then the newest.

    Returns:
        The edition, "" when none fits, and a note unless the choice is plain.
    """
    known = known_editions(number)
    if not known:
        return "", f"{len(blocks)} blocks; no definition of it is known."
    whole = np.flatnonzero(~blocks.cut) if not blocks.cut.all() else np.arange(len(blocks))
    sample = blocks.take(whole[:: max(1, len(whole) // _SAMPLE)][:_SAMPLE])
    if asked is not None:
        _check_asked(number, asked, sample, name)
        return asked, ""
    scores = {edition: _score(number, edition, sample) for edition in known}
    best = max(scores.values())
    alike = [edition for edition, score in scores.items() if score == best]
    chosen = alike[-1]
    if best[0] < _FITS and len(sample) >= _ENOUGH:
        return "", (
            f"{len(blocks)} blocks; none of the editions {', '.join(known)} parses more than {best[0]:.0%} of them. "
            "If it is another edition, it cannot be read."
        )
    if len(alike) == len(known):
        return chosen, ""
    span = chosen if len(alike) == 1 else f"{alike[0]} to {chosen} alike,"
    others = max((s[0] for e, s in scores.items() if e not in alike), default=0.0)
    return chosen, f"edition guessed: {span} parses {best[0]:.0%} of {len(sample)} sample blocks, others {others:.0%}"


def _check_asked(number: int, asked: str, sample: Blocks, name: str) -> None:
    """Refuse an edition that does not exist, or that most blocks do not follow while they follow another."""
    known = known_editions(number)
    if asked not in known:
        raise DataError(
            f"edition {asked!r} of category {number} is not known; choose one of {', '.join(known)} in [editions]."
        )
    share = _share(_parse(number, asked, sample)[1], sample)
    if share >= _FITS or len(sample) < _ENOUGH:
        return
    scores = {edition: _score(number, edition, sample) for edition in known if edition != asked}
    best = max(scores.values(), default=(0.0, 0.0))
    if best[0] >= _SURELY:
        fits = [edition for edition, score in scores.items() if score == best]
        raise DataError(
            f"{name}: category {number} is not of edition {asked}, as configured: it parses {share:.0%} of "
            f"{len(sample)} sample blocks, {' and '.join(fits)} {best[0]:.0%}. "
            f'Write {number} = "{fits[-1]}" in [editions], or leave it out to have it guessed.'
        )


def _parse(number: int, edition: str, blocks: Blocks, strict: bool = True) -> tuple[Found, Faults]:
    """What an edition makes of blocks."""
    form = layout(number, edition)
    records, faults = find_records(blocks.data, blocks.offset, blocks.length, form, strict=strict)
    columns = read_columns(blocks.data, records, form, CATEGORIES[number].fields)
    return Found(form, blocks.data, records, columns, records.block, blocks.clock[records.block]), faults


def _share(faults: Faults, sample: Blocks) -> float:
    """Share of the blocks that follow the edition."""
    return 1.0 - len(np.unique(faults.block[faults.record < 0])) / len(sample)


def _score(number: int, edition: str, sample: Blocks) -> tuple[float, float]:
    """Share of the sample that an edition parses, and how well its numbers hang together."""
    found, faults = _parse(number, edition, sample)
    plausible = CATEGORIES[number].plausible
    sense = plausible(found.columns) if plausible and len(found) else 1.0
    # A definition that parses by luck is betrayed by its numbers; single ones may be off in good recordings.
    return _share(faults, sample) * (1.0 if sense > 0.5 else 0.0), round(sense, 1)


def _unread(name: str, number: int, note: str) -> Contents:
    """The line of a category that is there and cannot be read."""
    nan = float("nan")
    return Contents(name, System(number, None, None), "", 0, 0, nan, nan, nan, {}, {}, {}, (note,))


def _told(name: str, blocks: Blocks, held: Found, faults: Faults) -> list[tuple[int, str]]:
    """Faults in words, with the byte of the file."""
    whole = np.bincount(held.records.block, minlength=len(blocks))
    form = held.layout
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
