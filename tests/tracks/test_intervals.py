"""Matrices remembered are those computed afresh, in any order, and memory is bounded."""

import numpy as np

from saltus.models import Chain, constant_velocity
from saltus.tracks.intervals import Intervals

CHAIN = Chain("mode", {"calm": 0.1, "wild": 5.0}, sojourn={"calm": 60.0, "wild": 9.0})
ONLY = Chain("only", {"one": 1.0}, trans=[[1.0]])
MOTION = constant_velocity(2, accel=lambda mode: mode, kind="white").bind([CHAIN, ONLY])
STILL = constant_velocity(1, accel=0.1).bind([ONLY])


def assert_right(found, dt):
    found, still = found
    np.testing.assert_array_equal(still.Q, STILL.step(dt).Q)
    assert still.trans == [None]
    F, Q, _ = MOTION.step(dt)
    np.testing.assert_array_equal(found.F, F)
    np.testing.assert_array_equal(found.Q, Q)
    np.testing.assert_allclose(found.trans[0], CHAIN.transition(dt), rtol=1e-14)
    assert found.trans[1] is None


def test_they_are_those_computed_afresh(rng):
    table = Intervals([(MOTION, [CHAIN, ONLY], 0), (STILL, [ONLY], 0)])
    for _ in range(30):  # more than the first room, many of them met before
        dt = rng.integers(0, 200, rng.integers(0, 25)) / 128.0
        assert_right(table.at(dt), dt)


def test_it_forgets_rather_than_grows(rng):
    table = Intervals([(MOTION, [CHAIN, ONLY], 0), (STILL, [ONLY], 0)])
    for _ in range(70):
        dt = rng.uniform(0.0, 10.0, 100)  # no two alike
        assert_right(table.at(dt), dt)
    assert len(table) <= 4196


def test_more_at_once_than_is_worth_remembering(rng):
    table = Intervals([(MOTION, [CHAIN, ONLY], 0), (STILL, [ONLY], 0)])
    dt = rng.uniform(0.0, 10.0, 5000)
    assert_right(table.at(dt), dt)
    assert len(table) == 1


def test_further_states_have_rows_and_columns_of_zeros():
    (plain,), (wide,) = (Intervals([(MOTION, [CHAIN, ONLY], more)]).at(np.array([0.7, 2.0])) for more in (0, 3))
    n = plain.F.shape[-1]
    np.testing.assert_array_equal(wide.F[..., :n, :n], plain.F)
    np.testing.assert_array_equal(wide.Q[..., :n, :n], plain.Q)
    for matrix in (wide.F, wide.Q):
        assert matrix.shape[-2:] == (n + 3, n + 3)
        assert not matrix[..., n:, :].any() and not matrix[..., n:].any()
