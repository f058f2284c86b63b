"""What must hold for every model: symmetries, no-ops, positive covariances."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.stats import norm

from oracles import error, is_psd
from saltus.filters import imm_filter
from strategies import problems, quick, random_cov, random_problem, random_trans, rngs

ROUND_OFF = 1e-10
CORE = {"F": 2, "Q": 2, "H": 2, "R": 2, "b": 1, "d": 1}  # trailing axes that are no modes


@quick
@given(problems())
def test_probabilities_sum_to_one_and_covariances_are_positive(p):
    est = imm_filter(**p, per_mode=True)
    axes = tuple(range(p["z"].ndim - 1, est.probs.ndim))
    assert np.abs(est.probs.sum(axis=axes) - 1.0).max() < 1e-12 and (est.probs >= 0).all()
    assert is_psd(est.cov) and is_psd(est.mode_covs)
    assert (est.nis >= 0).all()


def take_modes(p, chain, order):
    """The problem with the states of one chain in another order."""
    n_chains = len(p["trans"])
    q = dict(p)
    for name, core in (CORE | {"mean0": 1, "cov0": 2, "probs0": 0}).items():
        a = p[name]
        axis = None if a is None else a.ndim - core - n_chains + chain
        if axis is not None and axis >= 0 and a.ndim > core and a.shape[axis] > 1:
            q[name] = np.take(a, order, axis=axis)
    t = p["trans"][chain]
    q["trans"] = [*p["trans"][:chain], t[..., order, :][..., :, order], *p["trans"][chain + 1 :]]
    return q


@quick
@given(problems(), rngs())
def test_relabelled_modes_permute_the_answer(p, rng):
    assume(p["trans"])
    chain = int(rng.integers(len(p["trans"])))
    order = rng.permutation(p["trans"][chain].shape[-1])
    est, permuted = imm_filter(**p), imm_filter(**take_modes(p, chain, order))
    assert error(np.take(est.probs, order, axis=p["z"].ndim - 1 + chain), permuted.probs) < ROUND_OFF
    assert error(est.mean, permuted.mean) < ROUND_OFF
    assert error(est.cov, permuted.cov) < ROUND_OFF


@quick
@given(problems())
def test_swapped_chains_swap_the_axes(p):
    assume(len(p["trans"]) >= 2)
    n_chains, q = len(p["trans"]), dict(p)
    for name, core in (CORE | {"mean0": 1, "cov0": 2, "probs0": 0}).items():
        a = p[name]
        if a is not None and a.ndim >= core + n_chains:
            first = a.ndim - core - n_chains
            q[name] = np.swapaxes(a, first, first + 1)
    q["trans"] = [p["trans"][1], p["trans"][0], *p["trans"][2:]]
    est, swapped = imm_filter(**p), imm_filter(**q)
    first = p["z"].ndim - 1
    assert error(np.swapaxes(est.probs, first, first + 1), swapped.probs) < ROUND_OFF
    assert error(est.mean, swapped.mean) < ROUND_OFF
    assert error(est.cov, swapped.cov) < ROUND_OFF


@quick
@given(rngs(), st.lists(st.integers(2, 3), min_size=1, max_size=2))
def test_equal_modes_are_one_kalman_filter(rng, sizes):
    p = random_problem(rng, (), n=3, m=2, n_steps=6, batch=(2,), missing=0.3)
    one, q = (1,) * len(sizes), dict(p)
    for name, core in CORE.items():
        a = p[name]
        if a is not None:
            q[name] = a.reshape((*a.shape[: a.ndim - core], *one, *a.shape[a.ndim - core :]))
    q |= {"mean0": p["mean0"].reshape(*p["mean0"].shape[:-1], *one, 3), "trans": [random_trans(rng, s) for s in sizes]}
    q["cov0"] = p["cov0"].reshape(*p["cov0"].shape[:-2], *one, 3, 3)
    start = rng.dirichlet(np.ones(int(np.prod(sizes)))).reshape(sizes)
    est, kalman = imm_filter(**(q | {"probs0": start})), imm_filter(**p)
    assert error(est.mean, kalman.mean) < ROUND_OFF
    assert error(est.cov, kalman.cov) < ROUND_OFF
    np.testing.assert_allclose(est.log_likelihood, kalman.log_likelihood, rtol=1e-10, atol=1e-10)
    # And nothing was learnt of the modes: each chain went its own way.
    expected = start
    for axis, t in enumerate(q["trans"]):
        expected = np.moveaxis(np.tensordot(expected, np.linalg.matrix_power(t, 6), axes=(axis, 0)), -1, axis)
    assert error(est.probs[0, -1], expected) < ROUND_OFF


@quick
@given(problems())
def test_a_row_of_a_batch_is_the_run_alone(p):
    assume(p["z"].ndim > 2)
    batch, n_steps, m = p["z"].shape[:-2], p["z"].shape[-2], p["z"].shape[-1]
    sizes, n = tuple(t.shape[-1] for t in p["trans"]), p["cov0"].shape[-1]
    core = {"F": (n, n), "Q": (n, n), "H": (m, n), "R": (m, m), "b": (n,), "d": (m,)}
    est = imm_filter(**p)
    for run in np.ndindex(batch):
        alone = {
            k: None if p[k] is None else np.broadcast_to(p[k], (*batch, n_steps, *sizes, *c))[run]
            for k, c in core.items()
        }
        alone |= {"z": p["z"][run], "probs0": np.broadcast_to(p["probs0"], (*batch, *sizes))[run]}
        alone |= {"mean0": np.broadcast_to(p["mean0"], (*batch, *sizes, n))[run]}
        alone |= {"cov0": np.broadcast_to(p["cov0"], (*batch, *sizes, n, n))[run]}
        alone["trans"] = [
            np.broadcast_to(t, (*batch, n_steps, s, s))[run] for t, s in zip(p["trans"], sizes, strict=True)
        ]
        one = imm_filter(**alone)
        for name in ("probs", "mean", "cov"):
            assert error(getattr(est, name)[run], getattr(one, name)) < ROUND_OFF
        np.testing.assert_allclose(est.log_likelihood[run], one.log_likelihood, rtol=1e-10, atol=1e-10)


@quick
@given(problems(), rngs())
def test_a_sensor_that_sees_no_state_changes_nothing(p, rng):
    m, n = p["z"].shape[-1], p["cov0"].shape[-1]
    r, value = 2.0, rng.normal(size=(*p["z"].shape[:-1], 1))
    R = np.zeros((*p["R"].shape[:-2], m + 1, m + 1))
    R[..., :m, :m], R[..., m, m] = p["R"], r
    q = p | {"z": np.concatenate([p["z"], value], axis=-1), "R": R}
    q["H"] = np.concatenate([p["H"], np.zeros((*p["H"].shape[:-2], 1, n))], axis=-2)
    if p["d"] is not None:
        q["d"] = np.concatenate([p["d"], np.zeros((*p["d"].shape[:-1], 1))], axis=-1)
    est, more = imm_filter(**p), imm_filter(**q)
    for name in ("probs", "mean", "cov"):
        assert error(getattr(more, name), getattr(est, name)) < ROUND_OFF
    expected = est.log_likelihood + norm.logpdf(value[..., 0], 0.0, np.sqrt(r))
    np.testing.assert_allclose(more.log_likelihood, expected, rtol=1e-10, atol=1e-10)


@quick
@given(rngs(), st.lists(st.integers(1, 3), max_size=2), st.integers(1, 5))
def test_a_run_in_two_parts_is_the_run_in_one(rng, sizes, split):
    p = random_problem(rng, tuple(sizes), n=2, m=2, n_steps=6, missing=0.2)
    for name, core in CORE.items():  # all constant
        if p[name] is not None and p[name].ndim > core + len(sizes):
            p[name] = p[name][0]
    p["trans"] = [random_trans(rng, s) for s in sizes]
    whole = imm_filter(**p)
    first = imm_filter(**(p | {"z": p["z"][:split]}), per_mode=True)
    start = {"probs0": first.probs[-1], "mean0": first.mode_means[-1], "cov0": first.mode_covs[-1]}
    second = imm_filter(**(p | {"z": p["z"][split:]} | start))
    assert error(np.concatenate([first.probs, second.probs]), whole.probs) < ROUND_OFF
    assert error(np.concatenate([first.mean, second.mean]), whole.mean) < ROUND_OFF
    assert error(np.concatenate([first.cov, second.cov]), whole.cov) < ROUND_OFF


@quick
@given(rngs(), st.integers(1, 6))
def test_one_interval_is_the_same_in_equal_parts(rng, parts):
    # One channel: A and Q over the whole, or `parts` empty rows of the parts. The chain: powers of trans.
    F, Q, t = np.eye(3) + 0.2 * rng.normal(size=(3, 3)), random_cov(rng, (), 3), random_trans(rng, 3)
    F_all, Q_all = np.eye(3), np.zeros((3, 3))
    for _ in range(parts):
        F_all, Q_all = F @ F_all, F @ Q_all @ F.T + Q
    sensor = {"H": rng.normal(size=(1, 2, 3)), "R": random_cov(rng, (1,), 2), "probs0": rng.dirichlet(np.ones(3))}
    start = {"mean0": rng.normal(size=3), "cov0": random_cov(rng, (), 3)}
    z = np.full((parts, 2), np.nan)
    z[-1] = rng.normal(size=2)
    many = imm_filter(z, F=F[None], Q=Q[None], trans=[t], **sensor, **start, keep="last")
    once = imm_filter(
        z[-1:], F=F_all[None], Q=Q_all[None], trans=[np.linalg.matrix_power(t, parts)], **sensor, **start, keep="last"
    )
    for name in ("probs", "mean", "cov"):
        assert error(getattr(many, name), getattr(once, name)) < ROUND_OFF
    assert abs(many.log_likelihood[-1] - once.log_likelihood[-1]) < 1e-10 * (1 + abs(once.log_likelihood[-1]))


@quick
@given(problems(), rngs())
def test_rotated_frame_rotated_answer(p, rng):
    n, m = p["cov0"].shape[-1], p["z"].shape[-1]
    U, V = (np.linalg.qr(rng.normal(size=(s, s)))[0] for s in (n, m))
    z = np.where(np.isnan(p["z"]).any(-1, keepdims=True), np.nan, p["z"])  # a rotated row has all components or none
    p |= {"z": z}
    q = p | {
        "z": z @ V.T,
        "F": U @ p["F"] @ U.T,
        "Q": U @ p["Q"] @ U.T,
        "H": V @ p["H"] @ U.T,
        "R": V @ p["R"] @ V.T,
        "b": None if p["b"] is None else p["b"] @ U.T,
        "d": None if p["d"] is None else p["d"] @ V.T,
        "mean0": p["mean0"] @ U.T,
        "cov0": U @ p["cov0"] @ U.T,
    }
    est, rotated = imm_filter(**p), imm_filter(**q)
    assert error(rotated.probs, est.probs) < ROUND_OFF
    assert error(rotated.mean, est.mean @ U.T) < ROUND_OFF
    assert error(rotated.cov, U @ est.cov @ U.T) < ROUND_OFF
    np.testing.assert_allclose(rotated.log_likelihood, est.log_likelihood, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(rotated.nis, est.nis, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("sigma", [1.0, 1e-5])
def test_covariances_stay_positive_over_long_runs(rng, sigma):
    # Two manoeuvre levels in the plane, 2000 scans, a start that knows nothing: P spans up to 16 decades.
    dt, n_steps = 4.0, 2000
    F1, G1 = np.array([[1.0, dt], [0.0, 1.0]]), np.array([dt**2 / 2, dt])
    F, G = np.kron(np.eye(2), F1), np.kron(np.eye(2), G1[:, None])
    Q = np.array([s**2 * G @ G.T for s in (1e-3, 30.0)])
    H = np.array([[[1.0, 0, 0, 0], [0, 0, 1.0, 0]]])
    z = np.cumsum(rng.normal(size=(3, n_steps, 2)) * 100.0, axis=1)
    z[1, rng.random(n_steps) < 0.3] = np.nan
    z[2, :, 1] = np.nan  # one component is never seen
    est = imm_filter(
        z,
        F=F[None],
        Q=Q,
        H=H,
        R=sigma**2 * np.eye(2)[None],
        trans=[np.array([[0.95, 0.05], [0.2, 0.8]])],
        mean0=np.zeros(4),
        cov0=1e10 * np.eye(4),
        probs0=np.array([0.5, 0.5]),
        per_mode=True,
    )
    assert np.isfinite(est.mean).all() and np.isfinite(est.log_likelihood).all()
    assert is_psd(est.cov) and is_psd(est.mode_covs)
    assert np.abs(est.probs.sum(-1) - 1.0).max() < 1e-12
    assert np.abs(est.mean[0, -1, [0, 2]] - z[0, -1]).max() < sigma  # the measurement is all that counts
