"""CAT021, ADS-B reports (EUROCONTROL SPEC-0149-12), editions 0.23 to 0.26 and 2.1 on.

What becomes of the items (0.x | 2.x where they differ):

    I021/010  SAC, SIC                 the source
    I021/030  time of day              0.x
    I021/071, 073, 077  time           2.x: of applicability, else of reception, else of transmission
    I021/130, 131  latitude, longitude the finer one present (131 exists in 2.x)
    I021/145  flight level             1/4 flight level: pressure altitude
    I021/040  GBS, SIM, TST, RAB       ground bit; simulated and test targets and field monitors are no aircraft
    I021/080  24-bit address
    I021/070  MODE3A                   2.x
    I021/170  target identification
    I021/161  track number             2.x, a label only

Geometric height (140) is no pressure altitude and is counted only, like velocities and quality items (090 and so on).
"""

import numpy as np

from saltus.io.columns import Category, Columns, Decoded, first_reason
from saltus.records import Kind, Traits

__all__ = ["CAT021"]

_ITEMS = ("010", "040", "030", "071", "073", "077", "130", "131", "145", "080", "070", "170", "161")
_EARTH = 6371000.0  # m: an angle's step as a length


def _decode(c: Columns) -> Decoded:
    latitude, longitude, step = _position(c)
    reason = first_reason(
        c.n,
        {
            "simulated": c.code("040", "SIM") == 1,
            "test target": c.code("040", "TST") == 1,
            "field monitor": c.code("040", "RAB") == 1,
        },
    )
    return Decoded(
        time_of_day=_time(c),
        is_report=np.ones(c.n, np.bool_),
        types=c.code("040", "ATP"),
        labels=c.layout.labels("040", "ATP"),
        columns={
            "kind": np.where(np.isnan(latitude), Kind.NONE, Kind.GEODETIC),
            "latitude": latitude,
            "longitude": longitude,
            "altitude": c.number("145"),
            "icao24": c.code("080"),
            "mode3a": c.code("070", "MODE3A"),
            "callsign": c.text("170"),
            "on_ground": c.code("040", "GBS"),
            "local_id": c.code("161", "TRNUM"),
            "reason": reason,
        },
        new_cycle=np.zeros(c.n, np.bool_),
        steps={"xy_lsb": step * _EARTH, "altitude_lsb": 25 * 0.3048, "time_lsb": 1 / 128},
    )


def _time(c: Columns) -> np.ndarray:
    time = np.full(c.n, np.nan)
    for item in ("077", "073", "071", "030"):  # the best last
        given = c.number(item)
        time = np.where(np.isnan(given), time, given)
    return time


def _position(c: Columns) -> tuple[np.ndarray, np.ndarray, float]:
    """Latitude and longitude, rad, from the finer item present, and the step of most of them."""
    coarse = c.number("130", "LAT"), c.number("130", "LON")
    if c.defines("030"):  # 0.x: 131 is no position there (in 0.26 the signal amplitude)
        return *coarse, c.layout.field("130", "LAT").lsb
    fine = c.has("131")
    latitude = np.where(fine, c.number("131", "LAT"), coarse[0])
    longitude = np.where(fine, c.number("131", "LON"), coarse[1])
    item = "131" if np.count_nonzero(fine) * 2 > c.n else "130"
    return latitude, longitude, c.layout.field(item, "LAT").lsb


def _plausible(c: Columns) -> float:
    """Share of reports whose time follows the one before within 10 minutes and whose latitude exists.

    Read in the wrong edition, times and positions are other items' bytes.
    """
    time = _time(c)
    latitude, _, _ = _position(c)
    times, latitudes = time[~np.isnan(time)], latitude[~np.isnan(latitude)]
    if len(times) < 2 or not len(latitudes):
        return 0.0
    near = np.abs((np.diff(times) + 43200) % 86400 - 43200) < 600
    share = np.mean(near) * np.mean(np.abs(latitudes) <= np.pi / 2) * len(times) / c.n
    return float(share)


# A transponder at rest on the ground tells its position every 5 s; one without a clock of its own sends a position up
# to 0.1 s off the time it is received at.
CAT021 = Category(
    21,
    _ITEMS,
    _decode,
    _plausible,
    Traits(self_reporting=True, rest_period=5.0, sigma_time=0.2 / 12.0**0.5),
)
