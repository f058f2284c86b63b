"""`saltus track` on small simulated recordings: tables, counts, options, damaged input, interruption."""

import json
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner

from saltus.cli import main
from saltus.errors import DataError
from saltus.geo import Plane, Site
from saltus.io.asterix_write import write_cat048
from saltus.records import REASONS
from saltus.run import parse_time, track_files
from saltus.simulate import Leg, Radar, Trajectory, observe

MIDNIGHT = 1748736000.0  # 2025-06-01 00:00 UTC
START = 36000.0
SITES = (Site(*np.radians([48.0, 11.0]).tolist(), 500.0), Site(*np.radians([48.2, 11.8]).tolist(), 300.0))
PLANE = Plane(SITES[0].latitude, SITES[0].longitude)
FLIGHTS = tuple(
    Trajectory((x, y, h), course, speed, (Leg(400.0),))
    for x, y, h, course, speed in (
        (-20e3, 20e3, 9144.0, 1.5, 220.0),
        (30e3, -25e3, 6096.0, 0.2, 180.0),
        (25e3, 40e3, 10668.0, 3.6, 230.0),
    )
)
CODES = dict(icao24=np.array([0x3C6444, 0x4CA123, -1, -1]), mode3a=np.array([0o1234, 0o4321, 0o2345, -1]))
NAMES = np.array(["DLH1", "RYR2", "", ""])
TRACKS = {
    **dict.fromkeys(["track_id"], pa.int64()),
    **dict.fromkeys(["time", "latitude", "longitude", "altitude", "ve", "vn", "vu", "course_deg"], pa.float64()),
    **dict.fromkeys(["speed_mps", "cov_ee", "cov_en", "cov_nn", "cov_uu"], pa.float64()),
    **dict.fromkeys(["cov_veve", "cov_vevn", "cov_vnvn", "p_manoeuvre_h", "p_manoeuvre_v", "p_fault"], pa.float64()),
    **dict.fromkeys(["status", "icao24", "mode3a", "callsign"], pa.string()),
    **dict.fromkeys(["x_m", "y_m", "p_degraded", "time_known"], pa.float64()),
}


class Output(NamedTuple):
    tracks: pa.Table
    assignments: pa.Table
    summary: dict


def config(folder, sics=(1, 2), extra=""):
    text = "date = 2025-06-01\n" + extra
    for sic in sics:
        site = SITES[sic - 1]
        text += f"[[sensor]]\nsac = 25\nsic = {sic}\nheight = {site.height}\n"
        text += f"latitude = {np.degrees(site.latitude):.9f}\nlongitude = {np.degrees(site.longitude):.9f}\n"
    path = folder / f"sensors{''.join(map(str, sics))}.toml"
    path.write_text(text)
    return path


def record(path, sic=1, *, seed=1, seconds=80.0, start=START, altitude=True, codes=True, clutter=3.0):
    """One radar's file; returns which aircraft each CAT048 record is of, -1 clutter."""
    radar = Radar(
        SITES[sic - 1],
        period=4.0,
        sigma_range=20.0,
        sigma_azimuth=float(np.radians(0.03)),
        prob_detection=0.97,
        clutter_per_scan=clutter,
        max_range=120e3,
        north_time=0.7 * sic,
    )
    seen = observe(radar, FLIGHTS, PLANE, 0.0, seconds, np.random.default_rng(seed))
    write_cat048(
        path,
        sac=25,
        sic=sic,
        time_of_day=start + seen.time,
        range_m=seen.slant,
        azimuth_rad=seen.azimuth,
        altitude_m=seen.altitude if altitude else None,
        icao24=CODES["icao24"][seen.target] if codes else None,
        mode3a=CODES["mode3a"][seen.target] if codes else None,
        callsign=NAMES[seen.target] if codes else None,
        north_marker_times=start + radar.north_times(0.0, seconds),
    )
    return seen.target


def read(folder):
    summary = json.loads((folder / "summary.json").read_text())
    return Output(pq.read_table(folder / "tracks.parquet"), pq.read_table(folder / "assignments.parquet"), summary)


def track(inputs, folder, *arguments):
    result = CliRunner().invoke(main, ["track", *map(str, inputs), "-o", str(folder), *map(str, arguments)])
    assert result.exit_code == 0, result.output
    return read(folder)


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """Two radars' recordings tracked together."""
    folder = tmp_path_factory.mktemp("two")
    labels = [record(folder / f"radar{sic}.ast", sic, seed=sic) for sic in (1, 2)]
    files = [folder / "radar1.ast", folder / "radar2.ast"]
    return folder, files, labels, track(files, folder / "out", "--config", config(folder))


def check_consistent(out):
    """What holds of every output: each report has a track or a reason, and the summary counts what the tables hold."""
    a, summary = out.assignments, out.summary
    used = np.array(a["track_id"].is_valid())
    assert (used != np.array(a["reason"].is_valid())).all()
    assert summary["reports"] == {"read": len(a), "used": int(used.sum()), "unused": int((~used).sum())}
    assert sum(summary["reasons"].values()) == summary["reports"]["unused"]
    counted = {r["values"]: r["counts"] for r in a["reason"].drop_null().value_counts().to_pylist()}
    assert counted == summary["reasons"]
    ids = set(out.tracks["track_id"].to_pylist())
    assert set(a["track_id"].drop_null().to_pylist()) == ids
    assert summary["tracks"]["confirmed"] == len(ids)
    status = out.tracks["status"].to_pylist()
    assert summary["tracks"]["coasted"] == status.count("coasted")
    assert summary["tracks"]["updates"] == len(status) - status.count("coasted")
    assert set(status) <= {"tentative", "confirmed", "coasted"}
    keys = a.select(["source", "category", "record"]).to_pylist()
    assert len({tuple(k.values()) for k in keys}) == len(keys)


def test_tables_have_exactly_the_columns_of_the_interface(two):
    out = two[3]
    assert dict(zip(out.tracks.schema.names, out.tracks.schema.types, strict=True)) == TRACKS
    assert out.tracks.schema.names == list(TRACKS)
    a = out.assignments.schema
    assert a.names == ["source", "category", "record", "time", "track_id", "reason"]
    assert a.types == [pa.string(), pa.int32(), pa.int64(), pa.float64(), pa.int64(), pa.string()]
    check_consistent(out)


def test_every_report_of_every_file_has_a_row(two):
    _, _, labels, out = two
    for name, label in zip(("radar1.ast", "radar2.ast"), labels, strict=True):
        mine = out.assignments.filter(pa.compute.equal(out.assignments["source"], name))
        assert sorted(mine["record"].to_pylist()) == list(range(len(label)))
        assert set(mine["category"].to_pylist()) == {48}
    assert out.summary["inputs"] == ["radar1.ast", "radar2.ast"]
    assert set(out.assignments["reason"].drop_null().to_pylist()) & set(REASONS) == set()  # nothing rejected on reading


def test_tracks_are_the_aircraft(two):
    """Three aircraft, three tracks of both radars' plots, each with its own codes and where it flew."""
    _, _, labels, out = two
    by_file = {"radar1.ast": labels[0], "radar2.ast": labels[1]}
    seen = {}
    for row in out.assignments.to_pylist():
        target = by_file[row["source"]][row["record"]]
        if target >= 0 and row["time"] > MIDNIGHT + START + 8.0:  # both radars may begin a track, one of them stays
            assert row["track_id"] is not None
            seen.setdefault(row["track_id"], []).append((target, row["source"]))
    assert len(seen) == len(FLIGHTS)
    for track_id, plots in seen.items():
        assert len({t for t, _ in plots}) == 1
        assert {f for _, f in plots} == set(by_file)
        k = plots[0][0]
        rows = out.tracks.filter(pa.compute.equal(out.tracks["track_id"], track_id))
        address = f"{CODES['icao24'][k]:06X}" if CODES["icao24"][k] >= 0 else None
        assert set(rows["icao24"].to_pylist()) == {address}
        assert set(rows["mode3a"].to_pylist()) == {f"{CODES['mode3a'][k]:04o}"}
        assert set(rows["callsign"].to_pylist()) == {NAMES[k] or None}
        sure = rows.filter(pa.compute.equal(rows["status"], "confirmed")).slice(5)
        time = sure["time"].to_numpy() - MIDNIGHT - START
        truth = FLIGHTS[k].at(time)
        xy = PLANE.forward(np.radians(sure["latitude"].to_numpy()), np.radians(sure["longitude"].to_numpy()))
        sigma = np.sqrt(sure["cov_ee"].to_numpy() + sure["cov_nn"].to_numpy())
        assert (np.linalg.norm(xy - truth.position[:, :2], axis=-1) < 5 * sigma).all()
        assert np.abs(sure["altitude"].to_numpy() - FLIGHTS[k].position[2]).max() < 25.0
        assert np.abs(sure["speed_mps"].to_numpy() - FLIGHTS[k].speed).max() < 25.0
        e, n = sure["ve"].to_numpy(), sure["vn"].to_numpy()
        np.testing.assert_allclose(np.hypot(e, n), sure["speed_mps"].to_numpy())
        np.testing.assert_allclose(np.degrees(np.arctan2(e, n)) % 360, sure["course_deg"].to_numpy())


def test_numbers_are_finite_and_covariances_positive(two):
    out = two[3].tracks
    for name, kind in TRACKS.items():
        if kind == pa.float64():
            assert np.isfinite(out[name].drop_null().to_numpy()).all(), name
    for a, b, c in (("cov_ee", "cov_en", "cov_nn"), ("cov_veve", "cov_vevn", "cov_vnvn")):
        a, b, c = (out[n].to_numpy() for n in (a, b, c))
        assert (a > 0).all()
        assert (a * c > b * b).all()
    for p in ("p_manoeuvre_h", "p_manoeuvre_v"):
        assert ((out[p].to_numpy() >= 0) & (out[p].to_numpy() <= 1)).all()
    time, *rest = (out[name].to_numpy() for name in ("time", "track_id", "time_known"))
    order = [time, *rest]
    assert (np.lexsort(order) == np.arange(len(out))).all()
    assert time[0] >= MIDNIGHT + START


def test_summary_states_the_faults_of_each_sensor(two):
    faults = two[3].summary["faults"]
    assert list(faults) == list(two[3].summary["noise"])
    for row in faults.values():
        assert set(row) == {"judged_plots", "flagged_plots", "flagged_share", "flagged", "degraded"}
        assert set(row["flagged"]) == {"azimuth", "range"}
        assert row["judged_plots"] > 40
        assert sum(row["flagged"].values()) == row["flagged_plots"] < 0.02 * row["judged_plots"]
        assert row["degraded"] == []  # two radars whose errors stay what they are


def test_summary_states_the_noise_of_each_sensor(two):
    noise = two[3].summary["noise"]
    assert {row["system"] for row in noise.values()} == {"CAT048:25/1", "CAT048:25/2"}
    for row in noise.values():
        for label in ("sigma_range_m", "sigma_azimuth_deg"):
            assert set(row[label]) == {"configured", "estimated", "used"}
            assert row[label]["configured"] is None
            assert row[label]["used"] > 0
        assert row["update_period_s"] == pytest.approx(4.0, abs=0.02)
        assert row["nis_mean"] > 0


def test_configured_noise_is_used_as_it_stands(two, tmp_path):
    folder, files, *_ = two
    path = tmp_path / "noise.toml"
    path.write_text(config(folder, (1,)).read_text() + "sigma_range = 33.0\nsigma_azimuth = 0.05\n")
    row = next(iter(track(files[:1], tmp_path / "out", "--config", path, "--no-report").summary["noise"].values()))
    assert (row["sigma_range_m"]["configured"], row["sigma_range_m"]["used"]) == (33.0, 33.0)
    assert (row["sigma_azimuth_deg"]["configured"], row["sigma_azimuth_deg"]["used"]) == (0.05, 0.05)


def test_the_report_is_written_unless_declined(two, tmp_path):
    folder, files, _, _ = two
    assert {p.name for p in (folder / "out").iterdir()} == {
        ".saltus.json",
        "tracks.parquet",
        "assignments.parquet",
        "identifications.parquet",
        "biases.json",
        "summary.json",
        "report.html",
    }
    track(files[:1], tmp_path / "out", "--config", config(folder), "--no-report")
    assert not (tmp_path / "out" / "report.html").exists()


def test_the_order_of_inputs_changes_nothing(two, tmp_path):
    folder, files, _, first = two
    again = track(files[::-1], tmp_path / "out", "--config", config(folder), "--no-report")
    assert again.tracks.drop_columns("track_id").equals(first.tracks.drop_columns("track_id"))
    assert again.assignments["time"].equals(first.assignments["time"])


def test_time_window(two, tmp_path):
    folder, files, _, first = two
    window = ["--from", "10:00:20", "--to", "10:01:00"]
    out = track(files, tmp_path / "out", "--config", config(folder), "--no-report", *window)
    check_consistent(out)
    a = out.assignments
    assert len(a) == len(first.assignments)  # nothing is lost, what is outside says so
    inside = (a["time"].to_numpy() >= MIDNIGHT + START + 20) & (a["time"].to_numpy() <= MIDNIGHT + START + 60)
    outside = np.array([r == "outside time window" for r in a["reason"].to_pylist()])
    assert (outside == ~inside).all()
    assert out.tracks["time"].to_numpy().min() >= MIDNIGHT + START + 20
    updated = out.tracks.filter(pa.compute.not_equal(out.tracks["status"], "coasted"))
    assert updated["time"].to_numpy().max() <= MIDNIGHT + START + 60
    iso = ["--from", "2025-06-01T10:00:20Z", "--to", "2025-06-01T12:01:00+02:00"]
    other = track(files, tmp_path / "iso", "--config", config(folder), "--no-report", *iso)
    assert other.assignments.equals(a)


def test_times_as_people_write_them():
    start = MIDNIGHT + START
    assert parse_time("10:00", start) == start
    assert parse_time("9:59:30.5", start) == start - 29.5
    assert parse_time("2025-06-02T00:00:00", start) == MIDNIGHT + 86400
    for text in ("10", "24:00", "10:60", "10:00:61", "ten", ""):
        with pytest.raises(DataError, match="no time"):
            parse_time(text, start)


def test_the_option_date_wins(two, tmp_path):
    folder, files, *_ = two
    out = track(files[:1], tmp_path / "out", "--config", config(folder), "--no-report", "--date", "2024-02-29")
    assert out.tracks["time"].to_numpy()[0] // 86400 == 1709164800 // 86400


def test_identity_ignored_leaves_no_codes(two, tmp_path):
    folder, files, _, first = two
    out = track(files, tmp_path / "out", "--config", config(folder), "--no-report", "--identity", "ignore")
    check_consistent(out)
    for name in ("icao24", "mode3a", "callsign"):
        assert out.tracks[name].null_count == len(out.tracks)
        assert first.tracks[name].null_count < len(first.tracks)
    assert out.summary["settings"]["identity"] == "ignore"
    assert out.summary["tracks"]["confirmed"] >= len(FLIGHTS)


def test_one_site_missing_costs_only_its_reports(two, tmp_path):
    folder, files, labels, _ = two
    result = CliRunner().invoke(
        main,
        ["track", *map(str, files), "-o", str(tmp_path / "out"), "--config", str(config(folder, (1,))), "--no-report"],
    )
    assert result.exit_code == 0, result.output
    out = read(tmp_path / "out")
    check_consistent(out)
    assert out.summary["reasons"]["site unknown"] == len(labels[1])
    assert any("25/2" in p and "sic = 2" in p for p in out.summary["problems"])
    assert "sac = 25, sic = 2" in result.stderr
    assert out.summary["tracks"]["confirmed"] == len(FLIGHTS)


def test_a_truncated_file_is_tracked_up_to_its_end(two, tmp_path):
    folder, files, labels, _ = two
    data = files[0].read_bytes()
    (tmp_path / "cut.ast").write_bytes(data[: 2 * len(data) // 3 + 5])
    out = track([tmp_path / "cut.ast"], tmp_path / "out", "--config", config(folder), "--no-report")
    check_consistent(out)
    assert 0.5 * len(labels[0]) < len(out.assignments) < 0.75 * len(labels[0])
    assert any("cut.ast" in p and "byte" in p for p in out.summary["problems"])


def test_garbage_in_the_middle_costs_little(two, tmp_path):
    folder, files, labels, _ = two
    data = files[0].read_bytes()
    at = len(data) // 2
    (tmp_path / "dirty.ast").write_bytes(data[:at] + bytes(range(1, 200)) + data[at:])
    out = track([tmp_path / "dirty.ast"], tmp_path / "out", "--config", config(folder), "--no-report")
    check_consistent(out)
    assert any("dirty.ast" in p for p in out.summary["problems"])
    assert out.summary["reports"]["used"] > 0.4 * len(labels[0])


def test_duplicate_reports_are_used_once(two, tmp_path):
    folder, files, labels, _ = two
    doubled = [files[0], tmp_path / "copy.ast"]
    doubled[1].write_bytes(files[0].read_bytes())
    out = track(doubled, tmp_path / "out", "--config", config(folder), "--no-report")
    check_consistent(out)
    assert out.summary["reasons"]["duplicate"] == len(labels[0])


def test_plots_without_height(tmp_path):
    record(tmp_path / "flat.ast", altitude=False)
    out = track([tmp_path / "flat.ast"], tmp_path / "out", "--config", config(tmp_path), "--no-report")
    check_consistent(out)
    assert out.summary["tracks"]["confirmed"] == len(FLIGHTS)
    for name in ("altitude", "vu", "cov_uu"):
        assert out.tracks[name].null_count == len(out.tracks)
    for name in ("latitude", "ve", "cov_ee", "p_manoeuvre_v"):
        assert out.tracks[name].null_count == 0


def test_midnight_counts_on(tmp_path):
    label = record(tmp_path / "night.ast", start=86400.0 - 40.0)
    out = track([tmp_path / "night.ast"], tmp_path / "out", "--config", config(tmp_path), "--no-report")
    check_consistent(out)
    time = out.assignments["time"].to_numpy()
    assert time.min() < MIDNIGHT + 86400 < time.max() < MIDNIGHT + 86400 + 41
    assert len(out.assignments) == len(label)
    for k, count in zip(*np.unique(out.tracks["track_id"].to_numpy(), return_counts=True), strict=True):
        mine = out.tracks["time"].to_numpy()[out.tracks["track_id"].to_numpy() == k]
        assert mine.min() < MIDNIGHT + 86400 < mine.max(), count  # no track ends at midnight


def table(seconds=60.0, **columns):
    """Two targets seen every 4 s, as columns of a table with latitude and longitude."""
    t = np.arange(0.0, seconds, 4.0)
    time, k = np.tile(t, 2), np.repeat([0, 1], len(t))
    given = {"time": MIDNIGHT + START + time, "lat": 48.0 + 0.001 * time * (1 + k) / 4, "lon": 11.0 + 0.3 * k}
    return pa.table({**given, **{name: make(time, k) for name, make in columns.items()}})


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_table_of_latitudes_needs_no_site(tmp_path, suffix):
    path = tmp_path / f"points.{suffix}"
    content = table(altitude_m=lambda t, k: 3000.0 + 0.0 * t, icao24=lambda t, k: np.array(["3c6444", "4ca123"])[k])
    (pacsv.write_csv if suffix == "csv" else pq.write_table)(content, path)
    out = track([path], tmp_path / "out", "--no-report")
    check_consistent(out)
    assert out.summary["reports"] == {"read": 30, "used": 30, "unused": 0}
    assert out.assignments["category"].null_count == 30
    assert sorted(out.assignments["record"].to_pylist()) == list(range(30))
    assert set(out.tracks["icao24"].to_pylist()) == {"3C6444", "4CA123"}
    speed = out.tracks["speed_mps"].to_numpy()[-2:]
    np.testing.assert_allclose(np.sort(speed), [27.8, 55.6], atol=3.0)  # 0.001 degrees are 111.2 m


def test_a_table_of_metres_takes_its_site_by_name(tmp_path):
    t = np.arange(0.0, 60.0, 4.0)
    path = tmp_path / "boats.csv"
    pacsv.write_csv(pa.table({"time": MIDNIGHT + t, "x_m": 10.0 * t, "y_m": 500.0 + 0.0 * t}), path)
    site = 'name = "boats"\nlatitude = 63.4\nlongitude = 10.4\nheight = 10.0\n'
    (tmp_path / "c.toml").write_text("[[sensor]]\n" + site)
    out = track([path], tmp_path / "out", "--config", tmp_path / "c.toml", "--no-report")
    assert out.summary["reports"]["used"] == 15
    last = {name: out.tracks[name].to_numpy()[-1] for name in ("latitude", "longitude", "ve", "vn")}
    # One degree of latitude is 111.5 km there, one of longitude 50.0 km.
    assert last["latitude"] == pytest.approx(63.4 + 500 / 111.5e3, abs=2e-4)
    assert last["longitude"] == pytest.approx(10.4 + 560 / 50.0e3, abs=6e-4)
    assert last["ve"] == pytest.approx(10.0, abs=2.0)
    assert last["vn"] == pytest.approx(0.0, abs=2.0)
    result = CliRunner().invoke(main, ["track", str(path), "-o", str(tmp_path / "none")])
    assert result.exit_code != 0
    assert len(result.stderr.splitlines()) == 1
    assert 'name = "boats"' in result.stderr


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"lat": lambda t, k: 4800.0 + t}, ["latitude", "row 0", "degrees"]),
        ({"altitude_m": lambda t, k: 3e7 + t}, ["altitude_m", "row 0"]),
        ({"time": lambda t, k: 1e3 * (MIDNIGHT + t)}, ["time", "milliseconds"]),
    ],
)
def test_units_that_cannot_be_right(tmp_path, columns, words):
    path = tmp_path / "points.csv"
    pacsv.write_csv(table(**columns), path)
    result = CliRunner().invoke(main, ["track", str(path), "-o", str(tmp_path / "out")])
    assert result.exit_code != 0
    assert len(result.stderr.splitlines()) == 1
    for word in ("points.csv", *words):
        assert word in result.stderr
    assert not (tmp_path / "out").exists()


def test_single_values_that_cannot_be_cost_their_rows(tmp_path):
    content = table(altitude_m=lambda t, k: np.where((t == 20.0) & (k == 0), np.inf, 3000.0))
    lat = content["lat"].to_numpy().copy()
    lat[3], lat[5] = 95.0, np.nan
    pq.write_table(content.set_column(1, "lat", pa.array(lat)), tmp_path / "points.parquet")
    out = track([tmp_path / "points.parquet"], tmp_path / "out", "--no-report")
    check_consistent(out)
    assert out.summary["reasons"] == {"out of range": 1, "not a number": 1} or sum(out.summary["reasons"].values()) == 2
    assert out.assignments["reason"].to_pylist().count("out of range") >= 1


def test_nothing_left_is_said_with_its_reasons(tmp_path):
    record(tmp_path / "a.ast")
    result = CliRunner().invoke(main, ["track", str(tmp_path / "a.ast"), "-o", str(tmp_path / "out"), "--to", "09:00"])
    assert result.exit_code != 0
    assert "outside time window" in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def leftovers(folder):
    hidden = [p.name for p in folder.rglob("*") if p.name.startswith(".") or "tmp" in p.name]
    return [name for name in hidden if name != ".saltus.json"]  # belongs to a set


@pytest.mark.parametrize(
    "where",
    ["saltus.engine.setup.place_plots", "saltus.engine.outcome.assignment_table", "saltus.io.write.json.dumps"],
)
@pytest.mark.parametrize("older", [False, True])
def test_ctrl_c_leaves_nothing_half_written(tmp_path, monkeypatch, where, older):
    folder = tmp_path / "here"
    folder.mkdir()
    record(folder / "a.ast", seconds=30.0)
    path = config(folder)
    out = folder / "result"
    if older:
        track([folder / "a.ast"], out, "--config", path)
        (out / "mine.txt").write_text("mine")
    before = {p.name: p.read_bytes() for p in out.iterdir()} if older else {}

    def interrupted(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(where, interrupted)
    result = CliRunner().invoke(main, ["track", str(folder / "a.ast"), "-o", str(out), "--config", str(path)])
    assert result.exit_code == 130
    assert "interrupted" in result.stderr
    assert leftovers(folder) == []
    assert out.exists() == older
    assert before == ({p.name: p.read_bytes() for p in out.iterdir()} if older else {})


def test_an_older_output_survives_a_failure_and_gives_way_to_a_success(tmp_path):
    record(tmp_path / "a.ast", seconds=30.0)
    (tmp_path / "bad.ast").write_bytes(b"no radar")
    out, path = tmp_path / "out", config(tmp_path)
    first = track([tmp_path / "a.ast"], out, "--config", path, "--no-report")
    with pytest.raises(DataError, match=r"bad\.ast"):
        track_files([tmp_path / "bad.ast"], out, path, report=False)
    assert read(out).tracks.equals(first.tracks)
    record(tmp_path / "a.ast", seconds=40.0, seed=9)
    assert not track([tmp_path / "a.ast"], out, "--config", path, "--no-report").tracks.equals(first.tracks)
