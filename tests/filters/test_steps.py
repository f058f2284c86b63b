"""Each step of the recursion against its definition."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from oracles import error, is_psd, mix_all_pairs
from saltus.errors import NumericalError
from saltus.filters import steps
from strategies import law, quick, random_cov, random_trans, rngs

ROUND_OFF = 1e-11


def random_belief(rng, lead, sizes, n):
    probs = law(rng, lead, int(np.prod(sizes))).reshape(*lead, *sizes)
    return np.log(probs), rng.normal(size=(*lead, *sizes, n)), random_cov(rng, (*lead, *sizes), n)


@quick
@given(rngs(), st.lists(st.integers(1, 4), min_size=1, max_size=3), st.integers(1, 3))
def test_staged_mixing_equals_the_sum_over_all_pairs_of_joint_modes(rng, sizes, n):
    log_probs, means, covs = random_belief(rng, (), sizes, n)
    trans = [random_trans(rng, s) for s in sizes]
    flat = np.eye(1)
    for t in trans:
        flat = np.kron(flat, t)
    M = int(np.prod(sizes))
    expected = mix_all_pairs(np.exp(log_probs).ravel(), means.reshape(M, n), covs.reshape(M, n, n), flat)
    mixed = steps.mix(log_probs, means, covs, trans)
    assert error(np.exp(mixed.log_probs).ravel(), expected[0]) < ROUND_OFF
    assert error(mixed.means.reshape(M, n), expected[1]) < ROUND_OFF
    assert error(mixed.covs.reshape(M, n, n), expected[2]) < ROUND_OFF
    assert is_psd(mixed.covs)


def test_mixing_takes_a_matrix_per_run_and_skips_frozen_chains(rng):
    log_probs, means, covs = random_belief(rng, (5, 2), (2, 3), 2)
    trans = random_trans(rng, 3, (5, 2))
    mixed = steps.mix(log_probs, means, covs, [None, trans])
    for run in np.ndindex(5, 2):
        alone = steps.mix(log_probs[run], means[run], covs[run], [np.eye(2), trans[run]])
        for got, expected in zip(mixed, alone, strict=True):
            assert error(got[run], expected) < ROUND_OFF


def test_mixing_keeps_digits_far_from_the_origin(rng):
    # Raw second moments would lose all digits: |x|^2 / var = 1e18.
    log_probs, means, covs = random_belief(rng, (), (3,), 2)
    t = random_trans(rng, 3)
    near, far = steps.mix(log_probs, means, covs, [t]), steps.mix(log_probs, means + 2.0**30, covs, [t])
    assert error(far.covs, near.covs) < 1e-6  # means of size 1e9 carry 1e-7 each
    assert is_psd(far.covs)


def test_unreachable_modes_have_probability_zero_and_finite_moments(rng):
    _, means, covs = random_belief(rng, (), (3,), 2)
    with np.errstate(divide="ignore"):
        log_probs = np.log([0.0, 1.0, 0.0])
    mixed = steps.mix(log_probs, means, covs, [np.array([[1.0, 0, 0], [0, 0.5, 0.5], [0, 0, 1.0]])])
    np.testing.assert_array_equal(np.exp(mixed.log_probs), [0.0, 0.5, 0.5])
    assert np.isfinite(mixed.means).all() and is_psd(mixed.covs)
    # Reachable from mode 1 alone: its moments, untouched.
    np.testing.assert_allclose(mixed.means[2], means[1], rtol=1e-15)
    np.testing.assert_allclose(mixed.covs[2], covs[1], rtol=1e-15)


def test_mixing_keeps_ratios_of_probabilities_beyond_the_range_of_floats(rng):
    _, means, covs = random_belief(rng, (), (2, 2), 2)
    log_probs = np.array([[-1e6, -1e6 + 1.0], [0.0, -1.0]])  # the first row underflows outside logs
    t = random_trans(rng, 2)
    mixed = steps.mix(log_probs, means, covs, [None, t])
    p = np.exp(log_probs[0] + 1e6)
    assert error(mixed.log_probs[0], np.log(p @ t) - 1e6) < 1e-15
    alone = steps.mix(log_probs[0] + 1e6, means[0], covs[0], [t])
    assert error(mixed.means[0], alone.means) < ROUND_OFF
    assert error(mixed.covs[0], alone.covs) < ROUND_OFF


def test_propagate(rng):
    x, P, A, b, Q = (
        rng.normal(size=3),
        random_cov(rng, (), 3),
        rng.normal(size=(4, 3, 3)),
        rng.normal(size=3),
        np.eye(3),
    )
    mean, cov = steps.propagate(x, P, A, b, Q)
    for j in range(4):
        assert error(mean[j], A[j] @ x + b) < ROUND_OFF
        assert error(cov[j], A[j] @ P @ A[j].T + Q) < ROUND_OFF
    assert error(steps.propagate(x, P, A, None, Q)[0], mean - b) < ROUND_OFF


def random_step(rng, n, m, lead=()):
    """A linear step with correlated noises, and a measurement."""
    A, C = rng.normal(size=(*lead, n, n)), rng.normal(size=(*lead, m, n))
    b, d = rng.normal(size=(*lead, n)), rng.normal(size=(*lead, m))
    return (rng.normal(size=(*lead, n)), random_cov(rng, lead, n), A, b, C, d, random_cov(rng, lead, n + m))


@quick
@given(rngs(), st.integers(1, 4), st.integers(1, 3))
def test_condition_is_gaussian_conditioning_of_the_stacked_vector(rng, n, m):
    mean, cov, A, b, C, d, N = arguments = random_step(rng, n, m)
    z, seen = rng.normal(size=m), rng.random(m) < 0.7
    T = np.vstack([A, C])
    joint_mean, joint_cov = T @ mean + np.concatenate([b, d]), T @ cov @ T.T + N
    on = n + np.flatnonzero(seen)
    S, U = joint_cov[np.ix_(on, on)], joint_cov[:n, on]
    nu = z[seen] - joint_mean[on]
    prediction = steps.joint(*arguments)
    assert error(prediction.mean, joint_mean[:n]) < ROUND_OFF
    assert error(prediction.y, joint_mean[n:]) < ROUND_OFF
    assert error(prediction.U, joint_cov[:n, n:]) < ROUND_OFF
    assert error(prediction.S, joint_cov[n:, n:]) < ROUND_OFF
    done = steps.condition(prediction, np.where(seen, z, 1e6), seen)
    tolerance = ROUND_OFF * np.linalg.cond(joint_cov)
    assert error(done.mean, joint_mean[:n] + U @ np.linalg.solve(S, nu)) < tolerance
    assert error(done.cov, joint_cov[:n, :n] - U @ np.linalg.solve(S, U.T)) < tolerance
    expected = multivariate_normal.logpdf(z[seen], joint_mean[on], S) if seen.any() else 0.0
    assert abs(done.loglik - expected) < tolerance * (1 + abs(expected))
    assert abs(done.d2 - nu @ np.linalg.solve(S, nu)) < tolerance * (1 + abs(expected))
    assert is_psd(done.cov)


def test_component_not_seen_changes_nothing_whatever_its_value(rng):
    prediction = steps.joint(*random_step(rng, 3, 2))
    z, seen = rng.normal(size=2), np.array([True, False])
    first, second = steps.condition(prediction, z, seen), steps.condition(prediction, z + np.array([0.0, 1e9]), seen)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
    nothing = steps.condition(prediction, z, np.zeros(2, bool))
    assert nothing.loglik == 0.0 and nothing.d2 == 0.0
    np.testing.assert_array_equal(nothing.mean, prediction.mean)


def test_measurement_without_noise_or_uncertainty_is_a_numerical_error():
    prediction = steps.measure(np.zeros(2), np.zeros((2, 2)), np.eye(2), None, np.zeros((2, 2)))
    with pytest.raises(NumericalError, match=r"not positive definite.*positive variance in R"):
        steps.condition(prediction, np.zeros(2), np.ones(2, bool))


def test_exact_measurement_of_an_uncertain_component_is_allowed():
    prediction = steps.measure(np.zeros(2), np.eye(2), np.array([[1.0, 0.0]]), None, np.zeros((1, 1)))
    done = steps.condition(prediction, np.array([3.0]), np.array([True]))
    np.testing.assert_array_equal(done.mean, [3.0, 0.0])
    np.testing.assert_array_equal(done.cov, [[0.0, 0.0], [0.0, 1.0]])


def test_reweigh_is_bayes_rule_beyond_the_range_of_floats(rng):
    prior, loglik = law(rng, (2,), 6).reshape(2, 2, 3), rng.normal(size=(2, 2, 3))
    posterior = prior * np.exp(loglik)
    evidence = posterior.sum((-1, -2))
    log_probs, log_f = steps.reweigh(np.log(prior), loglik - 1e8, 2)
    # Adding 1e8 costs eight of sixteen digits of the logs.
    assert np.abs(np.exp(log_probs) - posterior / evidence[:, None, None]).max() < 1e-7
    assert error(log_f, np.log(evidence) - 1e8) < 1e-15
    assert np.abs(np.exp(log_probs).sum((-1, -2)) - 1.0).max() < 1e-7


def test_reweigh_leaves_impossible_modes_impossible():
    with np.errstate(divide="ignore"):
        log_probs, log_f = steps.reweigh(np.log([0.0, 1.0]), np.array([50.0, -3.0]), 1)
    assert log_probs.tolist() == [-np.inf, 0.0] and log_f == -3.0


def test_collapse_has_the_mixture_s_moments(rng):
    log_probs, means, covs = random_belief(rng, (4,), (2, 3), 2)
    p = np.exp(log_probs)
    mean, cov = steps.collapse(log_probs, means, covs, 2)
    expected = np.einsum("bij,bijn->bn", p, means)
    second = np.einsum("bij,bijnm->bnm", p, covs + means[..., :, None] * means[..., None, :])
    assert error(mean, expected) < ROUND_OFF
    assert error(cov, second - expected[:, :, None] * expected[:, None, :]) < ROUND_OFF
    assert is_psd(cov)


def test_collapse_of_no_runs_at_all():
    mean, cov = steps.collapse(np.zeros((0, 2)), np.zeros((0, 2, 3)), np.zeros((0, 2, 3, 3)), 1)
    assert mean.shape == (0, 3) and cov.shape == (0, 3, 3)


def test_distance_to_the_mixture_s_measurement(rng):
    log_probs, means, covs = random_belief(rng, (), (2, 2), 3)
    H, d, R = rng.normal(size=(2, 1, 2, 3)), rng.normal(size=2), random_cov(rng, (1, 2), 2)
    prediction = steps.measure(means, covs, H, d, R)
    z = rng.normal(size=2)
    p = np.exp(log_probs).ravel()
    y = prediction.y.reshape(4, 2)
    centre = p @ y
    S = np.einsum("i,ijk->jk", p, prediction.S.reshape(4, 2, 2)) + (p[:, None] * (y - centre)).T @ (y - centre)
    for seen in ([True, True], [True, False], [False, True]):
        on = np.flatnonzero(seen)
        nu = (z - centre)[on]
        expected = nu @ np.linalg.inv(S[np.ix_(on, on)]) @ nu
        got = steps.mixture_nis(log_probs, prediction, np.where(seen, z, 7.0), np.array(seen), 2)
        assert abs(got - expected) < ROUND_OFF * (1 + expected)
