"""Reports of every source category, written by our encoder and read by every command that takes them."""

import csv
import datetime

import numpy as np
import pyarrow.parquet as pq
import pyproj
import pytest

from saltus.asterix.codec import Column
from saltus.asterix.encode import blocks, encode
from saltus.asterix.layout import layout
from saltus.convert import convert_files
from saltus.info import show_info
from saltus.io import read
from saltus.records import Datum, Kind
from saltus.run import track_files

N, TURN, START = 40, 4.0, 36_000.0
TIME = START + TURN * np.arange(N)
TOD = np.round(TIME * 128).astype(np.int64)
WEST, HEIGHT_FT = 2.0, 10_000.0
DATE = "2024-05-01"


def ones(value):
    return np.full(N, value, np.int64)


def degrees(value, step):
    return np.round(np.asarray(value) / step).astype(np.int64)


LATITUDE = 41.0 + 0.0075 * np.arange(N)  # north at 208 m/s
POLAR = {"RHO": np.round((30e3 + 800.0 * np.arange(N)) / 1852.0, 6), "THETA": 8192}
SOURCE = {"010/SAC": ones(20), "010/SIC": ones(5)}
IDENTITY = 0x3C6444

# category -> edition, items, kind of the reports
RECORDINGS = {
    1: (
        "1.4",
        {
            "020/SSRPSR": ones(2),
            "040/RHO": np.round(POLAR["RHO"] * 128).astype(np.int64),
            "040/THETA": ones(POLAR["THETA"]),
            "070/MODE3A": ones(0o1234),
            "090/HGT": ones(400),
            "141": TOD % 65536,
        },
        Kind.POLAR,
    ),
    10: (
        "1.1",
        {
            "000": ones(1),
            "020/TYP": ones(1),
            "140": TOD,
            "042/X": ones(500),
            "042/Y": np.round(10.0 * TURN * np.arange(N)).astype(np.int64),
            "220": ones(IDENTITY),
        },
        Kind.PLANE,
    ),
    20: (
        "1.10",
        {
            "020/MS": ones(1),
            "140": TOD,
            "041/LAT": degrees(LATITUDE, 180 / 2**25),
            "041/LON": degrees(np.full(N, WEST), 180 / 2**25),
            "090/FL": ones(400),
            "105": ones(1600),  # 6.25 ft: 10 000 ft
            "220": ones(IDENTITY),
        },
        Kind.GEODETIC,
    ),
    21: (
        "2.1",
        {
            "040/ATP": ones(0),
            "073": TOD,
            "131/LAT": degrees(LATITUDE, 180 / 2**30),
            "131/LON": degrees(np.full(N, WEST), 180 / 2**30),
            "080": ones(IDENTITY),
            "140": ones(1600),
            "145": ones(400),
            "090/NUCPNIC": ones(8),
            "090/NACP": ones(9),
            "210/VN": ones(2),
        },
        Kind.GEODETIC,
    ),
    48: (
        "1.32",
        {
            "140": TOD,
            "020/TYP": ones(5),
            "040/RHO": np.round(POLAR["RHO"] * 256).astype(np.int64),
            "040/THETA": ones(POLAR["THETA"]),
            "070/MODE3A": ones(0o1234),
            "090/FL": ones(400),
            "110/3DH": ones(400),
            "220": ones(IDENTITY),
        },
        Kind.POLAR,
    ),
    62: (
        "1.18",
        {
            "070": TOD,
            "040": ones(17),
            "105/LAT": degrees(LATITUDE, 180 / 2**25),
            "105/LON": degrees(np.full(N, WEST), 180 / 2**25),
            "136": ones(400),
        },
        Kind.GEODETIC,
    ),
    11: (
        "1.3",
        {
            "000": ones(1),
            "140": TOD,
            "161/FTN": ones(17),
            "041/LAT": degrees(LATITUDE, 180 / 2**31),
            "041/LON": degrees(np.full(N, WEST), 180 / 2**31),
            "090": ones(400),
        },
        Kind.GEODETIC,
    ),
}
SERVICES = {  # category -> edition, items, beside the reports of a source
    1: (2, "1.2", {"000": ones(1), "030": TOD}),
    20: (19, "1.3", {"000": ones(1), "140": TOD}),
    21: (23, "1.3", {"000": ones(1), "070": TOD}),
    48: (34, "1.29", {"000": ones(1), "030": TOD}),
    62: (65, "1.5", {"000": ones(1), "030": TOD}),
}
ALONE = {  # decoded and counted: category -> edition, items
    4: ("1.13", {"000": ones(3), "020": TOD}),
    15: ("1.2", {"000/MT": ones(1), "145": TOD}),
    16: ("1.0", {"000": ones(1), "140": TOD}),
    63: ("1.7", {"030": TOD}),
    205: ("1.0", {"000": ones(1), "030": TOD}),
}


def data_blocks(category, edition, items):
    """One block for each record."""
    form = layout(category, edition)
    held = {path: Column(values, None, None) for path, values in (SOURCE | items).items()}
    profile = next(iter(form.records))
    whole = blocks(category, encode(form, held, profile=profile), np.arange(N))
    return [whole.data[a:b] for a, b in zip(whole.start[:-1], whole.start[1:], strict=True)]


def recording(path, category):
    edition, items, _ = RECORDINGS[category]
    some = [data_blocks(category, edition, items)]
    if category in SERVICES:
        some.insert(0, data_blocks(*SERVICES[category]))
    path.write_bytes(b"".join(block for together in zip(*some, strict=True) for block in together))
    return path


@pytest.mark.parametrize("category", RECORDINGS)
def test_reports_are_read_as_they_were_written(tmp_path, category):
    got = read([recording(tmp_path / "a.ast", category)], date=datetime.date.fromisoformat(DATE))
    plots, kind = got.plots, RECORDINGS[category][2]
    assert len(plots) == N
    assert (plots.kind == kind).all()
    np.testing.assert_allclose(plots.time % 86400, TIME, atol=1 / 128)
    if category not in (62, 11):
        assert (plots.reason == 0).all()
    if kind == Kind.GEODETIC:
        np.testing.assert_allclose(np.degrees(plots.latitude), LATITUDE, atol=180 / 2**25)
    if kind == Kind.POLAR:
        np.testing.assert_allclose(plots.range, POLAR["RHO"] * 1852.0, atol=1852 / 128)
    if category != 10:
        np.testing.assert_allclose(plots.altitude, HEIGHT_FT * 0.3048)
    heights = {20: Datum.ELLIPSOID, 21: Datum.ELLIPSOID, 48: Datum.MEAN_SEA_LEVEL}
    if category in heights:
        np.testing.assert_allclose(plots.height, HEIGHT_FT * 0.3048)
        assert (plots.datum == heights[category]).all()
    if category == 21:  # NACp 9: 30 m with 95 %; NIC 8: 0.1 NM
        np.testing.assert_allclose(plots.sigma, 30.0 / 2.45)
        np.testing.assert_allclose(plots.containment, 185.2)


@pytest.mark.parametrize("category", [*RECORDINGS, *ALONE])
def test_every_category_is_shown_and_converted(tmp_path, capsys, category):
    path = tmp_path / "a.ast"
    if category in RECORDINGS:
        recording(path, category)
    else:
        path.write_bytes(b"".join(data_blocks(category, *ALONE[category])))
    show_info([path], date=DATE)
    shown = capsys.readouterr().out
    assert f"CAT{category:03d}:20/5" in shown
    assert f"{N}, of these {N if category in RECORDINGS else 0} target reports" in shown
    service = SERVICES[category][0] if category in SERVICES else category
    assert f"CAT{service:03d}:20/5" in shown
    convert_files([path], tmp_path / "a.csv", categories=[category], date=DATE, native=True)
    with (tmp_path / "a.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == N
    assert {(row["category"], row["sac"], row["sic"]) for row in rows} == {(str(category), "20", "5")}
    levels = {1: "I001/090/HGT", 11: "I011/090", 20: "I020/090/FL", 21: "I021/145", 48: "I048/090/FL", 62: "I062/136"}
    if category in levels:
        assert {float(row[levels[category]]) for row in rows} == {100.0}


@pytest.mark.parametrize("category", [1, 10, 20, 21, 48])
def test_sources_are_tracked(tmp_path, category):
    config = tmp_path / "c.toml"
    site = "latitude = 41.0\nlongitude = 2.0\nheight = 0.0\n" if category in (1, 10, 48) else ""
    config.write_text(f"date = {DATE}\n[[sensor]]\nsac = 20\nsic = 5\nperiod = 4.0\nsigma_xy = 20.0\n{site}")
    summary = track_files([recording(tmp_path / "a.ast", category)], tmp_path / "out", config, report=False)
    assert summary["tracks"]["confirmed"] == 1
    rows = pq.read_table(tmp_path / "out" / "tracks.parquet").sort_by("time")
    here = [rows[name].to_numpy()[-1] for name in ("longitude", "latitude")]
    earth = pyproj.Geod(ellps="WGS84")
    if category in (1, 48):  # to the north-east of the site
        slant = POLAR["RHO"][-1] * 1852.0
        truth = earth.fwd(2.0, 41.0, 45.0, np.sqrt(slant**2 - (HEIGHT_FT * 0.3048) ** 2))[:2]
    elif category == 10:
        truth = earth.fwd(2.0, 41.0, np.degrees(np.arctan2(500.0, 1560.0)), np.hypot(500.0, 1560.0))[:2]
    else:
        truth = (WEST, LATITUDE[-1])
    assert earth.inv(*here, *truth)[2] < 60.0  # m, of 30 km flown and more
