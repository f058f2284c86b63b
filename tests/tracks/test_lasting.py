"""What lasts of a source's errors, from simulated straight stretches, and the stretches themselves."""

from dataclasses import replace

import numpy as np
import pytest
from tracking_scenes import measured

from saltus.tracks.lasting import Pieces, estimate_lasting, straight_pieces
from saltus.tracks.rows import join_rows
from saltus.tracks.setup_settings import LastingSettings

SETTINGS = LastingSettings()


def wandering(rng, t, tau, size):
    u = np.empty(len(t))
    u[0] = rng.normal()
    for k, dt in enumerate(np.diff(t), 1):
        a = np.exp(-dt / tau)
        u[k] = a * u[k - 1] + np.sqrt(1.0 - a * a) * rng.normal()
    return size * u


def stretches(rng, number, length, step, *, tau=1.0, c=0.0, w=3.0, near=0.0, factor=None):
    """Straight flights with lasting errors c sqrt(1 + (d / near)^2) and white ones w, both times a factor."""
    t = step * np.arange(length) + rng.uniform(0.0, step, (number, 1))
    d = np.abs(rng.uniform(2e3, 2e4, (number, 1)) + rng.uniform(-150.0, 150.0, (number, 1)) * t)
    h = np.ones_like(t) if factor is None else factor + 0.0 * t
    grown = np.sqrt(1.0 + (d / near) ** 2) if near else 1.0
    errors = np.array([wandering(rng, row, tau, c) for row in t]) * grown + rng.normal(0.0, w, t.shape)
    x = rng.uniform(-1e4, 1e4, (number, 1)) + rng.uniform(-200.0, 200.0, (number, 1)) * t
    return Pieces(t, x + h * errors, h, d if near else 0.0 * d)


def test_size_and_rate_of_what_lasts_are_found_and_its_time_is_said_to_be_assumed(rng):
    found = estimate_lasting(stretches(rng, 40, 60, 1.0, tau=40.0, c=25.0), 8.0, 0.09, SETTINGS)
    assert 2.0 * found.lasting**2 / found.time == pytest.approx(31.25, rel=0.15)
    assert found.white == pytest.approx(3.0, rel=0.15)
    assert found.gain > 0.05
    assert found.told == (found.time < 60.0)


def test_a_time_too_short_to_be_the_one_assumed_is_told(rng):
    found = estimate_lasting(stretches(rng, 40, 60, 1.0, tau=5.0, c=8.0, w=2.0), 8.0, 0.09, SETTINGS)
    assert found.told
    assert 3.0 < found.time < 9.0
    assert found.lasting == pytest.approx(8.0, rel=0.25)


def test_a_time_that_is_configured_is_not_sought(rng):
    """Only the rate D = 2 c^2 / tau is told; with another time another size goes with it."""
    pieces = stretches(rng, 40, 60, 1.0, tau=40.0, c=25.0)
    sizes = [estimate_lasting(pieces, 8.0, 0.09, SETTINGS, told=tau).lasting for tau in (40.0, 160.0)]
    assert sizes[0] == pytest.approx(25.0, rel=0.15)
    assert sizes[1] == pytest.approx(50.0, rel=0.15)


@pytest.mark.parametrize("w", [5.0, 25.0])
def test_nothing_lasts_of_white_errors(w, rng):
    for _ in range(2):
        found = estimate_lasting(stretches(rng, 30, 50, 1.0, w=w), 8.0, 0.09, SETTINGS)
        assert found.lasting == 0.0
        assert found.white == pytest.approx(w, rel=0.1)


def test_an_azimuth_errs_by_its_range(rng):
    """In radians, whatever the range."""
    far = rng.uniform(2e4, 1e5, (40, 1))
    found = estimate_lasting(stretches(rng, 40, 40, 4.0, tau=13.0, c=1.4e-4, w=2e-5, factor=far), 1e-4, 0.09, SETTINGS)
    assert found.lasting * np.sqrt(2.0 / found.time) == pytest.approx(1.4e-4 * np.sqrt(2.0 / 13.0), rel=0.25)


def test_errors_that_grow_with_distance_are_told_from_even_ones(rng):
    grown = estimate_lasting(stretches(rng, 36, 36, 1.0, tau=60.0, c=4.0, w=1.0, near=1e3), 8.0, 0.09, SETTINGS)
    assert grown.lasting / grown.distance == pytest.approx(4.0 / 1e3, rel=0.3)  # so far off, only that is told
    even = stretches(rng, 36, 30, 1.0, tau=60.0, c=40.0, w=1.0)
    assert (
        estimate_lasting(even._replace(d=rng.uniform(2e3, 2e4, even.t.shape)), 8.0, 0.09, SETTINGS).distance == np.inf
    )


def test_too_few_reports_tell_nothing(rng):
    assert np.isnan(estimate_lasting(stretches(rng, 5, 40, 1.0, tau=40.0, c=25.0), 8.0, 0.09, SETTINGS).white)


def followed(time, xy, p_manoeuvre, track=None, **changes):
    """Measurements of one source, and rows of a tracker that took all of them."""
    m, n = measured(time, xy, 1.0), len(time)
    whole = join_rows([])
    moments = whole.moments._replace(
        mean=np.zeros((n, 6)), cov=np.zeros((n, 6, 6)), p_manoeuvre_h=p_manoeuvre, p_manoeuvre_v=np.zeros(n)
    )
    rows = whole._replace(
        track_id=np.ones(n, np.int64) if track is None else track,
        time=time,
        moments=moments,
        status=np.full(n, 2, np.int8),
        measurement=np.arange(n),
        source=np.zeros(n, np.int32),
        p_fault=np.zeros(n),
    )
    return replace(m, **changes), rows


def test_stretches_end_before_a_manoeuvre_and_at_a_pause_and_leave_out_what_stands():
    time = np.append(np.arange(100.0), np.arange(120.0, 160.0))
    xy = np.column_stack([50.0 * time, np.zeros(len(time))])
    turning = np.where(time == 50.0, 0.9, 0.0)
    pieces = straight_pieces(*followed(time, xy, turning), 0, 1.0, SETTINGS)
    begins, ends = np.nanmin(pieces.t, axis=1), np.nanmax(pieces.t, axis=1)
    assert list(zip(begins[::2], ends[::2], strict=True)) == [(0.0, 41.0), (59.0, 99.0), (120.0, 159.0)]
    np.testing.assert_array_equal(pieces.z[0][:42], xy[:42, 0])
    np.testing.assert_array_equal(pieces.z[1][:42], 0.0)
    assert len(straight_pieces(*followed(time, 0.0 * xy, turning), 0, 1.0, SETTINGS).t) == 0


def test_of_a_radar_the_stretch_lies_across_the_ray():
    time = np.arange(0.0, 160.0, 4.0)
    xy = np.column_stack([50.0 * time - 4000.0, np.full(len(time), 3e4)])
    pieces = straight_pieces(*followed(time, xy, np.zeros(len(time)), ray=xy), 0, 4.0, SETTINGS)
    assert len(pieces.t) == 1
    np.testing.assert_allclose(pieces.h[0], np.hypot(*xy.T))
    np.testing.assert_allclose(np.abs(np.diff(pieces.z[0])), 200.0, rtol=1e-2)
