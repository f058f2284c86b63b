"""What a reader makes of one file, before files are merged."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.io.contents import Tally
from saltus.records import Contents, FileContents, Kind, Plots, System, Traits
from saltus.shapes import Int
from saltus.text import shown

__all__ = ["Part", "join_parts", "printable", "revisit", "rotating", "scan_period"]

_FEW = 5  # intervals that make a median
_NEARLY, _MOSTLY = 0.2, 0.8  # this share of the intervals lies within that of their median: one report a scan
_FASTEST = 0.1  # s: closer reports are those of one rotation, not of one target
_SHARED = 0.1  # of the reports share their time with another: the source dates scans, not reports


class Part(NamedTuple):
    """One file: its target reports in file order, and the lines of `saltus info` without the rejected reports."""

    plots: Plots
    tracks: pa.Table | None
    contents: tuple[Contents, ...]
    problems: tuple[str, ...]
    in_order: bool  # the order of the reports is the order of reception (not so in tables)
    dated: bool  # the file tells the date itself
    file: FileContents | None = None


def join_parts(parts: Sequence[Part]) -> Part:
    """Make one of the pieces of one file; what the last tells of the file goes first."""
    tables = [part.tracks for part in parts if part.tracks is not None]
    tally = Tally()
    for part in parts:
        tally.add(part.contents)
    last = parts[-1]
    return Part(
        Plots.concat([part.plots for part in parts], same_files=True),
        pa.concat_tables(tables) if tables else None,
        tally.lines(),
        tuple(dict.fromkeys(problem for part in (last, *parts[:-1]) for problem in part.problems)),
        last.in_order,
        last.dated,
        last.file,
    )


def rotating(traits: Traits, kind: npt.NDArray[np.integer]) -> Traits:
    """Return the traits of a source with reports of these kinds: what measures range and azimuth turns round."""
    return replace(traits, rotating=bool((kind == Kind.POLAR).any()))


def printable(part: Part) -> Part:
    """Spell the names of files and sources and what is said of them so that they only show (`saltus.text.shown`)."""

    def system(of: System) -> System:
        return replace(of, name=shown(of.name))

    plots = replace(
        part.plots,
        sources=tuple(replace(s, system=system(s.system)) for s in part.plots.sources),
        files=tuple(shown(name) for name in part.plots.files),
    )
    lines = tuple(
        replace(
            line,
            file=shown(line.file),
            system=system(line.system),
            fields={shown(name): count for name, count in line.fields.items()},
            notes=tuple(shown(note) for note in line.notes),
        )
        for line in part.contents
    )
    about = part.file and replace(part.file, file=shown(part.file.file))
    problems = tuple(shown(told) for told in part.problems)
    return part._replace(plots=plots, contents=lines, problems=problems, file=about)


def revisit(time: npt.ArrayLike, *identities: Int[np.ndarray, " n"]) -> float:
    """Median time between two reports of one target, s, NaN when none returns.

    Args:
        time: (N,) s.
        identities: columns that tell targets apart, the best first, -1 = not given; the first that tells any is used.
    """
    times = np.asarray(time, np.float64)
    for identity in identities:
        known = (identity >= 0) & np.isfinite(times)
        order = np.lexsort((times[known], identity[known]))
        who, when = identity[known][order], times[known][order]
        step = np.diff(when)[(np.diff(who) == 0) & (np.diff(when) > 0)]
        if len(step) >= _FEW:
            return float(np.median(step))
    return float("nan")


def scan_period(time: npt.ArrayLike) -> float:
    """Median time between the scans of a source, where its times tell: NaN where they do not.

    They tell when all reports of a scan have one time, and when single reports come at regular intervals.

    Args:
        time: (N,) s, NaN = unknown.
    """
    times = np.asarray(time, np.float64)
    scans, counts = np.unique(times[np.isfinite(times)], return_counts=True)
    shared = counts[counts > 1].sum()
    if len(scans) <= _FEW:
        return float("nan")
    steps = np.diff(scans)
    median = float(np.median(steps))
    regular = np.mean(np.abs(steps - median) < _NEARLY * median) > _MOSTLY
    told = shared >= _SHARED * counts.sum() or (regular and median > _FASTEST)
    return median if told else float("nan")
