"""Margins against enumeration; the assignment itself is tested where plots are given to tracks."""

from itertools import combinations

import numpy as np
import pytest

from saltus.identify.assignment import best_assignment, best_with_margins


def totals(row, col, gain):
    """Every set of pairs that uses each row and each column at most once, and its total gain."""
    for size in range(len(gain) + 1):
        for pairs in combinations(range(len(gain)), size):
            picked = list(pairs)
            if len(set(row[picked])) == size == len(set(col[picked])):
                yield set(pairs), gain[picked].sum()


@pytest.mark.parametrize("shape", [(1, 3), (2, 2), (3, 3)])
def test_margin_is_what_the_total_loses_without_the_pair(rng, shape):
    for _ in range(20):
        at = np.argwhere(rng.random(shape) < 0.8)
        at = at[rng.permutation(len(at))]
        gain = rng.normal(2.0, 3.0, len(at))
        every = list(totals(*at.T, gain))
        chosen, margin = best_with_margins(at[:, 0] + 5, at[:, 1] + 2, gain)
        assert sorted(chosen) == sorted(best_assignment(*at.T, gain))
        best = max(total for _, total in every)
        assert gain[chosen].sum() == pytest.approx(best, abs=1e-12)
        for pair, found in zip(chosen, margin, strict=True):
            without = max(total for pairs, total in every if pair not in pairs)
            assert found == pytest.approx(best - without, abs=1e-12)


def test_alone_the_margin_is_the_gain():
    chosen, margin = best_with_margins(np.array([0, 1, 2]), np.array([3, 4, 5]), np.array([2.0, -1.0, 7.0]))
    assert chosen.tolist() == [0, 2] and margin.tolist() == [2.0, 7.0]
    chosen, margin = best_with_margins(np.zeros(0, int), np.zeros(0, int), np.zeros(0))
    assert len(chosen) == len(margin) == 0
