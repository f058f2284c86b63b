"""Read ASTERIX recordings in every framing that `saltus.framing` knows.

Target reports are taken from CAT010, CAT021 and CAT048, system tracks from CAT062, the antenna's turns from CAT034;
one file of this folder says what becomes of the items of each. Records of other categories are counted.

The record index counts the records of its category in the file from 0, status messages included. Of a block that
breaks off or does not follow its definition the leading whole records are used and counted; what follows in it
cannot be told apart, so it counts as no record, and a problem names its byte.
"""

import datetime
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from saltus.errors import DataError
from saltus.io.assemble import CATEGORIES, TIME_ITEM, Records, assemble
from saltus.io.blocks import Block, read_blocks
from saltus.io.layout import Malformed, categories, layout
from saltus.io.part import Part
from saltus.records import Contents, Plots, System

__all__ = ["read_asterix"]

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
    blocks, told, dated = read_blocks(path, framing, None)
    if not path.stat().st_size:
        raise DataError(f"{path}: byte 0: the file is empty.")
    problems = list(told.problems)
    notes: dict[int, tuple[str, ...]] = {}
    chosen: dict[int, str] = {}
    unread = []
    for number in sorted({b.category for b in blocks}):
        mine = [b for b in blocks if b.category == number]
        edition, note = _edition(number, mine, editions.get(number), name)
        if edition:
            chosen[number], notes[number] = edition, (note,) if note else ()
        else:
            unread.append(_unread(name, number, note))
            problems.append(f"{name}: byte {mine[0].offset}: category {number} is not read: {note}")
    records = _walk(blocks, chosen, problems, name, progress)
    if any(r.fspecs for r in records.values()):
        part = assemble(name, records, notes, problems, date if date or not dated else "capture clock")
        return part._replace(contents=(*part.contents, *unread))
    if not unread:
        over = ", ".join(f"{n} of {what}" for what, n in told.passed.items())
        said = (f" {problems[0]}" if problems else "") + (f" Passed over: {over}." if over else "")
        raise DataError(f"{path}: no ASTERIX record could be read: wrong format, category or edition?{said}")
    return Part(Plots.build(0, (), (name,), {}), None, tuple(unread), tuple(problems), in_order=True, dated=dated)


def _edition(number: int, blocks: Sequence[Block], asked: str | None, name: str) -> tuple[str, str]:
    """Choose the edition: as asked, or the one whose definitions parse most of a sample; then the newest.

    Returns:
        The edition, "" when none fits, and a note unless the choice is plain.
    """
    known = categories().get(number)
    if known is None:
        return "", f"{len(blocks)} blocks; no definition of it is known."
    whole = [b for b in blocks if not b.cut] or list(blocks)
    sample = whole[:: max(1, len(whole) // _SAMPLE)][:_SAMPLE]
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


def _check_asked(number: int, asked: str, sample: Sequence[Block], name: str) -> None:
    """Refuse an edition that does not exist, or that most blocks do not follow while they follow another."""
    known = categories()[number]
    if asked not in known:
        raise DataError(
            f"edition {asked!r} of category {number} is not known; choose one of {', '.join(known)} in [editions]."
        )
    share = _parse(number, asked, sample)[1]
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


def _parse(number: int, edition: str, sample: Sequence[Block]) -> tuple[Records, float]:
    """What an edition makes of the sample, and the share of its blocks that follow it."""
    category = CATEGORIES.get(number)
    records = Records(layout(number, edition), frozenset(category.items if category else ()))
    n_good = 0
    for block in sample:
        try:
            records.add(block, 0)
            n_good += 1
        except Malformed:
            pass
    return records, n_good / len(sample)


def _score(number: int, edition: str, sample: Sequence[Block]) -> tuple[float, float]:
    """Share of the sample that an edition parses, and how well its numbers hang together."""
    category = CATEGORIES.get(number)
    records, share = _parse(number, edition, sample)
    plausible = category.plausible if category else None
    sense = plausible(records.columns()) if plausible and records.fspecs else 1.0
    # A definition that parses by luck is betrayed by its numbers; single ones may be off in good recordings.
    return share * (1.0 if sense > 0.5 else 0.0), round(sense, 1)


def _unread(name: str, number: int, note: str) -> Contents:
    """The line of a category that is there and cannot be read."""
    nan = float("nan")
    return Contents(name, System(number, None, None), "", 0, 0, nan, nan, nan, {}, {}, {}, (note,))


def _walk(
    blocks: Sequence[Block],
    editions: Mapping[int, str],
    problems: list[str],
    name: str,
    progress: Callable[[str, float], None] | None,
) -> dict[int, Records]:
    """Take the wanted items of all records, and note the blocks that do not follow their edition."""
    records = {}
    for number, edition in editions.items():
        handled = CATEGORIES.get(number)
        items = handled.items if handled else ("010", TIME_ITEM.get(number, "010"))
        records[number] = Records(layout(number, edition), frozenset(items))
    sequence = 0
    broken: list[str] = []
    for k, block in enumerate(blocks):
        if progress is not None and k % 1000 == 0:
            progress(name, k / len(blocks))
        mine = records.get(block.category)
        if mine is None:
            continue
        before = len(mine.fspecs)
        try:
            mine.add(block, sequence)
        except Malformed as fault:
            if not block.cut:
                broken.append(
                    f"{name}: byte {block.offset + fault.offset}: block of category {block.category} (edition "
                    f"{mine.layout.edition}): {fault.what}; {len(mine.fspecs) - before} whole records of it are used."
                )
        sequence += len(mine.fspecs) - before
    problems.extend(broken[:_TOLD])
    if len(broken) > _TOLD:
        problems.append(f"{name}: {len(broken) - _TOLD} more blocks do not follow their definition.")
    if progress is not None:
        progress(name, 1.0)
    return records
