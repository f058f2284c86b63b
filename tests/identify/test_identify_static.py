"""Error probabilities of single estimates against the non-central chi-square law, the cases and simulation."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import binom, chi2, ncx2

from saltus import DataError, ModelError, p_correct, p_false, threshold
from saltus.identify import separation
from strategies import random_cov

DIMS = (1, 2, 3, 4, 9, 30)


@pytest.mark.parametrize("dim", [2, 3])
def test_reference_case(cases, dim):
    c, at = cases("identification_prob"), f"{dim}d"
    close = {"rtol": 0.0, "atol": 1e-9}
    np.testing.assert_allclose(p_correct(c["h"], dim), c[f"p_correct_{at}"], **close)
    np.testing.assert_allclose(p_false(c["h"], c["lam"][:, None], dim), c[f"p_false_{at}"], **close)
    np.testing.assert_allclose(p_false(c["h"], tuple(c["mean_range"]), dim), c[f"p_false_mean_{at}"], **close)
    found = threshold(dim=dim, p_false=c["p_targets"], distance=c["mean_range"])
    np.testing.assert_allclose(found, c[f"h_for_p_false_{at}"], **close)
    np.testing.assert_allclose(threshold(dim=dim, p_correct=c["p_targets"]), c[f"h_for_p_correct_{at}"], **close)


@pytest.mark.parametrize("dim", DIMS)
def test_probabilities_are_those_of_the_chi_square_laws(dim):
    h = np.array([1e-3, 0.5, 1.0, 3.0, 8.0, 25.0])
    distance = np.array([0.1, 1.0, 4.0, 9.0, 24.0])[:, None]
    np.testing.assert_allclose(p_correct(h, dim), chi2.cdf(h**2, dim), rtol=1e-12)
    expected = ncx2.cdf(h**2, dim, distance**2)
    np.testing.assert_allclose(p_false(h, distance, dim), expected, rtol=1e-8, atol=1e-13)
    np.testing.assert_allclose(p_false(h, 0.0, dim), p_correct(h, dim), rtol=1e-11)


@pytest.mark.parametrize(("h", "distance"), [(100.0, 99.5), (1e4, 1e4 - 1.0), (300.0, 310.0)])
def test_large_thresholds_and_distances_are_resolved(h, distance):
    assert p_false(h, distance, 3) == pytest.approx(ncx2.cdf(h**2, 3, distance**2), rel=1e-6, abs=1e-14)
    assert p_false(100.0, 1.0, 2) == pytest.approx(1.0, abs=1e-13)
    assert p_false(1.0, 1e3, 2) == 0.0


@pytest.mark.parametrize(("low", "high"), [(0.0, 0.5), (2.0, 2.0 + 1e-5), (0.0, 20.0), (3.0, 60.0)])
def test_mean_over_distances_is_the_integral(low, high):
    for h in (0.7, 4.0, 12.0):
        points = [p for p in (h - 3, h, h + 3) if low < p < high]
        integral = quad(
            lambda x, h=h: ncx2.cdf(h**2, 3, x**2), low, high, epsabs=0, epsrel=1e-11, points=points or None
        )
        assert p_false(h, (low, high), 3) == pytest.approx(integral[0] / (high - low), rel=1e-8, abs=1e-13)
    assert p_false(1.5, (2.0, 2.0), 3) == pytest.approx(p_false(1.5, 2.0, 3), rel=1e-12)


def test_probabilities_grow_with_the_threshold_and_fall_with_distance():
    h, distance = np.linspace(0.0, 8.0, 60), np.linspace(0.0, 9.0, 40)[:, None]
    p = p_false(h, distance, 2)
    assert (np.diff(p, axis=1)[:, :30] > 0).all() and (np.diff(p, axis=0)[:, 1:30] < 0).all()
    assert not p[:, 0].any() and p_correct(0.0, 2) == 0.0
    assert p.min() >= 0.0 and p.max() <= 1.0


@pytest.mark.parametrize("dim", DIMS)
def test_threshold_gives_the_probability_asked_for(dim):
    p = np.array([[1e-6, 0.01, 0.1], [0.5, 0.95, 0.999]])
    h = threshold(dim=dim, p_correct=p)
    np.testing.assert_allclose(chi2.cdf(h**2, dim), p, rtol=1e-10)
    h = threshold(dim=dim, p_false=p, distance=5.0)
    np.testing.assert_allclose(ncx2.cdf(h**2, dim, 25.0), p, rtol=1e-8)
    assert p_false(threshold(dim=dim, p_false=0.2, distance=(1.0, 7.0)), (1.0, 7.0), dim) == pytest.approx(0.2)


def test_thresholds_of_the_plane_have_a_closed_form():
    assert threshold(dim=2, p_correct=0.95) == pytest.approx(np.sqrt(-2 * np.log(0.05)), rel=1e-13)


def pairs(rng, n, offset, cov_a, cov_b):
    """Normalised distances of simulated estimates of objects `offset` apart."""
    noise = [rng.normal(size=(n, len(offset))) @ np.linalg.cholesky(C).T for C in (cov_a, cov_b)]
    return separation(offset + noise[1] - noise[0], cov_a + cov_b)


@pytest.mark.parametrize(
    ("asked", "dim", "n"),
    [
        (1e-1, 2, 20_000),
        (1e-1, 3, 20_000),
        (1e-2, 2, 50_000),
        (1e-2, 3, 50_000),
        (1e-3, 2, 200_000),
        (1e-4, 3, 400_000),
    ],
)
def test_share_of_false_identifications_is_the_one_asked_for(rng, asked, dim, n):
    cov_a, cov_b = random_cov(rng, (), dim), 3.0 * random_cov(rng, (), dim)  # neither round nor parallel
    offset = rng.normal(size=dim)
    offset *= 3.0 / separation(offset, cov_a + cov_b)
    low, high = binom.interval(0.999, n, asked)  # six checks: one in 170 false alarms
    found = pairs(rng, n, offset, cov_a, cov_b)
    assert low <= (found < threshold(dim=dim, p_false=asked, distance=3.0)).sum() <= high
    # One coordinate too many would be seen: the interval is narrow enough.
    assert (found < threshold(dim=dim + 1, p_false=asked, distance=3.0)).sum() > high


def test_share_of_correct_identifications_is_the_one_asked_for(rng):
    cov_a, cov_b, n = random_cov(rng, (), 4), random_cov(rng, (), 4), 20_000
    observed = (pairs(rng, n, np.zeros(4), cov_a, cov_b) < threshold(dim=4, p_correct=0.9)).mean()
    assert abs(observed - 0.9) < 3 * np.sqrt(0.09 / n)


def test_separation_is_the_length_in_standard_deviations(rng):
    C, d = random_cov(rng, (5,), 3), rng.normal(size=(5, 3))
    expected = [np.sqrt(v @ np.linalg.inv(P) @ v) for v, P in zip(d, C, strict=True)]
    np.testing.assert_allclose(separation(d, C), expected, rtol=1e-10)
    np.testing.assert_allclose(separation([3.0, 4.0], 4.0 * np.eye(2)), 2.5)


@pytest.mark.parametrize(
    ("call", "kind", "what"),
    [
        (lambda: p_correct(-1.0, 2), DataError, "h must be finite and not negative"),
        (lambda: p_correct([1.0, np.nan], 2), DataError, "h must be finite"),
        (lambda: p_correct(1.0, 0), ModelError, "dim must be"),
        (lambda: p_false(1.0, -2.0, 2), DataError, "distance must be finite and not negative"),
        (lambda: p_false(1.0, (3.0, 2.0), 2), DataError, "low <= high"),
        (lambda: p_false(1.0, (1.0, 2.0, 3.0), 2), DataError, "a tuple"),
        (lambda: p_false(np.ones(3), np.ones(2), 2), DataError, "do not broadcast"),
        (lambda: threshold(dim=2), ModelError, "either p_correct or p_false"),
        (lambda: threshold(dim=2, p_correct=0.9, p_false=0.1), ModelError, "either p_correct or p_false"),
        (lambda: threshold(dim=2, p_false=0.1), ModelError, "needs the distance"),
        (lambda: threshold(dim=2, p_correct=0.9, distance=3.0), ModelError, "does not depend on a distance"),
        (lambda: threshold(dim=2, p_correct=1.0), DataError, "both excluded"),
        (lambda: threshold(dim=2, p_false=0.0, distance=3.0), DataError, "both excluded"),
        (lambda: threshold(dim=2, p_false=0.1, distance=[1.0, 2.0, 3.0]), DataError, "one number"),
        (lambda: separation([1.0, 2.0], np.eye(3)), ModelError, "do not fit"),
        (lambda: separation([1.0, 2.0], np.diag([1.0, 0.0])), ModelError, "positive definite"),
        (lambda: separation(np.ones((2, 2)), np.ones((3, 1, 1)) * np.eye(2)), ModelError, "do not broadcast"),
    ],
)
def test_impossible_arguments_are_refused(call, kind, what):
    with pytest.raises(kind, match=what):
        call()
