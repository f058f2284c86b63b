"""Formats that are known and not read: each told by its first bytes, with the way from it to one that is."""

import re
from typing import NamedTuple

__all__ = ["FOREIGN", "Foreign", "foreign", "is_plain"]


class Foreign(NamedTuple):
    """One such format: what its first bytes look like, its name, and what to do with a file of it."""

    head: re.Pattern[bytes]
    name: str
    remedy: str


def _first(pattern: bytes) -> re.Pattern[bytes]:
    """At the beginning, blanks and a byte order mark aside."""
    return re.compile(rb"(?:\xef\xbb\xbf)?\s*" + pattern)


_MODE_S = (
    "Decode its messages (dump1090, readsb or rs1090 do) and write one row a position as a CSV or Parquet table with "
    "the columns time, icao24, latitude, longitude, altitude_m, callsign."
)
_ADSB = "columns time, icao24, latitude, longitude, altitude_m (1 ft = 0.3048 m), callsign, on_ground"
_UNPACK = "Unpack it and name the file inside."

FOREIGN = (
    Foreign(
        _first(rb"(\\[^\\]{1,80}\\)?!(AI|AB|AD|BS|SA)VD[MO],\d"),
        "AIS sentences (NMEA 0183)",
        "Decode them (pyais or gpsdecode do) and write one row a position report as a CSV or Parquet table with the "
        "columns time, latitude, longitude, and callsign or source.",
    ),
    Foreign(
        _first(rb"(MSG|SEL|ID|AIR|STA|CLK),\d*,\d*,\d*,[0-9A-Fa-f]*,\d*,"),
        "BaseStation messages (SBS, port 30003)",
        "Its lines of type MSG,3 hold positions: write them as a CSV or Parquet table with a header and the "
        f"{_ADSB}; the two fields of date and time make one time, 2023-11-14T22:13:20Z.",
    ),
    Foreign(
        _first(rb'\{\s*"now"\s*:'),
        "aircraft.json of dump1090 or readsb",
        f"Write its list aircraft as a CSV or Parquet table with the {_ADSB}; time is now minus seen_pos.",
    ),
    Foreign(
        _first(rb'\{\s*"time"\s*:\s*\d+\s*,\s*"states"\s*:'),
        "states of the OpenSky network (JSON)",
        "Write its list states as a CSV or Parquet table with the columns time (the fourth entry, time_position), "
        "icao24, callsign, longitude, latitude, altitude_m, on_ground.",
    ),
    Foreign(_first(rb"[*@:%][0-9A-Fa-f]{14,44};"), "raw Mode S messages (AVR)", _MODE_S),
    Foreign(re.compile(rb"\x1a[1-4]"), "raw Mode S messages (Beast)", _MODE_S),
    Foreign(
        _first(rb"MMSI,BaseDateTime,"),
        "AIS positions of MarineCadastre",
        "Rename BaseDateTime to time, LAT to latitude, LON to longitude and CallSign to callsign.",
    ),
    Foreign(re.compile(rb"\x1f\x8b|BZh[1-9]|\xfd7zXZ\0|\x28\xb5\x2f\xfd"), "compressed file", _UNPACK),
    Foreign(re.compile(rb"PK\x03\x04"), "ZIP archive (or a spreadsheet)", "Unpack it, or save the sheet as CSV."),
    Foreign(re.compile(rb"SQLite format 3\0"), "SQLite database", "Export the table of reports as CSV or Parquet."),
    Foreign(re.compile(rb"\x89HDF\r\n"), "HDF5 or MATLAB file", "Export the reports as a CSV or Parquet table."),
)


def foreign(head: bytes) -> Foreign | None:
    """The format that a file's first bytes tell, if it is one that is known and not read."""
    return next((entry for entry in FOREIGN if entry.head.match(head)), None)


def is_plain(head: bytes) -> bool:
    """Whether bytes hold no control characters: no block of ASTERIX is without, and some digits make a container."""
    return not any(byte < 32 and byte not in b"\t\n\r\f" for byte in head)
