"""The radar experiment against its published table, the reference case and small oracles."""

import numpy as np
import pytest

from saltus import imm_filter
from saltus.studies.radar import FILTERS, Trial, follow, run_radar, scene, two_point_start
from saltus.studies.radar_report import radar_metrics, steady

RUNS = 200  # of the experiment here, and of the one behind the table


@pytest.fixture(scope="module")
def trial():
    return run_radar(RUNS, 20240501)


@pytest.fixture(scope="module")
def metrics(trial):
    return radar_metrics(scene(), trial)


def agrees(figure, want, last_digit=1.0):
    """Both are means over 200 independent runs, so their difference has sqrt(2) standard errors; 5 allowed."""
    bound = 5 * np.sqrt(2) * figure["standard_error"] + last_digit / 2
    return abs(figure["value"] - want) <= bound


# Theory notes on Cartesian radar filtering, section 6: steady / manoeuvre, x y z, in m.
TABLE = {
    "measurement": ((315, 379, 406), (281, 414, 345)),
    "estimate.adaptive": ((260, 304, 333), (275, 421, 360)),
    "estimate.kalman_steady": ((257, 298, 314), (976, 1029, 448)),
    "estimate.kalman_manoeuvre": ((310, 370, 389), (278, 404, 338)),
    "estimate.clairvoyant": ((257, 298, 314), (277, 402, 336)),
    "prediction.adaptive": ((435, 489, 579), (1795, 1875, 1342)),
    "prediction.kalman_steady": ((402, 447, 465), (3805, 3009, 1354)),
    "prediction.kalman_manoeuvre": ((1084, 1179, 1041), (1822, 1737, 1507)),
}


def errors_of(metrics, name):
    found = metrics["rmse"]
    for key in name.split("."):
        found = found[key]
    return found


@pytest.mark.parametrize("name", TABLE)
def test_rmse_agrees_with_the_table(metrics, name):
    for part, row in zip(("steady", "manoeuvre"), TABLE[name], strict=True):
        for axis, want in zip("xyz", row, strict=True):
            figure = errors_of(metrics, name)[part][axis]
            assert agrees(figure, want), (part, axis, figure, want)
            assert figure["low"] < figure["value"] < figure["high"]
            assert figure["standard_error"] < 0.05 * want  # the bound sees a difference of a third


def test_computed_prediction_sd_agrees_with_the_table(metrics):
    for part, row in (("steady", (871, 921, 1007)), ("manoeuvre", (1773, 1948, 1279))):
        for axis, want in zip("xyz", row, strict=True):
            assert agrees(metrics["prediction_sd"]["adaptive"][part][axis], want), (part, axis)


def test_the_adaptive_estimate_is_no_worse_than_the_measurement(metrics):
    rms = metrics["rmse"]
    for axis in "xyz":
        ours, raw = rms["estimate"]["adaptive"], rms["measurement"]
        assert ours["steady"][axis]["value"] < raw["steady"][axis]["value"]
        assert ours["manoeuvre"][axis]["value"] < 1.10 * raw["manoeuvre"][axis]["value"]


def test_gates_hold_the_measurements_and_those_of_a_steady_filter_lose_them(metrics):
    gates = metrics["gates"]
    n = RUNS * 79
    for axis, want in zip("xyz", (0.9997, 0.9950, 0.9999), strict=True):
        share = gates["adaptive"]["all"][axis]["value"]
        assert share >= 0.99
        # the last digit printed, and at least the binomial error of rare misses
        assert abs(share - want) <= 0.5e-4 + 5 * np.sqrt(2 * want * (1 - want) / n)
    for axis, want in (("x", 0.997), ("y", 0.963)):
        assert agrees(gates["adaptive"]["turns"][axis], want, last_digit=0.001)
    lost = gates["kalman_steady"]
    for part, axis, want in (("turns", "x", 0.24), ("turns", "y", 0.41), ("vertical", "z", 0.88)):
        assert agrees(lost[part][axis], want, last_digit=0.01)


def test_decisions_agree_with_the_table(metrics):
    turn, climb = metrics["lags"]["horizontal"], metrics["lags"]["vertical"]
    assert [d["value"] for d in turn["detected"]] == [1.0, 1.0]
    assert turn["detection"]["quantile_90"] <= 1 and turn["return"]["median"] == 1
    assert climb["detection"]["median"] == 2 and climb["detection"]["quantile_90"] == 3
    assert climb["return"]["median"] == 1
    for figure, want in zip(climb["detected"], (0.81, 0.90), strict=True):
        assert agrees(figure, want, last_digit=0.01)
    for figure in (turn["false_alarms"], climb["false_alarms"]):
        assert figure["value"] <= 0.003 + 5 * np.sqrt(2) * figure["standard_error"]


def test_mean_probability_of_the_first_turn_agrees_with_the_table(trial):
    want = [0.02, 0.02, 0.82, 0.93, 0.88, 0.85, 0.94, 0.75, 0.32, 0.09, 0.03, 0.02]  # scans 31 to 42
    first = int(np.flatnonzero(scene().scan == 31)[0])
    p = trial.prob_manoeuvre[:, first : first + 12, 0]
    bound = 5 * np.sqrt(2 / RUNS) * p.std(0, ddof=1) + 0.005
    assert np.all(np.abs(p.mean(0) - want) <= bound)


def test_decomposition_costs_next_to_nothing(metrics):
    both = metrics["decomposition"]
    rows = (
        ("estimate", "all", (274, 338, 357), (274, 338, 357)),
        ("estimate", "near", (253, 180, 133), (250, 179, 133)),
        ("prediction", "near", (1375, 1108, 274), (1352, 1097, 275)),
    )
    for what, part, apart, together in rows:
        for axis, a, b in zip("xyz", apart, together, strict=True):
            pair = both[what][part]
            assert agrees(pair["decomposed"][axis], a), (what, part, axis)
            assert agrees(pair["joint"][axis], b), (what, part, axis)
            # the same data in both: the ratio is far more certain than either
            assert 0.99 < pair["decomposed"][axis]["value"] / pair["joint"][axis]["value"] < 1.03


def test_conversion_table():
    one = Trial(*(np.ones((2, *shape)) for shape in ((79, 3), (79, 3, 3), (5, 79, 3), (5, 79, 3), (5, 79, 3), (79, 2))))
    table = radar_metrics(scene(), one)["conversion"]
    sigma_x = {"250_km": (300.0, 445.7, 554.4, 645.0), "140_km": (300.0, 329.6, 356.7, 382.0)}
    for name, want in sigma_x.items():
        np.testing.assert_allclose(table[name]["sigma_x"], want, atol=0.05)
    np.testing.assert_allclose(table["30_km"]["correlation_xy"], (0, 0.808, 0.845, 0.808), atol=5e-4)
    np.testing.assert_allclose(table["30_km"]["correlation_xz"][1:5], (0.098, 0.237, 0.425, 0.724), atol=5e-4)
    np.testing.assert_allclose(table["250_km"]["correlation_yz"][1:5], (-0.041, -0.101, -0.199, -0.508), atol=5e-4)
    np.testing.assert_allclose(table["30_km"]["sigma_z"][-1], 300.0, atol=0.05)


# --- pieces -----------------------------------------------------------------------------------------------


def test_two_point_start_is_the_linear_map_of_two_measurements(rng):
    m, period = 3, 7.0
    z, root = rng.normal(size=(2, m)), rng.normal(size=(2, m, m))
    R = root @ root.swapaxes(-1, -2)
    A = np.zeros((2 * m, 2 * m))  # from (z_0, z_1) to (x, vx, y, vy, ...)
    for a in range(m):
        A[2 * a, m + a] = 1.0
        A[2 * a + 1, [a, m + a]] = -1 / period, 1 / period
    both = np.zeros((2 * m, 2 * m))
    both[:m, :m], both[m:, m:] = R
    mean, cov = two_point_start(z[None], R[None], period)
    np.testing.assert_allclose(mean[0], A @ z.ravel(), rtol=1e-12)
    np.testing.assert_allclose(cov[0], A @ both @ A.T, rtol=1e-12)


def test_steady_means_six_quiet_scans():
    flags = np.zeros(30, bool)
    flags[12:14] = True
    want = [k >= 6 and not any(flags[max(k - 5, 0) : k + 1]) for k in range(30)]
    assert steady(flags).tolist() == want
    assert not steady(flags)[13 + 5] and steady(flags)[13 + 6]


def test_scene_is_the_reference_trajectory(cases):
    case, truth = cases("radar_track"), scene()
    np.testing.assert_allclose(truth.position, case["pos"][2:], rtol=1e-9)
    np.testing.assert_array_equal(truth.turning, case["man_h"][2:] > 0)
    np.testing.assert_array_equal(truth.climbing, case["man_v"][2:] > 0)


def close(got, want):
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-8 * np.max(np.abs(want)))


@pytest.mark.parametrize(("tag", "axes", "F"), [("h", slice(0, 2), "Fh"), ("v", slice(2, 3), "Fv")])
def test_filters_agree_with_the_reference_case(cases, tag, axes, F):
    case = cases("radar_track")
    z, R = case["Y"][:, axes], case["R"][:, axes, axes]
    m = z.shape[-1]
    mean0, cov0 = two_point_start(z[:2], R[:2], 10.0)
    close(mean0, case["x0" if tag == "h" else "z0"])
    close(cov0, case["P0" if tag == "h" else "Z0"])
    est = imm_filter(
        z[2:],
        F=case[F],
        Q=case[f"Q{tag}"],
        H=np.kron(np.eye(m), [1.0, 0.0])[None],
        R=R[2:, None],
        trans=[case["Pi"]],
        mean0=mean0,
        cov0=cov0,
        probs0=case["p0"],
        per_mode=True,
    )
    close(est.probs, case[f"exp_{tag}_P"])
    close(est.mode_means, case[f"exp_{tag}_X"])
    close(est.mean, case[f"exp_{tag}_x"])
    close(est.cov, case[f"exp_{tag}_C"])
    close(est.log_likelihood, case[f"exp_{tag}_loglik"])

    # predictions: collapse the reference's per-mode ones by hand
    got = follow(z[None], R[None], case[f"Q{tag}"], [case["Pi"]])
    p, x, P = (case[f"exp_{tag}_{name}"] for name in ("P_pred", "X_pred", "R_pred"))
    mean = np.einsum("tm,tmi->ti", p, x)
    spread = x - mean[:, None]
    cov = np.einsum("tm,tmij->tij", p, P + spread[..., :, None] * spread[..., None, :])
    close(got.prediction[0], mean[:, ::2])
    close(got.prediction_sd[0], np.sqrt(np.diagonal(cov, axis1=1, axis2=2))[:, ::2])
    close(got.estimate[0], case[f"exp_{tag}_x"][:, ::2])


def test_runs_do_not_depend_on_how_many_are_made(trial):
    few = run_radar(3, 20240501)
    for name, a in few._asdict().items():
        np.testing.assert_allclose(a, getattr(trial, name)[:3], rtol=1e-9, err_msg=name)
    assert trial.estimate.shape == (RUNS, len(FILTERS), 79, 3)
