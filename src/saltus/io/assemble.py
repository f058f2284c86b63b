"""Records of a recording, as columns, to target reports and lines of contents."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.asterix.codec import announced
from saltus.io.categories import CATEGORIES
from saltus.io.clock import told_clock
from saltus.io.columns import Decoded
from saltus.io.dating import Clock, Read, read_records
from saltus.io.found import Found
from saltus.io.part import Part, revisit, rotating
from saltus.io.same_code import SameCode
from saltus.records import Contents, Kind, Plots, Source, System, Traits

__all__ = ["Assembler"]


class Assembler:
    """Turns the records of a recording, piece after piece, into target reports and lines of contents."""

    def __init__(
        self,
        name: str,
        clock: Clock,
        before: Mapping[int, int] | None = None,
        apart: Collection[tuple[int, int]] = (),
    ) -> None:
        """Begin a recording.

        Args:
            name: of the file.
            clock: that dates its records.
            before: records of each category before those that will be given.
            apart: SAC and SIC of the sources that are told apart by the channel that brings them.
        """
        self.same_code = SameCode()
        self._apart = apart
        self._name, self._clock = name, clock
        self._before = Counter(before or {})  # records of each category in the pieces before
        self.read: dict[int, Read] = {}  # of the last piece, and
        self.times: dict[int, npt.NDArray[np.float64]] = {}  # the times of its records
        self._doubted = False  # the clock of the capture was found to be another

    def part(
        self,
        found: Mapping[int, Found],
        notes: Mapping[int, tuple[str, ...]],
        channels: Sequence[str] = (),
        *,
        dated: bool,
    ) -> Part:
        """Take the next piece.

        Args:
            found: records by category.
            notes: on each category.
            channels: names of the channels so far.
            dated: the clocks of all blocks tell the date.
        """
        name, clock = self._name, self._clock
        names = dict(enumerate(channels))
        read = {
            number: read_records(CATEGORIES[number], records, names, self._apart)
            for number, records in found.items()
            if len(records)
        }
        times = clock.times(read, dated=dated)
        self.read, self.times = read, times
        problems: list[str] = []
        if clock.captured and read and not self._doubted:
            captured = np.concatenate([r.found.clock for r in read.values()])
            told = told_clock(captured, np.concatenate(list(times.values())))
            problems += [f"{name}: {told}"] if told else []
            self._doubted = bool(told)
        plots, tracks, contents = [], [], []
        turns = _turns(read, times)
        self._look_for_two(read, times)
        for number, r in read.items():
            part = _plots(name, CATEGORIES[number].traits, r, times[number], self._before[number])
            self.same_code.add(part, r.found.channel[r.decoded.is_report].astype(np.int64))
            self._before[number] += len(r.found)
            plots.append(part)
            if r.decoded.tracks is not None:
                tracks.append(_tracks(r, r.decoded.tracks, times[number]))
            contents += _lines(name, number, r, times[number], part, turns, notes[number])
        with_reports = [p for p in plots if len(p)] or plots[:1]
        return Part(
            Plots.concat(with_reports, same_files=True) if with_reports else Plots.build(0, (), (name,), {}),
            pa.concat_tables(tracks) if tracks else None,
            tuple(contents),
            tuple(problems),
            in_order=True,
            dated=clock.captured,
        )

    def _look_for_two(self, read: Mapping[int, Read], times: Mapping[int, npt.NDArray[np.float64]]) -> None:
        """Look for north marks of two antennas of one code."""
        for number, r in read.items():
            marks = np.flatnonzero(r.decoded.new_cycle)
            codes = np.array([(s.sac or 0) << 8 | (s.sic or 0) for s in r.systems], np.int64)[r.system_of[marks]]
            for code in np.unique(codes).tolist():
                own = marks[codes == code]
                channel = r.found.channel[own].astype(np.int64)
                self.same_code.turns((code >> 8, code & 255), times[number][own], channel)


def _lines(
    name: str,
    number: int,
    r: Read,
    time: npt.NDArray[np.float64],
    plots: Plots,
    turns: Mapping[System, float],
    notes: tuple[str, ...],
) -> list[Contents]:
    """A line of contents for each system of a category."""
    lines = []
    sets, which = announced(r.found.data, r.found.records, r.found.layout)
    for k, system in enumerate(r.systems):
        mine = r.system_of == k
        fields: Counter[str] = Counter()
        for items, n in zip(sets, np.bincount(which[mine], minlength=len(sets)).tolist(), strict=True):
            fields.update({f"I{number:03d}/{item}": n for item in items if n})
        line = _contents(name, system, r, time, mine, plots, turns)
        extra = ("counted only: no target reports are taken from this category",)
        said = (*notes, *(extra if CATEGORIES[number].counted else ()))
        titles = {item: r.found.layout.titles.get(item[5:], "") for item in fields}
        lines.append(replace(line, fields=dict(sorted(fields.items())), notes=said, titles=titles))
    return lines


def _plots(name: str, traits: Traits, r: Read, time: npt.NDArray[np.float64], before: int) -> Plots:
    kinds = np.asarray(r.decoded.columns.get("kind", np.full(len(time), Kind.NONE)))
    sources = tuple(
        Source(s, rotating(traits, kinds[r.system_of == k]), **r.decoded.steps) for k, s in enumerate(r.systems)
    )
    columns = {
        **r.decoded.columns,
        "time": time,
        "source": r.system_of,
        "file": np.zeros(len(time)),
        "record": before + np.arange(len(time)),
    }
    return Plots.build(len(time), sources, (name,), columns).take(np.flatnonzero(r.decoded.is_report))


def _tracks(r: Read, table: pa.Table, time: npt.NDArray[np.float64]) -> pa.Table:
    labels = pa.array([str(system) for system in r.systems]).take(pa.array(r.system_of))
    table = table.add_column(0, "system", labels).add_column(1, "time", pa.array(time))
    return table.filter(pa.array(r.decoded.is_report))


def _turns(read: Mapping[int, Read], times: Mapping[int, npt.NDArray[np.float64]]) -> dict[System, float]:
    """Median time between two starts of a cycle of each system that sends them, s."""
    found = {}
    for number, r in read.items():
        for k, system in enumerate(r.systems):
            starts = np.unique(times[number][r.decoded.new_cycle & (r.system_of == k)])
            if len(starts) >= 3:
                found[system] = float(np.median(np.diff(starts[np.isfinite(starts)])))
    return found


def _contents(
    name: str,
    system: System,
    r: Read,
    time: npt.NDArray[np.float64],
    mine: npt.NDArray[np.bool_],
    plots: Plots,
    turns: Mapping[System, float],
) -> Contents:
    """One line of `saltus info`, without its fields; rejected reports are counted when the files are merged."""
    number = system.category or 0
    decoded = r.decoded
    kinds, counts = np.unique(decoded.types[mine], return_counts=True)
    own = plots.take(np.flatnonzero(plots.source == plots.sources.index(_source_of(plots, system))))
    service = replace(system, category=CATEGORIES[number].turns or number)
    period = turns.get(service, turns.get(system, np.nan))
    if np.isnan(period):
        numbered = decoded.tracks is not None  # another system's tracks are told apart by their numbers
        period = revisit(own.time, own.icao24, own.local_id if numbered else own.mode3a, own.local_id)
    span = time[mine & np.isfinite(time)]
    return Contents(
        file=name,
        system=system,
        edition=r.found.layout.edition,
        n_records=int(np.count_nonzero(mine)),
        n_reports=int(np.count_nonzero(mine & decoded.is_report)),
        time_from=float(span.min()) if len(span) else float("nan"),
        time_to=float(span.max()) if len(span) else float("nan"),
        update_period=float(period),
        fields={},
        rejected={},
        n_by_type={
            decoded.labels.get(int(kind), "type not given" if kind < 0 else f"type {kind}"): int(n)
            for kind, n in zip(kinds, counts, strict=True)
        },
        words=CATEGORIES[number].words,
        site=_site(decoded, mine),
    )


def _site(decoded: Decoded, mine: npt.NDArray[np.bool_]) -> tuple[float, float, float] | None:
    """Where a source says that it stands."""
    if decoded.site is None or not np.isfinite(decoded.site[0][mine]).any():
        return None
    told = [v[mine][np.isfinite(v[mine])] for v in decoded.site]
    latitude, longitude, height = (float(np.median(v)) if len(v) else float("nan") for v in told)
    return latitude, longitude, height


def _source_of(plots: Plots, system: System) -> Source:
    return next(s for s in plots.sources if s.system == system)
