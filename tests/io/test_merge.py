"""Reports that cannot be plots: marked with a reason, counted, and the others in time order."""

import datetime
import random

import numpy as np
import pytest
from frames import PLOT, plot

from saltus.io import read
from saltus.records import REASONS

DAY = datetime.date(2024, 5, 1)
MIDNIGHT = datetime.datetime(2024, 5, 1, tzinfo=datetime.UTC).timestamp()


def load(tmp_path, frames, name="a.ast"):
    (tmp_path / name).write_bytes(b"".join(frames))
    return read([tmp_path / name], date=DAY)


def by_record(got):
    return {int(r): REASONS[c] for r, c in zip(got.plots.record, got.plots.reason, strict=True)}


def scan(*tods, start=0):
    """Plots that differ in azimuth, so that no two are the same."""
    return [plot(tod=t, theta=start + k) for k, t in enumerate(tods)]


def test_sorted_within_the_window_rejected_beyond(tmp_path):
    tods = [10.0, 11.0, 10.5, 12.0, 13.0, 10.0, 14.0]
    got = load(tmp_path, scan(*tods))
    assert np.all(np.diff(got.plots.time) >= 0)
    assert by_record(got) == {**dict.fromkeys(range(7), ""), 5: "out of order"}
    assert got.contents[0].rejected == {"out of order": 1}


def test_a_wild_time_is_a_jump(tmp_path):
    tods = list(np.arange(100.0, 120.0))
    tods[7] = 40000.0
    got = load(tmp_path, scan(*tods))
    assert by_record(got)[7] == "clock jump"
    assert got.contents[0].rejected == {"clock jump": 1}
    assert got.contents[0].time_to == MIDNIGHT + 119.0


def test_a_clock_set_back_is_told_with_its_record(tmp_path):
    tods = [*np.arange(1000.0, 1060.0), *np.arange(950.0, 980.0)]
    got = load(tmp_path, scan(*tods))
    assert by_record(got) == dict.fromkeys(range(90), "")
    assert "record 60 of CAT048:20/129: the clock steps back by 109.000 s" in got.problems[0]


def test_midnight_between_sources_and_files(tmp_path):
    (tmp_path / "a.ast").write_bytes(b"".join(scan(86399.0, 86399.5, 0.5, 1.0)))
    (tmp_path / "b.ast").write_bytes(b"".join(scan(0.25, 0.75, start=9)))
    got = read([tmp_path / "a.ast", tmp_path / "b.ast"], date=DAY)
    assert (got.plots.time - MIDNIGHT - 86400).tolist() == [-1.0, -0.5, 0.25, 0.5, 0.75, 1.0]
    assert "b.ast: begins after the midnight" in got.problems[0]
    alone = read([tmp_path / "b.ast"], date=DAY)
    assert (alone.plots.time - MIDNIGHT).tolist() == [0.25, 0.75]


def test_duplicates_keep_the_first(tmp_path):
    got = load(tmp_path, [PLOT, PLOT, plot(theta=0x4001), plot(tod=100.5 + 1 / 128), PLOT])
    assert by_record(got) == {0: "", 1: "duplicate", 2: "", 3: "", 4: "duplicate"}


def test_a_file_given_twice_counts_once(tmp_path):
    frames = scan(*np.arange(100.0, 150.0))
    (tmp_path / "a.ast").write_bytes(b"".join(frames + frames))
    got = read([tmp_path / "a.ast"], date=DAY)
    assert got.contents[0].rejected == {"duplicate": 50}
    assert not got.problems
    (tmp_path / "b.ast").write_bytes(b"".join(frames))
    twice = read([tmp_path / "b.ast", tmp_path / "b.ast"], date=DAY)
    assert [c.rejected for c in twice.contents] == [{}, {"duplicate": 50}]


def test_a_recording_doubled_is_as_one(tmp_path):
    tods = np.arange(100.0, 400.0)
    frames = [plot(tod=t, theta=k, kind="00" if k % 5 == 2 else "a0") for k, t in enumerate(tods)]
    once = load(tmp_path, frames)
    twice = load(tmp_path, frames + frames)
    usable = twice.plots.take(twice.plots.reason == 0)
    assert usable.record.tolist() == once.plots.take(once.plots.reason == 0).record.tolist()
    assert twice.contents[0].rejected == {"coasted by station": 120, "duplicate": 240}
    assert once.problems == twice.problems == ()


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (plot(rho=0), "out of range"),
        (plot(level="2000"), "out of range"),  # -8192 quarters
        (plot(level="1fff"), "out of range"),  # FL 2047.75 = 62 km
    ],
)
def test_values_that_cannot_be(tmp_path, frame, reason):
    assert by_record(load(tmp_path, [frame])) == {0: reason}


def test_no_position_and_no_time(tmp_path):
    # FSPEC 010 140 020: e0; 010 020 040: b0
    no_position = bytes.fromhex("30 000a e0 1481 003240 a0")
    no_time = bytes.fromhex("30 000b b0 1481 a0 0a004000")
    got = load(tmp_path, [no_position, no_time, PLOT])
    assert by_record(got) == {0: "no position", 1: "no time", 2: ""}
    assert got.plots.time[-1] != got.plots.time[-1]  # without time they stand last


def test_every_report_is_counted_once(tmp_path):
    draw = random.Random(3)
    frames = [
        plot(tod=100 + k / 10 + draw.choice([0, 0, 0, 300, -50]), kind=draw.choice(["a0", "00", "b0"]), theta=k)
        for k in range(300)
    ]
    got = load(tmp_path, frames + frames[:20])
    (line,) = got.contents
    assert len(got.plots) == line.n_reports == 320
    assert sorted(got.plots.record.tolist()) == list(range(320))
    assert sum(line.rejected.values()) == np.count_nonzero(got.plots.reason)


def test_an_impossible_time_of_day_is_counted_by_its_reason(tmp_path):
    none = plot(tod=30.0).replace((30 * 128).to_bytes(3, "big"), b"\xff\xff\xff")
    got = load(tmp_path, [*scan(*(10.0 + np.arange(30))), none])
    assert [REASONS[c] for c in got.plots.reason[got.plots.reason > 0]] == ["impossible time of day"]
    assert got.contents[0].rejected == {"impossible time of day": 1}
    assert got.contents[0].time_to == MIDNIGHT + 39.0
