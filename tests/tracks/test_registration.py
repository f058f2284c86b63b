"""Biases between systems: simulated scenes with known ones are the oracle."""

import numpy as np
import pytest
from scipy.stats import chi2

from saltus.errors import ModelError
from saltus.identify import LocalTracks, PairSettings
from saltus.tracks.bias import PARAMETERS, BiasSeries, corrected, effects
from saltus.tracks.encounters import SystemTracks, encounters
from saltus.tracks.measurements import Measurements
from saltus.tracks.registration import RegistrationSettings, register

PAIRING = PairSettings(speed_sigma=150.0)
DURATION = 600.0


def scene(rng, n, region, speed, *, period=4.0, sigma=10.0, site=None, sigma_polar=None, bias=None, scatter=0.0):
    """Straight tracks of n objects seen by a reference and by a system with biases: two SystemTracks, in that order.

    Objects start in a square of half width `region` and are seen for the whole time. With a `site` the second system
    is a radar there, with deviations `sigma_polar` of range (m) and azimuth (rad).
    """
    bias = np.zeros(len(PARAMETERS)) if bias is None else np.asarray(bias)
    start = rng.uniform(-region, region, (n, 2))
    course = rng.uniform(0, 2 * np.pi, n)
    velocity = speed * rng.uniform(0.3, 1.0, n)[:, None] * np.stack([np.sin(course), np.cos(course)], -1)
    own = scatter * rng.standard_normal((n, 2))
    systems = []
    for biased in (False, True):
        t = np.concatenate([np.arange(rng.uniform(0, period), DURATION, period) for _ in range(n)])
        track = np.cumsum(np.diff(t, prepend=np.inf) < 0) - 1
        when = t - bias[5] * biased
        true = start[track] + velocity[track] * when[:, None]
        ray, R = np.full((len(t), 2), np.nan), np.broadcast_to(sigma**2 * np.eye(2), (len(t), 2, 2)).copy()
        z = true + sigma * rng.standard_normal(true.shape)
        if biased and site is not None:
            z, ray, R = seen(rng, true + own[track], np.asarray(site), sigma_polar, bias)
        elif biased:
            z += own[track]
        z = z + bias[:2] * biased
        tracks = LocalTracks(track, t, z, R)
        systems.append(SystemTracks(tracks, velocity[track], ray, np.arange(n)))
    return systems


def seen(rng, true, site, sigma, bias):
    ray = true - site
    distance = np.hypot(*ray.T)
    r = distance * (1 + bias[4]) + bias[3] + sigma[0] * rng.standard_normal(len(ray))
    azimuth = np.arctan2(*ray.T) + bias[2] + sigma[1] * rng.standard_normal(len(ray))
    ray = r[:, None] * np.stack([np.sin(azimuth), np.cos(azimuth)], -1)
    u = ray / np.hypot(*ray.T)[:, None]
    c = np.stack([u[:, 1], -u[:, 0]], -1)
    R = (
        sigma[0] ** 2 * u[:, :, None] * u[:, None]
        + (sigma[1] * distance)[:, None, None] ** 2 * c[:, :, None] * c[:, None]
    )
    return site + ray, ray, R


def unnamed(system):
    return system._replace(icao24=np.full(len(system.icao24), -1))


def last(registration):
    s = registration.series
    return s.mean[-1], s.cov[-1], s.estimated[-1]


def test_effects_are_derivatives_of_a_report():
    rng = np.random.default_rng(1)
    ray, velocity = rng.normal(0, 5e4, (20, 2)), rng.normal(0, 100, (20, 2))
    distance, azimuth = np.hypot(*ray.T), np.arctan2(*ray.T)

    def reported(c):
        r, a = distance * (1 + c[4]) + c[3], azimuth + c[2]
        return r[:, None] * np.stack([np.sin(a), np.cos(a)], -1) + c[:2] - velocity * c[5]

    found = effects(ray, velocity)
    for k, step in enumerate((1.0, 1.0, 1e-5, 1.0, 1e-5, 1e-2)):
        up, down = (reported(sign * step * np.eye(6)[k]) for sign in (1, -1))
        np.testing.assert_allclose(found[:, :, k], (up - down) / (2 * step), atol=1e-4, rtol=1e-6)
    np.testing.assert_array_equal(effects(np.full((20, 2), np.nan), velocity)[:, :, 2:5], 0.0)


def test_blocks_keep_the_median_and_no_long_gap():
    t = np.arange(0.0, 40.0, 1.0)
    straight = np.stack([3.0 * t, np.zeros_like(t)], -1)
    strange = straight + np.array([5.0, 7.0])
    strange[3] += 1e4  # one gross outlier
    R = np.broadcast_to(np.eye(2), (40, 2, 2))
    blank = np.full((40, 2), np.nan)
    a = SystemTracks(LocalTracks(np.zeros(40, int), t, strange, R), np.zeros((40, 2)), blank, np.array([-1]))
    hole = (t < 20) | (t > 31)
    b = SystemTracks(
        LocalTracks(np.zeros(hole.sum(), int), t[hole] - 0.25, straight[hole] - np.array([0.75, 0.0]), R[hole]),
        np.zeros((hole.sum(), 2)), blank[hole], np.array([-1]),
    )  # fmt: skip
    blocks = encounters(a, b, np.array([[0, 0]]), 10.0)
    np.testing.assert_allclose(blocks.residual, np.tile([5.0, 7.0], (len(blocks.time), 1)), atol=1e-9)
    assert len(blocks.time) == 3  # the block of 20 to 30 s lies in the hole
    assert (np.diff(blocks.time) > 0).all()


def coverage(make, wanted, runs):
    """Chi-square of the estimated parameters over runs, and their number."""
    total, dof = 0.0, 0
    for seed in range(runs):
        b, a = make(np.random.default_rng(seed))
        mean, cov, estimated = last(register(a, b, PAIRING))
        at = np.flatnonzero(estimated)
        assert set(np.flatnonzero(wanted)) <= set(at)
        error = (mean - wanted)[at]
        total += error @ np.linalg.solve(cov[np.ix_(at, at)], error)
        dof += len(at)
    return total, dof


def test_offset_and_time_are_found_within_their_uncertainty():
    bias = np.array([5.0, 8.0, 0, 0, 0, 0.4])

    def make(rng):
        return scene(rng, 20, 4e3, 40.0, bias=bias, scatter=5.0, sigma=3.0)

    total, dof = coverage(make, bias, 12)
    # Standard deviations are widened, never narrowed, by what the scores of the objects say: the lower end is loose.
    assert 0.35 * dof < total < chi2.ppf(0.999, dof)


def test_azimuth_and_range_are_found_all_around_a_radar():
    bias = np.array([0, 0, np.radians(-0.6), 80.0, 0, 0])

    def make(rng):
        return scene(
            rng, 16, 1.2e5, 220.0, bias=bias, site=(1e4, -2e4), sigma_polar=(30.0, np.radians(0.08)), sigma=20.0
        )

    total, dof = coverage(make, bias, 8)
    assert 0.35 * dof < total < chi2.ppf(0.999, dof)


def test_reports_of_few_objects_are_few_objects():
    """Four objects with 5 m scatter: a standard deviation near 2.5 m, however many reports there are."""
    b, a = scene(np.random.default_rng(3), 4, 3e3, 20.0, bias=[5, 8, 0, 0, 0, 0], scatter=5.0, sigma=1.0, period=1.0)
    _, cov, estimated = last(register(a, b, PAIRING))
    assert estimated[:2].all()
    assert 1.2 < np.sqrt(cov[0, 0]) < 6.0


def test_one_airport_cannot_tell_azimuth_and_range_from_offset():
    rng = np.random.default_rng(5)
    b, a = scene(
        rng, 15, 400.0, 8.0, bias=[5, 8, 0, 0, 0, 0], site=(2000.0, 1500.0), sigma_polar=(2.0, 1e-3), sigma=2.0
    )
    found = register(a, b, PAIRING)
    mean, _, estimated = last(found)
    assert estimated[:2].all()
    assert not estimated[2:5].any()
    assert (mean[2:5] == 0).all()
    for group in ("azimuth", "range"):
        assert found.not_estimated[group] == "not separable from position offset"


def test_what_has_no_effect_is_named():
    b, a = scene(np.random.default_rng(5), 10, 4e3, 40.0)
    assert register(a, b, PAIRING).not_estimated["azimuth"] == "has no effect on these reports"


@pytest.mark.parametrize("polar", [False, True])
def test_objects_without_names_agree(polar):
    """Nobody says which track is whose: pairs that one bias explains are found among all neighbours."""
    rng = np.random.default_rng(11)
    if polar:
        bias = np.array([0, 0, np.radians(0.6), 0, 0, 0])
        b, a = scene(rng, 25, 1e5, 200.0, bias=bias, site=(0, 0), sigma_polar=(30.0, np.radians(0.05)), sigma=20.0)
    else:
        bias = np.array([17.0, 22.0, 0, 0, 0, 0])
        b, a = scene(rng, 40, 800.0, 10.0, bias=bias, scatter=4.0, sigma=2.0)
    mean, cov, estimated = last(register(unnamed(a), unnamed(b), PAIRING))
    at = np.flatnonzero(bias)
    assert estimated[at].all()
    assert (np.abs(mean - bias)[at] < 4.0 * np.sqrt(np.diag(cov))[at]).all()


def test_strangers_are_no_common_objects():
    """Tracks of different objects do not agree on any bias."""
    rng = np.random.default_rng(2)
    b, _ = scene(rng, 6, 2e3, 30.0)
    _, a = scene(rng, 6, 2e3, 30.0)
    found = register(unnamed(a), unnamed(b), PAIRING)
    assert not found.series.estimated.any()
    assert set(found.not_estimated.values()) == {"too few common objects"}
    np.testing.assert_array_equal(found.series.at(np.array([DURATION]))[1][0], np.diag(found.series.prior**2))


def test_a_third_of_strange_objects_moves_nothing():
    rng = np.random.default_rng(4)
    bias = np.array([5.0, 8.0, 0, 0, 0, 0])
    b, a = scene(rng, 24, 4e3, 40.0, bias=bias, scatter=4.0, sigma=3.0)
    far = 80.0 * rng.standard_normal((24, 2)) * (np.arange(24) % 3 == 0)[:, None]
    a = a._replace(tracks=a.tracks._replace(z=a.tracks.z + far[a.tracks.track]))
    mean, cov, _ = last(register(a, b, PAIRING))
    assert (np.abs(mean - bias)[:2] < 4.0 * np.sqrt(np.diag(cov))[:2]).all()
    assert np.sqrt(cov[0, 0]) < 4.0


def test_estimates_use_nothing_later():
    b, a = scene(np.random.default_rng(6), 15, 4e3, 40.0, bias=[5, 8, 0, 0, 0, 0.3], sigma=3.0)
    whole = register(a, b, PAIRING).series

    def until(system, t):
        keep = system.tracks.time <= t
        tracks = LocalTracks(*(column[keep] for column in system.tracks))
        return system._replace(tracks=tracks, velocity=system.velocity[keep], ray=system.ray[keep])

    part = register(until(a, 305.0), until(b, 305.0), PAIRING).series
    k = np.searchsorted(whole.time, 300.0)
    np.testing.assert_allclose(part.time[:k], whole.time[:k])
    np.testing.assert_allclose(part.mean[:k], whole.mean[:k], atol=1e-9)
    mean, cov = whole.at(np.array([whole.time[0] - 1.0, whole.time[5], whole.time[5] + 1.0]))
    np.testing.assert_array_equal(mean[0], 0.0)
    np.testing.assert_array_equal(mean[1], whole.mean[5])
    np.testing.assert_array_equal(cov[2], whole.cov[5])


def test_drifting_bias_is_followed():
    """Twice the memory later the estimate is of the bias now."""
    rng = np.random.default_rng(8)
    b, a = scene(rng, 15, 4e3, 40.0, scatter=1.0, sigma=3.0)
    step = np.where(a.tracks.time > 200.0, 30.0, 0.0)[:, None] * [1.0, 0.0]
    a = a._replace(tracks=a.tracks._replace(z=a.tracks.z + step))
    mean, cov, _ = last(register(a, b, PAIRING, RegistrationSettings(memory=200.0)))
    assert abs(mean[0] - 30.0) < 4.0 * np.sqrt(cov[0, 0]) + 0.5


def test_corrections_undo_the_biases():
    """Reports of a radar with every bias, corrected by exactly those, are the true positions at the true times."""
    rng = np.random.default_rng(9)
    bias = np.array([30.0, -20.0, np.radians(0.7), 90.0, 2e-4, 0.6])
    n = 50
    true, site = rng.uniform(-8e4, 8e4, (n, 2)), np.array([3e3, -2e3])
    position, ray, _ = seen(rng, true, site, (0.0, 0.0), bias)
    m = measurements(np.arange(n, dtype=float), position + bias[:2], ray, np.radians(5.0) + np.arctan2(*ray.T))
    series = BiasSeries(
        time=np.array([10.0]), mean=bias[None], cov=np.zeros((1, 6, 6)), estimated=np.ones((1, 6), bool),
        scatter=np.zeros(1), objects=np.ones(1, int), excess=np.zeros(1), prior=np.ones(6),
    )  # fmt: skip
    own = np.arange(0, n, 2)
    fixed = corrected(m, own, series)
    known = own[own >= 10]
    np.testing.assert_allclose(fixed.position[known, :2], true[known], atol=0.1)
    np.testing.assert_allclose(fixed.time[known], known - 0.6)
    np.testing.assert_allclose(fixed.polar[known, 1], np.radians(5.0) + np.arctan2(*(true - site).T)[known], atol=1e-9)
    untouched = np.setdiff1d(np.arange(n), known)
    np.testing.assert_array_equal(fixed.position[untouched], m.position[untouched])
    np.testing.assert_array_equal(fixed.time[untouched], m.time[untouched])


def measurements(time, position, ray, azimuth):
    n = len(time)
    blank, codes = np.full(n, np.nan), np.full(n, -1, np.int32)
    return Measurements(
        plot=np.arange(n), time=time, source=np.zeros(n, np.int32),
        position=np.column_stack([position, np.zeros(n)]), cov=np.broadcast_to(np.eye(3), (n, 3, 3)).copy(),
        icao24=codes, mode3a=codes.astype(np.int16), callsign=np.full(n, "", "U8"),
        polar=np.column_stack([np.hypot(*ray.T), azimuth]), ray=ray, lever=np.zeros((n, 2)),
        elevation=blank, range_rate=blank, sigma_range_rate=blank, origin=np.full((n, 2), np.nan), bearing=blank,
        sigma_bearing=blank, jitter=np.zeros(n),
        lasting=np.zeros((n, 2, 2)),
        lasting_time=np.full(n, 60.0),
    )  # fmt: skip


def test_settings_that_cannot_be():
    with pytest.raises(ModelError, match=r"registration\.sigma_azimuth"):
        RegistrationSettings(sigma_azimuth=-1.0)
    with pytest.raises(ModelError, match=r"registration\.memory"):
        RegistrationSettings(memory=np.inf)


def test_empty_systems():
    b, a = scene(np.random.default_rng(6), 3, 4e3, 40.0)
    nothing = SystemTracks(
        LocalTracks(np.zeros(0, int), np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2, 2))),
        np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, int),
    )  # fmt: skip
    for pair in ((a, nothing), (nothing, b)):
        assert not len(register(*pair, PAIRING).series.time)
