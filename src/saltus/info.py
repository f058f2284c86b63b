"""`saltus info`: what is in a recording."""

import datetime
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from saltus.config import Config, load_config
from saltus.errors import DataError, SaltusError
from saltus.io import Told, read_part
from saltus.io.inputs import expand
from saltus.io.merge import merge
from saltus.io.part import Part
from saltus.records import Contents, Recording
from saltus.text import shown

__all__ = ["show_info"]

_PLAIN_WIDTH = 120  # columns when the output is no terminal
_DAY = 86400.0  # s


def show_info(inputs: Sequence[Path], config_path: Path | None, date: str | None, framing: str | None) -> None:
    """Print systems, editions, counts, times, update period, fields and rejected reports of recordings.

    Files that cannot be read are named after all others are shown.

    Args:
        inputs: files, directories, patterns.
        config_path: TOML file with date, editions and sensors, or None.
        date: YYYY-MM-DD of the first record; goes before the configuration's.
        framing: one of `saltus.framing.NAMES`; None has it guessed.

    Raises:
        DataError: files cannot be read at all.
        ModelError: the configuration or the date is wrong.
    """
    config = load_config(config_path, date=date, framing=framing)
    told = Told(config.date, config.editions, config.framing, config.reading)
    parts: list[Part] = []
    failures: dict[str, SaltusError | OSError] = {}
    for path in expand(inputs):
        try:
            parts.append(read_part(path, told))
        except (SaltusError, OSError) as error:
            failures.setdefault(str(error), error)
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=_PLAIN_WIDTH)
    if parts:
        _show(console, merge(parts), config)
    if len(failures) == 1:
        raise next(iter(failures.values()))
    if failures:
        raise DataError("\n".join(failures))


def _show(console: Console, recording: Recording, config: Config) -> None:
    for file, lines in groupby(recording.contents, key=lambda c: c.file):
        console.print(Text(shown(file), style="bold"))
        for line in lines:
            console.print(Padding(_system(line, config), (0, 0, 1, 2)))
    plots = recording.plots
    usable = int(np.count_nonzero(plots.reason == 0))
    console.print(f"{len(plots)} target reports, {usable} usable, {len(plots) - usable} rejected")
    if recording.tracks is not None:
        console.print(f"{recording.tracks.num_rows} reports are another system's tracks: kept apart, never plots")
    for problem in recording.problems:
        console.print(Text("problem: ", style="yellow") + Text(shown(problem)))


def _system(line: Contents, config: Config) -> Table:
    """One system as a grid of two columns."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="cyan", no_wrap=True)
    grid.add_column(overflow="fold")
    site = config.site_for(line.system)
    named = f"  {site.name}" if site and site.name != line.system.name else ""
    edition = f"  edition {line.edition}" if line.edition else ""
    grid.add_row(Text(str(line.system), style="bold"), Text(f"{named}{edition}".strip()))
    grid.add_row("records", f"{line.n_records}, of these {line.n_reports} target reports")
    grid.add_row("time", _span(line))
    period = "cannot be told" if np.isnan(line.update_period) else f"{line.update_period:.3f} s"
    grid.add_row("update", period)
    if line.n_by_type:
        grid.add_row("types", Text(_counts(line.n_by_type)))
    if line.fields:
        grid.add_row("fields", Text(_counts(line.fields)))
    if line.n_reports:
        rejected = sum(line.rejected.values())
        usable = f"{line.n_reports - rejected} usable"
        grid.add_row("rejected", Text(f"{_counts(line.rejected)} ({usable})" if rejected else f"none ({usable})"))
    for note in line.notes:
        grid.add_row("note", Text(note))
    return grid


def _counts(table: dict[str, int]) -> str:
    return ", ".join(f"{name} {n}" for name, n in table.items())


def _span(line: Contents) -> str:
    if np.isnan(line.time_from):
        return "not told"
    seconds = line.time_to - line.time_from
    length = f"{seconds / 60:.1f} min" if seconds >= 60 else f"{seconds:.3f} s"
    return f"{_moment(line.time_from)} to {_moment(line.time_to)} UTC ({length})"


def _moment(time: float) -> str:
    """Date and time of day; without a date (counted from 1970-01-01) the time of day alone."""
    moment = datetime.datetime.fromtimestamp(round(time, 3), datetime.UTC)
    shown = moment.strftime("%H:%M:%S.") + f"{moment.microsecond // 1000:03d}"
    if -_DAY <= time < 10 * _DAY:
        days = int(time // _DAY)
        return shown + (f" (+{days} d)" if days else "")
    return f"{moment:%Y-%m-%d} {shown}"
