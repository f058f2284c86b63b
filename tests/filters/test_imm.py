"""The batch filter against slow answers, and the mistakes other IMM filters are known for."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from oracles import dense_kalman, enumerate_modes, error, flat_model, textbook_imm
from saltus.filters import imm_filter
from strategies import law, problems, quick, random_cov, random_problem, random_trans, rngs

BACKENDS = ["numpy", None]  # the definition, and what the package chooses by itself
ROUND_OFF = 1e-9  # the oracles subtract (R - K S K') and invert; condition numbers reach 1e4


def compare(est, run, oracle):
    """One run of the estimates with a flat oracle's."""
    n_steps = est.mean.shape[-2]
    assert error(est.probs[run].reshape(n_steps, -1), oracle.probs) < ROUND_OFF
    assert error(est.mean[run], oracle.mean) < ROUND_OFF
    assert error(est.cov[run], oracle.cov) < ROUND_OFF
    np.testing.assert_allclose(est.log_likelihood[run], oracle.log_likelihood, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("backend", BACKENDS)
@quick
@given(p=problems())
def test_every_shape_of_argument_against_the_textbook_cycle_on_the_flat_chain(p, backend):
    est = imm_filter(**p, per_mode=True, backend=backend)
    batch = p["z"].shape[:-2]
    for run in np.ndindex(batch):
        f = flat_model(p, run)
        oracle = textbook_imm(f)
        compare(est, run, oracle)
        n_steps, n_modes, n = oracle.mode_means.shape
        assert error(est.mode_means[run].reshape(n_steps, n_modes, n), oracle.mode_means) < ROUND_OFF
        assert error(est.mode_covs[run].reshape(n_steps, n_modes, n, n), oracle.mode_covs) < ROUND_OFF
        np.testing.assert_allclose(est.nis[run], oracle.nis, rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(est.n_observed[run], (~np.isnan(f.z)).sum(-1))
    assert (est.log_likelihood_start == np.zeros(batch)).all()


@quick
@given(problems())
def test_last_row_alone_with_every_log_likelihood(p):
    every, last = imm_filter(**p, per_mode=True), imm_filter(**p, per_mode=True, keep="last")
    n_batch = p["z"].ndim - 2
    np.testing.assert_array_equal(last.log_likelihood, every.log_likelihood)
    for name in ("probs", "mean", "cov", "nis", "n_observed", "mode_means", "mode_covs"):
        expected = np.take(getattr(every, name), [-1], axis=n_batch)
        np.testing.assert_array_equal(getattr(last, name), expected, err_msg=name)
    assert imm_filter(**p, keep="last").mode_means is None


@quick
@given(rngs(), st.integers(1, 4), st.integers(1, 3), st.lists(st.integers(1, 3), max_size=2))
def test_without_chains_it_is_gaussian_conditioning_on_all_that_was_seen(rng, n, m, batch):
    p = random_problem(rng, (), n=n, m=m, n_steps=6, batch=tuple(batch), missing=0.4)
    est = imm_filter(**p)
    assert est.probs.shape == (*batch, 6) and (est.probs == 1.0).all()
    for run in np.ndindex(*batch):
        f = flat_model(p, run)
        mean, cov, total = dense_kalman(*(a if i == 0 else a[:, 0] for i, a in enumerate(f[:7])), f.mean0[0], f.cov0[0])
        assert error(est.mean[run], mean) < ROUND_OFF
        assert error(est.cov[run], cov) < ROUND_OFF
        np.testing.assert_allclose(est.log_likelihood[run].cumsum(), total, rtol=1e-9, atol=1e-9)


@quick
@given(rngs(), st.lists(st.integers(1, 3), min_size=1, max_size=2))
def test_exact_at_the_first_row_from_a_common_prior(rng, sizes):
    p = random_problem(rng, tuple(sizes), n=2, m=2, n_steps=1, missing=0.1)
    p |= {"mean0": rng.normal(size=2), "cov0": random_cov(rng, (), 2)}
    compare(imm_filter(**p), (), enumerate_modes(flat_model(p)))


@quick
@given(rngs(), st.lists(st.integers(1, 2), min_size=1, max_size=2))
def test_exact_at_every_row_when_no_chain_switches(rng, sizes):
    p = random_problem(rng, tuple(sizes), n=2, m=1, n_steps=3)
    p["trans"] = [np.eye(s) for s in sizes]
    compare(imm_filter(**p), (), enumerate_modes(flat_model(p)))


@quick
@given(rngs())
def test_exact_when_only_the_last_row_tells_the_modes_apart(rng):
    # Equal modes until row 2, so mixing merges equal Gaussians and loses nothing.
    p = random_problem(rng, (2,), n=2, m=1, n_steps=3, missing=0.2)
    H = np.repeat(rng.normal(size=(3, 1, 1, 2)), 2, axis=1)
    H[2] = rng.normal(size=(2, 1, 2))
    one = {"F": np.eye(2)[None], "Q": random_cov(rng, (1,), 2), "R": np.ones((1, 1, 1)), "b": None, "d": None}
    p |= one | {"H": H, "trans": [random_trans(rng, 2)], "mean0": rng.normal(size=2), "cov0": random_cov(rng, (), 2)}
    compare(imm_filter(**p), (), enumerate_modes(flat_model(p)))


def test_enumeration_differs_where_merging_is_an_approximation(rng):
    # So that the agreements above say something: the oracle does not merge histories.
    p = random_problem(rng, (2,), n=1, m=1, n_steps=3, missing=0.0)
    p |= {"Q": np.array([[[0.01]], [[25.0]]]), "trans": [random_trans(rng, 2)]}
    exact = enumerate_modes(flat_model(p))
    assert error(imm_filter(**p).probs, exact.probs) > 1e-5
    np.testing.assert_allclose(exact.probs.sum(-1), 1.0, rtol=1e-12)


def two_modes(**changes):
    """A scalar random walk, quiet or noisy."""
    model = {
        "F": np.ones((1, 1, 1)),
        "Q": np.array([[[0.01]], [[4.0]]]),
        "H": np.ones((1, 1, 1)),
        "R": np.ones((1, 1, 1)),
        "trans": [np.array([[0.7, 0.3], [0.1, 0.9]])],
        "mean0": np.zeros(1),
        "cov0": np.eye(1),
        "probs0": np.array([0.2, 0.8]),
    }
    return model | changes


def test_mode_probabilities_advance_in_a_prediction_without_measurement():
    p = two_modes(z=np.full((5, 1), np.nan))
    expected = [p["probs0"] @ np.linalg.matrix_power(p["trans"][0], k + 1) for k in range(5)]
    est = imm_filter(**p)
    assert error(est.probs, expected) < 1e-14
    assert error(imm_filter(**p, keep="last").probs[0], expected[-1]) < 1e-14


def test_missing_measurement_leaves_no_stale_likelihood():
    z = np.array([[0.3], [9.0], [np.nan], [np.nan], [0.1]])
    p = two_modes(z=z)
    est = imm_filter(**p)
    for k in (2, 3):
        assert error(est.probs[k], est.probs[k - 1] @ p["trans"][0]) < 1e-14
    assert (est.log_likelihood[2:4] == 0.0).all() and (est.nis[2:4] == 0.0).all()
    assert est.n_observed.tolist() == [1, 1, 0, 0, 1]
    # In a batch whose other runs are seen, the same.
    seen = np.where(np.isnan(z), 4.0, z)
    both = imm_filter(**two_modes(z=np.stack([z, seen])))
    assert error(both.probs[0], est.probs) < 1e-12
    assert np.abs(both.log_likelihood[0] - est.log_likelihood).max() < 1e-12
    assert np.abs(both.nis[0] - est.nis).max() < 1e-12
    np.testing.assert_array_equal(both.n_observed[0], est.n_observed)


def test_rows_of_trans_are_from():
    p = two_modes(z=np.full((4, 1), np.nan), trans=[np.array([[0.7, 0.3], [0.0, 1.0]])], probs0=np.array([1.0, 0.0]))
    stay = 0.7 ** np.arange(1, 5)
    assert error(imm_filter(**p).probs, np.stack([stay, 1 - stay], axis=-1)) < 1e-14


@pytest.mark.parametrize("sigmas", [1e4, 1e8])
def test_outlier_does_not_flatten_modes_it_cannot_tell_apart(sigmas):
    # Both modes predict the same measurement, so a value far out says nothing about them.
    p = two_modes(z=np.array([[sigmas]]), Q=np.ones((1, 1, 1)))
    est = imm_filter(**p)
    assert error(est.probs[0], p["probs0"] @ p["trans"][0]) < 1e-14 * sigmas**2  # what 16 digits of the logs leave
    assert error(est.log_likelihood, norm.logpdf([sigmas], 0.0, np.sqrt(3.0))) < 1e-14


def test_outlier_is_weighed_exactly_and_forgotten():
    # Noise levels that differ by a hair: the log-odds at 1e4 sigmas are moderate, their terms are 5e7.
    R = np.array([[[1.0]], [[1.0 + 1e-8]]])
    z = np.array([[0.0], [1e4], [np.nan]])
    model = two_modes(z=z, F=np.zeros((1, 1, 1)), Q=np.zeros((1, 1, 1)), R=R)  # z is its noise alone
    est = imm_filter(**model)
    odds = model["probs0"] @ model["trans"][0]
    odds = (odds * norm.pdf(0.0, 0.0, np.sqrt(R.ravel()))) @ model["trans"][0]
    log_odds = np.log(odds[1] / odds[0]) + 0.5 * 1e8 * (1 - 1 / R[1, 0, 0]) - 0.5 * np.log(R[1, 0, 0])
    assert abs(est.probs[1, 1] - 1 / (1 + np.exp(-log_odds))) < 1e-7
    assert error(est.probs[2], est.probs[1] @ model["trans"][0]) < 1e-12


def test_unreachable_mode_is_as_if_it_were_not_there(rng):
    p = random_problem(rng, (3,), n=2, m=1, n_steps=5)
    t = random_trans(rng, 2)
    three = np.zeros((3, 3))
    three[:2, :2], three[2, 2] = t, 1.0
    probs = np.append(law(rng, (), 2), 0.0)
    p |= {"trans": [three], "probs0": probs, "Q": random_cov(rng, (3,), 2), "F": np.eye(2)[None], "b": None, "d": None}
    p |= {"H": rng.normal(size=(3, 1, 2)), "R": np.ones((1, 1, 1)), "mean0": np.zeros(2), "cov0": np.eye(2)}
    est = imm_filter(**p, per_mode=True)
    two = imm_filter(**(p | {"trans": [t], "probs0": probs[:2], "Q": p["Q"][:2], "H": p["H"][:2]}))
    assert (est.probs[:, 2] == 0.0).all() and np.isfinite(est.mode_means).all() and np.isfinite(est.mode_covs).all()
    assert error(est.probs[:, :2], two.probs) < 1e-12
    assert error(est.mean, two.mean) < 1e-12
    assert error(est.cov, two.cov) < 1e-12
    assert error(est.log_likelihood, two.log_likelihood) < 1e-12


def test_no_runs_at_all():
    est = imm_filter(**two_modes(z=np.zeros((0, 3, 1))))
    assert est.mean.shape == (0, 3, 1) and est.probs.shape == (0, 3, 2) and est.log_likelihood.shape == (0, 3)


def test_arguments_are_left_alone(rng):
    p = random_problem(rng, (2, 2), n=2, m=2, n_steps=3, batch=(2,))
    arrays = [a for a in (*p.values(), *p["trans"]) if isinstance(a, np.ndarray)]
    before = [a.copy() for a in arrays]
    imm_filter(**p)
    for a, b in zip(arrays, before, strict=True):
        np.testing.assert_array_equal(a, b)
