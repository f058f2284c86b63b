"""The history a filter returns."""

import numpy as np
import pytest

from oracles import error
from saltus.errors import ModelError
from saltus.filters import Estimates
from strategies import law


def estimates(rng, rows=(5, 4), sizes=(2, 3, 2), chains=("a", "b", "c")):
    probs = law(rng, rows, int(np.prod(sizes))).reshape(*rows, *sizes)
    ones = np.ones(rows)
    return Estimates(
        probs, np.zeros((*rows, 2)), np.zeros((*rows, 2, 2)), ones, np.zeros(rows[:-1]), ones, ones, chains=chains
    )


def test_marginal_of_a_chain_by_name_and_by_position(rng):
    est = estimates(rng)
    for i, (name, sum_over) in enumerate({"a": "btijk->bti", "b": "btijk->btj", "c": "btijk->btk"}.items()):
        expected = np.einsum(sum_over, est.probs)
        assert error(est.prob(name), expected) < 1e-14
        assert error(est.prob(i), expected) < 1e-14


def test_unknown_chain(rng):
    est = estimates(rng)
    with pytest.raises(ModelError, match="no chain named 'd'; the chains are a, b, c"):
        est.prob("d")
    for index in (-1, 3):
        with pytest.raises(ModelError, match=f"chain {index} does not exist: there are 3"):
            est.prob(index)
    with pytest.raises(ModelError, match="the chains are unnamed"):
        estimates(rng, chains=()).prob("a")
    with pytest.raises(ModelError, match="there are 0"):
        estimates(rng, sizes=(), chains=()).prob(0)
