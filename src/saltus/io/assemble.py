"""Walked records to target reports and lines of contents."""

import datetime
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.io.blocks import Block
from saltus.io.cat010 import CAT010
from saltus.io.cat021 import CAT021
from saltus.io.cat034 import CAT034
from saltus.io.cat048 import CAT048
from saltus.io.cat062 import CAT062
from saltus.io.clock import DAY, day_offsets
from saltus.io.columns import Category, Columns, Decoded
from saltus.io.layout import Layout, Malformed
from saltus.io.part import Part, revisit, rotating
from saltus.records import Contents, Kind, Plots, Source, System, Traits

__all__ = ["CATEGORIES", "TIME_ITEM", "Records", "assemble"]

CATEGORIES = {c.number: c for c in (CAT010, CAT021, CAT034, CAT048, CAT062)}

# time of day of categories that are only counted
TIME_ITEM = {2: "030", 8: "090", 19: "140", 20: "140", 23: "070", 25: "070", 63: "030", 65: "030"}
_TURNS = {48: 34}  # target category -> category of its service messages


@dataclass(slots=True)
class Records:
    """The records of one category as they are walked."""

    layout: Layout
    wanted: frozenset[str]
    fspecs: list[bytes] = field(default_factory=list)
    sequence: list[int] = field(default_factory=list)  # position among all records of the file
    clock: list[float] = field(default_factory=list)
    items: dict[str, tuple[list[int], list[bytes]]] = field(default_factory=dict)

    def add(self, block: Block, sequence: int) -> int:
        """Take the records of a block; return how many. Malformed carries what stopped it, whole records stay."""
        data, position, end = block.data, 3, len(block.data)
        start = len(self.fspecs)
        while position < end:
            fspec, spans, position = self.layout.walk(data, position, end)
            if "010" not in spans:
                raise Malformed(position, "a record does not name its source (item 010)")
            k = len(self.fspecs)
            for name in self.wanted & spans.keys():
                index, chunks = self.items.setdefault(name, ([], []))
                index.append(k)
                chunks.append(data[spans[name][0] : spans[name][1]])
            self.fspecs.append(fspec)
            self.sequence.append(sequence + k - start)
            self.clock.append(block.clock)
        return len(self.fspecs) - start

    def columns(self) -> Columns:
        """The wanted items, by name."""
        return Columns(self.layout, len(self.fspecs), self.items)


def assemble(
    name: str,
    records: Mapping[int, Records],
    notes: Mapping[int, tuple[str, ...]],
    problems: list[str],
    date: datetime.date | str | None,
) -> Part:
    """Turn walked records into target reports and lines of contents."""
    walked = {number: r for number, r in records.items() if r.fspecs}
    decoded = {number: _decode(number, r.columns()) for number, r in walked.items()}
    times = _times(walked, decoded, date)
    if date is None:
        problems.append(f"{name}: no date given: times count from 1970-01-01; give --date YYYY-MM-DD.")
    plots, tracks, contents = [], [], []
    turns = _turns(walked, decoded, times)
    for number, r in walked.items():
        systems, system_of = _systems(number, r.columns())
        traits = CATEGORIES[number].traits if number in CATEGORIES else Traits()
        kinds = np.asarray(decoded[number].columns.get("kind", np.full(len(system_of), Kind.NONE)))
        sources = tuple(
            Source(s, rotating(traits, kinds[system_of == k]), **decoded[number].steps) for k, s in enumerate(systems)
        )
        part = _plots(name, sources, system_of, times[number], decoded[number])
        plots.append(part)
        table = decoded[number].tracks
        if table is not None:
            labels = [str(systems[k]) for k in system_of]
            tracks.append(
                table.add_column(0, "system", pa.array(labels)).add_column(1, "time", pa.array(times[number]))
            )
        for k, system in enumerate(systems):
            line = _contents(name, system, r, decoded[number], times[number], system_of == k, part, turns)
            extra = () if number in CATEGORIES else ("counted only: no target reports are taken from this category",)
            contents.append(replace(line, notes=(*notes[number], *extra)))
    with_reports = [p for p in plots if len(p)] or plots[:1]
    return Part(
        _one_file(Plots.concat(with_reports), name),
        pa.concat_tables(tracks) if tracks else None,
        tuple(contents),
        tuple(problems),
        in_order=True,
        dated=isinstance(date, str),
    )


def _decode(number: int, columns: Columns) -> Decoded:
    category: Category | None = CATEGORIES.get(number)
    if category is not None:
        return category.decode(columns)
    item = TIME_ITEM.get(number)
    return Decoded(
        time_of_day=columns.number(item) if item else np.full(columns.n, np.nan),
        is_report=np.zeros(columns.n, np.bool_),
        types=np.full(columns.n, -1, np.int64),
        labels={},
        columns={},
        new_cycle=np.zeros(columns.n, np.bool_),
        steps={},
    )


def _times(
    records: Mapping[int, Records], decoded: Mapping[int, Decoded], date: datetime.date | str | None
) -> dict[int, npt.NDArray[np.float64]]:
    """Times of all records, s, UTC: midnights are counted over the whole file, or told by the capture clock."""
    sequence = np.concatenate([r.sequence for r in records.values()])
    tod = np.concatenate([d.time_of_day for d in decoded.values()])
    if isinstance(date, str):
        clock = np.concatenate([r.clock for r in records.values()])
        days = np.round((clock - tod) / DAY)
        time = tod + DAY * np.where(np.isnan(days), np.nanmedian(days) if np.isfinite(days).any() else 0.0, days)
    else:
        order = np.argsort(sequence, kind="stable")
        days = np.empty(len(tod))
        days[order] = day_offsets(tod[order])
        first = (date or datetime.date(1970, 1, 1)) - datetime.date(1970, 1, 1)
        time = tod + DAY * (days + first.days)
    bounds = np.cumsum([0] + [len(r.fspecs) for r in records.values()])
    return {n: time[a:b] for n, a, b in zip(records, bounds[:-1], bounds[1:], strict=True)}


def _systems(number: int, columns: Columns) -> tuple[list[System], npt.NDArray[np.int64]]:
    """The sources of a category's records, and which each record is of."""
    index, chunks = columns.items["010"]
    word = np.zeros(columns.n, np.int64)
    word[index] = [int.from_bytes(chunk[:2], "big") for chunk in chunks]
    values, which = np.unique(word, return_inverse=True)
    return [System(number, int(v) >> 8, int(v) & 255) for v in values], which.astype(np.int64)


def _plots(
    name: str,
    sources: tuple[Source, ...],
    system_of: npt.NDArray[np.int64],
    time: npt.NDArray[np.float64],
    decoded: Decoded,
) -> Plots:
    columns = {
        **decoded.columns,
        "time": time,
        "source": system_of,
        "file": np.zeros(len(time)),
        "record": np.arange(len(time)),
    }
    return Plots.build(len(time), sources, (name,), columns).take(np.flatnonzero(decoded.is_report))


def _one_file(plots: Plots, name: str) -> Plots:
    """Categories were joined as if they were files: make them one again."""
    columns = {c: getattr(plots, c) for c in plots.column_names()}
    columns["file"] = np.zeros(len(plots), np.int32)
    return Plots.build(len(plots), plots.sources, (name,), columns)


def _turns(
    records: Mapping[int, Records],
    decoded: Mapping[int, Decoded],
    times: Mapping[int, npt.NDArray[np.float64]],
) -> dict[System, float]:
    """Median time between two starts of a cycle of each system that sends them, s."""
    found = {}
    for number, d in decoded.items():
        systems, system_of = _systems(number, records[number].columns())
        for k, system in enumerate(systems):
            starts = np.unique(times[number][d.new_cycle & (system_of == k)])
            if len(starts) >= 3:
                found[system] = float(np.median(np.diff(starts[np.isfinite(starts)])))
    return found


def _contents(
    name: str,
    system: System,
    records: Records,
    decoded: Decoded,
    time: npt.NDArray[np.float64],
    mine: npt.NDArray[np.bool_],
    plots: Plots,
    turns: Mapping[System, float],
) -> Contents:
    """One line of `saltus info`; rejected reports are counted when the files are merged."""
    number = system.category or 0
    fields: Counter[str] = Counter()
    for fspec, n in Counter(records.fspecs[k] for k in np.flatnonzero(mine)).items():
        fields.update({f"I{number:03d}/{item}": n for item in records.layout.names_in(fspec)})
    kinds, counts = np.unique(decoded.types[mine], return_counts=True)
    own = plots.take(np.flatnonzero(plots.source == plots.sources.index(_source_of(plots, system))))
    service = System(_TURNS.get(number, number), system.sac, system.sic)
    period = turns.get(service, turns.get(system, np.nan))
    if np.isnan(period):
        period = revisit(own.time, own.icao24, own.local_id if number == 62 else own.mode3a, own.local_id)
    span = time[mine & np.isfinite(time)]
    return Contents(
        file=name,
        system=system,
        edition=records.layout.edition,
        n_records=int(np.count_nonzero(mine)),
        n_reports=int(np.count_nonzero(mine & decoded.is_report)),
        time_from=float(span.min()) if len(span) else float("nan"),
        time_to=float(span.max()) if len(span) else float("nan"),
        update_period=float(period),
        fields=dict(sorted(fields.items())),
        rejected={},
        n_by_type={
            decoded.labels.get(int(kind), "type not given" if kind < 0 else f"type {kind}"): int(n)
            for kind, n in zip(kinds, counts, strict=True)
        },
    )


def _source_of(plots: Plots, system: System) -> Source:
    return next(s for s in plots.sources if s.system == system)
