"""Inputs bent out of shape, and what every reader must do with them.

An input passes when it is read, or refused by a DataError or ModelError, within five seconds of CPU; and when it is
read, every record of it is a report, a rejected report with its reason, or told among the problems.
"""

import csv
import random
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from saltus.errors import DataError, ModelError
from saltus.io.merge import LIMITS
from saltus.records import REASONS, Kind, Recording

CORPUS = Path(__file__).parent / "corpus"
LONGEST = 5.0  # s of CPU


POSITIONS = {  # what positions of these kinds alone must not exceed
    "range": (Kind.POLAR,),
    "azimuth": (Kind.POLAR, Kind.BEARING),
    "x": (Kind.PLANE,),
    "y": (Kind.PLANE,),
    "latitude": (Kind.GEODETIC,),
    "longitude": (Kind.GEODETIC,),
}


class Failed(AssertionError):
    """What a reader must not do, and with which input."""


class Target(NamedTuple):
    """A kind of file: its suffix, good files, words that mean something in it, and what reads it."""

    name: str
    suffix: str
    seeds: tuple[bytes, ...]
    words: tuple[bytes, ...]
    read: Callable[[Path], object]
    blocks: int = 0  # ASTERIX blocks of every seed, one record each


def check(target: Target, content: bytes, folder: Path) -> str:
    """Read one input and return "read" or "refused".

    Raises:
        Failed: a foreign exception, more than `LONGEST`, or a record that is unaccounted for.
    """
    path = folder / f"input{target.suffix}"
    path.write_bytes(content)
    began = time.process_time()
    try:
        found = target.read(path)
    except (DataError, ModelError) as error:
        if str(path) not in str(error) and path.name not in str(error):
            raise Failed(f"{target.name}: the message names no file: {error}") from error
        found = None
    except Exception as error:
        raise Failed(f"{target.name}: {type(error).__name__}: {error}") from error
    lasted = time.process_time() - began
    if lasted > LONGEST:
        raise Failed(f"{target.name}: {lasted:.1f} s of CPU")
    if isinstance(found, Recording):
        account(found, content, target)
    return "refused" if found is None else "read"


def account(found: Recording, content: bytes, target: Target) -> None:
    """See that every record is a report, rejected, or told."""
    plots = found.plots
    if int(sum(c.n_reports for c in found.contents)) != len(plots):
        raise Failed(f"{target.name}: {sum(c.n_reports for c in found.contents)} reports counted, {len(plots)} read")
    counted = Counter(plots.reason[plots.reason > 0].tolist())
    told: Counter[int] = Counter()
    for line in found.contents:
        told.update({REASONS.index(reason): n for reason, n in line.rejected.items()})
    if counted != told:
        raise Failed(f"{target.name}: rejected {dict(counted)}, told {dict(told)}")
    usable = plots.take(plots.reason == 0)
    if not np.isfinite(usable.time).all() or np.any(usable.kind == Kind.NONE) or np.any(np.diff(usable.time) < 0):
        raise Failed(f"{target.name}: a usable report has no time or no position, or is out of order")
    for name, (low, high) in LIMITS.items():
        values, kinds = getattr(usable, name), POSITIONS.get(name, ())
        if np.any(((values < low) | (values > high)) & (np.isin(usable.kind, kinds) if kinds else True)):
            raise Failed(f"{target.name}: {name} of a usable report is out of range")
    shown = [*found.problems, *plots.files, *(str(s.system) for s in plots.sources), *set(plots.callsign.tolist())]
    if not all(text.isprintable() for text in shown):
        raise Failed(f"{target.name}: what is said would steer a terminal")
    records = int(sum(c.n_records for c in found.contents))
    expected = rows_of(content) if target.suffix == ".csv" else target.blocks
    silent = not found.problems and not any(c.notes for c in found.contents)
    if target.suffix == ".csv" and expected is not None and records != expected:
        raise Failed(f"{target.name}: {records} rows read of {expected}")
    if target.blocks and silent and records < untouched(content, target):
        raise Failed(f"{target.name}: {records} records read in silence, {untouched(content, target)} blocks are whole")


def rows_of(content: bytes) -> int | None:
    """Rows below the header of a CSV table, None where quotes or lone carriage returns make it a matter of taste."""
    if b'"' in content or content.count(b"\r") != content.count(b"\r\n"):
        return None
    lines = [cells for cells in csv.reader(content.decode("latin-1").split("\n")) if any(cells) or len(cells) > 1]
    return len(lines) - 1


def untouched(content: bytes, target: Target) -> int:
    """Blocks of a plain file's seed that lie whole in an input."""
    best = 0
    for seed in target.seeds:
        position = count = 0
        while position + 3 <= len(seed):
            size = int.from_bytes(seed[position + 1 : position + 3], "big")
            count += seed[position : position + size] in content
            position += max(size, 1)
        best = max(best, count)
    return best


def mutated(draw: random.Random, target: Target) -> tuple[bytes, int]:
    """An input bent out of shape, and how many of its bytes were changed, put in or taken out."""
    data = bytearray(draw.choice(target.seeds))
    changed = 0
    for _ in range(draw.choice((1, 1, 2, 3, 8, 20))):
        at = draw.randrange(len(data) + 1)
        size = min(draw.choice((1, 1, 2, 4, 16, 100, 1000)), len(data) - at)
        match draw.randrange(9):
            case 0:
                size, bit = min(size, 1), 1 << draw.randrange(8)
                data[at : at + size] = bytes(b ^ bit for b in data[at : at + size])
            case 1:
                data[at : at + size] = draw.choice((b"\0", b"\xff", b"\x80", b"\x7f", b"\x01", b"0", b" ")) * size
            case 2:
                data[at : at + size] = draw.randbytes(size)
            case 3:
                data[at:at] = draw.randbytes(max(size, 1))
                size = max(size, 1)
            case 4:
                del data[at : at + size]
            case 5:
                data[at:at] = data[at : at + size]
            case 6:
                word = draw.choice(target.words)
                data[at : at + draw.choice((0, len(word)))] = word
                size = len(word)
            case 7:
                other = draw.choice(target.seeds)
                begin = draw.randrange(len(other) + 1)
                data[at:at] = other[begin : begin + size]
            case _:
                size = min(len(data) - at, len(data) // 2) if not draw.randrange(4) else 0
                del data[len(data) - size :]
        changed += size
        if len(data) > 40_000:
            del data[40_000:]
    return bytes(data), changed


def corpus() -> Iterator[tuple[str, bytes]]:
    """Every input that ever failed: the target's name, which begins the file's, and its bytes."""
    for path in sorted(CORPUS.iterdir()):
        yield path.name.split("--")[0], path.read_bytes()
