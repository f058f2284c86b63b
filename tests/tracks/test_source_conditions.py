"""Which of several sensors has failed: a radar and a camera at one place, told apart by who disagrees with whom."""

import numpy as np
import pytest
from tracking_scenes import SITE, fed, tracker_of

from saltus.geo import Plane
from saltus.records import Kind, Plots, Source, System
from saltus.tracks.health import degraded_intervals
from saltus.tracks.measurements import Noise, place_plots
from saltus.tracks.settings import FilterSettings, TrackerSettings

PLANE = Plane(SITE.latitude, SITE.longitude)
NOISE = {0: Noise(range=30.0, azimuth=float(np.radians(0.08))), 1: Noise(azimuth=float(np.radians(0.05)))}
PERIODS = [4.0, 2.0]


def scene(rng, *, targets, until=400, bad=1.0, which=1, wrong=(150.0, 250.0)):
    """Targets about the sensors, 25 km away at first; the errors of azimuth of one sensor are `bad` times as large."""
    rows = []
    for i in range(targets):
        angle = 2 * np.pi * i / targets + 0.3
        place, velocity = (a * np.array([np.sin(b), np.cos(b)]) for a, b in ((25e3, angle), (120.0, angle + 0.6)))
        for t in np.arange(until) + 0.01 * i:
            radar, camera = t % 4 < 1.0, t % 2 < 1.0
            for source, seen, shift in ((0, radar, 0.0), (1, camera, 0.5)):
                if seen:
                    q = place + velocity * (t + shift)
                    factor = bad if source == which and wrong[0] <= t < wrong[1] else 1.0
                    azimuth = np.arctan2(*q) + factor * NOISE[source].azimuth * rng.standard_normal()
                    range_ = np.hypot(*q) + 30.0 * rng.standard_normal() if source == 0 else np.nan
                    rows.append((t + shift, source, range_, azimuth % (2 * np.pi)))
    table = np.array(sorted(rows))
    columns = {"time": table[:, 0], "source": table[:, 1], "range": table[:, 2], "azimuth": table[:, 3]}
    columns["kind"] = np.where(table[:, 1] == 0, Kind.POLAR, Kind.BEARING)
    sources = tuple(Source(System(None, None, None, name)) for name in ("radar", "camera"))
    plots = Plots.build(len(table), sources, ("t",), columns)
    return place_plots(plots, PLANE, [SITE, SITE], NOISE, (0.0, 30.0))


def conditions(m):
    rows, found = fed(tracker_of(m, settings=TrackerSettings(), filters=FilterSettings(), periods=PERIODS), m)
    return [degraded_intervals(c.history, c.law) for c in found.sources], rows, found


@pytest.mark.parametrize("seed", [0, 1])
def test_a_camera_that_fails_is_found_and_the_radar_is_not_blamed(seed):
    m = scene(np.random.default_rng(seed), targets=6, bad=10.0)
    (radar, camera), rows, _ = conditions(m)
    assert radar == []
    assert len(camera) == 1
    assert 150.0 <= camera[0].time_from <= 170.0
    assert 245.0 <= camera[0].time_to <= 280.0
    assert camera[0].condition == "azimuth degraded"
    judged = np.isfinite(rows.p_fault[rows.measurement >= 0])
    assert np.isfinite(rows.p_degraded[rows.measurement >= 0]).mean() > 0.95
    assert judged.mean() > 0.95


def test_a_radar_that_fails_is_found_and_the_camera_is_not_blamed():
    m = scene(np.random.default_rng(3), targets=6, bad=10.0, which=0)
    (radar, camera), *_ = conditions(m)
    assert camera == []
    assert [150.0 <= d.time_from <= 170.0 and d.condition.startswith("azimuth") for d in radar] == [True]


@pytest.mark.parametrize("seed", [0, 1])
def test_crossing_bearings_degrade_nobody(seed):
    (radar, camera), _, found = conditions(scene(np.random.default_rng(seed), targets=10))
    assert len(found.confirmed) == 10
    assert radar == camera == []
