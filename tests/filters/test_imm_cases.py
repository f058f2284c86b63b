"""Agreement with the reference cases: 1e-8 of max|expected| per array, exact ones 1e-10."""

import numpy as np
import pytest

from oracles import error
from saltus.filters import Belief, imm_filter, steps

# The definition, and whatever the package chooses by itself where a compiled backend is present.
BACKENDS = ["numpy", None]


def imm_case(d):
    return {
        "z": d["Y"],
        **{k: d[k] for k in ("F", "Q", "H", "R")},
        "trans": [d["Pi"]],
        "mean0": d["x0"],
        "cov0": d["P0"],
        "probs0": d["p0"],
    }


def lift(a, chain):
    """(T?, M, rows, cols) of one chain -> (T?, 1, M, 1, rows, cols)."""
    sizes = [1, 1, 1]
    sizes[chain] = a.shape[-3]
    return a.reshape(*a.shape[:-3], *sizes, *a.shape[-2:])


def fusion_case(d):
    """Stack the two channels: H depends on chains B and C by broadcasting, R is block diagonal."""
    q1, q2 = d["Y1"].shape[-1], d["Y2"].shape[-1]
    h1, h2, r1, r2 = lift(d["H1"], 1), lift(d["H2"], 2), lift(d["R1"], 1), lift(d["R2"], 2)
    both = np.broadcast_shapes(h1.shape[:-2], h2.shape[:-2])
    H = np.concatenate([np.broadcast_to(h, (*both, *h.shape[-2:])) for h in (h1, h2)], axis=-2)
    R = np.zeros((*np.broadcast_shapes(r1.shape[:-2], r2.shape[:-2]), q1 + q2, q1 + q2))
    R[..., :q1, :q1], R[..., q1:, q1:] = r1, r2
    return {
        "z": np.concatenate([d["Y1"], d["Y2"]], axis=-1),
        "F": lift(d["Phi"], 0),
        "Q": lift(d["B"], 0),
        "H": H,
        "R": R,
        "trans": [d["Pa"], d["Pb"], d["Pc"]],
        "mean0": d["X0"],
        "cov0": d["R0"],
        "probs0": d["P0"],
    }


def check(est, d, prefix="exp_", reachable=None):
    """Compare every array the case has."""
    arrays = {
        "P": est.probs,
        "X": est.mode_means,
        "R": est.mode_covs,
        "x": est.mean,
        "C": est.cov,
        "loglik": est.log_likelihood,
    }
    compared = 0
    for letter, actual in arrays.items():
        if prefix + letter in d:
            expected = d[prefix + letter]
            if letter in "XR" and reachable is not None:
                actual, expected = actual[reachable], expected[reachable]
            assert error(actual, expected) < 1e-8, letter
            compared += 1
    return compared


@pytest.mark.parametrize("backend", BACKENDS)
def test_generic_imm(cases, backend):
    d = cases("imm_M2_n3")
    assert check(imm_filter(**imm_case(d), per_mode=True, backend=backend), d) == 6


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "name",
    [
        "fusion_m222",
        "fusion_m222_missing",
        "fusion_m222_outlier",
        "fusion_m221_zero_prob",
        "fusion_m432_tv_missing",
        "fusion_paper_frozen",
    ],
)
def test_fusion_of_two_channels_under_three_chains(cases, name, backend):
    d = cases(name)
    est = imm_filter(**fusion_case(d), per_mode=True, backend=backend)
    # Moments of a mode that cannot be reached are any finite numbers.
    reachable = d["exp_P_pred"] > 0 if "exp_P_pred" in d else None
    assert check(est, d, reachable=reachable) == 6
    assert np.isfinite(est.mode_means).all() and np.isfinite(est.mode_covs).all()
    empty = np.isnan(d["Y1"]).all(-1) & np.isnan(d["Y2"]).all(-1)
    assert (est.log_likelihood[empty] == 0.0).all()


@pytest.mark.parametrize(
    "name", ["imm_M2_n3", "fusion_m222", "fusion_m222_missing", "fusion_m221_zero_prob", "fusion_m432_tv_missing"]
)
def test_predictions_step_by_step(cases, name):
    d = cases(name)
    p = imm_case(d) if "Y" in d else fusion_case(d)
    n_chains, n_steps = len(p["trans"]), len(p["z"])
    sizes, n = d["exp_P"].shape[1:], p["cov0"].shape[-1]

    def at(letter, k):
        return p[letter][k] if p[letter].ndim == n_chains + 3 else p[letter]

    with np.errstate(divide="ignore"):
        log_probs0 = np.log(p["probs0"])
    belief = Belief(log_probs0, np.broadcast_to(p["mean0"], (*sizes, n)), np.broadcast_to(p["cov0"], (*sizes, n, n)))
    for k in range(n_steps):
        log_probs, means, covs = steps.mix(*belief, p["trans"])
        means, covs = steps.propagate(means, covs, at("F", k), None, at("Q", k))
        prediction = steps.measure(means, covs, at("H", k), None, at("R", k))
        on = d["exp_P_pred"][k] > 0
        assert error(np.exp(log_probs), d["exp_P_pred"][k]) < 1e-8
        assert error(means[on], d["exp_X_pred"][k][on]) < 1e-8
        assert error(covs[on], d["exp_R_pred"][k][on]) < 1e-8
        if "exp_W" in d:
            assert error(prediction.y[on], d["exp_Y_pred"][k][on]) < 1e-8
            assert error(prediction.S[on], d["exp_W"][k][on]) < 1e-8
        done = steps.condition(prediction, np.nan_to_num(p["z"][k]), ~np.isnan(p["z"][k]))
        log_probs, _ = steps.reweigh(log_probs, done.loglik, n_chains)
        belief = Belief(log_probs, done.mean, done.cov)


@pytest.mark.parametrize("backend", BACKENDS)
def test_exact_filter_agrees_at_the_first_row(cases, backend):
    d = cases("exact_M2")
    est = imm_filter(**imm_case(d), backend=backend)
    assert check(est, d, "imm_") == 4
    assert error(est.probs[0], d["exact_P"][0]) < 1e-10
    assert error(est.mean[0], d["exact_x"][0]) < 1e-10
    assert error(est.cov[0], d["exact_C"][0]) < 1e-10
    assert error(est.log_likelihood[:1], d["exact_loglik"][:1]) < 1e-10


@pytest.mark.parametrize("backend", BACKENDS)
def test_exact_filter_agrees_at_every_row_when_chains_are_frozen(cases, backend):
    d = cases("exact_frozen_chain_222")
    est = imm_filter(**fusion_case(d), backend=backend)
    assert error(est.probs.reshape(len(est.probs), -1), d["exact_P"]) < 1e-10
    assert error(est.mean, d["exact_x"]) < 1e-10
    assert error(est.cov, d["exact_C"]) < 1e-10
    assert error(est.log_likelihood, d["exact_loglik"]) < 1e-10


@pytest.mark.parametrize("name", ["mixing_m222", "mixing_m432"])
def test_mixing(cases, name):
    d = cases(name)
    log_probs, means, covs = steps.mix(np.log(d["P"]), d["X"], d["R"], [d["Pa"], d["Pb"], d["Pc"]])
    assert error(np.exp(log_probs), d["exp_P"]) < 1e-8
    assert error(means, d["exp_X"]) < 1e-8
    assert error(covs, d["exp_R"]) < 1e-8


@pytest.mark.parametrize("backend", BACKENDS)
def test_radar_track_in_decomposed_channels(cases, backend):
    d = cases("radar_track")
    both = {"trans": [d["Pi"]], "probs0": d["p0"], "per_mode": True, "backend": backend}
    H = np.array([[[1.0, 0, 0, 0], [0, 0, 1, 0]]])
    horizontal = imm_filter(
        d["Y"][2:, :2], F=d["Fh"], Q=d["Qh"], H=H, R=d["R"][2:, None, :2, :2], mean0=d["x0"], cov0=d["P0"], **both
    )
    assert check(horizontal, d, "exp_h_") == 5
    vertical = imm_filter(
        d["Y"][2:, 2:],
        F=d["Fv"],
        Q=d["Qv"],
        H=[[[1.0, 0]]],
        R=d["R"][2:, None, 2:, 2:],
        mean0=d["z0"],
        cov0=d["Z0"],
        **both,
    )
    assert check(vertical, d, "exp_v_") == 5


@pytest.mark.parametrize("letter", ["h", "v"])
def test_radar_track_predictions(cases, letter):
    d = cases("radar_track")
    F, Q = d[f"F{letter}"], d[f"Q{letter}"]
    # The prediction of row k from the case's own posterior of row k - 1; covariances only from the common start.
    probs, X = d[f"exp_{letter}_P"], d[f"exp_{letter}_X"]
    log_probs, means, _ = steps.mix(np.log(probs[:-1]), X[:-1], np.zeros((*X[:-1].shape, X.shape[-1])), [d["Pi"]])
    means, _ = steps.propagate(means, np.zeros((*means.shape, means.shape[-1])), F, None, Q)
    assert error(np.exp(log_probs), d[f"exp_{letter}_P_pred"][1:]) < 1e-8
    assert error(means, d[f"exp_{letter}_X_pred"][1:]) < 1e-8
    P0 = d["P0"] if letter == "h" else d["Z0"]
    _, covs = steps.propagate(np.zeros(len(P0)), P0, F, None, Q)
    assert error(covs, d[f"exp_{letter}_R_pred"][0]) < 1e-8
