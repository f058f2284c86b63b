"""Several systems in one run, on simulated scenes: identification, registration, fused states, conflicts."""

import csv
import json
from typing import NamedTuple

import numpy as np
import pyarrow.parquet as pq
import pytest

from saltus.geo import Plane
from saltus.run import track_files

PLANE = Plane(*np.radians([48.0, 11.0]))
EPOCH = 1748772000.0
SITES = {"west": (-15e3, -5e3), "east": (20e3, 12e3)}
GLOBAL = "global"  # a system that reports latitude and longitude


class Run(NamedTuple):
    labels: np.ndarray  # object of each report, in the order of assignments
    source: np.ndarray
    track_id: np.ndarray
    tracks: object
    identifications: list
    biases: dict
    summary: dict


def flights(n, rng, seconds):
    """Straight flights within 40 km, no two near each other for long: (n, 2) positions and velocities."""
    course = np.linspace(0, 2 * np.pi, n, endpoint=False) + 0.3
    heading = np.stack([np.sin(course), np.cos(course)], -1)
    velocity = rng.uniform(120, 230, n)[:, None] * heading
    across = np.stack([heading[:, 1], -heading[:, 0]], -1) * np.linspace(-25e3, 25e3, n)[:, None]
    return across - 0.5 * seconds * velocity, velocity


def reports(rng, source, start, velocity, seconds, *, period=4.0, seen=None, code=None, azimuth=0.0, offset=(0.0, 0.0)):
    """Rows of one system's table: a radar of 25 m and 0.05 degrees, or positions to 15 m."""
    rows = []
    for k in range(len(start)):
        t = np.arange(rng.uniform(0, period), seconds, period)
        t = t[rng.random(len(t)) < 0.97]
        if seen is not None:
            t = t[seen(k, t)]
        true = start[k] + velocity[k] * t[:, None]
        if source in SITES:
            site = np.array(SITES[source])
            ray = true - site
            r = np.hypot(*ray.T) + 25.0 * rng.standard_normal(len(t))
            convergence, _ = PLANE.factors_at(*PLANE.inverse(site))
            a = np.degrees(np.arctan2(*ray.T) + convergence) + azimuth + 0.05 * rng.standard_normal(len(t))
            place = [{"range_m": x, "azimuth_deg": y % 360.0} for x, y in zip(r, a, strict=True)]
        else:
            z = true + np.asarray(offset) + 15.0 * rng.standard_normal(true.shape)
            lat, lon = np.degrees(PLANE.inverse(z))
            place = [{"latitude": x, "longitude": y} for x, y in zip(lat, lon, strict=True)]
        address = "" if code is None else code(k)
        rows += [
            {"time": EPOCH + s, "source": source, "icao24": address, "label": k, **p}
            for s, p in zip(t, place, strict=True)
        ]
    return rows


def run(folder, tables, identity="use", extra=""):
    """Track one table for each system; the labels come back in the order of the assignments."""
    columns = ["time", "source", "icao24", "label", "range_m", "azimuth_deg", "latitude", "longitude", "altitude_m"]
    config, files = extra, []
    for rows in tables:
        rows.sort(key=lambda row: row["time"])
        name = rows[0]["source"]
        path = folder / f"{name}.csv"
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, columns, restval="")
            writer.writeheader()
            writer.writerows({**row, "altitude_m": 0.0} for row in rows)
        files.append(path)
        config += f'[[sensor]]\nname = "{name}"\nsystem = "{name}"\nperiod = 4.0\n'
        if name in SITES:
            lat, lon = np.degrees(PLANE.inverse(np.array(SITES[name])))
            config += f"latitude = {lat:.9f}\nlongitude = {lon:.9f}\nheight = 0.0\n"
    (folder / "c.toml").write_text(config)
    out = folder / "out"
    summary = track_files(files, out, folder / "c.toml", None, identity, None, None, report=False)
    a = pq.read_table(out / "assignments.parquet")
    label = {rows[0]["source"]: [row["label"] for row in rows] for rows in tables}
    source = np.array([name.removesuffix(".csv") for name in a["source"].to_pylist()])
    labels = np.array([label[s][r] for s, r in zip(source, a["record"].to_pylist(), strict=True)])
    found = pq.read_table(out / "identifications.parquet").to_pylist()
    tracks = pq.read_table(out / "tracks.parquet")
    biases = json.loads((out / "biases.json").read_text())
    return Run(labels, source, a["track_id"].fill_null(-1).to_numpy(), tracks, found, biases, summary)


def owners(found, time_from=0.0):
    """System tracks of each object's reports, the most frequent first."""
    out = {}
    for k in np.unique(found.labels):
        ids, count = np.unique(found.track_id[(found.labels == k) & (found.track_id > 0)], return_counts=True)
        out[int(k)] = ids[np.argsort(-count)].tolist()
    return out


def test_two_radars_with_an_azimuth_bias_and_no_codes(tmp_path):
    rng = np.random.default_rng(1)
    seconds, n = 420.0, 10
    start, velocity = flights(n, rng, seconds)
    west = reports(rng, "west", start, velocity, seconds)
    east = reports(rng, "east", start, velocity, seconds, azimuth=0.6)
    found = run(tmp_path, [west, east], "ignore", '[systems]\nreference = "west"\n')
    bias = found.biases["systems"]["east"]
    azimuth = bias["biases"]["azimuth_deg"]
    assert abs(azimuth["value"] - 0.6) < 4.0 * azimuth["sd"]
    assert azimuth["sd"] < 0.1
    assert bias["relative_to"] == found.biases["reference"] == "west"
    late = found.tracks["time"].to_numpy() > EPOCH + 240.0
    owner = owners(found)
    position = PLANE.forward(*np.radians([found.tracks[c].to_numpy() for c in ("latitude", "longitude")]))
    ids, time = found.tracks["track_id"].to_numpy(), found.tracks["time"].to_numpy() - EPOCH
    main = [owner[k][0] for k in range(n)]
    assert len(set(main)) == n
    for k in range(n):
        at = late & (ids == main[k])
        for name in SITES:  # both radars feed one track
            mine = (found.labels == k) & (found.source == name) & (found.track_id == main[k])
            assert mine.sum() > 0.97 * ((found.labels == k) & (found.source == name)).sum()  # from the first report
        error = position[at] - (start[k] + velocity[k] * time[at][:, None])
        assert np.sqrt((error**2).sum(-1).mean()) < 60.0  # the bias alone is 300 m at 30 km
    # What is learnt of a bias moves no target: neither its speed nor the sensor's good name suffers.
    settled = (found.tracks["status"].to_numpy(zero_copy_only=False) == "confirmed") & (time > 60.0)
    speed = found.tracks["speed_mps"].to_numpy()
    for k in range(n):
        at = settled & (ids == main[k])
        assert np.abs(speed[at] - np.hypot(*velocity[k])).max() < 30.0
    assert sum(f["flagged_plots"] for f in found.summary["faults"].values()) < 0.01 * len(found.labels)
    given_up = [row for row in found.identifications if row["merged_into"] is not None]
    assert len(given_up) >= n  # announced, each once it is known
    assert not {row["track_id"] for row in given_up} & set(ids.tolist())
    assert {row["merged_into"] for row in given_up} <= set(ids.tolist())
    order = [(row["time_known"], row["track_id"], row["time_from"]) for row in found.identifications]
    assert order == sorted(order)
    mixed = [t for t in np.unique(ids) if len(np.unique(found.labels[found.track_id == t])) > 1]
    assert not mixed


def test_gaps_of_one_system_are_bridged_and_a_third_joins(tmp_path):
    """East sees nothing for a minute, west and the global system go on: one system track for each object."""
    rng = np.random.default_rng(2)
    seconds, n = 260.0, 6
    start, velocity = flights(n, rng, seconds)

    def code(k):
        return f"3C000{k}"

    def seen(k, t):
        return (t < 90.0) | (t > 150.0)

    tables = [
        reports(rng, "west", start, velocity, seconds, code=code),
        reports(rng, "east", start, velocity, seconds, seen=seen, code=code),
        reports(rng, GLOBAL, start, velocity, seconds, period=2.0, seen=lambda k, t: t > 40.0),
    ]
    found = run(tmp_path, tables)
    for k, ids in owners(found).items():
        share = (found.track_id[found.labels == k] == ids[0]).mean()
        assert share > 0.98
        of = {row["system"] for row in found.identifications if row["track_id"] == ids[0]}
        assert of == {"west", "east", GLOBAL}
        pieces = [r for r in found.identifications if r["track_id"] == ids[0] and r["system"] == "east"]
        assert len(pieces) == 2
        assert {r["local_id"] for r in pieces} == {code(k)}
        assert all(0.99 < r["probability"] <= 1.0 for r in pieces)
    time = found.tracks["time"].to_numpy()
    ids = found.tracks["track_id"].to_numpy()
    assert (np.diff(time[np.lexsort((time, ids))]) >= 0)[np.diff(np.sort(ids)) == 0].all()
    assert found.summary["systems"]["east"]["identified_with_another_system"] == 2 * n
    assert time.max() < EPOCH + seconds  # nobody coasts beyond the last report
    for bias in found.biases["systems"].values():
        assert bias["relative_to"] == found.biases["reference"] == GLOBAL
        assert bias["compared_with"] in {"west", "east", GLOBAL}


def test_two_addresses_claim_one_object(tmp_path):
    """Both systems see one aircraft and name it differently: never one track, and a line for the user."""
    rng = np.random.default_rng(3)
    seconds, n = 200.0, 5
    start, velocity = flights(n, rng, seconds)
    west = reports(rng, "west", start, velocity, seconds, code=lambda k: f"3C000{k}")
    other = reports(rng, GLOBAL, start, velocity, seconds, code=lambda k: "4CAAAA" if k == 2 else f"3C000{k}")
    found = run(tmp_path, [west, other])
    tracks = {s: set(found.track_id[(found.labels == 2) & (found.source == s)]) - {-1} for s in ("west", GLOBAL)}
    assert not tracks["west"] & tracks[GLOBAL]
    (line,) = (p for p in found.summary["problems"] if "identity conflict" in p)
    assert "3C0002" in line
    assert "4CAAAA" in line
    assert "two by their addresses" in line


def test_formation_that_parts_is_sorted_out(tmp_path):
    """Two aircraft 120 m apart, one of them seen by both systems: when they part, the right one is identified."""
    rng = np.random.default_rng(4)
    seconds = 300.0
    start, velocity = flights(4, rng, seconds)
    start = np.vstack([start, start[:1] + np.array([120.0, 0.0])])
    velocity = np.vstack([velocity, velocity[:1] + np.array([8.0, -8.0])])
    start[4] -= 100.0 * (velocity[4] - velocity[0])  # nearest after 100 s
    west = reports(rng, "west", start, velocity, seconds)
    other = reports(rng, GLOBAL, start[:4], velocity[:4], seconds, period=2.0)
    found = run(tmp_path, [west, other], "ignore")

    def at_end(label, source):
        ids = found.track_id[(found.labels == label) & (found.source == source)][-5:]
        return set(ids.tolist())

    assert at_end(0, GLOBAL) == at_end(0, "west")
    assert not at_end(4, "west") & at_end(0, GLOBAL)


def test_one_system_alone_has_trivial_tables(tmp_path):
    rng = np.random.default_rng(5)
    start, velocity = flights(3, rng, 60.0)
    found = run(tmp_path, [reports(rng, "west", start, velocity, 60.0, code=lambda k: f"3C000{k}")])
    assert found.biases["systems"] == {}
    assert found.biases["reference"] == "west"
    assert len(found.identifications) == 3
    assert {r["local_id"] for r in found.identifications} == {"3C0000", "3C0001", "3C0002"}
    assert {r["probability"] for r in found.identifications} == {1.0}
    assert {r["track_id"] for r in found.identifications} == set(found.tracks["track_id"].to_pylist())
    kinds = pq.read_table(tmp_path / "out" / "identifications.parquet").schema
    columns = ["track_id", "system", "local_id", "time_from", "time_to", "probability", "time_known", "merged_into"]
    assert kinds.names == columns


@pytest.mark.parametrize("line", ['[systems]\nreference = "nobody"\n'])
def test_reference_must_be_there(tmp_path, line):
    from saltus.errors import ModelError

    rng = np.random.default_rng(6)
    start, velocity = flights(3, rng, 60.0)
    tables = [reports(rng, s, start, velocity, 60.0) for s in SITES]
    with pytest.raises(ModelError, match="nobody"):
        run(tmp_path, tables, extra=line)


def test_one_address_far_apart_in_two_systems_is_said(tmp_path):
    """A site half a degree off: nothing is common, and the addresses say why."""
    rng = np.random.default_rng(8)
    start, velocity = flights(5, rng, 200.0)
    near = reports(rng, "mlat", start, velocity, 200.0, code="3C000{}".format)
    far = reports(rng, "adsb", start, velocity, 200.0, code="3C000{}".format, offset=(0.0, 50e3))
    found = run(tmp_path, [near, far])
    (line,) = [p for p in found.summary["problems"] if "in common" in p]
    assert line.startswith("mlat and adsb have 5 addresses in common, ")
    assert 49.0 < float(line.split("common, ")[1].split(" km")[0]) < 51.0


def test_addresses_at_no_common_time_are_said(tmp_path):
    rng = np.random.default_rng(9)
    start, velocity = flights(4, rng, 200.0)
    first = reports(rng, "mlat", start, velocity, 200.0, code="3C000{}".format)
    other = reports(rng, "adsb", start, velocity, 200.0, code="3C000{}".format)
    later = [{**row, "time": row["time"] + 3600.0} for row in other]
    found = run(tmp_path, [first, later])
    assert any("have 4 addresses in common, and none at one time" in p for p in found.summary["problems"])


def test_a_source_that_makes_no_track_is_named(tmp_path):
    """A period a hundred times too short: every report is the first of a new target."""
    rng = np.random.default_rng(10)
    start, velocity = flights(5, rng, 200.0)
    rows = sorted(reports(rng, "west", start, velocity, 200.0), key=lambda row: row["time"])
    with (tmp_path / "west.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    lat, lon = np.degrees(PLANE.inverse(np.array(SITES["west"])))
    site = f"latitude = {lat:.9f}\nlongitude = {lon:.9f}\nheight = 0.0\n"
    (tmp_path / "c.toml").write_text(f'[[sensor]]\nname = "west"\nperiod = 0.04\n{site}')
    summary = track_files([tmp_path / "west.csv"], tmp_path / "out", tmp_path / "c.toml", report=False)
    (said,) = (p for p in summary["problems"] if "no track" in p)
    assert "none got 3 reports in 5 update periods of 0.04 s" in said
    assert "is the update period another" in said


def test_an_altitude_that_nobody_tells_any_more_is_null(tmp_path):
    """It descends at 10 m/s for a minute, then reports no height: what would be far below ground is not published."""
    time = np.arange(0.0, 300.0, 4.0)
    with (tmp_path / "t.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time", "source", "latitude", "longitude", "altitude_m"])
        for t in time.tolist():
            height = f"{900.0 - 10.0 * t:.0f}" if t < 60.0 else ""
            writer.writerow([EPOCH + t, "adsb", 48.0 + 1e-3 * t, 11.0, height])
    track_files([tmp_path / "t.csv"], tmp_path / "out", report=False)
    tracks = pq.read_table(tmp_path / "out" / "tracks.parquet")
    after = tracks["time"].to_numpy() - EPOCH
    told = np.isfinite(tracks["altitude"].to_numpy(zero_copy_only=False).astype(float))
    assert told[(after > 8.0) & (after < 70.0)].all() and not told[after > 200.0].any()
    for column in ("vu", "cov_uu"):
        values = tracks[column].to_numpy(zero_copy_only=False).astype(float)
        np.testing.assert_array_equal(np.isfinite(values), told)


def test_a_system_without_tracks_is_no_reference(tmp_path):
    """Two positions of a third system make no track: the radars are compared with each other as before."""
    rng = np.random.default_rng(12)
    start, velocity = flights(6, rng, 200.0)
    code = "3C000{}".format
    tables = [reports(rng, name, start, velocity, 200.0, code=code) for name in ("west", "east")]
    tables.append([r for r in reports(rng, "adsb", start[:1], velocity[:1], 200.0) if r["time"] < EPOCH + 5.0])
    found = run(tmp_path, tables)
    assert found.biases["reference"] in {"west", "east"}
    finest = reports(rng, "adsb", start, velocity, 200.0, code=code)
    assert run(tmp_path, [*tables[:2], finest]).biases["reference"] == "adsb"
    coarse = [{**row, "latitude": row["latitude"] + 3e-3 * rng.standard_normal()} for row in finest]
    assert run(tmp_path, [*tables[:2], coarse]).biases["reference"] == "adsb"  # a radar has a north of its own
