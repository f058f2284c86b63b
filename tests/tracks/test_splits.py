"""Second echoes of a radar: told by going together, joined to the object's track, kept out of its state."""

import csv

import numpy as np
import pyarrow.parquet as pq
import pytest

from saltus.identify import LocalTracks
from saltus.run import track_files
from saltus.tracks.encounters import SystemTracks
from saltus.tracks.local import LocalSystem
from saltus.tracks.membership import Segments
from saltus.tracks.picture import Picture
from saltus.tracks.settings import FilterSettings, RegistrationSettings, SystemsSettings
from saltus.tracks.splits import echo_rows, second_echoes
from saltus.tracks.systems import Region, pairing_settings


def radar(*ways, sigma=3.0, seed=0, polar=True):
    """A system of local tracks, each a function of time that returns positions and velocities."""
    rng, times = np.random.default_rng(seed), np.arange(0.0, 120.0, 1.0)
    track = np.repeat(np.arange(len(ways)), len(times))
    seen = [way(times) for way in ways]
    position = np.concatenate([p for p, _ in seen]) + sigma * rng.standard_normal((len(track), 2))
    velocity = np.concatenate([v for _, v in seen])
    time, n = np.tile(times, len(ways)), len(ways)
    R = np.broadcast_to(sigma**2 * np.eye(2), (len(track), 2, 2)).copy()
    ray = position if polar else np.full_like(position, np.nan)
    view = SystemTracks(LocalTracks(track, time, position, R), velocity, ray, np.full(n, -1))
    nothing = np.full(n, -1)
    ids, rows, codes = np.arange(1, n + 1), np.arange(len(track)), np.full((len(track), 2), -1)
    return LocalSystem("radar", view, nothing, ("",) * n, np.full(n, 3.0), ids, rows, sigma, time, codes)


def taxiing(x, y, speed=8.0):
    """East, then to the left: what goes together keeps its distance, along the way too."""

    def way(t):
        turn = np.clip((t - 50.0) / 20.0, 0.0, 1.0) * 0.8
        v = speed * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        return np.array([x, y]) + np.cumsum(v, axis=0), v

    return way


def parked(x, y):
    return lambda t: (np.tile([x, y], (len(t), 1)), np.zeros((len(t), 2)))


def looked_at(system, until=120.0):
    """Look at a radar alone every ten seconds."""
    picture = Picture(["radar"], [0], [1.0], SystemsSettings(), RegistrationSettings(), FilterSettings())
    for now in np.arange(10.0, until + 1.0, 10.0).tolist():
        picture.look(now, [system])
    return picture


def test_echoes_that_go_together_are_one_object_and_neighbours_are_not():
    system = radar(
        taxiing(-800.0, 300.0),
        taxiing(-780.0, 310.0),  # its second echo
        taxiing(-920.0, 300.0),  # the next in the queue
        parked(500.0, -400.0),
        parked(525.0, -400.0),  # beside it
        taxiing(-700.0, 1500.0, 12.0),
    )
    found = looked_at(system).decisions()
    pairs = set(zip(found.episodes.a.tolist(), found.episodes.b.tolist(), strict=True))
    assert pairs == {(0, 1)}
    assert found.episodes.probability.min() > 0.999


def test_only_radars_have_second_echoes():
    ways = taxiing(-800.0, 300.0), taxiing(-780.0, 310.0)
    assert len(echo_rows(radar(*ways).view, own=True).time)
    assert not len(echo_rows(radar(*ways).view, own=False).time)
    assert not len(echo_rows(radar(*ways, polar=False).view, own=True).time)
    assert not len(echo_rows(radar(parked(0.0, 300.0), parked(20.0, 300.0)).view, own=True).time)


def test_the_later_of_two_tracks_of_one_system_is_the_echo():
    segments = Segments(
        track=np.array([0, 1, 1, 2, 3]),
        time_from=np.array([0.0, 10.0, 40.0, 5.0, 50.0]),
        time_to=np.array([60.0, 40.0, 80.0, 70.0, 55.0]),
        system_track=np.array([1, 2, 1, 1, 1]),
        probability=np.ones(5),
        time_known=np.full(5, 80.0),
    )
    spells = second_echoes(segments, np.array([0, 0, 1, 0]))
    assert sorted(spells) == [(1, 40.0, 60.0), (3, 50.0, 55.0), (3, 50.0, 55.0)]


@pytest.fixture(scope="module")
def aerodrome(tmp_path_factory):
    """One aircraft on a taxiway, twice seen by a radar and told by ADS-B, and others in the air."""
    folder, rng = tmp_path_factory.mktemp("splits"), np.random.default_rng(3)
    aloft = [(rng.uniform(-4e3, 4e3, 2), 60.0 * rng.standard_normal(2)) for _ in range(5)]
    site = "latitude = 48.0\nlongitude = 11.0\nheight = 0.0\n"
    config = '[systems]\nreference = "ads-b"\n'
    config += f'[[sensor]]\nname = "ads-b"\nsystem = "ads-b"\nsigma_xy = 4.0\n{site}'
    config += f'[[sensor]]\nname = "radar"\nsystem = "radar"\nsigma_range = 3.0\nsigma_azimuth = 0.05\n{site}'
    config += "period = 1.0\n"
    (folder / "two.toml").write_text(config + "[tracker]\nsplit_range = 5.0\n")
    for name in ("radar", "ads-b"):
        rows = []
        for t in np.arange(0.0, 200.0, 1.0):
            here = np.array([-900.0 + 9.0 * t, 1500.0])
            targets = [(here, "3C0001"), *((p + v * t, f"3C001{k}") for k, (p, v) in enumerate(aloft))]
            if name == "radar" and t >= 20.0:
                targets.append((here + np.array([22.0, 12.0]), ""))
            for (x, y), code in targets:
                x, y = np.array([x, y]) + 3.0 * rng.standard_normal(2)
                row = {"time": 1.7e9 + t + rng.uniform(0.0, 0.1), "source": name, "altitude_m": 0.0}
                polar = {"range_m": np.hypot(x, y), "azimuth_deg": np.degrees(np.arctan2(x, y)) % 360.0}
                rows.append(row | (polar if name == "radar" else {"x_m": x, "y_m": y, "icao24": code}))
        columns = ["time", "source", "icao24", "range_m", "azimuth_deg", "x_m", "y_m", "altitude_m"]
        with (folder / f"{name}.csv").open("w", newline="") as file:
            table = csv.DictWriter(file, columns, restval="")
            table.writeheader()
            table.writerows(sorted(rows, key=lambda row: row["time"]))
    track_files([folder / "radar.csv", folder / "ads-b.csv"], folder / "out", folder / "two.toml", report=False)
    return folder / "out"


def test_a_second_echo_belongs_to_the_track_and_does_not_move_it(aerodrome):
    found = pq.read_table(aerodrome / "identifications.parquet").to_pylist()
    (track,) = {row["track_id"] for row in found if row["local_id"] == "3C0001" and row["time_to"] > 1.7e9 + 150.0}
    mine = [row for row in found if row["track_id"] == track and row["system"] == "radar"]
    assert sum(row["time_from"] < 1.7e9 + 150.0 < row["time_to"] for row in mine) == 2  # both echoes
    since = max(row["time_from"] for row in mine) - 1.7e9
    assert since < 100.0
    rows = pq.read_table(aerodrome / "tracks.parquet")
    rows = rows.filter((np.array(rows["track_id"]) == track) & (np.array(rows["time"]) > 1.7e9 + since))
    rows = rows.filter(np.array(rows["status"].to_pylist()) == "confirmed")
    assert rows.num_rows > 150
    north = (np.array(rows["latitude"]) - 48.0) * 111_190.0  # the echo lies 12 m further north
    assert abs(north.mean() - 1500.0) < 3.0
    assert np.abs(north - 1500.0).max() < 9.0


def test_objects_move_as_the_filters_say():
    """Levels of acceleration as configured; a turn and the hardest of them are one manoeuvre."""
    region = Region()
    region.add(radar(parked(0.0, 300.0)).view.tracks.z)
    found = pairing_settings([region], SystemsSettings(), FilterSettings(), 0.0)
    assert (found.accel, found.sojourn, found.accel_time) == ((0.15, 3.0), (150.0, 25.0), 4.0)
    boats = FilterSettings(accel_h=(0.01, 0.1, 0.5), sojourn_h=(60.0, 30.0, 20.0), turn_rate=(), accel_time=0.0)
    found = pairing_settings([region], SystemsSettings(), boats, 0.0)
    assert (found.accel, found.sojourn, found.accel_time) == ((0.01, 0.1, 0.5), (60.0, 30.0, 20.0), 4.0)
    assert pairing_settings([region], SystemsSettings(), FilterSettings(accel_time=2.0), 0.0).accel_time == 2.0
