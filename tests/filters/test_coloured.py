"""The filter for coloured noise: reference cases, dense and textbook oracles, its two ways, limits, statistics."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import block_diag, expm

from oracles import dense_kalman, error, flat_model, is_psd, textbook_imm
from saltus.errors import DataError, ModelError, NumericalError
from saltus.evaluate import consistency, nees
from saltus.filters import imm_filter
from saltus.filters.coloured import augmented_filter, coloured_filter
from saltus.filters.coloured_model import augment, difference
from strategies import coloured_problems, quick, random_coloured, random_cov, random_trans, rngs

BACKENDS = ["numpy", None]  # the definition, and whatever the package chooses where a compiled backend is present
WAYS = [coloured_filter, augmented_filter]
CASES = ["coloured_m22_n2", "coloured_m22_n3_missing", "coloured_m32_n3", "coloured_paper"]


def case_arguments(d):
    return {
        "F": d["Fx"][:, None],
        "G": d["Gx"][:, None],
        "noise_F": d["Fw"][None],
        "noise_G": d["Gw"][None],
        "H": d["H"],
        "dt": d["dt"],
        "trans": [d["Pa"], d["Pb"]],
        "mean0": d["m0"],
        "cov0": d["P0x"],
        "noise_cov0": d["Pw"][None],
        "probs0": d["Pm0"],
    }


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", CASES)
def test_reference_cases(cases, name, way, backend):
    d = cases(name)
    est = way(d["Y"], **case_arguments(d), per_mode=True, backend=backend)
    found = {
        "P": est.probs,
        "X": est.mode_means,
        "R": est.mode_covs,
        "x": est.mean,
        "C": est.cov,
        "loglik": est.log_likelihood,
    }
    for key, a in found.items():
        assert error(a, d[f"exp_{key}"]) < 1e-8, key
    if "init_loglik" in d:
        assert error(est.log_likelihood_start, d["init_loglik"]) < 1e-8


@pytest.mark.parametrize("name", ["coloured_m22_n2", "coloured_m22_n3_missing", "coloured_m32_n3"])
def test_reference_discretisation(cases, name):
    d = cases(name)
    given = {k: v for k, v in case_arguments(d).items() if k not in ("trans", "probs0")}
    moves = difference(augment(**given, n_steps=len(d["Y"]) - 1, n_chains=2))
    n, Phi, B = moves.n_kept, moves.Phi, moves.B
    full = (len(d["Fx"]), len(d["Fw"]))

    def close(a, want):
        assert error(np.broadcast_to(a, (*full, *a.shape[-2:])), np.broadcast_to(want, (*full, *a.shape[-2:]))) < 1e-8

    close(Phi[..., :n, :n], d["model_Phixx"][:, None])
    close(Phi[..., n:, :n], d["model_Phiyx"])
    close(Phi[..., n:, n:], d["model_Phiyy"][None])
    assert not Phi[..., :n, n:].any()  # the state does not hear the noise
    close(B[..., :n, :n], d["model_Bxx"][:, None])
    close(B[..., :n, n:], d["model_Bxy"])
    close(B[..., n:, n:], d["model_Byy"])


# --- random problems ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", BACKENDS)
@quick
@given(problem=coloured_problems())
def test_differencing_equals_augmentation_for_any_chains_and_gaps(problem, backend):
    a, b = (way(**problem, per_mode=True, backend=backend) for way in WAYS)
    for name in ("probs", "mean", "cov", "mode_means", "mode_covs"):
        assert error(getattr(a, name), getattr(b, name)) < 1e-6, name
    scale = 1 + np.abs(b.log_likelihood).max()
    assert np.abs(a.log_likelihood - b.log_likelihood).max() < 1e-6 * scale
    assert np.abs(a.log_likelihood_start - b.log_likelihood_start).max() < 1e-6 * scale
    assert np.abs(a.nis - b.nis).max() < 1e-6 * (1 + b.nis.max())
    np.testing.assert_array_equal(a.n_observed, (~np.isnan(problem["z"][..., 1:, :])).sum(-1))
    assert is_psd(a.cov) and is_psd(a.mode_covs)
    np.testing.assert_allclose(a.probs.sum(axis=tuple(range(a.mean.ndim - 1, a.probs.ndim))), 1.0, rtol=1e-12)


def van_loan(F, G, dt):
    n = len(F)
    big = expm(np.block([[-F, G @ G.T], [np.zeros((n, n)), F.T]]) * dt)
    Phi = big[n:, n:].T
    return Phi, Phi @ big[:n, n:]


def augmented_problem(p):
    """The augmented model as arguments of `imm_filter`, discretised by scipy; its prior holds just before row 0."""
    m, n = p["H"].shape
    sizes = tuple(np.shape(t)[-1] for t in p["trans"])
    n_steps = p["z"].shape[-2] - 1
    dt = np.broadcast_to(p["dt"], n_steps)
    full = {k: np.broadcast_to(p[k], (*sizes, *p[k].shape[-2:])) for k in ("F", "G", "noise_F", "noise_G")}
    F = np.zeros((n_steps + 1, *sizes, n + m, n + m))
    F[0], Q = np.eye(n + m), np.zeros_like(F)
    for k in range(n_steps):
        for mode in np.ndindex(sizes):
            parts = [van_loan(full[f][mode], full[g][mode], dt[k]) for f, g in (("F", "G"), ("noise_F", "noise_G"))]
            F[k + 1][mode], Q[k + 1][mode] = (block_diag(*blocks) for blocks in zip(*parts, strict=True))
    still = [
        np.concatenate([np.eye(s)[None], np.broadcast_to(t, (n_steps, s, s))])
        for t, s in zip(p["trans"], sizes, strict=True)
    ]
    mean0 = np.broadcast_to(p["mean0"], (*sizes, n))
    covs = [np.broadcast_to(p[k], (*sizes, *p[k].shape[-2:])) for k in ("cov0", "noise_cov0")]
    cov0 = np.array([block_diag(covs[0][mode], covs[1][mode]) for mode in np.ndindex(sizes)])
    return {
        "z": p["z"],
        "F": F,
        "Q": 0.5 * (Q + Q.swapaxes(-1, -2)),
        "H": np.concatenate([p["H"], np.eye(m)], axis=1).reshape((1,) * len(sizes) + (m, n + m)),
        "R": np.zeros((1,) * len(sizes) + (m, m)),
        "trans": still,
        "mean0": np.concatenate([mean0, np.zeros((*sizes, m))], axis=-1),
        "cov0": cov0.reshape(*sizes, n + m, n + m),
        "probs0": p["probs0"],
    }


@pytest.mark.parametrize("backend", BACKENDS)
@quick
@given(rng=rngs(), n=st.integers(1, 3), m=st.integers(1, 3))
def test_chains_agree_with_the_textbook_cycle(rng, n, m, backend):
    p = random_coloured(rng, (2, 2), n, m, n_steps=4)
    est, want = coloured_filter(**p, per_mode=True, backend=backend), textbook_imm(flat_model(augmented_problem(p)))
    assert error(est.probs.reshape(4, 4), want.probs[1:]) < 1e-8
    assert error(est.mean, want.mean[1:, :n]) < 1e-8
    assert error(est.cov, want.cov[1:, :n, :n]) < 1e-8
    total = np.concatenate([[est.log_likelihood_start], est.log_likelihood])
    assert np.abs(total - want.log_likelihood).max() < 1e-8 * (1 + np.abs(want.log_likelihood).max())


@pytest.mark.parametrize("backend", BACKENDS)
@quick
@given(rng=rngs(), n=st.integers(1, 4), m=st.integers(1, 3))
def test_without_chains_it_is_the_dense_gaussian_answer(rng, n, m, backend):
    p = random_coloured(rng, (), n, m, n_steps=6, missing=0.4)
    a = augmented_problem(p)
    T = len(p["z"])
    H, R = np.broadcast_to(a["H"], (T, m, n + m)), np.zeros((T, m, m))
    args = (a["F"], a["Q"], H, R, np.zeros((T, n + m)), np.zeros((T, m)), a["mean0"], a["cov0"])
    mean, cov, total = dense_kalman(p["z"], *args)
    est = coloured_filter(**p, backend=backend)
    assert error(est.mean, mean[1:, :n]) < 1e-8
    assert error(est.cov, cov[1:, :n, :n]) < 1e-8
    got = np.cumsum(np.concatenate([[est.log_likelihood_start], est.log_likelihood]))
    assert np.abs(got - total).max() < 1e-8 * (1 + np.abs(total).max())


def test_a_white_part_goes_through_augmentation(rng):
    p = random_coloured(rng, (), 3, 2, 6)
    a = augmented_problem(p)
    T, R = len(p["z"]), random_cov(rng, (), 2)
    H = np.broadcast_to(a["H"], (T, 2, 5))
    args = (a["F"], a["Q"], H, np.broadcast_to(R, (T, 2, 2)), np.zeros((T, 5)), np.zeros((T, 2)), a["mean0"], a["cov0"])
    mean, cov, total = dense_kalman(p["z"], *args)
    est = augmented_filter(**p, R=R)
    assert error(est.mean, mean[1:, :3]) < 1e-8 and error(est.cov, cov[1:, :3, :3]) < 1e-8
    assert est.log_likelihood_start + est.log_likelihood.sum() == pytest.approx(total[-1], rel=1e-9)
    with pytest.raises(ModelError, match="must not vary in time"):
        augmented_filter(**p, R=np.broadcast_to(R, (6, 2, 2)))


def test_batch_rows_are_what_each_run_gives_alone(rng):
    p = random_coloured(rng, (2, 3), 3, 2, 8, batch=(2, 3), missing=0.3)
    p["z"][0, 0] = np.where(np.isnan(p["z"][0, 0]), 0.3, p["z"][0, 0])  # one run is complete, the others are not
    whole = coloured_filter(**p)
    for run in np.ndindex(2, 3):
        alone = coloured_filter(**{**p, "z": p["z"][run]})
        for name in ("probs", "mean", "cov", "log_likelihood", "nis"):
            np.testing.assert_allclose(getattr(whole, name)[run], getattr(alone, name), rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(whole.log_likelihood_start[run], alone.log_likelihood_start, rtol=1e-12)


def test_relabelled_modes_permute_the_answer(rng):
    p = random_coloured(rng, (3,), 2, 1, 6)
    order = np.array([2, 0, 1])
    q = dict(p)
    for name, core in (
        ("F", 2),
        ("G", 2),
        ("noise_F", 2),
        ("noise_G", 2),
        ("mean0", 1),
        ("cov0", 2),
        ("noise_cov0", 2),
    ):
        if p[name].ndim > core and p[name].shape[0] == 3:
            q[name] = p[name][order]
    q["trans"], q["probs0"] = [p["trans"][0][..., order, :][..., order]], p["probs0"][order]
    a, b = coloured_filter(**p), coloured_filter(**q)
    np.testing.assert_allclose(b.probs, a.probs[:, order], rtol=1e-9)
    np.testing.assert_allclose(b.mean, a.mean, rtol=1e-9)


def test_an_empty_row_changes_nothing_but_time(rng):
    """Rows without measurement inside an interval give what one long interval gives, when nothing jumps."""
    p = random_coloured(rng, (2,), 2, 1, 3, missing=0.0)
    p |= {"trans": [np.eye(2)], "dt": np.array([0.4, 0.9, 0.5])}
    gap = np.full((1, 1), np.nan)
    z, dt = np.concatenate([p["z"][:2], gap, p["z"][2:]]), np.array([0.4, 0.3, 0.6, 0.5])
    a, b = coloured_filter(**p), coloured_filter(**{**p, "z": z, "dt": dt})
    np.testing.assert_allclose(b.mean[[0, 2, 3]], a.mean, rtol=1e-9)
    np.testing.assert_allclose(b.probs[[0, 2, 3]], a.probs, rtol=1e-9)
    assert abs(b.log_likelihood[1]) < 1e-12 and b.n_observed[1] == 0


# --- limits ---------------------------------------------------------------------------------------------------


def tracking_problem(rng, tau, sigma, n_steps=60, level=1.0):
    """A point with white acceleration of two levels, its position seen with first-order noise."""
    F, dt = np.array([[0.0, 1.0], [0.0, 0.0]]), 1.0
    G = np.array([[[0.0], [0.1]], [[0.0], [1.0]]]) * level
    z = np.cumsum(np.cumsum(level * rng.normal(size=(n_steps + 1, 1)), axis=0), axis=0) + sigma * rng.normal(
        size=(n_steps + 1, 1)
    )
    return {
        "z": z,
        "F": F[None],
        "G": G,
        "noise_F": np.array([[[-1.0 / tau]]]),
        "noise_G": np.array([[[sigma * np.sqrt(2.0 / tau)]]]),
        "H": np.array([[1.0, 0.0]]),
        "dt": dt,
        "trans": [np.array([[0.9, 0.1], [0.2, 0.8]])],
        "mean0": np.zeros(2),
        "cov0": np.diag([100.0, 10.0]),
        "noise_cov0": np.array([[sigma**2]]),
        "probs0": np.array([0.5, 0.5]),
    }


def white_problem(p, R, bias=None):
    """The same motion seen with white noise R, and perhaps a constant unknown bias, from the first sample on."""
    n = 2 if bias is None else 3
    Phi, Q = np.zeros((2, n, n)), np.zeros((2, n, n))
    for j in range(2):
        Phi[j], Q[j] = np.eye(n), 0.0
        Phi[j, :2, :2], Q[j, :2, :2] = van_loan(p["F"][0], p["G"][j], p["dt"])
    first = np.concatenate([np.eye(n)[None, None], np.ones((len(p["z"]) - 1, 1, 1, 1)) * Phi[0]])
    return {
        "z": p["z"],
        "F": first,
        "Q": np.concatenate([np.zeros((1, 2, n, n)), np.broadcast_to(Q, (len(p["z"]) - 1, 2, n, n))]),
        "H": np.array([[[1.0, 0.0, 1.0][:n]]]),
        "R": np.array([[[R]]]),
        "trans": [np.concatenate([np.eye(2)[None], np.broadcast_to(p["trans"][0], (len(p["z"]) - 1, 2, 2))])],
        "mean0": np.zeros(n),
        "cov0": p["cov0"] if bias is None else block_diag(p["cov0"], bias),
        "probs0": p["probs0"],
    }


@pytest.mark.parametrize("backend", BACKENDS)
def test_correlation_time_to_zero_is_white_noise(rng, backend):
    errors = []
    for tau in (0.1, 1e-3, 1e-9):
        p = tracking_problem(rng, tau, sigma=3.0)
        a, b = coloured_filter(**p, backend=backend), imm_filter(**white_problem(p, 9.0))
        errors.append(max(error(a.mean, b.mean[1:]), error(a.cov, b.cov[1:]), error(a.probs, b.probs[1:])))
    assert errors[0] < 1e-3  # exp(-10) of memory is left
    assert max(errors[1:]) < 1e-8


@pytest.mark.parametrize("backend", BACKENDS)
def test_correlation_time_to_infinity_is_a_constant_bias(rng, backend):
    errors = []
    for tau in (1e4, 1e8, 1e13):
        p = tracking_problem(rng, tau, sigma=3.0)
        a, b = coloured_filter(**p, backend=backend), imm_filter(**white_problem(p, 0.0, bias=9.0))
        errors.append(max(error(a.mean, b.mean[1:, :2]), error(a.cov, b.cov[1:, :2, :2]), error(a.probs, b.probs[1:])))
    assert errors[0] > errors[1]
    assert errors[1] < 1e-5 and errors[2] < 1e-6
    fixed = coloured_filter(**{**p, "noise_F": np.zeros((1, 1, 1)), "noise_G": np.zeros((1, 1, 1))}, backend=backend)
    assert error(fixed.mean, b.mean[1:, :2]) < 1e-6


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("tau", [1e-9, 1.0, 1e12])
@pytest.mark.parametrize("sigma", [1e-9, 1e-4, 1e6])
@pytest.mark.parametrize("level", [1e-6, 1.0])
def test_ill_conditioned_problems_stay_finite_and_psd(rng, tau, sigma, level, backend):
    p = tracking_problem(rng, tau, sigma, n_steps=200, level=level)
    p["z"][17:23] = np.nan
    est = coloured_filter(**p, per_mode=True, backend=backend)
    for a in (est.probs, est.mean, est.cov, est.log_likelihood, est.mode_covs):
        assert np.isfinite(a).all()
    assert is_psd(est.cov) and is_psd(est.mode_covs)


# --- statistics -----------------------------------------------------------------------------------------------


def simulate(rng, tau, runs, n_steps=40):
    """Draws of a damped point with first-order noise of unit variance; arguments without z, z, states."""
    F, G = np.array([[0.0, 1.0], [-0.2, -0.5]]), np.array([[0.0], [0.8]])
    Phi, Q = van_loan(F, G, 0.5)
    phi = np.exp(-0.5 / tau)
    cov0 = np.diag([4.0, 1.0])
    x = rng.normal(size=(runs, 2)) * np.sqrt(np.diag(cov0))
    w = rng.normal(size=runs)
    states, z = [], [x[:, 0] + w]
    for _ in range(n_steps):
        x = x @ Phi.T + rng.multivariate_normal(np.zeros(2), Q, size=runs)
        w = phi * w + np.sqrt(1 - phi**2) * rng.normal(size=runs)
        states.append(x)
        z.append(x[:, 0] + w)
    arguments = {
        "F": F,
        "G": G,
        "noise_F": np.array([[-1.0 / tau]]),
        "noise_G": np.array([[np.sqrt(2.0 / tau)]]),
        "H": np.array([[1.0, 0.0]]),
        "dt": 0.5,
        "trans": [],
        "mean0": np.zeros(2),
        "cov0": cov0,
        "noise_cov0": np.eye(1),
        "probs0": np.ones(()),
    }
    return arguments, np.stack(z, axis=1)[..., None], np.stack(states, axis=1)


@pytest.mark.parametrize("tau", [0.05, 0.5, 5.0, 50.0])
def test_nees_is_consistent_at_every_correlation_time(rng, tau):
    arguments, z, states = simulate(rng, tau, runs=1000)
    est = coloured_filter(z, **arguments)
    last = nees(states[:, -1] - est.mean[:, -1], est.cov[:, -1])
    assert consistency(last, 2, probability=0.9999).inside == 1.0
    everywhere = consistency(nees(states - est.mean, est.cov), 2)
    assert everywhere.inside > 0.8  # 40 times in 95 % bands, correlated
    if tau >= 5:  # the twin that must fail: the same noise taken for white
        white = coloured_filter(z, **{**arguments, "noise_F": [[-1e6]], "noise_G": [[np.sqrt(2e6)]]})
        last = nees(states[:, -1] - white.mean[:, -1], white.cov[:, -1])
        assert consistency(last, 2, probability=0.9999).mean > 3.0


def test_innovations_are_white_and_their_nis_consistent(rng):
    arguments, z, _ = simulate(rng, 5.0, runs=1000)
    est = coloured_filter(z, **arguments)
    assert consistency(est.nis[:, -1], 1, probability=0.9999).inside == 1.0
    assert consistency(est.nis, 1).inside > 0.8


# --- what is refused ------------------------------------------------------------------------------------------


@pytest.fixture
def plain(rng):
    return random_coloured(rng, (2,), 2, 1, 4, missing=0.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"F": np.zeros((2, 2))}, r"F has shape \(2, 2\); with 1 chain"),
        ({"noise_F": np.zeros((1, 2, 2))}, r"noise_F has shape \(1, 2, 2\)"),
        ({"G": np.zeros((1, 3, 1))}, r"G has shape \(1, 3, 1\)"),
        ({"H": np.zeros((2, 1, 2))}, "same in every mode"),
        ({"H": np.zeros((2, 2))}, r"noise_F has shape"),
        ({"mean0": np.zeros(3)}, r"mean0 has shape \(3,\)"),
        ({"noise_cov0": -np.eye(1)}, "noise_cov0 must be positive semi-definite"),
        ({"trans": [np.array([[0.9, 0.2], [0.1, 0.9]])]}, "rows must be probabilities"),
        ({"probs0": np.array([0.5, 0.6])}, "sum to 1"),
        ({"dt": -0.5}, "dt must not be negative, got -0.5 s"),
        ({"dt": np.array([1.0, 1.0, 1.0, -2.0])}, "dt must not be negative, got -2 s"),
        ({"dt": np.nan}, "dt holds nan; give a finite number"),
    ],
)
def test_wrong_descriptions_are_refused(plain, change, message):
    with pytest.raises(ModelError, match=message):
        coloured_filter(**{**plain, **change})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"z": np.zeros((1, 1))}, "K >= 1 rows after it"),
        ({"z": np.array([[0.0], [np.inf], [0.0], [0.0], [0.0]])}, r"z\[1, 0\] is infinite"),
        ({"z": np.array([[-np.inf], [0.0], [0.0], [0.0], [0.0]])}, r"z\[0, 0\] is infinite"),
        ({"dt": np.ones(5)}, r"dt has shape \(5,\); z has 5 rows"),
    ],
)
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("backend", BACKENDS)
def test_wrong_data_are_refused(plain, change, message, backend, way):
    with pytest.raises(DataError, match=message):
        way(**{**plain, **change}, backend=backend)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("way", WAYS)
def test_the_last_row_alone(rng, way, backend):
    p = random_coloured(rng, (2, 2), 3, 2, 6, batch=(3,))
    every = way(**p, per_mode=True, backend=backend)
    last = way(**p, per_mode=True, keep="last", backend=backend)
    np.testing.assert_array_equal(last.log_likelihood, every.log_likelihood)
    np.testing.assert_array_equal(last.log_likelihood_start, every.log_likelihood_start)
    for name in ("probs", "mean", "cov", "nis", "n_observed", "mode_means", "mode_covs"):
        np.testing.assert_array_equal(getattr(last, name), getattr(every, name)[:, -1:], err_msg=name)


@pytest.mark.parametrize("way", WAYS)
def test_no_threads_are_refused(plain, way):
    with pytest.raises(ModelError, match="num_threads is at least 1"):
        way(**plain, num_threads=0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_two_samples_at_one_time_are_refused_and_two_components_are_not(rng, backend):
    p = random_coloured(rng, (2,), 2, 2, 2, missing=0.0)
    p["dt"] = np.array([0.5, 0.0])
    with pytest.raises(NumericalError, match=r"Component 0 gets no noise in the interval before row 2. Two samples"):
        coloured_filter(**p, backend=backend)
    p["z"][1, 1] = p["z"][2, 0] = np.nan
    P = random_trans(rng, 2)
    apart = coloured_filter(**{**p, "trans": [np.stack([P, np.eye(2)])]}, backend=backend)
    both = np.array([p["z"][0], [p["z"][1, 0], p["z"][2, 1]]])
    together = coloured_filter(**{**p, "z": both, "dt": 0.5, "trans": [P]}, backend=backend)
    np.testing.assert_allclose(apart.mean[-1], together.mean[-1], rtol=1e-9)
    np.testing.assert_allclose(apart.probs[-1], together.probs[-1], rtol=1e-9)
    np.testing.assert_allclose(apart.log_likelihood.sum(), together.log_likelihood.sum(), rtol=1e-9)
