"""Decisions against their expected loss, written out, and against the reference cases."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from oracles import error, is_psd
from saltus import Estimates, decide, imm_filter
from saltus.decisions import decide_chains
from saltus.errors import DataError, ModelError
from strategies import law, quick, random_cov, random_problem, rngs


def mixture(rng, sizes, n, lead=()):
    m = int(np.prod(sizes))
    probs = law(rng, lead, m).reshape(*lead, *sizes)
    return probs, 2 * rng.normal(size=(*lead, *sizes, n)), random_cov(rng, (*lead, *sizes), n)


def expected_loss(mixture, mode, x, alpha, beta, S):
    """Average over the modes of the loss of announcing `mode` and x."""
    total = 0.0
    for s in np.ndindex(mixture[0].shape):
        P, X, R = (a[s] for a in mixture)
        if s == tuple(mode):
            total += P * beta * sum(S[i, j] * (R[i, j] + (x - X)[i] * (x - X)[j]) for i in range(2) for j in range(2))
        else:
            total += P * alpha
    return total


@quick
@given(rngs(), st.lists(st.integers(1, 3), min_size=1, max_size=3), st.sampled_from([0.0, 0.05, 0.8]))
def test_no_other_announcement_has_a_smaller_expected_loss(rng, sizes, beta):
    one, S = mixture(rng, tuple(sizes), 2), random_cov(rng, (), 2)
    found = decide(*one, alpha=1.5, beta=beta, scale=S)
    least = expected_loss(one, found.mode, found.mean, 1.5, beta, S)
    for s in np.ndindex(*sizes):
        for x in (one[1][s], one[1][s] + 0.1 * rng.normal(size=2), rng.normal(size=2)):
            assert least <= expected_loss(one, s, x, 1.5, beta, S) + 1e-12


def test_the_other_sign_would_decide_otherwise(rng):
    # Equal probabilities, one mode vague: the rule of the paper as printed prefers the vague one.
    probs, means = np.array([0.5, 0.5]), np.zeros((2, 1))
    assert decide(probs, means, np.array([[[1.0]], [[4.0]]]), beta=0.1).mode == (0,)
    assert decide(probs, means, np.array([[[4.0]], [[1.0]]]), beta=0.1).mode == (1,)


def test_units_are_made_comparable_by_the_scale():
    # Mode 0 is vague in metres, mode 1 in radians; in metres alone mode 1 wins, per standard deviation mode 0.
    covs = np.array([np.diag([100.0, 1e-6]), np.diag([1.0, 1e-2])])
    two = (np.array([0.5, 0.5]), np.zeros((2, 2)), covs)
    assert decide(*two, beta=1e-3).mode == (1,)
    assert decide(*two, beta=1e-3, scale=np.diag([0.01, 1e4])).mode == (0,)


@quick
@given(rngs())
def test_leading_axes_are_a_loop(rng):
    many = mixture(rng, (2, 3), 2, (4, 2))
    alpha, beta = rng.uniform(0.5, 2.0, (4, 2)), rng.uniform(0.0, 0.5, (4, 2))
    found, each = decide(*many, alpha=alpha, beta=beta), decide_chains(*many)
    for run in np.ndindex(4, 2):
        one = tuple(a[run] for a in many)
        for got, want in (
            (found, decide(*one, alpha=alpha[run], beta=beta[run])),
            (each, decide_chains(*one)),
        ):
            assert tuple(int(i[run]) for i in got.mode) == want.mode
            assert all(type(i) is int for i in want.mode)
            np.testing.assert_allclose(got.mean[run], want.mean, atol=1e-13)
            np.testing.assert_allclose(got.cov[run], want.cov, atol=1e-12)


def test_mean_square_matrix_is_that_of_the_errors_made(rng):
    probs, means, covs = mixture(rng, (2, 2), 2)
    n = 200_000
    mode = rng.choice(4, n, p=probs.ravel())
    roots = np.linalg.cholesky(covs.reshape(4, 2, 2))
    truth = means.reshape(4, 2)[mode] + np.einsum("kij,kj->ki", roots[mode], rng.normal(size=(n, 2)))
    for found in (decide(probs, means, covs), decide_chains(probs, means, covs)):
        products = np.einsum("ki,kj->kij", truth - found.mean, truth - found.mean)
        bound = 5 * products.std(0) / np.sqrt(n)
        assert (np.abs(products.mean(0) - found.cov) < bound).all()
        assert is_psd(found.cov)
    # About any other point than the mean it is larger.
    spread = decide(probs, means, covs).cov - decide_chains(probs, means, covs).cov
    assert np.linalg.eigvalsh(spread)[0] > -1e-12 and np.trace(spread) > 1e-3


def test_chains_decided_alone_need_not_be_the_best_joint_mode():
    # Marginals: 0.6 for state 0 of a, 0.6 for state 1 of b; jointly (1, 1) has 0.4, (0, 1) only 0.2.
    probs = np.array([[0.4, 0.2], [0.0, 0.4]])
    zero = (np.zeros((2, 2, 1)), np.ones((2, 2, 1, 1)))
    assert decide(probs, *zero).mode == (0, 0)
    assert decide_chains(probs, *zero).mode == (0, 1)


def test_ties_go_to_the_lowest_flattened_index():
    assert decide(np.full((2, 2), 0.25), np.zeros((2, 2, 1)), np.ones((2, 2, 1, 1))).mode == (0, 0)


def test_no_chain_and_axes_of_length_one():
    one = decide(np.ones(5), np.zeros((5, 2)), np.broadcast_to(np.eye(2), (5, 2, 2)), n_chains=0)
    assert one.mode == () and one.mean.shape == (5, 2)
    row = (np.full((1, 2), 0.5), np.zeros((1, 2, 1)), np.ones((1, 2, 1, 1)))
    assert decide(*row).mode == (0, 0)
    assert [i.tolist() for i in decide(*row, n_chains=1).mode] == [[0]]


def test_reference_case(cases):
    case = cases("decision")
    P, R = case["P"], case["R"]
    found = decide(P, np.zeros((*P.shape, 2)), R, alpha=case["alpha"], beta=case["beta"])
    np.testing.assert_array_equal(found.mode[0], case["exp_index"])
    for k in range(len(P)):
        one = decide(P[k], np.zeros((6, 2)), R[k], alpha=case["alpha"][k], beta=case["beta"][k])
        assert one.mode == (case["exp_index"][k],)


@pytest.mark.parametrize(
    "name", ["m222", "m222_missing", "m222_outlier", "m432_tv_missing", "m221_zero_prob", "paper_frozen"]
)
def test_reference_decisions_of_the_fusion_filter(cases, name):
    case = cases(f"fusion_{name}")
    P, X, R = (np.nan_to_num(case[f"exp_{a}"]) for a in "PXR")
    for key, beta in (("dec_alpha1_beta0", 0.0), ("dec_alpha1_beta005", 0.05)):
        if key in case:
            mode = decide(P, X, R, beta=beta).mode
            np.testing.assert_array_equal(np.ravel_multi_index(mode, P.shape[1:]), case[key])


@pytest.mark.parametrize("name", ["m222", "m222_missing", "m432_tv_missing"])
def test_the_filter_s_own_decisions_are_those_of_the_reference(cases, name):
    case = cases(f"fusion_{name}")
    q1, q2, n = case["Y1"].shape[1], case["Y2"].shape[1], len(case["X0"])
    M2, M3 = case["H1"].shape[-3], case["H2"].shape[-3]
    lead = case["H1"].shape[:-3]
    H, R = np.zeros((*lead, 1, M2, M3, q1 + q2, n)), np.zeros((*lead, 1, M2, M3, q1 + q2, q1 + q2))
    H[..., :q1, :], H[..., q1:, :] = case["H1"][..., None, :, None, :, :], case["H2"][..., None, None, :, :, :]
    R[..., :q1, :q1], R[..., q1:, q1:] = case["R1"][..., None, :, None, :, :], case["R2"][..., None, None, :, :, :]
    est = imm_filter(
        np.concatenate([case["Y1"], case["Y2"]], axis=-1),
        F=case["Phi"][..., None, None, :, :],
        Q=case["B"][..., None, None, :, :],
        H=H,
        R=R,
        trans=[case["Pa"], case["Pb"], case["Pc"]],
        mean0=case["X0"],
        cov0=case["R0"],
        probs0=case["P0"],
        per_mode=True,
    )
    for key, beta in (("dec_alpha1_beta0", 0.0), ("dec_alpha1_beta005", 0.05)):
        mode = est.decide(beta=beta).mode
        np.testing.assert_array_equal(np.ravel_multi_index(mode, est.probs.shape[1:]), case[key])


# --- Estimates.decide and joint probabilities ---------------------------------------------------------------


def test_estimates_decide_for_every_row(rng):
    p = random_problem(rng, (2, 3), n=2, m=1, n_steps=4, batch=(3,))
    est = imm_filter(**p, per_mode=True)
    found = est.decide(beta=0.1, scale=np.eye(2))
    want = decide(est.probs, est.mode_means, est.mode_covs, beta=0.1)
    assert [i.shape for i in found.mode] == [(3, 4)] * 2
    np.testing.assert_array_equal(found.mode, want.mode)
    np.testing.assert_array_equal(found.mean, want.mean)
    with pytest.raises(ModelError, match="per_mode=True"):
        imm_filter(**p).decide()


def test_estimates_decide_one_row_of_one_run(rng):
    p = random_problem(rng, (2,), n=2, m=1, n_steps=1)
    assert [i.shape for i in imm_filter(**p, per_mode=True).decide().mode] == [(1,)]


def test_joint_probabilities_of_several_chains(rng):
    probs = law(rng, (5, 4), 12).reshape(5, 4, 2, 3, 2)
    ones = np.ones((5, 4))
    zero = np.zeros((5, 4, 2))
    est = Estimates(
        probs, zero, zero[..., None] * zero[..., None, :], ones, ones[:, 0], ones, ones, chains=tuple("abc")
    )
    assert error(est.prob("a", "c"), np.einsum("btijk->btik", probs)) < 1e-14
    assert error(est.prob("c", "a"), np.einsum("btijk->btki", probs)) < 1e-14
    assert error(est.prob(2, "a", 1), np.einsum("btijk->btkij", probs)) < 1e-14
    for wrong in ((), ("a", "a"), ("a", 0)):
        with pytest.raises(ModelError, match="prob needs"):
            est.prob(*wrong)


# --- what is refused -----------------------------------------------------------------------------------------

GOOD = {"probs": [0.4, 0.6], "means": np.zeros((2, 2)), "covs": np.broadcast_to(np.eye(2), (2, 2, 2))}


@pytest.mark.parametrize(
    ("change", "kind", "message"),
    [
        ({"probs": [0.4, 0.5]}, DataError, "must sum to 1 over the modes"),
        ({"probs": [-0.4, 1.4]}, DataError, "probs holds -0.4"),
        ({"probs": [np.nan, 1.0]}, DataError, r"probs\[0\] is nan"),
        ({"n_chains": 2}, ModelError, "n_chains = 2, but probs has 1 axes"),
        ({"n_chains": 0}, DataError, "over the last 0 axes"),
        ({"means": np.zeros((3, 2))}, ModelError, r"means has shape \(3, 2\)"),
        ({"means": 1.0}, ModelError, "means has shape"),
        ({"covs": np.eye(2)}, ModelError, r"covs has shape \(2, 2\).*per_mode=True"),
        ({"alpha": -1.0}, ModelError, "alpha is a loss"),
        ({"beta": [0.1, 0.2]}, ModelError, "beta must be one number"),
        ({"scale": np.eye(3)}, ModelError, "scale must be a symmetric matrix"),
        ({"scale": [[1.0, 1.0], [0.0, 1.0]]}, ModelError, "scale must be a symmetric matrix"),
    ],
)
def test_wrong_arguments_are_named(change, kind, message):
    with pytest.raises(kind, match=message):
        decide(**(GOOD | change))
