"""`saltus convert`: every decoded item as Parquet, CSV and JSON lines."""

import json

import numpy as np
import pyarrow.csv as csv
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner

from saltus.cli import main
from saltus.convert.columns import Items
from saltus.io.asterix_write import write_cat048

N = 300


def convert(*arguments):
    return CliRunner().invoke(main, ["convert", *map(str, arguments)])


@pytest.fixture
def radar(tmp_path, rng):
    path = tmp_path / "radar.ast"
    truth = {
        "time_of_day": np.sort(rng.uniform(86390, 86410, N)),  # midnight at 86400
        "range_m": rng.uniform(1e3, 400e3, N),
        "azimuth_rad": rng.uniform(0, 2 * np.pi, N),
        "altitude_m": np.where(rng.random(N) < 0.2, np.nan, rng.uniform(-300, 15000, N)),
        "icao24": np.where(rng.random(N) < 0.3, -1, rng.integers(0, 1 << 24, N)),
        "mode3a": np.where(rng.random(N) < 0.3, -1, rng.integers(0, 4096, N)),
    }
    write_cat048(path, sac=20, sic=129, **truth, north_marker_times=np.arange(86390.0, 86410.0, 4.0))
    return path, truth


def test_every_item_in_si_units(radar):
    path, truth = radar
    out = path.parent / "out.parquet"
    result = convert(path, "-o", out, "--date", "2024-05-01")
    assert result.exit_code == 0, result.output
    assert "333 records (33 of category 34, 300 of category 48)" in result.output
    table = pq.read_table(out)
    plots = table.filter(np.asarray(table["category"]) == 48)
    column = {name: plots[name].to_numpy(zero_copy_only=False) for name in plots.column_names}
    assert np.allclose(column["time"], 19844 * 86400 + truth["time_of_day"], rtol=0, atol=1 / 256 + 1e-9)
    assert np.allclose(column["I048/040/RHO"], truth["range_m"], rtol=0, atol=1852 / 512 + 1e-6)
    assert np.allclose(
        column["I048/040/THETA"] % (2 * np.pi),
        np.round(truth["azimuth_rad"] * 65536 / (2 * np.pi)) % 65536 * (2 * np.pi / 65536),
    )
    assert np.allclose(column["I048/090/FL"], truth["altitude_m"], rtol=0, atol=12.5 * 0.3048 + 1e-6, equal_nan=True)
    codes = [None if v < 0 else f"{v:04o}" for v in truth["mode3a"].tolist()]
    assert plots["I048/070/MODE3A"].to_pylist() == codes
    assert plots["I048/220"].to_pylist() == [None if v < 0 else f"{v:06x}" for v in truth["icao24"].tolist()]
    assert set(column["sac"].tolist()) == {20}
    assert set(column["sic"].tolist()) == {129}
    assert column["record"].tolist() == list(range(N))
    assert np.all(np.diff(table["byte"].to_numpy()) >= 0)  # in the order of the file, categories mixed
    about = table.schema.field("I048/040/RHO").metadata
    assert about == {b"title": b"Measured Position in Polar Co-ordinates", b"unit": b"m"}
    assert "I048/042/X" not in table.column_names  # what no record holds


def test_native_units(radar):
    path, truth = radar
    out = path.parent / "out.parquet"
    assert convert(path, "-o", out, "--native", "--items", "I048/040 090/FL").exit_code == 0
    table = pq.read_table(out)
    assert table.column_names[7:] == ["I048/040/RHO", "I048/040/THETA", "I048/090/FL"]
    assert table.schema.field("I048/090/FL").metadata[b"unit"] == b"FL"
    rho = table["I048/040/RHO"].drop_null().to_numpy()
    assert np.allclose(rho, truth["range_m"] / 1852, rtol=0, atol=1 / 512 + 1e-9)


def test_formats_say_the_same_and_the_same_again(radar):
    path, _ = radar
    names = [path.parent / f"out.{suffix}" for suffix in ("parquet", "csv", "jsonl")]
    for name in names:
        assert convert(path, "-o", name, "--category", 48).exit_code == 0
    before = [name.read_bytes() for name in names]
    for name in names:
        assert convert(path, "-o", name, "--category", 48).exit_code == 0
    assert [name.read_bytes() for name in names] == before
    table = pq.read_table(names[0])
    lines = [json.loads(line) for line in names[2].read_text().splitlines()]
    assert lines == [{k: v for k, v in row.items() if v is not None} for row in table.to_pylist()]
    text = csv.read_csv(
        names[1], convert_options=csv.ConvertOptions(column_types=table.schema, strings_can_be_null=True)
    )
    assert text.to_pydict() == table.to_pydict()


def test_several_files_categories_and_times(radar, tmp_path):
    _, truth = radar
    other = tmp_path / "other.ast"
    write_cat048(other, sac=1, sic=2, time_of_day=[86395.0, 86405.0], range_m=[1e4, 2e4], azimuth_rad=[0.0, 1.0])
    out = tmp_path / "out" / "table.csv"
    arguments = (tmp_path / "*.ast", "-o", out, "--date", "2024-05-01", "--category", 48)
    assert convert(*arguments, "--from", "23:59:55", "--to", "00:00:05").exit_code == 0
    table = csv.read_csv(out)
    assert table["file"].to_pylist() == ["other.ast"] * 2 + ["radar.ast"] * (table.num_rows - 2)
    midnight = 19845 * 86400
    assert midnight - 5 <= min(table["time"].to_pylist()) <= max(table["time"].to_pylist()) <= midnight + 5
    kept = np.abs(truth["time_of_day"] - 86400) <= 5
    assert abs(table.num_rows - 2 - np.count_nonzero(kept)) <= 2  # rounding to 1/128 s at the edges


def test_repeated_fields_are_lists(tmp_path):
    # FSPEC 81 20: 010 and, tenth, 250: two registers of 7 bytes and their numbers, BDS 4,0 and 6,0
    head = bytes.fromhex("81 20 0a0b 02 8000000000000040 c000000000000060".replace(" ", ""))
    (tmp_path / "a.ast").write_bytes(b"\x30" + (3 + len(head)).to_bytes(2, "big") + head)
    for suffix in ("parquet", "csv", "jsonl"):
        assert convert(tmp_path / "a.ast", "-o", tmp_path / f"o.{suffix}", "--items", "250").exit_code == 0
    table = pq.read_table(tmp_path / "o.parquet")
    assert table["I048/250/BDS1"].to_pylist() == [[4, 6]]
    assert table["I048/250/MBDATA"].to_pylist() == [["80000000000000", "c0000000000000"]]
    assert json.loads((tmp_path / "o.jsonl").read_text())["I048/250/BDS1"] == [4, 6]
    assert csv.read_csv(tmp_path / "o.csv")["I048/250/BDS1"].to_pylist() == ["4 6"]


def test_names_of_items():
    assert Items.parse(["040,070/MODE3A", "I062/105  250/5,0/ROLL,250/6,0"]).wanted == (
        (None, "040"),
        (None, "070/MODE3A"),
        (62, "105"),
        (None, "250/5,0/ROLL"),
        (None, "250/6,0"),
    )
    some = Items.parse(["I048/040", "09"])
    assert some.take(48, "040/RHO")
    assert not some.take(62, "040/RHO")
    assert not some.take(48, "090/FL")  # whole names only


def test_what_cannot_be(radar, tmp_path):
    path, _ = radar
    (tmp_path / "t.csv").write_text("time,latitude,longitude\n1,2,3\n")
    (tmp_path / "no.ast").write_bytes(b"\x00" * 50)
    for arguments, text in (
        ((path, "-o", tmp_path / "x.txt"), "x.txt: write to a file that ends in .parquet, .pq, .csv, .jsonl"),
        ((path, "-o", tmp_path / "x.csv", "--category", 62), "category 62 does not occur; there are 34, 48"),
        ((path, "-o", tmp_path / "x.csv", "--items", "999"), "--items 999: no category of these recordings has it"),
        ((tmp_path / "t.csv", "-o", tmp_path / "x.csv"), "is a table already"),
        ((tmp_path / "no.ast", "-o", tmp_path / "x.csv"), "no record could be read"),
        (
            (path, "-o", tmp_path / "x.csv", "--from", "12:00"),
            "outside time window from 1970-01-02 12:00:00: the recording",
        ),
        ((path, "-o", tmp_path / "x.csv", "--framing", "tar"), "framing 'tar' is not known; choose one of plain"),
    ):
        result = convert(*arguments)
        assert result.exit_code == 2, result.output
        assert text in result.output
        assert len(result.output.strip().splitlines()) == 1
        assert not (tmp_path / "x.csv").exists()


def test_pieces_make_one_table(tmp_path, monkeypatch):
    path = tmp_path / "long.ast"
    tod = 80000 + np.arange(20000) / 3.0  # past midnight
    write_cat048(path, sac=1, sic=2, time_of_day=tod, range_m=np.full(20000, 1e4), azimuth_rad=np.zeros(20000))
    assert convert(path, "-o", tmp_path / "one.parquet", "--date", "2024-05-01").exit_code == 0
    monkeypatch.setattr("saltus.io.stream.PIECE", 50_000)
    assert convert(path, "-o", tmp_path / "many.parquet", "--date", "2024-05-01").exit_code == 0
    one, many = pq.read_table(tmp_path / "one.parquet"), pq.read_table(tmp_path / "many.parquet")
    assert one.equals(many)
    assert np.allclose(one["time"].to_numpy(), 19844 * 86400 + tod, rtol=0, atol=1 / 256 + 1e-9)


def test_recordings_as_decoded_by_others(recordings, tmp_path):
    folder = recordings / "bcn_cat048_2023-05-02"
    out = tmp_path / "bcn.parquet"
    assert convert(folder / "bcn_cat048.ast", "-o", out, "--native", "--date", "2023-05-02").exit_code == 0
    ours = pq.read_table(out).sort_by("time")
    theirs = pq.read_table(folder / "bcn_cat048.parquet")
    assert ours.num_rows == theirs.num_rows == 29212
    for name, other, step in (
        ("I048/040/RHO", "rho_nm", 1 / 256),
        ("I048/090/FL", "fl", 0.25),
        ("I048/250/5,0/ROLL", "bds50_roll_deg", 45 / 256),
        ("I048/250/6,0/IAS", "bds60_ias_kt", 1.0),
        ("I048/130/SAM", "sam_dbm", 1.0),
    ):
        a, b = ours[name].to_numpy(), theirs[other].to_numpy(zero_copy_only=False).astype(np.float64)
        a, b = np.sort(a[np.isfinite(a)]), np.sort(b[np.isfinite(b)])
        assert len(a) == len(b), name
        assert np.allclose(a, b, rtol=1e-5, atol=step / 100), name
