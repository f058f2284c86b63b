"""Decisions on ratios against enumeration and against simulated rates of error."""

from decimal import Decimal

import numpy as np
import pytest

from saltus import DataError, ModelError, discretise, identification_llr
from saltus.identify import (
    DIFFERENT,
    SAME,
    UNDECIDED,
    neyman_pearson_bound,
    posterior,
    same_object,
    sprt,
    sprt_bounds,
)

F, G, H = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [0.3]]), np.array([[1.0, 0.0]])
SD = (1.0, 2.0)
PRIOR = (np.zeros(2), np.diag([30.0**2, 2.0**2]))


def ratios(rng, runs, n_rows, same):
    """Ratios of pairs drawn from the model, both objects from the prior unless there is one only."""
    A, Q = discretise(F, G, 1.0)
    x = rng.normal(size=(runs, 2, 2)) @ np.sqrt(PRIOR[1])
    system, z = np.arange(n_rows) % 2, np.empty((runs, n_rows, 1))
    for k in range(n_rows):
        x = x @ A.T + rng.normal(size=x.shape) @ np.linalg.cholesky(Q).T
        z[:, k, 0] = x[:, 0 if same else system[k], 0] + SD[system[k]] * rng.normal(size=runs)
    R = tuple(np.array([[sd**2]]) for sd in SD)
    return identification_llr(
        1.0 + np.arange(n_rows), system, z, F=F, G=G, H=H, R=R, t0=0.0, prior_same=PRIOR, prior_other=PRIOR
    )


def test_posterior_is_bayes_rule_and_stands_any_ratio():
    for llr, p in ((0.3, 0.5), (-4.0, 0.2), (2.0, 0.9), (30.0, 0.01), (-500.0, 0.5)):
        one, two = Decimal(p) * Decimal(llr).exp(), 1 - Decimal(p)
        assert posterior(llr, p) == pytest.approx(float(one / (one + two)), rel=1e-13)
    np.testing.assert_array_equal(posterior([-np.inf, -1e5, 0.0, 1e5, np.inf]), [0.0, 0.0, 0.5, 1.0, 1.0])
    assert posterior(np.zeros((2, 3)), [0.1, 0.2, 0.3]).shape == (2, 3)


@pytest.mark.parametrize("prior", [0.05, 0.5, 0.8])
@pytest.mark.parametrize(("false", "missed"), [(1.0, 1.0), (20.0, 1.0), (1.0, 3.0)])
def test_declaration_has_the_smaller_expected_loss(prior, false, missed):
    llr = np.linspace(-8.0, 8.0, 401)
    p = posterior(llr, prior)
    cheaper = (1 - p) * false < p * missed
    tie = np.isclose((1 - p) * false, p * missed)
    got = same_object(llr, prior=prior, loss_false=false, loss_missed=missed)
    np.testing.assert_array_equal(got[~tie], cheaper[~tie])


def test_bound_is_the_smallest_that_keeps_the_share():
    sample = np.array([3.0, -1.0, 2.0, 2.0, 0.0, 5.0, -7.0, 1.0, 1.5, 4.0])
    for asked, share in ((0.1, 1), (0.29, 2), (0.3, 3), (0.4, 3)):  # 0.4 would need to part the twos
        bound = neyman_pearson_bound(sample, asked)
        assert (sample >= bound).sum() == share
        lower = sample[sample < bound].max()
        assert (sample >= lower).mean() > asked


@pytest.mark.parametrize("asked", [1e-1, 1e-2])
def test_share_of_false_identifications_is_the_one_asked_for(rng, asked):
    runs = 12_000
    bound = neyman_pearson_bound(ratios(rng, runs, 3, same=False)[:, -1], asked)
    fresh = ratios(rng, runs, 3, same=False)[:, -1]
    # The bound comes from a sample as large as the one that it is held to.
    interval = 1.96 * np.sqrt(2 * asked * (1 - asked) / runs)
    assert abs((fresh >= bound).mean() - asked) < interval
    # A bound a nat too low would be seen.
    assert (fresh >= bound - 1.0).mean() - asked > interval


def test_bound_is_the_most_powerful(rng):
    different, same = (ratios(rng, 4000, 3, same=flag)[:, -1] for flag in (False, True))
    assert (same >= neyman_pearson_bound(different, 0.1)).mean() > 0.75


def test_sequential_bounds_are_wald_s():
    assert sprt_bounds(0.01, 0.05) == pytest.approx((np.log(0.05 / 0.99), np.log(0.95 / 0.01)))


def test_sequential_test_keeps_to_its_first_crossing():
    low, high = sprt_bounds(0.1, 0.1)
    llr = np.array(
        [
            [0.0, 1.0, high, low - 5, 0.0],
            [0.0, low, 0.0, high + 9, high + 9],
            [0.0, 1.0, -1.0, 1.0, -1.0],
            [high + 1, low - 1, 0.0, 0.0, 0.0],
        ]
    )
    verdict, row = sprt(llr, p_false=0.1, p_missed=0.1)
    assert verdict.tolist() == [SAME, DIFFERENT, UNDECIDED, SAME]
    assert row.tolist() == [2, 1, 5, 0]
    one = sprt(llr[1], p_false=0.1, p_missed=0.1)
    assert one.verdict == DIFFERENT and one.row == 1


@pytest.mark.parametrize("asked", [1e-1, 1e-2])
def test_sequential_test_makes_no_more_errors_than_promised(rng, asked):
    runs, missed = 3000, 0.05
    different = sprt(ratios(rng, runs, 24, same=False), p_false=asked, p_missed=missed).verdict
    same = sprt(ratios(rng, runs, 24, same=True), p_false=asked, p_missed=missed).verdict
    for share, promised in (
        ((different == SAME).mean(), asked / (1 - missed)),
        ((same == DIFFERENT).mean(), missed / (1 - asked)),
    ):
        assert share < promised + 3 * np.sqrt(promised * (1 - promised) / runs)
    assert (different == UNDECIDED).mean() < 0.05 and (same == SAME).mean() > 0.5
    # Bounds for five times the error let more than that through: the promise is no empty one.
    loose = sprt(ratios(rng, runs, 24, same=False), p_false=min(0.9, 5 * asked), p_missed=missed).verdict
    assert (loose == SAME).mean() > (different == SAME).mean()


@pytest.mark.parametrize(
    ("call", "kind", "what"),
    [
        (lambda: posterior(np.nan), DataError, "NaN"),
        (lambda: posterior(0.0, 1.0), DataError, "prior probability"),
        (lambda: same_object(0.0, loss_false=0.0), ModelError, "loss_false must be positive"),
        (lambda: same_object(0.0, prior=0.0), DataError, "prior probability"),
        (lambda: neyman_pearson_bound(np.zeros(50), 0.01), DataError, "50 ratios cannot tell"),
        (lambda: neyman_pearson_bound(np.zeros(50), 1.0), ModelError, "p_false must lie"),
        (lambda: sprt_bounds(0.0, 0.1), ModelError, "p_false must lie"),
        (lambda: sprt_bounds(0.5, 0.5), ModelError, "less than 1"),
        (lambda: sprt(0.0, p_false=0.1, p_missed=0.1), DataError, "last axis of rows"),
    ],
)
def test_impossible_arguments_are_refused(call, kind, what):
    with pytest.raises(kind, match=what):
        call()
