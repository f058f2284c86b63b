"""What is done with particles as arrays: resampling, merging, the error of independent groups."""

import numpy as np
import pytest

from diffusions import unchecked
from saltus import ModelError
from saltus.filters.particles import effective_size, generator, group_error, merged, systematic


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
