"""The fusion experiment against its published table, the reference case and answers that share no code."""

import json

import numpy as np
import pytest

from oracles import dense_kalman, error
from saltus.evaluate import rmse
from saltus.studies.fusion import FILTERS, fixed_chains, matrices, run_fusion
from saltus.studies.fusion_report import SEGMENTS, calibration_curve, fusion_metrics, fusion_study, lags

RUNS = 200
TABLE_RUNS = 300
MERGING = 0.03  # bias of single bins that merging histories leaves: 0.06 for A above 0.9, 0.01 elsewhere


@pytest.fixture(scope="module")
def frozen():
    return run_fusion(RUNS, 20240501)


@pytest.fixture(scope="module")
def drawn():
    return run_fusion(150, 7, chains="drawn")


@pytest.fixture(scope="module")
def by_range():
    return run_fusion(60, 3, "range")


@pytest.fixture(scope="module")
def metrics(frozen, drawn, by_range):
    return fusion_metrics(frozen, drawn, by_range)


def near(figure, want, last_digit, runs=RUNS):
    """Compare independent means of `runs` and of the table's runs: 5 standard errors, and the table's last digit."""
    bound = 5 * figure["standard_error"] * np.sqrt(1 + runs / TABLE_RUNS) + last_digit / 2
    return abs(figure["value"] - want) <= bound


# Theory notes on fusion, section 9: adaptive, nominal, clairvoyant for phi (mrad), omega (mrad/s), V (m/s), J (m/s^2).
TABLE = {
    "all": ((7.38, 81.7, 6.86), (5.08, 15.3, 4.96), (0.655, 0.667, 0.632), (2.08, 2.11, 2.03)),
    "B": ((12.1, 17.8, 11.4), (6.03, 8.46, 5.88), (1.44, 1.50, 1.37), (2.20, 2.51, 2.00)),
    "C": ((1.96, 181, 1.82), (3.27, 28.6, 3.22), (0.495, 0.493, 0.485), (2.09, 2.10, 2.07)),
    "A": ((7.50, 6.95, 6.95), (5.18, 5.04, 5.04), (0.534, 0.526, 0.494), (3.25, 3.25, 3.17)),
    "nominal": ((7.51, 6.96, 6.96), (5.79, 5.65, 5.65), (0.483, 0.480, 0.480), (1.60, 1.59, 1.59)),
}
UNIT = {"phi": 1e-3, "omega": 1e-3, "V": 1.0, "J": 1.0}


@pytest.mark.parametrize("segment", SEGMENTS)
def test_rmse_agrees_with_the_table(metrics, segment):
    found = metrics["intervals"]["rmse_segments"][segment]
    for (state, unit), row in zip(UNIT.items(), TABLE[segment], strict=True):
        for name, want in zip(FILTERS, row, strict=True):
            last_digit = 10.0 ** np.floor(np.log10(want) - 2) * unit
            assert near(found[name][state], want * unit, last_digit), (name, state, found[name][state], want)
            assert found[name][state]["standard_error"] < 0.05 * want * unit  # a difference of a third is seen
            assert metrics["rmse_segments"][segment][name][state] == found[name][state]["value"]
    if segment == "all":
        assert metrics["rmse"] == {name: {state: found[name][state]["value"] for state in UNIT} for name in FILTERS}


def test_adaptation_costs_little_and_gains_much(metrics):
    rms = metrics["rmse"]
    # The same noise in all: the ratios are far more certain than the figures.
    assert 1.04 < rms["adaptive"]["phi"] / rms["clairvoyant"]["phi"] < 1.12
    assert rms["nominal"]["phi"] / rms["adaptive"]["phi"] > 8
    quiet = metrics["rmse_segments"]["nominal"]
    assert 1.05 < quiet["adaptive"]["phi"] / quiet["nominal"]["phi"] < 1.11


def test_modes_decided_agree_with_the_table(metrics):
    joint = metrics["intervals"]["p_joint_mode_correct"]
    for segment, want in {"all": 0.77, "nominal": 0.86, "B": 0.60, "C": 0.79, "A": 0.57}.items():
        assert near(joint[segment], want, 0.01), (segment, joint[segment])
        assert joint[segment]["standard_error"] < 0.02
    assert metrics["p_joint_mode_correct"] == joint["all"]["value"]
    for chain, want in {"A": 0.84, "B": 0.92, "C": 0.995}.items():
        assert abs(metrics["p_chain_correct"][chain] - want) < 0.015
    assert abs(metrics["p_true_mode"] - 0.47) < 0.01


def test_delays_agree_with_the_table(metrics, frozen):
    assert metrics["lag"]["B"] == 1 and metrics["lag"]["C"] == 0 and metrics["lag"]["A"] in (1, 2)
    for chain, low, high in (("A", 4, 7), ("B", 2, 4), ("C", 0, 0)):
        for change in metrics["lags"][chain]:
            assert low <= change["quantile_90"] <= high and change["detected"] > 0.97
    assert [change["step"] for change in metrics["lags"]["A"]] == [120, 160]
    slow = lags(frozen._replace(marginals=np.where(np.arange(200)[:, None] < 55, 0.0, frozen.marginals)), 1)
    assert (np.nan_to_num(slow, nan=99) >= 6).all()  # step 50 is row 49


def test_covariances_and_probabilities_are_honest(metrics, drawn):
    nees = metrics["intervals"]["nees"]
    # The merged filter's own NEES is 3.98 +- 0.03 in the table.
    assert near(nees, 3.98, 0.01, runs=150) and nees["standard_error"] < 0.05
    assert abs(metrics["nees_test_chains"] - 3.0) < 0.15
    found = metrics["calibration"]
    assert abs(found["difference"]) <= 5 * found["difference_standard_error"] < 0.01
    assert abs(found["prob_true"] - 0.3735) < 0.01
    stated, observed, spread = calibration_curve(drawn)
    full = spread > 0
    assert full.sum() > 20
    assert (np.abs(stated - observed)[full] < 5 * spread[full] + MERGING).all()


def test_overconfident_filters_are_caught(drawn):
    # The same figures with twice the honest probability ratio, and with covariances half as large.
    p = drawn.marginals**2 / (drawn.marginals**2 + (1 - drawn.marginals) ** 2)
    stated, observed, spread = calibration_curve(drawn._replace(marginals=p))
    full = spread > 0
    assert not (np.abs(stated - observed)[full] < 5 * spread[full] + 2 * MERGING).all()
    assert abs(2 * drawn.nees.mean() - 3.98) > 1.0


def test_range_dependent_variant_is_close_to_the_frozen_one(frozen, by_range):
    for segment, (first, last) in SEGMENTS.items():
        part = slice(first - 1, last)
        one, other = (rmse(t.estimate[:, 0, part] - t.states[:, part], pool=(1,)) for t in (frozen, by_range))
        change = other.value / one.value - 1
        # Two independent samples here, two of 300 runs behind the stated range of changes.
        spread = np.hypot(one.standard_error / one.value, other.standard_error / other.value)
        bound = 5 * spread * np.sqrt(1 + len(by_range.states) / TABLE_RUNS) + 0.005
        assert -0.15 - bound[1] < change[1] < 0.08 + bound[1], segment
        assert (np.abs(change[[0, 2, 3]]) < 0.07 + bound[[0, 2, 3]]).all(), segment
        assert bound.max() < 0.35


def test_the_figures_do_not_depend_on_how_many_runs_are_made(frozen):
    few = run_fusion(2, 20240501)
    for name, a in few._asdict().items():
        np.testing.assert_allclose(a, getattr(frozen, name)[:2], rtol=1e-9, atol=1e-12, err_msg=name)


def test_the_study_writes_its_pictures_and_plain_numbers(tmp_path):
    told = []
    found = json.loads(json.dumps(fusion_study(tmp_path, 2, 5, lambda *of: told.append(of)), allow_nan=False))
    assert told == [(2, 6), (4, 6), (6, 6)]
    assert len(list(tmp_path.glob("*.png"))) == 4
    for name in FILTERS:
        assert all(isinstance(found["rmse"][name][state], float) for state in UNIT)
    assert set(found["lag"]) == {"A", "B", "C"} and {"rmse_segments", "nees", "calibration"} < set(found)


# --- pieces -----------------------------------------------------------------------------------------------


def test_model_has_the_numbers_of_the_notes():
    model = matrices("frozen")
    F, Q = model.F[0, 0, 0], model.Q[:, 0, 0]
    want = {(0, 0): 0.987354, (0, 1): 0.980951, (1, 0): -0.0251123, (1, 1): 0.957925, (2, 3): 0.998488}
    want |= {(2, 4): 0.439144, (3, 3): 0.995609, (3, 4): 0.822831, (4, 3): -0.00822831, (4, 4): 0.666476}
    want |= {(1, 4): -2.015e-5}
    for index, value in want.items():
        assert abs(F[index] / value - 1) < 1e-3, index
    noise = {(0, 0): 4.98e-6, (1, 1): 1.478e-5, (2, 2): 0.289927, (2, 3): 0.694252, (3, 3): 1.793789}
    for index, value in (noise | {(3, 4): 2.437380, (4, 4): 4.941349}).items():
        assert abs(Q[(0, *index)] / value - 1) < 1e-3, index
    assert abs(Q[1, 4, 4] - 24.706746) < 1e-5
    assert matrices("range").F.shape == (200, 1, 1, 1, 5, 5) and matrices("range").Q.shape == (200, 2, 1, 1, 5, 5)


def test_model_is_the_reference_case(cases):
    case, model = cases("fusion_paper_frozen"), matrices("frozen")
    assert error(np.broadcast_to(model.F[0, 0], (1, 5, 5))[0], case["Phi"][0]) < 1e-9
    assert error(model.Q[:, 0, 0], case["B"]) < 1e-9
    assert error(model.H[0, 0, :, :2], case["H1"]) < 1e-12 and error(model.H[0, 0, :, 2:], case["H2"]) < 1e-12
    assert error(model.R[0, :, 0, :2, :2], case["R1"]) < 1e-12
    assert error(fixed_chains(), np.stack([case["A"], case["Bm"], case["C"]], axis=-1)) == 0.0


@pytest.mark.parametrize("variant", ["frozen", "range"])
def test_clairvoyant_is_gaussian_conditioning_with_the_true_matrices(variant, rng):
    model, trial = matrices(variant), run_fusion(1, 3, variant, "drawn")
    steps, modes = 12, trial.modes[0, :12]
    F = np.broadcast_to(model.F, (200, 1, 1, 1, 5, 5))[:steps, 0, 0, 0]
    Q = np.broadcast_to(model.Q, (200, 2, 1, 1, 5, 5))[np.arange(steps), modes[:, 0], 0, 0]
    H, R = model.H[0, 0][modes[:, 2]], model.R[0, :, 0][modes[:, 1]]
    cov0 = np.diag(np.square([0.1, 0.016, 100.0, 30.0, 3.0]))
    zero = np.zeros((steps, 5)), np.zeros((steps, 3))
    mean, _, _ = dense_kalman(trial.measurement[0, :steps], F, Q, H, R, *zero, np.zeros(5), cov0)
    assert error(trial.estimate[0, 2, :steps], mean[:, [0, 1, 3, 4]]) < 1e-7


def test_simulated_chains_and_noises_have_the_law_of_the_model(drawn):
    same = drawn.modes[:, 1:] == drawn.modes[:, :-1]
    n = same[..., 0].size
    assert (np.abs(same.mean((0, 1)) - 0.8) < 5 * np.sqrt(0.16 / n)).all()
    # Residuals of the passive sensor and of the active speed, whitened with the modes that made them.
    B, C = drawn.modes[..., 1], drawn.modes[..., 2]
    passive = (drawn.measurement[..., 2] - np.where(C, 10.0, 1.0) * drawn.states[..., 0]) / 0.02
    speed = (drawn.measurement[..., 1] - drawn.states[..., 2]) / (0.5 * np.sqrt(np.where(B, 10.0, 1.0)))
    for white in (passive, speed):
        assert abs(white.mean()) < 5 / np.sqrt(white.size)
        assert abs(white.var() - 1) < 5 * np.sqrt(2 / white.size)
