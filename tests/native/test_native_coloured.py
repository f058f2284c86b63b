"""The compiled filters for coloured noise against their definitions, under every instruction set of the machine."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from twins import EPS, assert_covariances, assert_same, predictions

from oracles import error
from saltus import _native
from saltus.errors import DataError, ModelError, NumericalError
from saltus.filters import augmented_filter, coloured_filter
from saltus.filters.coloured import after_first, run_differenced
from saltus.filters.coloured_model import Augmented, augment
from saltus.linalg import block_diagonal
from saltus.models import discretise, second_order
from strategies import coloured_problems, law, random_coloured, random_cov, random_trans, rngs

some = settings(max_examples=30, deadline=None, derandomize=True)
WAYS = [coloured_filter, augmented_filter]
EVERY = (
    "probs",
    "mean",
    "cov",
    "log_likelihood",
    "log_likelihood_start",
    "nis",
    "n_observed",
    "mode_means",
    "mode_covs",
)


def described(p):
    """The augmented model of arguments of `coloured_filter`."""
    given = {k: v for k, v in p.items() if k not in ("z", "trans", "probs0", "R")}
    return augment(**given, n_steps=p["z"].shape[-2] - 1, n_chains=len(p["trans"]))


def scales(z, model, trans, probs0, R=None):
    """Per mode and row 1..K: standard deviations of the predicted state; the worst condition number of S."""
    sizes, n_steps, (m, n) = tuple(np.shape(t)[-1] for t in trans), z.shape[-2] - 1, model.H.shape
    modes, N = (1,) * len(sizes), model.F.shape[-1]

    def from_first(a, first, chain=False):
        """Put the first row before an array over intervals."""
        constant = np.ndim(first) + (0 if chain else len(sizes))
        later = np.broadcast_to(a, (n_steps, *np.shape(a)[np.ndim(a) - constant :]))
        return np.concatenate([np.broadcast_to(first, (1, *later.shape[1:])), later])

    problem = {
        "z": z,
        "F": from_first(model.F, np.eye(N)),
        "Q": from_first(model.Q, np.zeros((N, N))),
        "b": None if model.b is None else from_first(model.b, np.zeros(N)),
        "d": None,
        "H": np.concatenate([model.H, model.L], axis=-1).reshape(*modes, m, N),
        "R": np.zeros((*modes, m, m)) if R is None else R,
        "trans": [from_first(t, np.eye(s), chain=True) for t, s in zip(trans, sizes, strict=True)],
        "mean0": model.mean0,
        "cov0": model.cov0,
        "probs0": probs0,
    }  # fmt: skip
    sigma, condition = predictions(problem)
    return np.take(sigma, range(1, n_steps + 1), axis=z.ndim - 2)[..., :n], condition


def assert_twins(p, isa, using, way=coloured_filter, bound=None):
    """Deviations within 1e-10 + 1e3 eps cond(S), in units of the predicted standard deviations."""
    sigma, condition = scales(p["z"], described(p), p["trans"], p["probs0"], p.get("R"))
    if bound is None:
        bound = 1e-10 + 1e3 * EPS * condition
    expected = way(**p, backend="numpy", per_mode=True)
    with using(isa):
        actual = way(**p, backend="native", per_mode=True)
    assert_same(actual, expected, sigma, bound)
    np.testing.assert_allclose(actual.log_likelihood_start, expected.log_likelihood_start, rtol=bound, atol=bound)
    return actual


@pytest.mark.parametrize("way", WAYS)
@some
@given(p=coloured_problems())
def test_every_shape_of_argument(p, way, isa, using):
    assert_twins(p, isa, using, way)


def stable(p, rng, n):
    """Nineteen steps of a random motion in many dimensions would explode."""
    return {**p, "F": -0.4 * np.eye(n) + 0.4 / n * rng.normal(size=p["F"].shape)}


@some
@given(
    rng=rngs(),
    n=st.integers(1, 8),
    m=st.integers(1, 5),
    n_runs=st.integers(1, 19),
    n_steps=st.integers(1, 19),
    sizes=st.sampled_from([(), (2,), (3,), (2, 2), (1, 5), (2, 3, 2)]),
    missing=st.sampled_from([0.0, 0.01, 0.3]),
)
def test_every_size_unrolled_or_not(rng, n, m, n_runs, n_steps, sizes, missing, isa, using):
    assert_twins(stable(random_coloured(rng, sizes, n, m, n_steps, (n_runs,), missing), rng, n), isa, using)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(("n", "m"), [(10, 2), (3, 7)])
def test_sizes_that_are_not_unrolled(way, n, m, isa, using, rng):
    assert_twins(stable(random_coloured(rng, (2,), n, m, 6, (9,), 0.1), rng, n), isa, using, way)


@some
@given(rng=rngs(), n=st.integers(1, 4), m=st.integers(1, 3), sizes=st.sampled_from([(), (2,), (2, 2)]))
def test_a_white_part_by_augmentation(rng, n, m, sizes, isa, using):
    p = random_coloured(rng, sizes, n, m, 6, (5,))
    assert_twins({**p, "R": random_cov(rng, (1,) * len(sizes), m)}, isa, using, augmented_filter)


@some
@given(rng=rngs(), n=st.integers(1, 5), m=st.integers(1, 3), sizes=st.sampled_from([(), (2,), (2, 2)]))
def test_ill_conditioned_problems(rng, n, m, sizes, isa, using):
    p = stable(random_coloured(rng, sizes, n, m, 8, (9,), missing=0.1), rng, n)
    decades = 10.0 ** rng.uniform(-2, 2, size=(4, max(n, m)))
    p["G"] = p["G"] * decades[0, :n]
    p["noise_G"] = p["noise_G"] * decades[1, :m]
    p["cov0"] = p["cov0"] * decades[2, :n] * decades[2, :n, None]
    p["noise_cov0"] = p["noise_cov0"] * decades[3, :m] * decades[3, :m, None]
    est = assert_twins(p, isa, using)
    assert_covariances(est.mode_covs)
    assert_covariances(est.cov)


@some
@given(rng=rngs(), sizes=st.sampled_from([(2,), (3,), (2, 2)]), n=st.integers(1, 4))
def test_unreachable_modes(rng, sizes, n, isa, using):
    p = stable(random_coloured(rng, sizes, n, 2, 6, (5,)), rng, n)
    for c, size in enumerate(sizes):
        t = np.triu(rng.uniform(0.2, 1.0, size=(size, size)))  # no way back
        p["trans"][c] = t / t.sum(-1, keepdims=True)
    probs = rng.uniform(size=sizes) * (rng.uniform(size=sizes) < 0.5)
    probs.flat[-1] += 0.1
    assert_twins({**p, "probs0": probs / probs.sum()}, isa, using)


@some
@given(rng=rngs(), frozen=st.booleans())
def test_gross_outliers_leave_the_linear_range(rng, frozen, isa, using):
    # Log-likelihoods of -1e5 and their differences are known to 1e-11, and with them the probabilities of modes whose
    # means are a hundred standard deviations apart.
    p = stable(random_coloured(rng, (2, 2), 2, 2, 8, (11,), missing=0.1), rng, 2)
    if frozen:
        p["trans"] = [np.eye(2), np.eye(2)]
    p["z"][rng.uniform(size=p["z"].shape) < 0.1] *= 100.0
    assert_twins(p, isa, using, bound=1e-8)


def second_order_problem(rng, sizes=(2,), n_runs=9, n_steps=12, missing=0.1):
    """A drifting point in the plane seen with noise of second order: four states kept of six."""
    noise = second_order([2.0, 5.0], 3.0, dims=2, damping=0.6).bind([])
    motion = np.kron(np.eye(2), [[0.0, 1.0], [0.0, -0.2]]), np.kron(np.eye(2), [[0.0], [1.0]])
    levels = np.linspace(0.3, 2.0, sizes[0]).reshape(*sizes, 1, 1)
    F, Q = discretise(motion[0], levels * motion[1], 0.7)
    Phi, W = discretise(noise.F, noise.G, 0.7)
    model = Augmented(
        F=block_diagonal(F, Phi), Q=block_diagonal(Q, W), b=rng.normal(size=(*sizes, 8)),
        H=np.kron(np.eye(2), [1.0, 0.0]), L=noise.output, mean0=rng.normal(size=(*sizes, 8)),
        cov0=block_diagonal(random_cov(rng, sizes, 4), noise.cov0),
    )  # fmt: skip
    z = np.cumsum(rng.normal(size=(n_runs, n_steps + 1, 2)), axis=1)
    z[rng.random(z.shape) < missing] = np.nan
    return z, model, [random_trans(rng, s) for s in sizes], law(rng, (), sizes[0])


@pytest.mark.parametrize("missing", [0.0, 0.15])
def test_noise_of_second_order_and_known_inputs(missing, isa, using, rng):
    problem = second_order_problem(rng, missing=missing)
    sigma, condition = scales(*problem)
    expected = after_first(run_differenced(*problem, per_mode=True, backend="numpy"))
    with using(isa):
        actual = after_first(run_differenced(*problem, per_mode=True, backend="native"))
    assert actual.mean.shape == (9, 12, 4)
    assert_same(actual, expected, sigma, 1e-10 + 1e3 * EPS * condition)


@some
@given(rng=rngs(), n=st.integers(1, 3), m=st.integers(1, 2), timed=st.booleans(), missing=st.sampled_from([0.0, 0.2]))
def test_runs_that_move_each_in_its_own_way(rng, n, m, timed, missing, isa, using):
    p = random_coloured(rng, (2,), n, m, 5, (11,), missing, irregular=timed)
    model, lead = described(p), (11, 5 if timed else 1, 2)
    F, Q = (np.broadcast_to(a, (*lead, n + m, n + m)) for a in (model.F, model.Q))
    own = rng.uniform(0.5, 1.0, size=(11, 1, 1, 1, 1))
    model = model._replace(F=own * F, Q=own**2 * Q)
    settings = {"trans": p["trans"], "probs0": p["probs0"], "per_mode": True}
    expected = after_first(run_differenced(p["z"], model, **settings, backend="numpy"))
    with using(isa):
        actual = after_first(run_differenced(p["z"], model, **settings, backend="native"))
    for name in EVERY:
        assert error(getattr(actual, name), getattr(expected, name)) < 1e-9, name


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("threads", [2, 3, 16])
def test_results_do_not_depend_on_threads(threads, way, isa, using, rng):
    p = random_coloured(rng, (2, 2), 3, 2, 7, (203,), missing=0.02)
    with using(isa):
        one, many = (way(**p, backend="native", per_mode=True, num_threads=k) for k in (1, threads))
    for name in EVERY:
        np.testing.assert_array_equal(getattr(one, name), getattr(many, name), err_msg=name)


def test_complete_neighbours_change_nothing_and_gaps_of_neighbours_only_rounding(isa, using, rng):
    p = random_coloured(rng, (2,), 4, 2, 7, (21,), missing=0.0)
    z = p.pop("z")
    with using(isa):
        together = coloured_filter(z, **p, backend="native")
        gaps = z.copy()
        gaps[[1, 8, 19], 2:4] = np.nan
        with_gaps = coloured_filter(gaps, **p, backend="native")
        for run in (0, 7, 20):
            alone = coloured_filter(z[run], **p, backend="native")
            for name in ("probs", "mean", "cov", "log_likelihood"):
                np.testing.assert_array_equal(getattr(alone, name), getattr(together, name)[run])
                np.testing.assert_allclose(getattr(with_gaps, name)[run], getattr(alone, name), rtol=1e-10, atol=1e-12)


def test_a_gap_at_the_start_at_the_end_and_throughout(isa, using, rng):
    for rows in (slice(0, 1), slice(0, 3), slice(-1, None), slice(None)):
        p = random_coloured(rng, (2,), 3, 2, 6, (10,), missing=0.0)
        p["z"][:, rows] = np.nan
        assert_twins(p, isa, using)
        p["z"][3:, ..., 0] = np.nan  # one component never
        assert_twins(p, isa, using)


def test_what_it_is_given_is_checked(isa, using, rng):
    p = random_coloured(rng, (2,), 2, 1, 4, (3,), missing=0.0)
    for row in (0, 3):
        z = p["z"].copy()
        z[2, row] = np.inf
        with using(isa), pytest.raises(DataError, match=rf"z\[2, {row}, 0\] is infinite"):
            coloured_filter(**{**p, "z": z}, backend="native")
    twice = {**p, "dt": np.array([0.5, 0.0, 0.5, 0.5])}
    with using(isa), pytest.raises(NumericalError, match="Two samples at one time"):
        coloured_filter(**twice, backend="native")
    assert coloured_filter(**{**p, "z": np.zeros((0, 5, 1))}, backend="native").mean.shape == (0, 4, 2)


def test_more_than_the_kernel_holds():
    n = 256
    p = {
        "z": np.zeros((2, 1)), "F": -np.eye(n), "G": np.eye(n), "noise_F": [[-1.0]], "noise_G": [[1.0]], "dt": 1.0,
        "H": np.ones((1, n)), "trans": [], "mean0": np.zeros(n), "cov0": np.eye(n), "noise_cov0": np.eye(1),
        "probs0": 1.0,
    }  # fmt: skip
    with pytest.raises(ModelError, match='use backend="numpy"'):
        coloured_filter(**p, backend="native")
    assert coloured_filter(**p).mean.shape == (1, n)  # chosen automatically: the definition


def test_the_binding_itself_checks_the_map():
    model = {k: np.ones((1, 1, 2, 2)) for k in ("F",)} | {
        "Q": np.ones((1, 1, 2, 4)),
        "H": np.ones((1, 1, 1, 2)),
        "R": np.ones((1, 1, 1, 1)),
    }
    model |= {"n": 2, "sizes": [], "b": None, "d": None, "mean0": np.ones((1, 2)), "cov0": np.eye(2)[None]}
    model |= {"log_probs0": np.zeros(1), "trans": [], "reported": 1, "from_first": True, "map": np.eye(2)}
    out = {name: np.empty(2) for name in ("probs", "mean", "cov", "nis", "n_observed", "log_likelihood")}
    out |= {"mode_means": None, "mode_covs": None, "faults": np.zeros((1, 3), np.int64)}
    z = np.zeros((1, 2, 1))
    assert _native.imm_filter("", z, model, out, True, 1) == 0
    for wrong, message in (
        ({"from_first": False}, "prior at the first row"),
        ({"reported": 2}, "reported"),
        ({"reported": 0}, "reported"),
        ({"map": np.eye(3)}, "map has shape"),
        ({"F": np.ones((1, 2, 2, 2))}, "F has shape"),  # two intervals between two rows
    ):
        with pytest.raises(ModelError, match=message):
            _native.imm_filter("", z, {**model, **wrong}, out, True, 1)
    with pytest.raises(ModelError, match="no measurement after the first"):
        _native.imm_filter("", z[:, :1], model, out, True, 1)


def test_reference_cases_and_limits(other_isa, cases):
    suite = Path(__file__).parents[1] / "filters" / "test_coloured.py"
    chosen = "(reference_cases or correlation_time_to or ill_conditioned) and not numpy"
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", "-k", chosen, str(suite)],
        env={**os.environ, "SALTUS_ISA": other_isa, "SALTUS_REQUIRE_NATIVE": "1"},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stdout
