"""Every size of state and measurement once, under every instruction set: what the sanitizers run over."""

import numpy as np
import pytest
from twins import assert_covariances

from saltus.filters import Bank, Belief, coloured_filter, imm_filter
from saltus.filters.particles import Tables
from strategies import law, random_coloured, random_cov, random_problem, random_trans

STATES, MEASURED = range(1, 10), (1, 2, 3, 4, 6)
RUNS = 9  # one more than the widest register holds


def close(actual, expected, bound=1e-8):
    """A few steps of well-conditioned models, m > n among them: S of condition 1e4 at most, mostly 1e2."""
    np.testing.assert_allclose(actual, expected, rtol=bound, atol=bound)


@pytest.mark.parametrize("n", STATES)
@pytest.mark.parametrize("m", MEASURED)
def test_the_batch_filter(n, m, isa, using, rng):
    p = random_problem(rng, ((2,), (3, 2), ())[n % 3], n, m, 4, (RUNS,), missing=0.2)
    p["F"] = np.eye(n) + 0.3 / n * rng.normal(size=p["F"].shape)
    with using(isa):
        native = imm_filter(**p, backend="native", per_mode=True)
    numpy = imm_filter(**p, backend="numpy", per_mode=True)
    for part in ("probs", "mean", "cov", "log_likelihood", "nis", "mode_means", "mode_covs"):
        close(getattr(native, part), getattr(numpy, part))
    assert_covariances(native.mode_covs)


@pytest.mark.parametrize("n", STATES)
@pytest.mark.parametrize("m", (1, 2, 3, 4))
def test_coloured_noise(n, m, isa, using, rng):
    p = random_coloured(rng, (2,), n, m, 4, (RUNS,), missing=(0.0, 0.2)[n % 2])
    p["F"] = -0.4 * np.eye(n) + 0.4 / n * rng.normal(size=p["F"].shape)
    with using(isa):
        native = coloured_filter(**p, backend="native")
    numpy = coloured_filter(**p, backend="numpy")
    for part in ("probs", "mean", "cov", "log_likelihood"):
        close(getattr(native, part), getattr(numpy, part))


@pytest.mark.parametrize("n", STATES)
@pytest.mark.parametrize("m", MEASURED)
def test_a_bank(n, m, isa, using, rng):
    sizes, k = ((2,), (), (3,))[n % 3], RUNS
    with using(isa):
        native = Bank(n, sizes, capacity=1, backend="native")
    numpy = Bank(n, sizes, capacity=1, backend="numpy")
    probs = law(rng, (k,), int(np.prod(sizes))).reshape(k, *sizes)
    start = Belief(np.log(probs), rng.normal(size=(k, *sizes, n)), random_cov(rng, (k, *sizes), n))
    lead, trans = (k, *(1,) * len(sizes)), [random_trans(rng, s) for s in sizes]
    F, Q = np.eye(n) + 0.1 * rng.normal(size=(*lead, n, n)), random_cov(rng, lead, n)
    z, H, R = rng.normal(size=(k, m)), rng.normal(size=(*lead, m, n)), random_cov(rng, lead, m)
    z[rng.random(z.shape) < 0.2] = np.nan
    for bank in (native, numpy):
        rows = bank.add(start)
        bank.step(rows[1:], trans, F[1:], None, Q[1:])  # not from the first of a block
    for way in ("score", "update"):
        told = [getattr(bank, way)(rows, z, H, None, R) for bank in (native, numpy)]
        close(*map(np.array, told))
    for bank in (native, numpy):
        bank.merge(rows[:3], bank.take(rows), np.array([0, 2, 3, k]), np.log(np.full(k, 0.25)))
    for mine, definition in zip(native.read(rows), numpy.read(rows), strict=True):
        close(mine, definition)


@pytest.mark.parametrize("n", STATES)
@pytest.mark.parametrize("m", MEASURED)
def test_particles(n, m, isa, using, rng):
    n_modes, k = 3, 2 * RUNS
    with using(isa):
        native = Bank(n, (), capacity=0, backend="native")
    numpy = Bank(n, (), capacity=0, backend="numpy")
    start = Belief(np.zeros(k), rng.normal(size=(k, n)), random_cov(rng, (k,), n))
    F, Q = np.eye(n) + 0.1 * rng.normal(size=(n_modes, n, n)), random_cov(rng, (n_modes,), n)
    t = Tables(F, None, Q, rng.normal(size=(1, m, n)), None, random_cov(rng, (n_modes,), m))
    now, z, trans = rng.integers(0, n_modes, k), rng.normal(size=(k, m)), random_trans(rng, n_modes)
    rows = native.add(start)
    assert (rows == numpy.add(start)).all()
    for mine, definition in zip(
        native.expand(rows, now, trans, z, t), numpy.expand(rows, now, trans, z, t), strict=True
    ):
        close(mine, definition)
    weights = law(rng, (), k)
    for mine, definition in zip(
        native.merged(rows, weights, now, n_modes), numpy.merged(rows, weights, now, n_modes), strict=True
    ):
        close(mine, definition)
