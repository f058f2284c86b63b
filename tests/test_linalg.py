"""Algebra on stacks of small matrices."""

import numpy as np
import pytest
from scipy import special

from oracles import error
from saltus import linalg
from strategies import random_cov


def test_symmetric_and_quadratic_form(rng):
    a, b = rng.normal(size=(3, 1, 2, 4)), random_cov(rng, (5,), 4)
    expected = np.einsum("...pi,...ij,...qj->...pq", a, b, a)
    assert error(linalg.quadratic_form(a, b), expected) < 1e-14
    square = rng.normal(size=(2, 3, 3))
    np.testing.assert_array_equal(linalg.symmetric(square), (square + np.moveaxis(square, 1, 2)) / 2)


@pytest.mark.parametrize("axes", [(), (0,), (1, 2), (0, 1, 2)])
def test_logsumexp(rng, axes):
    a = 1e5 * rng.normal(size=(2, 3, 4))
    a[0, 1] = -np.inf
    expected = special.logsumexp(a, axis=axes, keepdims=True) if axes else a
    with np.errstate(divide="ignore"):
        got = linalg.logsumexp(a, axes)
    finite = np.isfinite(expected)
    np.testing.assert_array_equal(np.isfinite(got), finite)
    assert error(got[finite], expected[finite]) < 1e-14
    assert (got[~finite] == -np.inf).all()


def test_logsumexp_of_nothing_possible_and_of_no_axes():
    assert linalg.logsumexp(np.full((2, 3), -np.inf), (1,)).tolist() == [[-np.inf], [-np.inf]]
    assert isinstance(linalg.logsumexp(np.array(1.5), ()), np.ndarray)
    assert linalg.logsumexp(np.array(1.5), ()) == 1.5


def test_gaussian_terms(rng):
    S, nu = random_cov(rng, (5,), 3), rng.normal(size=(5, 3))
    d2, logdet, L_inv = linalg.gaussian_terms(nu, S)
    assert error(d2, np.einsum("bi,bij,bj->b", nu, np.linalg.inv(S), nu)) < 1e-12
    assert error(logdet, np.linalg.slogdet(S)[1]) < 1e-12
    assert error(L_inv.swapaxes(-1, -2) @ L_inv, np.linalg.inv(S)) < 1e-12
    with pytest.raises(np.linalg.LinAlgError):
        linalg.gaussian_terms(np.zeros(2), np.array([[1.0, 2.0], [2.0, 1.0]]))


@pytest.mark.parametrize("size", [1.0, 1e8, 1e16, 1e300])
def test_weights_of_any_size_are_normalised_to_the_last_bits(rng, size):
    log_w = rng.normal(size=(4, 3)) - size
    got, total = linalg.normalised(log_w, (1,))
    np.testing.assert_allclose(np.exp(got).sum(1), 1.0, rtol=1e-15)
    np.testing.assert_allclose(total, special.logsumexp(log_w, axis=1, keepdims=True), rtol=1e-15)
    nothing, total = linalg.normalised(np.full((1, 2), -np.inf), (1,))
    assert nothing.tolist() == [[-np.inf, -np.inf]] and total == -np.inf


def test_a_root_of_what_rounding_has_made_indefinite(rng):
    root = rng.normal(size=(50, 4, 2)) * 10.0 ** rng.uniform(-9, 9, size=(50, 4, 1))
    P = linalg.symmetric(root @ root.swapaxes(-1, -2))  # rank 2, but for rounding
    L = linalg.cholesky(P)
    sigma = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
    assert not np.triu(L, 1).any()
    assert (
        np.abs((L @ L.swapaxes(-1, -2) - P) / (sigma[:, :, None] * sigma[:, None])).max() < 1e-11
    )  # rounding over the second pivot
    assert np.isnan(linalg.cholesky(np.array([[1.0, 2.0], [2.0, np.nan]]))).any()  # and no number out of none


def test_a_root_at_the_ends_of_double_precision():
    assert not linalg.cholesky(np.array([[1e-310]])).any()  # no variance, but rounding of a mode of probability zero
    assert np.isnan(linalg.cholesky(np.array([[np.inf, 0.0], [0.0, 0.0]]))[0, 0])  # overflow is not nothing
    barely = np.array([[1.0, 1.0], [1.0, 1.0 + 2e-16]])  # NumPy's own would take rounding for a variance
    np.testing.assert_array_equal(linalg.cholesky(barely), [[1.0, 0.0], [1.0, 0.0]])
