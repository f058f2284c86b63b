"""`saltus info`: what is in recordings, in words and figures."""

import datetime
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path

import click
import numpy as np
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from saltus.config import Config, load_config
from saltus.errors import DataError, SaltusError
from saltus.info.inventory import Inventory, Line
from saltus.info.skeleton import skeleton
from saltus.io import Told, format_of, read_part
from saltus.io.asterix import read_pieces
from saltus.io.inputs import expand, left_out
from saltus.io.merge import merge
from saltus.io.part import Part, printable
from saltus.records import Contents, FileContents
from saltus.text import shown

__all__ = ["show_info"]

_PLAIN_WIDTH = 120  # columns when the output is no terminal
_DAY = 86400.0  # s
_HEAD = 1 << 22  # bytes of a recording that tell what is in it
_CHANNELS = 6  # named one by one


def show_info(
    inputs: Sequence[Path],
    config_path: Path | None = None,
    date: str | None = None,
    framing: str | None = None,
    *,
    full: bool = False,
    as_skeleton: bool = False,
) -> None:
    """Print what recordings hold: framing, systems, targets, where and when, items, rejected reports.

    Of large ASTERIX files the beginning is read, unless all is asked for. Files that cannot be read are named after
    all others are shown.

    Args:
        inputs: files, directories, patterns.
        config_path: TOML file with date, editions and sensors, or None.
        date: YYYY-MM-DD of the first record; goes before the configuration's.
        framing: one of `saltus.framing.NAMES`; None has it guessed.
        full: read all of every file.
        as_skeleton: print a configuration to begin with, and nothing else.

    Raises:
        DataError: files cannot be read at all.
        ModelError: the configuration or the date is wrong.
    """
    config = load_config(config_path, date=date, framing=framing)
    told = Told(config.date, config.editions, config.framing, config.reading, None if full else _HEAD, config.apart)
    inventory, parts = Inventory(), list[Part]()
    failures: dict[str, SaltusError | OSError] = {}
    paths = expand(inputs)
    for path in paths:
        try:
            if full and path.stat().st_size > _HEAD and "table" not in format_of(path, config.framing).name:
                for part in read_pieces(
                    path, date=told.date, editions=told.editions, framing=told.framing, apart=told.apart
                ):
                    inventory.add(merge([printable(part)]))
            else:
                parts.append(read_part(path, told))
        except (SaltusError, OSError) as error:
            failures.setdefault(str(error), error)
    if parts:
        inventory.add(merge(parts))
    if inventory.lines and as_skeleton:
        click.echo(skeleton(inventory), nl=False)
    elif inventory.lines:
        console = Console(highlight=False)
        if not console.is_terminal:
            console = Console(highlight=False, width=_PLAIN_WIDTH)
        _show(console, inventory, [shown(path.name) for path in paths], config, left_out(inputs))
    if len(failures) == 1:
        raise next(iter(failures.values()))
    if failures:
        raise DataError("\n".join(failures))


def _show(console: Console, inventory: Inventory, files: Sequence[str], config: Config, missed: Sequence[str]) -> None:
    """Print all files in the order in which they were given, and what was not read."""
    for file in dict.fromkeys(files):
        lines = inventory.of_file(file)
        if not lines:
            continue
        console.print(Text(file, style="bold"))
        if file in inventory.files:
            console.print(Padding(_file(inventory.files[file]), (0, 0, 1, 2)))
        for line in lines:
            console.print(Padding(_system(line, config), (0, 0, 1, 2)))
        for items in _items([line.contents for line in lines]):
            console.print(Padding(items, (0, 0, 1, 2)))
    n, usable = inventory.n_reports, inventory.n_usable
    console.print(f"{n} target reports, {usable} usable, {n - usable} rejected")
    if inventory.n_tracks:
        console.print(f"{inventory.n_tracks} reports are another system's tracks: kept apart, never plots")
    for problem in (*missed, *inventory.problems):
        console.print(Text("problem: ", style="yellow") + Text(problem))


def _grid() -> Table:
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="cyan", no_wrap=True)
    grid.add_column(overflow="fold")
    return grid


def _file(file: FileContents) -> Table:
    """How a file is framed, and what of it was looked at."""
    grid = _grid()
    for words in file.framing:
        grid.add_row("framing", Text(words))
    if file.n_read < file.size:
        share = f"{file.n_read / file.size:.1%}"
        grid.add_row("read", Text(f"the first {_size(file.n_read)} of {_size(file.size)} ({share}); --full reads all"))
    for words in file.order:
        grid.add_row("order", Text(words))
    if file.channels:
        more = f", and {len(file.channels) - _CHANNELS} more" if len(file.channels) > _CHANNELS else ""
        grid.add_row("channels", Text(f"{len(file.channels)}: {', '.join(file.channels[:_CHANNELS])}{more}"))
    if file.passed:
        grid.add_row("passed over", Text(_counts(file.passed)))
    return grid


def _system(entry: Line, config: Config) -> Table:
    """One system as a grid of two columns."""
    grid, line, figures = _grid(), entry.contents, entry.figures
    site = config.site_for(line.system)
    named = f"  {shown(site.name)}" if site and shown(site.name) != line.system.name else ""
    edition = f"  edition {line.edition}" if line.edition else ""
    words = f"  {line.words}" if line.words else ""
    grid.add_row(Text(str(line.system), style="bold"), Text(f"{named}{edition}{words}".strip()))
    grid.add_row("records", f"{line.n_records}, of these {line.n_reports} target reports")
    if line.n_reports:
        grid.add_row("targets", Text(figures.targets()))
    grid.add_row("time", _span(line))
    period = "cannot be told" if np.isnan(line.update_period) else f"{line.update_period:.3f} s"
    grid.add_row("update", period)
    for where in figures.extents():
        grid.add_row("extent", Text(where))
    if line.site is not None:
        grid.add_row("site", Text(_place(*line.site)))
    high = figures.levels()
    if high:
        grid.add_row("levels", Text(high))
    if line.n_by_type:
        grid.add_row("types", Text(_counts(line.n_by_type)))
    if line.n_reports:
        rejected = sum(line.rejected.values())
        usable = f"{line.n_reports - rejected} usable"
        grid.add_row("rejected", Text(f"{_counts(line.rejected)} ({usable})" if rejected else f"none ({usable})"))
    if line.fields and not line.titles:
        grid.add_row("fields", Text(_counts(line.fields)))
    for note in line.notes:
        grid.add_row("note", Text(note))
    return grid


def _place(latitude: float, longitude: float, height: float) -> str:
    above = f", {height:.1f} m" if np.isfinite(height) else ""
    return f"{np.degrees(latitude):.6f}, {np.degrees(longitude):.6f} degrees{above}, as it tells itself"


def _items(lines: Sequence[Contents]) -> list[RenderableType]:
    """Of each category the items that its systems send: number, words, how many records carry it."""
    shown_items: list[RenderableType] = []
    for (category, edition), group in groupby(
        sorted((c for c in lines if c.titles), key=lambda c: (c.system.category or 0, c.edition)),
        key=lambda c: (c.system.category, c.edition),
    ):
        some = list(group)
        count: Counter[str] = Counter()
        titles: dict[str, str] = {}
        for line in some:
            count.update(line.fields)
            titles |= line.titles
        n = sum(line.n_records for line in some)
        table = Table.grid(padding=(0, 2))
        table.add_column(style="cyan", no_wrap=True)
        table.add_column(overflow="fold")
        table.add_column(justify="right")
        table.add_column(justify="right")
        for name in sorted(count):
            table.add_row(Text(name), Text(titles[name]), str(count[name]), f"{count[name] / n:.0%}")
        shown_items.append(Group(Text(f"items of category {category}, edition {edition}", style="bold"), table))
    return shown_items


def _counts(table: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {n}" for name, n in table.items())


def _size(n: int) -> str:
    """Bytes in words."""
    return f"{n / 1e6:.1f} MB" if n >= 1e5 else f"{n} bytes"


def _span(line: Contents) -> str:
    if np.isnan(line.time_from):
        return "not told"
    seconds = line.time_to - line.time_from
    sizes = ((2 * _DAY, _DAY, "days"), (7200.0, 3600.0, "h"), (60.0, 60.0, "min"))
    lengths = [f"{seconds / unit:.1f} {name}" for least, unit, name in sizes if seconds >= least]
    length = lengths[0] if lengths else f"{seconds:.3f} s"
    return f"{_moment(line.time_from)} to {_moment(line.time_to)} UTC ({length})"


def _moment(time: float) -> str:
    """Date and time of day; without a date (counted from 1970-01-01) the time of day alone."""
    moment = datetime.datetime.fromtimestamp(round(time, 3), datetime.UTC)
    shown = moment.strftime("%H:%M:%S.") + f"{moment.microsecond // 1000:03d}"
    if -_DAY <= time < 10 * _DAY:
        days = int(time // _DAY)
        return shown + (f" (+{days} d)" if days else "")
    return f"{moment:%Y-%m-%d} {shown}"
