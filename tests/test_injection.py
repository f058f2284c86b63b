"""Faults put into plots, the references they are judged by, and the study as a whole."""

import json
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner

from saltus.cli import main
from saltus.errors import DataError
from saltus.evaluate.plots import Followed, Motion, downlinked, from_run, simulated
from saltus.evaluate.reference import make_reference
from saltus.injection import command
from saltus.injection.figures import RUNS, errors, found, growth
from saltus.injection.plots import AZIMUTH, RANGE, inject
from saltus.records import Kind, Plots, Source, System

KNOT = 1852.0 / 3600.0


def radar_plots(rng, n=20_000, **columns):
    common = {
        "time": np.arange(n) / 128.0,
        "source": np.zeros(n),
        "kind": np.full(n, Kind.POLAR),
        "range": rng.uniform(100.0, 100e3, n),
        "azimuth": rng.uniform(0.0, 2 * np.pi, n),
    }
    return Plots.build(n, (Source(System(48, 1, 2)),), ("x",), common | columns)


def test_faults_are_what_was_asked_for(rng):
    k = np.arange(20_000)
    plots = radar_plots(rng, reason=k < 1000, kind=np.where((k >= 1000) & (k < 2000), Kind.GEODETIC, Kind.POLAR))
    faulty = inject(plots, 0.02, np.random.default_rng(1))
    n, hit = 18_000, faulty.fault > 0
    assert not hit[:2000].any()
    assert abs(hit.sum() - 0.02 * n) < 5 * np.sqrt(n * 0.02 * 0.98)
    turned, moved = faulty.fault == AZIMUTH, faulty.fault == RANGE
    assert 0.35 < turned[hit].mean() < 0.65
    angle = np.degrees((faulty.plots.azimuth - plots.azimuth + np.pi) % (2 * np.pi) - np.pi)
    np.testing.assert_allclose(np.abs(angle[turned]), 1.0, rtol=1e-9)
    np.testing.assert_allclose(np.abs((faulty.plots.range - plots.range)[moved]), 926.0, rtol=1e-9)
    assert set(np.sign(angle[turned])) == set(np.sign((faulty.plots.range - plots.range)[moved])) == {-1.0, 1.0}
    np.testing.assert_array_equal(faulty.plots.azimuth[~turned], plots.azimuth[~turned])
    np.testing.assert_array_equal(faulty.plots.range[~moved], plots.range[~moved])
    assert (faulty.plots.range > 0).all() and (faulty.plots.azimuth >= 0).all()
    again = inject(plots, 0.02, np.random.default_rng(1))
    np.testing.assert_array_equal(again.plots.azimuth, faulty.plots.azimuth)


def test_a_recording_without_radar_plots_is_refused(rng):
    with pytest.raises(DataError, match="no usable radar plot"):
        inject(radar_plots(rng, 10, kind=np.full(10, Kind.GEODETIC)), 0.02, rng)


def test_downlinked_data_are_found_by_time_range_and_azimuth(rng, tmp_path):
    plots = radar_plots(rng, 50, range=np.arange(1, 51) * 1852.0, azimuth=np.arange(50) * 2 * np.pi / 64)
    order = rng.permutation(50)
    table = {
        "time": plots.time,
        "rho_nm": (plots.range / 1852.0).astype(np.float32),
        "theta_deg": np.degrees(plots.azimuth).astype(np.float32),
        "bds50_track_deg": np.arange(50.0),
        "bds50_roll_deg": np.where(np.arange(50) < 20, 0.5, np.where(np.arange(50) < 30, -5.0, -25.0)),
        "bds50_gs_kt": np.full(50, 100.0),
    }
    table["bds50_roll_deg"][3] = np.nan
    path = tmp_path / "bds.parquet"
    pq.write_table(pa.table({name: np.asarray(v)[order] for name, v in table.items()}), path)
    found_ = downlinked(plots, path)
    np.testing.assert_array_equal(found_.course, np.arange(50.0))
    np.testing.assert_allclose(found_.speed, 100 * KNOT)
    np.testing.assert_array_equal(np.flatnonzero(found_.straight), [0, 1, 2, *range(4, 20)])
    np.testing.assert_array_equal(np.flatnonzero(found_.turning), np.arange(30, 50))
    pq.write_table(pa.table({name: np.asarray(v)[:40] for name, v in table.items()}), path)
    with pytest.raises(DataError, match=r"only 80.0% of the recording's plots"):
        downlinked(plots, path)
    pq.write_table(pa.table({"time": plots.time}), path)
    with pytest.raises(DataError, match="no column rho_nm"):
        downlinked(plots, path)


def test_what_is_no_table_is_no_reference(rng, tmp_path):
    with pytest.raises(DataError, match=r"absent\.parquet: no such file"):
        downlinked(radar_plots(rng, 3), tmp_path / "absent.parquet")
    (tmp_path / "good.csv").write_text("time,latitude,longitude\n")
    with pytest.raises(DataError, match=r"good\.csv: no column rho_nm, .*; a reference has time, rho_nm"):
        downlinked(radar_plots(rng, 3), tmp_path / "good.csv")


def test_simulated_aircraft_are_interpolated():
    zeros = np.zeros(6)
    truth = make_reference(
        ["A", "A", "A", "B", "B", "B"],
        [0.0, 1.0, 2.0] * 2,
        zeros,
        zeros,
        velocity=[(0.0, 10.0), (10.0, 10.0), (20.0, 10.0), (50.0, 0.0), (50.0, 0.0), (50.0, 0.0)],
        turning=[False, True, True, False, False, False],
    )
    found_ = simulated(np.array([0, 0, 1, -1, 1]), np.array([1.0, 0.0, 1.5, 1.0, 9.0]), truth)
    np.testing.assert_allclose(found_.course, [45.0, 0.0, 90.0, np.nan, np.nan])
    np.testing.assert_allclose(found_.speed[:3], [np.sqrt(200.0), 10.0, 50.0])
    assert found_.turning.tolist() == [True, False, False, False, False]
    assert found_.straight.tolist() == [False, True, True, False, False]


def run_of(course, speed, p_fault, **columns):
    n = len(course)
    given = {"track": np.ones(n, int), "p_manoeuvre": np.zeros(n), "confirmed": np.arange(n) > 1} | columns
    return Followed(course=np.array(course), speed=np.array(speed), p_fault=np.array(p_fault), **given)


def test_figures_of_a_small_run():
    """Six plots of one track, one of a short one; course errors 1, 1, 2, 3 (across north) and 10 in the turn."""
    reference = Motion(
        "x",
        np.array([10.0, 20.0, 30.0, 359.0, 50.0, 60.0, 0.0]),
        np.full(7, 100.0),
        np.array([1, 1, 1, 1, 0, 0, 1], bool),
        np.array([0, 0, 0, 0, 1, 0, 0], bool),
    )
    run = run_of(
        [11.0, 21.0, 28.0, 2.0, 60.0, 60.0, 90.0],
        [100.0 + KNOT, 100.0, 100.0, 100.0 - 7 * KNOT, 100.0, 100.0, 300.0],
        [np.nan] * 7,
        track=np.array([1] * 6 + [2]),
    )
    table, parts = errors(run, reference)
    np.testing.assert_allclose(np.sort(parts["course_straight"]), [1.0, 1.0, 2.0, 3.0])
    assert table["course_straight_median_deg"] == pytest.approx(1.5)
    assert table["course_turn_median_deg"] == pytest.approx(10.0)
    assert table["speed_straight_rms_kt"] == pytest.approx(np.sqrt(50.0 / 4))
    assert table["speed_straight_rms_confirmed_kt"] == pytest.approx(np.sqrt(49.0 / 2))
    assert (table["plots_straight"], table["plots_turn"]) == (4.0, 1.0)


def test_a_run_is_a_reference_for_others():
    run = run_of([1.0, np.nan, 3.0], [4.0, np.nan, 5.0], [0.0] * 3, p_manoeuvre=np.array([0.1, np.nan, 0.9]))
    found_ = from_run(run)
    assert found_.straight.tolist() == [True, False, False]
    assert found_.turning.tolist() == [False, False, True]


def test_shares_of_plots_told(rng):
    plots = radar_plots(rng, 8, on_ground=np.array([0, 0, 0, 0, 1, 1, 0, 0]))
    fault = np.array([1, 2, 0, 0, 1, 0, 2, 0], np.int8)
    clean = run_of(np.zeros(8), np.zeros(8), [0.0, 0.0, 0.0, 0.9, 0.0, 0.0, 0.0, np.nan])
    faulty = run_of(np.zeros(8), np.zeros(8), [0.9, 0.2, 0.0, 0.9, 0.1, 0.0, np.nan, 0.9])
    shares = found(fault, clean, faulty, plots)
    assert shares["injected_told"]["value"] == pytest.approx(1 / 4)
    assert shares["injected_told_airborne"]["value"] == pytest.approx(1 / 3)
    assert shares["injected_left_out"]["value"] == pytest.approx(1 / 4)
    assert shares["clean_suspected"]["value"] == pytest.approx(1 / 3)
    assert shares["clean_run_suspected"]["value"] == pytest.approx(1 / 7)
    assert shares["clean_suspected"]["plots"] == 3.0


def test_the_study_of_the_simulated_scene(tmp_path, monkeypatch):
    whole = command._scene

    def beginning(folder, seed):
        recording, config, truth = whole(folder, seed)
        early = recording.plots.time < recording.plots.time.min() + 50.0
        cut = Motion(truth.name, *(column[early] for column in truth[1:]))
        return replace(recording, plots=recording.plots.take(early)), config, cut

    monkeypatch.setattr(command, "_scene", beginning)
    result = CliRunner().invoke(main, ["study", "faults", "-o", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        ".saltus.json",
        "figure1_errors.png",
        "figure2_p_fault.png",
        "metrics.json",
    ]
    told, suspected = metrics["p_fault"]["injected_told"], metrics["p_fault"]["clean_suspected"]
    assert told["plots"] >= 1
    assert 0.0 <= told["value"] <= 1.0
    assert suspected["value"] < 0.02
    assert set(metrics["growth"]) == {"with", "without"}
    assert set(metrics["figures"]) == set(RUNS)
    assert "injected_told" in result.output
    assert "told, suspected: p_fault above 0.5" in result.output
    assert "for growth" not in result.output


def test_departures_from_the_programs_own_run_do_not_grow():
    before, after = {"speed_straight_rms_kt": 0.02, "tracks": 3.0}, {"speed_straight_rms_kt": 1.2, "tracks": 3.0}
    assert growth(before, after, own=True) == {"speed_straight_rms_kt": None}
    assert growth(before, after, own=False)["speed_straight_rms_kt"] == pytest.approx(59.0)
    clean, told = {"plots_straight": 5.0, "plots_turn": 0.0}, {"injected_told": {"value": None, "plots": 0.0}}
    text = "\n".join(command._explained(True, clean, told))
    for words in (
        "– for turn: there is no such plot",
        "– of 0 plots",
        "– for growth: the reference is the run over clean",
    ):
        assert words in text
    clean["plots_turn"], told["injected_told"]["value"] = 1.0, 0.9
    assert len(command._explained(False, clean, told)) == 1


def test_options_that_mean_nothing_are_refused(tmp_path):
    for arguments in (["faults", "--runs", "5"], ["fusion", "x.ast"], ["fusion", "--reference", "x.parquet"]):
        result = CliRunner().invoke(main, ["study", *arguments, "-o", str(tmp_path / "out")])
        assert result.exit_code == 2
        assert "Usage" in result.output
    assert not (tmp_path / "out").exists()
