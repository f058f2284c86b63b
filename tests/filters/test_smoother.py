"""The smoother against dense Gaussians, enumeration and stored cases."""

import numpy as np
import pytest
from hypothesis import given

from oracles import error, flat_model, is_psd, smooth_enumerated
from saltus import ModelError, imm_filter, imm_smoother
from strategies import quick, random_problem, rngs

NAMES = (
    "absorb_a",
    "c222_n4",
    "coloured_aug_a",
    "cv2_tv",
    "fusion_paper_a",
    "ident_2x2_a",
    "m1_rts",
    "memoryless_a",
    "zero_a",
)
EXACT = ("ident_2x2_a", "m1_rts")


def case(cases, name):
    d = cases(f"smooth_{name}")
    model = {k: d[k] for k in ("z", "F", "Q", "H", "R", "mean0", "cov0", "probs0")}
    model |= {k: d[k] for k in ("b", "d") if k in d}
    return d, model | {"trans": [d[k] for k in sorted(d) if k.startswith("trans")]}


def in_deviations(found, expected, covs):
    """Largest error of means in standard deviations, modes that are known exactly left out."""
    sd = np.sqrt(np.diagonal(covs, axis1=-2, axis2=-1))
    return (np.abs(found - expected) / np.where(sd > 0, sd, 1.0)).max()


@pytest.mark.parametrize("name", NAMES)
def test_stored_cases(cases, name):
    d, model = case(cases, name)
    found = imm_smoother(**model, floor=float(d["floor"]), per_mode=True)
    assert in_deviations(found.mean, d["smooth_mean"], d["smooth_cov"]) < 1e-8
    sd = np.sqrt(np.diagonal(d["smooth_cov"], axis1=-2, axis2=-1))
    unit = np.where(sd > 0, sd, 1.0)
    assert (np.abs(found.cov - d["smooth_cov"]) / (unit[..., :, None] * unit[..., None, :])).max() < 1e-8
    assert np.abs(found.probs - d["smooth_probs"]).max() < 1e-8
    live = d["smooth_probs"] > 1e-250
    assert in_deviations(found.mode_means[live], d["smooth_means"][live], d["smooth_covs"][live]) < 1e-8
    np.testing.assert_allclose(found.log_likelihood, d["filter_log_likelihood"], rtol=1e-9, atol=1e-9)
    for c, pairs in enumerate(found.pairs):
        assert np.abs(pairs - d[f"smooth_pairs{c}"]).max() < 1e-8
        np.testing.assert_allclose(found.chain_probs[c], pairs.sum(-2))
    plain = imm_smoother(**model, floor=1.0)
    assert in_deviations(plain.mean, d["smooth_mean_floor1"], d["smooth_cov"]) < 1e-8
    assert np.abs(plain.probs - d["smooth_probs_floor1"]).max() < 1e-8
    if name in EXACT:
        assert in_deviations(found.mean, d["exact_mean"], d["exact_cov"]) < 1e-10
        assert np.abs(found.probs - d["exact_probs"]).max() < 1e-10


@given(rngs())
@quick
def test_one_mode_is_the_dense_answer(rng):
    problem = random_problem(rng, sizes=(), n=3, m=2, n_steps=5, batch=(2,))
    found = imm_smoother(**problem)
    for run in range(2):
        expected, _ = smooth_enumerated(flat_model(problem, (run,)))
        assert error(found.mean[run], expected.mean) < 1e-9
        assert error(found.cov[run], expected.cov) < 1e-9
        assert found.log_likelihood[run].sum() == pytest.approx(expected.log_likelihood, rel=1e-9, abs=1e-9)


@given(rngs())
@quick
def test_chains_that_cannot_switch_are_exact(rng):
    problem = random_problem(rng, sizes=(2, 2), n=2, m=1, n_steps=4) | {"trans": [np.eye(2), np.eye(2)]}
    found, (expected, pairs) = imm_smoother(**problem), smooth_enumerated(flat_model(problem))
    assert error(found.mean, expected.mean) < 1e-8
    assert error(found.cov, expected.cov) < 1e-8
    np.testing.assert_allclose(found.probs.reshape(4, 4), expected.probs, atol=1e-9)
    joint = pairs.reshape(4, 2, 2, 2, 2)
    np.testing.assert_allclose(found.pairs[0], joint.sum((2, 4)), atol=1e-9)
    np.testing.assert_allclose(found.chain_probs[1], expected.probs.reshape(4, 2, 2).sum(1), atol=1e-9)


@given(rngs())
@quick
def test_the_first_step_back_is_exact(rng):
    """From one prior for all modes the filter is exact at the first row, so the smoother is at the prior's pair."""
    problem = random_problem(rng, sizes=(2,), n=2, m=1, n_steps=1, missing=0.0)
    problem["mean0"], problem["cov0"] = rng.normal(size=2), np.eye(2)
    found, (expected, pairs) = imm_smoother(**problem), smooth_enumerated(flat_model(problem))
    assert error(found.mean, expected.mean) < 1e-9
    np.testing.assert_allclose(found.pairs[0], pairs, atol=1e-10)


def cv(rng, runs=40, n_steps=40, sizes=3):
    """Targets that fly straight, turn a little or hard, seen in position; and the truth."""
    dt, noise = 4.0, np.array([0.1, 3.0, 20.0])[:sizes]
    F = np.array([[1.0, dt], [0.0, 1.0]])
    g = np.array([dt**2 / 2, dt])
    trans = np.full((sizes, sizes), 0.1 / (sizes - 1)) + (0.9 - 0.1 / (sizes - 1)) * np.eye(sizes)
    mode, x = rng.integers(sizes, size=runs), rng.normal(size=(runs, 2)) * [100.0, 50.0]
    start, states, modes = x.copy(), [], []
    for _ in range(n_steps):
        mode = (rng.random(runs)[:, None] > np.cumsum(trans[mode], axis=-1)).sum(-1)
        x = x @ F.T + (noise[mode] * rng.normal(size=runs))[:, None] * g
        states.append(x)
        modes.append(mode)
    states, modes = np.stack(states, 1), np.stack(modes, 1)
    z = states[..., :1] + 30.0 * rng.normal(size=(runs, n_steps, 1))
    model = {
        "z": z,
        "F": F[None],
        "Q": noise[:, None, None] ** 2 * np.outer(g, g),
        "H": np.array([[[1.0, 0.0]]]),
        "R": np.array([[[900.0]]]),
        "trans": [trans],
        "mean0": start[:, None] * 0.0,
        "cov0": np.diag([1e4, 2.5e3]),
        "probs0": np.full(sizes, 1.0 / sizes),
    }
    return model, states, modes


def test_better_than_the_filter_and_honest(rng):
    """Singular Q, the model on which smoothers without a guard diverge."""
    model, states, modes = cv(rng, runs=200)
    before, after = imm_filter(**model), imm_smoother(**model)
    assert is_psd(after.cov)
    filtered, smoothed = (np.sqrt(np.square(e.mean - states)[:, :-1].mean((0, 1))) for e in (before, after))
    assert (smoothed < 0.75 * filtered).all()
    error_ = after.mean - states
    nees = np.einsum("rki,rkij,rkj->rk", error_, np.linalg.inv(after.cov), error_).mean() / 2.0
    assert 0.9 < nees < 1.1  # 200 runs of 40 correlated rows: about 3 % of noise
    right = (np.take_along_axis(e, modes[..., None], -1).mean() for e in (before.probs, after.probs))
    assert next(right) + 0.1 < next(right)
    log_pairs, log_joint = (
        np.log(np.take_along_axis(p, modes[..., None], -1)).mean() for p in (after.chain_probs[0], after.probs)
    )
    assert log_pairs > log_joint  # what the pairs are for
    # The chain makes up for some of a noise stated twice too large; the same interval still finds it out.
    doubled = imm_smoother(**(model | {"R": 4.0 * model["R"], "Q": 4.0 * model["Q"]}))
    off = doubled.mean - states
    assert np.einsum("rki,rkij,rkj->rk", off, np.linalg.inv(doubled.cov), off).mean() / 2.0 < 0.9


@pytest.mark.parametrize("lag", [0, 2, 11, 50])
def test_fixed_lag_is_the_smoother_of_the_record_so_far(rng, lag):
    model, _, _ = cv(rng, runs=2, n_steps=12)
    found = imm_smoother(**model, lag=lag, per_mode=True)
    for k in range(12):
        cut = model | {"z": model["z"][:, : min(k + lag, 11) + 1]}
        expected = imm_smoother(**cut, per_mode=True)
        assert error(found.mean[:, k], expected.mean[:, k]) < 1e-12
        assert error(found.cov[:, k], expected.cov[:, k]) < 1e-12
        assert error(found.mode_means[:, k], expected.mode_means[:, k]) < 1e-12
        assert error(found.pairs[0][:, k], expected.pairs[0][:, k]) < 1e-12
    if lag == 0:
        np.testing.assert_allclose(found.mean, imm_filter(**model).mean, rtol=1e-9, atol=1e-9)


def test_relabelled_modes_permute_the_answer(rng):
    model, _, _ = cv(rng, runs=3, n_steps=10)
    order = np.array([2, 0, 1])
    again = model | {"Q": model["Q"][order], "trans": [model["trans"][0][np.ix_(order, order)]]}
    found, permuted = imm_smoother(**model), imm_smoother(**again)
    np.testing.assert_allclose(permuted.probs, found.probs[..., order], atol=1e-9)
    np.testing.assert_allclose(permuted.mean, found.mean, rtol=1e-8, atol=1e-8)


@given(rngs())
@quick
def test_any_model_gives_laws_and_covariances(rng):
    problem = random_problem(rng, sizes=(2, 3), n=3, m=2, n_steps=5, batch=(2,))
    found = imm_smoother(**problem, per_mode=True)
    assert is_psd(found.cov, 1e-9)
    np.testing.assert_allclose(found.probs.sum((-1, -2)), 1.0, rtol=1e-12)
    for pairs, size in zip(found.pairs, (2, 3), strict=True):
        assert pairs.shape == (2, 5, size, size)
        np.testing.assert_allclose(pairs.sum((-1, -2)), 1.0, rtol=1e-12)
    for run in range(2):
        alone = imm_smoother(**{k: v for k, v in _one(problem, run).items()})
        assert error(found.mean[run], alone.mean) < 1e-9


def _one(problem, run):
    """One run of a batch of two."""
    flat = flat_model(problem, (run,))
    sizes = tuple(np.shape(t)[-1] for t in problem["trans"])
    out = {k: getattr(flat, k).reshape(-1, *sizes, *getattr(flat, k).shape[2:]) for k in ("F", "Q", "H", "R", "b", "d")}
    trans = [np.broadcast_to(t, (2, 5, s, s))[run] for t, s in zip(problem["trans"], sizes, strict=True)]
    prior = {k: getattr(flat, k).reshape(*sizes, *getattr(flat, k).shape[1:]) for k in ("mean0", "cov0", "probs0")}
    return out | prior | {"z": flat.z, "trans": trans}


def test_what_cannot_be_asked_is_refused(rng):
    model, _, _ = cv(rng, runs=1, n_steps=3)
    for settings, said in (
        ({"lag": -1}, "lag is a whole number"),
        ({"lag": True}, "lag is a whole number"),
        ({"floor": 0.0}, "floor is a share"),
        ({"backend": "native"}, "compiled"),
    ):
        with pytest.raises(ModelError, match=said):
            imm_smoother(**model, **settings)
