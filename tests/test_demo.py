"""The demonstration's parts: a small decoder of its own, geodesics and tables made by hand are the oracles."""

import tomllib

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyproj
import pytest

from saltus.demo import run_demo, score_demo, write_demo
from saltus.evaluate.tables import read_reference
from saltus.geo import wrap
from saltus.simulate.scene import DURATION, demo_aircraft, demo_plane, demo_radars

MIDNIGHT = 1748736000.0  # 2025-06-01 00:00 UTC
# CAT048 items by field reference number, with their lengths: 010 140 020 040 070 090 | 220 240 | 230.
LENGTHS = {1: 2, 2: 3, 3: 1, 4: 4, 5: 2, 6: 2, 8: 3, 9: 6, 21: 2}


def records_048(data):
    """Time of day, range in NM, azimuth in degrees and identity of every CAT048 record, in file order."""
    at, out = 0, []
    while at < len(data):
        category, end = data[at], at + int.from_bytes(data[at + 1 : at + 3])
        at += 3
        while category == 48 and at < end:
            fields, first = [], 1
            while True:
                spec, at = data[at], at + 1
                fields += [first + k for k in range(7) if spec >> (7 - k) & 1]
                first += 7
                if not spec & 1:
                    break
            item = {}
            for number in fields:
                item[number], at = data[at : at + LENGTHS[number]], at + LENGTHS[number]
            raw = [int.from_bytes(item[2]), int.from_bytes(item[4][:2]), int.from_bytes(item[4][2:])]
            out.append((raw[0] / 128, raw[1] / 256, raw[2] * 360 / 65536, 5 in item, 8 in item))
        at = end
    return np.array(out)


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo") / "out"
    return folder, write_demo(folder, seed=3)


def polar_truth(craft, times, site):
    """Range and azimuth by PROJ alone."""
    plane = demo_plane()
    pipeline = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=stere +lat_0={np.degrees(plane.latitude)} "
        f"+lon_0={np.degrees(plane.longitude)} +ellps=WGS84 +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lat_0={np.degrees(site.latitude)} "
        f"+lon_0={np.degrees(site.longitude)} +h_0={site.height}"
    )
    e, n, u = pipeline.transform(*craft.trajectory.at(times).position.T)
    return np.sqrt(e**2 + n**2 + u**2), np.arctan2(e, n)


def test_each_record_is_a_plot_of_its_label(demo):
    folder, simulated = demo
    aircraft = demo_aircraft()
    for file, labels, station in zip(simulated.files, simulated.labels, demo_radars(), strict=True):
        assert file.parent == folder
        records = records_048(file.read_bytes())
        assert len(records) == len(labels)
        clutter = records[labels == -1]
        assert not clutter[:, 3:].any()  # neither Mode A nor Mode S
        # Poisson of 10 a scan, and P_D = 0.92: five standard deviations.
        scans = DURATION / station.radar.period
        assert abs(len(clutter) - 10 * scans) < 5 * np.sqrt(10 * scans)
        for k, craft in enumerate(aircraft):
            mine = records[labels == k]
            assert mine[:, 3].all()
            assert (mine[:, 4] == (craft.icao24 >= 0)).all()
            assert abs(len(mine) - 0.92 * scans) < 5 * np.sqrt(scans * 0.92 * 0.08) + 2
            slant, azimuth = polar_truth(craft, mine[:, 0] - 36000.0, station.radar.site)
            # Six sigma, plus what the plot's time, rounded to 1/256 s, costs at 250 m/s.
            assert (np.abs(mine[:, 1] * 1852 - slant) < 6 * 25 + 8).all()
            off = np.abs(wrap(np.radians(mine[:, 2]) - azimuth))
            assert (off < 6 * np.radians(0.05) + 1.0 / slant).all()


def test_configuration_names_both_radars(demo):
    _, simulated = demo
    config = tomllib.loads(simulated.config.read_text())
    assert str(config["date"]) == "2025-06-01"
    for entry, station in zip(config["sensor"], demo_radars(), strict=True):
        assert (entry["sac"], entry["sic"], entry["name"]) == (station.sac, station.sic, station.name)
        site = station.radar.site
        np.testing.assert_allclose(np.radians([entry["latitude"], entry["longitude"]]), [site.latitude, site.longitude])
        assert entry["height"] == site.height
    # The fastest mode must hold the hardest turn, or its aircraft comes apart into several tracks.
    t = np.arange(0.0, DURATION, 0.25)
    hardest = max(
        np.nanmax(np.abs(np.gradient(a.trajectory.at(t).velocity[:, :2], t, axis=0))) for a in demo_aircraft()
    )
    assert hardest <= max(config["filter"]["accel_h"]) * 1.01
    assert len(config["filter"]["accel_h"]) == len(config["filter"]["sojourn_h"])
    (a, b) = (s.radar.site for s in demo_radars())
    _, _, distance = pyproj.Geod(ellps="WGS84").inv(*np.degrees([a.longitude, a.latitude, b.longitude, b.latitude]))
    assert 60e3 < distance < 100e3


def test_truth_moves_as_its_velocity_says(demo):
    folder, _ = demo
    truth = pq.read_table(folder / "truth.parquet")
    names = truth.column("target_id").to_numpy()
    assert len(set(names)) == 14
    for name in ("SAL101", "SAL109", "SAL113"):
        rows = truth.filter(pa.array(names == name))
        lat, lon, height, time, ve, vn = (
            rows.column(c).to_numpy() for c in ("latitude", "longitude", "altitude", "time", "ve", "vn")
        )
        assert time[0] == MIDNIGHT + 36000.0
        assert len(time) == DURATION + 1
        azimuth, _, arc = pyproj.Geod(ellps="WGS84").inv(lon[:-2], lat[:-2], lon[2:], lat[2:])
        speed = arc / 2 * (1 + height[1:-1] / 6.37e6)
        # A chord over 2 s of a turn at 0.1 rad/s is short by 0.2 %.
        np.testing.assert_allclose(speed, np.hypot(ve, vn)[1:-1], rtol=3e-3)
        np.testing.assert_allclose(wrap(np.radians(azimuth) - np.arctan2(ve, vn)[1:-1]), 0.0, atol=0.06)


def test_crossing_pair_is_a_thousand_feet_apart():
    by_name = {a.name: a.trajectory for a in demo_aircraft()}
    t = np.arange(0.0, 600.0, 0.5)
    gap = by_name["SAL103"].at(t).position - by_name["SAL104"].at(t).position
    assert np.hypot(*gap[:, :2].T).min() < 100.0
    np.testing.assert_allclose(gap[:, 2], 304.8)


def test_the_seed_decides_every_byte(tmp_path, monkeypatch):
    monkeypatch.setattr("saltus.demo.DURATION", 30.0)
    first, again, other = (write_demo(tmp_path / name, seed) for name, seed in (("a", 3), ("b", 3), ("c", 4)))
    assert [f.read_bytes() for f in again.files] == [f.read_bytes() for f in first.files]
    assert other.files[0].read_bytes() != first.files[0].read_bytes()


def perfect_tables(labels, shift=0.0, p_turning=0.9, p_straight=0.1):
    """Tracks that are the truth, shifted north by `shift` m: track 100 + k follows aircraft k."""
    files = np.repeat(["radar_a.ast", "radar_b.ast"], [len(x) for x in labels])
    record = np.concatenate([np.arange(len(x)) for x in labels])
    label = np.concatenate(labels)
    track = pa.array([None if k < 0 else 100 + k for k in label.tolist()], pa.int64())
    assignments = pa.table({"source": files, "record": record, "track_id": track})
    parts = []
    for k, craft in enumerate(demo_aircraft()):
        t = np.arange(10.0, 590.0, 4.0)
        motion = craft.trajectory.at(t)
        lat, lon = (np.degrees(a) for a in demo_plane().inverse(motion.position[:, :2]))
        lon, lat, _ = pyproj.Geod(ellps="WGS84").fwd(lon, lat, np.zeros(len(t)), np.full(len(t), shift))
        columns = {
            "track_id": np.full(len(t), 100 + k),
            "time": MIDNIGHT + 36000.0 + t,
            "latitude": lat,
            "longitude": lon,
            "cov_ee": np.full(len(t), 900.0),
            "cov_en": np.zeros(len(t)),
            "cov_nn": np.full(len(t), 900.0),
            "status": np.where(t < 20, "tentative", "confirmed"),
            "p_manoeuvre_h": np.where(motion.turning, p_turning, p_straight),
        }
        parts.append(pa.table(columns))
    return pa.concat_tables(parts), assignments


def test_perfect_tracks_score_perfectly(demo):
    folder, simulated = demo
    truth = read_reference(folder / "truth.parquet")
    tracks, assignments = perfect_tables(simulated.labels, shift=30.0)
    score = score_demo(tracks, assignments, simulated.labels, truth)
    np.testing.assert_allclose(score.rmse, 30.0, rtol=1e-6)
    assert score.tracks.completeness == score.tracks.purity == score.tracks.fragmentation == 1.0
    assert score.false.n_false == 0
    assert score.p_turning == pytest.approx(0.9)
    assert score.p_straight == pytest.approx(0.1)
    np.testing.assert_array_equal(score.n_plots, sum(np.bincount(x[x >= 0], minlength=14) for x in simulated.labels))


def test_faults_are_counted(demo):
    folder, simulated = demo
    truth = read_reference(folder / "truth.parquet")
    tracks, assignments = perfect_tables(simulated.labels)
    label = np.concatenate(simulated.labels)
    track = assignments.column("track_id").to_numpy().copy()
    clutter = np.flatnonzero(label < 0)[:6]
    track[clutter] = 900  # a false track of six plots
    first = np.flatnonzero(label == 2)
    track[first[: len(first) // 4]] = np.nan  # a quarter of an aircraft's plots unused
    numbers = pa.array([None if np.isnan(x) else int(x) for x in track], pa.int64())
    assignments = assignments.set_column(2, "track_id", numbers)
    row = {"track_id": [900], "time": [MIDNIGHT + 36100.0], "latitude": [48.0], "longitude": [11.0]}
    row |= {"cov_ee": [900.0], "cov_en": [0.0], "cov_nn": [900.0]}
    false_row = pa.table({**row, "status": ["confirmed"], "p_manoeuvre_h": [0.5]})
    score = score_demo(pa.concat_tables([tracks, false_row]), assignments, simulated.labels, truth)
    assert score.false.n_false == 1
    assert score.false.per_hour == pytest.approx(6.0)  # one in ten minutes
    assert score.tracks.per_object_completeness[2] == pytest.approx(0.75, abs=0.01)


def test_no_tracks_at_all(demo):
    folder, simulated = demo
    truth = read_reference(folder / "truth.parquet")
    tracks, assignments = perfect_tables(simulated.labels)
    nothing = pa.array([None] * len(assignments), pa.int64())
    score = score_demo(tracks.slice(0, 0), assignments.set_column(2, "track_id", nothing), simulated.labels, truth)
    assert np.isnan(score.rmse).all()
    assert np.isnan(score.p_turning)
    assert score.false.n_false == 0


def test_the_demonstration_tracks_what_it_simulates(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("saltus.demo.DURATION", 90.0)  # the first minute and a half of the scene
    run_demo(tmp_path / "out", seed=1)
    tracks = pq.read_table(tmp_path / "out" / "tracks.parquet")
    assert set(tracks.column("status").to_pylist()) >= {"tentative", "confirmed"}
    assert (tmp_path / "out" / "report.html").stat().st_size > 0
    printed = capsys.readouterr().out
    for craft in demo_aircraft():
        (line,) = (x for x in printed.splitlines() if x.split()[:1] == [craft.name])
        words = line.split()
        n_tracks, share, rmse = int(words[-4]), float(words[-3]), float(words[-1])
        assert n_tracks == 1
        assert share > 95.0
        assert rmse < 150.0  # the plots' own error reaches 120 m across the ray at 100 km and more
    assert "False confirmed tracks:" in printed


def test_an_interrupted_demonstration_leaves_nothing(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("saltus.demo.DURATION", 20.0)
    monkeypatch.setattr("saltus.run.write_tracks", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_demo(tmp_path / "out", seed=1)
    assert list(tmp_path.iterdir()) == []
