"""How many plots a second does the tracker take?

    python benchmarks/tracker_speed.py [RECORDING... --config FILE]

Two simulated radars see the same aircraft, with clutter, and update common tracks; the default filters (eight modes:
four horizontal, two vertical) and chains of faults, one thread. Recordings are tracked as `saltus track` does. The
fastest of three runs; of recordings the time includes the estimation of noise and everything after decoding.
"""

import argparse
import math
import tempfile
import time
from pathlib import Path

import numpy as np

from saltus.geo import Plane, Site
from saltus.records import Kind, Plots, Source, System
from saltus.run import track_files
from saltus.simulate import Leg, Radar, Trajectory, observe
from saltus.tracks.measurements import Measurements, Noise, place_plots
from saltus.tracks.settings import FilterSettings, TrackerSettings
from saltus.tracks.sources import learn_setup
from saltus.tracks.tracker import Tracker

_REPEATS, _SECONDS = 3, 600.0
_PERIODS = (4.0, 5.0)


def main() -> None:
    """Print one line for each scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", type=Path, nargs="*")
    parser.add_argument("--config", type=Path)
    given = parser.parse_args()
    print(f"{'scene':34}{'plots':>8}{'s':>8}{'plots/s':>10}")
    for aircraft in (20, 100, 300):
        m = scene(np.random.default_rng(0), aircraft)
        seconds = min(tracked(m) for _ in range(_REPEATS))
        print(f"{f'two radars, {aircraft} aircraft':34}{len(m):8d}{seconds:8.2f}{len(m) / seconds:10.0f}", flush=True)
    for path in given.recordings:
        runs = [recorded(path, given.config) for _ in range(_REPEATS)]
        plots, seconds = min(runs, key=lambda run: run[1])
        print(f"{path.name:34}{plots:8d}{seconds:8.2f}{plots / seconds:10.0f}", flush=True)


def scene(rng: np.random.Generator, aircraft: int) -> Measurements:
    """What two radars measure of aircraft that fly straight and turn within 150 km."""
    site = Site(float(np.radians(48.0)), float(np.radians(11.0)), 500.0)
    other = Site(site.latitude, site.longitude + float(np.radians(0.8)), 500.0)
    plane = Plane(site.latitude, site.longitude)
    radars = [
        Radar(s, p, 40.0, 0.001, 10.0, 0.95, clutter_per_scan=5.0, max_range=200e3, north_time=0.7 * k)
        for k, (s, p) in enumerate(zip((site, other), _PERIODS, strict=True))
    ]
    flights = []
    for _ in range(aircraft):
        x, y = rng.uniform(-120e3, 120e3, 2)
        legs = (Leg(rng.uniform(60.0, 300.0)), Leg(40.0, turn_rate=rng.choice([-1, 1]) * 0.03), Leg(_SECONDS))
        start = (float(x), float(y), float(rng.uniform(3e3, 11e3)))
        flights.append(Trajectory(start, float(rng.uniform(0.0, 6.28)), float(rng.uniform(120.0, 250.0)), legs))
    seen = [observe(radar, flights, plane, 0.0, _SECONDS, rng) for radar in radars]
    n = sum(len(s.time) for s in seen)
    columns = {
        "time": np.concatenate([s.time for s in seen]),
        "source": np.repeat([0, 1], [len(s.time) for s in seen]),
        "range": np.concatenate([s.slant for s in seen]),
        "azimuth": np.concatenate([s.azimuth for s in seen]),
        "altitude": np.concatenate([s.altitude for s in seen]),
        "file": np.zeros(n),
        "record": np.arange(n),
        "kind": np.full(n, Kind.POLAR),
    }
    plots = Plots.build(n, tuple(Source(System(48, 1, k)) for k in (1, 2)), ("simulated",), columns)
    plots = plots.take(np.argsort(plots.time, kind="stable"))
    noise = {k: Noise(range=r.sigma_range, azimuth=r.sigma_azimuth, altitude=30.0) for k, r in enumerate(radars)}
    return place_plots(plots, plane, [site, other], noise, TrackerSettings().height_prior)


def tracked(m: Measurements) -> float:
    """Seconds of processor time of one run of the tracker."""
    tracker = Tracker(TrackerSettings(), FilterSettings(), learn_setup(m, _PERIODS), use_identity=False)
    began = time.process_time()
    tracker.feed(m, until=math.inf)
    return time.process_time() - began


def recorded(path: Path, config: Path | None) -> tuple[int, float]:
    """Reports of a recording, and seconds of tracking them."""
    with tempfile.TemporaryDirectory() as folder:
        summary = track_files([path], Path(folder), config, report=False)
    reports, seconds = summary["reports"], summary["seconds"]
    assert isinstance(reports, dict) and isinstance(seconds, dict)
    return int(reports["used"]), float(seconds["tracking"])


if __name__ == "__main__":
    main()
