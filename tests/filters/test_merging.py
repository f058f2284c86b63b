"""What mixing throws away: against the exact filter's own bound, and as a sign of the distance from its answer."""

import numpy as np
import pytest
from scipy.stats import spearmanr
from test_exact import problem

from saltus import IMM, Chain, Gaussian, HybridModel, PositionSensor, constant_velocity
from saltus.errors import ModelError
from saltus.filters import INTERACTING, MergingRule, exact_filter, imm_filter, merging
from saltus.filters.merging import lost_by_merging
from saltus.models import OK, Condition, FaultySensor, FunctionSensor
from saltus.simulate import simulate_hybrid


def priors(arrays):
    return {name: arrays[name] for name in ("trans", "mean0", "cov0", "probs0")}


@pytest.mark.parametrize("sizes", [(2,), (3, 2), (2, 2, 2)])
def test_it_is_what_the_rule_of_the_exact_filter_throws_away(rng, sizes):
    p = problem(rng, n_steps=5, batch=(3,), sizes=sizes)
    ours = lost_by_merging(imm_filter(**p, per_mode=True), **priors(p))
    theirs = exact_filter(**p, rule=INTERACTING)
    np.testing.assert_allclose(ours, theirs.lost, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(theirs.error, np.sqrt(2 * np.cumsum(theirs.lost, axis=-1)))
    if sizes == (2,):
        assert (exact_filter(**p).lost == 0).all()


def test_equal_modes_and_chains_that_stay_lose_nothing(rng):
    p = problem(rng, n_steps=5, batch=(2,), sizes=(2,))
    still = p | {"trans": [np.eye(2)]}
    assert np.abs(lost_by_merging(imm_filter(**still, per_mode=True), **priors(still))).max() < 1e-9
    equal = {name: p[name].mean(-3, keepdims=True) for name in ("F", "Q", "H", "R")}
    alike = p | equal | {name: p[name].mean(-2, keepdims=True) for name in ("b", "d") if p.get(name) is not None}
    alike |= {"mean0": np.zeros(p["F"].shape[-1]), "cov0": np.eye(p["F"].shape[-1])}
    assert np.abs(lost_by_merging(imm_filter(**alike, per_mode=True), **priors(alike))).max() < 1e-9


def test_what_is_known_exactly_counts_for_nothing():
    still = dict(
        F=[[[1.0, 0.0], [0.0, 1.0]]], Q=np.array([0.1, 4.0])[:, None, None] * np.diag([1.0, 0.0]), H=[[[1.0, 0]]]
    )
    still |= dict(R=[[[1.0]]], trans=[[[0.9, 0.1], [0.2, 0.8]]], probs0=[0.5, 0.5])
    one = {name: np.asarray(a)[..., :1, :1] for name, a in still.items() if name in "FQR"} | {"H": [[[1.0]]]}
    z = np.array([0.1, 0.3, 5.0, 5.5])[:, None]
    both = still | dict(mean0=[0.0, 3.0], cov0=np.diag([1.0, 0.0]))
    one = still | one | dict(mean0=[0.0], cov0=[[1.0]])
    lost = [lost_by_merging(imm_filter(z, **a, per_mode=True), **priors(a)) for a in (both, one)]
    np.testing.assert_allclose(*lost, rtol=1e-9)


TURN = Chain("turn", {"cruise": 0.3, "turn": 8.0}, sojourn={"cruise": 120.0, "turn": 20.0})
JAM = Chain("jam", {"ok": 30.0, "jammed": 300.0}, sojourn={"ok": 300.0, "jammed": 30.0})
BIAS = Chain("bias", {"ok": OK, "biased": Condition(bias=200.0)}, sojourn={"ok": 100.0, "biased": 30.0})
LEVEL = Chain("level", {"calm": 1.0, "rough": 3.0}, stay=0.7, per=4.0)
MOTION = constant_velocity(1, accel=lambda turn: turn)
PRIOR = Gaussian([0.0, 200.0], np.diag([1e4, 1e4]))


def described(chains, sensor, motion=MOTION):
    return HybridModel(chains, motion, {"s": sensor}, PRIOR)


def scalar(**changes):
    a = dict(F=[[[1.0]]], Q=[[[1.0]]], H=[[[1.0]]], R=[[[1.0]]], mean0=[0.0], cov0=[[1.0]], probs0=[0.5, 0.5])
    return a | changes


MODELS = {
    "turn": described([TURN], PositionSensor(1, 30.0)),
    "turn and jamming": described([TURN, JAM], PositionSensor(1, lambda jam: jam)),
    "turn and bias": described([TURN, BIAS], FaultySensor(PositionSensor(1, 30.0), ["bias"])),
    "levels of noise": described([LEVEL], PositionSensor(1, lambda level: 30 * level), constant_velocity(1, accel=1.0)),
    "outliers": scalar(R=[[[1.0]], [[100.0]]], trans=[[[0.9, 0.1], [0.9, 0.1]]], probs0=[0.9, 0.1]),
    "drift": scalar(b=[[-1.0], [1.0]], Q=[[[0.1]]], R=[[[4.0]]], trans=[[[0.95, 0.05], [0.05, 0.95]]]),
    "gain": scalar(H=[[[1.0]], [[-1.0]]], R=[[[0.5]]], trans=[[[0.9, 0.1], [0.3, 0.7]]], mean0=[3.0], cov0=[[4.0]]),
    "decay": scalar(F=[[[1.0]], [[0.5]]], R=[[[9.0]]], trans=[[[0.9, 0.1], [0.1, 0.9]]], mean0=[5.0], cov0=[[4.0]]),
}


def test_it_tells_how_far_the_multimode_filter_is_from_the_exact_answer(rng):
    """Over eight models whose distances differ by a factor of 20; rows of one model follow more loosely."""
    distance, lost, within, named = [], [], [], []
    for model in MODELS.values():
        a = model.compile(dt=4.0)._asdict() if isinstance(model, HybridModel) else model
        z = simulate_hybrid(**a, n_steps=25, batch=25, rng=rng).z
        est, exact = imm_filter(z, **a, per_mode=True), exact_filter(z, **a, rule=MergingRule(most=300))
        gap = (est.mean - exact.mean)[..., None]
        off = np.sqrt((gap.swapaxes(-1, -2) @ np.linalg.solve(exact.cov, gap))[..., 0, 0])
        told = lost_by_merging(est, **priors(a))
        recent = np.stack([told[:, : k + 1] @ 0.7 ** np.arange(k, -1, -1) for k in range(25)], axis=1)
        distance.append(off.mean())
        lost.append(told.mean() / est.mean.shape[-1])
        within.append(spearmanr(recent.ravel(), off.ravel())[0])
        named.append(bool(merging.findings(told, est.mean.shape[-1])))
    assert spearmanr(lost, distance)[0] > 0.7
    assert np.median(within) > 0.4 and min(within) > 0.1
    # The finding speaks where the mean is tenths of a standard deviation off, and not where it is hundredths.
    assert all(told for told, off in zip(named, distance, strict=True) if off > 0.15)
    assert not any(told for told, off in zip(named, distance, strict=True) if off < 0.08)


def test_records_of_a_described_model_are_told_of_it(rng):
    model, quiet = MODELS["turn and bias"], MODELS["levels of noise"]
    records, easy = (
        [
            (4.0 * k, "s", z)
            for k, z in enumerate(simulate_hybrid(**m.compile(dt=4.0)._asdict(), n_steps=40, rng=rng).z[0])
        ]
        for m in (model, quiet)
    )
    est = IMM(model).run(records)
    assert est.lost.shape == (40,) and est.mode_means is None and [f.kind for f in est.findings] == ["merging"]
    assert "optimality_gap" in est.findings[0].message and IMM(quiet).run(easy).findings == ()
    # Record by record, through a sensor that says nothing of being linear.
    hidden = described(
        [TURN, BIAS], FaultySensor(FunctionSensor(function=lambda x: x[..., :1], R=np.eye(1) * 900.0), ["bias"])
    )
    np.testing.assert_allclose(IMM(hidden).run(records).lost, est.lost, rtol=1e-6, atol=1e-9)


def test_a_long_record_goes_in_pieces(rng, monkeypatch):
    model = MODELS["turn and jamming"]
    records = [(4.0 * k + (k > 20), "s", [800.0 * k + 100 * rng.normal()]) for k in range(50)]
    whole = IMM(model).run(records)
    monkeypatch.setattr(merging, "_AT_ONCE", 7 * 4 * 4)
    pieces, kept = IMM(model).run(records), IMM(model, per_mode=True).run(records)
    np.testing.assert_allclose(pieces.lost, whole.lost, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(kept.lost, whole.lost, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(pieces.mean, whole.mean)
    assert kept.mode_means is not None and pieces.mode_means is None


def test_without_the_moments_of_the_modes(rng):
    p = problem(rng)
    with pytest.raises(ModelError, match="per_mode=True"):
        lost_by_merging(imm_filter(**p), **priors(p))
