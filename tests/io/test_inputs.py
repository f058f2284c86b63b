"""Directories and patterns as inputs."""

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from frames import NORTH, PLOT, plot

from saltus.errors import DataError
from saltus.io import read
from saltus.io.inputs import expand, left_out


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "b").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / ".hidden").mkdir()
    for name, data in (
        ("a.ast", NORTH + PLOT),
        ("b/c.bin", plot(tod=101.0) * 3),
        ("b/d.csv", b"time,range_m,azimuth_deg\n100,1,2\n"),
        ("README.md", b"# not a recording"),
        ("sensors.toml", b"date = 2024-01-01\n"),
        ("sites.csv", b"name,latitude\nBCN,41\n"),
        (".hidden/x.ast", PLOT),
        ("out/summary.json", b"{}"),
        ("out/tracks.csv", b"time,latitude,longitude\n1,2,3\n"),
        ("empty.ast", b""),
    ):
        (tmp_path / name).write_bytes(data)
    return tmp_path


def test_a_directory_stands_for_its_recordings(folder):
    names = [str(p.relative_to(folder)) for p in expand([folder])]
    assert names == ["a.ast", "b/c.bin", "b/d.csv"]
    assert read([folder / "b", folder / "a.ast"]).plots.files == ("c.bin", "d.csv", "a.ast")


def test_what_a_directory_leaves_out_is_told(folder):
    table = pa.table({"a": [1.0]}).rename_columns(["caf#"])
    pq.write_table(table, folder / "odd.parquet")
    content = (folder / "odd.parquet").read_bytes()
    (folder / "odd.parquet").write_bytes(content.replace(b"caf#", b"caf\xff"))  # a column's name that is no text
    said = read([folder]).problems[:2]
    assert said == tuple(left_out([folder / "a.ast", folder]))
    assert set(said) == {
        f"{folder}: not read, tables without a column time: odd.parquet, sites.csv.",
        f"{folder}: not read, of no format that is known: README.md, empty.ast, sensors.toml.",
    }
    assert left_out([folder / "b"]) == []


def test_patterns(folder):
    assert [p.name for p in expand([folder / "**" / "*.ast"])] == ["a.ast", "empty.ast"]
    assert [p.name for p in expand([folder / "a.ast", folder / "[ab].a?t", folder])] == ["a.ast", "c.bin", "d.csv"]
    odd = folder / "odd[1].ast"
    odd.write_bytes(PLOT)
    assert expand([odd]) == [odd]  # a file of that name goes first


def test_nothing_there(folder, tmp_path):
    with pytest.raises(DataError, match=r"\*\.xyz: no file matches this pattern"):
        expand([folder / "*.xyz"])
    (tmp_path / "void").mkdir()
    with pytest.raises(DataError, match="none of its 0 files is a recording"):
        expand([tmp_path / "void"])
