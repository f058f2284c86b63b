"""Tracks as measurements: the inverse filter gives back what the filter took; thinned updates are honest."""

import numpy as np
import pytest

from saltus import DataError, ModelError, constant_velocity, imm_filter
from saltus.identify import LocalTracks, PairSettings, doubled, filled, pair_ratios, track_updates, tracklets
from strategies import random_cov

H = np.eye(4)[[0, 2]]
DENSITY = 0.8


def filtered(rng, runs, time, R):
    """Constant-velocity tracks of random objects: truth (runs, T, 2), measurements, means, covariances."""
    step = constant_velocity(2, accel=DENSITY, kind="white").step(np.diff(time, prepend=time[0] - 1.0))
    x, truth = rng.normal(size=(runs, 4)) * [300.0, 50.0, 300.0, 50.0], []
    for F, Q in zip(step.F, step.Q, strict=True):
        x = x @ F.T + rng.multivariate_normal(np.zeros(4), Q, runs)
        truth.append(x)
    truth = np.stack(truth, axis=1)
    z = truth @ H.T + np.einsum("tij,rtj->rti", np.linalg.cholesky(R), rng.normal(size=(runs, len(time), 2)))
    found = imm_filter(
        z, F=step.F, Q=step.Q, H=H, R=R, trans=[], mean0=np.zeros(4), cov0=np.diag([1e5, 3e3, 1e5, 3e3]), probs0=1.0
    )
    return truth, z, found


def test_inverse_filter_gives_back_the_measurements(rng):
    time = np.cumsum(rng.uniform(1.0, 8.0, 12))
    R = 400.0 * random_cov(rng, (12,), 2)
    _, z, found = filtered(rng, 3, time, R)
    track = np.repeat(np.arange(3), 12)
    back = tracklets(track, np.tile(time, 3), found.mean.reshape(-1, 4), found.cov.reshape(-1, 4, 4), density=DENSITY)
    later = np.tile(np.arange(12) > 0, 3)
    np.testing.assert_array_equal(back.track, track)
    np.testing.assert_allclose(back.z[later], z.reshape(-1, 2)[later], atol=1e-4)
    np.testing.assert_allclose(back.R[later], np.tile(R, (3, 1, 1))[later], rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(back.z[~later], found.mean[:, 0][:, [0, 2]])


def test_spaced_tracklets_have_independent_errors_of_their_covariance(rng):
    """Normalised errors: unit variance and no memory, within 5 standard errors."""
    time = np.arange(40.0)
    truth, _, found = filtered(rng, 400, time, np.tile(400.0 * np.eye(2), (40, 1, 1)))
    track = np.repeat(np.arange(400), 40)
    mean, cov = found.mean.reshape(-1, 4), found.cov.reshape(-1, 4, 4)
    back = tracklets(track, np.tile(time, 400), mean, cov, density=DENSITY, spacing=5.0)
    assert len(back.time) == 400 * 8
    off = back.z - truth[back.track, back.time.astype(int)][:, [0, 2]]
    white = np.linalg.solve(np.linalg.cholesky(back.R), off[..., None])[..., 0].reshape(400, 8, 2)[:, 1:]
    n = white[..., 0].size
    assert np.abs((white**2).mean((0, 1)) - 1.0).max() < 5.0 * np.sqrt(2.0 / n)
    assert np.abs((white[:, 1:] * white[:, :-1]).mean((0, 1))).max() < 5.0 / np.sqrt(n)


def test_thinned_updates_are_less_than_one_per_memory():
    time = np.concatenate([np.arange(0.0, 60.0, 4.0), np.arange(2.0, 30.0, 4.0)])
    track = np.repeat([0, 1], [15, 7])
    position = np.stack([100.0 * time, np.zeros(22)], axis=-1)
    kept = track_updates(track, time, position, sigma=50.0, memory=5.0, time_sigma=0.5, accel_sigma=2.0, shared=False)
    assert kept.time.tolist() == [0.0, 16.0, 32.0, 48.0, 2.0, 18.0] and kept.track.tolist() == [0, 0, 0, 0, 1, 1]
    np.testing.assert_allclose(kept.R, np.tile(np.diag([50.0**2 + 50.0**2 + 50.0**2, 50.0**2 + 50.0**2]), (6, 1, 1)))
    velocity = np.tile([100.0, 0.0], (22, 1))
    told = track_updates(
        track, time, position, sigma=50.0, memory=5.0, velocity=velocity, time_sigma=0.5, accel_sigma=2.0
    )
    np.testing.assert_allclose(told.R, 2.0 * kept.R)
    np.testing.assert_allclose(doubled(kept).R, told.R)
    assert track_updates([0], [1.0], [[0.0, 0.0]], sigma=1.0, memory=5.0, time_sigma=1.0).R.tolist() == [
        [[2, 0], [0, 2]]
    ]


def test_a_track_fed_by_the_other_systems_plots_is_found(rng):
    """The centre filters the very plots it is compared with: every update as a measurement would be too sure."""
    time = np.arange(0.0, 240.0, 4.0)
    _, z, found = filtered(rng, 60, time, np.tile(2500.0 * np.eye(2), (60, 1, 1)))
    track, times = np.repeat(np.arange(60), 60), np.tile(time, 60)
    plots = LocalTracks(track, times, z.reshape(-1, 2), np.tile(2500.0 * np.eye(2), (3600, 1, 1)))
    settings = PairSettings(
        accel=(np.sqrt(DENSITY / 4.0),), sojourn=(1.0,), region_cov=1e6 * np.eye(2), speed_sigma=60.0
    )
    position, sd = found.mean[..., [0, 2]].reshape(-1, 2), float(np.sqrt(found.cov[0, -1, 0, 0]))
    naive = LocalTracks(track, times, position, np.tile(sd**2 * np.eye(2), (3600, 1, 1)))
    honest = track_updates(track, times, position, sigma=sd, memory=8.0)
    pairs = np.repeat(np.arange(60)[:, None], 2, axis=1)
    every, few = (
        filled(pair_ratios(a, b, pairs, settings))[:, -1] for a, b in ((plots, naive), (doubled(plots), honest))
    )
    assert few.min() > 5.0
    assert np.median(every) > np.median(few) + 10.0, "noise that both share passes for agreement"


def test_what_is_no_track_is_refused():
    with pytest.raises(ModelError, match="sigma"):
        track_updates([0], [0.0], [[0.0, 0.0]], sigma=0.0, memory=5.0)
    with pytest.raises(ModelError, match="density"):
        tracklets([0], [0.0], np.zeros((1, 4)), np.eye(4)[None], density=0.0)
    with pytest.raises(DataError, match="out of order"):
        track_updates([0, 0], [1.0, 0.0], np.zeros((2, 2)), sigma=1.0, memory=5.0)
    with pytest.raises(DataError, match="inverse"):
        tracklets([0, 0], [0.0, 1.0], np.zeros((2, 4)), np.zeros((2, 4, 4)), density=1.0)
