"""Particles in the compiled bank against their definition."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from saltus.errors import ModelError, NumericalError
from saltus.filters import Bank, Belief
from saltus.filters.particles import Tables
from strategies import law, random_cov, random_trans, rngs

some = settings(max_examples=25, deadline=None, derandomize=True)


def tables(rng, n_modes, n, m):
    def lead():
        return (int(rng.choice([1, n_modes])),)

    return Tables(
        np.eye(n) + 0.1 * rng.normal(size=(*lead(), n, n)),
        rng.normal(size=(*lead(), n)) if rng.random() < 0.5 else None,
        random_cov(rng, lead(), n),
        rng.normal(size=(*lead(), m, n)),
        rng.normal(size=(*lead(), m)) if rng.random() < 0.5 else None,
        random_cov(rng, lead(), m),
    )


def twins(rng, n, k, isa, using):
    with using(isa):
        native = Bank(n, (), capacity=0, backend="native")
    numpy = Bank(n, (), capacity=0, backend="numpy")
    start = Belief(np.zeros(k), rng.normal(size=(k, n)), random_cov(rng, (k,), n))
    return native, numpy, native.add(start), numpy.add(start)


def close(actual, expected):
    for a, e in zip(actual, expected, strict=True):
        np.testing.assert_allclose(a, e, rtol=1e-9, atol=1e-10)  # well-conditioned: round-off of a few steps


@some
@given(rng=rngs(), n=st.integers(1, 10), m=st.integers(1, 5), n_modes=st.integers(1, 9), k=st.integers(1, 40))
def test_particles_branch_move_and_merge(rng, n, m, n_modes, k, isa, using):
    native, numpy, mine, theirs = twins(rng, n, k, isa, using)
    t, trans = tables(rng, n_modes, n, m), random_trans(rng, n_modes, ())
    now = rng.integers(0, n_modes, k)
    z = 3.0 * rng.normal(size=(k, m))
    z[rng.random(z.shape) < 0.2] = np.nan
    order = rng.permutation(k)
    close(native.expand(mine[order], now, trans, z, t), numpy.expand(theirs[order], now, trans, z, t))
    mode = np.sort(rng.integers(0, n_modes, k)) if rng.random() < 0.5 else rng.integers(0, n_modes, k)
    for bank, rows in ((native, mine), (numpy, theirs)):
        bank.step(rows, [], t.F, t.b, t.Q, mode=mode)
    close(native.score(mine, z, t.H, t.d, t.R, mode=mode), numpy.score(theirs, z, t.H, t.d, t.R, mode=mode))
    close(native.update(mine, z, t.H, t.d, t.R, mode=mode), numpy.update(theirs, z, t.H, t.d, t.R, mode=mode))
    weights, labels = law(rng, (), k), rng.permutation(mode) if rng.random() < 0.5 else mode
    weights[rng.random(k) < 0.2] = 0.0
    close(native.merged(mine, weights, labels, 12), numpy.merged(theirs, weights, labels, 12))
    close(native.read(mine)[1:], numpy.read(theirs)[1:])


def test_an_outlier_flattens_nothing(rng, isa, using):
    native, numpy, mine, theirs = twins(rng, 3, 20, isa, using)
    t, trans = tables(rng, 4, 3, 2), random_trans(rng, 4, ())
    now, z = rng.integers(0, 4, 20), np.full((20, 2), 1e4)
    ours, definition = native.expand(mine, now, trans, z, t), numpy.expand(theirs, now, trans, z, t)
    np.testing.assert_allclose(ours[1], definition[1], rtol=1e-9)
    np.testing.assert_allclose(ours[0], definition[0], atol=1e-6)  # differences of 1e6 nats, each to 1e-9 relative


def test_wrong_arguments_say_so(rng, isa, using):
    native, _, rows, _ = twins(rng, 2, 5, isa, using)
    t, trans, z, now = tables(rng, 3, 2, 1), random_trans(rng, 3, ()), np.zeros((5, 1)), np.zeros(5, np.int64)
    with pytest.raises(ModelError, match="mode number is out of range"):
        native.expand(rows, now + 3, trans, z, t)
    with pytest.raises(ModelError, match="a row number is out of range"):
        native.step(rows, [], np.ones((3, 2, 2)), None, np.ones((1, 2, 2)), mode=now + 7)
    with pytest.raises(ModelError, match="a label is out of range"):
        native.merged(rows, np.ones(5), now + 2, 2)
    blind = t._replace(H=np.zeros((1, 1, 2)), R=np.zeros((1, 1, 1)))
    with pytest.raises(NumericalError, match="not positive definite"):
        native.expand(rows, now, trans, z, blind)
