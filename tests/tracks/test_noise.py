"""The noise found from tracks is the noise that was simulated."""

from dataclasses import replace

import numpy as np
import pytest
from tracking_scenes import SITE, measured, observed

from saltus.geo import Plane
from saltus.records import Source, System
from saltus.simulate import Leg, Observations, Radar, Trajectory, observe
from saltus.tracks.measurements import Noise
from saltus.tracks.noise import NoiseEstimate, apply_estimate, estimate_noise

PLANE = Plane(SITE.latitude, SITE.longitude)
TIMES = 4.0 * np.arange(150)


def standard_error(sigma, n):
    """Of the root mean square of n residuals of seven-point quadratics, which overlap and so are correlated.

    The residual filter is the middle row of I - A A^+; for Gaussian noise var(mean e^2) = 2 sigma^4 / n times
    1 + 2 sum of squared autocorrelations.
    """
    A = np.vander(np.arange(-3.0, 4.0), 3)
    c = (np.eye(7) - A @ np.linalg.inv(A.T @ A) @ A.T)[3]
    r = np.array([(c[: 7 - k] * c[k:]).sum() for k in range(7)]) / (c * c).sum()
    return sigma * np.sqrt((1.0 + 2.0 * (r[1:] ** 2).sum()) / (2.0 * n))


def seen_by(rng, sigma_range, sigma_azimuth, *, n=12, turn=0.0, sigma_altitude=3.0, factor=1.0):
    """Plots every 4 s of targets 30 to 140 km away: exact polar truth of curved-earth geometry plus noise."""
    parts = []
    for k in range(n):
        course = 2.0 * np.pi * k / n
        place = 1e3 * (30 + 9 * k) * np.array([np.sin(course + 1.0), np.cos(course + 1.0)])
        flight = Trajectory((*place, 9e3), course, 220.0, (Leg(700.0, turn_rate=turn),))
        radar = Radar(SITE, 4.0, 0.0, 0.0, prob_detection=1.0, max_range=400e3)
        exact = observe(radar, [flight], PLANE, 0.0, TIMES[-1], rng)
        m = len(exact.time)
        parts.append(
            Observations(
                exact.time,
                exact.slant + factor * sigma_range * rng.standard_normal(m),
                exact.azimuth + factor * sigma_azimuth * rng.standard_normal(m),
                exact.altitude + sigma_altitude * rng.standard_normal(m),
                np.full(m, k + 1),
            )
        )
    joined = Observations(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    radar = Radar(SITE, 4.0, sigma_range, sigma_azimuth)
    return observed([joined], [radar], [Noise()], PLANE)


@pytest.mark.parametrize(("sigma_range", "sigma_azimuth_deg"), [(3.5, 0.007), (30.0, 0.03)])
def test_polar_noise_is_recovered(rng, sigma_range, sigma_azimuth_deg):
    sigma_azimuth = np.radians(sigma_azimuth_deg)
    m, label = seen_by(rng, sigma_range, sigma_azimuth)
    found = estimate_noise(m, label, 0)
    assert found.n_windows > 1000
    for value, sigma in ((found.range, sigma_range), (found.azimuth, sigma_azimuth)):
        # Cutting beyond four sigma takes 0.05 % off, the wander of the ray within seven plots less.
        assert abs(value - sigma) < 5 * standard_error(sigma, found.n_windows) + 2e-3 * sigma
    assert np.isnan(found.xy)


def test_a_quarter_more_noise_would_be_seen(rng):
    m, label = seen_by(rng, 4.0, np.radians(0.01), factor=1.25)
    found = estimate_noise(m, label, 0)
    assert found.range > 4.0 + 5 * standard_error(4.0, found.n_windows)
    assert found.azimuth > np.radians(0.01) + 5 * standard_error(np.radians(0.01), found.n_windows)


def test_plane_noise_is_recovered_per_source(rng):
    n = 3000
    time = np.arange(n) * 1.0
    source = np.arange(n) % 2
    sigma = np.array([4.0, 15.0])[source]
    xy = np.column_stack([30.0 * time, -8.0 * time]) + sigma[:, None] * rng.standard_normal((n, 2))
    m = measured(time, xy, 1.0, source=source)
    for s, expected in enumerate((4.0, 15.0)):
        found = estimate_noise(m, np.ones(n, int), s)
        # Two axes give two independent residuals a window.
        assert abs(found.xy - expected) < 5 * standard_error(expected, 2 * found.n_windows) + 1e-3 * expected
        assert np.isnan(found.range)
        assert np.isnan(found.azimuth)


def stamped(rng, speeds, sigma, late, n=600, period=0.5):
    """Straight flights, reported at times that are off by `late`, all axes noisy by sigma; and whose each report is."""
    k = len(speeds)
    course, time = rng.uniform(0.0, 2.0 * np.pi, k), period * np.arange(n)
    velocity = np.asarray(speeds)[:, None] * np.stack([np.sin(course), np.cos(course)], axis=-1)
    when = time + late * rng.standard_normal((k, n))
    xy = velocity[:, None] * when[..., None] + sigma * rng.standard_normal((k, n, 2))
    m, label = measured(np.tile(time, k), xy.reshape(-1, 2), sigma), np.repeat(np.arange(1, k + 1), n)
    return m, label[np.argsort(np.tile(time, k), kind="stable")]


def test_errors_of_time_stamps_are_found_along_the_course(rng):
    """Two reports a second: over seven of them in a row, what a position errs by would be taken for a turn."""
    m, label = stamped(rng, np.linspace(60.0, 240.0, 10), 2.0, 0.06)
    found = estimate_noise(m, label, 0)
    assert found.xy == pytest.approx(2.0, rel=0.05)
    assert found.time == pytest.approx(0.06, rel=0.05)
    assert apply_estimate(Noise(), found, Source(System(21, 1, 1))).time == found.time
    exact = estimate_noise(*stamped(rng, np.linspace(60.0, 240.0, 10), 2.0, 0.0), 0)
    assert exact.time < 0.005


@pytest.mark.parametrize(("sigma", "late"), [(10.0, 0.06), (5.0, 0.06), (20.0, 0.1)])
def test_time_stamps_are_found_where_positions_are_coarse_and_speeds_mixed(rng, sigma, late):
    """Slow targets err by sigma, fast ones by both: neither may be taken for the outliers of the other."""
    m, label = stamped(rng, np.linspace(35.0, 240.0, 20), sigma, late)
    found = estimate_noise(m, label, 0)
    assert found.xy == pytest.approx(sigma, rel=0.05)
    assert found.time == pytest.approx(late, rel=0.15)


def test_short_tracks_tell_by_shorter_windows(rng):
    m, label = stamped(rng, np.full(60, 10.0), 0.3, 0.0, n=90, period=0.1)
    assert estimate_noise(m, label, 0).xy == pytest.approx(0.3, rel=0.05)


def test_slow_targets_tell_nothing_of_time_stamps(rng):
    m, label = stamped(rng, np.full(10, 10.0), 2.0, 0.06)
    found = estimate_noise(m, label, 0)
    assert np.isnan(found.time)
    assert found.xy == pytest.approx(2.0, rel=0.1)
    assert apply_estimate(Noise(time=0.05), found, Source(System(21, 1, 1))).time == 0.05


def test_turns_are_left_out(rng):
    """Targets turning at 3 degrees a second and 220 m/s pull 11 m/s^2: no window is straight enough."""
    m, label = seen_by(rng, 3.5, np.radians(0.007), n=4, turn=float(np.radians(3.0)))
    found = estimate_noise(m, label, 0)
    assert np.isnan(found.range)
    assert np.isnan(found.azimuth)


def test_constant_acceleration_is_no_noise(rng):
    """0.8 m/s^2 bends the way by 57 m over seven plots; a line would call it noise, a quadratic does not."""
    time = TIMES.copy()
    xy = np.column_stack([100.0 * time, 0.5 * 0.8 * time**2]) + 3.0 * rng.standard_normal((len(time), 2))
    found = estimate_noise(measured(time, xy, 1.0), np.ones(len(time), int), 0)
    assert abs(found.xy - 3.0) < 5 * standard_error(3.0, 2 * found.n_windows) + 3e-3


def test_gaps_and_few_plots_give_nothing(rng):
    assert np.isnan(estimate_noise(measured([], np.zeros((0, 2)), 1.0), np.zeros(0, int), 0).xy)
    time = np.arange(20.0)
    m = measured(time, rng.normal(size=(20, 2)), 1.0)
    few = estimate_noise(m, np.ones(20, int), 0)
    assert np.isnan(few.xy)
    assert few.n_windows < 30
    assert estimate_noise(m, np.zeros(20, int), 0).n_windows == 0  # on no track


def test_never_below_quantisation():
    source = Source(System(48, 1, 2), range_lsb=1852 / 256, azimuth_lsb=2 * np.pi / 65536, xy_lsb=1.0)
    start = Noise()
    tiny = apply_estimate(start, NoiseEstimate(0.1, 1e-9, 0.01, np.nan, 500), source)
    assert tiny.range == pytest.approx(7.234375 / 3.4641016, rel=1e-7)
    assert tiny.azimuth == pytest.approx(9.5873799e-5 / 3.4641016, rel=1e-7)
    assert tiny.xy == pytest.approx(1 / 3.4641016, rel=1e-7)
    real = apply_estimate(start, NoiseEstimate(30.0, 1e-3, 5.0, np.nan, 500), source)
    assert (real.range, real.azimuth, real.xy) == (30.0, 1e-3, 5.0)
    assert apply_estimate(start, NoiseEstimate(np.nan, np.nan, np.nan, np.nan, 0), source) == start


def test_estimate_of_quantised_plots_stays_above_the_step(rng):
    """Noise far below the step: rounding is the noise, LSB / sqrt(12), and the estimate may not undercut it."""
    step = 7.234375
    time = TIMES.copy()
    xy = np.round(np.column_stack([123.4 * time, 77.7 * time]) / step) * step
    found = estimate_noise(measured(time, xy, 1.0), np.ones(len(time), int), 0)
    source = Source(System(None, None, None, "grid"), xy_lsb=step)
    assert apply_estimate(Noise(), found, source).xy >= step / np.sqrt(12.0) * (1 - 1e-12)
    assert apply_estimate(Noise(), found, source).xy == pytest.approx(step / np.sqrt(12.0), rel=0.2)


@pytest.mark.parametrize("sigma_deg", [0.05, 1.0])
def test_the_noise_of_elevations_is_recovered_and_never_below_their_step(rng, sigma_deg):
    sigma = float(np.radians(sigma_deg))
    m, label = seen_by(rng, 30.0, np.radians(0.03))
    assert np.isnan(estimate_noise(m, label, 0).elevation)  # heights were told, not measured
    exact = np.arctan2(m.position[:, 2] - SITE.height, np.hypot(*m.ray.T))
    m = replace(m, elevation=exact + sigma * rng.standard_normal(len(m)))
    found = estimate_noise(m, label, 0)
    # The median deviation of n has the relative standard error 1.17 / sqrt(n): five of these, windows correlated.
    assert found.elevation == pytest.approx(sigma, rel=5.0 * 1.2 * 1.17 / np.sqrt(found.n_windows))
    coarse = Source(System(None, None, None, "grid"), elevation_lsb=float(np.radians(6.0)))
    assert apply_estimate(Noise(), found, coarse).elevation == pytest.approx(np.radians(6.0) / np.sqrt(12.0))


def test_a_fine_elevation_is_taken_as_it_is():
    """The least deviation is one of positions, m: of an angle it is what that is at some range."""
    fine = NoiseEstimate(np.nan, np.nan, np.nan, np.nan, 99, elevation=float(np.radians(0.05)), range_rate=0.2)
    used = apply_estimate(Noise(), fine, Source(System(None, None, None, "fine")))
    assert used.elevation == pytest.approx(np.radians(0.05)) and used.range_rate == 0.2
