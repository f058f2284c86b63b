"""Which edition of its category a recording follows, told by what each makes of a sample of its blocks."""

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np

from saltus.asterix.codec import find_records
from saltus.asterix.layout import editions, layout
from saltus.errors import DataError
from saltus.io.blocks import Blocks
from saltus.io.sense import evidence

__all__ = ["SAMPLE", "Chosen", "Weighed", "choose_edition", "weigh"]

SAMPLE = 200  # blocks looked at
_FITS, _ENOUGH = 0.5, 20  # an edition that explains less of this many blocks is not theirs
_PART = 0.5  # of what the best explains, that an edition must explain to be weighed by its values
_SURELY = 0.9  # an edition that explains as much is theirs, where the one asked for is not
_FOLLOWS, _LUCK = 0.97, 0.3  # blocks that follow their own edition, and another one
_HURT = 0.9  # what a block counts whose records are all kept, one without its broken item
_HEADER = 3  # bytes
# What to do about categories and editions that the tables do not have, besides the common advice.
_ASK = {
    21: "Of CAT021 there is no table of editions 1.x: have the station send 2.1 or later.",
    30: "CAT030 is the former format of system tracks: have the centre send CAT062.",
    62: "Of CAT062 there is no table of editions before 1.16: have the centre send a later one.",
}
_COMMONEST = {21: "2.1"}  # what most stations send, taken among equals: later ones extend it


class Weighed(NamedTuple):
    """What one edition makes of blocks."""

    edition: str
    nats: float  # evidence for it: ln of how much likelier the blocks are by it than by chance
    share: float  # of the bytes, that its records explain
    sense: float  # share of the values that can be checked that are what they should be


class Chosen(NamedTuple):
    """The edition taken, "" when none fits; why; and what was weighed, the newest first."""

    edition: str
    note: str
    weighed: tuple[Weighed, ...]


def choose_edition(number: int, blocks: Blocks, asked: str | None, name: str) -> Chosen:
    """Choose the edition: as asked, or the one that the evidence speaks for; of equal ones the commonest, the newest.

    Evidence is what each edition explains, block by block and byte by byte, and how much sense the values of every
    record make (`saltus.io.sense`).

    Args:
        number: the category.
        blocks: of it.
        asked: edition, or None.
        name: of the recording, for messages.

    Raises:
        DataError: the edition asked for does not exist, or another is plainly the recording's.
    """
    known = editions(number)
    if not known:
        return Chosen("", " ".join(["no definition of it is known.", *_asked(number)]), ())
    if asked is not None and asked not in known:
        raise DataError(
            f"edition {asked!r} of category {number} is not known; choose one of {', '.join(known)} in [editions]."
        )
    whole = np.flatnonzero(~blocks.cut) if not blocks.cut.all() else np.arange(len(blocks))
    sample = blocks.take(whole[:: max(1, len(whole) // SAMPLE)][:SAMPLE])
    weighed = tuple(weigh(number, edition, sample) for edition in reversed(known))
    # Values that make no sense speak against an edition, but not for one that explains nothing.
    most = max(w.share for w in weighed)
    some = [w for w in weighed if w.share >= _PART * most]
    best = max(some, key=lambda w: (w.nats, w.edition == _COMMONEST.get(number)))  # the newest of equals
    if asked is not None:
        _check_asked(number, next(w for w in weighed if w.edition == asked), best, len(sample), name)
        return Chosen(asked, "", weighed)
    if (best.share < _FITS or best.nats < 0.0) and len(sample) >= _ENOUGH:
        return Chosen("", _none_fits(number, weighed), weighed)
    alike = [w for w in weighed if w.nats == best.nats]
    if len(alike) == len(known):
        return Chosen(best.edition, "", weighed)
    return Chosen(best.edition, f"edition guessed: {_said(weighed, best)}", weighed)


def weigh(number: int, edition: str, blocks: Blocks) -> Weighed:
    """Weigh one edition by blocks."""
    form = layout(number, edition)
    found = find_records(blocks.data, blocks.offset, blocks.length, form, strict=True)
    records, faults = found
    lost = np.zeros(len(blocks), np.bool_)
    lost[faults.block[faults.record < 0]] = True
    hurt = np.zeros(len(blocks), np.bool_)
    hurt[faults.block] = True
    size = blocks.length - _HEADER
    explained = np.bincount(records.block, records.stop - records.start, minlength=len(blocks))
    part = np.clip(explained / np.maximum(size, 1), 0.0, 1.0) * np.where(hurt & ~lost, _HURT, 1.0)
    # A block that follows the edition in part speaks for it in proportion.
    speaks, against = np.log(_FOLLOWS / _LUCK), np.log((1.0 - _FOLLOWS) / (1.0 - _LUCK))
    nats, sense = evidence(blocks.data, records, form)
    share = float(explained.sum() / max(size.sum(), 1))
    return Weighed(edition, round(float((part * speaks + (1.0 - part) * against).sum()) + nats, 6), share, sense)


def _check_asked(number: int, asked: Weighed, best: Weighed, n: int, name: str) -> None:
    """Refuse an edition that the blocks speak against while they follow another."""
    if asked.nats < 0.0 < best.nats and n >= _ENOUGH and best.share >= _SURELY:
        raise DataError(
            f"{name}: category {number} is not of edition {asked.edition}, as configured: it explains "
            f"{asked.share:.0%} of the bytes of {n} sample blocks and {asked.sense:.0%} of its values make sense, by "
            f"{best.edition} {best.share:.0%} and {best.sense:.0%}. "
            f'Write {number} = "{best.edition}" in [editions], or leave it out to have it guessed.'
        )


def _none_fits(number: int, weighed: Sequence[Weighed]) -> str:
    best = max(weighed, key=lambda w: w.share)
    names = ", ".join(w.edition for w in reversed(weighed))
    said = (
        f"none of the editions {names} explains more than {best.share:.0%} of their bytes, of whose values "
        f"{best.sense:.0%} make sense. If it is another edition, it cannot be read; to see what there is, write "
        f'{number} = "{best.edition}" in [editions].'
    )
    return " ".join([said, *_asked(number)])


def _asked(number: int) -> list[str]:
    return [_ASK[number]] if number in _ASK else []


def _said(weighed: Sequence[Weighed], best: Weighed) -> str:
    """Shares of all editions in words, neighbours of equal figures together, the best first."""
    parts = []
    for (nats, share), group in groupby(weighed, lambda w: (w.nats == best.nats, f"{w.share:.0%}")):
        names, sense = [w.edition for w in group], next(w.sense for w in weighed if f"{w.share:.0%}" == share)
        span = names[0] if len(names) == 1 else f"{names[-1]} to {names[0]}"
        parts.append((not nats, span, share if share == "0%" else f"{share}, {sense:.0%} of the values make sense"))
    (_, span, first), *rest = sorted(parts, key=lambda p: p[0])
    others = "; ".join(f"{span} {share}" for _, span, share in rest)
    verb = "explain" if " to " in span else "explains"
    return f"{span} {verb} {first.replace(',', ' of the bytes,', 1)} ({others})"
