"""Exact enumeration of mode sequences, and the rules that merge them."""

import numpy as np
import pytest
from test_imm_cases import fusion_case, imm_case

from oracles import enumerate_modes, error, flat_model, is_psd
from saltus import IMM, Chain, ExactFilter, Gaussian, HybridModel, ModelError, PositionSensor, constant_velocity
from saltus.filters import exact_filter, imm_filter
from saltus.filters.histories import EXACT, GPB1, GPB2, INTERACTING, MergingRule
from saltus.simulate import simulate_hybrid


def problem(rng, n_steps=4, batch=(), sizes=(2, 2), n=2, m=2, per_mode_prior=True, missing=True):
    """A model whose matrices depend on different chains, with b, d and a hole in the data."""
    C = len(sizes)
    a, b = (*sizes[:1], *(1,) * (C - 1)), (*(1,) * (C - 1), *sizes[-1:])

    def spd(*lead, k=n, low=0.1):
        root = rng.normal(size=(*lead, k, k))
        return root @ root.swapaxes(-1, -2) + low * np.eye(k)

    z = 2 * rng.normal(size=(*batch, n_steps, m))
    if missing:
        z[..., 1, :] = np.nan
        z[..., 2, 0] = np.nan
    weights = rng.uniform(0.2, 1, size=sizes)
    return {
        "z": z,
        "F": np.eye(n) + 0.3 * rng.normal(size=(*a, n, n)),
        "Q": spd(*a),
        "H": rng.normal(size=(*b, m, n)),
        "R": spd(*b, k=m),
        "b": rng.normal(size=(*a, n)),
        "d": rng.normal(size=(*b, m)),
        "trans": [t / t.sum(-1, keepdims=True) for t in (rng.uniform(0.1, 1, size=(s, s)) for s in sizes)],
        "mean0": rng.normal(size=(*sizes, n) if per_mode_prior else n),
        "cov0": spd(*sizes) if per_mode_prior else spd(),
        "probs0": weights / weights.sum(),
    }


def agree(actual, expected, tolerance=1e-10):
    for name in ("probs", "mean", "cov", "log_likelihood"):
        assert error(getattr(actual, name), getattr(expected, name)) < tolerance, name


def test_reference_case_with_two_modes(cases):
    d = cases("exact_M2")
    est = exact_filter(**imm_case(d))
    assert error(est.probs, d["exact_P"]) < 1e-10
    assert error(est.mean, d["exact_x"]) < 1e-10
    assert error(est.cov, d["exact_C"]) < 1e-10
    assert error(est.log_likelihood, d["exact_loglik"]) < 1e-10
    assert (est.error == 0.0).all()


def test_reference_case_with_chains_that_cannot_switch(cases):
    d = cases("exact_frozen_chain_222")  # 20 rows: 8^20 sequences, of which 8 are possible
    est = exact_filter(**fusion_case(d))
    assert error(est.probs.reshape(len(est.probs), -1), d["exact_P"]) < 1e-10
    assert error(est.mean, d["exact_x"]) < 1e-10
    assert error(est.cov, d["exact_C"]) < 1e-10
    assert error(est.log_likelihood, d["exact_loglik"]) < 1e-10


@pytest.mark.parametrize("per_mode_prior", [True, False])
def test_agrees_with_a_dense_gaussian_for_every_sequence(rng, per_mode_prior):
    p = problem(rng, n_steps=3, per_mode_prior=per_mode_prior)
    est = exact_filter(**p)
    expected = enumerate_modes(flat_model(p))
    assert error(est.probs.reshape(3, 4), expected.probs) < 1e-10
    assert error(est.mean, expected.mean) < 1e-10
    assert error(est.cov, expected.cov) < 1e-10
    assert error(est.log_likelihood, expected.log_likelihood) < 1e-10


@pytest.mark.parametrize("name", ["imm_M2_n3", "fusion_m222", "fusion_m222_missing", "fusion_m222_outlier"])
def test_imm_is_a_rule_of_the_exact_filter(cases, name):
    d = cases(name)
    p = imm_case(d) if name.startswith("imm") else fusion_case(d)
    ours = exact_filter(**p, rule=INTERACTING, per_mode=True)
    imm = imm_filter(**p, per_mode=True, backend="numpy")
    agree(ours, imm, 1e-8)  # the cases' own tolerance; rounding grows over 60 rows
    for field in ("mode_means", "mode_covs", "nis", "n_observed"):
        assert error(getattr(ours, field), getattr(imm, field)) < 1e-8, field


def test_batch_rows_are_single_runs_and_matrices_may_differ_by_run(rng):
    p = problem(rng, batch=(2, 3))
    p["R"] = p["R"] * np.arange(1.0, 4.0).reshape(3, *(1,) * 5)
    for rule in (EXACT, GPB2, MergingRule(most=5), MergingRule(last=2, before=True, most=9)):
        whole = exact_filter(**p, rule=rule)
        one = exact_filter(**{**p, "z": p["z"][1, 2], "R": p["R"][2, 0]}, rule=rule)
        for name in ("probs", "mean", "cov", "log_likelihood", "error"):
            assert np.allclose(getattr(whole, name)[1, 2], getattr(one, name), rtol=1e-10, atol=1e-12)


def test_rules_are_points_on_one_scale(rng):
    """Deeper rules come closer, on average over data; a rule that reaches back to the start is exact."""
    p = problem(rng, n_steps=5, batch=(200,), sizes=(2,), missing=False)
    p["trans"] = [np.array([[0.9, 0.1], [0.2, 0.8]])]
    exact = exact_filter(**p)

    def off(rule):
        est = exact_filter(**p, rule=rule)
        return np.square(est.mean - exact.mean)[:, -1].sum(-1).mean()

    gpb1, imm, gpb2, gpb3 = off(GPB1), off(INTERACTING), off(GPB2), off(MergingRule(last=2))
    assert gpb1 > imm > gpb2 > gpb3 > 0
    # From two modes on, merging before or after is the same: given j, the next mode says nothing of those before j.
    agree(exact_filter(**p, rule=MergingRule(last=2, before=True)), exact_filter(**p, rule=GPB2))
    agree(exact_filter(**p, rule=MergingRule(last=3, before=True)), exact_filter(**p, rule=MergingRule(last=2)))
    agree(exact_filter(**p, rule=MergingRule(last=5)), exact)
    agree(exact_filter(**p, rule=MergingRule(last=6, before=True)), exact)


def test_keeping_enough_histories_is_exact_and_fewer_are_further_off(rng):
    p = problem(rng, n_steps=6, batch=(20,), sizes=(2,))
    exact = exact_filter(**p)
    agree(exact_filter(**p, rule=MergingRule(most=128)), exact)
    worst = [np.abs(exact_filter(**p, rule=MergingRule(most=k)).mean - exact.mean).max() for k in (32, 8, 2)]
    assert 0 < worst[0] < worst[1] < worst[2]


@pytest.mark.parametrize("rule", [GPB1, GPB2, INTERACTING, MergingRule(most=4), MergingRule(last=2, most=3)])
def test_error_bounds_the_distance_of_the_mean(rng, rule):
    """In posterior standard deviations, on data of the model: nats are lost in the mean over data, and the law of the
    distance is taken for Gaussian, so a few rows may lie beyond."""
    p = problem(rng, n_steps=6, sizes=(2,))
    p["trans"] = [np.array([[0.9, 0.1], [0.2, 0.8]])]
    model = {name: value for name, value in p.items() if name != "z"}
    p["z"] = simulate_hybrid(**model, n_steps=6, rng=rng, batch=200).z
    exact, est = exact_filter(**p), exact_filter(**p, rule=rule)
    gap = (est.mean - exact.mean)[..., None]
    distance = np.sqrt((gap.swapaxes(-1, -2) @ np.linalg.solve(exact.cov, gap))[..., 0, 0])
    assert np.mean(distance > est.error + 1e-9) < 0.05
    assert est.error[:, -1].max() > 0 and (np.diff(est.error, axis=1) >= 0).all()


@pytest.mark.parametrize("rule", [EXACT, GPB1, GPB2, MergingRule(most=3)])
def test_laws_and_covariances_stay_what_they_are(rng, rule):
    est = exact_filter(**problem(rng, n_steps=5, batch=(8,)), rule=rule, per_mode=True)
    assert np.allclose(est.probs.sum((-1, -2)), 1.0)
    assert is_psd(est.cov) and is_psd(est.mode_covs)
    assert (est.probs >= 0).all() and np.isfinite(est.mode_means).all()


def test_one_mode_is_the_kalman_filter(rng):
    p = {**problem(rng, n_steps=8, sizes=(1,)), "trans": []}
    p = {k: v[0] if k in ("F", "Q", "H", "R", "b", "d", "mean0", "cov0", "probs0") else v for k, v in p.items()}
    agree(exact_filter(**p), imm_filter(**p, backend="numpy"))


def test_too_many_histories_say_what_to_do(rng):
    p = problem(rng, n_steps=30)
    with pytest.raises(ModelError, match="Keep the most probable ones"):
        exact_filter(**p)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"last": -1}, "number of modes from 0"),
        ({"last": 0, "before": True}, "agree at least in their newest mode"),
        ({"before": True}, "which histories"),
        ({"most": 0}, "at least 1 history"),
    ],
)
def test_rules_that_cannot_be(settings, message):
    with pytest.raises(ModelError, match=message):
        MergingRule(**settings)


@pytest.fixture
def model():
    turn = Chain("manoeuvre", {"cruise": 0.3, "turn": 8.0}, sojourn={"cruise": 120.0, "turn": 20.0})
    return HybridModel(
        chains=[turn],
        dynamics=constant_velocity(1, accel=lambda manoeuvre: manoeuvre),
        sensors={"a": PositionSensor(1, sigma=30.0), "b": PositionSensor(1, sigma=60.0)},
        prior=Gaussian([0.0, 100.0], np.diag([1e4, 1e4])),
    )


def test_records_of_a_model(model):
    records = [(t, name, [100.0 * t + bump]) for t, name, bump in [(0, "a", 5), (3, "b", -20), (8, "a", 90)]]
    exact = ExactFilter()(model).run(records)
    assert exact.chains == ("manoeuvre",) and (exact.times == [0, 3, 8]).all()
    imm = IMM(model).run(records)
    assert error(ExactFilter(INTERACTING)(model).run(records).mean, imm.mean) < 1e-10
    assert np.abs(exact.prob("manoeuvre") - imm.prob("manoeuvre")).max() < 0.2
    with pytest.raises(ModelError, match="bound to no model"):
        ExactFilter().run(records)
