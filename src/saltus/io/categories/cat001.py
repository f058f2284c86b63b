"""CAT001, monoradar target reports of older radars: plots and tracks (EUROCONTROL SPEC-0149-2a).

I001/020 TYP says of each record whether it is laid out as a plot or as a track. What becomes of the items:

    I001/010  SAC, SIC                   the source
    I001/141  truncated time of day      1/128 s, modulo 512 s: completed by the last message of CAT002 of the same
                                         source, else by the capture clock; without either a report has no time
    I001/020  SSRPSR, SIM, TST, RAB      SSRPSR 0 is no detection; simulated and test targets and field monitors are no
                                         aircraft
    I001/040  RHO, THETA                 slant range 1/128 NM, azimuth 360/65536 degrees
    I001/042  X, Y                       a track's calculated position: where 040 is absent the record tells what the
                                         station's tracker believes, no measurement: a system track
    I001/070  V, G, L, MODE3A            kept when validated, not garbled and taken from this reply
    I001/090  V, G, HGT                  1/4 flight level: pressure altitude, kept when validated and not garbled
    I001/161  track or plot number       a label only

All else (Doppler speed 120, powers 130 and 131, the station's velocity 200, status 170) is counted and not used.
"""

import numpy as np

from saltus.io.columns import Category, Columns, Decoded, first_reason, validated
from saltus.records import Kind

__all__ = ["CAT001"]

_FIELDS = tuple(
    "141 020/TYP 020/SSRPSR 020/SIM 020/TST 020/RAB 040/RHO 040/THETA 042/X 042/Y 070/V 070/G 070/L 070/MODE3A "
    "090/V 090/G 090/HGT 161".split()
)
_WRAP = 512.0  # s


def _decode(c: Columns) -> Decoded:
    kind = c.code("020/SSRPSR")
    measured = c.has("040/RHO")
    code = np.where(validated(c, "070") & (c.code("070/L") == 0), c.code("070/MODE3A"), -1)
    reason = first_reason(
        c.n,
        {
            "coasted by station": kind == 0,
            "simulated": c.code("020/SIM") == 1,
            "test target": c.code("020/TST") == 1,
            "field monitor": c.code("020/RAB") == 1,
            "system track": c.has("042/X") & ~measured,
        },
    )
    return Decoded(
        time_of_day=c.number("141"),
        is_report=np.ones(c.n, np.bool_),
        types=kind,
        labels=c.labels("020/SSRPSR"),
        columns={
            "kind": np.select([measured, c.has("042/X")], [Kind.POLAR, Kind.PLANE], Kind.NONE),
            "range": c.number("040/RHO"),
            "azimuth": c.number("040/THETA"),
            "x": c.number("042/X"),
            "y": c.number("042/Y"),
            "altitude": np.where(validated(c, "090"), c.number("090/HGT"), np.nan),
            "mode3a": code,
            "local_id": c.code("161"),
            "reason": reason,
        },
        new_cycle=np.zeros(c.n, np.bool_),
        steps={
            "range_lsb": 1852.0 / 128,
            "azimuth_lsb": 2 * np.pi / 65536,
            "altitude_lsb": 25 * 0.3048,
            "time_lsb": 1 / 128,
        },
    )


CAT001 = Category(
    1, "monoradar plots and tracks of older radars", ("141",), _FIELDS, _decode, turns=2, time_modulus=_WRAP
)
