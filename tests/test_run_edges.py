"""Runs at the edges: nothing to publish, windows past midnight, cut tables, sources that disagree."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from saltus.errors import DataError, ModelError
from saltus.run import parse_time, track_files
from saltus.tracks.settings import TrackerSettings

START = 1_700_000_000.0 - 1_700_000_000.0 % 86400.0  # midnight


def table(path, times, step=0.001, tail=""):
    rows = [f"{t},{41.0 + step * k},2.0,5000" for k, t in enumerate(times)]
    path.write_text("time,latitude,longitude,altitude_m\n" + "\n".join(rows) + "\n" + tail)
    return path


@pytest.mark.parametrize("n", [1, 2])
def test_a_recording_that_makes_no_track_is_no_failure(tmp_path, n):
    track_files([table(tmp_path / "few.csv", START + 4.0 * np.arange(n))], tmp_path / "out")
    assert pq.read_table(tmp_path / "out/tracks.parquet").num_rows == 0
    assigned = pq.read_table(tmp_path / "out/assignments.parquet")
    assert assigned.num_rows == n
    assert None not in assigned["reason"].to_pylist()


def test_a_time_of_day_past_midnight_is_the_next_days(tmp_path):
    path = table(tmp_path / "night.csv", START + 86400.0 - 600.0 + 4.0 * np.arange(400))
    summary = track_files([path], tmp_path / "out", time_from="23:55", time_to="00:05", report=False)
    assert summary["time_from"] == pytest.approx(START + 86400.0 - 300.0, abs=4.0)
    assert summary["time_to"] == pytest.approx(START + 86400.0 + 300.0, abs=4.0)


def test_an_empty_window_names_the_recordings_span(tmp_path):
    path = table(tmp_path / "day.csv", START + 36000.0 + 4.0 * np.arange(30))
    with pytest.raises(DataError, match=r"the recording lasts from .* 10:00:00 to"):
        track_files([path], tmp_path / "out", time_from="12:00", report=False)
    with pytest.raises(DataError, match=r"--from 10:02 is after --to 10:01: .* 10:02:00 and .* 10:01:00"):
        track_files([path], tmp_path / "out", time_from="10:02", time_to="10:01", report=False)
    with pytest.raises(DataError, match="is no time"):
        parse_time("noon", START)


def test_a_cut_row_costs_only_itself(tmp_path):
    path = table(tmp_path / "cut.csv", START + 4.0 * np.arange(30), tail=f"{START + 121.0},41\n")
    summary = track_files([path], tmp_path / "out", report=False)
    assert summary["reports"]["read"] == 31
    assert summary["reasons"] == {"broken row": 1}
    assert any("row 30: 2 cells where the header has 4" in line for line in summary["problems"])


def test_rows_after_a_ragged_one_keep_their_numbers(tmp_path):
    path = table(tmp_path / "ragged.csv", START + 4.0 * np.arange(30))
    lines = path.read_text().splitlines()
    lines.insert(11, "1,2")
    path.write_text("\n".join(lines) + "\n")
    track_files([path], tmp_path / "out", report=False)
    record = pq.read_table(tmp_path / "out/assignments.parquet")["record"].to_pylist()
    assert sorted(record) == list(range(31))  # each row once, whatever is wrong with it


def test_single_reports_at_regular_times_tell_the_period(tmp_path):
    summary = track_files([table(tmp_path / "boat.csv", START + 2.0 * np.arange(60))], tmp_path / "out", report=False)
    (row,) = summary["noise"].values()
    assert row["update_period_s"] == 2.0
    assert summary["tracks"]["confirmed"] == 1
    assert json.loads((tmp_path / "out/summary.json").read_text())["problems"] == summary["problems"]


def test_a_corrupt_page_names_the_file(tmp_path):
    path = tmp_path / "bad.parquet"
    pq.write_table(pq.read_table(_good(tmp_path)), path)
    content = bytearray(path.read_bytes())
    content[200:600] = b"\xff" * 400
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"bad\.parquet"):
        track_files([path], tmp_path / "out", report=False)


def _good(tmp_path):
    time = START + 4.0 * np.arange(500)
    path = tmp_path / "good.parquet"
    pq.write_table(pa.table({"time": time, "latitude": 41.0 + 1e-3 * time % 1, "longitude": time % 1}), path)
    return path


@pytest.mark.parametrize(
    "setting",
    [{"max_speed": np.inf}, {"outlier_range": -5.0}, {"height_prior": (5e3, -1.0)}, {"sigma_pressure": np.nan}],
)
def test_settings_that_cannot_be_are_refused(setting):
    with pytest.raises(ModelError, match=f"tracker.{next(iter(setting))}.* must be positive and finite"):
        TrackerSettings(**setting)


def test_a_scene_across_180_degrees_is_the_scene_elsewhere(tmp_path, rng):
    noise = 3e-4 * rng.standard_normal((3, 40, 2))

    def tracked(middle, name):
        rows = []
        for j in range(3):
            for k in range(40):
                longitude = (middle + 0.004 * (k - 20) + 0.3 * (j - 1) + noise[j, k, 0] + 180.0) % 360.0 - 180.0
                rows.append(f"{START + 4.0 * k},{20 + 0.1 * j + noise[j, k, 1]:.9f},{longitude:.9f},{0x400000 + j:06x}")
        (tmp_path / f"{name}.csv").write_text("time,latitude,longitude,icao24\n" + "\n".join(rows) + "\n")
        track_files([tmp_path / f"{name}.csv"], tmp_path / name)
        return pq.read_table(tmp_path / name / "tracks.parquet")

    across, elsewhere = tracked(180.0, "across"), tracked(10.0, "elsewhere")
    assert len(set(across["track_id"].to_pylist())) == 3
    moved = (np.array(across["longitude"]) - 170.0 + 180.0) % 360.0 - 180.0
    np.testing.assert_allclose(moved, np.array(elsewhere["longitude"]), atol=1e-7)
    np.testing.assert_allclose(np.array(across["latitude"]), np.array(elsewhere["latitude"]), atol=1e-7)


def test_tables_without_noise_make_their_tracks_and_are_told(tmp_path):
    """Two sources without noise, and the way of a second between them: what a newcomer simulates first."""
    for name, late in (("a", 0.0), ("b", 1.0)):
        rows = [
            f"{START + 4.0 * k + late},{41 + 0.002 * k + 0.1 * j},{2 + 0.003 * k},3000,{0x400000 + j:06x}"
            for j in range(3)
            for k in range(60)
        ]
        (tmp_path / f"{name}.csv").write_text("time,latitude,longitude,altitude_m,icao24\n" + "\n".join(rows) + "\n")
    both = track_files([tmp_path / "a.csv", tmp_path / "b.csv"], tmp_path / "both", report=False)
    assert both["tracks"]["confirmed"] == 3
    assert any("a: its reports scatter by less than 0.01 m" in line for line in both["problems"])
    alone = track_files([tmp_path / "a.csv"], tmp_path / "alone", report=False)
    assert alone["tracks"]["confirmed"] == 3
    assert alone["noise"]["a"]["sigma_xy_m"]["used"] == 0.01
