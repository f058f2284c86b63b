"""CAT062, system tracks of a surveillance centre (EUROCONTROL SPEC-0149-9): kept for comparison, never plots.

What becomes of the items: time I062/070, track number 040, position 105 (WGS-84) and 100 (system plane), velocity
185 (east, north), Mode 3/A 060, address and identification 380 ADR and ID (callsign else 245, else flight plan
390 CS), status 080, altitude 136 (measured flight level: pressure) else 135 (barometric), height 130 (calculated
geometric altitude, above the ellipsoid), vertical rate 220.
"""

import numpy as np

from saltus.io.columns import Category, Columns, Decoded, validated
from saltus.io.system_track import STATES, system_tracks
from saltus.records import Datum

__all__ = ["CAT062"]

_FIELDS = (
    *"070 040 105/LAT 105/LON 100/X 100/Y 185/VX 185/VY 060/V 060/G 060/MODE3A 245/CHR 380/ADR 380/ID 390/CS".split(),
    *"136 130 135/CTB 220".split(),
    *(f"080/{bit}" for bit in STATES.values()),
)


def _decode(c: Columns) -> Decoded:
    measured, barometric = c.number("136"), c.number("135/CTB")
    valid = validated(c, "060") if c.defines("060/V") else c.has("060/MODE3A")  # edition 1.16 does not say
    sent, own, planned = c.text("380/ID"), c.text("245/CHR"), c.text("390/CS")
    return system_tracks(
        c,
        time=c.number("070"),
        number=c.code("040"),
        position=(c.number("105/LAT"), c.number("105/LON")),
        plane=(c.number("100/X"), c.number("100/Y")),
        velocity=(c.number("185/VX"), c.number("185/VY")),
        altitude=np.where(np.isnan(measured), barometric, measured),
        height=c.number("130"),
        datum=Datum.ELLIPSOID,
        vertical_rate=c.number("220"),
        mode3a=np.where(valid, c.code("060/MODE3A"), -1),
        address=c.code("380/ADR"),
        callsign=np.select([sent != "", own != ""], [sent, own], planned),
        status="080",
        more={},
        is_report=np.ones(c.n, np.bool_),
    )


CAT062 = Category(62, "system tracks of a surveillance centre", ("070",), _FIELDS, _decode)
