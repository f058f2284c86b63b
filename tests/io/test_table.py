"""Tables as CSV and Parquet: documented columns, and messages with row and column."""

import datetime

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyproj
import pytest

from saltus.errors import DataError
from saltus.io import read
from saltus.records import REASONS, Kind, Traits

NOON = datetime.datetime(2024, 5, 1, 12, tzinfo=datetime.UTC).timestamp()


def csv(tmp_path, text):
    (tmp_path / "t.csv").write_text(text)
    return read([tmp_path / "t.csv"])


def parquet(tmp_path, **columns):
    pq.write_table(pa.table(columns), tmp_path / "t.parquet")
    return read([tmp_path / "t.parquet"])


def reasons(got):
    return {int(r): REASONS[c] for r, c in zip(got.plots.record, got.plots.reason, strict=True)}


def test_polar_csv(tmp_path):
    got = csv(
        tmp_path,
        "time,range_m,azimuth_deg,altitude_m,icao24,mode3a,callsign,on_ground,source\n"
        "2024-05-01T12:00:00Z,1000,90,3048,3c6444,1234,DLH1,false,A\n"
        "2024-05-01 14:00:01+02:00,2000,270,,,,,,B\n",
    )
    p = got.plots
    assert p.time.tolist() == [NOON, NOON + 1]
    assert p.range.tolist() == [1000.0, 2000.0]
    np.testing.assert_allclose(p.azimuth, [np.pi / 2, 3 * np.pi / 2], rtol=1e-15)
    assert (p.icao24.tolist(), p.mode3a.tolist()) == ([0x3C6444, -1], [0o1234, -1])
    assert (p.callsign.tolist(), p.on_ground.tolist()) == (["DLH1", ""], [0, -1])
    assert [s.system.name for s in p.sources] == ["A", "B"]
    assert got.problems == ()
    assert [c.n_reports for c in got.contents] == [1, 1]


def test_a_table_in_which_a_container_of_asterix_could_be_seen_is_a_table(tmp_path):
    """Bearings between positions in time order; the digits of many read as lengths of blocks."""
    rng = np.random.default_rng(1)
    rows = []
    for i in range(6):
        p, v = 25e3 * np.array([np.sin(i + 0.3), np.cos(i + 0.3)]), 120 * np.array([np.sin(i + 0.9), np.cos(i + 0.9)])
        for k in range(400):
            q = p + v * k
            r, az = np.hypot(*q), np.degrees(np.arctan2(*q))
            if k % 4 == i % 4:
                rows.append(f"{1.7e9 + k + 0.01 * i:.3f},radar,polar,{r + 30 * rng.normal():.2f},{az % 360:.5f}")
            if k % 2 == 0:
                rows.append(f"{1.7e9 + k + 0.5:.3f},cam,bearing,,{(az + 0.5 * rng.normal()) % 360:.5f}")
    got = csv(tmp_path, "\n".join(["time,source,kind,range_m,azimuth_deg", *sorted(rows)]) + "\n")
    assert len(got.plots) == len(rows)


def test_a_source_that_measures_range_turns_round(tmp_path):
    got = csv(tmp_path, "time,range_m,azimuth_deg,source\n1,1000,90,radar\n1,,90,camera\n")
    assert [(s.system.name, s.traits) for s in got.plots.sources] == [
        ("camera", Traits(pooled=True)),
        ("radar", Traits(pooled=True, rotating=True)),
    ]


def test_each_row_takes_the_position_it_has(tmp_path):
    got = csv(tmp_path, "time,x_m,y_m,lat,lon\n1e9,1,2,,\n1000000001,,,41,2\n1000000002,,,,\n1000000003,1,,,\n")
    assert got.plots.kind.tolist() == [Kind.PLANE, Kind.GEODETIC, Kind.NONE, Kind.PLANE]
    assert reasons(got) == {0: "", 1: "", 2: "no position", 3: "not a number"}


def test_float32_becomes_float64_before_anything(tmp_path):
    degrees = np.array([41.30069956], np.float32)
    got = parquet(
        tmp_path,
        time=np.array([NOON]),
        latitude=degrees,
        longitude=degrees,
        altitude_m=np.array([1000.1], np.float32),
    )
    assert got.plots.latitude.dtype == np.float64
    assert got.plots.latitude[0] == np.float64(degrees[0]) * (np.pi / 180)


def test_parquet_types(tmp_path):
    got = parquet(
        tmp_path,
        time=pa.array([datetime.datetime(2024, 5, 1, 12, 0, 0, 500000)], pa.timestamp("ms")),
        latitude=pa.array([41], pa.int16()),
        longitude=pa.array([2.0]),
        onground=pa.array([True]),
        icao24=pa.array(["abcdef"]).dictionary_encode(),
        extra=pa.array([1]),
    )
    assert got.plots.time[0] == NOON + 0.5
    assert (got.plots.on_ground[0], got.plots.icao24[0]) == (1, 0xABCDEF)
    assert got.contents[0].notes == ("1 times without an offset are taken as UTC",)
    assert got.problems == ("t.parquet: columns not used: extra (1 values).",)


def test_rows_in_any_order(tmp_path):
    got = csv(tmp_path, "time,x_m,y_m\n1000000100,1,1\n1000000000,2,2\n1000000050,3,3\n")
    assert got.plots.record.tolist() == [1, 2, 0]
    assert np.all(got.plots.reason == 0)


def test_bad_cells_name_row_and_column_and_the_rest_is_kept(tmp_path):
    got = csv(
        tmp_path,
        "time,latitude,longitude,altitude_m,icao24,mode3a,on_ground\n"
        "1000000000,41,2,100,zzz,8888,maybe\n"
        "yesterday,41,2,100,,,\n"
        "1000000002,north,2,100,,,\n"
        "1000000003,413,2,100,,,\n"
        "1000000004,41,2,1e6,,,\n"
        "1000000005,nan,2,100,,,\n"
        "1000000006,41,inf,100,,,\n"
        "1000000007,41,2,100,,,\n"
        "1000000008,41,2.1,100,,,\n"
        "1000000009,41,2.1,100,,,\n",
    )
    assert reasons(got) == {
        0: "",
        1: "no time",
        2: "not a number",
        3: "out of range",
        4: "out of range",
        5: "not a number",
        6: "out of range",
        7: "",
        8: "",
        9: "",
    }
    text = "\n".join(got.problems)
    for part in (
        "t.csv: row 0, column 'icao24': 'zzz' is no hexadecimal code",
        "t.csv: row 0, column 'mode3a': '8888' is no octal code",
        "t.csv: row 0, column 'on_ground': 'maybe'",
        "t.csv: row 1, column 'time': 'yesterday'",
        "t.csv: row 2, column 'latitude': 'north' is no number",
        "t.csv: row 3, column 'latitude': '413' is out of range",
        "t.csv: row 4, column 'altitude_m': '1e+06' is out of range",
    ):
        assert part in text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "t.csv: byte 0: the file is empty"),
        ("time,x_m,y_m\n", "has columns and no row"),
        ("x_m,y_m\n1,2\n", "no column for time"),
        ("time;x_m;y_m\n1,5;1,0;2,0\n", "t.csv: semicolons separate the columns. Separate them by commas"),
        ("time\tx_m\ty_m\n1\t1\t2\n", "t.csv: tabs separate the columns"),
        ("time,range_m\n1,2\n", "no column for a position: range_m and azimuth_deg"),
        ("time,x_m,y_m\n1000,1\n", "no readable CSV"),
        ("time,x_m,x_m,y_m\n1,1,1,1\n", "column 'x_m' occurs 2 times"),
        ("time,range_m,azimuth_deg\n1e9,1,5000\n", r"row 0, column 'azimuth_deg': 5000 cannot be.*degrees"),
        ("time,x_m,y_m,observer_x_m,observer_y_m\n1e9,1,2,3,4\n", "'observer_x_m' needs 'origin_latitude' beside it"),
        ("time,x_m,y_m,origin_latitude\n1e9,1,2,3\n", "'origin_latitude' needs 'origin_longitude' beside it"),
        ("time,x_m,y_m,observer_latitude,observer_longitude\n1e9,1,2,4.1e6,0\n", "column 'observer_latitude'.*degrees"),
        ("time,x_m,y_m,range_rate_mps\n1e9,1,2,1e6\n", "column 'range_rate_mps'.*is it in m/s"),
        ("time,latitude,longitude\n1e9,4.1e6,2\n", r"row 0, column 'latitude': 4\.1e\+06 cannot be"),
        ("time,x_m,y_m\n1714564800000,1,2\n", r"column 'time': .*milliseconds"),
    ],
)
def test_tables_that_cannot_be_used(tmp_path, text, message):
    with pytest.raises(DataError, match=message):
        csv(tmp_path, text)


def test_broken_rows_are_counted_with_the_source_before(tmp_path):
    rows = [
        "1000000000,1,2,A",
        "",
        "1000000001,3,4,B",
        "1000000002,5",
        "1000000003,5,6,7,C",
        "1000000004,8,9,A",
        "x,1,1,B",
    ]
    got = csv(tmp_path, "\n".join(["time,x_m,y_m,source", *rows]) + "\n")
    assert reasons(got) == {0: "", 1: "", 2: "broken row", 3: "broken row", 4: "", 5: "no time"}
    assert [(c.system.name, c.n_reports, c.rejected) for c in got.contents] == [
        ("A", 2, {}),
        ("B", 4, {"no time": 1, "broken row": 2}),
    ]
    assert got.contents[1].time_from == got.contents[1].time_to == 1000000001.0
    assert got.problems == (
        "t.csv: row 2: 2 cells where the header has 4, and 1 more such rows: not used (broken row).",
        "t.csv: row 5, column 'time': 'x' is neither seconds nor ISO 8601.",
    )


def test_parquet_that_cannot_be_used(tmp_path):
    (tmp_path / "t.parquet").write_bytes(b"PAR1 and nothing else")
    with pytest.raises(DataError, match=r"t\.parquet: no readable Parquet"):
        read([tmp_path / "t.parquet"])
    with pytest.raises(DataError, match="give octal digits as text"):
        parquet(tmp_path, time=[1e9], x_m=[1.0], y_m=[1.0], mode3a=[1200])


def test_an_observer_in_degrees(tmp_path):
    got = csv(
        tmp_path,
        "time,range_m,azimuth_deg,heading_deg,observer_latitude,observer_longitude,observer_height_m\n"
        "1000000000,50,350,30,63.4,10.4,40\n"
        "1000000001,50,350,,63.4,10.4,\n"
        "1000000002,50,350,30,,10.4,40\n",
    )
    p = got.plots
    np.testing.assert_allclose(np.degrees(p.azimuth), [20.0, 350.0, 20.0], rtol=1e-14)  # from the bow, from north
    np.testing.assert_allclose(np.degrees(p.observer_latitude), [63.4, 63.4, np.nan], rtol=1e-14)
    np.testing.assert_array_equal(p.observer_height, [40.0, 0.0, np.nan])
    assert got.problems == ()
    assert got.contents[0].notes == ()


def test_an_observer_in_a_frame_of_its_own(tmp_path):
    # PROJ's topocentric conversion is the oracle.
    got = csv(
        tmp_path,
        "time,x_m,y_m,z_m,observer_x_m,observer_y_m,origin_latitude,origin_longitude,origin_height_m\n"
        "1000000000,1,2,3,4000,-9000,63.4,10.4,40\n"
        "1000000001,1,2,,,,63.4,10.4,40\n",
    )
    to_geodetic = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0=63.4 +lon_0=10.4 +h_0=40 "
        "+step +inv +proj=cart +ellps=WGS84"
    )
    lon, lat, height = to_geodetic.transform(4000.0, -9000.0, 0.0)
    p = got.plots
    np.testing.assert_allclose(np.degrees([p.observer_longitude[0], p.observer_latitude[0]]), [lon, lat], rtol=1e-12)
    assert p.observer_height[0] == pytest.approx(height, abs=1e-6)
    assert np.isnan(p.observer_latitude[1])  # a row whose observer is unknown is not at the origin
    assert (p.x[0], p.y[0], p.z[0]) == (1.0, 2.0, 3.0)


def test_the_origin_alone_is_the_observer(tmp_path):
    got = csv(tmp_path, "time,x_m,y_m,origin_latitude,origin_longitude\n1e9,1,2,63.4,10.4\n1000000001,2,2,,\n")
    np.testing.assert_allclose(np.degrees(got.plots.observer_latitude), [63.4, np.nan], rtol=1e-14)


def test_kinds_stated_and_bearings(tmp_path):
    got = csv(
        tmp_path,
        "time,kind,range_m,azimuth_deg,x_m,y_m\n"
        "1000000000,,50,10,1,2\n"
        "1000000001,plane,50,10,1,2\n"
        "1000000002,Bearing,50,10,1,2\n"
        "1000000003,,,10,,\n"
        "1000000004,polar,,10,1,2\n"
        "1000000005,sonar,50,10,,\n",
    )
    polar, plane, bearing = Kind.POLAR, Kind.PLANE, Kind.BEARING
    assert got.plots.kind.tolist() == [polar, plane, bearing, bearing, polar, polar]
    found = reasons(got)
    assert [found[k] for k in (2, 3, 4)] == ["", "", "not a number"]
    assert "row 5, column 'kind': 'sonar' is no kind" in got.problems[0]
    assert "row 3: no range_m" in got.problems[1]


def test_a_range_that_is_no_number_makes_no_bearing_of_a_radar_plot(tmp_path):
    rows = ["50,10,A", "NaN,11,A", "far,12,A", "inf,13,A", ",14,A", ",15,A", ",16,camera", "nan,17,camera"]
    got = csv(tmp_path, "time,range_m,azimuth_deg,source\n" + "".join(f"{10**9 + k},{r}\n" for k, r in enumerate(rows)))
    assert reasons(got) == {
        **dict.fromkeys(range(8), ""),
        **{1: "not a number", 2: "not a number", 3: "out of range"},
    }
    assert got.plots.kind.tolist() == [Kind.POLAR] * 4 + [Kind.BEARING] * 4
    told = "t.csv: row 4: no range_m, where its source tells ranges elsewhere; 2 such rows are taken as bearings alone."
    assert told in got.problems
    got = parquet(
        tmp_path,
        time=1e9 + np.arange(4.0),
        range_m=pa.array([50.0, float("nan"), None, None]),
        azimuth_deg=np.arange(4.0),
        kind=[None, None, None, "bearing"],
    )
    assert reasons(got) == {0: "", 1: "not a number", 2: "", 3: ""}
    assert "row 2: no range_m" in got.problems[0] and "1 such rows" in got.problems[0]


def test_an_impossible_heading_costs_the_azimuth(tmp_path):
    rows = "".join(f"{1000000000 + k},50,10,{9000 if k == 1 else 30}\n" for k in range(4))
    got = csv(tmp_path, "time,range_m,azimuth_deg,heading_deg\n" + rows)
    assert reasons(got) == {0: "", 1: "not a number", 2: "", 3: ""}
    assert "row 1, column 'heading_deg': '9000' is out of range" in got.problems[0]


def test_scans_of_one_time_tell_the_update_period(tmp_path):
    # Three detections a scan, one scan in four empty: the median of the steps is the period.
    times = [1e9 + 0.5 * k for k in range(40) if k % 4 for _ in range(3)]
    got = csv(tmp_path, "time,x_m,y_m\n" + "".join(f"{t},{k},1\n" for k, t in enumerate(times)))
    assert got.contents[0].update_period == 0.5
    got = csv(tmp_path, "time,x_m,y_m\n" + "".join(f"{1e9 + 0.01 * k},{k},1\n" for k in range(50)))
    assert np.isnan(got.contents[0].update_period)


def test_nothing_and_directories(tmp_path):
    with pytest.raises(DataError, match="no input given"):
        read([])
    with pytest.raises(DataError, match="none of its 0 files is a recording"):
        read([tmp_path])


def test_opensky_tables(recordings):
    got = read([recordings / "adsb_opensky" / "switzerland.parquet"])
    assert len(got.plots) == 97873
    assert np.all(got.plots.reason == 0)
    assert got.contents[0].update_period == pytest.approx(10.0, abs=1.0)
