import numpy as np
import pytest

from saltus.models import (
    Chain,
    Gaussian,
    HybridModel,
    LinearSDE,
    LinearSensor,
    LinearTransition,
    PositionSensor,
    constant_velocity,
)

MODE = Chain("mode", {"one": 1.0, "two": 2.0}, stay=0.9)
GAIN = Chain("gain", {"low": 1.0, "high": 2.0}, stay=0.9)
CV = constant_velocity(1, accel=1.0)
CV_F, CV_G = [[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]
SEEN = {"s": PositionSensor(1, 1.0)}
PRIOR = Gaussian(np.zeros(2), np.eye(2))


def kinds(chains, dynamics, sensors=SEEN, prior=PRIOR):
    return [f.kind for f in HybridModel(chains, dynamics, sensors, prior).check()]


def test_a_sound_model_has_no_findings():
    assert kinds([MODE], constant_velocity(1, accel=lambda mode: mode)) == []
    assert kinds([], LinearSDE(CV_F, CV_G)) == []
    assert kinds([], LinearTransition([[1.0, 1.0], [0.0, 1.0]], np.eye(2))) == []


def test_states_nothing_depends_on():
    found = HybridModel([MODE, GAIN], constant_velocity(1, accel=lambda mode: mode), SEEN, PRIOR).check()
    assert [f.kind for f in found] == ["indistinguishable"]
    assert found[0].where == "chain gain, states low and high"
    assert str(found[0]).startswith("chain gain, states low and high: all matrices are equal")


def test_joint_modes_that_coincide():
    # The gain only enters as mode * gain: (one, high) is (two, low).
    sensors = {"s": LinearSensor(H=[[1.0, 0.0]], R=lambda mode, gain: [[mode * gain]])}
    found = HybridModel([MODE, GAIN], CV, sensors, PRIOR).check()
    assert [f.where for f in found] == ["modes (mode=one, gain=high) and (mode=two, gain=low)"]


@pytest.mark.parametrize(
    "dynamics, expected",
    [
        (LinearTransition(CV_F, np.eye(2)), "undiscretised"),
        (LinearTransition([[-0.1, 1.0], [-1.0, -0.1]], np.eye(2)), "undiscretised"),
        (LinearTransition([[1.1, 1.0], [0.0, 1.0]], np.eye(2)), "unstable"),
        (LinearSDE([[1.0, 4.0], [0.0, 1.0]], CV_G), "not-continuous"),
        (LinearSDE([[0.1, 1.0], [0.0, 0.0]], CV_G), "unstable"),
        (LinearSDE(CV_F, np.zeros((2, 1))), "no-noise"),
    ],
)
def test_doubtful_motion(dynamics, expected):
    assert kinds([], dynamics) == [expected]


def test_one_bad_mode_is_named():
    found = HybridModel([MODE], LinearSDE(lambda mode: [[mode - 1, 1], [0, 0]], CV_G), SEEN, PRIOR).check()
    assert [(f.kind, f.where) for f in found] == [("unstable", "dynamics, mode=two")]


def test_what_no_sensor_sees():
    speed = {"s": LinearSensor(H=[[0.0, 1.0]], R=[[1.0]])}
    found = HybridModel([], CV, speed, PRIOR).check()
    assert [f.kind for f in found] == ["unobservable"] and "x[0]" in found[0].where


def test_what_one_mode_hides():
    blind = {"s": LinearSensor(H=lambda mode: [[2.0 - mode, 0.0]], R=[[1.0]])}
    found = HybridModel([MODE], CV, blind, PRIOR).check()
    assert [(f.kind, f.where) for f in found] == [("unobservable-in-mode", "mode=two")]
    assert "x[0], x[1]" in found[0].message


def test_motion_that_belongs_to_intervals():
    scan = HybridModel([MODE], constant_velocity(1, accel=lambda mode: mode, kind="scan"), SEEN, PRIOR)
    assert [f.kind for f in scan.check()] == ["per-interval"]
    assert scan.check(times=[0.0, 4.0, 8.001, 8.001, 12.0]) == []
    found = scan.check(times=[0.0, 4.0, 8.0, 16.0, 20.0])  # at 4 s: accel * 8 against accel * sqrt(2) * 4
    assert found[0].message.startswith("over 8 s x[1] is disturbed by 8, over two intervals of 4 s by 5.66: a missed")
    own = LinearTransition(F=lambda dt: [[1.0, dt], [0.0, 1.0]], Q=lambda dt: dt * np.eye(2))
    assert kinds([], own) == ["per-interval"]  # Q is not that of white noise through F


def test_motion_that_belongs_to_time():
    for motion in (CV, constant_velocity(1, accel=2.0, kind="white"), LinearSDE(CV_F, CV_G, [0.0, 3.0])):
        assert HybridModel([], motion, SEEN, PRIOR).check(times=[0.0, 1.0, 5.0]) == []
    drifts = LinearTransition(F=lambda dt: np.eye(2), Q=lambda dt: dt * np.eye(2), b=lambda dt: [0.0, 3.0 * dt])
    assert kinds([], drifts, {"s": PositionSensor(2, 1.0)}) == []


def test_units_do_not_hide_observability():
    # Position in metres, speed in units of 1e9 m/s: observable all the same.
    scaled = LinearSDE([[0.0, 1e9], [0.0, 0.0]], [[0.0], [1e-9]])
    assert kinds([], scaled, prior=Gaussian(np.zeros(2), np.diag([1.0, 1e-18]))) == []


def test_states_never_entered():
    dead = Chain("mode", {"one": 1.0, "two": 2.0}, trans=[[1.0, 0.0], [0.1, 0.9]])
    found = HybridModel([dead], constant_velocity(1, accel=lambda mode: mode), SEEN, PRIOR).check()
    assert [(f.kind, f.where) for f in found] == [("unreachable", "chain mode, state two")]


def test_matrices_that_depend_on_time_are_left_alone():
    sensors = {"s": LinearSensor(H=[[1.0, 0.0]], R=lambda t: [[1.0 + t]])}
    assert kinds([MODE], constant_velocity(1, accel=1.0), sensors) == []
