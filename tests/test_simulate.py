"""Simulated worlds: numerical integration, exact moments and counting are the oracles."""

import numpy as np
import pyproj
import pytest
from scipy import stats
from scipy.integrate import solve_ivp

from saltus.errors import ModelError
from saltus.geo import Plane, Site, wrap
from saltus.simulate import (
    Leg,
    Radar,
    Trajectory,
    coordinated_turn,
    observe,
    radar_paper_trajectory,
    simulate_hybrid,
)


def test_paper_trajectory_case(cases):
    case = cases("radar_track")
    motion = radar_paper_trajectory()
    assert np.abs(motion.position - case["pos"]).max() <= 1e-8 * np.abs(case["pos"]).max()
    assert np.abs(motion.velocity - case["vel"]).max() <= 1e-8 * np.abs(case["vel"]).max()
    np.testing.assert_array_equal(motion.turning, case["man_h"])
    np.testing.assert_array_equal(motion.climbing, case["man_v"])


def test_paper_trajectory_by_its_description():
    motion = radar_paper_trajectory()
    np.testing.assert_allclose(np.hypot(*motion.velocity[:, :2].T), 600.0)
    heights = motion.position[:, 2]
    assert heights.max() == pytest.approx(11e3)
    assert heights.min() == pytest.approx(7e3)
    assert np.flatnonzero(motion.turning).tolist() == [*range(33, 38), *range(62, 67)]
    assert np.flatnonzero(motion.climbing).tolist() == [*range(18, 22), *range(48, 52)]
    turned = np.unwrap(np.arctan2(motion.velocity[:, 1], motion.velocity[:, 0]))
    assert np.degrees(turned[37] - turned[32]) == pytest.approx(143.24, abs=0.01)  # to the left
    assert np.degrees(turned[66] - turned[61]) == pytest.approx(-143.24, abs=0.01)


@pytest.mark.parametrize("turn_rate", [0.0, 1e-9, 1e-3, 0.02, -0.4])
@pytest.mark.parametrize("acceleration", [0.0, -1.5])
def test_leg_by_numerical_integration(turn_rate, acceleration):
    leg = Leg(40.0, turn_rate=turn_rate, acceleration=acceleration, climb=12.0, climb_acceleration=-0.2)
    way = Trajectory((1e3, -2e3, 5e3), 0.7, 200.0, (leg,), start=100.0)

    def rates(t, state):
        _, _, _, course, speed, climb = state
        return [speed * np.sin(course), speed * np.cos(course), climb, turn_rate, acceleration, -0.2]

    times = np.linspace(0.0, 40.0, 9)
    path = solve_ivp(rates, (0, 40), [1e3, -2e3, 5e3, 0.7, 200.0, 12.0], t_eval=times, rtol=1e-12, atol=1e-9).y
    motion = way.at(100.0 + times)
    np.testing.assert_allclose(motion.position, path[:3].T, atol=1e-5)
    velocity = np.stack([path[4] * np.sin(path[3]), path[4] * np.cos(path[3]), path[5]], axis=-1)
    np.testing.assert_allclose(motion.velocity, velocity, atol=1e-7)


def test_legs_join_without_a_jump():
    way = Trajectory(
        (0.0, 0.0, 3e3),
        0.0,
        150.0,
        (Leg(30.0), coordinated_turn(np.pi / 2, 9.81, 150.0), Leg(20.0, acceleration=2.0), Leg(10.0, climb=5.0)),
    )
    knots = np.cumsum([leg.duration for leg in way.legs[:-1]])
    before, after = way.at(knots - 1e-6), way.at(knots + 1e-6)
    np.testing.assert_allclose(before.position, after.position, atol=1e-3)
    np.testing.assert_allclose(before.velocity[:, :2], after.velocity[:, :2], atol=1e-4)
    np.testing.assert_allclose(way.at(way.end).velocity, [[190.0, 0.0, 5.0]], atol=1e-9)  # due east, 150 + 20 * 2


def test_coordinated_turn_pulls_the_acceleration_asked():
    leg = coordinated_turn(-np.pi, 15.0, 200.0)
    way = Trajectory((0.0, 0.0, 0.0), 1.0, 200.0, (leg,))
    v = way.at([10.0, 10.001]).velocity
    assert np.linalg.norm(v[1] - v[0]) / 0.001 == pytest.approx(15.0, rel=1e-3)
    assert v[0, 0] * v[1, 1] > v[0, 1] * v[1, 0]  # to the left
    np.testing.assert_allclose(way.at(way.end).velocity, -way.at(0.0).velocity, atol=1e-9)


def test_an_object_is_nowhere_before_and_after():
    way = Trajectory((0.0, 0.0, 0.0), 0.0, 100.0, (Leg(10.0, turn_rate=0.1),), start=5.0)
    motion = way.at([4.9, 5.0, 15.0, 15.1])
    np.testing.assert_array_equal(np.isnan(motion.position[:, 0]), [True, False, False, True])
    np.testing.assert_array_equal(motion.turning, [False, True, True, False])


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda: Leg(0.0), "duration"),
        (lambda: Leg(5.0, turn_rate=np.nan), "finite"),
        (lambda: Trajectory((0.0, 0.0, 0.0), 0.0, 1.0, ()), "at least one leg"),
        (lambda: Trajectory((0.0, np.inf, 0.0), 0.0, 1.0, (Leg(1.0),)), "finite"),
        (lambda: coordinated_turn(1.0, 0.0, 100.0), "lateral acceleration"),
    ],
)
def test_what_cannot_be_flown_is_refused(wrong, words):
    with pytest.raises(ModelError, match=words):
        wrong()


# --- radar -------------------------------------------------------------------------------------------------

SITE = Site(0.72, 0.03, 120.0)
PLANE = Plane(0.72, 0.03)
SHARP = {"sigma_range": 0.0, "sigma_azimuth": 0.0, "prob_detection": 1.0}


def truth_at(trajectory, times):
    """Slant range and azimuth by PROJ alone."""
    position = trajectory.at(times).position
    to_local = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=stere +lat_0={np.degrees(0.72)} +lon_0={np.degrees(0.03)} +ellps=WGS84 "
        f"+step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 "
        f"+lat_0={np.degrees(0.72)} +lon_0={np.degrees(0.03)} +h_0=120"
    )
    e, n, u = to_local.transform(*position.T)
    return np.sqrt(e**2 + n**2 + u**2), np.arctan2(e, n)


def circling(radius=8e3, north=60e3):
    """A holding circle that crosses the radar's north again and again."""
    return Trajectory((-radius, north, 3e3), 0.0, 120.0, (Leg(3000.0, turn_rate=120.0 / radius),))


def test_plots_come_when_the_antenna_passes_once_a_turn():
    radar = Radar(SITE, period=4.8, north_time=1.3, **SHARP)
    way = circling()
    seen = observe(radar, [way], PLANE, 100.0, 2900.0, np.random.default_rng(1))
    slant, azimuth = truth_at(way, seen.time)
    np.testing.assert_allclose(seen.slant, slant, atol=1e-3)
    np.testing.assert_allclose(wrap(seen.azimuth - azimuth), 0.0, atol=1e-8)
    np.testing.assert_allclose(wrap(2 * np.pi * (seen.time - 1.3) / 4.8 - azimuth), 0.0, atol=1e-6)
    assert (np.diff(seen.time) > 4.8 * 0.95).all()
    assert (np.diff(seen.time) < 4.8 * 1.05).all()  # none is missed where it crosses north
    assert seen.time[0] < 100.0 + 4.9
    assert seen.time[-1] > 2900.0 - 4.9
    np.testing.assert_array_equal(seen.target, 0)


def test_noise_and_misses_have_the_stated_size():
    radar = Radar(SITE, 2.0, sigma_range=40.0, sigma_azimuth=2e-3, sigma_altitude=15.0, prob_detection=0.8)
    ways = [circling(), circling(radius=5e3, north=100e3)] * 3
    seen = observe(radar, ways, PLANE, 0.0, 3000.0, np.random.default_rng(2))
    n = len(seen.time)
    trials = 6 * 1500
    assert abs(n - 0.8 * trials) < 5 * np.sqrt(trials * 0.8 * 0.2)
    assert (np.diff(seen.time) >= 0).all()
    for target, way in enumerate(ways):
        mine = seen.target == target
        slant, azimuth = truth_at(way, seen.time[mine])
        k = mine.sum()
        errors = (
            (seen.slant[mine] - slant) / 40.0,
            wrap(seen.azimuth[mine] - azimuth) / 2e-3,
            (seen.altitude[mine] - 3e3) / 15.0,
        )
        for error in errors:
            assert abs(error.mean()) < 5 / np.sqrt(k)
            assert abs(error.std() - 1) < 5 / np.sqrt(2 * k)


def test_out_of_range_and_out_of_time_is_not_seen():
    radar = Radar(SITE, 4.0, max_range=60e3, **SHARP)
    way = Trajectory((-50e3, 5e3, 2e3), np.pi / 2, 200.0, (Leg(600.0),), start=50.0)  # leaves 60 km at t = 600
    seen = observe(radar, [way], PLANE, 0.0, 1000.0, np.random.default_rng(3))
    assert seen.time.min() == pytest.approx(50.0, abs=4.0)
    assert seen.slant.max() <= 60e3
    assert seen.time.max() == pytest.approx(50 + (50e3 + 59.75e3) / 200, abs=5.0)


def test_clutter_is_poisson_and_uniform_over_the_area():
    radar = Radar(
        SITE, 4.0, 30.0, 1e-3, clutter_per_scan=12.0, clutter_altitudes=(0.0, 9e3), min_range=2e3, max_range=90e3
    )
    seen = observe(radar, [], PLANE, 0.0, 4000.0, np.random.default_rng(4))
    assert abs(len(seen.time) - 12_000) < 5 * np.sqrt(12_000)
    assert (seen.target == -1).all()
    # Kolmogorov-Smirnov at a false-alarm rate of 1e-6.
    area = (seen.slant**2 - 2e3**2) / (90e3**2 - 2e3**2)
    assert stats.kstest(area, "uniform").pvalue > 1e-6
    assert stats.kstest(seen.azimuth / (2 * np.pi), "uniform").pvalue > 1e-6
    assert stats.kstest(seen.altitude / 9e3, "uniform").pvalue > 1e-6
    np.testing.assert_allclose(wrap(seen.azimuth - 2 * np.pi * seen.time / 4.0), 0.0, atol=1e-6)
    bare = observe(Radar(SITE, 4.0, 30.0, 1e-3, clutter_per_scan=5.0), [], PLANE, 0.0, 40.0, np.random.default_rng(5))
    assert np.isnan(bare.altitude).all()


def test_quantised_values_are_whole_steps():
    radar = Radar(SITE, 4.0, 30.0, 1e-3, range_step=10.0, azimuth_step=2 * np.pi / 4096, altitude_step=7.62)
    seen = observe(radar, [circling()], PLANE, 0.0, 400.0, np.random.default_rng(6))
    for values, step in ((seen.slant, 10.0), (seen.azimuth, 2 * np.pi / 4096), (seen.altitude, 7.62)):
        np.testing.assert_allclose(values / step, np.round(values / step), atol=1e-6)


def test_the_same_seed_sees_the_same():
    radar = Radar(SITE, 4.0, 30.0, 1e-3, clutter_per_scan=3.0)
    a, b, c = (observe(radar, [circling()], PLANE, 0.0, 200.0, np.random.default_rng(s)) for s in (7, 7, 8))
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x, y)
    assert len(a.time) != len(c.time) or not np.array_equal(a.slant, c.slant)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"period": 0.0}, "period"),
        ({"sigma_range": -1.0}, "sigmas"),
        ({"prob_detection": 1.2}, "prob_detection"),
        ({"max_range": 100.0}, "max_range"),
    ],
)
def test_impossible_radars_are_refused(values, words):
    good = {"site": SITE, "period": 4.0, "sigma_range": 30.0, "sigma_azimuth": 1e-3}
    with pytest.raises(ModelError, match=words):
        Radar(**(good | values))


# --- hybrid models -----------------------------------------------------------------------------------------

SWITCH = np.array([[0.9, 0.1], [0.3, 0.7]])
THREE = np.array([[0.8, 0.2, 0.0], [0.0, 0.6, 0.4], [0.5, 0.0, 0.5]])


def test_without_chains_the_moments_are_those_of_the_linear_model():
    rng = np.random.default_rng(11)
    transition, noise = np.array([[1.0, 2.0], [0.0, 0.9]]), np.outer([2.0, 1.0], [2.0, 1.0])  # singular
    gain, measured = np.array([[1.0, 0.5]]), np.array([[3.0]])
    n = 40_000
    draws = simulate_hybrid(
        F=transition, Q=noise, H=gain, R=measured, trans=[], mean0=[5.0, -1.0], cov0=np.diag([4.0, 0.0]), probs0=1.0,
        n_steps=3, rng=rng, batch=n, b=[0.0, 0.3], d=[7.0],
    )  # fmt: skip
    assert draws.modes.shape == (n, 3, 0)
    # All of x0, w1, w2, w3 stacked: the third state is one dense linear map of them.
    powers = [np.linalg.matrix_power(transition, k) for k in range(4)]
    dense = np.hstack([powers[3], powers[2], powers[1], powers[0]])
    inputs = np.zeros((8, 8))
    inputs[:2, :2] = np.diag([4.0, 0.0])
    for k in range(1, 4):
        inputs[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = noise
    mean = powers[3] @ [5.0, -1.0] + (powers[0] + powers[1] + powers[2]) @ [0.0, 0.3]
    cov = dense @ inputs @ dense.T
    found = draws.states[:, 2]
    assert (np.abs(found.mean(0) - mean) < 5 * np.sqrt(np.diag(cov) / n)).all()
    error = 5 * np.sqrt((np.outer(np.diag(cov), np.diag(cov)) + cov**2) / n)
    assert (np.abs(np.cov(found.T) - cov) < error).all()
    noise_seen = draws.z[:, 2, 0] - found @ gain[0] - 7.0
    assert abs(noise_seen.var() - 3.0) < 5 * 3.0 * np.sqrt(2 / n)
    assert abs(np.corrcoef(noise_seen, found[:, 0])[0, 1]) < 5 / np.sqrt(n)


def test_modes_follow_their_chains():
    n, probs0 = 30_000, np.array([[0.1, 0.2, 0.0], [0.3, 0.3, 0.1]])
    one = np.eye(1)
    draws = simulate_hybrid(
        F=one.reshape(1, 1, 1, 1), Q=one.reshape(1, 1, 1, 1), H=one.reshape(1, 1, 1, 1), R=one.reshape(1, 1, 1, 1),
        trans=[SWITCH, THREE], mean0=[0.0], cov0=one, probs0=probs0, n_steps=2, rng=np.random.default_rng(12), batch=n,
    )  # fmt: skip
    law = probs0
    for k in range(2):
        law = np.einsum("ij,ia,jb->ab", law, SWITCH, THREE)  # the prior is one interval before the first step
        counts = np.zeros((2, 3))
        np.add.at(counts, (draws.modes[:, k, 0], draws.modes[:, k, 1]), 1)
        assert stats.chisquare(counts.ravel(), n * law.ravel()).pvalue > 1e-6
    pairs = np.zeros((3, 3))
    np.add.at(pairs, (draws.modes[:, 0, 1], draws.modes[:, 1, 1]), 1)
    rows = pairs.sum(axis=1, keepdims=True)
    assert (np.abs(pairs / rows - THREE) <= 5 * np.sqrt(THREE * (1 - THREE) / rows)).all()


def test_each_run_uses_its_own_modes_matrices():
    # No noise at all: replaying the modes gives the states exactly.
    rng = np.random.default_rng(13)
    transition = rng.normal(size=(4, 2, 1, 2, 2))  # time varying, by the first chain
    gain = rng.normal(size=(1, 3, 1, 2))  # by the second chain
    drift = rng.normal(size=(2, 3, 2))
    mean0 = rng.normal(size=(2, 1, 2))
    zero = np.zeros((1, 1, 2, 2))
    draws = simulate_hybrid(
        F=transition, Q=zero, H=gain, R=np.zeros((1, 1, 1, 1)), trans=[np.stack([SWITCH] * 4), THREE], mean0=mean0,
        cov0=np.zeros((2, 2)), probs0=np.outer([0.0, 1.0], [1.0, 0.0, 0.0]), n_steps=4, rng=rng, batch=50, b=drift,
    )  # fmt: skip
    for run in range(50):
        x = mean0[1, 0]
        for k in range(4):
            i, j = draws.modes[run, k]
            x = transition[k, i, 0] @ x + drift[i, j]
            np.testing.assert_allclose(draws.states[run, k], x, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(draws.z[run, k], gain[0, j] @ x, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"F": np.eye(2)}, "F has shape"),
        ({"trans": [SWITCH * 1.01]}, "sum to 1"),
        ({"trans": [np.ones((2, 3))]}, r"trans\[0\]"),
        ({"probs0": [0.5, 0.6]}, "probs0"),
        ({"Q": np.diag([1.0, -1.0])[None]}, "not a covariance"),
        ({"R": np.full((1, 1, 1), np.nan)}, "NaN"),
        ({"cov0": np.array([[1.0, 0.5], [0.0, 1.0]])}, "not symmetric"),
    ],
)
def test_arrays_that_are_no_model_are_refused(change, words):
    good = {
        "F": np.eye(2)[None], "Q": np.eye(2)[None], "H": np.eye(2)[None, :1], "R": np.eye(1)[None], "trans": [SWITCH],
        "mean0": [0.0, 0.0], "cov0": np.eye(2), "probs0": [0.5, 0.5], "n_steps": 3, "rng": np.random.default_rng(0),
    }  # fmt: skip
    simulate_hybrid(**good)
    with pytest.raises(ModelError, match=words):
        simulate_hybrid(**(good | change))
