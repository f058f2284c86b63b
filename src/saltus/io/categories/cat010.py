"""CAT010, surface movement reports of radars and multilateration (EUROCONTROL SPEC-0149-7).

What becomes of the items:

    I010/010  SAC, SIC                 the source
    I010/000  message type             1 target report; 2 to 4 are status messages, 2 starts an update cycle
    I010/020  TYP, GBS, SIM, TST, RAB  simulated and test targets and field monitors are no aircraft
    I010/140  time of day              1/128 s
    I010/040  RHO, TH                  slant range 1 m, azimuth 360/65536 degrees: taken first, it is what was measured
    I010/042  X, Y                     1 m east and north of the sensor's reference point: taken without 040
    I010/041  latitude, longitude      taken without 040 and 042
    I010/060  V, G, L, MODE3A          kept when validated, not garbled and taken from this reply
    I010/090  V, G, FL                 1/4 flight level, kept when validated and not garbled
    I010/220  24-bit address
    I010/245  target identification
    I010/161  track number             a label only

A target is on the ground when GBS or the type of target (ground vehicle) says so, airborne when a Mode S or ADS-B
report does not set GBS. I010/091 (measured height) is no pressure altitude and is counted only, like all
that the station's tracking computes (161, 170, 200, 202, 210).
"""

import numpy as np

from saltus.io.columns import Category, Columns, Decoded, first_reason, validated
from saltus.records import Kind, Traits

__all__ = ["CAT010"]

_FIELDS = tuple(
    "000 020/TYP 020/SIM 020/TST 020/RAB 020/GBS 020/TOT 140 040/RHO 040/TH 042/X 042/Y 041/LAT 041/LON "
    "060/V 060/G 060/L 060/MODE3A 090/V 090/G 090/FL 220 245/CHR 161/TRK".split()
)
_MODE_S, _ADS_B = 1, 2  # I010/020 TYP
_VEHICLE = 2  # I010/020 TOT
_STATUS = 100  # added to message types to keep them apart from detection types


def _decode(c: Columns) -> Decoded:
    message, kind = c.code("000"), c.code("020/TYP")
    is_report = (message == 1) | ((message == -1) & (kind >= 0))
    labels = {_STATUS + k: text for k, text in c.labels("000").items()}
    ground = (c.code("020/GBS") == 1) | (c.code("020/TOT") == _VEHICLE)
    position = [c.has("040/RHO"), c.has("042/X"), c.has("041/LAT")]
    code = np.where(validated(c, "060") & (c.code("060/L") == 0), c.code("060/MODE3A"), -1)
    reason = first_reason(
        c.n,
        {
            "simulated": c.code("020/SIM") == 1,
            "test target": c.code("020/TST") == 1,
            "field monitor": c.code("020/RAB") == 1,
        },
    )
    return Decoded(
        time_of_day=c.number("140"),
        is_report=is_report,
        types=np.where(is_report, kind, np.where(message >= 0, _STATUS + message, -1)),
        labels={**c.labels("020/TYP"), **labels},
        columns={
            "kind": np.select(position, [Kind.POLAR, Kind.PLANE, Kind.GEODETIC], Kind.NONE),
            "range": c.number("040/RHO"),
            "azimuth": c.number("040/TH"),
            "x": c.number("042/X"),
            "y": c.number("042/Y"),
            "latitude": c.number("041/LAT"),
            "longitude": c.number("041/LON"),
            "altitude": np.where(validated(c, "090"), c.number("090/FL"), np.nan),
            "icao24": c.code("220"),
            "mode3a": code,
            "callsign": c.text("245/CHR"),
            "on_ground": np.select([ground, (kind == _MODE_S) | (kind == _ADS_B)], [1, 0], -1),
            "local_id": c.code("161/TRK"),
            "reason": reason,
        },
        new_cycle=message == 2,
        steps={
            "range_lsb": 1.0,
            "azimuth_lsb": 2 * np.pi / 65536,
            "xy_lsb": 1.0,
            "altitude_lsb": 25 * 0.3048,
            "time_lsb": 1 / 128,
        },
    )


CAT010 = Category(10, "surface movement sensors of an airport", ("140",), _FIELDS, _decode, traits=Traits(surface=True))
