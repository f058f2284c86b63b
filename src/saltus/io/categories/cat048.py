"""CAT048, monoradar target reports (EUROCONTROL SPEC-0149-4).

What becomes of the items:

    I048/010  SAC, SIC               the source
    I048/140  time of day            1/128 s
    I048/020  TYP, SIM, RAB, TST     TYP 0 is the station's extrapolation, no detection; simulated and test
                                     targets and field monitors are no aircraft
    I048/040  RHO, THETA             slant range 1/256 NM, azimuth 360/65536 degrees from north, clockwise
    I048/070  V, G, L, MODE3A        kept when validated, not garbled and taken from this reply (L = 0)
    I048/090  V, G, FL               1/4 flight level, two's complement in every edition (older tables say unsigned);
                                     kept when validated and not garbled
    I048/110  3DH                    25 ft, above mean sea level: measured by a radar with elevation
    I048/220  24-bit address
    I048/240  aircraft identification
    I048/230  STAT                   0, 2 airborne; 1, 3 on ground; others do not say
    I048/161  track number           a label only

All else, above all the station's own tracking (042, 170, 200), is counted and not used; the Comm-B registers of 250
are columns of the codec ("250/5,0/ROLL"). I048/100 (Mode C with its pulses' quality) is sent for codes that are not
valid, so it gives no height.
"""

import numpy as np

from saltus.asterix.codec import Want
from saltus.io.columns import Category, Columns, Decoded, first_reason, validated
from saltus.records import Datum, Kind

__all__ = ["CAT048"]

_FIELDS: tuple[str | Want, ...] = (
    *"140 020/TYP 020/SIM 020/RAB 020/TST 020/ERR 040/RHO 040/THETA 070/V 070/G 070/L 070/MODE3A 090/V 090/G".split(),
    Want("090/FL", signed=True),
    *"110/3DH 220 240 230/STAT 161/TRN".split(),
)
_RANGE_LSB = 1852.0 / 256
_RANGE_FULL = 65535 * _RANGE_LSB


def _decode(c: Columns) -> Decoded:
    kind, height = c.code("020/TYP"), c.number("110/3DH")
    # ERR: the true range is beyond the item's scale and stands in the reserved field
    beyond = (c.code("020/ERR") == 1) & (c.number("040/RHO") >= _RANGE_FULL)
    code = np.where(validated(c, "070") & (c.code("070/L") == 0), c.code("070/MODE3A"), -1)
    state = c.code("230/STAT")
    reason = first_reason(
        c.n,
        {
            "coasted by station": kind == 0,
            "simulated": c.code("020/SIM") == 1,
            "test target": c.code("020/TST") == 1,
            "field monitor": c.code("020/RAB") == 1,
        },
    )
    return Decoded(
        time_of_day=c.number("140"),
        is_report=np.ones(c.n, np.bool_),
        types=kind,
        labels=c.labels("020/TYP"),
        columns={
            "kind": np.where(c.has("040/RHO"), Kind.POLAR, Kind.NONE),
            "range": np.where(beyond, np.inf, c.number("040/RHO")),
            "azimuth": c.number("040/THETA"),
            "altitude": np.where(validated(c, "090"), c.number("090/FL"), np.nan),
            "height": height,
            "datum": np.where(np.isnan(height), -1, Datum.MEAN_SEA_LEVEL),
            "icao24": c.code("220"),
            "mode3a": code,
            "callsign": c.text("240"),
            "on_ground": np.select([(state == 0) | (state == 2), (state == 1) | (state == 3)], [0, 1], -1),
            "local_id": c.code("161/TRN"),
            "reason": reason,
        },
        new_cycle=np.zeros(c.n, np.bool_),
        steps={
            "range_lsb": _RANGE_LSB,
            "azimuth_lsb": 2 * np.pi / 65536,
            "altitude_lsb": 25 * 0.3048,
            "time_lsb": 1 / 128,
        },
    )


CAT048 = Category(48, "monoradar plots", ("140",), _FIELDS, _decode, turns=34)
