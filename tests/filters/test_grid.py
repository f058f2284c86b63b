"""The grid filter against reference posteriors, a Kalman filter, sampled exact mixtures and closed forms."""

import numpy as np
import pytest
from scipy.linalg import expm

from diffusions import case, distances, exact_mixture, few, unchecked
from saltus import (
    Chain,
    DataError,
    DiffusionSensor,
    Gaussian,
    GridFilter,
    HybridModel,
    LinearSDE,
    LinearSensor,
    ModelError,
    NumericalError,
    SwitchingSDE,
    imm_filter,
)
from saltus.filters.grid.bounds import axes_within, reach, start
from saltus.filters.grid.generator import generator
from saltus.filters.grid.propagate import dense, split, uniformised
from saltus.models import discretise


@pytest.mark.parametrize("name", ["a1", "a2", "b", "br"])
def test_agrees_with_the_reference_posterior(cases, name):
    """The reference has 320 cells and is good to 0.003 standard deviations; ours adds about as much at 200."""
    part = few(cases(f"moments_{name}"), 10, 40)
    model, sensor = case(name)
    found = GridFilter(200, ([-4.5], [4.5])).run(model, sensor, part["z"], part["times"])
    mean, cov, prob = distances(found, part)
    assert mean < 0.005 and cov < 0.005 and prob < 0.003
    assert 0.2 * mean < np.sqrt(np.mean(found.error**2)) < 0.01


def test_agrees_with_the_reference_posterior_in_two_dimensions(cases):
    part = few(cases("moments_c"), 4, 20)
    model, sensor = case("c")
    found = GridFilter(cells=110).run(model, sensor, part["z"], part["times"])
    mean, cov, prob = distances(found, part)
    assert mean < 0.015 and cov < 0.015 and prob < 0.01
    assert 0.3 * mean < np.sqrt(np.mean(found.error**2)) < 0.03


def test_error_falls_with_the_square_of_the_width(cases):
    part = few(cases("moments_b"), 4, 20)
    model, sensor = case("b")
    bounds = ([-3.5], [3.5])
    fine, half, rough = (GridFilter(n, bounds).run(model, sensor, part["z"], part["times"]) for n in (400, 160, 80))
    off = [np.abs(f.mean - fine.mean).mean() for f in (half, rough)]
    assert 3.0 < off[1] / off[0] < 5.5  # 4, and the finest grid's own error
    assert np.mean(rough.error) > 2.5 * np.mean(half.error)


def test_is_a_kalman_filter_without_switching():
    rng = np.random.default_rng(4)
    F, B = np.array([[-0.7]]), np.array([[0.5]])
    times = np.cumsum(rng.uniform(0.05, 0.4, 12))  # as many intervals as measurements: uniformised
    z = rng.standard_normal((3, 12, 1))
    z[1, 4:6] = np.nan
    model = SwitchingSDE(drift=[lambda y: -0.7 * y], diffusion=[0.5], intensity={}, mean0=[0.3], cov0=[[0.8]])
    found = GridFilter(cells=200).run(model, DiffusionSensor(h=[lambda y: y], R=[0.3]), z, times)
    Phi, Q = discretise(F, B, np.diff(times, prepend=0.0))
    want = imm_filter(
        z, F=Phi, Q=Q, H=[[1.0]], R=[[0.3]], trans=[], mean0=[0.3], cov0=[[0.8]], probs0=1.0, backend="numpy"
    )
    np.testing.assert_allclose(found.mean, want.mean, atol=2e-3)  # h^2 / 24 of the steepest posterior
    assert np.abs(found.mean - want.mean).max() < 5 * (found.error * np.sqrt(found.cov[..., 0, 0])).max()
    np.testing.assert_allclose(found.cov, want.cov, rtol=5e-3)
    np.testing.assert_allclose(found.log_likelihood, want.log_likelihood, rtol=5e-4, atol=2e-3)  # tails of 4 sigma
    np.testing.assert_allclose(found.nis, want.nis, rtol=5e-3, atol=2e-3)
    assert (found.n_observed[1, 4:6] == 0).all() and (found.log_likelihood[1, 4:6] == 0).all()


def test_is_the_kalman_filter_of_a_target_in_two_dimensions():
    """Position and velocity: one axis has no noise of its own, so that cells blur it; the error says how much."""
    chain = Chain("engine", ["on"], rates=[[0.0]])
    motion = LinearSDE(np.array([[0.0, 1.0], [-1.0, -1.0]]), np.array([[0.0], [0.8]]))
    seen = LinearSensor(np.array([[1.0, 0.0]]), np.array([[0.3]]))
    model = HybridModel([chain], motion, {"place": seen}, Gaussian([0.0, 0.0], np.eye(2)))
    rng, times = np.random.default_rng(8), 0.25 * np.arange(1, 11)
    z = rng.standard_normal((2, 10, 1))
    found = GridFilter(cells=100, bounds=([-5, -5], [5, 5])).run(model, None, z, times)
    arrays = model.compile(dt=np.full(10, 0.25))
    want = imm_filter(z, **arrays._asdict(), backend="numpy")
    sd = np.sqrt(np.diagonal(want.cov, axis1=-2, axis2=-1))
    assert np.abs((found.mean - want.mean) / sd).max() < 0.1
    assert np.abs((found.mean - want.mean) / sd).max() < 10 * found.error.max()


def test_agrees_with_the_exact_mixture():
    rng = np.random.default_rng(11)
    times, z = np.array([0.5, 1.0, 1.5]), np.array([0.9, -0.4, 0.7])
    want, error = exact_mixture(z, times, rng, 200_000)
    found = GridFilter().run(*case("b"), z[:, None], times)
    got = np.array([found.probs[-1, 0], found.mean[-1, 0], found.cov[-1, 0, 0]])
    assert (np.abs(got - want) < 5 * error + 1e-3).all()
    assert error.max() < 2e-3


def test_restoration_has_the_moments_of_its_law():
    """No measurement: mode probabilities and moments obey the linear equations (D)."""
    model, sensor = case("br")
    t = 0.7
    found = GridFilter().run(model, sensor, np.full((1, 1), np.nan), [t])
    u0 = np.array([0.5, 0.5, 0.0, 0.0, 0.5, 0.5])  # P, P M, P <y^2>
    A = np.zeros((6, 6))
    A[:2, :2] = A[2:4, 2:4] = A[4:, 4:] = -0.4 * np.eye(2)
    A[0, 1] = A[1, 0] = 0.4
    A[2:4, 2:4] -= np.eye(2)
    A[2, 0], A[3, 1] = 1.0, -1.0  # the forcing
    A[2, 1], A[3, 0] = 0.4 * -1.5, 0.4 * 1.5  # where a switch puts the state
    A[4:, 4:] -= 2 * np.eye(2)
    A[4, 2], A[5, 3] = 2.0, -2.0
    A[4, 0] = A[5, 1] = 0.16
    A[4, 1] = A[5, 0] = 0.4 * (2.25 + 0.04)
    u = expm(A * t) @ u0
    assert found.probs[0, 0] == pytest.approx(u[0], abs=1e-6)
    assert found.mean[0, 0] == pytest.approx(u[2] + u[3], abs=1e-4)
    assert found.cov[0, 0, 0] == pytest.approx(u[4] + u[5] - (u[2] + u[3]) ** 2, rel=2e-3)


def chain_of(name, cells):
    model, _ = case(name)
    axes = axes_within(*reach(model, 5.0), (cells,) * model.n_state)
    return generator(model, axes), start(model, axes)[None]


@pytest.mark.parametrize("name", ["a1", "br", "c"])
def test_every_propagator_keeps_probability_and_its_sign(name):
    rates, p = chain_of(name, 40)
    makers = [uniformised(rates.change, rates.fastest(), 0.2), dense(rates, 0.2) if name != "c" else split(rates, 0.2)]
    rng = np.random.default_rng(0)
    for p0 in (p, np.where(rng.uniform(size=p.shape) > 0.99, 1.0, 0.0)):
        one, two = (move(p0) for move in makers)
        for moved in (one, two):
            assert moved.min() >= 0
            np.testing.assert_allclose(moved.sum(), p0.sum(), rtol=1e-12)
        if name != "c":
            np.testing.assert_allclose(one, two, atol=1e-11 * p0.sum())
    if name == "c":  # splitting is second order in the substep, here 0.1 s
        smooth = [np.abs(a - b).sum() for a, b in zip((makers[0](p),), (makers[1](p),), strict=True)]
        assert smooth[0] < 2e-3


def test_splitting_agrees_where_axes_and_switches_are_entangled():
    swirl = SwitchingSDE(
        drift=[lambda y: np.stack([y[..., 1] - y[..., 0], -y[..., 0]], axis=-1), lambda y: -y],
        diffusion=[0.5, 0.8],
        intensity={(0, 1): lambda y: y[..., 0] ** 2 / (1 + y[..., 0] ** 2), (1, 0): 0.7},
        restore={(1, 0): ([1.0, 0.0], 0.1 * np.eye(2))},
        probs0=[0.5, 0.5],
        mean0=[0.5, 0.0],
        cov0=0.3 * np.eye(2),
    )
    axes = axes_within(*reach(swirl, 1.0), (36, 36))
    rates, p = generator(swirl, axes), start(swirl, axes)[None]
    whole = uniformised(rates.change, rates.fastest(), 0.2)(p)
    off = [np.abs(split(rates, dt)(p) - uniformised(rates.change, rates.fastest(), dt)(p)).sum() for dt in (0.05, 0.1)]
    assert np.abs(split(rates, 0.2)(p) - whole).sum() < 5e-3
    assert off[0] < 0.2 * off[1]  # third order in one substep: a factor 8


def test_increments_of_a_continuous_sensor_agree_with_measured_rates():
    """dZ over dt is a measurement dZ / dt with variance R / dt of a state that hardly moves meanwhile."""
    model, _ = case("a1")
    rng = np.random.default_rng(5)
    times = 0.01 * np.arange(1, 6)
    dz = 0.01 * rng.standard_normal((2, 5, 1)) + 0.05 * rng.standard_normal((2, 5, 1))
    cubed = [lambda y: y**3] * 2
    one = GridFilter(160, estimate_error=False).run(
        model, DiffusionSensor(h=cubed, R=[0.5] * 2, continuous=True), dz, times
    )
    other = GridFilter(160, estimate_error=False).run(model, DiffusionSensor(h=cubed, R=[50.0] * 2), dz / 0.01, times)
    np.testing.assert_allclose(one.mean, other.mean, atol=1e-12)
    np.testing.assert_allclose(one.probs, other.probs, atol=1e-12)
    np.testing.assert_allclose(one.nis, other.nis, rtol=1e-9)


def test_runs_do_not_depend_on_each_other(cases):
    part = few(cases("moments_a2"), 3, 8)
    model, sensor = case("a2")
    grid = GridFilter(60, ([-4], [4]))
    whole = grid.run(model, sensor, part["z"].reshape(3, 1, 8, 1), part["times"])
    alone = grid.run(model, sensor, part["z"][1], part["times"])
    assert whole.probs.shape == (3, 1, 8, 2) and alone.mean.shape == (8, 1)
    np.testing.assert_allclose(whole.mean[1, 0], alone.mean, rtol=1e-10)
    dense_ = grid.densities(model, sensor, part["z"], part["times"])
    mean = np.einsum("btsi,i->bt", dense_.probs, dense_.axes[0])
    np.testing.assert_allclose(mean, whole.mean[:, 0, :, 0], rtol=1e-10)
    np.testing.assert_allclose(dense_.density.sum((-1, -2)) * 8 / 60, 1.0, rtol=1e-10)


def test_what_a_grid_cannot_do_is_refused():
    model, sensor = case("b")
    z, times = np.zeros((2, 1)), [0.2, 0.4]
    with pytest.raises(ModelError, match="at least 8 on each of 1 axes, got 4"):
        GridFilter(4).run(model, sensor, z, times)
    with pytest.raises(ModelError, match="low < high"):
        GridFilter(bounds=(1.0, -1.0)).run(model, sensor, z, times)
    with pytest.raises(DataError, match=r"z must be \(..., T, 1\)"):
        GridFilter().run(model, sensor, z, [0.2])
    with pytest.raises(DataError, match="must not decrease"):
        GridFilter().run(model, sensor, z, [0.4, 0.2])
    with pytest.raises(DataError, match="holds infinity"):
        GridFilter().run(model, sensor, np.full((2, 1), np.inf), times)
    with unchecked(), pytest.raises(DataError, match="z must be an array of numbers"):
        GridFilter().run(model, sensor, [["north"], ["south"]], times)
    with pytest.raises(DataError, match=r"z holds no run: its shape is \(0, 2, 1\)"):
        GridFilter().run(model, sensor, np.zeros((0, 2, 1)), times)
    with pytest.raises(DataError, match="times must be finite: t0 is 0 s, row 1 has nan s"):
        GridFilter().run(model, sensor, z, [0.2, np.nan])
    with pytest.raises(
        DataError, match=r"row 0: measurement \[1000.\] of run 0 puts 100 % of the posterior on the edge"
    ):
        GridFilter().run(model, sensor, np.full((2, 1), 1e3), times)
    with pytest.raises(DataError, match="on the edge of the grid, which reaches from 10"):
        GridFilter(bounds=(10, 20)).run(model, sensor, z, times)
    with unchecked(), pytest.raises(ModelError, match="must be a SwitchingSDE or a HybridModel, got NoneType"):
        GridFilter().run(None, sensor, z, times)
    for cells in ("a", 60.0, (60, 60)):
        with unchecked(), pytest.raises(ModelError, match="cells must be whole numbers"):
            GridFilter(cells).run(model, sensor, z, times)
    with unchecked(), pytest.raises(ModelError, match=r"bounds must be \(low, high\), each of 1"):
        GridFilter(bounds=3.0).run(model, sensor, z, times)
    with pytest.raises(ModelError, match="needs a DiffusionSensor, got str"):
        GridFilter().run(model, "radar", z, times)
    three = SwitchingSDE(drift=[lambda y: -y], diffusion=[1.0], intensity={}, mean0=np.zeros(3), cov0=np.eye(3))
    with pytest.raises(ModelError, match="1 or 2 dimensions, not 3"):
        GridFilter().run(three, DiffusionSensor(h=[lambda y: y[..., :1]], R=[1.0]), z, times)
    tilted = SwitchingSDE(
        drift=[lambda y: -y], diffusion=[[[1.0, 0.0], [0.5, 1.0]]], intensity={}, mean0=np.zeros(2), cov0=np.eye(2)
    )
    with pytest.raises(ModelError, match="uncorrelated noises"):
        GridFilter().run(tilted, DiffusionSensor(h=[lambda y: y[..., :1]], R=[1.0]), z, times)
    runaway = SwitchingSDE(drift=[lambda y: 5 * y], diffusion=[1.0], intensity={})
    with pytest.raises(NumericalError, match="leaves every grid"):
        GridFilter().run(runaway, DiffusionSensor(h=[lambda y: y], R=[1.0]), z, [0.5, 4.0])
