"""`saltus convert`: recordings in, a table of every decoded item out, in memory that does not grow with them."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.asterix.layout import Field, Layout, layout
from saltus.asterix.layout import editions as known_editions
from saltus.config import Config, load_config
from saltus.convert.columns import COMMON, Items, fields_of, held_by, schema_of, table_of
from saltus.convert.writers import check_suffix, open_writer
from saltus.errors import DataError
from saltus.io import format_of
from saltus.io.blocks import Blocks
from saltus.io.categories import CATEGORIES
from saltus.io.columns import SOURCE
from saltus.io.dating import Clock, Read, read_records
from saltus.io.found import Found
from saltus.io.inputs import expand
from saltus.io.stream import Stream
from saltus.io.write import output_file
from saltus.progress import Progress, progress_bar
from saltus.times import time_window

__all__ = ["convert_files"]


class _Met(NamedTuple):
    """What a first pass met in one file."""

    path: Path
    editions: dict[int, str]
    held: dict[int, set[str]]  # fields that records of each category hold
    first: float  # s: times of the records
    last: float
    problems: tuple[str, ...]


def convert_files(
    inputs: Sequence[Path],
    output: Path,
    *,
    categories: Sequence[int] = (),
    items: Sequence[str] = (),
    time_from: str | None = None,
    time_to: str | None = None,
    native: bool = False,
    config_path: Path | None = None,
    date: str | None = None,
    framing: str | None = None,
) -> Counter[int]:
    """Write every decoded item of recordings to a table, one row a record, in the order of the files.

    Args:
        inputs: ASTERIX files, directories, patterns.
        output: file whose suffix is one of `saltus.convert.writers.SUFFIXES`; it appears whole or not at all.
        categories: of the records written; none = all.
        items: as 040, 040/RHO, I048/040; none = all.
        time_from: first time written, HH:MM[:SS] of the recording's day or ISO 8601, UTC.
        time_to: last time written.
        native: in the units of the format (NM, FL, degrees, kt), else SI units and radians.
        config_path: TOML file with date, editions, framing.
        date: YYYY-MM-DD of the recordings.
        framing: one of `saltus.framing.NAMES`; None has it guessed.

    Returns:
        Number of rows by category.

    Raises:
        DataError: an input is no ASTERIX, nothing is left to write, or an item or category does not occur.
        ModelError: the configuration is wrong.
    """
    check_suffix(output)
    config = load_config(config_path, date=date, framing=framing)
    paths = [p for p in expand(inputs) if not _is_table(p, inputs)]
    wanted = Items.parse(items)
    with progress_bar() as bar:
        met = [_first_pass(path, config, categories, wanted, bar) for path in paths]
        _check(paths, categories, met)
        layouts = _layouts(met)
        wanted.check(layouts)
        columns = _columns(met, layouts, wanted)
        schema = schema_of(columns, native=native)
        span = min(m.first for m in met), max(m.last for m in met)
        window = time_window(time_from, time_to, *span) if time_from or time_to else None
        rows: Counter[int] = Counter()
        with output_file(output) as temporary:
            writer = open_writer(temporary, schema)
            try:
                for m in met:
                    for table, counts in _tables(m, config, columns, schema, window, native, bar):
                        writer.write(table)
                        rows += counts
            finally:
                writer.close()
    _show(met, rows, schema, output)
    return rows


def _is_table(path: Path, inputs: Sequence[Path]) -> bool:
    """Whether a file is no ASTERIX; one that is named itself is refused."""
    if "table" not in format_of(path).name:
        return False
    if path in inputs:
        raise DataError(f"{path}: is a table already; convert reads ASTERIX in any framing.")
    return True


def _first_pass(path: Path, config: Config, categories: Sequence[int], items: Items, bar: Progress) -> _Met:
    """See which categories, editions and fields a file holds, and when."""
    stream = Stream(path, config.editions, config.framing)
    clock, held = Clock(config.date, path.name), dict[int, set[str]]()
    first, last = np.inf, -np.inf
    for piece in stream.pieces(progress=lambda name, share: bar.working(f"looking at {name}", share)):
        found = stream.records(piece)
        dated = all(blocks.dated for blocks, _ in piece.values())
        for number, times in clock.times(_read(found), dated=dated).items():
            if categories and number not in categories:
                continue
            seen = held.setdefault(number, set())
            seen |= held_by(found[number], [f for f in fields_of(found[number].layout, items) if f.path not in seen])
            finite = times[np.isfinite(times)]
            if len(finite):
                first, last = min(first, float(finite.min())), max(last, float(finite.max()))
    editions = {number: chosen.edition for number, chosen in stream.chosen.items() if chosen.edition}
    unread = [f"{path.name}: category {n}: {c.note}" for n, c in stream.chosen.items() if not c.edition]
    return _Met(path, editions, held, first, last, (*stream.told.problems, *unread, *dict.fromkeys(clock.problems)))


def _read(found: Mapping[int, Found]) -> dict[int, Read]:
    return {number: read_records(CATEGORIES[number], f) for number, f in found.items() if len(f)}


def _layouts(met: Sequence[_Met]) -> dict[int, Layout]:
    """The layout of each category; where files follow several editions, the newest."""
    editions: dict[int, set[str]] = {}
    for m in met:
        for number in m.held:
            editions.setdefault(number, set()).add(m.editions[number])
    known = {number: known_editions(number) for number in editions}
    return {n: layout(n, max(some, key=known[n].index)) for n, some in sorted(editions.items())}


def _columns(met: Sequence[_Met], layouts: Mapping[int, Layout], wanted: Items) -> dict[int, list[Field]]:
    """Fields of each category that become columns: those asked for, else those that some record holds."""
    columns: dict[int, list[Field]] = {}
    for number, newest in layouts.items():
        held = {path for m in met for path in m.held.get(number, ())}
        others = {m.editions[number] for m in met if number in m.held} - {newest.edition}
        found = {f.path: f for f in fields_of(newest, wanted)}
        for edition in sorted(others, key=known_editions(number).index, reverse=True):
            for f in fields_of(layout(number, edition), wanted):
                found.setdefault(f.path, f)
        columns[number] = [f for path, f in found.items() if path in held or wanted.wanted]
    return columns


def _check(inputs: Sequence[Path], categories: Sequence[int], met: Sequence[_Met]) -> None:
    """Refuse inputs of which nothing would be written."""
    there = sorted({number for m in met for number in m.held})
    missing = [number for number in categories if number not in there]
    found = sorted({number for m in met for number in m.editions})
    if missing or not there:
        what = f"category {', '.join(map(str, missing))} does not occur" if missing else "no record could be read"
        known = f"; there are {', '.join(map(str, found))}" if found else ""
        said = next((f" {p}" for m in met for p in m.problems), "")
        names = ", ".join(map(str, inputs[:3])) + (" and others" if len(inputs) > 3 else "")
        raise DataError(f"{names}: {what}{known}.{said}")


def _tables(
    m: _Met,
    config: Config,
    columns: Mapping[int, Sequence[Field]],
    schema: pa.Schema,
    window: tuple[float, float] | None,
    native: bool,
    bar: Progress,
) -> Iterator[tuple[pa.Table, Counter[int]]]:
    """The rows of a file, a piece at a time, in the order of its records."""
    stream = Stream(m.path, m.editions, config.framing)
    clock, before = Clock(config.date, m.path.name), Counter[int]()
    for piece in stream.pieces(progress=lambda name, share: bar.working(f"converting {name}", share)):
        found = stream.records(piece)
        times = clock.times(_read(found), dated=all(blocks.dated for blocks, _ in piece.values()))
        parts, sequence, counts = [], [], Counter[int]()
        for number in sorted(times.keys() & columns.keys()):
            f = found[number]
            part = _common(m.path.name, number, f, piece[number][0], times[number], before[number])
            part |= table_of(number, f, [c for c in columns[number] if f.layout.has(c.path)], native=native)
            before[number] += len(f)
            keep = np.ones(len(f), np.bool_)
            if window is not None:
                keep = (times[number] >= window[0]) & (times[number] <= window[1])
            counts[number] = int(keep.sum())
            parts.append(_filled(part, schema, len(f)).filter(pa.array(keep)))
            sequence.append(f.sequence[keep])
        if parts:
            order = np.argsort(np.concatenate(sequence), kind="stable")
            yield pa.concat_tables(parts).take(pa.array(order)), counts


def _common(
    name: str, number: int, found: Found, blocks: Blocks, times: npt.NDArray[np.float64], before: int
) -> dict[str, pa.Array]:
    """Columns that every record has."""
    n = len(found)
    first, stop = found.columns.spans(SOURCE).T
    sac, sic = found.data[first], found.data[np.minimum(first + 1, stop - 1)]
    values = (
        pa.array([name] * n, pa.string()),
        pa.array(blocks.at[found.records.block]),
        pa.array(np.full(n, number, np.int16)),
        pa.array(before + np.arange(n)),
        pa.array(sac.astype(np.int16)),
        pa.array(sic.astype(np.int16)),
        pa.array(times, mask=np.isnan(times)),
    )
    return dict(zip(COMMON.names, values, strict=True))


def _filled(part: Mapping[str, pa.Array], schema: pa.Schema, n: int) -> pa.Table:
    """A table of all columns, those that this category does not have null."""
    return pa.table([part[f.name] if f.name in part else pa.nulls(n, f.type) for f in schema], schema=schema)


def _show(met: Sequence[_Met], rows: Counter[int], schema: pa.Schema, output: Path) -> None:
    told = ", ".join(f"{n} of category {number}" for number, n in sorted(rows.items()))
    click.echo(f"{rows.total()} records ({told}), {len(schema)} columns: written to {output}")
    for problem in (p for m in met for p in m.problems):
        click.echo(f"problem: {problem}")
