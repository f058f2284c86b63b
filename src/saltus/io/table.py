"""Target reports as CSV or Parquet tables, one row a report, in any order.

Columns, by name; others are passed over and noted:

    time            UTC seconds since 1970-01-01, or ISO 8601 text (without an offset it is UTC); always needed
    range_m         slant range, m, with
    azimuth_deg     degrees from north, clockwise, 0 to 360 (or -180 to 180); from the bow where heading_deg is given
    elevation_deg   degrees above the horizontal, -90 to 90, if measured
    range_rate_mps  m/s, positive going away; kept with the report, not used by the tracker
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
cannot be, is kept as a report with its reason; a code that cannot be read is lost alone. Rows count from 0, without
the header.
"""

import csv
from collections.abc import Sequence
from io import BytesIO, StringIO
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from saltus.errors import DataError
from saltus.io.cells import codes, numbers, tell, times, truths
from saltus.io.merge import LIMITS
from saltus.io.observer import FRAME, observer_columns
from saltus.io.part import Part, revisit, rotating, scan_period
from saltus.records import REASONS, Contents, Kind, Plots, Source, System, Traits

__all__ = ["csv_as_text", "read_csv", "read_parquet"]

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
_LIMIT_OF = {"heading": "azimuth", "origin_latitude": "latitude", "origin_longitude": "longitude"} | {
    "observer_x": "x",
    "observer_y": "y",
    "observer_z": "z",
    "origin_height": "observer_height",
}
_HALF = 0.5  # a column with more impossible values than this has another unit


def read_csv(path: Path) -> Part:
    """Read a CSV table with a header line.

    Raises:
        DataError: no CSV, needed columns are missing, or a column's unit cannot be right.
    """
    problems: list[str] = []
    _check_separator(path)
    try:
        table = csv_as_text(path)
        broken = np.zeros(table.num_rows, np.bool_)
    except pa.ArrowInvalid as error:
        blanked, broken = _blank_broken(path, problems, error)
        table = csv_as_text(blanked)
    except (pa.ArrowException, OSError) as error:
        raise DataError(f"{path}: no readable CSV table: {str(error).splitlines()[0]}") from error
    return _read(path, table, broken, problems)


def _check_separator(path: Path) -> None:
    with path.open("rb") as file:
        header = file.readline()
    for mark, name in ((b";", "semicolons"), (b"\t", "tabs")):
        if mark in header and b"," not in header:
            raise DataError(f"{path}: {name} separate the columns. Separate them by commas, and decimals by points.")


def csv_as_text(source: Path | BytesIO) -> pa.Table:
    """Read every column as text, empty cells null: what a cell may hold is then judged cell by cell."""
    from pyarrow import csv as arrow

    content = source.read_bytes() if isinstance(source, Path) else source.getvalue()
    with arrow.open_csv(BytesIO(content)) as reader:
        names = reader.schema.names
    empty = arrow.ConvertOptions().null_values
    nan = [text for text in empty if text.lower().endswith("nan")]  # a range that is no number is not an absent one
    as_text = arrow.ConvertOptions(
        column_types={name: pa.string() for name in names},
        null_values=[text for text in empty if text not in nan],
        strings_can_be_null=True,
    )
    table = arrow.read_csv(BytesIO(content), convert_options=as_text)
    for k, name in enumerate(table.column_names):
        if name != "range_m":
            absent = pc.is_in(table[k], value_set=pa.array(nan))
            table = table.set_column(k, name, pc.if_else(absent, pa.scalar(None, pa.string()), table[k]))
    return table


def _blank_broken(path: Path, problems: list[str], error: pa.ArrowInvalid) -> tuple[BytesIO, npt.NDArray[np.bool_]]:
    """Empty the rows whose number of cells is not the header's, but for the source of the row before; tell them.

    Returns:
        The table, and which rows are broken: less than half of them.
    """
    try:
        lines = list(csv.reader(StringIO(path.read_text(encoding="utf-8"))))
    except UnicodeDecodeError as wrong:
        raise DataError(f"{path}: byte {wrong.start}: not UTF-8 text; save the table as UTF-8 CSV.") from wrong
    header, body = (lines[0], [cells for cells in lines[1:] if cells]) if lines else ([], [])
    broken = np.array([len(cells) != len(header) for cells in body], np.bool_)
    if 2 * np.count_nonzero(broken) >= len(body):
        raise DataError(f"{path}: no readable CSV table: {str(error).splitlines()[0]}") from error
    told = [f"row {k}: {len(body[k])} cells where the header has {len(header)}" for k in np.flatnonzero(broken)]
    more = f", and {len(told) - 1} more such rows" if len(told) > 1 else ""
    problems.append(f"{path.name}: {told[0]}{more}: not used (broken row).")
    column = header.index("source") if "source" in header else None
    last = body[int(np.argmin(broken))]
    for k, cells in enumerate(body):
        if broken[k]:
            body[k] = [last[c] if c == column else "" for c in range(len(header))]
        else:
            last = cells
    text = StringIO()
    csv.writer(text).writerows([header, *body])
    return BytesIO(text.getvalue().encode()), broken


def read_parquet(path: Path) -> Part:
    """Read a Parquet table; numbers may be of any type and are taken as float64.

    Raises:
        DataError: no Parquet, needed columns are missing, or a column's unit cannot be right.
    """
    from pyarrow import parquet

    try:
        with path.open("rb") as file:  # a name may be no UTF-8, which Arrow asks for
            table = parquet.read_table(file)
    except (pa.ArrowException, OSError) as error:
        raise DataError(f"{path}: no readable Parquet table: {str(error).splitlines()[0]}") from error
    return _read(path, table, np.zeros(table.num_rows, np.bool_), [])


def _read(path: Path, table: pa.Table, broken: npt.NDArray[np.bool_], problems: list[str]) -> Part:
    table = table.rename_columns(
        [_ALIASES.get(c, c) if _ALIASES.get(c) not in table.column_names else c for c in table.column_names]
    )
    names = table.column_names
    twice = sorted({c for c in names if names.count(c) > 1 and c in _COLUMNS})
    if twice:
        raise DataError(f"{path}: column {twice[0]!r} occurs {names.count(twice[0])} times; keep one.")
    _need_columns(path, names)
    if not table.num_rows:
        raise DataError(f"{path}: row 0: the table has columns and no row.")
    columns: dict[str, npt.ArrayLike] = {"time": times(path, table["time"], problems)}
    for name, (target, factor) in _NUMBERS.items():
        if name in names:
            columns[target] = numbers(path, name, table[name], problems) * factor
    for name, (base, largest) in _CODES.items():
        if name in names:
            columns[name] = codes(path, name, table[name], base, largest, problems)
    if "callsign" in names:
        columns["callsign"] = [str(v or "").strip() for v in table["callsign"].to_pylist()]
    if "on_ground" in names:
        columns["on_ground"] = truths(path, table["on_ground"], problems)
    columns["kind"] = _kinds(columns, names)
    if "range_m" in names:
        columns["kind"] = _lost_ranges(path, table, columns, problems)
    if "kind" in names:
        columns["kind"] = _stated_kinds(path, table["kind"], columns["kind"], problems)
    _check_units(path, columns)
    _tell_impossible(path, columns, problems)
    reason = np.where(broken, REASONS.index("broken row"), 0)
    columns = {**observer_columns(path, columns), "record": np.arange(table.num_rows), "reason": reason}
    return _part(path, table, columns, problems)


def _need_columns(path: Path, names: Sequence[str]) -> None:
    pairs = [pair for _, pair in _POSITIONS]
    if "time" not in names or not any(set(pair) <= set(names) for pair in pairs):
        wanted = "time" if "time" not in names else "a position: " + ", or ".join(" and ".join(p) for p in pairs)
        shown = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
        raise DataError(f"{path}: no column for {wanted}. The columns are: {shown}. Names and units are fixed.")


def _kinds(columns: dict[str, npt.ArrayLike], names: Sequence[str]) -> npt.NDArray[np.int8]:
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
    path: Path, table: pa.Table, columns: dict[str, npt.ArrayLike], problems: list[str]
) -> npt.NDArray[np.int8]:
    """Of sources that tell ranges: make bearings whose range is no number radar plots again, and tell the others."""
    kinds = np.array(columns["kind"], np.int8)
    labels = np.array(_labels(path, table))
    ranging = np.isin(labels, labels[np.isfinite(np.asarray(columns["range"]))])
    stated = [bool(v) for v in table["kind"].to_pylist()] if "kind" in table.column_names else np.zeros(len(kinds))
    lone = ranging & (kinds == Kind.BEARING) & ~np.asarray(stated, np.bool_)
    written = np.array([v is not None and v != "" for v in table["range_m"].to_pylist()])
    kinds[lone & written] = Kind.POLAR
    empty = np.flatnonzero(lone & ~written)
    if len(empty):
        problems.append(
            f"{path.name}: row {empty[0]}: no range_m, where its source tells ranges elsewhere; {len(empty)} such rows "
            "are taken as bearings alone."
        )
    return kinds


def _stated_kinds(
    path: Path, column: pa.ChunkedArray, found: npt.ArrayLike, problems: list[str]
) -> npt.NDArray[np.int8]:
    """What the column `kind` says, else what the row gives."""
    cells = [str(v or "").strip().lower() for v in column.to_pylist()]
    bad = [(k, v) for k, v in enumerate(cells) if v and v not in _KINDS]
    tell(path, "kind", bad, f"no kind of report ({', '.join(_KINDS)})", problems)
    stated = np.array([_KINDS.get(v, Kind.NONE) for v in cells], np.int8)
    return np.where(stated == Kind.NONE, np.asarray(found), stated)


def _check_units(path: Path, columns: dict[str, npt.ArrayLike]) -> None:
    """Refuse a column most of whose values cannot be: its unit is another."""
    for name, values, outside in _impossible(columns):
        given = ~np.isnan(values)
        if np.count_nonzero(outside) > _HALF * np.count_nonzero(given):
            k = int(outside.argmax())
            hint = "seconds since 1970, not milliseconds?" if name == "time" else f"is it in {_unit(name)}?"
            raise DataError(
                f"{path}: row {k}, column {name!r}: {values[k]:g} cannot be, like {np.count_nonzero(outside)} of "
                f"{np.count_nonzero(given)} values: {hint}"
            )


def _tell_impossible(path: Path, columns: dict[str, npt.ArrayLike], problems: list[str]) -> None:
    for name, values, outside in _impossible(columns):
        bad = [(int(k), f"{values[k]:g}") for k in np.flatnonzero(outside)]
        tell(path, name, bad, "out of range", problems)


def _impossible(
    columns: dict[str, npt.ArrayLike],
) -> list[tuple[str, npt.NDArray[np.float64], npt.NDArray[np.bool_]]]:
    """Each numeric column in the units of the table, and which of its values cannot be."""
    found = []
    for name, (target, factor) in {"time": ("time", 1.0), **_NUMBERS}.items():
        if target in columns:
            values = np.asarray(columns[target], np.float64)
            low, high = LIMITS[_LIMIT_OF.get(target, target)]
            outside = ~np.isnan(values) & ~((values >= low * (1 + 1e-12)) & (values <= high * (1 + 1e-12)))
            found.append((name, values / factor, outside))
    return found


def _unit(name: str) -> str:
    return "m/s" if name.endswith("_mps") else "m" if name.endswith("_m") else "degrees"


def _labels(path: Path, table: pa.Table) -> list[str]:
    """The name of each row's source."""
    named = table["source"].to_pylist() if "source" in table.column_names else [None] * table.num_rows
    return [str(v) if v not in (None, "") else path.stem for v in named]


def _part(path: Path, table: pa.Table, columns: dict[str, npt.ArrayLike], problems: list[str]) -> Part:
    n = table.num_rows
    labels = _labels(path, table)
    systems = [System(None, None, None, label) for label in sorted(set(labels))]
    position = {s.name: k for k, s in enumerate(systems)}
    columns |= {"source": [position[label] for label in labels], "file": np.zeros(n)}
    kind, source = np.asarray(columns["kind"]), np.asarray(columns["source"])
    sources = tuple(Source(s, rotating(Traits(pooled=True), kind[source == k])) for k, s in enumerate(systems))
    plots = Plots.build(n, sources, (path.name,), columns)
    unused = [c for c in table.column_names if c not in _COLUMNS]
    notes = (f"columns not used: {', '.join(unused)}",) if unused else ()
    of_system = [np.flatnonzero(plots.source == k) for k in range(len(systems))]
    contents = tuple(
        _contents(path, s, plots.take(at), table.take(at), notes) for s, at in zip(systems, of_system, strict=True)
    )
    return Part(plots, None, contents, tuple(problems), in_order=False, dated=True)


def _contents(path: Path, system: System, own: Plots, table: pa.Table, notes: tuple[str, ...]) -> Contents:
    given = {c: table[c] for c in table.column_names if c in _COLUMNS}
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
        fields={c: len(v) - v.null_count for c, v in given.items()},
        rejected={},
        n_by_type={text: n for text, n in counts.items() if n},
        notes=notes,
    )
