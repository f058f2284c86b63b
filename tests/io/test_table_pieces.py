"""Tables are read in pieces of bounded size: the same reports, counts and words as read whole."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from saltus.errors import DataError
from saltus.io import ReadingSettings, read, read_in_order, sheet
from saltus.records import Plots

N = 4000


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch):
    monkeypatch.setattr(sheet, "_BLOCK", 1 << 14)
    monkeypatch.setattr(sheet, "_ROWS", 300)


def rows(n=N):
    """Rows of two sources, a little out of order, some of whose cells cannot be read."""
    rng = np.random.default_rng(3)
    time = 1.7e9 + 0.5 * np.arange(n) + rng.uniform(-2.0, 2.0, n)
    columns = {
        "time": [repr(float(t)) for t in time],
        "latitude": [f"{41 + 1e-5 * k:.6f}" for k in range(n)],
        "longitude": ["2.0" if k % 500 else "far" for k in range(n)],
        "icao24": [f"{0x400000 + k % 7:06x}" if k % 900 else "zz" for k in range(n)],
        "source": [("adsb", "mlat")[k % 2] for k in range(n)],
        "note": ["x" if k % 3 else "" for k in range(n)],
    }
    return columns


def same(path, tmp=None):
    whole = read([path])
    *chunks, last = read_in_order([path])
    assert len(chunks) > 5
    usable = [c.plots.take(c.plots.reason == 0) for c in chunks]
    assert np.all(np.diff(np.concatenate([p.time for p in usable])) >= 0)
    plots = Plots.concat([c.plots for c in chunks], same_files=True)
    order, expected = np.argsort(plots.record), np.argsort(whole.plots.record)
    assert [str(plots.sources[k].system) for k in plots.source[order]] == [
        str(whole.plots.sources[k].system) for k in whole.plots.source[expected]
    ]
    for name in ("record", "time", "reason", "kind", "latitude", "longitude", "icao24"):
        np.testing.assert_array_equal(getattr(plots, name)[order], getattr(whole.plots, name)[expected], err_msg=name)
    lines = {str(c.system): replace(c, update_period=0.0) for c in whole.contents}
    assert {str(c.system): replace(c, update_period=0.0) for c in last.contents} == lines
    assert sorted(last.problems) == sorted(whole.problems)
    return last


def csv(path, columns, *, broken=()):
    lines = [",".join(columns)]
    for k, cells in enumerate(zip(*columns.values(), strict=True)):
        lines.append("1,2" if k in broken else ",".join(cells))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("broken", [(), (0,), (0, 1, 700, 701, 2999, N - 2, N - 1)])
def test_a_table_of_text(tmp_path, broken):
    last = same(csv(tmp_path / "a.csv", rows(), broken=broken))
    assert any("'zz' is no hexadecimal code" in p for p in last.problems)
    if broken:
        assert any(f"row {broken[0]}: 2 cells where the header has 6" in p for p in last.problems)


def test_a_table_of_parquet(tmp_path):
    columns = rows()
    columns["time"] = [float(t) for t in columns["time"]]
    pq.write_table(pa.table(columns), tmp_path / "a.parquet", row_group_size=1000)
    same(tmp_path / "a.parquet")


def test_times_without_an_offset_are_counted_over_all_pieces(tmp_path):
    columns = rows(3000)
    columns["time"] = [f"2024-05-01T00:{k // 60:02d}:{k % 60:02d}" for k in range(3000)]
    last = same(csv(tmp_path / "a.csv", columns))
    assert {note for c in last.contents for note in c.notes} == {"3000 times without an offset are taken as UTC"}


def test_rows_in_any_order_wait_as_long_as_they_must(tmp_path):
    columns = rows()
    halves = {name: [*cells[N // 2 :], *cells[: N // 2]] for name, cells in columns.items()}
    same_path = csv(tmp_path / "a.csv", halves)
    *chunks, _ = read_in_order([same_path])
    time = np.concatenate([c.plots.time[c.plots.reason == 0] for c in chunks])
    assert np.all(np.diff(time) >= 0)
    big = {name: [*cells] * 3 for name, cells in halves.items()}
    big["time"] = [repr(1.7e9 + (7919 * k) % 12_000) for k in range(3 * N)]
    path = csv(tmp_path / "b.csv", big)
    with pytest.raises(DataError, match=r"b\.csv: some of its reports come \d+ s after others .* Sort a table by time"):
        list(read_in_order([path], settings=ReadingSettings(memory=1e6)))


def test_what_is_no_table_of_reports_is_refused_alike(tmp_path):
    for text in ("time,altitude_m\n1,2\n", "time,latitude,longitude\n", "time,latitude,longitude\n1,2\n1,2\n"):
        path = tmp_path / "a.csv"
        path.write_text(text)
        with pytest.raises(DataError) as whole:
            read([path])
        with pytest.raises(DataError) as pieces:
            list(read_in_order([path]))
        assert str(pieces.value) == str(whole.value)
