"""What the compiled filter does with arrays it should not get: an error or a copy, never a crash."""

import subprocess
import sys

import numpy as np
import pytest

from saltus import _native
from saltus.errors import DataError, ModelError, NumericalError
from saltus.filters import Bank, imm_filter
from saltus.filters.backend import system_report
from strategies import random_problem

ARRAYS = ("z", "F", "Q", "H", "R", "mean0", "cov0", "probs0")


@pytest.fixture
def problem(rng):
    p = random_problem(rng, (2, 3), 3, 2, 6, (7,))
    return {**p, "b": rng.normal(size=(1, 3, 3)), "d": rng.normal(size=(2, 1, 2))}


def same(p, q):
    a, b = imm_filter(**p, backend="native"), imm_filter(**q, backend="native")
    for name in ("probs", "mean", "cov", "log_likelihood"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-10, atol=1e-12)  # order of sums


def test_strides_order_and_read_only(problem):
    def reversed_twice(a):
        return np.ascontiguousarray(a[::-1])[::-1]

    def padded(a):
        wide = np.full((*a.shape, 3), np.nan)
        wide[..., 1] = a
        return wide[..., 1]

    def locked(a):
        a = a.copy()
        a.flags.writeable = False
        return a

    for awkward in (np.asfortranarray, reversed_twice, padded, locked):
        q = {k: awkward(v) if k in ARRAYS else v for k, v in problem.items()}
        same(problem, {**q, "trans": [awkward(t) for t in problem["trans"]]})


def test_other_types(problem):
    whole = {k: np.round(v) if k in ("F", "H", "mean0") else v for k, v in problem.items()}
    as_ints = {k: v.astype(np.int32) if k in ("F", "H", "mean0") else v for k, v in whole.items()}
    same(whole, as_ints)
    same(whole, {**whole, "F": whole["F"].tolist()})
    single = {**problem, "z": problem["z"].astype(np.float32)}
    same({**single, "z": single["z"].astype(np.float64)}, single)
    with pytest.raises(ModelError, match="F is not an array of numbers"):
        imm_filter(**{**problem, "F": problem["F"].astype(str).astype(object) + "x"}, backend="native")


def test_byte_order(problem):
    same(problem, {k: v.astype(">f8") if k in ARRAYS else v for k, v in problem.items()})


@pytest.mark.parametrize("name", ["F", "Q", "H", "R", "b", "d"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_in_a_large_per_run_model(name, bad, rng):
    # Such arrays are checked as the kernel loads them; the message is that of the definition.
    p = random_problem(rng, (2,), 3, 2, 50, (400,))
    core = {"F": (3, 3), "Q": (3, 3), "H": (2, 3), "R": (2, 2), "b": (3,), "d": (2,)}[name]
    p[name] = np.broadcast_to(np.eye(*core) if len(core) > 1 else np.ones(core), (400, 50, 2, *core)).copy()
    assert np.isfinite(imm_filter(**p, backend="native").mean).all()
    p[name][333, 44, 1, ..., 0] = bad
    with pytest.raises(DataError, match=rf"{name}\[333, 44, 1"):
        imm_filter(**p, backend="native")


def test_covariances_that_are_none_in_a_large_per_run_model(rng):
    p = random_problem(rng, (2,), 3, 2, 50, (400,))
    p["Q"] = np.broadcast_to(np.eye(3), (400, 50, 2, 3, 3)).copy()
    expected = imm_filter(**p, backend="native")
    nearly = p["Q"].copy()
    nearly[100, 3, 0, 0, 1] += 1e-13  # round-off of a caller's own product: made symmetric
    np.testing.assert_allclose(imm_filter(**{**p, "Q": nearly}, backend="native").mean, expected.mean, atol=1e-9)
    skew = p["Q"].copy()
    skew[399, 49, 1, 0, 2] = 0.5
    with pytest.raises(ModelError, match="Q is not symmetric"):
        imm_filter(**{**p, "Q": skew}, backend="native")
    p["Q"][5, 5, 0, 2, 2] = -1.0
    with pytest.raises(ModelError, match="Q is not positive semidefinite"):
        imm_filter(**p, backend="native")


def test_infinite_measurements_and_singular_innovations(problem):
    z = problem["z"].copy()
    z[3, 2, 1] = -np.inf
    with pytest.raises(DataError, match=r"z\[3, 2, 1\]"):
        imm_filter(**{**problem, "z": z}, backend="native")
    zero = {"Q": np.zeros((1, 1, 3, 3)), "R": np.zeros((1, 1, 2, 2)), "cov0": np.zeros((3, 3))}
    with pytest.raises(NumericalError, match="not positive definite"):
        imm_filter(**{**problem, **zero}, backend="native")


def test_more_than_the_kernel_holds():
    n = 257
    p = {
        "z": np.zeros((1, 1)),
        "F": np.eye(n),
        "Q": np.eye(n),
        "H": np.ones((1, n)),
        "R": np.eye(1),
        "trans": [],
        "mean0": np.zeros(n),
        "cov0": np.eye(n),
        "probs0": 1.0,
    }
    with pytest.raises(ModelError, match='use backend="numpy"'):
        imm_filter(**p, backend="native")
    assert imm_filter(**p).mean.shape == (1, n)  # chosen automatically: the definition
    assert Bank(n, ()).backend is None


def test_no_runs_at_all(problem):
    shared = {k: v for k, v in problem.items() if k not in ARRAYS}
    p = random_problem(np.random.default_rng(1), (2, 3), 3, 2, 6, ())
    est = imm_filter(**{**p, **shared, "b": None, "d": None, "z": np.zeros((0, 6, 2)), "trans": p["trans"]})
    assert est.mean.shape == (0, 6, 3) and est.probs.shape == (0, 6, 2, 3)


def test_arguments(problem, monkeypatch):
    with pytest.raises(ModelError, match="num_threads is at least 1"):
        imm_filter(**problem, backend="native", num_threads=0)
    monkeypatch.setenv("SALTUS_ISA", "vax")
    with pytest.raises(ModelError, match="SALTUS_ISA=vax is not available"):
        imm_filter(**problem, backend="native")


def test_the_binding_itself_checks_what_it_is_given(problem):
    model = {k: np.ones((1, 1, 1, 1)) for k in ("F", "Q", "H", "R")}
    model.update(n=1, sizes=[], b=None, d=None, mean0=np.ones((1, 1)), cov0=np.ones((1, 1, 1)))
    model.update(log_probs0=np.zeros(1), trans=[], reported=1, from_first=False, map=None)
    out = {name: np.empty(2) for name in ("probs", "mean", "cov", "nis", "n_observed", "log_likelihood")}
    out.update(mode_means=None, mode_covs=None, faults=np.zeros((1, 3), np.int64))
    z = np.zeros((1, 2, 1))
    assert _native.imm_filter("", z, model, out, True, 1) == 0
    with pytest.raises(ModelError, match="wrong size"):
        _native.imm_filter("", z, model, {**out, "cov": np.empty(1)}, True, 1)
    with pytest.raises(ModelError, match="H has shape"):
        _native.imm_filter("", z, {**model, "H": np.ones((1, 1, 2, 1))}, out, True, 1)
    with pytest.raises(ModelError, match="row number"):
        _native.imm_filter("", z, {**model, "F": (np.ones((2, 1, 1, 1)), np.array([7]))}, out, True, 1)
    with pytest.raises(ModelError, match="1 to 256"):
        _native.imm_filter("", z, {**model, "n": 0}, out, True, 1)
    with pytest.raises(TypeError):
        _native.imm_filter("", z.astype(str), model, out, True, 1)
    with pytest.raises(ModelError, match="no instruction set"):
        _native.imm_filter("vax", z, model, out, True, 1)


def test_the_report_names_the_instruction_set(isa, using):
    with using(isa):
        assert system_report()["instruction set"].startswith(isa)


ABSENT = """
import logging, sys
logging.basicConfig(level=logging.INFO, stream=sys.stdout)
sys.modules["saltus._native"] = None
import numpy as np
from saltus import imm_filter
from saltus.filters.backend import system_report
one = np.eye(1)
for _ in range(2):
    est = imm_filter(np.zeros((3, 1)), F=one, Q=one, H=one, R=one, trans=[], mean0=[0.0], cov0=one, probs0=1.0)
assert est.mean.shape == (3, 1)
print(system_report()["kernel"])
"""


def test_without_the_kernel_it_says_so_once_and_works(monkeypatch):
    monkeypatch.delenv("SALTUS_REQUIRE_NATIVE", raising=False)
    run = subprocess.run([sys.executable, "-c", ABSENT], capture_output=True, text=True, check=True)
    assert run.stdout.count("the compiled kernel is absent") == 1
    assert run.stdout.endswith("absent: filters run in NumPy\n")
    monkeypatch.setenv("SALTUS_REQUIRE_NATIVE", "1")
    run = subprocess.run([sys.executable, "-c", ABSENT], capture_output=True, text=True)
    assert run.returncode != 0 and "SALTUS_REQUIRE_NATIVE=1" in run.stderr
