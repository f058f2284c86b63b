"""Gates: what they promise in simulation, which pairs they form, and what becomes of heights and faulty plots."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, ncx2
from tracking_scenes import measured

from saltus.records import Kind
from saltus.tracks.channel import Start
from saltus.tracks.faults import SourceCondition, plot_law
from saltus.tracks.gates import Gate, distances, predict
from saltus.tracks.kinematics import make_kinematics
from saltus.tracks.lifecycle import CONFIRMED, TENTATIVE, Birth, Lifecycle
from saltus.tracks.settings import FilterSettings, TrackerSettings

DT = 4.0
STAYS = dict(sojourn_h=(60.0, 20.0), accel_v=(0.2, 4.0), sojourn_v=(60.0, 20.0))
AGILE = FilterSettings(accel_h=(0.2, 8.0), **STAYS, turn_rate=(), accel_time=0.0)
STEADY = FilterSettings(accel_h=(2.0,), sojourn_h=(60.0,), accel_v=(1.0,), sojourn_v=(60.0,), accel_time=0.0)
COV = np.kron(np.eye(3), [[900.0, 60.0], [60.0, 25.0]])  # of every start, per axis position and velocity


def tracks(filters, mean, status=TENTATIVE, time=0.0, icao24=-1):
    """Kinematics and lifecycle with one track per row of `mean`, last updated at `time`."""
    k = len(mean)
    kinematics, life = make_kinematics(filters), Lifecycle(TrackerSettings())
    cov = np.broadcast_to(COV, (k, 6, 6))
    rows = kinematics.add(Start(mean, cov))
    life.begin(rows, Birth(np.full(k, time), np.full(k, DT), np.zeros(k, int), mean, cov))
    life.status[rows], life.icao24[rows] = status, icao24
    return kinematics, life, rows


def far_apart(n):
    """States of n targets, 60 km from one another, flying 200 m/s in different directions at 8 km."""
    side = int(np.ceil(np.sqrt(n)))
    mean = np.zeros((n, 6))
    mean[:, 0], mean[:, 2], mean[:, 4] = 6e4 * (np.arange(n) % side), 6e4 * (np.arange(n) // side), 8e3
    angle = np.arange(n) * 2.4
    mean[:, 1], mean[:, 3] = 200.0 * np.cos(angle), 200.0 * np.sin(angle)
    return mean


def later(rng, mean, accel, sigma, accel_v=1.0):
    """Plots of targets drawn from the tracks' own law: start, one acceleration for the interval, noise."""
    x = mean + rng.standard_normal(mean.shape) @ np.linalg.cholesky(COV).T
    a = rng.standard_normal((len(mean), 3)) * [accel, accel, accel_v]
    z = x[:, 0::2] + DT * x[:, 1::2] + DT**2 / 2 * a
    z[:, :2] += sigma * rng.standard_normal((len(mean), 2))
    return z, z[:, 2] + 10.0 * rng.standard_normal(len(mean))


def gated(filters, mean, m, *, probability, identity=True, prior=None, **kwargs):
    kinematics, life, rows = tracks(filters, mean, **kwargs)
    settings = TrackerSettings(gate_probability=probability)
    gate = Gate(settings, filters, np.array([4.0, 4.0]), use_identity=identity)
    source = SourceCondition(plot_law(settings, Kind.POLAR if np.isfinite(m.ray).all() else Kind.PLANE), settings)
    prior = source.predicted(0.0) if prior is None else np.log(prior)
    found = gate(kinematics, life, m, np.arange(len(m)), source, prior)
    row_of = np.full(rows.max() + 1, -1)
    row_of[rows] = np.arange(len(rows))
    return found, row_of[found.pairs.track]


def own_share(found, track):
    return float((track == found.pairs.plot).sum())


@pytest.mark.parametrize("probability", [0.9, 0.99])
def test_gates_hold_the_stated_share_of_plots(rng, probability):
    n = 6400
    mean = far_apart(n)
    z, height = later(rng, mean, 2.0, 25.0)
    m = measured(np.full(n, DT), z[:, :2], 25.0, altitude=height)
    found, track = gated(STEADY, mean, m, probability=probability)
    bound = 5 * np.sqrt(n * probability * (1 - probability))
    assert abs(own_share(found, track) - n * probability) < bound
    # Height is gated by itself: of the pairs found the stated share keeps it.
    inside = len(found.height_used)
    assert abs(found.height_used.sum() - inside * probability) < 5 * np.sqrt(inside * probability * (1 - probability))


def test_the_count_would_show_noise_twice_as_large(rng):
    n, probability = 6400, 0.9
    mean = far_apart(n)
    z, height = later(rng, mean, 2.0, 50.0)
    m = measured(np.full(n, DT), z[:, :2], 25.0, altitude=height)
    found, track = gated(STEADY, mean, m, probability=probability)
    assert own_share(found, track) < n * probability - 5 * np.sqrt(n * probability * (1 - probability))


@pytest.mark.parametrize("form", ["decomposed", "joint"])
def test_the_gate_is_that_of_a_manoeuvre(rng, form):
    """Targets that begin to manoeuvre are inside at the stated probability, steady ones more often."""
    n, p = 3600, 0.95
    mean = far_apart(n)
    filters = replace(AGILE, form=form)
    shares = []
    for accel in (8.0, 0.2):
        z, height = later(rng, mean, accel, 25.0)
        m = measured(np.full(n, DT), z[:, :2], 25.0, altitude=height)
        shares.append(own_share(*gated(filters, mean, m, probability=p)) / n)
    assert abs(shares[0] - p) < 5 * np.sqrt(p * (1 - p) / n)
    assert shares[1] > p + 5 * np.sqrt(p * (1 - p) / n)


@pytest.mark.parametrize("form", ["decomposed", "joint"])
def test_a_target_that_turns_stays_inside(rng, form):
    """Turns of 12 degrees in a scan, 84 m off the straight, to either side.

    With S the variance of a straight way's innovations a filter without turns sees d^2/S = 3.9 of noncentrality; with
    them the gate reaches sqrt(1 + 3.9) times as far to the sides, and 2 of its 6.7 deviations are the turn's.
    """
    n, p, turn = 900, 0.99, np.radians(3.0)
    mean = far_apart(n)
    filters = FilterSettings(form=form, accel_h=(0.2, 0.5), **STAYS, turn_rate=(3.0,))
    speed = mean[:, 1] + 1j * mean[:, 3]
    for side in (turn, -turn):
        bent = mean.copy()
        way = speed * (np.exp(-1j * side * DT) - 1.0) / (-1j * side)  # clockwise is negative about the vertical
        bent[:, 0] += way.real - DT * mean[:, 1]
        bent[:, 2] += way.imag - DT * mean[:, 3]
        z, height = later(rng, bent, 0.2, 5.0)
        m = measured(np.full(n, DT), z[:, :2], 5.0, altitude=height)
        error = 5.0 * np.sqrt(p * (1.0 - p) / n)
        assert own_share(*gated(filters, mean, m, probability=p)) / n > p - error
        straight = own_share(*gated(replace(filters, turn_rate=()), mean, m, probability=p)) / n
        S = [1.0, DT] @ COV[:2, :2] @ [1.0, DT] + 0.5**2 * 4.0 * DT**3 / 3.0 + 5.0**2
        expected = ncx2.cdf(chi2.ppf(p, 2), 2, np.abs(way[0] - DT * speed[0]) ** 2 / S)
        assert abs(straight - expected) < 5.0 * np.sqrt(expected * (1.0 - expected) / n)


@pytest.mark.parametrize("identity", [True, False])
def test_pairs_are_those_of_a_loop_over_all(rng, identity):
    """Crowded tracks, plots spread over a slice: the coarse gate cuts nothing off that the exact one holds."""
    mean = np.zeros((60, 6))
    mean[:, 0::2] = rng.uniform(-800, 800, (60, 3))
    mean[:, 1::2] = rng.uniform(-250, 250, (60, 3))
    time, xy = np.sort(rng.uniform(2.0, 3.6, 70)), rng.uniform(-1200, 1200, (70, 2))
    plot_code, track_code = rng.integers(-1, 2, 70), rng.integers(-1, 2, 60)
    m = measured(time, xy, 40.0, icao24=plot_code)
    found, track = gated(STEADY, mean, m, probability=0.99, identity=identity, icao24=track_code)
    expected = set()
    for i in range(60):
        for j, dt in enumerate(time):
            F = np.kron(np.eye(2), [[1.0, dt], [0.0, 1.0]])
            g = np.array([dt**2 / 2, dt])
            P = F @ COV[:4, :4] @ F.T + np.kron(np.eye(2), 2.0**2 * np.outer(g, g))
            nu = m.position[j, :2] - (F @ mean[i, :4])[[0, 2]]
            S = P[np.ix_([0, 2], [0, 2])] + 40.0**2 * np.eye(2)
            apart = identity and plot_code[j] != track_code[i] and min(plot_code[j], track_code[i]) >= 0
            held = plot_code[j] >= 0 and plot_code[j] in track_code  # then it is for that track alone
            apart = apart or (identity and track_code[i] < 0 and held)
            if nu @ np.linalg.inv(S) @ nu <= chi2.ppf(0.99, 2) and not apart:
                expected.add((i, j))
    assert len(expected) > 40
    right = np.array([pair in expected for pair in zip(track.tolist(), found.pairs.plot.tolist(), strict=True)])
    assert set(zip(track[right].tolist(), found.pairs.plot[right].tolist(), strict=True)) == expected
    # Tracks not confirmed yet take a faulty plot only where the address vouches for it.
    assert identity or right.all()
    assert (track_code[track[~right]] == plot_code[found.pairs.plot[~right]]).all()
    assert (track_code[track[~right]] >= 0).all()


def test_a_garbled_height_is_ignored_and_the_plot_kept(rng):
    n = 40
    mean = far_apart(n)
    z = mean[:, 0::2] + DT * mean[:, 1::2]
    altitude = z[:, 2] + np.where(np.arange(n) % 2, 3000.0, 0.0)
    m = measured(np.full(n, DT), z[:, :2], 25.0, altitude=altitude)
    found, track = gated(AGILE, mean, m, probability=0.9999)
    assert (np.sort(track) == np.arange(n)).all()
    garbled = found.pairs.plot % 2 == 1
    assert (found.height_used == ~garbled).all()
    assert np.isnan(found.plan.z[garbled, 2]).all()
    assert np.isfinite(found.plan.z[~garbled, 2]).all()


def polar(m, site_xy):
    """Let the plots come from a radar at a place of the plane."""
    ray = m.position[:, :2] - site_xy
    range_azimuth = np.stack([np.hypot(*ray.T), np.arctan2(ray[:, 0], ray[:, 1])], axis=-1)
    return replace(m, ray=ray, polar=range_azimuth)


@pytest.mark.parametrize(("shift", "kind"), [((0.0, 1500.0), 1), ((1200.0, 0.0), 2)])
def test_a_faulty_plot_is_explained_for_confirmed_tracks_only(shift, kind):
    """A target 60 km east of the radar: 1500 m north is 1.4 degrees of azimuth, 1200 m east is range."""
    mean = np.zeros((1, 6))
    mean[0, 0], mean[0, 4] = 60e3, 8e3
    m = polar(measured([DT], [[60e3 + shift[0], shift[1]]], 25.0), np.zeros(2))
    found, _ = gated(AGILE, mean, m, probability=0.9999, status=CONFIRMED)
    assert found.pairs.plot.tolist() == [0]
    # An azimuth error moves the plot across its ray by the range times the error, a range error along it.
    x, y = 60e3 + shift[0], shift[1]
    settings = TrackerSettings()
    if kind == 1:
        moved = np.radians(settings.outlier_azimuth) * np.array([-y, x])
    else:
        moved = settings.outlier_range / np.hypot(x, y) * np.array([x, y])
    np.testing.assert_allclose(found.covs[0, 0, :2, :2], 25.0**2 * np.eye(2), rtol=1e-12)
    np.testing.assert_allclose(found.covs[0, kind, :2, :2], 25.0**2 * np.eye(2) + np.outer(moved, moved), rtol=1e-9)
    tentative, _ = gated(AGILE, mean, m, probability=0.9999, status=TENTATIVE)
    assert len(tentative.pairs.plot) == 0


def test_a_plot_far_beyond_any_fault_is_nobodys():
    mean = np.zeros((1, 6))
    mean[0, 0], mean[0, 4] = 60e3, 8e3
    m = polar(measured([DT], [[60e3, 9000.0]], 25.0), np.zeros(2))
    found, _ = gated(AGILE, mean, m, probability=0.9999, status=CONFIRMED)
    assert len(found.pairs.plot) == 0


@pytest.mark.parametrize(("prior", "share"), [((0.999, 0.001), 0.0), ((0.9, 0.1), 1.0)])
def test_gates_widen_when_the_source_is_probably_degraded(prior, share):
    """Plots 4.9 deviations off: outside the gate of a source that is well, inside that of one five times worse."""
    mean = far_apart(20)
    plots = mean[:, :3:2] + DT * mean[:, 1:4:2]
    P = 900.0 + 2 * DT * 60.0 + DT**2 * 25.0 + 100.0**2 + (DT**2 / 2 * 2.0) ** 2
    m = measured(np.full(20, DT), plots + np.array([4.9 * np.sqrt(P), 0.0]), 100.0)
    found, _ = gated(STEADY, mean, m, probability=0.9999, prior=np.array(prior))
    assert len(found.pairs.plot) == 20 * share


def test_first_plots_are_compared_with_all_that_their_gates_hold_and_no_more(rng):
    """Dense plots a slice later, against every pair's distance by the filter's own prediction."""
    n = 300
    mean, cov = np.zeros((n, 6)), np.zeros((n, 6, 6))
    mean[:, 0:3:2] = rng.uniform(-15e3, 15e3, (n, 2))
    cov[:, [0, 2], [0, 2]], cov[:, [1, 3], [1, 3]], cov[:, 4, 4], cov[:, 5, 5] = 900.0, 100.0**2, 1e6, 225.0
    settings = TrackerSettings(plot_outlier=0.0, degraded_noise=1.0)
    kinematics, life = make_kinematics(AGILE), Lifecycle(settings)
    rows = kinematics.add(Start(mean, cov))
    life.begin(rows, Birth(np.zeros(n), np.full(n, DT), np.zeros(n, int), mean, cov))
    m = measured(rng.uniform(3.5, 4.5, n), rng.uniform(-15e3, 15e3, (n, 2)), 30.0)
    gate = Gate(settings, AGILE, np.array([4.0]), use_identity=False)
    source = SourceCondition(plot_law(settings, Kind.PLANE), settings)
    near = gate._near(life, m, np.arange(n), source, source.predicted(0.0))
    found = gate(kinematics, life, m, np.arange(n), source, source.predicted(0.0))
    track, plot = np.repeat(rows, n), np.tile(np.arange(n), n)
    ahead = predict(kinematics, life, m, track, plot, np.zeros((n * n, 3, 3)))
    d2, _ = distances(ahead.nu, ahead.S)
    inside = set(zip(track[d2 <= gate.horizontal].tolist(), plot[d2 <= gate.horizontal].tolist(), strict=True))
    assert len(inside) > 300
    assert set(zip(found.pairs.track.tolist(), found.pairs.plot.tolist(), strict=True)) == inside
    assert len(near.track) < 1.01 * len(inside) + 3
