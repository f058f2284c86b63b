"""Two channels apart against the stacked gain, and chains without memory kept or merged."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from oracles import error
from saltus.errors import ModelError, NumericalError
from saltus.filters import steps
from saltus.filters.block import block_gain
from strategies import quick, random_cov, rngs


@quick
@given(rngs(), st.integers(1, 4), st.integers(1, 3), st.integers(1, 3), st.lists(st.integers(1, 3), max_size=2))
def test_side_by_side_they_are_the_stacked_gain(rng, n, m1, m2, lead):
    P, R1, R2 = (random_cov(rng, tuple(lead), k) for k in (n, m1, m2))
    H1, H2 = rng.normal(size=(*lead, m1, n)), rng.normal(size=(*lead, m2, n))
    found = block_gain(P, H1, R1, H2, R2)
    H = np.concatenate([H1, H2], axis=-2)
    R = np.zeros((*lead, m1 + m2, m1 + m2))
    R[..., :m1, :m1], R[..., m1:, m1:] = R1, R2
    W = H @ P @ H.swapaxes(-1, -2) + R
    stacked = np.linalg.solve(W, H @ P).swapaxes(-1, -2)
    assert error(np.concatenate([found.first, found.second], axis=-1), stacked) < 1e-10
    # D is the covariance of the first innovation given the second.
    assert error(np.linalg.inv(found.schur), np.linalg.inv(W)[..., :m1, :m1]) < 1e-9


def test_estimate_is_that_of_the_recursion(rng):
    P, R1, R2 = random_cov(rng, (2, 3), 3), random_cov(rng, (1, 3), 2), random_cov(rng, (2, 1), 1)
    H1, H2 = rng.normal(size=(1, 1, 2, 3)), rng.normal(size=(2, 1, 1, 3))
    x, z = rng.normal(size=(2, 3, 3)), rng.normal(size=3)
    K1, K2, _ = block_gain(P, H1, R1, H2, R2)
    one = x + np.einsum("...nm,...m->...n", K1, z[:2] - np.einsum("...mn,...n->...m", H1, x))
    one += np.einsum("...nm,...m->...n", K2, z[2:] - np.einsum("...mn,...n->...m", H2, x))
    H, R = np.empty((2, 3, 3, 3)), np.zeros((2, 3, 3, 3))
    H[..., :2, :], H[..., 2:, :], R[..., :2, :2], R[..., 2:, 2:] = H1, H2, R1, R2
    done = steps.condition(steps.measure(x, P, H, None, R), z, np.ones(3, bool))
    assert error(one, done.mean) < 1e-10


def test_a_useless_channel_leaves_the_other_alone(rng):
    P, H = random_cov(rng, (), 3), rng.normal(size=(2, 3))
    R = random_cov(rng, (), 2)
    K1, K2, _ = block_gain(P, H, R, np.zeros((1, 3)), [[1.0]])
    assert error(K1, P @ H.T @ np.linalg.inv(H @ P @ H.T + R)) < 1e-12
    assert np.abs(K2).max() == 0.0


def test_reference_innovations_of_the_fusion_filter(cases):
    # Predicted covariances and W of the reference filter: D and W22 rebuild its determinant, the gains its inverse.
    case = cases("fusion_m222")
    P, W = case["exp_R_pred"], case["exp_W"]
    H1, R1 = case["H1"][:, None], case["R1"][:, None]
    found = block_gain(P, H1, R1, case["H2"], case["R2"])
    assert error(found.schur[..., 0, 0] * W[..., 1, 1], np.linalg.det(W)) < 1e-8
    H = np.empty((*P.shape[:-2], 2, 3))
    H[..., :1, :], H[..., 1:, :] = H1, case["H2"]
    both = np.concatenate([found.first, found.second], axis=-1)
    assert error(both @ W, P @ H.swapaxes(-1, -2)) < 1e-8


def test_what_is_refused():
    eye = np.eye(2)
    with pytest.raises(ModelError, match=r"H1 has shape \(2, 3\), expected \(..., 2, 2\)"):
        block_gain(eye, np.zeros((2, 3)), eye, eye, eye)
    with pytest.raises(ModelError, match="R2 has shape"):
        block_gain(eye, eye, eye, eye, np.eye(3))
    with pytest.raises(ModelError, match="cov has shape"):
        block_gain(np.zeros((2, 3)), eye, eye, eye, eye)
    with pytest.raises(NumericalError, match="positive variance"):
        block_gain(eye, eye, eye, np.zeros((1, 2)), [[0.0]])
