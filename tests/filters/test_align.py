"""One reading of shapes, and a message for every argument that cannot be read."""

import inspect

import numpy as np
import pytest

from saltus.errors import DataError, ModelError
from saltus.filters import imm_filter
from saltus.filters.align import align, covariances
from strategies import spread_cov

GOOD = {
    "z": np.zeros((4, 1)),
    "F": np.eye(2)[None, None],
    "Q": np.eye(2)[None, None],
    "H": np.ones((1, 1, 1, 2)),
    "R": np.ones((1, 1, 1, 1)),
    "trans": [np.array([[0.9, 0.1], [0.2, 0.8]]), np.eye(3)],
    "mean0": np.zeros(2),
    "cov0": np.eye(2),
    "probs0": np.full((2, 3), 1 / 6),
    "b": None,
    "d": None,
}
ASYMMETRIC = np.array([[1.0, 0.5], [0.0, 1.0]])
INDEFINITE = np.array([[1.0, 2.0], [2.0, 1.0]])


def with_nan(a):
    a = np.array(a, float)
    a.flat[-1] = np.nan
    return a


@pytest.mark.parametrize(
    ("name", "value", "kind", "message"),
    [
        ("z", [1.0, 2.0], DataError, r"z has shape \(2,\); it is \(\*batch, T, m\)"),
        ("z", np.zeros((0, 1)), DataError, "T and m at least 1"),
        ("z", np.zeros((4, 0)), DataError, "T and m at least 1"),
        ("z", [[0.0], [-np.inf]], DataError, r"z\[1, 0\] is infinite\. A missing component is NaN"),
        ("F", with_nan(np.eye(2)), DataError, r"F\[1, 1\] is nan; only z may hold NaN"),
        ("b", [[[0.0, np.inf]]], DataError, r"b\[0, 0, 1\] is inf"),
        ("mean0", with_nan(np.zeros(2)), DataError, r"mean0\[1\] is nan"),
        ("probs0", with_nan(GOOD["probs0"]), DataError, r"probs0\[1, 2\] is nan"),
        ("trans", [with_nan(np.eye(2)), np.eye(3)], DataError, r"trans\[0\]\[1, 1\] is nan"),
        ("F", np.eye(2), ModelError, r"F has shape \(2, 2\); with 2 chain.*4 axes.*F\.reshape\(\(1, 1, 2, 2\)\)"),
        ("H", np.ones((1, 1, 2)), ModelError, r"H\.reshape\(\(1, 1, 1, 2\)\)"),
        (
            "F",
            np.ones((2, 2, 2, 2)),
            ModelError,
            r"F has shape .*read from the right as \(\*\(\), 4\|1, 2\|1, 3\|1, 2, 2\)",
        ),
        ("Q", np.ones((3, 1, 1, 2, 2)), ModelError, "Q has shape.*4|1.*absent axes have length 1"),
        ("R", np.ones((1, 1, 2, 2)), ModelError, "R has shape"),
        ("d", np.ones((1, 1, 2)), ModelError, "d has shape"),
        ("Q", np.ones((5, 4, 1, 1, 2, 2)), ModelError, r"Q has 6 axes.*drop leading axes"),
        ("mean0", np.zeros((2, 2)), ModelError, r"mean0 has shape \(2, 2\), which is none of: .*axis of length 1"),
        ("mean0", np.zeros((5, 2, 3, 2)), ModelError, "mean0 has 4 axes.*drop leading axes"),
        ("mean0", np.zeros((3, 3, 2)), ModelError, "mean0 has shape"),
        ("cov0", np.ones(2), ModelError, r"cov0 has shape \(2,\); it is a covariance matrix"),
        ("cov0", np.ones((3, 2)), ModelError, "F has shape|cov0 has shape"),
        ("probs0", 1.0, ModelError, r"probs0 has shape \(\), expected \(2, 3\)"),
        ("probs0", np.full((3, 2), 1 / 6), ModelError, r"probs0 has shape \(3, 2\)"),
        ("probs0", np.full((2, 3), 0.25), ModelError, r"probs0 must be probabilities that sum to 1.*a sum is 1\.5"),
        ("probs0", [[-0.5, 0.5, 0], [0.5, 0.5, 0]], ModelError, r"probs0 holds -0\.5; a probability is at least 0"),
        ("trans", list(np.eye(2)), ModelError, r"trans\[0\] has shape \(2,\); a transition matrix is square"),
        ("trans", [np.ones((2, 3)) / 3, np.eye(3)], ModelError, r"trans\[0\] has shape \(2, 3\)"),
        ("trans", [np.eye(2), np.zeros((0, 0))], ModelError, r"trans\[1\] has shape \(0, 0\)"),
        ("trans", [np.stack([np.eye(2)] * 3), np.eye(3)], ModelError, r"trans\[0\] has shape.*time varying"),
        (
            "trans",
            [np.eye(2), [[1.0, 0, 0], [0, 1, 0], [0.4, 0.1, 0.47]]],
            ModelError,
            r"trans\[1\] rows must be probabilities that sum to 1: row 2 sums to 0\.97\..*\*from\* each state",
        ),
        ("trans", [[[1.5, -0.5], [0, 1]], np.eye(3)], ModelError, r"trans\[0\]\[0, 0, 1\] is -0\.5; a probability"),
        ("Q", ASYMMETRIC[None, None], ModelError, r"Q is not symmetric at index \[.*0, 1\]"),
        ("Q", INDEFINITE[None, None], ModelError, "Q is not positive semidefinite.*never factors"),
        ("R", [[[[-1.0]]]], ModelError, "R is not positive semidefinite"),
        ("cov0", INDEFINITE, ModelError, "cov0 is not positive semidefinite"),
    ],
)
def test_message_says_what_is_wrong_where_and_how_to_mend_it(name, value, kind, message):
    with pytest.raises(kind, match=f"(?s){message}"):
        align(**{**GOOD, name: value})


def test_rows_to_keep_are_checked():
    bare = inspect.unwrap(imm_filter)  # without the tests' type checks, as users call it
    with pytest.raises(ModelError, match='keep is "all" or "last"'):
        bare(**GOOD, keep="first")


def test_no_covariance_is_refused_for_its_rank(rng):
    """Nearly singular first pivots let rounding grow: the error of the next is that of the first over its size."""
    for n in range(2, 10):
        for _ in range(20):
            cov = spread_cov(rng, (2000,), n, full=0.3)
            assert covariances("Q", cov).shape == cov.shape


def test_indefinite_by_one_part_in_a_hundred_thousand(rng):
    cov = spread_cov(rng, (2000,), 5, full=0.0)
    unit = np.sqrt(np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 1e-300))
    worse = cov / unit[..., None] / unit[..., None, :] - 1e-5 * np.eye(5) * (unit > 1e-100)[..., None]
    for one in worse[np.linalg.eigvalsh(worse)[:, 0] < -5e-6][:200]:
        with pytest.raises(ModelError, match="not positive semidefinite"):
            covariances("Q", one)


def test_an_indefinite_matrix_among_many_is_found():
    many = np.broadcast_to(np.eye(2), (5000, 1, 1, 2, 2)).copy()
    many[4321, 0, 0] = INDEFINITE
    with pytest.raises(ModelError, match=r"Q is not positive semidefinite at index \[4321, 0, 0\]"):
        align(**{**GOOD, "z": np.zeros((5000, 1)), "Q": many})


@pytest.mark.parametrize(
    ("shape", "full"),
    [
        ((1, 1, 2, 2), (1, 1, 1, 1, 2, 2)),
        ((2, 1, 2, 2), (1, 1, 2, 1, 2, 2)),
        ((4, 1, 3, 2, 2), (1, 4, 1, 3, 2, 2)),
        ((5, 1, 1, 1, 2, 2), (5, 1, 1, 1, 2, 2)),
    ],
)
def test_shapes_are_read_from_the_right(shape, full):
    F = np.arange(np.prod(shape), dtype=float).reshape(shape)
    aligned = align(**{**GOOD, "z": np.zeros((5, 4, 1)), "F": F})
    assert aligned.F.shape == full
    np.testing.assert_array_equal(aligned.F.ravel(), F.ravel())


def test_canonical_arrays():
    z = np.array([[[1.0, np.nan]], [[np.nan, np.nan]]])
    p = {**GOOD, "z": z, "H": np.ones((1, 1, 2, 2)), "R": np.eye(2)[None, None]}
    aligned = align(**p)
    np.testing.assert_array_equal(aligned.seen, ~np.isnan(z))
    np.testing.assert_array_equal(aligned.z, [[[1.0, 0.0]], [[0.0, 0.0]]])
    assert aligned.sizes == (2, 3) and aligned.log_probs0.shape == (1, 2, 3)
    assert aligned.trans[0].shape == (1, 1, 2, 2)
    assert aligned.trans[1] is None  # a chain that cannot switch
    assert np.isnan(z).sum() == 3  # the argument is left alone


def test_time_varying_identity_is_skipped_only_when_it_always_holds():
    eye = np.stack([np.eye(2)] * 4)
    assert align(**{**GOOD, "trans": [eye, np.eye(3)]}).trans[0] is None
    eye[2] = [[0.9, 0.1], [0.0, 1.0]]
    assert align(**{**GOOD, "trans": [eye, np.eye(3)]}).trans[0] is not None


def test_integers_and_lists_are_read_as_floats():
    p = {k: np.asarray(v).tolist() if k != "trans" else v for k, v in GOOD.items() if v is not None}
    aligned = align(**{**p, "F": [[[[1, 1], [0, 1]]]], "b": None, "d": None})
    assert aligned.F.dtype == np.float64
    np.testing.assert_array_equal(aligned.F[0, 0, 0], [[1.0, 1.0], [0.0, 1.0]])


def test_rounding_in_transition_rows_does_not_grow_over_empty_rows():
    trans = np.array([[0.9, 0.1], [0.2, 0.8]]) * (1 + 9e-7)
    est = imm_filter(**{**GOOD, "z": np.full((100, 1), np.nan), "trans": [trans, np.eye(3)]})
    assert np.abs(est.probs.sum((-1, -2)) - 1.0).max() < 1e-12


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("F", [np.eye(2), np.eye(3)]),
        ("H", [[1.0, 0.0], [1.0, 0.0, 0.0]]),
        ("mean0", [[0.0, 1.0], [0.0]]),
        ("z", [[0.0], [0.0, 1.0]]),
        ("R", [[[1.0]], [[1.0, 0.0], [0.0, 1.0]]]),
    ],
)
def test_modes_of_different_size_are_told_how_to_agree(name, value):
    with pytest.raises(ModelError, match=rf"{name} is not one array.*All modes have one state vector.*zeros in H"):
        inspect.unwrap(align)(**{**GOOD, name: value})
    with pytest.raises(ModelError, match=f"{name} is not an array of numbers"):
        inspect.unwrap(align)(**{**GOOD, name: "x"})
