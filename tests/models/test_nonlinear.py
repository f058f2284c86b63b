"""What radars, passive sensors and functions of the state measure; conventions, dependence, messages."""

import numpy as np
import pytest

from saltus.errors import ModelError, NumericalError
from saltus.models import (
    Chain,
    FunctionSensor,
    Gaussian,
    HybridModel,
    LinearSensor,
    Observer,
    PolarSensor,
    constant_velocity,
)

PRIOR = Gaussian([1e3, 10.0, 2e3, -5.0], np.diag([1e4, 100.0, 1e4, 100.0]))
FAULT = Chain("fault", {"ok": 1.0, "bad": 10.0}, stay=0.9, per=1.0)
FULL = PolarSensor(sigma_range=5.0, sigma_azimuth=0.01, sigma_elevation=0.02, sigma_range_rate=0.5, dims=3)


def test_azimuth_counts_from_north_clockwise():
    # The states' axes are east, north; compass points one after another.
    points = np.array([[0, 1], [1, 1], [1, 0], [1, -1], [-1, -1], [-1, 0], [-1, 1]]) * 100.0
    azimuth = PolarSensor(sigma_azimuth=0.01).h(points)[:, 0]
    np.testing.assert_allclose(np.degrees(azimuth), [0, 45, 90, 135, -135, -90, -45])


def test_components_of_a_right_angled_box():
    # A box of 3 x 4 x 12 has diagonals 5 (floor) and 13; north 4, east 3, up 12, moving up at 13 m/s.
    z = FULL.h([3.0, 0.0, 4.0, 0.0, 12.0, 13.0])
    np.testing.assert_allclose(z, [13.0, np.arctan2(3, 4), np.arctan2(12, 5), 12.0])
    assert FULL.components == ("range", "azimuth", "elevation", "range_rate")
    np.testing.assert_array_equal(FULL.R, np.diag([25.0, 1e-4, 4e-4, 0.25]))


def test_azimuth_is_relative_to_the_heading():
    # Heading east (90 degrees): an object to the north is 90 degrees to the left; one in the west is behind.
    looks_east = PolarSensor(sigma_azimuth=0.01, observer=Observer([0.0, 0.0], heading=np.pi / 2))
    np.testing.assert_allclose(np.degrees(looks_east.h([[0.0, 50.0], [50.0, 0.0], [0.0, -50.0]])[:, 0]), [-90, 0, 90])
    assert abs(looks_east.h([-50.0, 0.0])[0]) == pytest.approx(np.pi)


def test_only_what_moves_relative_to_the_observer_counts(rng):
    # The same scene from a frame that moves and turns with the observer: a rotation of all vectors about it.
    x = rng.normal(size=(20, 4)) * [1e3, 20, 1e3, 20]
    place, speed, heading = np.array([300.0, -700.0]), np.array([15.0, -4.0]), 0.7
    sensor = PolarSensor(
        sigma_range=1.0, sigma_azimuth=1.0, sigma_range_rate=1.0, observer=Observer(place, speed, heading)
    )
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, -s], [s, c]])  # a heading of 0.7 becomes north
    own = np.empty_like(x)
    own[:, ::2], own[:, 1::2] = (x[:, ::2] - place) @ turn.T, (x[:, 1::2] - speed) @ turn.T
    at_origin = PolarSensor(sigma_range=1.0, sigma_azimuth=1.0, sigma_range_rate=1.0)
    np.testing.assert_allclose(sensor.residual(sensor.h(x), at_origin.h(own)), 0.0, atol=1e-9)


def test_observers_broadcast_against_states():
    places = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 300.0]])
    sensor = PolarSensor(
        sigma_range=1.0, sigma_azimuth=1.0, observer=Observer(places[:, None], heading=[[0.0], [1], [2]])
    )
    x = np.array([[50.0, 1.0, 60.0, 2.0], [5.0, 0.0, -6.0, 0.0]])
    assert sensor.h(x).shape == (3, 2, 2) and sensor.jacobian(x).shape == (3, 2, 2, 4)
    for i, (place, heading) in enumerate(zip(places, (0.0, 1.0, 2.0), strict=True)):
        one = PolarSensor(sigma_range=1.0, sigma_azimuth=1.0, observer=Observer(place, heading=heading))
        np.testing.assert_array_equal(sensor.h(x)[i], one.h(x))
        np.testing.assert_array_equal(sensor.jacobian(x)[i], one.jacobian(x))


def test_residual_crosses_south_the_short_way():
    sensor = PolarSensor(sigma_range=1.0, sigma_azimuth=0.01)
    np.testing.assert_allclose(sensor.residual([10.0, np.pi - 0.01], [4.0, -np.pi + 0.02]), [6.0, -0.03])
    np.testing.assert_allclose(sensor.residual([10.0, 2 * np.pi - 0.01], [4.0, 0.02]), [6.0, -0.03])
    assert np.isnan(sensor.residual([np.nan, 0.0], [1.0, 0.0])).tolist() == [True, False]


def test_places_of_the_components_in_the_state(rng):
    # The same state, ordered axis by axis, with a turn rate at the end, and positions before velocities.
    x = rng.normal(size=(4, 4)) * 100
    plain = PolarSensor(sigma_range=1.0, sigma_range_rate=1.0).h(x)
    turning = PolarSensor(sigma_range=1.0, sigma_range_rate=1.0, axes=(0, 2))
    np.testing.assert_array_equal(turning.h(np.append(x, np.ones((4, 1)), axis=1)), plain)
    blocks = PolarSensor(sigma_range=1.0, sigma_range_rate=1.0, axes=(0, 1), velocities=(2, 3))
    np.testing.assert_array_equal(blocks.h(x[:, [0, 2, 1, 3]]), plain)
    np.testing.assert_array_equal(blocks.jacobian(x[:, [0, 2, 1, 3]])[..., [0, 2, 1, 3]], turning.jacobian(x))


@pytest.mark.parametrize(
    "sensor", [FULL, PolarSensor(sigma_azimuth=1.0, sigma_elevation=1.0, dims=3)], ids=["full", "passive"]
)
def test_jacobian_in_space_is_the_derivative(sensor, rng):
    x = rng.normal(size=(50, 6)) * [800, 20, 800, 20, 500, 10]
    step = 1e-2
    moved = [sensor.residual(sensor.h(x + step * e), sensor.h(x - step * e)) for e in np.eye(6)]
    # Third derivatives over the cube of distances of some 10 m upwards: error step^2 / distance^3.
    np.testing.assert_allclose(sensor.jacobian(x), np.stack(moved, axis=-1) / (2 * step), atol=1e-6)


def test_noise_and_offset_depend_on_chains_component_by_component():
    other = Chain("other", {"a": 0.0, "b": 1.0, "c": 2.0}, stay=0.9, per=1.0)
    sensor = PolarSensor(
        sigma_range=3.0,
        sigma_azimuth=lambda fault: 0.01 * fault,
        offset={"by": {"other": {"a": [0, 0], "b": [5, 0], "c": [0, 1]}}},
    )
    bound = sensor.bind([FAULT, other], 4)
    R = bound.at(0.0).noise()
    assert R.shape == (2, 1, 2, 2)
    np.testing.assert_allclose(R[:, 0, 0, 0], 9.0)
    np.testing.assert_allclose(R[:, 0, 1, 1], [1e-4, 1e-2])
    expected = bound.at(0.0).h(np.broadcast_to([3.0, 0.0, 4.0, 0.0], (2, 3, 4)))  # one state per mode
    np.testing.assert_allclose(expected[1] - [5.0, np.arctan2(3, 4)], [[0, 0], [5, 0], [0, 1]], atol=1e-12)
    assert sensor.bind([FAULT, other], 4) == bound


def test_noise_may_depend_on_time():
    sensors = (
        PolarSensor(sigma_range=lambda t, fault: (1 + t) * fault, sigma_azimuth=0.1),
        FunctionSensor(function=lambda x: x[..., :2], R=lambda t, fault: np.diag([(1 + t) ** 2 * fault**2, 0.01])),
        LinearSensor(H=np.eye(2, 4), R=lambda t, fault: np.diag([(1 + t) ** 2 * fault**2, 0.01])),
    )
    for sensor in sensors:
        bound = sensor.bind([FAULT], 4)
        with pytest.raises(ModelError, match="depends on chains or time"):
            bound.noise()
        np.testing.assert_allclose(bound.at(2.0).noise(), [np.diag([9.0, 0.01]), np.diag([900.0, 0.01])])


def test_a_model_keeps_nonlinear_sensors_and_compiles_the_linear_ones():
    gps = LinearSensor(H=np.eye(4)[::2], R=np.eye(2))
    model = HybridModel(
        [FAULT],
        constant_velocity(2, accel=1.0),
        {"gps": gps, "radar": PolarSensor(sigma_range=lambda fault: fault)},
        PRIOR,
    )
    assert model.compile(dt=1.0, sensor="gps").H.shape == (1, 2, 4)
    none = model.compile(times=[0.0, 1.0, 3.0], sensor=())
    assert none.H.shape == (1, 0, 4) and none.R.shape == (1, 0, 0) and none.F.shape == (3, 1, 4, 4)
    with pytest.raises(ModelError, match=r"sensor 'radar' is not linear: a PolarSensor has no matrices.*\n.*IMM"):
        model.compile(dt=1.0)


def found(sensor, chains=(FAULT,)):
    return HybridModel(chains, constant_velocity(2, accel=1.0), {"s": sensor}, PRIOR).check()


def test_doubts_about_modes_reach_nonlinear_sensors():
    assert found(PolarSensor(sigma_range=lambda fault: fault)) == []
    assert found(PolarSensor(sigma_range=1.0, offset=lambda fault: [fault])) == []
    (alike,) = found(PolarSensor(sigma_range=1.0))
    assert alike.kind == "indistinguishable" and alike.where == "chain fault, states ok and bad"
    assert found(PolarSensor(sigma_range=lambda t: 1.0 + t)) == []  # depends on time: not looked at


def test_no_derivative_at_the_observer():
    for sensor in (PolarSensor(sigma_range=1.0), PolarSensor(sigma_azimuth=1.0)):
        with pytest.raises(NumericalError, match="coincides with the observer"):
            sensor.jacobian(np.zeros((3, 4)))
    with pytest.raises(NumericalError, match="straight above"):
        FULL.jacobian([0.0, 1.0, 0.0, 1.0, 100.0, 0.0])
    assert np.isfinite(PolarSensor(sigma_range=1.0, dims=3).jacobian([0.0, 1.0, 0.0, 1.0, 100.0, 0.0])).all()


def test_a_function_s_own_derivative_is_used():
    sensor = FunctionSensor(function=np.sin, derivative=lambda x: np.full((*x.shape, 2), 7.0), R=np.eye(2))
    assert (sensor.jacobian(np.ones((3, 2))) == 7.0).all()
    numerical = FunctionSensor(function=np.sin, R=np.eye(2)).jacobian([0.3, -0.9])
    # Steps of 1e-5: truncation step^2 / 6 = 2e-11, round-off 1e-16 / 1e-5.
    np.testing.assert_allclose(numerical, np.diag(np.cos([0.3, -0.9])), atol=1e-10)


@pytest.mark.parametrize(
    "build, message",
    [
        (lambda: PolarSensor(), "measures nothing: give sigma_range"),
        (lambda: PolarSensor(sigma_range=0.0), "sigma_range must be positive, got 0"),
        (lambda: PolarSensor(sigma_azimuth=np.nan), "sigma_azimuth holds nan"),
        (lambda: PolarSensor(sigma_azimuth=lambda fault: -fault).bind([FAULT], 4), "sigma_azimuth must be positive"),
        (
            lambda: PolarSensor(sigma_azimuth=lambda wind: wind).bind([FAULT], 4),
            "'wind', which is no chain of this model",
        ),
        (lambda: PolarSensor(sigma_range=1.0, dims=1), "dims must be 2"),
        (lambda: PolarSensor(sigma_elevation=0.1), "only in three dimensions: pass dims=3"),
        (lambda: PolarSensor(sigma_range=1.0, axes=(0, 0)), "axes must be 2 different indices"),
        (lambda: PolarSensor(sigma_range=1.0, axes=(0, 1, 2)), "axes must be 2 different indices"),
        (lambda: PolarSensor(sigma_range=1.0, axes=(0, 7)).bind([], 4), "do not fit a state of 4"),
        (lambda: PolarSensor(sigma_range=1.0).bind([], 5), r"does not fit a state of 5.*axes=\(0, 2\)"),
        (lambda: PolarSensor(sigma_range_rate=1.0).bind([], 2), r"no velocities at \[1, 2\]"),
        (lambda: PolarSensor(sigma_range_rate=1.0, axes=(0, 1)).bind([], 4), r"velocities=\(1, 3\)"),
        (lambda: PolarSensor(sigma_range=1.0, offset=[1.0, 2.0]), r"offset must have one entry.*\(1,\)"),
        (lambda: PolarSensor(sigma_range=1.0, offset=lambda fault: [1, fault]).bind([FAULT], 4), "offset"),
        (lambda: PolarSensor(sigma_range=1.0, observer=Observer([1.0, 2.0, 3.0])), "3 components.*dims=2"),
        (lambda: PolarSensor(sigma_range=1.0, prob_detection=1.5), "prob_detection must lie in"),
        (lambda: Observer([1.0]), r"must be \(2,\) or \(3,\)"),
        (lambda: Observer([1.0, 2.0], [1.0]), "velocity must have the components of position"),
        (lambda: Observer([1.0, np.inf]), "position holds inf"),
        (lambda: FunctionSensor(function=np.sin, R=[1.0]), "R must be a covariance matrix"),
        (lambda: FunctionSensor(function=np.sin, R=[[1.0]], angles=(1,)), r"angles \(1,\) are not among 1"),
        (lambda: FunctionSensor(function=np.sin, R=[[1.0]]).h(np.ones((3, 2))), r"shape \(3, 2\) for states.*\(3, 1\)"),
        (lambda: FunctionSensor(function=np.sum, R=[[1.0]]).h(np.ones((3, 2))), r"shape \(\) for states"),
        (lambda: FunctionSensor(function=np.sin, R=np.eye(2)).at(0.0, Observer([0.0, 0.0])), "has no observer"),
        (lambda: LinearSensor(H=np.eye(2), R=np.eye(2)).at(0.0, Observer([0.0, 0.0])), "has no observer"),
    ],
)
def test_bad_sensors(build, message):
    with pytest.raises(ModelError, match=message):
        build()


def test_a_sensor_that_binds_to_nothing_usable_is_refused():
    class Half(LinearSensor):
        def bind(self, chains, n_state):
            return object()

    with pytest.raises(ModelError, match="sensor 'half': bind gave object, which lacks"):
        HybridModel([], constant_velocity(2, accel=1.0), {"half": Half(H=np.eye(4), R=np.eye(4))}, PRIOR)
