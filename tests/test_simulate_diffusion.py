"""Draws of switching diffusions against their closed-form laws; bounds are five standard errors."""

import numpy as np
import pytest

from diffusions import case
from saltus import DiffusionSensor, ModelError, SwitchingSDE
from saltus.simulate import simulate_diffusion


def test_state_and_mode_reach_the_law_of_the_model(rng):
    model = SwitchingSDE(
        drift=[lambda y: 1.0 - y, lambda y: -2.0 * y],
        diffusion=[0.4, 1.0],
        intensity={(0, 1): 0.5, (1, 0): 1.5},
        probs0=[1.0, 0.0],
    )
    sensor = DiffusionSensor(h=[lambda y: y, lambda y: 3 * y], R=[0.01, 1.0])
    draws = simulate_diffusion(model, sensor, [0.3, 1.1], rng=rng, batch=4000, substeps=100)
    second = 0.25 * -np.expm1(-2.0 * np.array([0.3, 1.1]))
    # Euler steps of 0.008 s bias the probability by less than a hundredth of it.
    assert (np.abs((draws.modes == 1).mean(0) - second) < 5 * np.sqrt(second / 4000) + 0.01 * second).all()
    # Mean over both modes from the linear moment equations u0', u1' of section 2.
    u = np.array([1.0, 0.0, 0.0, 0.0])  # P0, P1, P0 M0, P1 M1
    A = np.array([[-0.5, 1.5, 0, 0], [0.5, -1.5, 0, 0], [1, 0, -1.5, 1.5], [0, 0, 0.5, -3.5]])
    from scipy.linalg import expm

    want = (expm(1.1 * A) @ u)[2:].sum()
    assert abs(draws.states[:, 1, 0].mean() - want) < 5 * draws.states[:, 1, 0].std() / np.sqrt(4000) + 0.01 * abs(want)
    scale = np.where(draws.modes == 1, 3.0, 1.0)
    white = (draws.z[..., 0] - scale * draws.states[..., 0]) / np.where(draws.modes == 1, 1.0, 0.1)
    assert abs(white.mean()) < 5 / np.sqrt(white.size) and abs(white.var() - 1) < 5 * np.sqrt(2 / white.size)


def test_a_restored_state_is_drawn_from_its_law(rng):
    model = SwitchingSDE(
        drift=[[0.0, 0.0]] * 2,
        diffusion=[1e-9, 1e-9],
        intensity={(0, 1): 2.0},
        restore={(0, 1): ([5.0, -5.0], [[1.0, 0.6], [0.6, 2.0]])},
        probs0=[1.0, 0.0],
        mean0=[0.0, 0.0],
        cov0=np.zeros((2, 2)),
    )
    sensor = DiffusionSensor(h=[lambda y: y] * 2, R=[np.eye(2)] * 2)
    draws = simulate_diffusion(model, sensor, [1.0], rng=rng, batch=3000)
    gone = draws.modes[:, 0] == 1
    assert np.abs(draws.states[~gone]).max() < 1e-6
    x = draws.states[gone, 0]
    assert (np.abs(x.mean(0) - [5.0, -5.0]) < 5 * np.sqrt(np.array([1.0, 2.0]) / gone.sum())).all()
    assert np.abs(np.cov(x.T) - [[1.0, 0.6], [0.6, 2.0]]).max() < 5 * 2 * np.sqrt(2 / gone.sum())


def test_increments_add_up_the_signal(rng):
    model = SwitchingSDE(drift=[[0.0]], diffusion=[1e-9], intensity={}, mean0=[2.0], cov0=[[0.0]])
    sensor = DiffusionSensor(h=[lambda y: y], R=[0.5], continuous=True)
    z = simulate_diffusion(model, sensor, [0.25, 0.5], rng=rng, batch=2000).z
    assert (np.abs(z.mean(0)[:, 0] - 0.5) < 5 * np.sqrt(0.125 / 2000)).all()
    assert (np.abs(z.var(0)[:, 0] - 0.125) < 5 * 0.125 * np.sqrt(2 / 2000)).all()


def test_a_run_depends_on_its_own_generator_alone():
    model, sensor = case("c")
    few = simulate_diffusion(model, sensor, [0.25, 0.5], rng=[np.random.default_rng(s) for s in (1, 2)])
    one = simulate_diffusion(model, sensor, [0.25, 0.5], rng=[np.random.default_rng(2)])
    for a, b in zip(few, one, strict=True):
        np.testing.assert_array_equal(a[1:], b)
    assert few.z.shape == (2, 2, 2) and np.abs(few.z[..., 1]).max() <= np.pi


def test_times_must_increase(rng):
    with pytest.raises(ModelError, match="increase from t0"):
        simulate_diffusion(*case("b"), [0.5, 0.2], rng=rng)
