"""Target reports as arrays: what every reader returns and every tracker takes.

SI units and radians throughout; NaN marks an absent number, -1 an absent code. Angles of azimuth count from
north, clockwise. Readers convert once, in float64, whatever the precision of the file.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

__all__ = ["REASONS", "Contents", "Datum", "FileContents", "Kind", "Plots", "Recording", "Source", "System", "Traits"]

# Why a report is not used. Index 0 means usable; readers set the codes below, trackers never change them.
REASONS = (
    "",
    "status message",  # not a target report (never listed in assignments)
    "coasted by station",  # I048/020 TYP = 0: an extrapolated position, not a detection
    "simulated",  # SIM bit
    "test target",  # TST bit
    "field monitor",  # RAB bit: fixed transponder
    "no position",
    "no time",
    "out of range",  # a value that cannot be (units?)
    "not a number",
    "duplicate",  # same source, time and position as an earlier report
    "out of order",  # older than the newest report of its source by more than the sorting window
    "clock jump",  # time stands alone among its neighbours in the file
    "outside time window",  # --from / --to
    "site unknown",  # the source needs a site position and none is configured
    "system track",  # CAT062: another system's track, never used as a plot
    "broken row",  # of a table: more or fewer cells than the header
    "impossible time of day",  # past the end of the day
)


class Kind:
    """How a report gives its position (values of `Plots.kind`)."""

    NONE = 0
    POLAR = 1  # slant range, azimuth (and elevation when the radar measures it), from the source's site
    PLANE = 2  # east, north (and up) from the source's site
    GEODETIC = 3  # latitude, longitude
    BEARING = 4  # azimuth (and elevation) alone, from the source's site


class Datum:
    """What a geometric height counts from (values of `Plots.datum`)."""

    MEAN_SEA_LEVEL = 1
    ELLIPSOID = 2  # WGS-84


@dataclass(frozen=True, slots=True)
class System:
    """A surveillance system: (category, SAC, SIC) for ASTERIX, a name for tables."""

    category: int | None
    sac: int | None
    sic: int | None
    name: str = ""
    channel: str = ""  # the line or connection that brings it, where another sensor sends the same SAC and SIC

    def __str__(self) -> str:
        """Like `CAT048:20/129`, or the name for tables."""
        if self.category is None:
            return self.name
        if self.sac is None:
            return f"CAT{self.category:03d}"
        return f"CAT{self.category:03d}:{self.sac}/{self.sic}" + (f" on {self.channel}" if self.channel else "")


@dataclass(frozen=True, slots=True)
class Traits:
    """What a source is, told by its reader; nobody else asks in which format its reports came.

    Attributes:
        rotating: a beam goes round, and looks at each target once in an update period.
        self_reporting: targets tell where they are, each by its own means and at times of its own.
        surface: sees what stands on the ground.
        pooled: makes common local tracks with the other sources of this trait, unless the configuration says otherwise.
        rest_period: s between two reports of a target at rest; 0 = no longer than of one that moves.
        sigma_time: standard deviation of time stamps, s, where nothing better is known.
        latency: s from the time of a report until it is received.
    """

    rotating: bool = False
    self_reporting: bool = False
    surface: bool = False
    pooled: bool = False
    rest_period: float = 0.0
    sigma_time: float = 0.0
    latency: float = 0.0


@dataclass(frozen=True, slots=True)
class Source:
    """One system as it occurs in the inputs: what it is, and the quantisation of its reports.

    Quantisation steps (one least significant bit): `range_lsb`, `xy_lsb`, `altitude_lsb` in m, `azimuth_lsb` and
    `elevation_lsb` in rad, `range_rate_lsb` in m/s, `time_lsb` in s; 0 where the format does not quantise.
    """

    system: System
    traits: Traits = Traits()
    range_lsb: float = 0.0
    azimuth_lsb: float = 0.0
    elevation_lsb: float = 0.0
    range_rate_lsb: float = 0.0
    xy_lsb: float = 0.0
    altitude_lsb: float = 0.0
    time_lsb: float = 0.0


def _column(dtype: npt.DTypeLike, absent: object) -> Any:
    return field(metadata={"dtype": np.dtype(dtype), "absent": absent})


@dataclass(frozen=True, slots=True, eq=False)
class Plots:
    """Target reports of one or several sources, one array element each, all columns of one length N.

    A column of which all reports have one value, the absent one above all, is held once and may not be written to.
    """

    sources: tuple[Source, ...]
    files: tuple[str, ...]
    time: npt.NDArray[np.float64] = _column(np.float64, np.nan)  # s, UTC
    source: npt.NDArray[np.int32] = _column(np.int32, -1)  # index into sources
    file: npt.NDArray[np.int32] = _column(np.int32, -1)  # index into files
    record: npt.NDArray[np.int64] = _column(np.int64, -1)  # index among that file's records of that category
    kind: npt.NDArray[np.int8] = _column(np.int8, Kind.NONE)
    range: npt.NDArray[np.float64] = _column(np.float64, np.nan)  # slant range, m
    azimuth: npt.NDArray[np.float64] = _column(np.float64, np.nan)  # rad from north, clockwise
    elevation: npt.NDArray[np.float64] = _column(np.float64, np.nan)  # rad above the site's horizontal plane
    x: npt.NDArray[np.float64] = _column(np.float64, np.nan)  # m east of the site
    y: npt.NDArray[np.float64] = _column(np.float64, np.nan)  # m north of the site
    z: npt.NDArray[np.float64] = _column(np.float64, np.nan)  # m above the site's horizontal plane
    range_rate: npt.NDArray[np.float64] = _column(np.float64, np.nan)  # m/s, positive going away
    latitude: npt.NDArray[np.float64] = _column(np.float64, np.nan)  # rad, WGS-84
    longitude: npt.NDArray[np.float64] = _column(np.float64, np.nan)  # rad
    altitude: npt.NDArray[np.float64] = _column(np.float64, np.nan)  # m; pressure altitude if from Mode C
    height: npt.NDArray[np.float64] = _column(np.float64, np.nan)  # m, geometric, above `datum`
    datum: npt.NDArray[np.int8] = _column(np.int8, -1)  # of the height: a `Datum`
    sigma: npt.NDArray[np.float64] = _column(np.float64, np.nan)  # m, of each horizontal axis, as the report says
    containment: npt.NDArray[np.float64] = _column(
        np.float64, np.nan
    )  # m, radius whose integrity the report vouches for
    # The site of this report, of a source that moves; NaN = the source's own site.
    observer_latitude: npt.NDArray[np.float64] = _column(np.float64, np.nan)  # rad
    observer_longitude: npt.NDArray[np.float64] = _column(np.float64, np.nan)  # rad
    observer_height: npt.NDArray[np.float64] = _column(np.float64, np.nan)  # m above the ellipsoid
    icao24: npt.NDArray[np.int32] = _column(np.int32, -1)
    mode3a: npt.NDArray[np.int16] = _column(np.int16, -1)  # the 12 bits, shown in octal
    callsign: npt.NDArray[Any] = _column("U8", "")  # text of up to 8 characters
    on_ground: npt.NDArray[np.int8] = _column(np.int8, -1)  # 1 ground, 0 airborne, -1 not said
    local_id: npt.NDArray[np.int32] = _column(np.int32, -1)  # the source's own track number
    reason: npt.NDArray[np.int8] = _column(np.int8, 0)  # index into REASONS; 0 = usable

    @classmethod
    def build(
        cls, n: int, sources: tuple[Source, ...], files: tuple[str, ...], columns: Mapping[str, npt.ArrayLike]
    ) -> "Plots":
        """Make `n` reports from the columns given; the others hold their absent value.

        Columns are converted to the class's types (so float32 input becomes float64 here, before any geometry).
        """
        unknown = set(columns) - set(cls.column_names())
        if unknown:
            raise ValueError(f"no such column: {', '.join(sorted(unknown))}")
        arrays = {}
        for f in fields(cls):
            if f.name in ("sources", "files"):
                continue
            dtype, absent = f.metadata["dtype"], f.metadata["absent"]
            given = columns.get(f.name)
            if given is not None and np.shape(given) != (n,):
                raise ValueError(f"column {f.name!r} has shape {np.shape(given)}, expected ({n},)")
            arrays[f.name] = _once(np.asarray([absent] * min(n, 1) if given is None else given).astype(dtype), n)
        return cls(sources, files, **arrays)

    def __len__(self) -> int:
        """Number of reports."""
        return len(self.time)

    def take(self, index: npt.NDArray[np.generic] | slice) -> "Plots":
        """Return the reports selected by an index array, a mask or a slice."""
        n = len(self.time[index])
        taken: dict[str, Any] = {name: _taken(getattr(self, name), index, n) for name in self.column_names()}
        return replace(self, **taken)

    @classmethod
    def column_names(cls) -> list[str]:
        """Names of the per-report columns."""
        return [f.name for f in fields(cls) if f.name not in ("sources", "files")]

    @classmethod
    def concat(cls, parts: list["Plots"], *, same_files: bool = False) -> "Plots":
        """Join reports; equal systems become one source.

        Args:
            parts: reports of files of their own, or all of the first one's.
            same_files: they are of the same files.
        """
        sources: list[Source] = []
        files: list[str] = []
        columns: dict[str, list[npt.NDArray[np.generic]]] = {name: [] for name in cls.column_names()}
        for part in parts:
            source_idx = np.array([_index_of(sources, s) for s in part.sources], np.int32)
            for name in columns:
                columns[name].append(getattr(part, name))
            columns["source"][-1] = _once(source_idx[part.source] if len(part) else part.source, len(part))
            if not same_files:
                columns["file"][-1] = _once(part.file + np.int32(len(files)), len(part))
                files.extend(part.files)
        n = sum(len(p) for p in parts)
        if not parts:
            return cls.build(0, (), (), {})
        return cls(
            tuple(sources),
            parts[0].files if same_files else tuple(files),
            **{name: _joined(columns.pop(name), n) for name in cls.column_names()},
        )

    def sorted_by_time(self) -> "Plots":
        """Return the reports in time order (stable)."""
        if len(self) < 2 or np.all(self.time[1:] >= self.time[:-1]):
            return self
        return self.take(np.argsort(self.time, kind="stable"))


def _once(values: npt.NDArray[Any], n: int) -> npt.NDArray[Any]:
    """One value for all of `n` reports where they have no other; NaN is a value."""
    if not n or values.strides == (0,):
        return values
    first = values[0]
    other = values == values if first != first else values != first
    return values if other.any() else np.broadcast_to(values[:1].copy(), (n,))


def _taken(values: npt.NDArray[Any], index: npt.NDArray[np.generic] | slice, n: int) -> npt.NDArray[Any]:
    return np.broadcast_to(values[:1], (n,)) if n and values.strides == (0,) else values[index]


def _joined(parts: list[npt.NDArray[Any]], n: int) -> npt.NDArray[Any]:
    """Columns of several recordings as one."""
    some = [part for part in parts if len(part)]
    ends = np.array([part[0] for part in some]) if some else np.zeros(0)
    if some and len(np.unique(ends)) == 1 and all(len(part) == 1 or part.strides == (0,) for part in some):
        return np.broadcast_to(some[0][:1], (n,))
    return some[0] if len(some) == 1 else np.concatenate(parts)


def _index_of(sources: list[Source], source: Source) -> int:
    for i, known in enumerate(sources):
        if known.system == source.system:
            turns = known.traits.rotating or source.traits.rotating  # told by the reports that were seen
            sources[i] = replace(known, traits=replace(known.traits, rotating=turns))
            return i
    sources.append(source)
    return len(sources) - 1


@dataclass(frozen=True, slots=True)
class Contents:
    """What one file holds of one system: the lines of `saltus info`."""

    file: str
    system: System
    edition: str  # "" for tables
    n_records: int
    n_reports: int  # target reports
    time_from: float
    time_to: float
    update_period: float  # s, NaN when it cannot be told
    fields: dict[str, int]  # item -> number of records that carry it
    rejected: dict[str, int]  # reason -> number of target reports
    n_by_type: dict[str, int]  # message or detection type -> number
    notes: tuple[str, ...] = ()
    words: str = ""  # what such a system is
    titles: Mapping[str, str] = field(default_factory=dict)  # item -> what it holds
    site: tuple[float, float, float] | None = None  # as it tells itself: latitude, longitude, rad, height, m


@dataclass(frozen=True, slots=True)
class FileContents:
    """What one file is, apart from its systems."""

    file: str
    size: int  # bytes
    n_read: int  # of these, from the beginning
    framing: tuple[str, ...] = ()  # in words, what lies around its blocks
    passed: Mapping[str, int] = field(default_factory=dict)  # packets and frames passed over, by protocol
    channels: tuple[str, ...] = ()  # lines and connections that carried it
    order: tuple[str, ...] = ()  # in words, which of its blocks are out of order of time, and by how much


@dataclass(frozen=True, slots=True)
class Recording:
    """Everything read from the inputs: reports in time order, other systems' tracks, a list of contents."""

    plots: Plots
    tracks: pa.Table | None  # CAT062: system, time, track_number, latitude, longitude (deg), vx, vy, ...
    contents: tuple[Contents, ...]
    problems: tuple[str, ...]  # what could not be read, with file and byte or row
    files: tuple[FileContents, ...] = ()
