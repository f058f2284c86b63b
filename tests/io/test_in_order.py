"""Recordings in order of time a chunk at a time: the same reports as `read`, never one before what was given."""

import datetime
from dataclasses import replace

import frames
import numpy as np
import pytest

from saltus.errors import DataError
from saltus.io import ReadingSettings, read, read_in_order, stream
from saltus.io.asterix import index_blocks
from saltus.records import REASONS, Plots

DATE = datetime.date(2024, 5, 1)


def radar(first, n, *, sic=0x81, step=0.1, turn=40):
    """Plots of a radar whose targets stand at one azimuth each and move outward."""
    return [
        frames.plot(
            tod=(first + step * k) % 86400,
            rho=2560 + 4 * (k // turn),
            theta=1600 * (k % turn),
            sic=sic,
            address=0x400000 + k % turn,
        )
        for k in range(n)
    ]


def sorted_rows(plots):
    """Usable reports as rows that can be compared."""
    plots = plots.take(plots.reason == 0)
    systems = np.array([str(s.system) for s in plots.sources])[plots.source]
    files = np.array(plots.files)[plots.file]
    order = np.lexsort((plots.record, systems, files, plots.time))
    columns = ("time", "record", "range", "azimuth", "altitude", "latitude", "mode3a", "icao24", "callsign")
    return [systems[order].tolist(), files[order].tolist(), *(getattr(plots, n)[order].tolist() for n in columns)]


def same(paths, **options):
    """Read both ways; return the chunks and what `read` gives."""
    *chunks, last = read_in_order(paths, **options)
    whole = read(paths, **options)
    usable = [c.plots.take(c.plots.reason == 0) for c in chunks]
    time = np.concatenate([p.time for p in usable])
    assert np.all(np.diff(time) >= 0)
    plots = Plots.concat([c.plots for c in chunks], same_files=True)
    np.testing.assert_equal(sorted_rows(plots), sorted_rows(whole.plots))
    assert np.bincount(plots.reason).tolist() == np.bincount(whole.plots.reason).tolist()
    assert not len(last.plots)
    lines = [replace(c, update_period=0.0) for c in last.contents]
    assert lines == [replace(c, update_period=0.0) for c in whole.contents]
    return chunks, last, whole


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch):
    monkeypatch.setattr(stream, "PIECE", 1 << 14)


def test_one_recording_in_order(tmp_path):
    path = tmp_path / "a.ast"
    path.write_bytes(b"".join(radar(86000, 30_000)))
    _, last, whole = same([path], date=DATE)
    assert last.problems == whole.problems == ()
    assert last.files == whole.files


def test_several_files_are_merged_and_one_begins_after_midnight(tmp_path):
    for name, first, sic in (("a", 86000, 1), ("b", 86390, 2), ("c", 100, 3)):
        (tmp_path / f"{name}.ast").write_bytes(b"".join(radar(first, 9000, sic=sic)))
    table = "time,latitude,longitude\n" + "".join(f"{1714600000 + 7 * k},41.0{k % 9},2\n" for k in range(200))
    (tmp_path / "d.csv").write_text(table)
    _, last, whole = same(sorted(tmp_path.iterdir()), date=DATE)
    assert any("put on the next day" in p for p in last.problems)
    assert sorted(last.problems) == sorted(whole.problems)


def joined():
    """Three hours of a radar, the last recorded first, in the order 3, 1, 2."""
    hours = [b"".join(radar(36_000 + 1000 * h, 9000)) for h in range(3)]
    return hours[2] + hours[0] + hours[1]


def test_recordings_joined_out_of_order_are_read_in_order(tmp_path):
    path = tmp_path / "a.ast"
    path.write_bytes(joined())
    _, last, whole = same([path], date=DATE)
    assert len(whole.plots) == 27_000
    assert last.files[0].order == whole.files[0].order
    assert last.files[0].order == (f"from byte {9000 * 31} on older than what is before, by 2900 s",)


def test_a_capture_joined_out_of_order(tmp_path):
    path = tmp_path / "a.pcap"
    blocks = radar(36_000, 20_000)
    first = frames.capture(blocks[10_000:], start=1_714_558_600, step=0.1)
    path.write_bytes(first + frames.capture(blocks[:10_000], start=1_714_557_600, step=0.1))
    chunks, last, whole = same([path])
    assert whole.plots.time[0] == 1_714_521_600 + 36_000
    assert len(last.files[0].order) == 1
    assert max(len(c.plots) for c in chunks) < 8_000  # what the change of capture is judged by, not half the recording


def together(path, late):
    """A capture of two radars, the reports of one recorded so many seconds after those of the other."""
    pairs = zip(radar(36_000, 9000, sic=1), radar(36_000 - late, 9000, sic=2), strict=True)
    path.write_bytes(frames.capture([block for pair in pairs for block in pair], start=1_714_557_600, step=0.05))


def test_blocks_of_one_sensor_lag(tmp_path):
    """Nothing is lost and nothing waits longer than it must: 40 s are 400 reports of each radar."""
    path = tmp_path / "a.pcap"
    together(path, 40)
    _, last, whole = same([path])
    assert (whole.plots.reason == 0).all()
    assert last.files[0].order == ("blocks of some sources come up to 40.0 s after those of others",)
    tight = ReadingSettings(memory=1e6)  # 4000 reports may wait
    assert sum(len(c.plots) for c in read_in_order([path], settings=tight)) == 18_000
    together(path, 3000)
    with pytest.raises(DataError, match=r"come 3000 s after others of a later time: \d+ reports wait"):
        list(read_in_order([path], settings=tight))


def test_a_doubled_recording_is_duplicates(tmp_path):
    path = tmp_path / "a.ast"
    path.write_bytes(b"".join(radar(36_000, 3000)) * 2)
    chunks, _, _ = same([path], date=DATE)
    reasons = np.concatenate([c.plots.reason for c in chunks])
    assert np.count_nonzero(reasons == REASONS.index("duplicate")) == 3000


def test_a_late_and_a_wild_report_are_rejected(tmp_path):
    path = tmp_path / "a.ast"
    good = radar(36_000, 9000)
    good[4000] = frames.plot(tod=36_400 - 30)
    good[6000] = frames.plot(tod=80_000)
    path.write_bytes(b"".join(good))
    _, last, _ = same([path], date=DATE)
    assert last.contents[0].rejected == {"out of order": 1, "clock jump": 1}


def test_the_index_tells_where_blocks_are_and_when(tmp_path):
    path = tmp_path / "a.ast"
    path.write_bytes(frames.NORTH.replace(bytes.fromhex("003200"), bytes.fromhex("465000")) + joined())
    index = index_blocks(path, date=DATE)
    assert len(index) == 27_001
    assert index.category.tolist() == [34] + [48] * 27_000
    assert index.length.tolist() == [12] + [31] * 27_000
    assert index.at[:3].tolist() == [0, 12, 43]
    assert set(index.source.tolist()) == {0x1481}
    assert index.time[0] - 1_714_521_600 == 36_000.0
    assert [s.start for s in index.stretches()] == [0, 9001]


def test_a_block_without_a_record_that_is_understood_has_no_time(tmp_path):
    path = tmp_path / "a.ast"
    path.write_bytes(frames.PLOT * 20 + bytes.fromhex("300005 8001") + frames.PLOT * 3)
    index = index_blocks(path)
    assert np.isnan(index.time).tolist() == [False] * 20 + [True] + [False] * 3
    (tmp_path / "b.csv").write_text("time,latitude,longitude\n1,2,3\n")
    with pytest.raises(DataError, match="no input given"):
        next(read_in_order([]))


RECORDED = (
    "lebl_2016-05-10/smr.ast",
    "lebl_2016-05-10/mlat.ast",
    "bcn_cat048_2023-05-02/bcn_cat048.ast",
    "argentina_2026-04-29/radar_226_232.pcap",
    "argentina_2026-04-29/cat062_226_2.pcap",
    "asterix_small/adsb_v21_bcn.ast",
    "asterix_small/spain_multiradar_8s.gps",
    "asterix_small/croatia_cat034_048.pcap",
)


@pytest.mark.parametrize("name", RECORDED)
def test_recordings_of_real_sensors(recordings, name):
    path = recordings / name
    whole = read([path])
    *chunks, last = read_in_order([path])
    reasons = np.concatenate([c.plots.reason for c in chunks])
    assert np.bincount(reasons).tolist() == np.bincount(whole.plots.reason).tolist()
    time = np.concatenate([c.plots.time[c.plots.reason == 0] for c in chunks])
    np.testing.assert_array_equal(time, whole.plots.time[whole.plots.reason == 0])
    assert sorted(last.problems) == sorted(whole.problems)
    tracks = [c.tracks.num_rows for c in chunks if c.tracks is not None]
    assert sum(tracks) == (0 if whole.tracks is None else whole.tracks.num_rows)
