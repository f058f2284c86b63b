"""Recordings in: ASTERIX files, packet captures and tables become target reports as arrays."""

import datetime
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from saltus.errors import DataError
from saltus.framing.capture import MAGIC
from saltus.io.inputs import expand, left_out
from saltus.io.merge import merge
from saltus.io.part import Part, printable
from saltus.io.settings import ReadingSettings
from saltus.io.told import Progress, Told
from saltus.records import Recording
from saltus.text import brief

if TYPE_CHECKING:
    from saltus.io.in_order import InOrder

__all__ = ["FORMATS", "Format", "ReadingSettings", "Told", "format_of", "read", "read_in_order", "read_part"]

Reader = Callable[[Path, "Told", Progress | None], Part]


class Format(NamedTuple):
    """One input format: how it is called and told, and what reads it."""

    name: str
    suffixes: tuple[str, ...]
    magic: tuple[bytes, ...]  # the file's first bytes; they go before the suffix
    reader: Reader


def _asterix(path: Path, told: Told, progress: Progress | None) -> Part:
    from saltus.io.asterix import read_asterix

    return read_asterix(
        path,
        date=told.date,
        editions=told.editions,
        framing=told.framing,
        most=told.most,
        memory=told.settings.memory,
        apart=told.apart,
        progress=progress,
    )


def _table(path: Path, told: Told, progress: Progress | None) -> Part:
    del progress
    from saltus.io.table import read_table

    return read_table(path, told.settings)


FORMATS = (
    Format("Parquet table", (".parquet", ".pq"), (b"PAR1",), _table),
    Format("packet capture", (".pcap", ".pcapng", ".cap"), MAGIC, _asterix),
    Format("ASTERIX", (".ast", ".raw", ".asterix"), (), _asterix),
    Format("CSV table", (".csv",), (), _table),
)
_ASTERIX, _CSV = FORMATS[2:]


def read(
    paths: Sequence[Path | str],
    *,
    date: datetime.date | None = None,
    editions: Mapping[int, str] | None = None,
    framing: str | None = None,
    progress: Progress | None = None,
    settings: ReadingSettings | None = None,
    apart: Iterable[tuple[int, int]] = (),
) -> Recording:
    """Read files and merge them by time.

    The format is told by the first bytes (a whole ASTERIX block among them), else by the suffix.

    Args:
        paths: files, directories and patterns (`saltus.io.inputs.expand`); each file by its name in messages and in
            `Plots.files`.
        date: of the first record of ASTERIX files (past midnight counts on). Without it captures use their own
            clock, plain files count from 1970-01-01 and say so among the problems.
        editions: ASTERIX category -> edition, as "0.23"; categories not named are guessed.
        framing: of ASTERIX files, one of `saltus.framing.NAMES`; None has it guessed.
        progress: called with a file's name and the fraction read.
        settings: bounds of reading.
        apart: SAC and SIC of sources that are told apart by the channel that brings them; where two sensors plainly
            send one code on channels of their own they are without being named.

    Raises:
        DataError: a file is empty, of unknown format, without one readable record, or larger than the settings allow.
    """
    if not paths:
        raise DataError("no input given: name at least one recording.")
    told = Told(date, editions or {}, framing, settings or ReadingSettings(), None, frozenset(apart))
    found = merge([read_part(path, told, progress) for path in expand(paths)])
    return replace(found, problems=(*left_out(paths), *found.problems))


def read_in_order(
    paths: Sequence[Path | str],
    *,
    date: datetime.date | None = None,
    editions: Mapping[int, str] | None = None,
    framing: str | None = None,
    progress: Progress | None = None,
    settings: ReadingSettings | None = None,
    apart: Iterable[tuple[int, int]] = (),
) -> "InOrder":
    """Read files and merge them by time as `read` does, a chunk at a time: memory does not grow with them.

    All files are indexed at once, and read when the chunks are asked for.

    Clocks are judged as the reports come, and what was given is not taken back: where a clock is set back for good,
    its later reports are right as they are with `read`, but none of the earlier ones is marked for it. A recording
    whose blocks are not in order of time is read from several places at once (`saltus.io.index`). Rows of a table are
    held as long as others of an earlier time may follow.

    Args:
        paths: as `read`, like all others.
        date: of the first record of ASTERIX files.
        editions: ASTERIX category -> edition.
        framing: of ASTERIX files.
        progress: called with a file's name and the fraction read.
        settings: bounds of reading; reports that wait for others take no more than `memory`.
        apart: SAC and SIC of sources that are told apart by channel.

    Returns:
        An iterator of recordings whose usable reports are in order of time from first to last; rejected ones come with
        the piece of the file in which they lie, with contents of what was read so far and the problems first met. The
        last has no reports, but contents, problems and files of all. `span` is what the index tells of their times.

    Raises:
        DataError: as `read`, or too many reports wait for others that come late.
    """
    from saltus.io.in_order import InOrder, asterix_runs, table_run

    if not paths:
        raise DataError("no input given: name at least one recording.")
    told = Told(date, editions or {}, framing, settings or ReadingSettings(), None, frozenset(apart))
    indexed = [
        table_run(path, k) if "table" in format_of(path, framing).name else asterix_runs(path, k, told, progress)
        for k, path in enumerate(expand(paths))
    ]
    return InOrder(indexed, told.settings.memory)


def read_part(path: Path, told: Told, progress: Progress | None = None) -> Part:
    """Read one file of those that `saltus.io.merge.merge` joins; errors are those of `read`."""
    return printable(format_of(path, told.framing).reader(path, told, progress))


def format_of(path: Path, framing: str | None = None) -> Format:
    """Tell the format of a file; a framing that is asked for is one of ASTERIX.

    Raises:
        DataError: the file is empty, a directory or of unknown format.
    """
    if path.is_dir():
        raise DataError(f"{path}: is a directory; name the files in it.")
    with path.open("rb") as file:
        head = file.read(1 << 17)
    if not head:
        raise DataError(f"{path}: byte 0: the file is empty.")
    if framing is not None and not head.startswith(FORMATS[0].magic):
        return _ASTERIX
    for entry in FORMATS:
        if head.startswith(entry.magic):
            return entry
    from saltus.io.blocks import looks_like_asterix
    from saltus.io.foreign import foreign, is_plain

    known = foreign(head)
    if known is not None:
        raise DataError(f"{path}: {known.name}: known, and not read. {known.remedy}")
    plain = is_plain(head)
    if not plain and looks_like_asterix(head):
        return _ASTERIX
    for entry in FORMATS:
        if path.suffix.lower() in entry.suffixes:
            return entry
    formats = "; ".join(f"{entry.name} ({', '.join(entry.suffixes)})" for entry in FORMATS)
    first = head[:40].decode("utf-8", "replace").split("\n")[0]
    if plain and "\ufffd" not in first[:-1]:
        begins = brief(first)
        advice = "It is text: of text, tables are read that have the suffix .csv and a header line."
    else:
        begins = f"{head[:8].hex(' ')} and not with an ASTERIX block"
        advice = "ASTERIX in a recorder's container is told by its structure; --framing NAME insists on one."
    raise DataError(f"{path}: unknown format: it begins with {begins}. Known: {formats}. {advice}")
