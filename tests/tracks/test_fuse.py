"""System tracks' states against a dense Gaussian and in matched simulation; faults and conditions of two sources."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from tracking_scenes import measured

from saltus.records import Kind
from saltus.tracks.background import flat
from saltus.tracks.colour import Colour
from saltus.tracks.faults import plot_law
from saltus.tracks.fuse import Candidates, Fusion
from saltus.tracks.lifecycle import COASTED, CONFIRMED
from saltus.tracks.rows import join_rows
from saltus.tracks.settings import FilterSettings, TrackerSettings
from saltus.tracks.sources import SourceSetup

ONE_MODE = FilterSettings(
    accel_h=(0.5,), sojourn_h=(100.0,), turn_rate=(), accel_v=(0.2,), sojourn_v=(100.0,), accel_time=4.0
)
NO_FAULT = TrackerSettings(plot_outlier=0.0, degraded_noise=1.0, coast_seconds=60.0)


def candidates(m, track, state=None, *, sigma_p=20.0, sigma_v=10.0, every=False, **changes):
    """All measurements for their tracks; those begin with their first one in states given by track."""
    n, track = len(m), np.asarray(track)
    begins = np.zeros(n, bool)
    begins[np.unique(track, return_index=True)[1]] = True
    mean = np.zeros((n, 6)) if state is None else np.asarray(state, float)[track]
    cov = np.broadcast_to(np.diag([sigma_p**2, sigma_v**2] * 3), (n, 6, 6))
    nothing = np.zeros((n, 2, 2))
    base = Candidates(
        np.arange(n), track, np.ones(n, bool), begins | every, mean, cov, np.zeros((n, 2)), np.zeros(n), nothing
    )
    return base._replace(**changes)


def fused(m, given, filters=ONE_MODE, settings=NO_FAULT, *, kinds=(Kind.PLANE,), periods=None, width=1.0):
    laws = [plot_law(settings, kind) for kind in kinds]
    waits = periods or [4.0] * len(kinds)
    sources = [SourceSetup(w, w, kind, flat(1e-9), Colour()) for w, kind in zip(waits, kinds, strict=True)]
    fusion = Fusion(settings, filters, laws, sources, use_identity=True)
    slice_of = np.floor((m.time - m.time[0]) / width)
    out = [row for s in np.unique(slice_of) for row in fusion.feed(m, given.take(np.flatnonzero(slice_of == s)))]
    return join_rows(out), fusion.conditions


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


@pytest.mark.parametrize("form", ["decomposed", "joint"])
@pytest.mark.parametrize("width", [1.0, 100.0])
def test_one_mode_without_faults_is_the_dense_gaussian(rng, form, width):
    """In slices of any length: a track takes its reports in exact time order."""
    time = np.array([0.0, 0.4, 4.0, 4.1, 9.0, 13.0])
    z, sigma = rng.normal(0, 5, (6, 3)), np.array([1.0, 20.0, 5.0, 1.0, 20.0, 5.0])
    m = measured(time, z[:, :2], sigma, altitude=z[:, 2], sigma_altitude=sigma)
    state = np.array([[1.0, 0.2, -3.0, 0.4, 2.0, 0.1]])
    filters = FilterSettings(
        form=form, accel_h=(0.5,), sojourn_h=(100.0,), turn_rate=(), accel_v=(0.2,), sojourn_v=(100.0,), accel_time=4.0
    )
    found, _ = fused(m, candidates(m, np.zeros(6, int), state), filters, width=width)
    found = found.take(np.flatnonzero(found.status != COASTED))
    assert found.measurement.tolist() == list(range(6))
    for axis, accel in ((0, 0.5), (1, 0.5), (2, 0.2)):
        s = slice(2 * axis, 2 * axis + 2)
        mean, cov = dense(time, z[:, axis], sigma, state[0, s], np.diag([400.0, 100.0]), accel**2 * 4.0)
        np.testing.assert_allclose(found.moments.mean[-1, s], mean, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(found.moments.cov[-1, s, s], cov, rtol=1e-5)
    np.testing.assert_array_equal(found.moments.mean[0], state[0])
    assert np.isnan(found.d2[0])
    assert np.isfinite(found.d2[1:]).all()


def flight(rng, *, sigma=10.0, n=20, interval=2.0):
    time = interval * np.arange(n)
    true = np.column_stack([100.0 * time, 20.0 * time, np.full(n, 3000.0)])
    z = true.copy()
    z[:, :2] += sigma * rng.standard_normal((n, 2))
    return time, true, z


def test_wrong_plot_is_seen_and_moves_little(rng):
    time, true, z = flight(rng)
    z[10, 0] += 600.0
    z[14, 2] += 2000.0  # a garbled height
    m = measured(time, z[:, :2], 10.0, altitude=z[:, 2])
    state = [[0.0, 100.0, 0.0, 20.0, 3000.0, 0.0]]
    found, _ = fused(m, candidates(m, np.zeros(20, int), state), FilterSettings(), TrackerSettings(), periods=[2.0])
    assert found.p_fault[10] > 0.99
    assert np.nanmax(np.delete(found.p_fault, 10)) < 0.05
    assert np.abs(found.moments.mean[:, :4:2] - true[:, :2]).max() < 30.0
    assert np.abs(found.moments.mean[:, 4] - 3000.0).max() < 10.0


def test_innovations_of_two_sensors_are_what_the_filter_thinks():
    """Matched simulation: innovations of all tracks have the chi-square law, those under twice the noise have not."""
    rng = np.random.default_rng(2)
    n, tracks = 60, 12
    times, positions = [], []
    for _ in range(tracks):
        time = np.cumsum(rng.uniform(0.2, 3.0, n))
        state = rng.normal(0, 1, 4) * [20, 10, 20, 10] + [0, 80, 0, -30]
        sigma = np.where(np.arange(n) % 2, 5.0, 30.0)
        for j, dt in enumerate(np.diff(time, prepend=time[0])):
            F = np.kron(np.eye(2), [[1.0, dt], [0.0, 1.0]])
            q = 0.25 * 4.0 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
            state = F @ state + rng.multivariate_normal(np.zeros(4), np.kron(np.eye(2), q))
            positions.append(state[0::2] + sigma[j] * rng.standard_normal(2))
        times.append(time)
    time, track = np.concatenate(times), np.repeat(np.arange(tracks), n)
    order = np.argsort(time, kind="stable")
    z, sigma = np.array(positions)[order], np.tile(np.where(np.arange(n) % 2, 5.0, 30.0), tracks)[order]
    state = np.tile([0.0, 80.0, 0.0, -30.0, 0.0, 0.0], (tracks, 1))

    def total(scale):
        m = measured(time[order], z, scale * sigma)
        found, _ = fused(m, candidates(m, track[order], state))
        return float(np.nansum(found.d2))

    low, high = chi2.ppf([0.0005, 0.9995], 2 * tracks * (n - 1))
    assert low < total(1.0) < high
    assert total(2.0) < low


def two_sources(rng, *, degraded=slice(0), tracks=8):
    """Two position sources of 10 m, 2 s apart, over several flights; the first one's errors grow in a stretch."""
    time, place, source, track = [], [], [], []
    for k in range(tracks):
        t = np.arange(0.0, 240.0, 2.0) + 0.2 * k
        s = np.arange(len(t)) % 2
        x = np.column_stack([100.0 * t, 20.0 * t + 9e3 * k])
        sigma = np.full(len(t), 10.0)
        sigma[degraded] = np.where(s[degraded] == 0, 50.0, 10.0)
        time.append(t), source.append(s), track.append(np.full(len(t), k))
        place.append(x + sigma[:, None] * rng.standard_normal((len(t), 2)))
    order = np.argsort(np.concatenate(time), kind="stable")
    m = measured(np.concatenate(time), np.concatenate(place), 10.0, source=np.concatenate(source))
    track = np.concatenate(track)[order]
    state = np.zeros((tracks, 6))
    k = np.arange(tracks)
    state[:, :4] = np.column_stack([20.0 * k, np.full(tracks, 100.0), 4.0 * k + 9e3 * k, np.full(tracks, 20.0)])
    return m, track, state


def test_a_degraded_source_is_known_and_believed_less(rng):
    m, track, state = two_sources(rng, degraded=slice(40, 90))
    found, conditions = fused(
        m,
        candidates(m, track, state, sigma_p=10.0),
        FilterSettings(),
        TrackerSettings(),
        kinds=(Kind.PLANE, Kind.PLANE),
        periods=[4.0, 4.0],
        width=4.0,
    )
    (bad, good) = (condition.history for condition in conditions)
    inside = (bad.time > 92.0) & (bad.time < 178.0)
    assert (bad.probs[inside, 1] > 0.9).all()
    assert (bad.probs[(bad.time < 78.0) | (bad.time > 196.0), 1] < 0.1).all()
    assert (good.probs[:, 1] < 0.1).all()
    late = found.take(np.flatnonzero((found.time > 92.0) & (found.time < 178.0) & (found.measurement >= 0)))
    truth = np.column_stack([100.0 * late.time, 20.0 * late.time + 9e3 * late.track_id])
    e, P = late.moments.mean[:, :3:2] - truth, late.moments.cov[:, :3:2, :3:2]
    nees = np.einsum("ki,kij,kj->k", e, np.linalg.inv(P), e).mean()
    assert 1.0 < nees < 2.4  # of 2: straight flights, manoeuvres allowed for
    assert np.sqrt(np.square(e).sum(axis=1).mean()) < 13.0  # the good one alone: 14 m of a report, less after filtering


def test_what_lasts_between_systems_widens_a_position_whatever_its_condition(rng):
    """Extra covariance is that of a coarser sensor."""
    time, _, z = flight(rng, n=6)
    state = [[0.0, 100.0, 0.0, 20.0, 3000.0, 0.0]]
    fine, coarse = measured(time, z[:, :2], 10.0), measured(time, z[:, :2], np.hypot(10.0, 30.0))
    extra = np.broadcast_to(900.0 * np.eye(2), (6, 2, 2))
    with_extra, _ = fused(fine, candidates(fine, np.zeros(6, int), state, extra=extra))
    wide, _ = fused(coarse, candidates(coarse, np.zeros(6, int), state))
    for a, b in zip(with_extra.moments, wide.moments, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(with_extra.gate_cov, wide.gate_cov, rtol=1e-9)


def test_a_frame_that_moves_takes_its_tracks_along(rng):
    """From the sixth report on everything lies 500 m further and is turned: as if it always had been."""
    time, _, z = flight(rng, sigma=0.0, n=12)
    state = np.array([[0.0, 100.0, 0.0, 20.0, 3000.0, 0.0]])
    angle = np.radians(2.0)
    turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    ahead = z[6:, :2] - z[6, :2]
    z[6:, :2] = z[6, :2] + [300.0, 400.0] + ahead @ turned.T
    shift, turn = np.zeros((12, 2)), np.zeros(12)
    turn[6] = angle
    # The velocity turns before the report, so the way flown to it does, too.
    step = np.array([100.0, 20.0]) * 2.0
    shift[6] = np.array([300.0, 400.0]) + step - turned @ step
    m = measured(time, z[:, :2], 10.0)
    found, _ = fused(m, candidates(m, np.zeros(12, int), state, sigma_p=1.0, sigma_v=0.1, shift=shift, turn=turn))
    assert np.nanmax(found.d2) < 0.01
    np.testing.assert_allclose(found.moments.mean[-1, [1, 3]], turned @ [100.0, 20.0], atol=0.05)


def test_silence_is_coasted_and_a_track_that_was_given_up_begins_anew(rng):
    time = np.concatenate([np.arange(0.0, 20.0, 2.0), np.arange(80.0, 90.0, 2.0)])
    place = np.column_stack([100.0 * time, 0.0 * time])
    m = measured(time, place, 10.0)
    state = np.column_stack([place[:, 0], np.full(len(time), 100.0), *np.zeros((4, len(time)))])
    given = candidates(m, np.zeros(len(time), int), every=True, mean=state)
    settings = TrackerSettings(coast_seconds=20.0)
    found, _ = fused(m, given, FilterSettings(), settings, periods=[2.0], width=2.0)
    coasted = found.time[found.status == COASTED]
    np.testing.assert_allclose(coasted, np.arange(20.0, 38.1, 2.0))
    assert found.status[found.measurement >= 0].tolist() == [CONFIRMED] * len(time)
    again = np.flatnonzero(found.time >= 80.0)[0]
    np.testing.assert_allclose(found.moments.mean[again], state[10], atol=1e-9)
    assert (found.track_id == 0).all()


def test_bearings_of_a_track_update_it_too(rng):
    """One line of sight along the flight halves nothing along it, and shrinks what lies across."""
    time, _, z = flight(rng, n=8)
    m = measured(time, z[:, :2], 10.0)
    bearing, origin = m.bearing.copy(), m.origin.copy()
    bearing[5:], origin[5:] = np.arctan2(5.0, 1.0), np.array([-500.0, -100.0])
    sights = np.where(np.arange(8) >= 5, np.radians(0.05), np.nan)
    m = m.take(np.arange(8))
    position = m.position.copy()
    position[5:] = np.nan
    m = replace(m, bearing=bearing, origin=origin, sigma_bearing=sights, position=position)
    source = np.where(np.arange(8) >= 5, 1, 0).astype(np.int32)
    m = replace(m, source=source)
    state = [[0.0, 100.0, 0.0, 20.0, 3000.0, 0.0]]
    found, _ = fused(m, candidates(m, np.zeros(8, int), state), kinds=(Kind.PLANE, Kind.BEARING), periods=[2.0, 2.0])
    assert found.measurement.tolist() == list(range(8))
    c = np.array([1.0, -5.0]) / np.sqrt(26.0)
    across = np.einsum("i,kij,j->k", c, found.moments.cov[:, :3:2, :3:2], c)
    assert across[7] < 0.05 * across[4]
