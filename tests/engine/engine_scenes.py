"""Reports of simulated radars, for sessions."""

import numpy as np
import pyarrow as pa

from saltus.demo import write_demo
from saltus.geo import Plane, Site
from saltus.records import Kind, Plots, Source, System, Traits
from saltus.simulate import Leg, Radar, Trajectory, observe

SITES = (Site(*np.radians([48.0, 11.0]).tolist(), 500.0), Site(*np.radians([48.1, 11.4]).tolist(), 300.0))
PLANE = Plane(SITES[0].latitude, SITES[0].longitude)
SECONDS = 100.0


def radars_toml():
    """Return the configuration of the radars' sites; a minute is the first stretch."""
    text = "[setup]\nseconds = 60.0\nfewest = 1\n"
    for sic, site in enumerate(SITES, start=1):
        text += f"[[sensor]]\nsac = 1\nsic = {sic}\nheight = {site.height}\n"
        text += f"latitude = {np.degrees(site.latitude):.9f}\nlongitude = {np.degrees(site.longitude):.9f}\n"
    return text


def demo_start(folder, seed, share=0.5):
    """Write the demonstration's recordings up to a share of their bytes, in whole blocks, and its configuration."""
    made = write_demo(folder / "scene", seed)
    files = []
    for path in made.files:
        content, end = path.read_bytes(), 0
        while end < share * len(content):
            end += int.from_bytes(content[end + 1 : end + 3])
        files.append(folder / path.name)
        files[-1].write_bytes(content[:end])
    config = folder / "config.toml"
    config.write_text(made.config.read_text() + "\n[setup]\nseconds = 60.0\nfewest = 1\n")
    return [*map(str, files)], config


def aircraft(rng, seconds):
    """Eight flights, each with a turn."""
    return [
        Trajectory(
            (*rng.uniform(-4e4, 4e4, 2).tolist(), float(rng.uniform(3e3, 1e4))),
            float(rng.uniform(0.0, 6.28)),
            float(rng.uniform(120.0, 240.0)),
            (Leg(40.0), Leg(40.0, turn_rate=0.03), Leg(seconds)),
        )
        for _ in range(8)
    ]


def centre(seed=1, seconds=SECONDS, period=4.0):
    """Tracks of another centre of the aircraft that `scene` with this seed has, 50 m wrong, in order of time."""
    rng = np.random.default_rng(seed)
    flights, errors = aircraft(rng, seconds), np.random.default_rng(seed + 1)
    times = np.arange(1.0, seconds, period)
    rows = []
    for k, flight in enumerate(flights):
        motion = flight.at(times)
        place = motion.position[:, :2] + errors.normal(0.0, 50.0, 2)
        latitude, longitude = np.degrees(PLANE.inverse(place))
        rows += zip(times, [k + 100] * len(times), latitude, longitude, *motion.velocity[:, :2].T, strict=True)
    names = ("time", "track_number", "latitude", "longitude", "vx", "vy")
    columns = dict(zip(names, zip(*sorted(rows), strict=True), strict=True))
    none = [None] * len(rows)
    same = {"system": ["CAT062:1/9"] * len(rows), "coasted": [0.0] * len(rows), "mode3a": none, "icao24": none}
    return pa.table({**columns, **same})


def scene(radars, seed=1, seconds=SECONDS):
    """Reports of radars that see eight aircraft, with clutter, in order of time."""
    rng = np.random.default_rng(seed)
    flights = aircraft(rng, seconds)
    codes = np.array([*(0x3C6444 + np.arange(4)), -1, -1, -1, -1, -1], np.int32)
    columns = {}
    for k in range(radars):
        radar = Radar(SITES[k], 4.0 + k, 30.0, 1e-3, 10.0, clutter_per_scan=3.0, north_time=0.7 * k)
        seen = observe(radar, flights, PLANE, 0.0, seconds, rng)
        part = {"time": seen.time, "range": seen.slant, "azimuth": seen.azimuth, "altitude": seen.altitude}
        part |= {"source": np.full(len(seen.time), k), "icao24": codes[seen.target]}
        for name, values in part.items():
            columns.setdefault(name, []).append(values)
    whole = {name: np.concatenate(parts) for name, parts in columns.items()}
    n = len(whole["time"])
    whole |= {"file": np.zeros(n), "record": np.arange(n), "kind": np.full(n, Kind.POLAR)}
    sources = tuple(Source(System(48, 1, k + 1), Traits(rotating=True)) for k in range(radars))
    return Plots.build(n, sources, ("simulated",), whole).sorted_by_time()
