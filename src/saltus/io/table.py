"""Target reports as CSV or Parquet tables, one row a report, in any order.

Columns, by name; others are passed over, named and counted:

    time            UTC seconds since 1970-01-01, or ISO 8601 text (without an offset it is UTC); always needed
    range_m         slant range, m, with
    azimuth_deg     degrees from north, clockwise, 0 to 360 (or -180 to 180); from the bow where heading_deg is given
    elevation_deg   degrees above the horizontal, -90 to 90, if measured
    range_rate_mps  m/s, positive going away; used with range and azimuth
    x_m, y_m, z_m   m east and north (and up, if measured) of the sensor's site, whatever the heading
    latitude, longitude  (or lat, lon)  degrees, WGS-84
    kind            polar, plane, geodetic or bearing: which of these the row means, where it gives several
    altitude_m      m, -1500 to 60000
    icao24          Mode S address, six hexadecimal digits as text
    mode3a          Mode 3/A code, four octal digits as text
    callsign        up to 8 characters
    on_ground       (or onground)  true or 1 on the ground, false or 0 airborne
    source          the sensor's name; without it the file's name without suffix

and, where the sensor moves, the columns of `saltus.io.observer` that say where it was.

One position is needed: range and azimuth, x and y, latitude and longitude, or the azimuth alone (a bearing). Without
`kind` the first of these that the row gives is taken. An empty cell (null, NaN) is absent; but where a source tells
ranges, a range that is NaN or text makes no bearing of its row. A row without time or position, or with a number that
cannot be, is kept as a report with its reason; a code or text that cannot be read is lost alone. Rows count from 0,
without the header.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.errors import DataError
from saltus.io.cells import RowProblems, codes, naive, numbers, tell, texts, times, truths
from saltus.io.observer import FRAME, observer_columns
from saltus.io.part import Part, revisit, rotating, scan_period
from saltus.io.settings import ReadingSettings
from saltus.io.sheet import Sheet, read_sheet, read_sheets
from saltus.io.units import check_units, doubts, meaning, tell_impossible, told_unused
from saltus.records import REASONS, Contents, Kind, Plots, Source, System, Traits
from saltus.text import cut, shown

__all__ = ["read_table", "read_table_pieces", "times_of_rows"]

_ALIASES = {"lat": "latitude", "lon": "longitude", "onground": "on_ground"}
_DEGREE = np.pi / 180
# column -> (column of Plots, factor to SI units)
_NUMBERS = {
    "range_m": ("range", 1.0),
    "azimuth_deg": ("azimuth", _DEGREE),
    "elevation_deg": ("elevation", _DEGREE),
    "range_rate_mps": ("range_rate", 1.0),
    "x_m": ("x", 1.0),
    "y_m": ("y", 1.0),
    "z_m": ("z", 1.0),
    "latitude": ("latitude", _DEGREE),
    "longitude": ("longitude", _DEGREE),
    "altitude_m": ("altitude", 1.0),
    **FRAME,
}
_POSITIONS = (
    (Kind.POLAR, ("range_m", "azimuth_deg")),
    (Kind.PLANE, ("x_m", "y_m")),
    (Kind.GEODETIC, ("latitude", "longitude")),
    (Kind.BEARING, ("azimuth_deg",)),
)
_KINDS = {"polar": Kind.POLAR, "plane": Kind.PLANE, "geodetic": Kind.GEODETIC, "bearing": Kind.BEARING}
_CODES = {"icao24": (16, 0xFFFFFF), "mode3a": (8, 0o7777)}  # base, largest
_COLUMNS = ("time", *_NUMBERS, *_CODES, "callsign", "on_ground", "source", "kind")
_CALLSIGN = 8  # characters
_MOST_SOURCES = 1000  # more are no sensors but targets, or anything
_Columns = dict[str, pa.ChunkedArray]


def read_table(path: Path, settings: ReadingSettings | None = None) -> Part:
    """Read a CSV table with a header line, or a Parquet table, whose numbers may be of any type.

    Raises:
        DataError: no table, needed columns are missing, a column's unit cannot be right, or the table is larger than
            the settings allow.
    """
    sheet = read_sheet(path, (*_COLUMNS, *_ALIASES), settings)
    table, unused = _named(sheet)
    _need_columns(path, [*table, *unused])
    if not sheet.n_rows:
        raise DataError(f"{path}: row 0: the table has columns and no row.")
    problems = [*sheet.problems, *told_unused(path.name, unused, _COLUMNS)]
    columns, names = _columns(sheet, table, problems, judged=True)
    return _part(path, table, names, columns, naive(table["time"]), problems)


def read_table_pieces(path: Path) -> Iterator[Part]:
    """Read a table as `read_table` does, a piece at a time: memory does not grow with it.

    Units are judged by the first piece, and which source tells ranges by each.

    Yields:
        Pieces with rows, and last a part without: what was wrong with cells and rows of all.

    Raises:
        DataError: as `read_table`.
    """
    problems, unused = RowProblems(), Counter[str]()
    n_naive = n_rows = 0
    before: str | None = None
    sources: dict[str, Contents] = {}
    for sheet in read_sheets(path, (*_COLUMNS, *_ALIASES)):
        problems += sheet.problems
        if not sheet.n_rows:
            continue
        table, others = _named(sheet)
        unused.update(others)
        if not n_rows:
            _need_columns(path, [*table, *others])
        problems.first_row, n_rows = sheet.first, n_rows + sheet.n_rows
        columns, names = _columns(sheet, table, problems, judged=sheet.first == 0, before=before)
        before = names[int(np.asarray(columns["source"])[-1])]
        n_naive += naive(table["time"])
        part = _part(path, table, names, columns, 0, [])
        sources |= {str(line.system): line for line in part.contents}
        yield part
    if not n_rows:
        raise DataError(f"{path}: row 0: the table has columns and no row.")
    lines = tuple(_silent(line, n_naive) for line in sources.values()) if n_naive else ()
    told = (*told_unused(path.name, unused, _COLUMNS), *problems.texts())
    yield Part(Plots.build(0, (), (path.name,), {}), None, lines, told, in_order=False, dated=True)


def times_of_rows(path: Path) -> Iterator[npt.NDArray[np.float64]]:
    """Times of the rows of a table, s, UTC, a piece at a time; NaN where a row tells none."""
    for sheet in read_sheets(path, ("time",)):
        if "time" in sheet.columns:
            yield times(path, sheet.columns["time"], [])


def _silent(line: Contents, n_naive: int) -> Contents:
    """A line that adds a note and nothing else."""
    nan = float("nan")
    notes = _naive_notes(n_naive)
    empty: dict[str, int] = {}
    return replace(
        line,
        n_records=0,
        n_reports=0,
        time_from=nan,
        time_to=nan,
        update_period=nan,
        fields=empty,
        n_by_type=empty,
        notes=notes,
    )


def _columns(
    sheet: Sheet, table: _Columns, problems: list[str], *, judged: bool, before: str | None = None
) -> tuple[dict[str, npt.ArrayLike], list[str]]:
    """Columns of `Plots`, and the names of the sources; whether units can be right is judged if wanted.

    `before` is the source of the row before the first.
    """
    path = sheet.path
    columns: dict[str, npt.ArrayLike] = {"time": times(path, table["time"], problems)}
    for name, (target, factor) in _NUMBERS.items():
        if name in table:
            columns[target] = numbers(path, name, table[name], problems) * factor
    columns |= _identity(path, table, problems)
    names, source = _sources(path, table, sheet.broken, problems, before)
    columns["kind"] = _kinds(columns, list(table))
    stated = _stated_kinds(path, table, sheet.n_rows, problems)
    if "range_m" in table:
        columns["kind"] = _lost_ranges(path, table, columns, source, stated != Kind.NONE, problems)
    columns["kind"] = np.where(stated == Kind.NONE, columns["kind"], stated)
    if judged:
        check_units(path, _NUMBERS, columns)
    tell_impossible(path, _NUMBERS, columns, problems)
    if judged:
        problems += doubts(path.name, _NUMBERS, columns)
    reason = np.where(sheet.broken, REASONS.index("broken row"), 0)
    record = sheet.first + np.arange(sheet.n_rows)
    return {**observer_columns(path, columns), "record": record, "reason": reason, "source": source}, names


def _named(sheet: Sheet) -> tuple[_Columns, dict[str, int]]:
    """The columns by the names they have here, and those that are not used with the number of their values."""
    table: _Columns = {}
    unused = dict(sheet.unused)
    for name, column in sheet.columns.items():
        own = _ALIASES.get(name, name)
        if own != name and own in sheet.columns:
            unused[name] = len(column) - column.null_count
        else:
            table[own] = column
    return table, unused


def _need_columns(path: Path, names: Sequence[str]) -> None:
    pairs = [pair for _, pair in _POSITIONS]
    if "time" not in names or not any(set(pair) <= set(names) for pair in pairs):
        wanted = "time" if "time" not in names else "a position: " + ", or ".join(" and ".join(p) for p in pairs)
        there = ", ".join(cut(name, 40) for name in names[:40]) + (", ..." if len(names) > 40 else "")
        other = [(name, meaning(name, _COLUMNS)) for name in names if name not in _COLUMNS]
        hints = "".join(f" For {cut(name, 40)} write {hint}." for name, hint in other if hint)
        raise DataError(f"{path}: no column for {wanted}. The columns are: {there}. Names and units are fixed.{hints}")


def _identity(path: Path, table: _Columns, problems: list[str]) -> dict[str, npt.ArrayLike]:
    """Codes, callsigns and whether on the ground."""
    columns: dict[str, npt.ArrayLike] = {}
    for name, (base, largest) in _CODES.items():
        if name in table:
            columns[name] = codes(path, name, table[name], base, largest, problems)
    if "callsign" in table:
        found = texts(path, "callsign", table["callsign"], problems)
        spelt = {value: shown(value.strip()) for value in found.values}
        long = {value for value, text in spelt.items() if len(text) > _CALLSIGN}
        tell(path, "callsign", found.rows(long), f"longer than {_CALLSIGN} characters: cut", problems)
        columns["callsign"] = found.each(spelt, "", f"U{_CALLSIGN}")
    if "on_ground" in table:
        columns["on_ground"] = truths(path, table["on_ground"], problems)
    return columns


def _sources(
    path: Path, table: _Columns, broken: npt.NDArray[np.bool_], problems: list[str], before: str | None = None
) -> tuple[list[str], npt.NDArray[np.int64]]:
    """Names of the sources in order, and which each row is of; a broken row is of that of the row before.

    Args:
        path: the table.
        table: its columns.
        broken: which rows are.
        problems: what is told.
        before: the source of the row before the first, where there is one.

    Raises:
        DataError: they are too many to be sensors.
    """
    if "source" not in table:
        return [path.stem], np.zeros(len(broken), np.int64)
    found = texts(path, "source", table["source"], problems)
    whole = np.flatnonzero(~broken)
    place = np.cumsum(~broken) - 1
    index = found.which[whole[np.maximum(place, 0)]] if len(whole) else np.full(len(broken), -1)
    if before is not None:
        index[place < 0] = len(found.values)
    labels = np.array([*map(shown, found.values), path.stem if before is None else before, path.stem], object)
    here = np.unique(index)
    names = sorted(set(labels[here].tolist()))
    if len(names) > _MOST_SOURCES:
        raise DataError(
            f"{path}: column 'source' names {len(names)} sources, more than {_MOST_SOURCES}: it is for sensors. Give "
            "what tells targets apart as icao24, mode3a or callsign."
        )
    position = {name: k for k, name in enumerate(names)}
    place = np.array([position.get(label, -1) for label in labels], np.int64)
    return names, place[index]


def _kinds(columns: Mapping[str, npt.ArrayLike], names: Sequence[str]) -> npt.NDArray[np.int8]:
    """How each row gives its position: the first pair with both cells, else a pair that lacks one."""
    n = len(np.asarray(columns["time"]))
    kinds = np.full(n, Kind.NONE, np.int8)
    for missing in (0, 1):
        for kind, pair in _POSITIONS:
            if set(pair) <= set(names):
                given = sum(~np.isnan(np.asarray(columns[_NUMBERS[c][0]])) for c in pair)
                kinds[(kinds == Kind.NONE) & (given > 0) & (given >= len(pair) - missing)] = kind
    return kinds


def _lost_ranges(
    path: Path,
    table: _Columns,
    columns: Mapping[str, npt.ArrayLike],
    source: npt.NDArray[np.int64],
    stated: npt.NDArray[np.bool_],
    problems: list[str],
) -> npt.NDArray[np.int8]:
    """Of sources that tell ranges: make bearings whose range is no number radar plots again, and tell the others."""
    kinds = np.array(columns["kind"], np.int8)
    ranging = np.isin(source, source[np.isfinite(np.asarray(columns["range"]))])
    lone = ranging & (kinds == Kind.BEARING) & ~stated
    written = table["range_m"].is_valid().to_numpy()
    kinds[lone & written] = Kind.POLAR
    empty = np.flatnonzero(lone & ~written)
    if len(empty):
        problems.append(
            f"{path.name}: row {empty[0]}: no range_m, where its source tells ranges elsewhere; {len(empty)} such rows "
            "are taken as bearings alone."
        )
    return kinds


def _stated_kinds(path: Path, table: _Columns, n: int, problems: list[str]) -> npt.NDArray[np.int8]:
    """What the column `kind` says; none where it says nothing."""
    if "kind" not in table:
        return np.full(n, Kind.NONE, np.int8)
    found = texts(path, "kind", table["kind"], problems)
    meant = {value: _KINDS.get(value.strip().lower(), Kind.NONE) for value in found.values}
    wrong = {value for value, kind in meant.items() if value.strip() and kind == Kind.NONE}
    tell(path, "kind", found.rows(wrong), f"no kind of report ({', '.join(_KINDS)})", problems)
    return found.each(meant, Kind.NONE, np.int8)


def _part(
    path: Path,
    table: _Columns,
    names: Sequence[str],
    columns: dict[str, npt.ArrayLike],
    n_naive: int,
    problems: list[str],
) -> Part:
    given = {name: column.is_valid().to_numpy() for name, column in table.items()}
    source, kind = np.asarray(columns["source"]), np.asarray(columns["kind"])
    n = len(source)
    own = [np.flatnonzero(source == k) for k in range(len(names))]
    sources = tuple(
        Source(System(None, None, None, name), traits=rotating(Traits(pooled=True), kind[at]))
        for name, at in zip(names, own, strict=True)
    )
    plots = Plots.build(n, sources, (path.name,), columns | {"file": np.zeros(n)})
    notes = _naive_notes(n_naive)
    contents = tuple(
        _contents(path, s.system, plots.take(at), {name: int(v[at].sum()) for name, v in given.items()}, notes)
        for s, at in zip(sources, own, strict=True)
    )
    return Part(plots, None, contents, tuple(problems), in_order=False, dated=True)


def _naive_notes(n_naive: int) -> tuple[str, ...]:
    return (f"{n_naive} times without an offset are taken as UTC",) if n_naive else ()


def _contents(path: Path, system: System, own: Plots, fields: dict[str, int], notes: tuple[str, ...]) -> Contents:
    times = own.time[np.isfinite(own.time)]
    period = revisit(own.time, own.icao24, own.mode3a)
    kinds = {
        Kind.POLAR: "range and azimuth",
        Kind.PLANE: "plane position",
        Kind.GEODETIC: "latitude and longitude",
        Kind.BEARING: "bearing",
    }
    counts = {text: int(np.count_nonzero(own.kind == kind)) for kind, text in kinds.items()}
    return Contents(
        file=path.name,
        system=system,
        edition="",
        n_records=len(own),
        n_reports=len(own),
        time_from=float(times.min()) if len(times) else float("nan"),
        time_to=float(times.max()) if len(times) else float("nan"),
        update_period=scan_period(own.time) if np.isnan(period) else period,
        fields=fields,
        rejected={},
        n_by_type={text: n for text, n in counts.items() if n},
        notes=notes,
    )
