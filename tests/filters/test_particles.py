"""What is done with particles as arrays: resampling, merging, the error of independent groups."""

import numpy as np
import pytest

from diffusions import unchecked
from saltus import ModelError
from saltus.filters.particles import effective_size, generator, group_error, merged, stated_error, systematic, thinned


def test_systematic_resampling_takes_each_particle_as_often_as_it_weighs(rng):
    weights = rng.uniform(size=(5, 40)) ** 3
    expected = 40 * weights / weights.sum(1, keepdims=True)
    counts = np.zeros_like(weights)
    for _ in range(2000):
        taken = systematic(weights, rng)
        assert taken.shape == weights.shape and (np.diff(taken, axis=1) >= 0).all()
        count = np.stack([np.bincount(row, minlength=40) for row in taken])
        assert (np.abs(count - expected) < 1.0).all()  # the definition of systematic
        counts += count
    # A count is one of two neighbouring integers: variance at most 1/4; 5 standard errors of 2000 means.
    assert np.abs(counts / 2000 - expected).max() < 5 * np.sqrt(0.25 / 2000)


def test_one_particle_with_all_the_weight_is_all_there_is(rng):
    weights = np.zeros((1, 9))
    weights[0, 4] = 1e-300
    assert (systematic(weights, rng) == 4).all()
    assert effective_size(weights * 1e300) == 1.0
    assert effective_size(np.ones((3, 7))).tolist() == [7.0] * 3


def test_thinning_keeps_the_heavy_and_expectations(rng):
    k, n = 40, 12
    log_w = 6.0 * rng.normal(size=(3, k))
    w = np.exp(log_w - log_w.max(1, keepdims=True))
    total, squares, heavy = np.zeros_like(w), np.zeros_like(w), np.argsort(-w, axis=1)[:, :3]
    for _ in range(4000):
        chosen, kept = thinned(log_w, n, rng)
        assert (np.diff(chosen, axis=1) > 0).all()  # n different ones, in order
        np.testing.assert_allclose(np.exp(kept - log_w.max(1, keepdims=True)).sum(1), w.sum(1), rtol=1e-10)
        now = np.zeros_like(w)
        np.put_along_axis(now, chosen, np.exp(kept - log_w.max(1, keepdims=True)), 1)
        assert (np.take_along_axis(now, heavy, 1) == np.take_along_axis(w, heavy, 1)).all()
        total, squares = total + now, squares + now**2
    mean, sd = total / 4000, np.sqrt(np.maximum(squares / 4000 - (total / 4000) ** 2, 0.0))
    drawn = sd > 0
    assert (np.abs(mean - w)[drawn] < 5 * sd[drawn] / np.sqrt(4000)).all() and drawn.any()
    # What is never drawn in 4000 times has a chance below 1e-3: w / c, c the least weight of those kept.
    assert (w[~drawn & (mean == 0)] < 5e-3 * np.exp(kept - log_w.max(1, keepdims=True)).min()).all()


@pytest.mark.parametrize("scale", [1.0, 1e5])
def test_thinning_of_weights_that_no_number_holds(rng, scale):
    log_w = -scale * np.arange(30.0)[None] ** 2
    log_w[:, ::7] = -np.inf
    chosen, kept = thinned(rng.permutation(log_w, axis=1), 10, rng)
    assert len(set(chosen[0])) == 10 and np.isfinite(kept).all()
    few, rest = thinned(np.array([[0.0, -np.inf, -1e9, -2e300]]), 6, rng)
    assert sorted(few[0][np.isfinite(rest[0])]) == [0, 2, 3] and np.isfinite(rest).sum() == 3
    np.testing.assert_array_equal(np.sort(rest[0]), [-np.inf, -np.inf, -np.inf, -2e300, -1e9, 0.0])


def test_equal_weights_are_thinned_evenly(rng):
    chosen, kept = thinned(np.zeros((2, 30)), 10, rng)
    np.testing.assert_allclose(kept, np.log(3.0))
    assert (np.diff(chosen, axis=1) == 3).all()  # systematic


def test_nothing_is_claimed_after_what_no_mode_explains():
    d2, n = np.array([[1.0, 40.0, 0.0, 1.0], [1.0, 2.0, 25.0, 0.0]]), np.ones((2, 4))
    error, findings = stated_error(np.full((2, 4), 0.1), d2, n, n > 0)
    np.testing.assert_array_equal(error, [[0.1, np.inf, np.inf, np.inf], [0.1] * 4])
    assert [f.kind for f in findings] == ["unexplained"] and findings[0].where == "row 1 of run 0"
    assert stated_error(np.zeros((2, 4)), d2, n, n < 0)[1] == ()  # nothing was left to chance


def test_merging_keeps_weight_mean_and_covariance(rng):
    means, root = rng.normal(size=(50, 3)), rng.normal(size=(50, 3, 3))
    covs, weights, labels = root @ root.swapaxes(1, 2), rng.uniform(size=50), rng.integers(0, 4, 50)
    out = merged(means, covs, weights, labels, 5)
    for label in range(4):
        own = labels == label
        w = weights[own] / weights[own].sum()
        mean = w @ means[own]
        gap = means[own] - mean
        cov = np.einsum("i,ijk->jk", w, covs[own]) + np.einsum("i,ij,ik->jk", w, gap, gap)
        assert np.allclose(out.mass[label], weights[own].sum())
        assert np.allclose(out.means[label], mean) and np.allclose(out.covs[label], cov)
    assert out.mass[4] == 0 and not out.means[4].any()


@pytest.mark.parametrize("spread", [[1.0], [1.0, 1.0], [3.0, 0.1, 0.1], [1.0, 0.5, 0.2, 0.1]])
def test_error_of_groups_covers_the_truth(rng, spread):
    """Box's approximation against draws: 4000 trials, the share within 95 % up to 5 standard errors and its own 2 %."""
    n = len(spread)
    root = rng.normal(size=(n, n))
    posterior = root @ root.T + np.eye(n)
    axes = np.linalg.cholesky(posterior)
    groups = (rng.normal(size=(4000, 8, n)) * spread) @ axes.T  # exact mean 0
    bound = group_error(groups, np.broadcast_to(posterior, (4000, n, n)))
    mean = groups.mean(1)
    distance = np.sqrt(np.einsum("bi,ij,bj->b", mean, np.linalg.inv(posterior), mean))
    assert abs(np.mean(distance <= bound) - 0.95) < 5 * np.sqrt(0.95 * 0.05 / 4000) + 0.02
    assert np.mean(1.3 * distance <= bound) < 0.93  # a bound a third too narrow would not pass


def test_one_component_is_student_s_interval(rng):
    groups, variance = rng.normal(size=(6, 1)), 4.0
    half = 2.5705818366147395 * groups.std(ddof=1) / np.sqrt(6)  # t of 5 degrees of freedom, 97.5 %
    assert np.isclose(group_error(groups, np.array([[variance]])), half / 2.0)


def test_a_filter_that_draws_needs_a_source():
    with unchecked(), pytest.raises(ModelError, match="rng must be a generator, got 7"):
        generator(7)
    with pytest.raises(ModelError, match=r"pass rng=np\.random\.default_rng"):
        generator(None)
