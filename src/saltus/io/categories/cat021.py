"""CAT021, ADS-B reports (EUROCONTROL SPEC-0149-12), editions 0.23 to 0.26 and 2.1 on.

What becomes of the items (0.x | 2.x where they differ):

    I021/010  SAC, SIC                 the source
    I021/030  time of day              0.x
    I021/071, 073, 077  time           2.x: of applicability, else of reception, else of transmission
    I021/130, 131  latitude, longitude the finer one present (131 exists in 2.x)
    I021/145  flight level             1/4 flight level: pressure altitude
    I021/140  geometric height         6.25 ft, above the WGS-84 ellipsoid; full scale says "greater than" and is none
    I021/040  GBS, SIM, TST, RAB       ground bit; simulated and test targets and field monitors are no aircraft
    I021/080  24-bit address
    I021/070  MODE3A                   2.x
    I021/170  target identification
    I021/161  track number             2.x, a label only
    I021/210  VN                       2.x: version of the transponder's rules, 0 to 2
    I021/090  quality                  2.x: NACp gives `sigma` (versions 1 and 2), PIC, else NIC or NUCp by the version,
                                       gives `containment`; 0.x: PA is a NUCp, so `containment` alone

Containment radii are bounds of integrity and no measure of accuracy. Velocities are counted only.
"""

import numpy as np

from saltus.asterix.codec import Want
from saltus.io.columns import Category, Columns, Decoded, Numbers, first_reason, time_of_day
from saltus.records import Datum, Kind, Traits

__all__ = ["CAT021"]

_FIELDS: tuple[str | Want, ...] = (
    *"040/ATP 040/SIM 040/TST 040/RAB 040/GBS 030 071 073 077 130/LAT 130/LON 131/LAT 131/LON 145 140 080".split(),
    *"070/MODE3A 170 161/TRNUM 210/VN 090/NACP 090/NUCPNIC 090/PIC".split(),
    Want("090/PA", "raw"),
)
_TIME = ("077", "073", "071", "030")  # the best last
_EARTH = 6371000.0  # m: an angle's step as a length
_NM = 1852.0
_HEIGHT_FULL = 32767 * 6.25 * 0.3048  # m, I021/140
# 95 % radius of NACp 0 to 11, m (ICAO Doc 9871, C.2.3.10.7); a 95 % radius is sqrt(-2 ln 0.05) sigma of each axis
_EPU = np.array([np.nan, 10 * _NM, 4 * _NM, 2 * _NM, _NM, 0.5 * _NM, 0.3 * _NM, 0.1 * _NM, 0.05 * _NM, 30.0, 10.0, 3.0])
_RADIUS_95 = 2.45
# radii of containment, m: NIC 0 to 11 (Doc 9871, B.2.3.10.6), NUCp 0 to 9 (table C-41), PIC 0 to 14 (I021/090)
_NIC = np.array([np.nan, *(k * _NM for k in (20, 8, 4, 2, 1, 0.6, 0.2, 0.1)), 75.0, 25.0, 7.5])
_NUCP = np.array([np.nan, *(k * _NM for k in (20, 10, 2, 1, 0.5, 0.2, 0.1)), 25.0, 7.5])
_PIC = np.array([np.nan, *(k * _NM for k in (20, 10, 8, 4, 2, 1, 0.6, 0.5, 0.3, 0.2, 0.1, 0.04, 0.013, 0.004))])


def _decode(c: Columns) -> Decoded:
    latitude, longitude, step = _position(c)
    sigma, containment = _quality(c)
    height = c.number("140")
    height = np.where(height >= _HEIGHT_FULL, np.nan, height)
    reason = first_reason(
        c.n,
        {
            "simulated": c.code("040/SIM") == 1,
            "test target": c.code("040/TST") == 1,
            "field monitor": c.code("040/RAB") == 1,
        },
    )
    return Decoded(
        time_of_day=time_of_day(c, _TIME),
        is_report=np.ones(c.n, np.bool_),
        types=c.code("040/ATP"),
        labels=c.labels("040/ATP"),
        columns={
            "kind": np.where(np.isnan(latitude), Kind.NONE, Kind.GEODETIC),
            "latitude": latitude,
            "longitude": longitude,
            "altitude": c.number("145"),
            "height": height,
            "datum": np.where(np.isnan(height), -1, Datum.ELLIPSOID),
            "sigma": sigma,
            "containment": containment,
            "icao24": c.code("080"),
            "mode3a": c.code("070/MODE3A"),
            "callsign": c.text("170"),
            "on_ground": c.code("040/GBS", beside="040/ATP"),
            "local_id": c.code("161/TRNUM"),
            "reason": reason,
        },
        new_cycle=np.zeros(c.n, np.bool_),
        steps={"xy_lsb": step * _EARTH, "altitude_lsb": 25 * 0.3048, "time_lsb": 1 / 128},
    )


def _position(c: Columns) -> tuple[Numbers, Numbers, float]:
    """Latitude and longitude, rad, from the finer item present, and the step of most of them."""
    coarse = c.number("130/LAT"), c.number("130/LON")
    if not c.defines("131/LAT"):  # 0.x: 131 is no position there (in 0.26 the signal amplitude)
        return *coarse, c.step("130/LAT")
    fine = c.has("131/LAT")
    latitude = np.where(fine, c.number("131/LAT"), coarse[0])
    longitude = np.where(fine, c.number("131/LON"), coarse[1])
    item = "131" if np.count_nonzero(fine) * 2 > c.n else "130"
    return latitude, longitude, c.step(f"{item}/LAT")


def _quality(c: Columns) -> tuple[Numbers, Numbers]:
    """Standard deviation of each axis and radius of containment, m, NaN where unknown."""
    version = c.code("210/VN")
    sigma = np.where(np.isin(version, (1, 2)), _of(_EPU, c.code("090/NACP")), np.nan) / _RADIUS_95
    primary = c.code("090/NUCPNIC")
    by_version = np.select(
        [version == 0, version > 0], [_of(_NUCP, primary), _of(_NIC, primary)], _of(_NUCP, c.code("090/PA"))
    )
    category = _of(_PIC, c.code("090/PIC"))
    return sigma, np.where(np.isnan(category), by_version, category)


def _of(table: Numbers, codes: np.ndarray) -> Numbers:
    """The table's value for each code, NaN for codes without one."""
    known = (codes >= 0) & (codes < len(table))
    return np.where(known, table[np.where(known, codes, 0)], np.nan)


# A transponder at rest on the ground tells its position every 5 s; one without a clock of its own sends a position up
# to 0.1 s off the time it is received at.
CAT021 = Category(
    21,
    "ADS-B reports of a ground station",
    _TIME,
    _FIELDS,
    _decode,
    traits=Traits(self_reporting=True, rest_period=5.0, sigma_time=0.2 / 12.0**0.5),
    turns=None,
)
