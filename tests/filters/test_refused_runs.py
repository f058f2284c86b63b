"""Some runs of a batch are refused: the error says which, and the others' answers are one call away."""

import numpy as np
import pytest
from test_outliers import BACKENDS, COLOURED, ONE, WHITE

from saltus import DataError, NumericalError, imm_filter
from saltus.filters import Bank, Belief, coloured_filter, exact_filter


def sound(run, z):
    """What the documentation says: leave out what is refused until nothing is. The runs left, and their answer."""
    left = np.arange(len(z))
    while True:
        try:
            return left, run(z[left])
        except (DataError, NumericalError) as error:
            assert error.runs is not None and error.runs.shape == left.shape and error.runs.any()
            left = left[~error.runs]


FILTERS = {f"imm {b}": lambda z, b=b: imm_filter(z, **WHITE, backend=b) for b in BACKENDS}
FILTERS |= {f"coloured {b}": lambda z, b=b: coloured_filter(z, **COLOURED, backend=b) for b in BACKENDS}
FILTERS["exact"] = lambda z: exact_filter(z, **WHITE)


@pytest.mark.parametrize("name", FILTERS)
def test_the_others_are_answered_as_if_alone(name, rng):
    z = rng.normal(size=(7, 4, 1))
    z[2, 1], z[5, 3], z[6, 1] = 1e200, -1e180, 1e300
    left, est = sound(FILTERS[name], z)
    assert left.tolist() == [0, 1, 3, 4]
    alone = FILTERS[name](z[3:4])
    np.testing.assert_allclose(est.mean[2], alone.mean[0], rtol=1e-12)


@pytest.mark.parametrize("backend", BACKENDS)
def test_runs_on_several_axes_are_counted_in_the_order_of_the_array(backend):
    z = np.zeros((2, 3, 4, 1))
    z[0, 2, 1] = z[1, 1, 1] = 1e200
    with pytest.raises(DataError) as told:
        imm_filter(z, **WHITE, backend=backend)
    assert told.value.runs.tolist() == [False, False, True, False, True, False]
    assert np.isfinite(imm_filter(z.reshape(-1, 4, 1)[~told.value.runs], **WHITE, backend=backend).mean).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_of_every_kind(backend):
    model = {**WHITE, "R": np.array([0.0, 1.0])[:, None, None, None, None], "Q": 0.0 * ONE, "cov0": [[0.0]]}
    with pytest.raises(NumericalError, match="not positive definite") as told:
        imm_filter(np.zeros((2, 3, 1)), **model, backend=backend)
    assert told.value.runs.tolist() == [True, False]
    model = {**WHITE, "F": np.array([1.0, 1e80])[:, None, None, None, None]}
    with pytest.raises(NumericalError, match="not finite") as told:
        imm_filter(np.full((2, 4, 1), np.nan), **model, backend=backend)
    assert told.value.runs.tolist() == [False, True]


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_run_alone_is_no_batch(backend):
    with pytest.raises(DataError) as told:
        imm_filter([[1e200]], **WHITE, backend=backend)
    assert told.value.runs is None


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_bank_names_rows(backend):
    bank = Bank(1, (), backend=backend)
    rows = bank.add(Belief(np.zeros(3), np.zeros((3, 1)), np.ones((3, 1, 1))))
    with pytest.raises(DataError, match="run 1") as told:
        bank.update(rows, np.array([[0.0], [1e200], [0.0]]), ONE, None, ONE)
    assert told.value.runs.tolist() == [False, True, False]
