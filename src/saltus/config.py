"""The configuration: what recordings do not tell, and what a user may set, as TOML.

date = 2023-05-02                 # of the first record: ASTERIX carries only the time of day
framing = "ioss"                  # optional: the container of the recordings; else told by their structure

[[sensor]]
sac = 20
sic = 129
latitude = 41.30069956            # degrees, WGS-84
longitude = 2.10205819
height = 27.3                     # m above mean sea level; absent = unknown
category = 48                     # optional: sources of this category only
name = "BCN"                      # optional, each its own; alone, without sac and sic, it names the source of a table
sigma_range = 30.0                # optional noise: m,
sigma_azimuth = 0.08              # degrees,
sigma_elevation = 0.3             # degrees,
sigma_range_rate = 2.0            # m/s
sigma_xy = 10.0                   # m (plane and geodetic positions),
sigma_altitude = 8.0              # m
sigma_time = 0.06                 # s (time stamps of positions)
period = 4.0                      # optional: s between two reports of one target
sigma_lasting = 0.008             # errors that last: degrees of azimuth, m of sources of positions,
correlation_time = 13.0           # how long, s,
lasting_scale_distance = 13e3     # and m from the site at which they are 1.4 times as large
system = "platform"               # optional: sources of one system make common local tracks

[editions]
21 = "0.23"                       # category = edition; others are guessed

[learnt]                          # written by saltus setup: what was learnt from reports
[reading]                         # fields of saltus.io.ReadingSettings
[intake]                          # fields of saltus.tracks.setup_settings.IntakeSettings
[setup]                           # fields of saltus.tracks.setup_settings.SetupSettings
[periods]                         # fields of saltus.tracks.setup_settings.PeriodSettings
[lasting]                         # fields of saltus.tracks.setup_settings.LastingSettings
[tracker]                         # fields of saltus.tracks.settings.TrackerSettings
[filter]                          # fields of saltus.tracks.settings.FilterSettings
[systems]                         # fields of saltus.tracks.settings.SystemsSettings
[registration]                    # fields of saltus.tracks.settings.RegistrationSettings
"""

import dataclasses
import datetime
import difflib
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TypeVar, cast, get_type_hints

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from saltus import io
from saltus.asterix.layout import editions as known_editions
from saltus.errors import ModelError
from saltus.framing import NAMES
from saltus.io.settings import ReadingSettings
from saltus.io.told import Progress
from saltus.records import Recording, System
from saltus.text import brief, cut, shown
from saltus.toml import load_toml
from saltus.tracks.settings import FilterSettings, RegistrationSettings, SystemsSettings, TrackerSettings
from saltus.tracks.setup_settings import IntakeSettings, LastingSettings, PeriodSettings, SetupSettings

if TYPE_CHECKING:
    from saltus.io.in_order import InOrder

__all__ = ["Config", "SensorConfig", "load_config", "parse_date"]

_HINTS = {
    "sac": "a whole number from 0 to 255",
    "sic": "a whole number from 0 to 255",
    "category": "an ASTERIX category, 1 to 255",
    "channel": 'text, as channel = "board 1 line 2"; saltus info shows the channels',
    "latitude": "degrees north, -90 to 90",
    "longitude": "degrees east, -180 to 180",
    "height": "m above mean sea level, -450 to 9000 (1 ft = 0.3048 m); leave it out when unknown",
    "sigma_range": "one standard deviation in m, above 0 and up to 10000",
    "sigma_azimuth": "one standard deviation in degrees, above 0 and up to 10",
    "sigma_elevation": "one standard deviation in degrees, above 0 and up to 10",
    "sigma_range_rate": "one standard deviation in m/s, above 0 and up to 1000",
    "sigma_xy": "one standard deviation in m, above 0 and up to 10000",
    "sigma_altitude": "one standard deviation in m, above 0 and up to 10000",
    "sigma_time": "one standard deviation in s, 0 to 10",
    "sigma_lasting": "one standard deviation, m of positions and degrees of azimuths, above 0 and up to 10000",
    "correlation_time": "s, above 0 and up to 3600",
    "lasting_scale_distance": "m, above 0 and up to 1e7",
    "name": 'text, as name = "BCN"',
    "system": 'text, as system = "platform"',
    "period": "the time between two reports of one target in s, above 0 and up to 3600",
    "date": "a date, as date = 2023-05-02",
    "editions": 'category = "edition" in quotes, as 21 = "0.23"',
}

_YEARS = 1970, 2100  # of a recording: times count from the first, reports after the last are out of range
_TABLES: dict[str, type[Any]] = {
    "reading": ReadingSettings,
    "intake": IntakeSettings,
    "setup": SetupSettings,
    "periods": PeriodSettings,
    "lasting": LastingSettings,
    "tracker": TrackerSettings,
    "filter": FilterSettings,
    "systems": SystemsSettings,
    "registration": RegistrationSettings,
}
T = TypeVar("T")
_Read = TypeVar("_Read", Recording, "InOrder")
_Octet = Annotated[int, Field(ge=0, le=255)]
_Sigma = Annotated[float, Field(gt=0.0, le=1e4)]


_Name = Annotated[str, AfterValidator(shown)]  # as a source's is when it is read


class SensorConfig(BaseModel):
    """A sensor's site and noise; angles in degrees, lengths in m."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    latitude: Annotated[float, Field(ge=-90.0, le=90.0)] | None = None
    longitude: Annotated[float, Field(ge=-180.0, le=180.0)] | None = None
    sac: _Octet | None = None
    sic: _Octet | None = None
    height: Annotated[float, Field(ge=-450.0, le=9000.0)] | None = None
    category: Annotated[int, Field(ge=1, le=255)] | None = None
    channel: _Name = ""
    name: _Name = ""
    sigma_range: _Sigma | None = None
    sigma_azimuth: Annotated[float, Field(gt=0.0, le=10.0)] | None = None
    sigma_elevation: Annotated[float, Field(gt=0.0, le=10.0)] | None = None
    sigma_range_rate: Annotated[float, Field(gt=0.0, le=1e3)] | None = None
    sigma_xy: _Sigma | None = None
    sigma_altitude: _Sigma | None = None
    sigma_time: Annotated[float, Field(ge=0.0, le=10.0)] | None = None
    period: Annotated[float, Field(gt=0.0, le=3600.0)] | None = None
    sigma_lasting: _Sigma | None = None
    correlation_time: Annotated[float, Field(gt=0.0, le=3600.0)] | None = None
    lasting_scale_distance: Annotated[float, Field(gt=0.0, le=1e7)] | None = None
    system: _Name = ""

    @model_validator(mode="after")
    def _identified(self) -> "SensorConfig":
        if (self.sac is None) != (self.sic is None):
            raise ValueError("sac and sic go together: give both")
        if self.sac is None and not self.name:
            raise ValueError("give sac and sic, or for tables the name of the source")
        if self.channel and self.sac is None:
            raise ValueError("a channel tells sensors of one SAC and SIC apart: give sac and sic with it")
        if (self.latitude is None) != (self.longitude is None):
            raise ValueError("latitude and longitude go together: give both, or neither to configure noise alone")
        return self

    def matches(self, system: System) -> bool:
        """Whether this is the sensor of a system: by SAC and SIC (category, channel, if given), tables by name."""
        if system.category is None:
            return self.name == system.name
        if self.channel not in ("", system.channel):
            return False
        return (self.sac, self.sic) == (system.sac, system.sic) and self.category in (None, system.category)


class Learnt(NamedTuple):
    """What a file holds of an earlier run's setup; `saltus.engine` knows what it means."""

    path: str
    table: dict[str, Any]


class Config(BaseModel):
    """Everything a configuration file says, checked."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    date: datetime.date | None = None
    framing: str | None = None
    sensor: tuple[SensorConfig, ...] = ()
    editions: dict[int, str] = Field(default_factory=dict)
    reading: ReadingSettings = Field(default_factory=ReadingSettings)
    intake: IntakeSettings = Field(default_factory=IntakeSettings)
    setup: SetupSettings = Field(default_factory=SetupSettings)
    periods: PeriodSettings = Field(default_factory=PeriodSettings)
    lasting: LastingSettings = Field(default_factory=LastingSettings)
    tracker: TrackerSettings = Field(default_factory=TrackerSettings)
    filter: FilterSettings = Field(default_factory=FilterSettings)
    systems: SystemsSettings = Field(default_factory=SystemsSettings)
    registration: RegistrationSettings = Field(default_factory=RegistrationSettings)
    learnt: Learnt | None = None

    def read(self, inputs: Sequence[Path | str], progress: Progress | None = None) -> Recording:
        """Read recordings as the configuration says (`saltus.io.read`)."""
        return self._read(io.read, inputs, progress)

    def read_in_order(self, inputs: Sequence[Path | str], progress: Progress | None = None) -> "InOrder":
        """Read recordings a chunk at a time as the configuration says (`saltus.io.read_in_order`)."""
        return self._read(io.read_in_order, inputs, progress)

    def _read(self, how: Callable[..., _Read], inputs: Sequence[Path | str], progress: Progress | None) -> _Read:
        return how(
            inputs,
            date=self.date,
            editions=self.editions,
            framing=self.framing,
            progress=progress,
            settings=self.reading,
            apart=self.apart,
        )

    def site_for(self, system: System) -> SensorConfig | None:
        """The sensor of a system; one that names channel or category goes before one that does not."""
        found = [s for s in self.sensor if s.matches(system)]
        return min(found, key=lambda s: (not s.channel, s.category is None), default=None)

    @property
    def apart(self) -> frozenset[tuple[int, int]]:
        """SAC and SIC of the sensors that are told apart by channel."""
        return frozenset((s.sac, s.sic) for s in self.sensor if s.channel and s.sac is not None and s.sic is not None)


def load_config(path: Path | str | None, *, date: str | None = None, framing: str | None = None) -> Config:
    """Read and check a configuration file; without one, the defaults.

    Args:
        path: TOML file.
        date: YYYY-MM-DD, and
        framing: a name, as given on the command line: they go before what the file says.

    Raises:
        ModelError: the file is no TOML, a key is unknown, or a value cannot be; the message names file, key and value.
    """
    given: dict[str, object] = {}
    if date is not None:
        given["date"] = parse_date(date)
    if framing is not None:
        given["framing"] = framing
    return (Config() if path is None else _load(path)).model_copy(update=given)


def _load(path: Path | str) -> Config:
    content = load_toml(path)
    _known(path, "", content, Config.model_fields)
    values: dict[str, object] = {
        **{name: _settings(path, name, content.get(name, {}), kind) for name, kind in _TABLES.items()},
        "sensor": _sensors(path, content.get("sensor", [])),
        "editions": _editions(path, content.get("editions", {})),
    }
    if "learnt" in content:
        if not isinstance(content["learnt"], Mapping):
            raise ModelError(f"{path}: learnt = {brief(content['learnt'])}: saltus setup writes the table [learnt].")
        values["learnt"] = Learnt(shown(str(path)), dict(content["learnt"]))
    if "date" in content:
        values["date"] = _date(path, content["date"])
    if "framing" in content:
        values["framing"] = _framing(path, content["framing"])
    return Config.model_validate(values)


def _framing(path: Path | str, value: object) -> str:
    if value not in NAMES:
        raise ModelError(f"{path}: framing = {value!r}: choose one of {', '.join(NAMES)}, or leave it out.")
    return str(value)


def parse_date(text: str) -> datetime.date:
    """Read a date given on the command line.

    Raises:
        ModelError: it is no date of the form YYYY-MM-DD, or not from 1970 to 2100.
    """
    try:
        return _of_our_time(datetime.date.fromisoformat(text))
    except ValueError as error:
        raise ModelError(f"date {text!r}: {error}. Write YYYY-MM-DD, as 2023-05-02.") from error


def _of_our_time(date: datetime.date) -> datetime.date:
    if not _YEARS[0] <= date.year <= _YEARS[1]:
        raise ModelError(f"date {date}: the year must lie from {_YEARS[0]} to {_YEARS[1]}.")
    return date


def _date(path: Path | str, value: object) -> datetime.date:
    try:
        if isinstance(value, datetime.date) and not isinstance(value, datetime.datetime):
            return _of_our_time(value)
        if isinstance(value, str):
            return parse_date(value)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error
    raise ModelError(f"{path}: date = {brief(value)}: write {_HINTS['date']}.")


def _sensors(path: Path | str, tables: object) -> tuple[SensorConfig, ...]:
    if not isinstance(tables, list):
        raise ModelError(f"{path}: [sensor] is one table; write [[sensor]] with two brackets for each sensor.")
    sensors = []
    for k, table in enumerate(tables):
        where = f"[[sensor]] number {k + 1}"
        _known(path, where, table, SensorConfig.model_fields)
        try:
            sensors.append(SensorConfig.model_validate(table))
        except ValidationError as error:
            raise ModelError(f"{path}: {where}: {_first(error)}") from error
    _told_apart(path, sensors)
    return tuple(sensors)


def _told_apart(path: Path | str, sensors: Sequence[SensorConfig]) -> None:
    """Refuse two sensors of one system, and two of one name: a table's source would be either."""
    seen: dict[str, int] = {}
    for k, s in enumerate(sensors):
        category = "" if s.category is None else f", category = {s.category}"
        category += f', channel = "{s.channel}"' if s.channel else ""
        for key in ([] if s.sac is None else [f"sac = {s.sac}, sic = {s.sic}{category}"]) + [f'name = "{s.name}"']:
            if key in seen:
                named = key.startswith("name")
                what = "have one name" if named else "are the same system"
                cure = "give each its own name" if named else "tell them apart by category or channel"
                raise ModelError(
                    f"{path}: [[sensor]] number {seen[key] + 1} and number {k + 1} {what} ({key}); keep one, or {cure}."
                )
            if key != 'name = ""':
                seen[key] = k


def _first(error: ValidationError) -> str:
    """One clear line of pydantic's first finding."""
    finding = error.errors(include_url=False)[0]
    key = str(finding["loc"][0]) if finding["loc"] else ""
    if finding["type"] == "missing":
        return f"{key} is missing: {_HINTS.get(key, '')}."
    said = finding["msg"].removeprefix("Value error, ")
    if not key:
        return f"{said}."
    return f"{key} = {brief(finding['input'])}: {said[0].lower()}{said[1:]}. Give {_HINTS.get(key, 'another value')}."


def _editions(path: Path | str, table: object) -> dict[int, str]:
    if not isinstance(table, Mapping):
        raise ModelError(f"{path}: editions = {brief(table)}: make it a table [editions] of {_HINTS['editions']}.")
    editions = {}
    for key, value in table.items():
        if not re.fullmatch("[0-9]{1,3}", key) or not 1 <= int(key) <= 255 or not isinstance(value, str):
            raise ModelError(f"{path}: [editions] {cut(key)} = {brief(value)}: write {_HINTS['editions']}.")
        known = known_editions(int(key)) or (value,)
        if value not in known:
            raise ModelError(
                f"{path}: [editions] {cut(key)} = {brief(value)}: not known; choose one of {', '.join(known)}."
            )
        editions[int(key)] = value
    return editions


def _settings(path: Path | str, name: str, table: object, kind: type[T]) -> T:
    """Make settings from a table, each value checked against the type of its field."""
    if not isinstance(table, Mapping):
        raise ModelError(f"{path}: {name} = {brief(table)}: make it a table [{name}].")
    fields = [f.name for f in dataclasses.fields(cast(Any, kind))]
    _known(path, f"[{name}]", table, fields)
    types = get_type_hints(kind)
    values = {}
    for key, value in table.items():
        try:
            values[key] = TypeAdapter(types[key]).validate_python(_tuples(value), strict=True)
        except ValidationError as error:
            said = error.errors(include_url=False)[0]["msg"]
            raise ModelError(f"{path}: [{name}] {key} = {brief(value)}: {said[0].lower()}{said[1:]}.") from error
        if _holds_nan(values[key]):
            raise ModelError(f"{path}: [{name}] {key} = {brief(value)}: nan is no value.")
    try:
        return kind(**values)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error


def _holds_nan(value: object) -> bool:
    return any(map(_holds_nan, value)) if isinstance(value, tuple) else value != value


def _tuples(value: object) -> object:
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value


def _known(path: Path | str, where: str, table: object, known: Iterable[str]) -> None:
    """Refuse keys that mean nothing here: a misspelt one would be obeyed in silence."""
    if not isinstance(table, Mapping):
        raise ModelError(f"{path}: {where}: a table of keys is expected, not {brief(table)}.")
    names = list(known)
    for key in table:
        if key not in names:
            near = difflib.get_close_matches(key, names, n=2) or names
            place = f"{where}: " if where else ""
            raise ModelError(
                f"{path}: {place}unknown key {brief(key)}. Did you mean {' or '.join(near)}?"
                if near is not names
                else f"{path}: {place}unknown key {brief(key)}. Known are: {', '.join(names)}."
            )
