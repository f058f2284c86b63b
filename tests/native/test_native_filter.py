"""The compiled batch filter against its definition, under every instruction set of the machine."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from twins import EPS, assert_covariances, assert_same, predictions

from saltus.filters import imm_filter
from strategies import problems, random_problem, rngs

some = settings(max_examples=40, deadline=None, derandomize=True)


def assert_twins(p, isa, using, bound=None):
    """Deviations within 1e-10 + 1e3 eps cond(S), in units of the predicted standard deviations."""
    sigma, condition = predictions(p)
    if bound is None:
        bound = 1e-10 + 1e3 * EPS * condition
    expected = imm_filter(**p, backend="numpy", per_mode=True)
    with using(isa):
        actual = imm_filter(**p, backend="native", per_mode=True)
    assert_same(actual, expected, sigma, bound)
    return actual


@some
@given(p=problems(max_chains=3, max_modes=12, max_batch=2))
def test_every_shape_of_argument(p, isa, using):
    assert_twins(p, isa, using)


@some
@given(
    rng=rngs(),
    n=st.integers(1, 11),
    m=st.integers(1, 6),
    n_runs=st.integers(1, 19),
    n_steps=st.integers(1, 19),
    sizes=st.sampled_from([(), (2,), (3,), (2, 2), (1, 5), (2, 3, 2)]),
)
def test_every_size_unrolled_or_not(rng, n, m, n_runs, n_steps, sizes, isa, using):
    p = random_problem(rng, sizes, n, m, n_steps, (n_runs,))
    p["F"] = np.eye(n) + 0.3 / n * rng.normal(size=p["F"].shape)  # else 19 steps in 11 dimensions explode
    assert_twins(p, isa, using)


def spread_cov(rng, lead, n, decades):
    """Covariances whose axes differ by up to `decades` powers of ten in standard deviation."""
    axes = np.linalg.qr(rng.normal(size=(*lead, n, n)))[0]
    axes = axes * 10.0 ** rng.uniform(-decades / 2, decades / 2, size=(*lead, 1, n))
    return axes @ axes.swapaxes(-1, -2)


@some
@given(rng=rngs(), n=st.integers(1, 7), m=st.integers(1, 5), sizes=st.sampled_from([(), (2,), (2, 2), (3,)]))
def test_ill_conditioned_covariances(rng, n, m, sizes, isa, using):
    p = random_problem(rng, sizes, n, m, 5, (9,))
    p["cov0"] = spread_cov(rng, (), n, 5.0)
    p["Q"] = spread_cov(rng, sizes, n, 4.0)
    p["R"] = spread_cov(rng, sizes, m, 4.0)
    est = assert_twins(p, isa, using)
    assert_covariances(est.mode_covs)
    assert_covariances(est.cov)


def test_a_precise_measurement_of_a_vague_state_keeps_covariances(isa, using, rng):
    # Variances fall by 1e18 in one update: P - K H P alone would leave negative ones.
    n, m = 4, 2
    p = random_problem(rng, (2,), n, m, 3, (8,), missing=0.0)
    p.update(F=np.eye(n).reshape(1, n, n), Q=1e-9 * np.eye(n).reshape(1, n, n), cov0=1e9 * np.eye(n))
    p.update(H=np.eye(m, n).reshape(1, m, n), R=1e-9 * np.eye(m).reshape(1, m, m), b=None, d=None)
    with using(isa):
        est = imm_filter(**p, backend="native", per_mode=True)
    assert_covariances(est.mode_covs)
    np.testing.assert_allclose(np.diagonal(est.mode_covs[..., :m, :m], axis1=-2, axis2=-1).max(), 1e-9, rtol=1e-3)


@some
@given(rng=rngs(), sizes=st.sampled_from([(2,), (3,), (2, 2), (2, 3)]), n=st.integers(1, 4))
def test_unreachable_modes(rng, sizes, n, isa, using):
    p = random_problem(rng, sizes, n, 2, 6, (5,))
    for c, size in enumerate(sizes):
        t = np.triu(rng.uniform(0.2, 1.0, size=(size, size)))  # no way back
        p["trans"][c] = t / t.sum(-1, keepdims=True)
    probs = rng.uniform(size=sizes) * (rng.uniform(size=sizes) < 0.5)
    probs.flat[-1] += 0.1
    p["probs0"] = probs / probs.sum()
    assert_twins(p, isa, using)


@some
@given(rng=rngs(), sizes=st.sampled_from([(2,), (3,), (2, 2)]), frozen=st.booleans(), size=st.sampled_from([1e2, 1e4]))
def test_gross_outliers_leave_the_linear_range(rng, sizes, frozen, size, isa, using):
    # log-likelihoods of -1e8: their differences are known to 1e-8, and with them the probabilities.
    p = random_problem(rng, sizes, 2, 2, 8, (11,), missing=0.1)
    if frozen:
        p["trans"] = [np.eye(s) for s in sizes]
    p["z"][rng.uniform(size=p["z"].shape) < 0.1] *= size
    assert_twins(p, isa, using, bound=1e-7 if size > 1e3 else None)


@some
@given(rng=rngs(), n_runs=st.integers(1, 20), n_steps=st.integers(1, 20))
def test_last_row_alone_is_the_last_row_of_all(rng, n_runs, n_steps, isa, using):
    p = random_problem(rng, (2, 2), 3, 2, n_steps, (n_runs,))
    p["F"] = np.eye(3) + 0.1 * rng.normal(size=p["F"].shape)
    with using(isa):
        every = imm_filter(**p, backend="native", per_mode=True)
        last = imm_filter(**p, backend="native", per_mode=True, keep="last")
    np.testing.assert_array_equal(last.log_likelihood, every.log_likelihood)
    for name in ("probs", "mean", "cov", "nis", "n_observed", "mode_means", "mode_covs"):
        np.testing.assert_array_equal(getattr(last, name), getattr(every, name)[:, -1:], err_msg=name)


@pytest.mark.parametrize("threads", [2, 3, 16])
def test_results_do_not_depend_on_threads(threads, isa, using, rng):
    p = random_problem(rng, (2, 2), 4, 2, 7, (203,))
    with using(isa):
        one, many = (imm_filter(**p, backend="native", per_mode=True, num_threads=k) for k in (1, threads))
    for name in ("probs", "mean", "cov", "log_likelihood", "nis", "n_observed", "mode_means", "mode_covs"):
        np.testing.assert_array_equal(getattr(one, name), getattr(many, name), err_msg=name)


def test_results_do_not_depend_on_neighbours(isa, using, rng):
    # A run alone, whose block has one lane in use, and the same run among others.
    p = random_problem(rng, (2,), 4, 2, 7, ())
    z = p.pop("z") + rng.normal(size=(21, 7, 2))
    with using(isa):
        together = imm_filter(z, **p, backend="native")
        for run in (0, 7, 20):
            alone = imm_filter(z[run], **p, backend="native")
            np.testing.assert_array_equal(alone.mean, together.mean[run])
            np.testing.assert_array_equal(alone.cov, together.cov[run])
            np.testing.assert_array_equal(alone.log_likelihood, together.log_likelihood[run])


def test_a_forked_child_filters_on(rng):
    p = random_problem(rng, (2,), 3, 2, 5, (100,))
    before = imm_filter(**p, backend="native", num_threads=2)
    child = os.fork()
    if child == 0:
        after = imm_filter(**p, backend="native", num_threads=2)
        os._exit(0 if np.array_equal(before.mean, after.mean) else 1)
    assert os.waitpid(child, 0)[1] == 0


def test_reference_cases(other_isa, cases):
    suite = Path(__file__).parents[1] / "filters" / "test_imm_cases.py"
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(suite)],
        env={**os.environ, "SALTUS_ISA": other_isa, "SALTUS_REQUIRE_NATIVE": "1"},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stdout
