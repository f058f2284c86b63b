import pickle

import numpy as np
import pytest

from saltus.errors import ModelError
from saltus.models import (
    SENSORS,
    BoundSensor,
    Chain,
    ColouredSensor,
    FunctionSensor,
    LinearSensor,
    Observer,
    PolarSensor,
    PositionSensor,
    second_order,
)


def squares(x):
    return x[..., :2] ** 2 / 1e3


EXAMPLES = {
    "LinearSensor": [LinearSensor(H=[[1.0, 0, 2, 0]], R=[[4.0]], d=[3.0], prob_detection=0.9)],
    "ColouredSensor": [ColouredSensor(H=[[1.0, 0, 2, 0]], noise_model=second_order(5.0, 3.0), d=[3.0])],
    "PositionSensor": [PositionSensor(dims=2, sigma=[3.0, 5.0])],
    "PolarSensor": [
        PolarSensor(sigma_range=30.0, sigma_azimuth=0.01, sigma_range_rate=2.0, offset=[5.0, 0.1, 1.0]),
        PolarSensor(sigma_azimuth=0.01, observer=Observer([300.0, -200.0], heading=2.0), prob_detection=0.9),
        PolarSensor(sigma_range=5.0),
        PolarSensor(sigma_range_rate=0.5, observer=Observer([300.0, -200.0], velocity=[10.0, 5.0])),
        PolarSensor(sigma_range=5.0, sigma_azimuth=0.01, sigma_elevation=0.02, dims=3, axes=(0, 2, 3)),
    ],
    "FunctionSensor": [FunctionSensor(function=squares, R=np.eye(2), angles=(1,), offset=[1.0, 2.0])],
}


def test_every_sensor_has_an_example():
    assert set(SENSORS) == set(EXAMPLES)


@pytest.fixture(params=[(name, i) for name in sorted(SENSORS) for i in range(len(EXAMPLES.get(name, [])))], ids=str)
def sensor(request):
    name, i = request.param
    assert type(EXAMPLES[name][i]) is SENSORS[name]
    return EXAMPLES[name][i]


def test_jacobian_is_the_derivative(sensor, rng):
    x = rng.normal(size=(3, 4)) * 1e3
    step = 1e-3
    moved = [sensor.residual(sensor.h(x + step * e), sensor.h(x - step * e)) for e in np.eye(4)]
    np.testing.assert_allclose(sensor.jacobian(x), np.stack(moved, axis=-1) / (2 * step), atol=1e-6)


def test_residual_of_a_prediction_is_zero(sensor, rng):
    x = rng.normal(size=(3, 4))
    assert not sensor.residual(sensor.h(x), sensor.h(x)).any()
    np.testing.assert_allclose(sensor.residual(sensor.h(x) + 2.0, sensor.h(x)), 2.0)


def test_bound_form_measures_the_same(sensor, rng):
    x = rng.normal(size=(5, 4))
    bound = sensor.bind([], 4)
    assert isinstance(bound, BoundSensor)
    now = bound.at(3.0)
    np.testing.assert_allclose(now.h(x), sensor.h(x))
    np.testing.assert_array_equal(now.noise(), sensor.R)
    assert bound.prob_detection == now.prob_detection == sensor.prob_detection


def test_bound_form_of_linear_sensors_has_their_matrices(rng):
    x = rng.normal(size=(5, 4))
    for sensor in (*EXAMPLES["LinearSensor"], *EXAMPLES["PositionSensor"]):
        H, R, d = sensor.bind([], 4).measured(None)
        np.testing.assert_allclose(x @ H.T + (0 if d is None else d), sensor.h(x))
        np.testing.assert_array_equal(R, sensor.R)


def test_compares_and_pickles(sensor):
    assert pickle.loads(pickle.dumps(sensor)) == sensor
    assert sensor != LinearSensor(H=[[1.0, 0, 2, 0]], R=[[5.0]])


def test_position_takes_the_first_component_of_each_axis():
    x = np.arange(6.0)
    np.testing.assert_array_equal(PositionSensor(2, 1.0).h(x), [0.0, 3.0])  # position, velocity, acceleration
    np.testing.assert_array_equal(PositionSensor(3, 1.0).h(x), [0.0, 2.0, 4.0])
    np.testing.assert_array_equal(PositionSensor(2, [3.0, 5.0]).R, np.diag([9.0, 25.0]))


def test_noise_depends_on_chains():
    fog = Chain("fog", {"no": 1.0, "yes": 10.0}, stay=0.9)
    bound = PositionSensor(2, sigma=lambda fog: 3.0 * fog).bind([fog], 4)
    np.testing.assert_allclose(bound.measured(None).R, [9.0 * np.eye(2), 900.0 * np.eye(2)])


@pytest.mark.parametrize(
    "build, message",
    [
        (lambda: LinearSensor(H=np.ones(2), R=np.eye(1)), r"H must be a matrix \(m, n\).*\n.*H\[None, :\]"),
        (lambda: LinearSensor(H=np.eye(2), R=np.eye(3)), r"R must have shape \(2, 2\) to go with H"),
        (lambda: LinearSensor(H=np.eye(2), R=np.ones(2)), r"R must be a covariance matrix.*\n.*np.diag"),
        (lambda: LinearSensor(H=np.eye(2), R=[[1, 0.5], [0.2, 1]]), r"must be symmetric: entries \[0, 1\]"),
        (lambda: LinearSensor(H=np.eye(2), R=[[1, 2], [2, 1]]), "smallest eigenvalue is -1"),
        (lambda: LinearSensor(H=np.eye(2), R=np.diag([1e8, -1e-6])), "smallest eigenvalue is -1e-06"),
        (lambda: LinearSensor(H=np.eye(2), R=np.eye(2), d=[1.0]), r"d must have shape \(2,\)"),
        (lambda: LinearSensor(H=np.eye(2), R=np.eye(2), prob_detection=0.0), r"must lie in \(0, 1\], got 0.0"),
        (lambda: LinearSensor(H=np.eye(2), R=np.eye(2)).bind([], 4), "2 columns, but the state has 4"),
        (lambda: PositionSensor(0, 1.0), "positive whole number of axes"),
        (lambda: PositionSensor(2, 0.0), "sigma must be positive metres, got 0"),
        (lambda: PositionSensor(2, [1.0, 2.0, 3.0]), r"one per axis \(2,\)"),
        (lambda: PositionSensor(2, 1.0).bind([], 5), "does not fit a state of 5 components"),
    ],
)
def test_bad_sensors(build, message):
    with pytest.raises(ModelError, match=message):
        build()
