"""What looks said stays within a bound, and what is kept is as it was."""

import numpy as np

from saltus.tracks.told import Told


def said(looks, most):
    told = Told(most)
    for k in range(looks):
        told.add(np.array([[0, 1], [0, 2 + k % 2]]), np.array([10.0 * k, 10.0 * k - 1.0]), np.array([0.5 * k, -k]))
    return told


def test_all_is_kept_below_the_bound():
    told = said(6, 12)
    e = told.evidence()
    assert told.every == 1 and e.pairs.tolist() == [[0, 1], [0, 2], [0, 3]]
    assert e.pair.tolist() == [0] * 6 + [1] * 3 + [2] * 3
    assert e.time[:6].tolist() == [0.0, 10.0, 20.0, 30.0, 40.0, 50.0] and e.llr[6:9].tolist() == [0.0, -2.0, -4.0]
    assert len(Told(3).evidence().pairs) == 0


def test_of_more_every_fourth_look_is_kept():
    told = said(21, 12)
    e = told.evidence()
    assert told.every == 4 and e.pairs.tolist() == [[0, 1], [0, 2]]
    assert e.time[e.pair == 0].tolist() == [0.0, 40.0, 80.0, 120.0, 160.0, 200.0]


def test_memory_is_bounded():
    told = said(5000, 64)
    assert 16 <= len(told.evidence().time) <= 64
