"""Tables of odd bytes, types and sizes: a DataError with file, row or column, or the cell alone is lost and told."""

import datetime

import frames
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from saltus.errors import DataError
from saltus.io import ReadingSettings, read, sheet
from saltus.records import REASONS

T0 = 1.7e9


def csv(tmp_path, content):
    (tmp_path / "t.csv").write_bytes(content)
    return read([tmp_path / "t.csv"])


def parquet(tmp_path, settings=None, **columns):
    n = len(next(iter(columns.values())))
    whole = {"time": T0 + np.arange(n), "latitude": np.full(n, 41.0), "longitude": np.full(n, 2.0)} | columns
    pq.write_table(pa.table(whole), tmp_path / "t.parquet")
    return read([tmp_path / "t.parquet"], settings=settings)


def test_a_cell_that_is_no_text_costs_itself_alone(tmp_path):
    got = csv(
        tmp_path,
        b"time,latitude,longitude,callsign,icao24\n1,41,2,AB\xff1,40\n2,41,2,\xc3\x89T\xc3\x89,\xff\n\xfe,41,2,OK,40\n",
    )
    assert sorted(got.plots.callsign.tolist()) == ["", "OK", "ÉTÉ"]
    assert sorted(got.plots.icao24.tolist()) == [-1, 0x40, 0x40]
    assert [REASONS[c] for c in got.plots.reason] == ["", "", "no time"]
    assert got.problems == (
        "t.csv: row 2, column 'time': b'\\xfe' is no UTF-8 text.",
        "t.csv: row 1, column 'icao24': b'\\xff' is no UTF-8 text.",
        "t.csv: row 0, column 'callsign': b'AB\\xff1' is no UTF-8 text.",
    )


@pytest.mark.parametrize("as_type", [pa.binary(), pa.large_binary()])
@pytest.mark.parametrize("encoded", [False, True])
def test_text_of_parquet_that_is_no_text(tmp_path, as_type, encoded):
    cells = pa.array([b"KLM\xff", b"KLM1", None, b""], as_type)
    got = parquet(tmp_path, callsign=cells.dictionary_encode() if encoded else cells, icao24=["400000"] * 4)
    assert got.plots.callsign.tolist() == ["", "KLM1", "", ""]
    assert got.problems == ("t.parquet: row 0, column 'callsign': b'KLM\\xff' is no UTF-8 text.",)


def test_a_column_s_name_that_is_no_text(tmp_path):
    with pytest.raises(DataError, match=r"t\.csv: header, column 3: .* is no UTF-8 text; save the table as UTF-8"):
        csv(tmp_path, b"time,latitude,longitude,\xe9cart\n1,41,2,3\n")
    parquet(tmp_path, callsign_=["AAAA"])
    content = (tmp_path / "t.parquet").read_bytes()
    (tmp_path / "t.parquet").write_bytes(content.replace(b"callsign_", b"calls\xff\xff\xff_"))
    with pytest.raises(DataError, match=r"t\.parquet: "):
        read([tmp_path / "t.parquet"])


def test_a_long_cell_beside_a_broken_row(tmp_path):
    long = b"x" * 200_000
    got = csv(tmp_path, b"time,latitude,longitude,callsign\n1,41,2,A\n2,41\n3,41,2," + long + b"\n4,41,2,B\n5,41,2,C\n")
    assert [REASONS[c] for c in got.plots.reason] == ["broken row" if r == 1 else "" for r in got.plots.record]
    assert got.problems[0] == "t.csv: row 1: 2 cells where the header has 4: not used (broken row)."
    assert "row 2, column 'callsign': 'xxx" in got.problems[1] and len(got.problems[1]) < 150


def test_broken_rows_keep_their_number_across_blocks(tmp_path, monkeypatch):
    monkeypatch.setattr(sheet, "_BLOCK", 64)
    rows = [b"%d,41,2,\xff\xfe%d" % (k, k) if k % 7 else b"%d" % k for k in range(100)]
    got = csv(tmp_path, b"time,latitude,longitude,callsign\n" + b"\n\n".join(rows))
    broken = got.plots.record[got.plots.reason == REASONS.index("broken row")]
    assert sorted(broken.tolist()) == list(range(0, 100, 7))
    whole = got.plots.take(got.plots.reason == 0)
    assert np.array_equal(whole.record.astype(float), whole.time)
    monkeypatch.setattr(sheet, "_BLOCK", 32)
    with pytest.raises(DataError, match=r"t\.csv: no readable CSV table: a row is longer than 32 bytes"):
        csv(tmp_path, b'time,latitude,longitude\n1,41,2\n2,41,"2\n' + b"3,41,2\n" * 50)


def test_a_byte_order_mark_is_no_part_of_a_name(tmp_path):
    assert len(csv(tmp_path, b"\xef\xbb\xbftime,latitude,longitude\r\n1,41,2\r\n").plots) == 1


@pytest.mark.parametrize(
    ("column", "cell", "what"),
    [
        ("icao24", b"FFFFFFFFFFFFFFFFF", "no hexadecimal code"),
        ("icao24", b"0x4000", "no hexadecimal code"),
        ("icao24", b"-4", "no hexadecimal code"),
        ("icao24", b"40_00", "no hexadecimal code"),
        ("mode3a", "١٢".encode(), "no octal code"),
        ("mode3a", b"17777", "no octal code"),
        ("altitude_m", b"1_000", "no number"),
        ("altitude_m", b"9" * 5000 + b"x", "no number"),
        ("time", b"2024-13-01", "neither seconds nor ISO 8601"),
        ("callsign", b"ABCDEFGHI", "longer than 8 characters: cut"),
    ],
)
def test_cells_that_are_no_code_or_number(tmp_path, column, cell, what):
    names = ["time", "latitude", "longitude"]
    head = ",".join(dict.fromkeys([*names, column])).encode()
    good = b"1,41,2" + (b"," if column not in names else b"")
    odd = cell + b",41,2" if column == "time" else b"1,41,2," + cell
    got = csv(tmp_path, head + b"\n" + good + b"\n" + odd + b"\n")
    assert any(f"row 1, column '{column}': " in p and p.endswith(f"is {what}.") for p in got.problems), got.problems


def test_columns_of_types_that_mean_nothing_are_refused(tmp_path):
    moment = datetime.datetime(2024, 5, 1, 12)
    for column, cells, said in (
        ("latitude", pa.array([True]), "column 'latitude' is of type bool; it must hold numbers"),
        ("latitude", pa.array([moment]), r"column 'latitude' is of type timestamp\[us\]"),
        ("latitude", pa.array([[41.0]]), "column 'latitude' is of type list"),
        ("latitude", pa.array([{"a": 1}]), "column 'latitude' is of type struct"),
        ("time", pa.array([moment.date()]), r"column 'time' is of type date32"),
        ("time", pa.array([moment.time()]), r"column 'time' is of type time64"),
        ("time", pa.array([datetime.timedelta(1)]), r"column 'time' is of type duration"),
        ("callsign", pa.array([["A"]]), "column 'callsign' is of type list.*text"),
        ("source", pa.array([moment]), "column 'source' is of type timestamp"),
        ("icao24", pa.array([0x400000]), "give hexadecimal digits as text"),
    ):
        with pytest.raises(DataError, match=said):
            parquet(tmp_path, **{column: cells})


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_time_stamps_of_any_unit_are_seconds(tmp_path, unit):
    moments = np.array(["2024-05-01T12:00:00.000", "NaT"], "datetime64[ms]").astype(f"datetime64[{unit}]")
    got = parquet(tmp_path, time=pa.array(moments), icao24=["1", "2"])
    assert got.plots.time[0] == 1714564800.0
    assert np.isnan(got.plots.time[1])
    assert got.contents[0].notes == ("1 times without an offset are taken as UTC",)
    aware = pa.array(moments).cast(pa.timestamp(unit, "Europe/Madrid"))
    assert parquet(tmp_path, time=aware).contents[0].notes == ()


def test_time_stamps_beyond_their_unit_do_not_turn_over(tmp_path):
    with pytest.raises(DataError, match=r"row 0, column 'time'.*cannot be"):
        parquet(tmp_path, time=pa.array([2**62], pa.int64()).cast(pa.timestamp("us")))


def test_a_table_too_large_is_refused_with_its_size(tmp_path):
    small = ReadingSettings(memory=1e6)
    with pytest.raises(DataError, match=r"t\.parquet: 200000 rows: about 0\.14 GB .* 0\.001 GB are allowed"):
        parquet(tmp_path, small, callsign=["A"] * 200_000)
    text = b"time,latitude,longitude\n" + b"1,41,2\n" * 100_000
    (tmp_path / "t.csv").write_bytes(text)
    with pytest.raises(DataError, match=r"t\.csv: more than \d+ rows"):
        read([tmp_path / "t.csv"], settings=small)
    (tmp_path / "t.csv").write_bytes(text + b" " * 1_000_000)
    with pytest.raises(DataError, match=r"t\.csv: the file alone"):
        read([tmp_path / "t.csv"], settings=small)
    (tmp_path / "t.ast").write_bytes(frames.PLOT * 5000)
    with pytest.raises(DataError, match=r"t\.ast: more than 5000 reports: about 0\.00125 GB"):
        read([tmp_path / "t.ast"], settings=small)


def test_long_texts_unpack_once(tmp_path):
    # A text of 1 MB in 4000 rows is 4 GB when each row has its own.
    cells = pa.DictionaryArray.from_arrays(np.zeros(4000, np.int32), ["x" * 1_000_000])
    got = parquet(tmp_path, ReadingSettings(memory=1e7), callsign=cells)
    assert got.plots.callsign[0] == "xxxxxxxx"
    with pytest.raises(DataError, match=r"4000 rows of \d+ bytes"):
        parquet(
            tmp_path,
            ReadingSettings(memory=6e6),
            callsign=[f"{k:01000d}" for k in range(4000)],
            source=[f"{k % 9:02000d}" for k in range(4000)],
            kind=[f"{k:01000d}" for k in range(4000)],
        )


def test_more_sources_than_sensors_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"column 'source' names 1001 sources"):
        parquet(tmp_path, source=[f"A{k}" for k in range(1001)])
