"""Files to one recording: what cannot be a plot is marked, counted by reason, and the rest put in time order."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.io.clock import DAY, OrderFaults, order_faults, standing
from saltus.io.part import Part
from saltus.records import REASONS, Contents, Kind, Plots, Recording, Source, System

__all__ = [
    "LIMITS",
    "completed",
    "credible_times",
    "mark_order",
    "mark_values",
    "merge",
    "next_day",
    "shift",
    "told_next_day",
]

# What a report can say: ranges of ground radars (m), pressure altitudes of aircraft (m), epochs from 1970 to 2100.
LIMITS = {
    "range": (1e-9, 600e3),
    "azimuth": (-2 * np.pi, 2 * np.pi),
    "elevation": (-np.pi / 2, np.pi / 2),
    "x": (-600e3, 600e3),
    "y": (-600e3, 600e3),
    "latitude": (-np.pi / 2, np.pi / 2),
    "longitude": (-np.pi, 2 * np.pi),
    "altitude": (-1500.0, 60000.0),
    "z": (-60e3, 60e3),
    "range_rate": (-10e3, 10e3),
    "observer_latitude": (-np.pi / 2, np.pi / 2),
    "observer_longitude": (-np.pi, 2 * np.pi),
    "observer_height": (-1500.0, 60000.0),
    "time": (-DAY, 4.2e9),
}
_WILD = [
    REASONS.index(text)
    for text in (
        "clock jump",
        "out of order",
        "no time",
        "impossible time of day",
        "out of range",
        "coasted by station",
    )
]
_CODE = 1 << 24  # above all addresses
_JUDGED = 20  # reports by which a clock is judged
_OBSERVER = ("observer_latitude", "observer_longitude", "observer_height")
_POSITION = {
    Kind.POLAR: ("range", "azimuth"),
    Kind.PLANE: ("x", "y"),
    Kind.GEODETIC: ("latitude", "longitude"),
    Kind.BEARING: ("azimuth", "elevation"),
}


def merge(parts: Sequence[Part]) -> Recording:
    """Join what was read of each file.

    Reports that cannot be plots keep their row and get a reason, in this order: what the reader found (coasted,
    simulated, ...), no position, no time, not a number, out of range, duplicate (same source, time, address and
    position to the bit as an earlier usable report), and per source and file clock jump and out of order
    (`saltus.io.clock`).
    """
    parts, problems = _align_days(parts)
    plots = Plots.concat([part.plots for part in parts])
    reason, again = mark_values(plots)
    for k, part in enumerate(parts):
        if part.in_order:
            problems += mark_order(plots, reason, again, k, lambda _, time: order_faults(time))
    plots = replace(plots, reason=reason)
    tables = [part.tracks for part in parts if part.tracks is not None]
    first_file = np.cumsum([0] + [len(part.plots.files) for part in parts])
    return Recording(
        plots=plots.sorted_by_time(),
        tracks=pa.concat_tables(tables).sort_by("time") if tables else None,
        contents=tuple(
            _count(line, plots, int(k)) for k, part in zip(first_file, parts, strict=False) for line in part.contents
        ),
        problems=tuple(p for part in parts for p in part.problems) + tuple(problems),
        files=tuple(part.file for part in parts if part.file is not None),
    )


def mark_values(plots: Plots) -> tuple[npt.NDArray[np.int8], npt.NDArray[np.bool_]]:
    """Reasons of reports with those that their values and repetition give, and which repeat an earlier one."""
    reason = plots.reason.copy()
    _mark_values(plots, reason)
    again = _repeats(plots, reason)
    _mark(reason, again, "duplicate")
    return reason, again


def _mark(reason: npt.NDArray[np.int8], holds: npt.NDArray[np.bool_], text: str) -> None:
    """Give a reason to the reports that have none yet."""
    reason[holds & (reason == 0)] = REASONS.index(text)


def _mark_values(plots: Plots, reason: npt.NDArray[np.int8]) -> None:
    """Mark positions and times that are missing or cannot be."""
    _mark(reason, plots.kind == Kind.NONE, "no position")
    not_number, outside = np.zeros(len(plots), np.bool_), np.zeros(len(plots), np.bool_)
    for kind, names in _POSITION.items():
        for name in names:
            if name != "elevation":  # a bearing may have one
                not_number |= (plots.kind == kind) & np.isnan(getattr(plots, name))
            outside |= (plots.kind == kind) & _outside(plots, name)
    _mark(reason, np.isnan(plots.time), "no time")
    for name in ("time", "altitude", "elevation", "z", "range_rate", *_OBSERVER):
        outside |= _outside(plots, name)
    _mark(reason, not_number, "not a number")
    _mark(reason, outside, "out of range")


def _outside(plots: Plots, name: str) -> npt.NDArray[np.bool_]:
    values, (low, high) = getattr(plots, name), LIMITS[name]
    outside: npt.NDArray[np.bool_] = ~np.isnan(values) & ~((values >= low) & (values <= high))
    return outside


def _repeats(plots: Plots, reason: npt.NDArray[np.int8]) -> npt.NDArray[np.bool_]:
    """Tell the reports that repeat an earlier one of the same reason to the bit."""
    again = np.zeros(len(plots), np.bool_)
    if not len(plots):
        return again
    order = np.argsort(plots.time.view(np.int64), kind="stable")  # equal times side by side
    same = np.diff(plots.time.view(np.int64)[order]) == 0
    rows = np.sort(order[np.append(same, False) | np.append(False, same)])
    del order
    some = plots.take(rows)
    words = [some.source.astype(np.int64), some.kind.astype(np.int64), reason[rows].astype(np.int64)]
    words += [some.icao24.astype(np.int64), some.time.view(np.int64)]
    for names in zip(*_POSITION.values(), strict=True):  # the coordinates of the report's own kind
        kinds = [some.kind == kind for kind in _POSITION]
        words.append(np.select(kinds, [getattr(some, n).view(np.int64) for n in names]))
    order = np.lexsort(words[::-1])  # stable: earlier reports first
    equal = np.ones(max(len(rows) - 1, 0), np.bool_)
    for word in words:
        equal &= np.diff(word[order]) == 0
    again[rows[order[1:][equal]]] = True
    return again


def mark_order(
    plots: Plots,
    reason: npt.NDArray[np.int8],
    again: npt.NDArray[np.bool_],
    file: int,
    judge: Callable[[System, npt.NDArray[np.float64]], OrderFaults],
) -> list[str]:
    """Mark the reports of one file that come too late or whose clock jumped or stands; tell what lasts.

    Repeated reports, used or not (coasted, ...), say nothing about the clock: a recording doubled is as one.

    Args:
        plots: in the order received.
        reason: of each report, 0 = none yet; is written to.
        again: which repeat an earlier one.
        file: whose reports are judged.
        judge: of the times of a source.
    """
    told = []
    skipped = [REASONS.index(text) for text in ("no time", "impossible time of day", "system track")]
    identity = np.where(plots.icao24 >= 0, plots.icao24.astype(np.int64), _CODE + plots.mode3a.astype(np.int64))
    identity[(plots.icao24 < 0) & (plots.mode3a < 0)] = -1
    for k, source in enumerate(plots.sources):
        mine = (plots.file == file) & (plots.source == k) & ~np.isin(reason, skipped) & ~again
        index = np.flatnonzero(mine & np.isfinite(plots.time))
        time = plots.time[index]
        stands = standing(time, identity[index])
        faults = judge(source.system, time[~stands])
        jump, late = np.zeros(len(plots), np.bool_), np.zeros(len(plots), np.bool_)
        jump[index[stands]] = True
        moving = index[~stands]
        jump[moving], late[moving] = faults.jump, faults.late
        _mark(reason, jump, "clock jump")
        _mark(reason, late, "out of order")

        def place(at: np.intp, of: Source = source) -> str:
            return f"{plots.files[file]}: record {plots.record[at]} of {of.system}"

        told += [
            f"{place(moving[step])}: the clock steps back by {size:.3f} s for good. Later reports keep their times; of "
            "the earlier ones those at times that the clock repeats are not used (clock jump). If recordings were "
            "joined out of order, give them apart."
            for step, size in zip(faults.steps, faults.sizes, strict=True)
        ]
        told += [
            f"{place(moving[leap])}: its times go on {pause:.0f} s after all before: reports are missing, or the clock "
            "was set ahead."
            for leap, pause in zip(faults.leaps, faults.pauses, strict=True)
        ]
        told += _told_wrong(place, index, stands, jump | late)
    return told


def _told_wrong(
    place: Callable[[np.intp], str],
    index: npt.NDArray[np.intp],
    stands: npt.NDArray[np.bool_],
    wrong: npt.NDArray[np.bool_],
) -> list[str]:
    """Lines on a clock that stands, and on one that is wrong more often than right."""
    told = []
    if stands.any():
        told.append(
            f"{place(index[stands.argmax()])}: the clock stands still: targets are told again at the time they had. "
            f"{np.count_nonzero(stands)} reports of one time are not used (clock jump)."
        )
    count = int(np.count_nonzero(wrong[index]))
    if 2 * count > len(index) >= _JUDGED and not stands.any():
        told.append(
            f"{place(index[0])}: {count} of {len(index)} times are in no order (clock jump, out of order): the clock "
            "of this source, or the order of this file, cannot be relied upon."
        )
    return told


def _align_days(parts: Sequence[Part]) -> tuple[list[Part], list[str]]:
    """Put a file that begins after midnight on the day after the others of the same night."""
    spans = [
        (min(t), max(t))
        for t in ([v for c in p.contents for v in (c.time_from, c.time_to) if v == v] or [np.nan] for p in parts)
    ]
    later = next_day(spans, [part.in_order and not part.dated for part in parts])
    names = [", ".join(part.plots.files) for part in parts]
    return [shift(part, DAY) if k in later else part for k, part in enumerate(parts)], told_next_day(names, later)


def next_day(spans: Sequence[tuple[float, float]], plain: Sequence[bool]) -> list[int]:
    """Which of several files are of the next day.

    Plain ASTERIX tells the time of day only, and the date given is that of the first record. So when one file
    crosses midnight, another that begins more than 12 hours before it belongs to the next day.

    Args:
        spans: s, UTC, first and last time of each file, NaN = none.
        plain: which of them tell no date.
    """
    some = [k for k, is_plain in enumerate(plain) if is_plain]
    crossing = [spans[k][0] for k in some if spans[k][0] // DAY < spans[k][1] // DAY]
    return [k for k in some if crossing and min(crossing) - spans[k][0] > DAY / 2]


def told_next_day(names: Sequence[str], later: Sequence[int]) -> list[str]:
    """Lines on files that were put on the next day."""
    return [f"{names[k]}: begins after the midnight that another file crosses: put on the next day." for k in later]


def shift(part: Part, seconds: float) -> Part:
    """The same file or piece, so much later."""
    tracks = part.tracks
    if tracks is not None:
        column = tracks.column_names.index("time")
        tracks = tracks.set_column(column, "time", pa.array(tracks["time"].to_numpy() + seconds))
    return part._replace(
        plots=replace(part.plots, time=part.plots.time + seconds),
        tracks=tracks,
        contents=tuple(replace(c, time_from=c.time_from + seconds, time_to=c.time_to + seconds) for c in part.contents),
    )


def _count(line: Contents, plots: Plots, file: int) -> Contents:
    """Complete a line of contents: reports rejected by reason, and the span of those whose time is credible."""
    own = [k for k, s in enumerate(plots.sources) if s.system == line.system]
    mine = (plots.file == file) & np.isin(plots.source, own)
    counts = Counter(plots.reason[mine & (plots.reason > 0)].tolist())
    times = plots.time[mine & credible_times(plots)]
    return completed(line, counts, (float(times.min()), float(times.max())) if len(times) else None)


def completed(line: Contents, counts: Mapping[int, int], span: tuple[float, float] | None) -> Contents:
    """A line of contents with the reports rejected, by reason, and the span of credible times."""
    line = replace(line, rejected={REASONS[code]: n for code, n in sorted(counts.items())})
    if line.n_records == line.n_reports and span is not None:
        return replace(line, time_from=span[0], time_to=span[1])
    return line


def credible_times(plots: Plots) -> npt.NDArray[np.bool_]:
    """Which reports have a time that counts for the span of their source."""
    credible: npt.NDArray[np.bool_] = ~np.isin(plots.reason, _WILD) & np.isfinite(plots.time)
    return credible
