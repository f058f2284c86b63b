"""CAT062, system tracks of a surveillance centre (EUROCONTROL SPEC-0149-9): kept for comparison, never plots.

What becomes of the items: time I062/070, track number 040, position 105 (WGS-84) and 100 (system plane), velocity
185 (east, north), Mode 3/A 060, address and identification 380 ADR and ID (callsign else 245, else flight plan
390 CS), status 080, altitude 136 (measured flight level) else 135 (barometric), vertical rate 220.
"""

from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.io.columns import Category, Columns, Decoded, icao_text, validated
from saltus.records import REASONS, Kind

__all__ = ["CAT062"]

_ITEMS = tuple("010 070 040 105 100 185 060 245 380 390 080 136 135 220".split())
_STATUS = {"monosensor": "MON", "tentative": "CNF", "simulated": "SIM", "first": "TSB", "last": "TSE"}
_COASTED = "CST"


def _decode(c: Columns) -> Decoded:
    latitude, longitude = c.number("105", "LAT"), c.number("105", "LON")
    code = np.where(validated(c, "060"), c.code("060", "MODE3A"), -1)
    measured, barometric = c.number("136"), c.number("135", "CTB")
    altitude = np.where(np.isnan(measured), barometric, measured)
    address, callsign = _identity(c)
    columns: dict[str, npt.ArrayLike] = {
        "kind": np.where(np.isnan(latitude), Kind.NONE, Kind.GEODETIC),
        "latitude": latitude,
        "longitude": longitude,
        "altitude": altitude,
        "icao24": address,
        "mode3a": code,
        "callsign": callsign,
        "local_id": c.code("040"),
        "reason": np.full(c.n, REASONS.index("system track"), np.int8),
    }
    state = {name: c.code("080", bit) == 1 for name, bit in {**_STATUS, "coasted": _COASTED}.items()}
    tracks = pa.table(
        {
            "track_number": c.code("040"),
            "latitude": np.degrees(latitude),
            "longitude": np.degrees(longitude),
            "x_m": c.number("100", "X"),
            "y_m": c.number("100", "Y"),
            "vx": c.number("185", "VX"),
            "vy": c.number("185", "VY"),
            "altitude": altitude,
            "vertical_rate": c.number("220"),
            "mode3a": pa.array([None if v < 0 else f"{v:04o}" for v in code.tolist()], pa.string()),
            "icao24": pa.array([None if v < 0 else f"{v:06x}" for v in address.tolist()], pa.string()),
            "callsign": pa.array([v or None for v in callsign.tolist()], pa.string()),
            **state,
        }
    )
    return Decoded(
        time_of_day=c.number("070"),
        is_report=np.ones(c.n, np.bool_),
        types=np.select([state["coasted"], state["tentative"]], [2, 1], 0),
        labels={0: "confirmed track", 1: "tentative track", 2: "coasted track"},
        columns=columns,
        new_cycle=np.zeros(c.n, np.bool_),
        steps={"time_lsb": 1 / 128},
        tracks=tracks,
    )


def _identity(c: Columns) -> tuple[npt.NDArray[np.int64], npt.NDArray[Any]]:
    """Address and callsign; those of I062/380 are parts of a compound item, taken one by one."""
    address = np.full(c.n, -1, np.int64)
    callsign = c.text("245", "CHR")
    index, chunks = c.items.get("390", ([], []))
    for k, chunk in zip(index, chunks, strict=True):
        planned = c.layout.part("390", "CS", chunk)
        if planned and not callsign[k]:
            callsign[k] = planned.decode("latin-1").strip("\0 ")
    index, chunks = c.items.get("380", ([], []))
    for k, chunk in zip(index, chunks, strict=True):
        sent, name = c.layout.part("380", "ADR", chunk), c.layout.part("380", "ID", chunk)
        if sent:
            address[k] = int.from_bytes(sent, "big")
        if name:
            callsign[k] = icao_text(np.array([int.from_bytes(name, "big")]))[0] or callsign[k]
    return address, callsign


CAT062 = Category(62, _ITEMS, _decode)
