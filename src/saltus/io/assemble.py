"""Records of a recording, as columns, to target reports and lines of contents."""

from collections import Counter
from collections.abc import Mapping
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
from saltus.records import Contents, Kind, Plots, Source, System, Traits

__all__ = ["assemble"]


def assemble(
    name: str,
    found: Mapping[int, Found],
    notes: Mapping[int, tuple[str, ...]],
    clock: Clock,
    *,
    dated: bool,
) -> Part:
    """Turn the records of a recording, or of its next piece, into target reports and lines of contents.

    Args:
        name: of the file.
        found: records by category.
        notes: on each category.
        clock: that goes on from piece to piece.
        dated: the clocks of all blocks tell the date.
    """
    read = {number: read_records(number, records) for number, records in found.items() if len(records)}
    problems: list[str] = []
    times = clock.times(read, dated=dated)
    if clock.captured(dated=dated):
        told = told_clock(*(np.concatenate(c) for c in ([r.found.clock for r in read.values()], list(times.values()))))
        problems += [f"{name}: {told}"] if told else []
    plots, tracks, contents = [], [], []
    turns = _turns(read, times)
    for number, r in read.items():
        part = _plots(name, CATEGORIES[number].traits, r, times[number])
        plots.append(part)
        if r.decoded.tracks is not None:
            tracks.append(_tracks(r, r.decoded.tracks, times[number]))
        sets, which = announced(r.found.data, r.found.records, r.found.layout)
        for k, system in enumerate(r.systems):
            mine = r.system_of == k
            fields: Counter[str] = Counter()
            for items, n in zip(sets, np.bincount(which[mine], minlength=len(sets)).tolist(), strict=True):
                fields.update({f"I{number:03d}/{item}": n for item in items if n})
            line = _contents(name, system, r, times[number], mine, part, turns)
            extra = ("counted only: no target reports are taken from this category",)
            said = (*notes[number], *(extra if CATEGORIES[number].counted else ()))
            titles = {name: r.found.layout.titles.get(name[5:], "") for name in fields}
            contents.append(replace(line, fields=dict(sorted(fields.items())), notes=said, titles=titles))
    with_reports = [p for p in plots if len(p)] or plots[:1]
    return Part(
        _one_file(Plots.concat(with_reports), name),
        pa.concat_tables(tracks) if tracks else None,
        tuple(contents),
        tuple(problems),
        in_order=True,
        dated=clock.captured(dated=dated),
    )


def _plots(name: str, traits: Traits, r: Read, time: npt.NDArray[np.float64]) -> Plots:
    kinds = np.asarray(r.decoded.columns.get("kind", np.full(len(time), Kind.NONE)))
    sources = tuple(
        Source(s, rotating(traits, kinds[r.system_of == k]), **r.decoded.steps) for k, s in enumerate(r.systems)
    )
    columns = {
        **r.decoded.columns,
        "time": time,
        "source": r.system_of,
        "file": np.zeros(len(time)),
        "record": np.arange(len(time)),
    }
    return Plots.build(len(time), sources, (name,), columns).take(np.flatnonzero(r.decoded.is_report))


def _tracks(r: Read, table: pa.Table, time: npt.NDArray[np.float64]) -> pa.Table:
    labels = pa.array([str(system) for system in r.systems]).take(pa.array(r.system_of))
    table = table.add_column(0, "system", labels).add_column(1, "time", pa.array(time))
    return table.filter(pa.array(r.decoded.is_report))


def _one_file(plots: Plots, name: str) -> Plots:
    """Categories were joined as if they were files: make them one again."""
    return replace(plots, files=(name,), file=np.zeros(len(plots), np.int32))


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
    service = System(CATEGORIES[number].turns or number, system.sac, system.sic)
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
