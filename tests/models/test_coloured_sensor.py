"""Noise with a memory: its law against closed forms, its sensors, and both ways through the multimode filter."""

import logging
import pickle

import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov

from oracles import dense_kalman, error
from saltus.errors import DataError, ModelError
from saltus.filters import IMM
from saltus.models import (
    BoundSensor,
    Chain,
    ColouredSensor,
    Gaussian,
    HybridModel,
    LinearSDE,
    LinearSensor,
    MarkovNoise,
    Observer,
    PolarSensor,
    PositionSensor,
    augmented,
    constant_velocity,
    discretise,
    first_order,
    second_order,
    treatment,
)
from saltus.models.noise import stationary_covariance

TURN = Chain("turn", {"no": 0.1, "yes": 2.0}, sojourn={"no": 20.0, "yes": 5.0})
NOISE = Chain("noise", {"calm": 1.0, "rough": 6.0}, sojourn={"calm": 30.0, "rough": 10.0})


def autocovariance(noise, lag):
    """E L u(t + lag) u(t)' L', from the discretised equation."""
    Phi, _ = discretise(noise.F, noise.G, lag)
    return noise.output @ Phi @ noise.cov0 @ noise.output.T


def test_stationary_covariance_is_scipy_s(rng):
    F, G = -2 * np.eye(3) + 0.6 * rng.normal(size=(4, 3, 3)), rng.normal(size=(4, 3, 2))
    want = np.stack([solve_continuous_lyapunov(f, -g @ g.T) for f, g in zip(F, G, strict=True)])
    assert error(stationary_covariance(F, G), want) < 1e-12


@pytest.mark.parametrize("lag", [0.0, 0.3, 2.0, 9.0])
def test_autocorrelation_is_as_described(lag):
    one = first_order([2.0, 5.0], 3.0, dims=2).bind([])
    want = np.diag(9.0 * np.exp(-lag / np.array([2.0, 5.0])))
    np.testing.assert_allclose(autocovariance(one, lag), want, atol=1e-12)
    two = second_order([2.0, 5.0], [3.0, 1.0], dims=2).bind([])
    s = lag / np.array([2.0, 5.0])
    np.testing.assert_allclose(autocovariance(two, lag), np.diag([9.0, 1.0] * (1 + s) * np.exp(-s)), atol=1e-12)
    zeta = 0.25
    swing = np.sqrt(1 - zeta**2)
    s = lag / 2.0
    want = 9.0 * np.exp(-zeta * s) * (np.cos(swing * s) + zeta / swing * np.sin(swing * s))
    assert autocovariance(second_order(2.0, 3.0, damping=zeta).bind([]), lag)[0, 0] == pytest.approx(want, abs=1e-12)


def test_noise_depends_on_chains_like_anything_else():
    noise = first_order(tau=4.0, sigma=lambda noise: noise, dims=2, white=0.5).bind([TURN, NOISE])
    assert noise.F.shape[-2:] == (2, 2) and noise.G.shape == (1, 2, 2, 2)
    np.testing.assert_allclose(noise.total()[0], [1.5 * np.eye(2), 36.5 * np.eye(2)])
    table = MarkovNoise(F=[[-1.0]], G={"by": {"noise": {"calm": [[1.0]], "rough": [[3.0]]}}}).bind([NOISE])
    np.testing.assert_allclose(table.cov0[:, 0, 0], [0.5, 4.5])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: first_order(-1.0, 1.0), "tau of coloured noise must be positive, got -1"),
        (lambda: second_order(1.0, 0.0), "sigma of coloured noise must be positive"),
        (lambda: second_order(1.0, 1.0, damping=0.0), "damping must be positive"),
        (lambda: first_order(1.0, 1.0, dims=0), "dims must be a positive whole number"),
        (lambda: MarkovNoise([[0.0]], [[1.0]]).bind([]), "no stationary law"),
        (lambda: MarkovNoise([[-1.0]], [[1.0], [1.0]]).bind([]), "do not fit"),
        (lambda: MarkovNoise([[-1.0]], [[1.0]], L=[1.0]), "L must be a matrix"),
        (lambda: MarkovNoise([[-1.0]], [[1.0]], white=[[-1.0]]), "white must be positive semi-definite"),
        (lambda: ColouredSensor(np.eye(2), first_order(1.0, 1.0)).bind([], 2), "does not fit the 1 component"),
    ],
)
def test_wrong_noise_is_refused(make, message):
    with pytest.raises(ModelError, match=message):
        make()


def test_a_random_walk_needs_its_covariance_at_the_start():
    noise = MarkovNoise([[0.0]], [[2.0]], cov0=[[9.0]]).bind([])
    np.testing.assert_array_equal(noise.total(), [[9.0]])


# --- in a model ---------------------------------------------------------------------------------------------


POSITION = np.kron(np.eye(2), [1.0, 0.0])


def model_with(sensors, chains=(TURN, NOISE), prior_time=None):
    motion = constant_velocity(dims=2, accel=(lambda turn: turn) if TURN in chains else 0.3, kind="white")
    prior = Gaussian(np.array([10.0, 1.0, -5.0, 0.5]), np.diag([400.0, 9.0, 400.0, 9.0]), prior_time)
    return HybridModel(list(chains), motion, sensors, prior)


def records_of(rng, names, n=12, missing=0.2):
    t = np.cumsum(rng.uniform(0.2, 3.0, n))
    z = np.cumsum(rng.normal(size=(n, 2)), axis=0) + 5.0 * rng.normal(size=(n, 2))
    z[rng.random(z.shape) < missing] = np.nan
    return [(t[k], names[rng.integers(len(names))], z[k]) for k in range(n)]


PLAIN = LinearSensor(POSITION, 4.0 * np.eye(2))
ONE = ColouredSensor(POSITION, first_order(5.0, lambda noise: noise, dims=2), d=[3.0, -1.0])
TWO = ColouredSensor(POSITION, second_order(lambda noise: 4.0 * noise, 3.0, dims=2, damping=0.6))
MIXED = ColouredSensor(POSITION, first_order(5.0, lambda noise: noise, dims=2, white=0.5))
SCALED = ColouredSensor(lambda noise: POSITION * noise, first_order(5.0, 3.0, dims=2))
WAYS = {
    "first": ({"a": ONE}, ["a"], "differencing", 4),
    "second": ({"a": TWO}, ["a"], "differencing", 6),
    "white part": ({"a": MIXED}, ["a"], "augmentation", 6),
    "H jumps": ({"a": SCALED}, ["a"], "augmentation", 6),
    "two": ({"a": ONE, "b": PLAIN}, ["a", "b"], "augmentation", 6),
    "two coloured, one heard": ({"a": ONE, "b": TWO}, ["b"], "differencing", 6),
    "plain heard": ({"a": ONE, "b": PLAIN}, ["b"], "white", 4),
}


@pytest.mark.parametrize("name", WAYS)
def test_the_chosen_way_gives_what_augmentation_gives(name, rng, caplog):
    sensors, heard, way, dimension = WAYS[name]
    model = model_with(sensors)
    how = treatment(model, heard)
    assert (how.way, how.dimension) == (way, dimension) and how.reason
    records = records_of(rng, heard)
    with caplog.at_level(logging.INFO, logger="saltus"):
        est = IMM(model, per_mode=True).run(records)
    assert way in caplog.text
    want = IMM(augmented(model), per_mode=True).run(records)
    assert est.mean.shape == (12, 4) and est.chains == ("turn", "noise")
    assert error(est.probs, want.probs) < 1e-6
    assert error(est.mean, want.mean[:, :4]) < 1e-6
    assert error(est.cov, want.cov[:, :4, :4]) < 1e-6
    assert error(est.mode_means, want.mode_means[..., :4]) < 1e-6
    np.testing.assert_allclose(est.log_likelihood, want.log_likelihood, rtol=1e-6, atol=1e-8)


def test_a_prior_before_the_first_record_is_moved_to_it(rng):
    model = model_with({"a": ONE}, prior_time=0.0)
    records = [(t + 4.0, name, z) for t, name, z in records_of(rng, ["a"])]
    a, b = IMM(model).run(records), IMM(augmented(model)).run(records)
    assert error(a.mean, b.mean[:, :4]) < 1e-6 and error(a.probs, b.probs) < 1e-6


def test_a_drift_and_a_single_record(rng):
    drifting = LinearSDE([[0.0, 1.0], [0.0, -0.1]], [[0.0], [1.0]], drift=[0.0, 0.7])
    sensor = ColouredSensor([[1.0, 0.0]], first_order(3.0, 2.0))
    model = HybridModel([], drifting, {"a": sensor}, Gaussian(np.zeros(2), np.diag([100.0, 4.0])))
    records = [(float(t), "a", [0.2 * t**2 + rng.normal()]) for t in range(8)]
    a, b = IMM(model).run(records), IMM(augmented(model)).run(records)
    assert error(a.mean, b.mean[:, :2]) < 1e-8
    assert error(IMM(model).run(records[:1]).mean, a.mean[:1]) < 1e-10


def test_second_order_noise_is_the_dense_gaussian_answer(rng):
    model = model_with({"a": ColouredSensor(POSITION, second_order(4.0, 3.0, dims=2))}, chains=())
    records = records_of(rng, ["a"], n=8, missing=0.3)
    arrays = augmented(model).compile(times=[r[0] for r in records])
    z, n_all = np.array([r[2] for r in records]), 8
    full = [np.broadcast_to(a, (len(z), *a.shape[-2:])) for a in arrays[:4]]
    mean, cov, total = dense_kalman(
        z, *full, np.zeros((len(z), n_all)), np.zeros((len(z), 2)), arrays.mean0, arrays.cov0
    )
    est = IMM(model).run(records)
    assert error(est.mean, mean[:, :4]) < 1e-7
    assert error(est.cov, cov[:, :4, :4]) < 1e-7
    np.testing.assert_allclose(np.cumsum(est.log_likelihood), total, rtol=1e-7, atol=1e-8)


def test_sensors_are_checked_pickled_and_compared():
    model = model_with({"a": ONE})
    again = pickle.loads(pickle.dumps(model))
    assert again == model and model != model_with({"a": TWO})
    assert isinstance(model.sensors["a"], BoundSensor)
    np.testing.assert_allclose(model.sensors["a"].noise()[0], [np.eye(2), 36 * np.eye(2)])
    x = np.array([1.0, 2.0, 3.0, 4.0])
    np.testing.assert_allclose(model.sensors["a"].h(x), np.array([[[4.0, 2.0]]]))
    assert augmented(model_with({"a": PLAIN})) == model_with({"a": PLAIN})


def test_modes_that_differ_in_the_memory_of_noise_alone_can_be_told_apart():
    fades = Chain("fades", {"fast": 1.0, "slow": 9.0}, sojourn={"fast": 30.0, "slow": 10.0})
    told = ColouredSensor(POSITION, first_order(lambda fades: fades, 3.0, dims=2))
    assert model_with({"a": told}, chains=[fades]).check() == []
    alike = ColouredSensor(POSITION, first_order(lambda fades: 5.0, 3.0, dims=2))
    assert [f.kind for f in model_with({"a": alike}, chains=[fades]).check()] == ["indistinguishable"]


def test_what_coloured_noise_does_not_go_with_is_refused(rng):
    model = model_with({"a": ONE, "b": PolarSensor(sigma_range=30.0, sigma_azimuth=0.01)})
    with pytest.raises(ModelError, match="'b' is nonlinear"):
        IMM(model).run(records_of(rng, ["a"]))
    with pytest.raises(ModelError, match="must not depend on t"):
        model_with({"a": ColouredSensor(lambda t: POSITION * t, first_order(1.0, 1.0, dims=2))})
    with pytest.raises(DataError, match="have no observer"):
        IMM(model_with({"a": ONE})).run([(0.0, "a", [1.0, 2.0], Observer([0.0, 0.0]))])
    with pytest.raises(DataError, match="no sensor 'c'"):
        IMM(model_with({"a": ONE, "c2": PositionSensor(2, 1.0)})).run([(0.0, "c", [1.0, 2.0])])
