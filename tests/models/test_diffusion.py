"""Switching diffusions and their sensors: what they give, what they refuse, and hybrid models lowered to them."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from diffusions import case, unchecked
from saltus import (
    Chain,
    DataError,
    DiffusionSensor,
    Gaussian,
    HybridModel,
    LinearSDE,
    LinearSensor,
    ModelError,
    SwitchingSDE,
)
from saltus.models import FunctionSensor, as_diffusion, constant_velocity


def one_mode(**changes):
    given = {"drift": [lambda y: -y], "diffusion": [0.5], "intensity": {}}
    return SwitchingSDE(**(given | changes))


def two_modes(**changes):
    given = {"drift": [lambda y: -y] * 2, "diffusion": [0.5, 1.0], "intensity": {(0, 1): 0.3}, "probs0": [0.5, 0.5]}
    return SwitchingSDE(**(given | changes))


def test_functions_and_constants_give_the_same_fields(rng):
    x = rng.standard_normal((4, 3, 2))
    B = np.array([[0.5, 0.1, 0.0], [0.0, 0.2, 1.0]])
    common = {"mean0": [0.0, 1.0], "cov0": np.eye(2)}
    constant = one_mode(drift=[[1.0, 2.0]], diffusion=[B], **common)
    function = one_mode(
        drift=[lambda y: np.broadcast_to([1.0, 2.0], y.shape)],
        diffusion=[lambda y: np.broadcast_to(B, (*y.shape[:-1], 2, 3))],
        **common,
    )
    for model in (constant, function):
        assert (model.drift_at(0, x) == [1.0, 2.0]).all() and model.drift_at(0, x).shape == x.shape
        assert model.diffusion_at(0, x).shape == (4, 3, 2, 3)
        np.testing.assert_allclose(model.covariance_at(0, x), np.broadcast_to(B @ B.T, (4, 3, 2, 2)), rtol=1e-15)
    scalar = one_mode(diffusion=[0.5], **common)
    np.testing.assert_array_equal(scalar.diffusion_at(0, x[0, 0]), 0.5 * np.eye(2))
    np.testing.assert_array_equal(scalar.covariance_at(0, x)[1, 1], 0.25 * np.eye(2))


def test_rates_add_up_to_the_exit_rate(rng):
    model, _ = case("a1")
    x = rng.standard_normal((5, 1))
    np.testing.assert_allclose(model.exit_rate(1, x), 0.2 + 0.6 * x[:, 0] ** 2 / (1 + x[:, 0] ** 2), rtol=1e-15)
    assert (model.rate((0, 1), x) == 0.3).all() and (two_modes().exit_rate(1, x) == 0).all()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"drift": [lambda y: y]}, "drift has 1 entries, but probs0 has 2 modes"),
        ({"drift": [lambda y: y[..., 0]] * 2}, r"drift\[0\] returned shape .* must keep leading axes"),
        ({"drift": [lambda y: np.full_like(y, np.nan)] * 2}, r"drift\[0\] is not finite at state"),
        ({"drift": [[1.0, 2.0]] * 2}, r"drift\[0\] has shape \(2,\), but must have \(1,\)"),
        ({"intensity": {(0, 1): -0.1}}, r"intensity\[\(0, 1\)\] is -0.1 per second at state .*not be negative"),
        ({"intensity": {(0, 1): np.nan}}, "holds nan"),
        ({"intensity": [0.1, 0.2]}, r"dictionary of rates by \(from, to\)"),
        ({"drift": np.sin}, "list with one entry per mode"),
        ({"diffusion": 0.6}, "list with one entry per mode"),
        (
            {"diffusion": [[0.8], 0.6]},
            r"diffusion\[0\] has shape \(1,\), but must have \(1, w\).*\n.*one row per component",
        ),
        ({"diffusion": [lambda y: y, 0.6]}, r"must keep leading axes: \(2, 5, 1, w\)"),
        ({"drift": [lambda y: y if y > 0 else -y] * 2}, r"drift\[0\] failed for states .*\n.*np.where for branches"),
        ({"intensity": {(0, 0): 0.1}}, r"key \(0, 0\); keys are \(from, to\)"),
        ({"intensity": {(0, 2): 0.1}}, "two different modes of 0..1"),
        ({"intensity": {(0, 1): lambda y: y**2}}, "must keep leading axes"),
        ({"restore": {(1, 0): ([0.0], [[1.0]])}}, r"restore has \(1, 0\), a switch without intensity"),
        ({"restore": {(0, 1): 1.5}}, r"restore\[\(0, 1\)\] must be \(mean, cov\)"),
        ({"restore": 1.5}, r"restore must be a dictionary"),
        ({"mean0": 0.0}, r"mean0 must be \(n,\).*Write \[0.0\]"),
        ({"restore": {(0, 1): ([0.0, 1.0], np.eye(2))}}, r"restore\[\(0, 1\)\] must be a mean \(1,\)"),
        ({"restore": {(0, 1): ([0.0], [[-1.0]])}}, "positive semi-definite"),
        ({"probs0": [0.5, 0.6]}, "sum to 1"),
        ({"mean0": [[0.0], [1.0], [2.0]]}, r"mean0 must have shape \(1,\), or \(2, 1\) per mode"),
        ({"cov0": np.eye(2)}, "cov0 must have shape"),
    ],
)
def test_what_cannot_be_is_refused(changes, words):
    with unchecked(), pytest.raises(ModelError, match=words):
        two_modes(**changes)


def test_a_rate_that_falls_below_zero_far_out_is_refused_where_a_filter_looks():
    model = two_modes(intensity={(0, 1): lambda y: 9.0 - y[..., 0]})
    assert model.rate((0, 1), np.array([8.0])) == 1.0
    with pytest.raises(ModelError, match=r"is -1 per second at state \[10.\].*\n.*np.maximum"):
        model.exit_rate(0, np.array([[8.0], [10.0]]))


def test_a_sensor_is_refused_with_the_reason():
    with unchecked(), pytest.raises(ModelError, match="h must be a list with one entry per mode"):
        DiffusionSensor(h=np.sin, R=[1.0])
    with unchecked(), pytest.raises(ModelError, match="angular must be a list with one entry per component, got 0"):
        DiffusionSensor(h=[lambda y: y], R=[1.0], angular=0)
    with pytest.raises(ModelError, match="one h and one R per mode: got 2 and 1"):
        DiffusionSensor(h=[lambda y: y] * 2, R=[1.0])
    with pytest.raises(ModelError, match="positive definite"):
        DiffusionSensor(h=[lambda y: y], R=[0.0])
    with pytest.raises(ModelError, match="quadratic variation"):
        DiffusionSensor(h=[lambda y: y] * 2, R=[1.0, 2.0], continuous=True)
    with pytest.raises(ModelError, match="not wrapped"):
        DiffusionSensor(h=[lambda y: y], R=[1.0], angular=(0,), continuous=True)
    sensor = DiffusionSensor(h=[lambda y: y], R=[np.eye(2)], angular=(2,))
    with pytest.raises(ModelError, match="angular components"):
        sensor.check(np.zeros((1, 2)))
    with pytest.raises(ModelError, match="has 2 modes, but the sensor describes 1"):
        sensor.check(np.zeros((2, 2)))
    with pytest.raises(ModelError, match=r"R\[0\] has shape"):
        sensor.check(np.zeros((1, 1)))


def test_likelihood_is_the_normal_density_of_what_was_seen(rng):
    R = np.array([[0.5, 0.2], [0.2, 0.3]])
    h = lambda y: np.stack([y[..., 0] ** 2, y[..., 1]], axis=-1)  # noqa: E731
    sensor = DiffusionSensor(h=[h], R=[R])
    x, z = rng.standard_normal((2, 6, 5, 2))
    z[0, 0] = [np.nan, 1.0]
    z[1, 1] = np.nan
    got = sensor.log_likelihood(0, z, x)
    for i, j in np.ndindex(6, 5):
        seen = ~np.isnan(z[i, j])
        cov = R[np.ix_(seen, seen)]
        want = multivariate_normal(h(x[i, j])[seen], cov).logpdf(z[i, j][seen]) if seen.any() else 0.0
        assert got[i, j] == pytest.approx(want, rel=1e-12, abs=1e-12)


def test_noise_may_depend_on_the_state(rng):
    x, z = rng.standard_normal((2, 7, 1))
    sensor = DiffusionSensor(h=[lambda y: y], R=[lambda y: (0.1 + y**2)[..., None]])
    sensor.check(np.zeros((1, 1)))
    variance = 0.1 + x[:, 0] ** 2
    want = -0.5 * ((z - x)[:, 0] ** 2 / variance + np.log(2 * np.pi * variance))
    np.testing.assert_allclose(sensor.log_likelihood(0, z, x), want, rtol=1e-12)


def test_a_bearing_and_one_turn_more_are_the_same(rng):
    _, sensor = case("c")
    x, z = rng.standard_normal((9, 2)), rng.standard_normal((9, 2))
    turned = z + np.array([0.0, 2 * np.pi])
    np.testing.assert_allclose(sensor.log_likelihood(0, turned, x), sensor.log_likelihood(0, z, x), rtol=1e-9)


def test_increments_weigh_states_as_the_measured_rate_does(rng):
    """log g = log N(dZ; h dt, R dt) up to what does not depend on the state."""
    R, dt = np.array([[0.5, 0.2], [0.2, 0.3]]), 0.1
    sensor = DiffusionSensor(h=[lambda y: y**2], R=[R], continuous=True)
    x, dz = rng.standard_normal((20, 2)), rng.standard_normal(2)
    log_g = sensor.log_likelihood(0, dz, x, dt)
    want = np.array([multivariate_normal(y**2 * dt, R * dt).logpdf(dz) for y in x])
    np.testing.assert_allclose(log_g - log_g[0], want - want[0], rtol=1e-9, atol=1e-9)
    with pytest.raises(DataError, match="diagonal R"):
        sensor.log_likelihood(0, np.array([np.nan, 1.0]), x, dt)


def two_chains(dynamics=None, sensors=None):
    turn = Chain("turn", {"no": 0.1, "yes": 2.0}, sojourn={"no": 10.0, "yes": 5.0})
    radar = Chain(
        "radar", {"ok": 1.0, "jammed": 5.0, "off": 50.0}, rates=[[-0.1, 0.1, 0], [0.2, -0.3, 0.1], [1, 0, -1]]
    )
    F = np.array([[0.0, 1.0], [0.0, -0.2]])
    motion = LinearSDE(F, lambda turn: np.array([[0.0], [turn]]), drift=lambda turn: np.array([0.0, turn]))
    seen = LinearSensor(np.array([[1.0, 0.0]]), lambda radar: np.array([[radar**2]]))
    prior = Gaussian(lambda turn: np.array([0.0, turn]), np.eye(2))
    return HybridModel([turn, radar], dynamics or motion, sensors or {"radar": seen}, prior)


def test_a_product_of_chains_becomes_modes(rng):
    model = two_chains()
    sde, sensor = as_diffusion(model)
    assert (sde.n_modes, sde.n_state, sensor.check(sde.means0)) == (6, 2, 1)
    turns, radars = (0.1, 2.0), (1.0, 5.0, 50.0)
    generator = np.kron(model.chains[0].generator, np.eye(3)) + np.kron(np.eye(2), model.chains[1].generator)
    x, z = rng.standard_normal((4, 2)), rng.standard_normal((4, 1))
    for mode, (i, j) in enumerate(np.ndindex(2, 3)):
        want = x @ np.array([[0.0, 1.0], [0.0, -0.2]]).T + [0.0, turns[i]]
        np.testing.assert_allclose(sde.drift_at(mode, x), want, rtol=1e-14)
        np.testing.assert_array_equal(sde.covariance_at(mode, x[0]), np.diag([0.0, turns[i] ** 2]))
        assert sde.means0[mode, 1] == turns[i]
        want = -0.5 * ((z - x[:, :1]) / radars[j]) ** 2 - np.log(np.sqrt(2 * np.pi) * radars[j])
        np.testing.assert_allclose(sensor.log_likelihood(mode, z, x), want[:, 0], rtol=1e-12)
        for to in range(6):
            if to != mode:
                assert sde.rate((mode, to), x[0]) == pytest.approx(generator[mode, to])
    np.testing.assert_allclose(sde.probs0, np.multiply.outer(*(c.law for c in model.chains)).ravel())


def test_angles_are_found_and_sensors_stacked():
    bearing = FunctionSensor(function=lambda x: np.arctan2(x[..., 1:], x[..., :1]), R=[[0.01]], angles=(0,))
    model = two_chains(sensors={"place": LinearSensor(np.eye(2), np.eye(2)), "bearing": bearing})
    sde, sensor = as_diffusion(model)
    assert sensor.angular == (2,) and sensor.check(sde.means0) == 3
    assert as_diffusion(model, "place")[1].check(sde.means0) == 2
    with pytest.raises(ModelError, match="no sensor 'sonar'"):
        as_diffusion(model, "sonar")


def test_what_has_no_stochastic_equation_is_not_lowered():
    with pytest.raises(ModelError, match="kind='lasting'"):
        as_diffusion(two_chains(dynamics=constant_velocity(dims=1, accel=1.0, kind="scan")))
    white = constant_velocity(dims=1, accel=1.0, kind="white")
    assert as_diffusion(two_chains(dynamics=white))[0].n_state == 2
    step = Chain("turn", ["no", "yes"], stay=0.9)
    model = two_chains(dynamics=white)
    with pytest.raises(ModelError, match="no rates per second"):
        as_diffusion(
            HybridModel([step], white, {"place": LinearSensor(np.eye(2), np.eye(2))}, Gaussian([0, 0], np.eye(2)))
        )
    assert model.n_modes == 6
