import pickle

import numpy as np
import pytest

from saltus.errors import ModelError
from saltus.models import Chain, LinearSDE, LinearTransition, discretise

MODE = Chain("mode", {"slow": 0.1, "fast": 10.0}, stay=0.9)
DT = np.array([0.0, 0.5, 300.0])


def test_drift_is_integrated():
    # dx = (u - a x) dt + dW: b = u (1 - exp(-a dt)) / a, Q = (1 - exp(-2 a dt)) / (2 a)
    a, u = 0.3, 4.0
    step = LinearSDE(F=[[-a]], G=[[1.0]], drift=[u]).step(DT)
    np.testing.assert_allclose(step.b[:, 0], -u * np.expm1(-a * DT) / a, rtol=1e-12)
    np.testing.assert_allclose(step.Q[:, 0, 0], -np.expm1(-2 * a * DT) / (2 * a), rtol=1e-12)
    np.testing.assert_allclose(step.F[:, 0, 0], np.exp(-a * DT), rtol=1e-12, atol=1e-15)


def test_matrices_and_drift_depend_on_chains():
    sde = LinearSDE(F=lambda mode: [[0.0, 1.0], [0.0, -mode]], G=[[0.0], [1.0]], drift=lambda mode: [0.0, mode])
    step = sde.bind([MODE]).step(DT)
    assert step.F.shape == step.Q.shape == (3, 2, 2, 2) and step.b.shape == (3, 2, 2)
    for i, rate in enumerate(MODE.values):
        Phi, Q = discretise([[0.0, 1.0], [0.0, -rate]], [[0.0], [1.0]], DT)
        np.testing.assert_allclose(step.F[:, i], Phi, rtol=1e-11, atol=1e-13)
        np.testing.assert_allclose(step.Q[:, i], Q, rtol=1e-11)
        np.testing.assert_allclose(step.b[:, i, 1], -np.expm1(-rate * DT), rtol=1e-11)


def test_noise_alone_depends_on_chains():
    step = LinearSDE(F=np.zeros((1, 1)), G=lambda mode: [[mode]]).bind([MODE]).step(np.asarray(2.0))
    assert step.F.shape == (1, 1, 1) or step.F.shape == (2, 1, 1)
    np.testing.assert_allclose(step.Q[:, 0, 0], [0.02, 200.0])


def test_constant_transition_is_per_step():
    step = LinearTransition(F=[[1.0, 1.0], [0.0, 1.0]], Q=np.eye(2), b=[1.0, 2.0]).step(np.array([0.0, 4.0, 4.0]))
    np.testing.assert_array_equal(step.F[0], np.eye(2))
    np.testing.assert_array_equal(step.F[2], [[1, 1], [0, 1]])
    assert not step.Q[0].any() and not step.b[0].any()
    np.testing.assert_array_equal(step.b[1], [1.0, 2.0])
    with pytest.raises(ModelError, match=r"equal intervals, but they range from 1 to 4 s.\nDescribe .* LinearSDE"):
        LinearTransition(F=np.eye(2), Q=np.eye(2)).step(np.array([1.0, 4.0]))


def test_transition_may_ask_for_dt_and_t():
    walk = LinearTransition(
        F=lambda dt: [[1.0, dt], [0.0, 1.0]],
        Q=lambda t, dt, mode: mode * dt * t * np.eye(2),
    ).bind([MODE])
    assert walk.dimension() == 2
    step = walk.step(np.array([0.0, 0.5, 2.0]), np.array([1.0, 1.5, 3.5]))
    assert step.F.shape == (3, 1, 2, 2) and step.Q.shape == (3, 2, 2, 2)
    np.testing.assert_allclose(step.F[:, 0, 0, 1], [0.0, 0.5, 2.0])
    np.testing.assert_allclose(step.Q[:, 1, 0, 0], [0.0, 7.5, 70.0])


def test_compares_and_pickles():
    sde = LinearSDE(F=lambda mode: [[-mode]], G=[[1.0]]).bind([MODE])
    assert pickle.loads(pickle.dumps(sde)) == sde == LinearSDE(F=[[[-0.1]], [[-10.0]]], G=[[[1.0]]])
    assert sde != LinearSDE(F=[[[-0.1]], [[-10.0]]], G=[[[2.0]]])


@pytest.mark.parametrize(
    "build, message",
    [
        (lambda: LinearSDE(F=np.ones((2, 3)), G=np.eye(2)), r"F must be a square matrix \(n, n\), got shape \(2, 3\)"),
        (lambda: LinearSDE(F=np.eye(2), G=np.eye(3)), r"G must have shape \(2, q\) to go with F, got \(3, 3\)"),
        (lambda: LinearSDE(F=np.eye(2), G=np.ones(2)), r"G must have shape \(2, q\)"),
        (lambda: LinearSDE(F=np.eye(2), G=np.eye(2), drift=[1.0]), r"drift must have shape \(2,\)"),
        (lambda: LinearSDE(F=[[np.nan]], G=[[1.0]]), "F holds nan"),
        (lambda: LinearSDE(F=lambda dt: [[dt]], G=[[1.0]]).bind([]), "asks for 'dt', but here"),
        (lambda: LinearSDE(F=lambda mode: [[mode]], G=[[1.0]]).step(DT), "put it into a HybridModel"),
        (lambda: LinearTransition(F=np.eye(2), Q=np.eye(3)), r"Q must have shape \(2, 2\)"),
        (lambda: LinearTransition(F=np.eye(2), Q=-np.eye(2)), "positive semi-definite: its smallest eigenvalue is -1"),
        (lambda: LinearTransition(F=np.eye(2), Q=np.eye(2), b=1.0), r"b must have shape \(2,\)"),
        (lambda: LinearTransition(F=np.ones((2, 3)), Q=np.eye(2)), "F must be a square matrix"),
    ],
)
def test_bad_dynamics(build, message):
    with pytest.raises(ModelError, match=message):
        build()


def test_covariance_of_a_function_is_checked():
    shrinking = LinearTransition(F=np.eye(1), Q=lambda dt: [[1.0 - dt]]).bind([])
    with pytest.raises(ModelError, match="LinearTransition Q must be positive semi-definite"):
        shrinking.step(np.array([0.5, 2.0]))
