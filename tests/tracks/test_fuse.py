"""System-track states: a dense Gaussian, the tracker's own filters and matched simulation are the oracles."""

import numpy as np
import pytest
from scipy.stats import chi2

from saltus.tracks.fuse import LaneRows, fuse
from saltus.tracks.kinematics import Moments
from saltus.tracks.settings import FilterSettings, TrackerSettings

ONE_MODE = FilterSettings(
    accel_h=(0.5,), sojourn_h=(100.0,), turn_rate=(), accel_v=(0.2,), sojourn_v=(100.0,), accel_time=4.0
)
NO_FAULT = TrackerSettings(plot_outlier=1e-12, altitude_outlier=1e-12)


def start_at(mean, sigma_p=20.0, sigma_v=10.0):
    mean = np.atleast_2d(np.asarray(mean, float))
    cov = np.broadcast_to(np.diag([sigma_p**2, sigma_v**2] * 3), (len(mean), 6, 6)).copy()
    return Moments(mean, cov, np.zeros(len(mean)), np.zeros(len(mean)))


def rows(lane, time, position, sigma):
    cov = np.broadcast_to(np.eye(3), (len(lane), 3, 3)) * np.broadcast_to(sigma, len(lane))[:, None, None] ** 2
    far = cov[:, None] + np.diag([400.0**2, 400.0**2, 0.0])
    return LaneRows(np.asarray(lane), np.asarray(time, float), np.asarray(position, float), cov, np.repeat(far, 2, 1))


def dense(time, z, sigma, mean, cov, density):
    """Mean and covariance of (x, vx) at the last time, by one joint Gaussian over all times of one axis."""
    n = len(time)
    F = [np.array([[1.0, dt], [0.0, 1.0]]) for dt in np.diff(time)]
    Q = [density * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) for dt in np.diff(time)]
    A = np.zeros((2 * n, 2 * n))  # states from independent increments
    for k in range(n):
        block = np.eye(2)
        for j in range(k, -1, -1):
            A[2 * k : 2 * k + 2, 2 * j : 2 * j + 2] = block
            block = block @ F[j - 1] if j else block
    noise = np.zeros((2 * n, 2 * n))
    noise[:2, :2] = cov
    for k in range(n - 1):
        noise[2 * k + 2 : 2 * k + 4, 2 * k + 2 : 2 * k + 4] = Q[k]
    P = A @ noise @ A.T
    m = A[:, :2] @ mean
    seen = [2 * k for k in range(1, n) if np.isfinite(z[k])]
    S = P[np.ix_(seen, seen)] + np.diag([sigma[k // 2] ** 2 for k in seen])
    gain = np.linalg.solve(S, P[seen]).T
    m = m + gain @ (z[[k // 2 for k in seen]] - m[seen])
    P = P - gain @ P[seen]
    return m[-2:], P[-2:, -2:]


def test_one_mode_without_faults_is_the_dense_gaussian():
    rng = np.random.default_rng(0)
    time = np.array([0.0, 0.4, 4.0, 4.1, 9.0, 13.0])
    z = rng.normal(0, 5, (6, 3))
    z[3] = np.nan  # a coasted row
    sigma = np.array([1.0, 20.0, 5.0, 1.0, 20.0, 5.0])
    start = start_at([1.0, 0.2, -3.0, 0.4, 2.0, 0.1])
    found = fuse(rows(np.zeros(6, int), time, z, sigma), start, ONE_MODE, NO_FAULT)
    for axis, accel in ((0, 0.5), (1, 0.5), (2, 0.2)):
        s = slice(2 * axis, 2 * axis + 2)
        mean, cov = dense(time, z[:, axis], sigma, start.mean[0, s], start.cov[0, s, s], accel**2 * 4.0)
        np.testing.assert_allclose(found.moments.mean[-1, s], mean, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(found.moments.cov[-1, s, s], cov, rtol=1e-5)
    np.testing.assert_array_equal(found.moments.mean[0], start.mean[0])
    assert np.isnan(found.p_fault[3]).all()


def test_lanes_do_not_know_each_other():
    """Many lanes of any length at once are each lane alone."""
    rng = np.random.default_rng(1)
    length = [1, 40, 3, 200, 41, 2]
    parts = [
        rows(np.zeros(n, int), np.cumsum(rng.uniform(0.1, 5.0, n)), rng.normal(0, 30, (n, 3)), rng.uniform(3, 20, n))
        for n in length
    ]
    start = start_at(rng.normal(0, 20, (len(length), 6)))
    together = LaneRows(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    together = together._replace(lane=np.repeat(np.arange(len(length)), length))
    filters, settings = FilterSettings(accel_time=4.0), TrackerSettings()
    whole = fuse(together, start, filters, settings)
    edge = np.cumsum([0, *length])
    for k, part in enumerate(parts):
        own = Moments(*(column[k : k + 1] for column in start))
        alone = fuse(part, own, filters, settings)
        at = slice(edge[k], edge[k + 1])
        np.testing.assert_allclose(whole.moments.mean[at], alone.moments.mean, atol=1e-8)
        np.testing.assert_allclose(whole.moments.cov[at], alone.moments.cov, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(whole.p_fault[at], alone.p_fault, atol=1e-10)


def test_wrong_plot_is_seen_and_moves_little():
    time = np.arange(0.0, 40.0, 2.0)
    true = np.column_stack([100.0 * time, 20.0 * time, np.full_like(time, 3000.0)])
    z = true.copy()
    z[10, 0] += 600.0
    z[14, 2] += 2000.0  # a garbled height
    start = start_at([0.0, 100.0, 0.0, 20.0, 3000.0, 0.0])
    found = fuse(rows(np.zeros(20, int), time, z, 10.0), start, FilterSettings(accel_time=2.0), TrackerSettings())
    assert found.p_fault[10].sum() > 0.99
    assert np.nanmax(np.delete(found.p_fault.sum(axis=1), 10)) < 0.02
    assert np.abs(found.moments.mean[:, :4:2] - true[:, :2]).max() < 10.0
    assert np.abs(found.moments.mean[:, 4] - 3000.0).max() < 10.0


def test_innovations_of_two_sensors_are_what_the_filter_thinks():
    """Matched simulation: normalised innovations of all lanes have the chi-square law, and twice the noise does not."""
    rng = np.random.default_rng(2)
    n, lanes = 60, 12
    parts, start = [], []
    for k in range(lanes):
        time = np.cumsum(rng.uniform(0.2, 3.0, n))
        state, z = rng.normal(0, 1, 4) * [20, 10, 20, 10] + [0, 80, 0, -30], []
        start.append([0, 80, 0, -30, 0, 0])
        sigma = np.where(np.arange(n) % 2, 5.0, 30.0)
        for j, dt in enumerate(np.diff(time, prepend=time[0])):
            F = np.kron(np.eye(2), [[1.0, dt], [0.0, 1.0]])
            q = 0.25 * 4.0 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
            state = F @ state + rng.multivariate_normal(np.zeros(4), np.kron(np.eye(2), q))
            z.append([*(state[0::2] + sigma[j] * rng.standard_normal(2)), np.nan])
        parts.append(rows(np.full(n, k), time, z, sigma))
    every = LaneRows(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    first = np.flatnonzero(np.diff(every.lane, prepend=-1))

    def total(scale):
        scaled = every._replace(cov=every.cov * scale**2, faulty=every.faulty * scale**2)
        found = fuse(scaled, start_at(start), ONE_MODE, NO_FAULT)
        nu = np.delete(every.position[:, :2] - found.centre, first, axis=0)
        return float(np.einsum("ki,kij,kj->", nu, np.linalg.inv(np.delete(found.gate_cov, first, axis=0)), nu))

    dof = 2 * lanes * (n - 1)
    low, high = chi2.ppf([0.0005, 0.9995], dof)
    assert low < total(1.0) < high
    assert total(2.0) < low


@pytest.mark.parametrize("form", ["decomposed", "joint"])
def test_either_form(form):
    time = np.arange(0.0, 30.0, 3.0)
    z = np.column_stack([50.0 * time, -20.0 * time, 1000.0 + 5.0 * time])
    found = fuse(
        rows(np.zeros(10, int), time, z, 15.0), start_at([0, 50, 0, -20, 1000, 5]), FilterSettings(form=form),
        TrackerSettings(),
    )  # fmt: skip
    np.testing.assert_allclose(found.moments.mean[-1], [1350, 50, -540, -20, 1135, 5], atol=0.05)
    assert (np.linalg.eigvalsh(found.moments.cov) > 0).all()
    assert (found.moments.p_manoeuvre_h[1:] > 0).all()
