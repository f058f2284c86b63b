"""Tracks of another system as reports that are no plots and as rows of a table: what categories 011 and 062 share."""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.io.columns import Codes, Columns, Decoded, Mask, Numbers, Texts
from saltus.records import REASONS, Kind

__all__ = ["STATES", "system_tracks"]

# columns of the table that say in which state a track is, and the bits that both categories call so
STATES = {
    "monosensor": "MON",
    "tentative": "CNF",
    "simulated": "SIM",
    "first": "TSB",
    "last": "TSE",
    "coasted": "CST",
}


def system_tracks(
    c: Columns,
    *,
    time: Numbers,
    number: Codes,
    position: tuple[Numbers, Numbers],
    plane: tuple[Numbers, Numbers],
    velocity: tuple[Numbers, Numbers],
    altitude: Numbers,
    height: Numbers,
    datum: int,
    vertical_rate: Numbers,
    mode3a: Codes,
    address: Codes,
    callsign: Texts,
    status: str,
    more: Mapping[str, npt.ArrayLike],
    is_report: Mask,
) -> Decoded:
    """Keep tracks for comparison.

    Args:
        c: the records.
        time: s after midnight.
        number: track number.
        position: latitude and longitude, rad.
        plane: m east and north in the system's plane.
        velocity: m/s east and north.
        altitude: pressure altitude, m.
        height: geometric height, m, above `datum`.
        datum: one of `saltus.records.Datum`.
        vertical_rate: m/s.
        mode3a: 12 bits.
        address: 24 bits.
        callsign: text.
        status: item that holds the bits of `STATES`.
        more: further columns of `Plots`.
        is_report: which records are tracks.
    """
    latitude, longitude = position
    columns: dict[str, npt.ArrayLike] = {
        "kind": np.where(np.isnan(latitude), Kind.NONE, Kind.GEODETIC),
        "latitude": latitude,
        "longitude": longitude,
        "altitude": altitude,
        "height": height,
        "datum": np.where(np.isnan(height), -1, datum),
        "icao24": address,
        "mode3a": mode3a,
        "callsign": callsign,
        "local_id": number,
        "reason": np.full(c.n, REASONS.index("system track"), np.int8),
        **more,
    }
    state = {name: c.code(f"{status}/{bit}") == 1 for name, bit in STATES.items()}
    tracks = pa.table(
        {
            "track_number": number,
            "latitude": np.degrees(latitude),
            "longitude": np.degrees(longitude),
            "x_m": plane[0],
            "y_m": plane[1],
            "vx": velocity[0],
            "vy": velocity[1],
            "altitude": altitude,
            "vertical_rate": vertical_rate,
            "mode3a": _spelled(mode3a, "04o"),
            "icao24": _spelled(address, "06x"),
            "callsign": pa.array([v or None for v in callsign.tolist()], pa.string()),
            **state,
        }
    )
    return Decoded(
        time_of_day=time,
        is_report=is_report,
        types=np.select([state["coasted"], state["tentative"]], [2, 1], 0),
        labels={0: "confirmed track", 1: "tentative track", 2: "coasted track"},
        columns=columns,
        new_cycle=np.zeros(c.n, np.bool_),
        steps={"time_lsb": 1 / 128},
        tracks=tracks,
    )


def _spelled(codes: Codes, form: str) -> pa.Array:
    """Codes as texts; each different one is spelled once."""
    values, which = np.unique(codes, return_inverse=True)
    texts = pa.array([None if v < 0 else format(v, form) for v in values.tolist()], pa.string())
    return texts.take(pa.array(which))
