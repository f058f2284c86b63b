"""CAT020, multilateration reports, of wide areas and of airports (EUROCONTROL SPEC-0149-14).

What becomes of the items:

    I020/010  SAC, SIC                 the source; its status messages and update cycle come as CAT019
    I020/020  SIM, TST, RAB, GBS       simulated and test targets and field monitors are no aircraft
    I020/140  time of day              1/128 s
    I020/041  latitude, longitude      WGS-84: taken first
    I020/042  X, Y                     0.5 m east and north of the system's reference point: taken without 041
    I020/070  V, G, L, MODE3A          kept when validated, not garbled and taken from this reply
    I020/090  V, G, FL                 1/4 flight level: pressure altitude, kept when validated and not garbled
    I020/105  geometric height         above the WGS-84 ellipsoid
    I020/110  measured height          above the plane of the reference point
    I020/170  CST, GHO                 CST extrapolated: no detection; a ghost is no aircraft either
    I020/220  24-bit address
    I020/245  target identification
    I020/161  track number             a label only
    I020/500  SDP X, Y                 standard deviations: `sigma` is their root mean square

On the ground when GBS says so, airborne where the report has an address and GBS is not set.
"""

import numpy as np

from saltus.io.columns import Category, Columns, Decoded, first_reason, validated
from saltus.records import Datum, Kind

__all__ = ["CAT020"]

_FIELDS = tuple(
    "020/SSR 020/MS 020/HF 020/VDL4 020/UAT 020/DME 020/OT 020/SIM 020/TST 020/RAB 020/GBS 140 041/LAT 041/LON 042/X "
    "042/Y 070/V 070/G 070/L 070/MODE3A 090/V 090/G 090/FL 105 110 170/CST 170/GHO 220 245/CHR 161/TRN 500/SDP/X "
    "500/SDP/Y".split()
)
# bits of I020/020, the first that is set names the report
_TECHNOLOGIES = {
    "MS": "Mode S multilateration",
    "SSR": "Non-Mode S multilateration",
    "HF": "HF multilateration",
    "VDL4": "VDL Mode 4 multilateration",
    "UAT": "UAT multilateration",
    "DME": "DME/TACAN multilateration",
    "OT": "Other multilateration",
}
_EARTH = 6371000.0  # m: an angle's step as a length


def _decode(c: Columns) -> Decoded:
    position = [c.has("041/LAT"), c.has("042/X")]
    code = np.where(validated(c, "070") & (c.code("070/L") == 0), c.code("070/MODE3A"), -1)
    address, ground, height = c.code("220"), c.code("020/GBS"), c.number("105")
    reason = first_reason(
        c.n,
        {
            "coasted by station": (c.code("170/CST") == 1) | (c.code("170/GHO") == 1),
            "simulated": c.code("020/SIM") == 1,
            "test target": c.code("020/TST") == 1,
            "field monitor": c.code("020/RAB") == 1,
        },
    )
    told = [c.code(f"020/{bit}") == 1 for bit in _TECHNOLOGIES]
    geodetic = np.count_nonzero(position[0]) * 2 > c.n
    return Decoded(
        time_of_day=c.number("140"),
        is_report=np.ones(c.n, np.bool_),
        types=np.select(told, range(len(told)), -1),
        labels=dict(enumerate(_TECHNOLOGIES.values())),
        columns={
            "kind": np.select(position, [Kind.GEODETIC, Kind.PLANE], Kind.NONE),
            "x": c.number("042/X"),
            "y": c.number("042/Y"),
            "z": c.number("110"),
            "latitude": c.number("041/LAT"),
            "longitude": c.number("041/LON"),
            "altitude": np.where(validated(c, "090"), c.number("090/FL"), np.nan),
            "height": height,
            "datum": np.where(np.isnan(height), -1, Datum.ELLIPSOID),
            "sigma": np.hypot(c.number("500/SDP/X"), c.number("500/SDP/Y")) / np.sqrt(2.0),
            "icao24": address,
            "mode3a": code,
            "callsign": c.text("245/CHR"),
            "on_ground": np.select([ground == 1, address >= 0], [1, 0], -1),
            "local_id": c.code("161/TRN"),
            "reason": reason,
        },
        new_cycle=np.zeros(c.n, np.bool_),
        steps={
            "xy_lsb": c.step("041/LAT") * _EARTH if geodetic else c.step("042/X"),
            "altitude_lsb": 25 * 0.3048,
            "time_lsb": 1 / 128,
        },
    )


CAT020 = Category(20, "multilateration", ("140",), _FIELDS, _decode, turns=19)
