"""Honest covariances and calibrated probabilities in matched simulations; and a wrong model that is caught."""

import numpy as np
import pytest
from scipy.stats import chi2, norm

from oracles import error
from saltus.filters import imm_filter

DT = 1.0
F = np.array([[1.0, DT], [0.0, 1.0]])
G = np.array([DT**2 / 2, DT])
H = np.array([[1.0, 0.0]])
R = np.array([[1.0]])
COV0 = np.diag([4.0, 1.0])
FALSE_ALARM = 1e-4


def nees(mean, cov, truth):
    e = truth - mean
    return np.einsum("...i,...ij,...j->...", e, np.linalg.inv(cov), e)


def simulate(rng, n_runs, n_steps, accel, trans, probs0):
    """Draw states, modes and measurements from the model itself; acceleration constant within an interval."""
    modes = np.empty((n_runs, n_steps), int)
    mode = (rng.random(n_runs)[:, None] > np.cumsum(probs0)).sum(-1)
    x = rng.normal(size=(n_runs, 2)) * np.sqrt(np.diag(COV0))
    states = np.empty((n_runs, n_steps, 2))
    for k in range(n_steps):
        mode = (rng.random(n_runs)[:, None] > np.cumsum(trans, axis=1)[mode]).sum(-1)
        x = x @ F.T + (np.asarray(accel)[mode] * rng.normal(size=n_runs))[:, None] * G
        states[:, k], modes[:, k] = x, mode
    return states, modes, states[..., :1] + rng.normal(size=(n_runs, n_steps, 1))


def filter_cv(z, Q, trans, probs0):
    ones = (1,) * len(trans)
    return imm_filter(
        z,
        F=F.reshape(*ones, 2, 2),
        Q=Q,
        H=H.reshape(*ones, 1, 2),
        R=R.reshape(*ones, 1, 1),
        trans=trans,
        mean0=np.zeros(2),
        cov0=COV0,
        probs0=probs0,
    )


def expected_nees(Q, Q_assumed, n_steps):
    """E[e' P^-1 e] at the last row of a Kalman filter that assumes the wrong Q: its own gains, the true spread."""
    P, true = COV0, COV0
    for _ in range(n_steps):
        P, true = F @ P @ F.T + Q_assumed, F @ true @ F.T + Q
        K = P @ H.T / (H @ P @ H.T + R)
        J = np.eye(2) - K @ H
        P, true = J @ P, J @ true @ J.T + K @ R @ K.T
    return np.trace(np.linalg.solve(P, true))


def test_nees_of_a_kalman_filter_is_chi_square_and_a_doubled_q_is_not(rng):
    accel, n_steps = 0.7, 15
    Q = accel**2 * np.outer(G, G)
    wrong = expected_nees(Q, 2 * Q, n_steps)
    # Mean NEES of N runs has standard deviation sqrt(2 n / N), n = 2. The doubled Q shows when its shift exceeds
    # the half-width of the interval by five of them.
    half_width = norm.isf(FALSE_ALARM / 2)
    n_runs = int(np.ceil(4.0 * ((half_width + 5.0) / (2.0 - wrong)) ** 2))
    assert 100 < n_runs < 20_000
    states, _, z = simulate(rng, n_runs, n_steps, [accel], np.eye(1), [1.0])
    low, high = chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], 2 * n_runs)
    right = filter_cv(z, Q, [], 1.0)
    assert low < nees(right.mean[:, -1], right.cov[:, -1], states[:, -1]).sum() < high
    doubled = filter_cv(z, 2 * Q, [], 1.0)
    assert nees(doubled.mean[:, -1], doubled.cov[:, -1], states[:, -1]).sum() < low


def test_innovations_of_a_kalman_filter_are_chi_square_and_a_doubled_q_s_are_not(rng):
    accel, n_runs, n_steps = 0.7, 200, 40
    Q = accel**2 * np.outer(G, G)
    _, _, z = simulate(rng, n_runs, n_steps, [accel], np.eye(1), [1.0])
    z[rng.random(z.shape) < 0.2] = np.nan
    low, high = chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], (~np.isnan(z)).sum())
    right, doubled = filter_cv(z, Q, [], 1.0), filter_cv(z, 2 * Q, [], 1.0)
    assert right.n_observed.sum() == (~np.isnan(z)).sum()
    assert low < right.nis.sum() < high
    assert doubled.nis.sum() < low
    # The likelihood knows the right model too: Wald's inequality, P(LR > 1 / alpha) <= alpha under the truth.
    assert (right.log_likelihood - doubled.log_likelihood).sum() > np.log(1 / FALSE_ALARM)


@pytest.fixture(scope="module")
def switching():
    """A thousand runs of a target that manoeuvres one scan in four, filtered by its own model and by a wrong one."""
    # A thousand runs: the doubled Q then moves the mean NEES by about 13 standard errors and the mean mode
    # probability by about 8 (averages over seeds), against a bound of five.
    accel, trans, probs0 = np.array([0.2, 3.0]), np.array([[0.9, 0.1], [0.3, 0.7]]), np.array([0.75, 0.25])
    states, modes, z = simulate(np.random.default_rng(7), 1000, 25, accel, trans, probs0)
    Q = accel[:, None, None] ** 2 * np.outer(G, G)
    return states, modes, filter_cv(z, Q, [trans], probs0), filter_cv(z, 2 * Q, [trans], probs0)


def five_errors(sample):
    """Mean and five standard errors of independent runs."""
    return sample.mean(), 5.0 * sample.std(ddof=1) / np.sqrt(len(sample))


def test_nees_of_a_switching_filter_and_of_one_with_doubled_q(switching):
    # E[e' P^-1 e] = n for any posterior mean and covariance, Gaussian or not.
    states, _, right, doubled = switching
    mean, bound = five_errors(nees(right.mean, right.cov, states).mean(-1))
    assert abs(mean - 2.0) < bound
    mean, bound = five_errors(nees(doubled.mean, doubled.cov, states).mean(-1))
    assert abs(mean - 2.0) > bound


def test_mode_probabilities_are_calibrated(switching):
    # E[1{true = j} - P_j] = 0 within any set of rows chosen by P_j.
    _, modes, right, doubled = switching
    manoeuvre = right.probs[..., 1]
    gap = (modes == 1) - manoeuvre
    for low, high in ((0.0, 1.0), (0.0, 0.2), (0.2, 0.5), (0.5, 1.0)):
        inside = (manoeuvre >= low) & (manoeuvre <= high)
        mean, bound = five_errors((gap * inside).mean(-1))
        assert abs(mean) < bound, (low, high)
    mean, bound = five_errors(((modes == 1) - doubled.probs[..., 1]).mean(-1))
    assert abs(mean) > bound


def test_likelihood_prefers_the_model_that_made_the_data(switching):
    _, _, right, doubled = switching
    assert (right.log_likelihood - doubled.log_likelihood).sum() > np.log(1 / FALSE_ALARM)


def test_frozen_chain_finds_the_mode_by_bayes_rule(rng):
    # No switching: the filter is exact, so log-odds follow from the likelihoods of two Kalman filters.
    accel, probs0 = np.array([0.2, 1.0]), np.array([0.5, 0.5])
    _, modes, z = simulate(rng, 200, 30, accel, np.eye(2), probs0)
    Q = accel[:, None, None] ** 2 * np.outer(G, G)
    est = filter_cv(z, Q, [np.eye(2)], probs0)
    alone = [filter_cv(z, q, [], 1.0).log_likelihood.sum(-1) for q in Q]
    assert error(est.probs[:, -1, 1], 1 / (1 + np.exp(alone[0] - alone[1]))) < 1e-10
    mean, bound = five_errors((modes[:, -1] == 1) - est.probs[:, -1, 1])
    assert abs(mean) < bound
