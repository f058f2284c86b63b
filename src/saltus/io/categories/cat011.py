"""CAT011, tracks of surface movement guidance and control (EUROCONTROL SPEC-0149-8): another system's tracks.

What becomes of the items: time I011/140, track number 161 FTN, position 041 (WGS-84) and 042 (east, north of the
system's reference point), velocity 202, Mode 3/A 060, address 380 ADR, callsign 245, else flight plan 390 CSN, status
170, altitude 090 (measured flight level: pressure), else 093 where no QNH correction is applied, height 092
(calculated geometric altitude, above mean sea level), vertical rate 215. A track is on the ground where 170 GBS says
so. Messages about flight plans and holdbars (I011/000 from 2 on) are no reports.
"""

import numpy as np

from saltus.io.columns import Category, Columns, Decoded
from saltus.io.system_track import STATES, system_tracks
from saltus.records import Datum, Traits

__all__ = ["CAT011"]

_TARGETS = 1  # I011/000: target reports, flight plan data and basic alerts
_FIELDS = (
    *"000 140 161/FTN 041/LAT 041/LON 042/X 042/Y 202/VX 202/VY 060/MOD3A 245/TID 380/ADR 390/CSN".split(),
    *"090 093/QNH 093/CTBA 092 215 170/GBS".split(),
    *(f"170/{bit}" for bit in STATES.values()),
)


def _decode(c: Columns) -> Decoded:
    measured = c.number("090")
    pressure = np.where(c.code("093/QNH") == 0, c.number("093/CTBA"), np.nan)
    sent, planned = c.text("245/TID"), c.text("390/CSN")
    return system_tracks(
        c,
        time=c.number("140"),
        number=c.code("161/FTN"),
        position=(c.number("041/LAT"), c.number("041/LON")),
        plane=(c.number("042/X"), c.number("042/Y")),
        velocity=(c.number("202/VX"), c.number("202/VY")),
        altitude=np.where(np.isnan(measured), pressure, measured),
        height=c.number("092"),
        datum=Datum.MEAN_SEA_LEVEL,
        vertical_rate=c.number("215"),
        mode3a=c.code("060/MOD3A"),
        address=c.code("380/ADR"),
        callsign=np.where(sent != "", sent, planned),
        status="170",
        more={"on_ground": np.where(c.code("170/GBS") == 1, 1, -1)},  # 0 is "not set or unknown"
        is_report=np.isin(c.code("000"), (_TARGETS, -1)),
    )


CAT011 = Category(11, "tracks of an airport surface centre", ("140",), _FIELDS, _decode, traits=Traits(surface=True))
