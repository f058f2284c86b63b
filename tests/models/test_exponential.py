import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm, solve_continuous_lyapunov

from saltus.errors import ModelError, NumericalError
from saltus.models import discretise, exponential

matrices = st.integers(1, 4).flatmap(lambda n: arrays(np.float64, (n, n), elements=st.floats(-3, 3)))


@given(matrices)
@settings(deadline=None)
def test_exponential_agrees_with_pade(A):
    expected = expm(A)
    # The looser side is the oracle: on 2 * ones((4, 4)), known in closed form below, it is off by 1e-12.
    np.testing.assert_allclose(exponential(A), expected, rtol=0, atol=1e-10 * np.abs(expected).max())


def test_exponential_of_a_rank_one_matrix_in_closed_form():
    # (c J)^2 = 4 c^2 J for J = ones((4, 4)): exp(c J) = I + expm1(4 c) / 4 J
    for c in (-2.0, 1e-9, 2.0):
        expected = np.eye(4) + np.expm1(4 * c) / 4
        np.testing.assert_allclose(exponential(np.full((4, 4), c)), expected, rtol=1e-14, atol=1e-16)


def test_exponential_survives_stiffness():
    # Eigenvalues -1e8 and -1: the slow one keeps its digits through 29 doublings.
    A = np.array([[-1e8, 0.0], [0.0, -1.0]])
    np.testing.assert_allclose(exponential(A), np.diag([0.0, np.exp(-1.0)]), rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("i", range(6))
def test_discretise_reference(cases, i):
    case = cases("discretisation")
    Phi, Q = discretise(case[f"F{i}"], case[f"G{i}"], case["dt"][i])
    for got, expected in ((Phi, case[f"Phi{i}"]), (Q, case[f"B{i}"])):
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def test_stiff_coupled_pair_against_lyapunov():
    # Source of the numbers: the stationary part minus what is left of it, computed without integrating.
    F, G = np.array([[-50.0, 0.0], [1.0, -0.01]]), np.eye(2)
    _, Q = discretise(F, G, 1.0)
    stationary = solve_continuous_lyapunov(F, -G @ G.T)
    np.testing.assert_allclose(Q, stationary - expm(F) @ stationary @ expm(F).T, rtol=1e-9)
    assert Q[0, 1] == pytest.approx(1.9996e-4, rel=1e-4)  # plain Van Loan returns 384
    assert Q[1, 1] == pytest.approx(0.990450518, rel=1e-9)


@given(matrices, st.floats(1e-3, 2.0), st.integers(0, 2**32 - 1))
@settings(deadline=None)
def test_covariance_solves_its_differential_equation(F, dt, seed):
    n = len(F)
    G = np.random.default_rng(seed).normal(size=(n, 2))
    Phi, Q = discretise(F, G, dt)
    N = G @ G.T
    left = F @ Q + Q @ F.T + N  # = dQ/dt = Phi N Phi'
    scale = np.abs(left).max() + np.abs(F).max() * np.abs(Q).max() + np.abs(N).max()
    np.testing.assert_allclose(left, Phi @ N @ Phi.T, rtol=0, atol=1e-10 * scale)
    np.testing.assert_array_equal(Q, Q.T)
    assert np.linalg.eigvalsh(Q).min() >= -1e-13 * np.abs(Q).max()


@given(matrices, st.floats(0, 1.0), st.floats(0, 1.0))
@settings(deadline=None)
def test_two_intervals_are_one(F, a, b):
    G = np.eye(len(F))
    (Fa, Qa), (Fb, Qb), (Fab, Qab) = (discretise(F, G, dt) for dt in (a, b, a + b))
    size = np.abs(Fb).max()  # round-off is relative to the factors, which may cancel in the product
    np.testing.assert_allclose(Fab, Fb @ Fa, rtol=0, atol=1e-11 * size * np.abs(Fa).max())
    scale = size**2 * np.abs(Qa).max() + np.abs(Qb).max()
    np.testing.assert_allclose(Qab, Fb @ Qa @ Fb.T + Qb, rtol=0, atol=1e-11 * scale)


def test_broadcasts_over_leading_axes_and_intervals(rng):
    F, G, dt = rng.normal(size=(3, 2, 2)), rng.normal(size=(2, 1)), np.array([0.0, 0.3, 40.0, 1.0])
    F -= 3 * np.eye(2)
    Phi, Q = discretise(F, G, dt[:, None])
    assert Phi.shape == Q.shape == (4, 3, 2, 2)
    for t in range(4):
        for i in range(3):
            one = discretise(F[i], G, dt[t])
            np.testing.assert_allclose(Phi[t, i], one[0], atol=1e-14)
            np.testing.assert_allclose(Q[t, i], one[1], atol=1e-13)
    np.testing.assert_array_equal(Phi[0], np.broadcast_to(np.eye(2), (3, 2, 2)))
    assert not Q[0].any()


@pytest.mark.parametrize("a", [1.0, 5.0])
def test_numbers_of_the_frozen_range_example(a):
    chi, alpha_w, psi, chi_j, alpha_j, sigma_w, sigma_j = 0.16, 0.015, 2.5e-5, 0.1, 0.2, 0.1, 30.0
    F = np.zeros((5, 5))
    F[0, 1] = F[2, 3] = F[3, 4] = 1.0
    F[1] = [-(chi**2), -2 * alpha_w, 0.0, 0.0, -psi]
    F[4, 3:] = [-(chi_j**2), -2 * alpha_j]
    G = np.zeros((5, 2))
    G[1, 0] = np.sqrt(4 * alpha_w * chi**2 * sigma_w**2)
    G[4, 1] = np.sqrt(8 * a * chi_j**3 * sigma_j**2)
    Phi, Q = discretise(F, G, 1.0)
    upper = [(0, 0), (0, 1), (1, 0), (1, 1), (2, 3), (2, 4), (3, 3), (3, 4), (4, 3), (4, 4), (1, 4)]
    values = [0.987354, 0.980951, -0.0251123, 0.957925, 0.998488, 0.439144, 0.995609, 0.822831, -0.00822831]
    values += [0.666476, -2.015e-5]
    np.testing.assert_allclose([Phi[i] for i in upper], values, rtol=3e-4, atol=5e-7)
    places = [(0, 0), (1, 1), (2, 2), (2, 3), (3, 3), (3, 4), (4, 4)]
    noise = np.array([4.98e-6, 1.478e-5, 0.289927, 0.694252, 1.793789, 2.437380, 4.941349])
    noise[2:] *= a  # the first two entries come from the angle's own noise
    np.testing.assert_allclose([Q[i] for i in places], noise, rtol=1e-3)


@pytest.mark.parametrize(
    "F, G, dt, message",
    [
        (np.eye(2)[:1], np.eye(2), 1.0, "F must be a square matrix"),
        (np.eye(2), np.eye(3), 1.0, "G must have shape"),
        (np.eye(2), np.ones(2), 1.0, "G must have shape"),
        (np.eye(2), np.eye(2), -1.0, "must not be negative, got -1 s"),
        (np.eye(2), np.eye(2), np.nan, "dt holds nan"),
        (np.full((2, 2), np.inf), np.eye(2), 1.0, "F holds inf at index"),
        (np.zeros((3, 2, 2)), np.eye(2), np.ones(4), "leading axes do not broadcast"),
        ("F", np.eye(2), 1.0, "F must be real numbers"),
        ([[1.0, 2.0], [3.0]], np.eye(2), 1.0, "rows differ in length"),
    ],
)
def test_bad_input(F, G, dt, message):
    with pytest.raises(ModelError, match=message):
        discretise(F, G, dt)


def test_overflow_is_an_error():
    with pytest.raises(NumericalError, match="overflows"):
        discretise(np.eye(2) * 1e4, np.eye(2), 1.0)
