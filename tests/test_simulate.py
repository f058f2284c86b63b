"""Simulated worlds: numerical integration, exact moments and counting are the oracles."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from saltus.errors import ModelError
from saltus.simulate import Leg, Trajectory, coordinated_turn, radar_paper_trajectory


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
