"""The examples: the Autoferry tables, by hand and on the recordings."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pyproj
import pytest

from saltus.config import load_config
from saltus.io import read
from saltus.records import Kind
from saltus.report.places import plot_positions
from saltus.run import track_files
from saltus.score import score_files

EXAMPLES = Path(__file__).parents[1] / "examples"
PIREN = pyproj.Transformer.from_pipeline(
    "+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 "
    "+lat_0=63.4389029083 +lon_0=10.39908278 +h_0=39.923"
)
START = 1.62e9


def loaded(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def autoferry():
    return loaded("autoferry_to_table")


def scan(sensor, time, measurement, ship=(0.0, 0.0)):
    return {"sensorID": sensor, "ownshipPosition": list(ship), "time": START + time, "measurement": measurement}


def write(folder, detections, truth):
    (folder / "d.json").write_text(json.dumps(detections))
    (folder / "t.json").write_text(json.dumps(truth))
    return folder / "d.json", folder / "t.json"


def test_a_row_of_norths_and_a_row_of_easts(autoferry, tmp_path):
    detections = [
        scan(1, 0, []),
        scan(1, 1, [10, 20]),  # one: north 10, east 20
        scan(2, 2, [[1, 2], [30, 40]]),  # two: norths 1, 2 and easts 30, 40
        scan(2, 3, [[1, 2, 3], [40, 50, 60]]),
        scan(3, 4, 0.5),
        scan(4, 5, [-0.5, 3.0]),
    ]
    truth = [[{"targetID": 1, "position": [0, 0, 0], "time": START}]]
    autoferry.main(*write(tmp_path, detections, truth), tmp_path / "out", ("lidar", "radar", "ir", "eo"))
    plots = read([tmp_path / "out" / "measurements.parquet"]).plots
    plane = plots.kind == Kind.PLANE
    pairs = [(20, 10), (30, 1), (40, 2), (40, 1), (50, 2), (60, 3)]
    assert list(zip(plots.x[plane].tolist(), plots.y[plane].tolist(), strict=True)) == pairs
    bearing = plots.kind == Kind.BEARING
    np.testing.assert_allclose(plots.azimuth[bearing], [0.5, 2 * np.pi - 0.5, 3.0])
    names = np.array([s.system.name for s in plots.sources])[plots.source]
    assert names.tolist() == ["lidar", *["radar"] * 5, "ir", "eo", "eo"]
    assert np.all(plots.reason == 0)


def test_places_of_ship_and_truth(autoferry, tmp_path):
    detections = [scan(1, k, [5, 6], ship=(-100.0 * k, 40.0)) for k in range(3)]
    truth = [
        [
            {"targetID": 1, "position": [10.0 * (k // 2), -200.0, 0], "time": START + k // 2},
            {"targetID": 2, "position": [-300.0, 7.0, 0], "time": START + k + 0.1},
        ]
        for k in range(3)
    ]
    autoferry.main(*write(tmp_path, detections, truth), tmp_path, ("lidar",))
    plots = read([tmp_path / "measurements.parquet"]).plots
    east, north, up = PIREN.transform(
        np.degrees(plots.observer_longitude), np.degrees(plots.observer_latitude), plots.observer_height
    )
    np.testing.assert_allclose(np.stack([east, north, up]), [[40] * 3, [0, -100, -200], [0] * 3], atol=1e-6)
    table = pq.read_table(tmp_path / "truth.parquet").to_pydict()
    assert table["target_id"] == ["1", "1", "2", "2", "2"]  # what is listed again is written once
    np.testing.assert_allclose(np.array(table["time"]) - START, [0, 1, 0.1, 1.1, 2.1], atol=1e-6)
    east, north, _ = PIREN.transform(table["longitude"], table["latitude"], [39.923] * 5)
    np.testing.assert_allclose(east, [-200, -200, 7, 7, 7], atol=1e-3)
    np.testing.assert_allclose(north, [0, 10, -300, -300, -300], atol=1e-3)
    np.testing.assert_allclose([east, north], [table["x_m"], table["y_m"]], atol=1e-3)


def test_the_report_puts_them_where_they_were_seen(autoferry, tmp_path):
    detections = [scan(1, k, [5, 6], ship=(-100.0 * k, 40.0)) for k in range(3)]
    truth = [[{"targetID": 1, "position": [0, 0, 0], "time": START}]]
    autoferry.main(*write(tmp_path, detections, truth), tmp_path, ("lidar",))
    latitude, longitude = np.degrees(plot_positions(read([tmp_path / "measurements.parquet"]).plots, {})).T
    east, north, _ = PIREN.transform(longitude, latitude, [39.923] * 3)
    np.testing.assert_allclose(np.stack([east, north]), [[46] * 3, [5, -95, -195]], atol=1e-3)


def test_a_row_without_observer_is_told(autoferry, tmp_path):
    """Where neither the row nor the configuration says from where: a reason, a count, and both ways to mend it."""
    detections = [scan(1, k, [5, 6 + k]) for k in range(6)] + [scan(3, 6, 0.5)]
    truth = [[{"targetID": 1, "position": [0, 0, 0], "time": START}]]
    autoferry.main(*write(tmp_path, detections, truth), tmp_path, ("lidar", "ir"))
    table = pq.read_table(tmp_path / "measurements.parquet")
    ship = table["observer_x_m"].to_numpy().copy()
    ship[[2, 6]] = np.nan
    table = table.set_column(table.column_names.index("observer_x_m"), "observer_x_m", [ship])
    pq.write_table(table, tmp_path / "holes.parquet")
    summary = track_files([tmp_path / "holes.parquet"], tmp_path, EXAMPLES / "autoferry.toml", report=False)
    assert summary["reasons"]["site unknown"] == 2
    told = [p for p in summary["problems"] if "relative to a site" in p]
    assert [p.partition(":")[0] for p in told] == ["lidar", "ir"]  # as they first report
    assert all("[[sensor]]" in p and "observer_latitude" in p for p in told)


def boats(time):
    """Two boats on straight courses, north and east of the origin at the times."""
    return np.array([[50.0 + 2.0 * time, -200.0 + 3.0 * time], [150.0 - 1.0 * time, 250.0 - 2.5 * time]])


@pytest.mark.parametrize("only", [("radar",), ("lidar",), ("radar", "lidar")], ids="+".join)
def test_boats_from_a_moving_ship(autoferry, tmp_path, rng, only):
    """From a ship that itself moves at 3 m/s the boats are found where they are, and no track turns."""
    detections = []
    for sensor, period, sigma in ((1, 0.5, 1.5), (2, 1.7, 3.0)):
        for t in np.arange(0.0, 40.0, period):
            ship = np.array([3.0 * t, -1.0 * t])
            seen = boats(t) - ship + sigma * rng.standard_normal((2, 2))
            seen = seen[rng.random(2) < 0.9]
            if len(seen):
                flat = seen[0].tolist() if len(seen) == 1 else seen.T.tolist()
                detections.append(scan(sensor, t, flat, ship.tolist()))
    detections.sort(key=lambda d: d["time"])
    truth = [
        [{"targetID": k, "position": [*boats(t)[k].tolist(), 0], "time": START + t} for k in (0, 1)]
        for t in np.arange(0.0, 40.0, 0.2)
    ]
    autoferry.main(*write(tmp_path, detections, truth), tmp_path, only)
    track_files([tmp_path / "measurements.parquet"], tmp_path / "out", EXAMPLES / "autoferry.toml", report=False)
    found = score_files(tmp_path / "out", tmp_path / "truth.parquet")
    assert found["completeness"] > 0.75  # three scans to be confirmed, one to the end, of twenty-four
    assert (found["id_switches"], found["tracks"], found["false_tracks"]) == (0, 2, 0.0)
    assert found["rmse_m"] < {("radar",): 3.0, ("lidar",): 1.5}.get(only, 1.5)  # one scan's error, and less


def test_a_recorded_scenario(autoferry, tmp_path, recordings):
    """Scenario 16: radar and lidar follow both boats."""
    folder = recordings / "autoferry"
    paths = folder / "scenario16_detections.json", folder / "scenario16_groundTruth.json"
    autoferry.main(*paths, tmp_path, ("radar", "lidar"))
    inputs = [tmp_path / "measurements.parquet"]
    summary = track_files(inputs, tmp_path / "out", EXAMPLES / "autoferry.toml", report=False)
    assert summary["noise"]["lidar"]["update_period_s"] == pytest.approx(0.504, abs=0.01)
    assert summary["noise"]["radar"]["update_period_s"] == pytest.approx(1.68, abs=0.03)
    found = score_files(tmp_path / "out", tmp_path / "truth.parquet")
    assert found["completeness"] > 0.85
    assert found["rmse_m"] < 7.0
    assert found["id_switches"] == 0


DETECTIONS = json.dumps([scan(2, 0, [10, 20])])
TRUTH = json.dumps([[{"targetID": 1, "position": [0, 0, 0], "time": START}]])


@pytest.mark.parametrize(
    ("detections", "truth", "words"),
    [
        (DETECTIONS[:-9], TRUTH, r"d\.json: no JSON, or a part of it"),
        ("", TRUTH, r"d\.json: no JSON"),
        ("{}", TRUTH, r"d\.json: detections: a list of scans .* this is empty"),
        (None, TRUTH, r"d\.json: No such file"),
        (TRUTH, TRUTH, r"d\.json: detections: a list of scans .*an entry of this is another"),
        (DETECTIONS, DETECTIONS, r"t\.json: truth: a list of lists of targets .*an entry of this is another"),
        (DETECTIONS, "[[]]", r"t\.json: truth"),
        (json.dumps([scan(2, 0, [1, 2, 3])]), TRUTH, r"d\.json: detections"),
        (json.dumps([scan(7, 0, [1, 2])]), TRUTH, r"d\.json: detections: .*KeyError: 7"),
    ],
)
def test_files_of_another_kind_end_in_one_line(autoferry, tmp_path, detections, truth, words):
    for name, text in (("d", detections), ("t", truth)):
        if text is not None:
            (tmp_path / f"{name}.json").write_text(text)
    with pytest.raises(SystemExit, match=words) as caught:
        autoferry.main(tmp_path / "d.json", tmp_path / "t.json", tmp_path / "out", ("radar",))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_a_sensor_that_is_not_there(autoferry, tmp_path):
    with pytest.raises(SystemExit, match="no sensor 'sonar'; there are lidar, radar, ir, eo"):
        autoferry.main(tmp_path / "d.json", tmp_path / "t.json", tmp_path / "out", ("sonar",))


def test_the_picture_needs_a_demonstration(tmp_path):
    (tmp_path / "tracks.parquet").write_bytes(b"")
    with pytest.raises(SystemExit, match=r"no sensors\.toml in it; name a folder that saltus demo wrote"):
        loaded("plots_and_tracks").main(tmp_path, tmp_path / "p.png")


def test_the_configuration_is_read():
    config = load_config(EXAMPLES / "autoferry.toml")
    assert [s.name for s in config.sensor] == ["radar", "lidar", "ir", "eo"]
