"""The experiment with coloured noise against its published tables, the reference case and small oracles."""

import json

import numpy as np
import pytest

from saltus.studies import run_study
from saltus.studies.coloured import FILTERS, STEPS, Trial, follow, run_coloured, scripted_modes
from saltus.studies.coloured_report import coloured_metrics, value_metrics

RUNS = 300  # as behind the table for the published chains


@pytest.fixture(scope="module")
def trial():
    return run_coloured(RUNS, 20240501)


@pytest.fixture(scope="module")
def metrics(trial):
    return coloured_metrics(trial)


def agrees(figure, want, runs=RUNS, theirs=300, last_digit=0.001):
    """Both are means over independent runs: five standard errors of their difference, and half a printed digit."""
    bound = 5 * np.sqrt(1 + runs / theirs) * figure["standard_error"] + last_digit / 2
    return abs(figure["value"] - want) <= bound


# Notes on coloured measurement noise, section 6: x / v of adaptive, nominal, clairvoyant, colour ignored; raw x.
TABLE = {
    "all": ((1.106, 1.129), (1.227, 1.201), (0.987, 1.074), (1.129, 1.133), 1.80),
    "nominal": ((0.748, 0.834), (0.730, 0.818), (0.730, 0.818), (0.747, 0.834), 1.00),
    "agitated": ((0.985, 1.648), (1.028, 1.700), (0.850, 1.563), (0.954, 1.642), 0.99),
    "noisy": ((1.678, 0.996), (1.972, 1.238), (1.457, 0.914), (1.752, 1.023), 3.16),
    "after": ((0.740, 0.832), (0.734, 0.821), (0.721, 0.815), (0.747, 0.834), 1.00),
}


@pytest.mark.parametrize("part", TABLE)
def test_errors_agree_with_the_table(metrics, part):
    found = metrics["rmse"][part]
    for name, row in zip(FILTERS, TABLE[part][:-1], strict=True):
        for state, want in zip("xv", row, strict=True):
            assert agrees(found[name][state], want), (name, state, found[name][state], want)
            assert found[name][state]["standard_error"] < 0.02 * want  # the bound sees a difference of a seventh
    assert agrees(found["raw"], TABLE[part][-1], last_digit=0.01)


def test_decisions_agree_with_the_table(metrics):
    for part, want in (("all", 0.70), ("nominal", 0.84), ("agitated", 0.52), ("noisy", 0.64)):
        assert agrees(metrics["map_mode_correct"][part], want, last_digit=0.01), part
    assert agrees(metrics["map_chain_correct"]["a"], 0.75, last_digit=0.01)
    assert agrees(metrics["map_chain_correct"]["b"], 0.93, last_digit=0.01)
    assert agrees(metrics["probability_of_true_mode"], 0.44, last_digit=0.01)
    assert agrees(metrics["nees"]["adaptive"], 1.45, last_digit=0.01)
    assert agrees(metrics["nees"]["clairvoyant"], 2.00, last_digit=0.01)
    lags = metrics["lags"]
    for name, median, tail in (("a_onset", 5, 15), ("a_end", 1, 7), ("b_onset", 1, 5), ("b_end", 2, 3)):
        assert abs(lags[name]["median"] - median) <= 1, name
        assert abs(lags[name]["quantile_90"] - tail) <= 3, name  # one step of the law's tail is 5 % of the runs
        assert lags[name]["detected"] > 0.99


# alpha_w / alpha_v: x of adaptive, white, nominal, clairvoyant; v of adaptive, white; NEES and MAP of adaptive, white.
VALUE = {
    10.0: ((1.489, 1.508, 1.593, 1.327), (1.416, 1.420), (1.96, 2.28), (0.451, 0.445)),
    3.0: ((1.718, 1.870, 1.853, 1.525), (1.416, 1.450), (1.97, 3.74), (0.452, 0.401)),
    1.0: ((1.854, 2.142, 2.005, 1.636), (1.348, 1.411), (1.97, 6.81), (0.446, 0.318)),
    0.3: ((1.866, 2.202, 1.966, 1.658), (1.181, 1.302), (2.00, 9.24), (0.457, 0.306)),
}


@pytest.mark.parametrize("rate", VALUE)
def test_value_of_the_colour_agrees_with_the_table(rate):
    # a third of the table's 400 steps, for more runs: 250 of 130 hold as much as 81 of the table's 320
    found = value_metrics(run_coloured(250, 7, rate=rate, drawn=130), rate)

    def close(figure, want, last_digit=0.001):
        return agrees(figure, want, 81, 320, last_digit)

    x, v, honesty, right = VALUE[rate]
    for name, want in zip(("adaptive", "white", "nominal", "clairvoyant"), x, strict=True):
        assert close(found["rmse"][name]["x"], want), (name, found["rmse"][name]["x"])
    for i, name in enumerate(("adaptive", "white")):
        assert close(found["rmse"][name]["v"], v[i]), name
        assert close(found["nees"][name], honesty[i], 0.01), name
        assert close(found["map_mode_correct"][name], right[i]), name
    # Honest at every correlation time: 2 lies in the interval of the mean NEES, at a stated one chance in 10^4 ...
    for name in ("adaptive", "clairvoyant"):
        assert abs(found["nees"][name]["value"] - 2.0) < 4 * found["nees"][name]["standard_error"], name
    assert found["nees_inside"]["clairvoyant"] > 0.85  # 400 correlated steps in 95 % bands
    # ... and the twin that must fail.
    assert found["nees"]["white"]["value"] - 2.0 > 4 * found["nees"]["white"]["standard_error"]
    assert found["phi_yy"] == pytest.approx({10.0: 0.208, 3.0: 0.624, 1.0: 0.855, 0.3: 0.954}[rate], abs=5e-4)


def test_the_published_run_is_the_reference_case(cases):
    d = cases("coloured_paper")
    modes = scripted_modes()
    np.testing.assert_array_equal(modes[:, 0], d["A"])
    np.testing.assert_array_equal(modes[:, 1], d["Bm"])
    est = follow(d["Y"][None], np.zeros((1, 2), int), modes[None], 10.0)[0]
    for a, key in ((est.probs, "exp_P"), (est.mean, "exp_x"), (est.cov, "exp_C")):
        np.testing.assert_allclose(a[0], d[key], rtol=0, atol=1e-8 * np.abs(d[key]).max())


def test_drawn_chains_have_their_law():
    modes = run_coloured(80, 3, drawn=100).modes
    jumps = modes[:, 1:] != modes[:, :-1]
    share = jumps.mean()
    assert abs(share - 0.1) < 5 * np.sqrt(0.09 / jumps.size)
    assert abs(modes.mean() - 0.5) < 5 * 0.5 / np.sqrt(modes.size / 9)  # 9: memory of a chain that stays 0.9


def test_runs_do_not_depend_on_how_many_are_made(trial):
    few = run_coloured(3, 20240501)
    for name, a in few._asdict().items():
        np.testing.assert_allclose(a, getattr(trial, name)[:3], rtol=1e-7, atol=1e-9, err_msg=name)
    assert isinstance(few, Trial) and trial.estimate.shape == (RUNS, len(FILTERS), STEPS, 2)


def test_the_study_writes_its_metrics_and_pictures(tmp_path, monkeypatch, trial):
    def three_runs(n_runs, seed, *, rate=10.0, drawn=None, progress=None):
        assert (n_runs, seed) == (3, 5)
        progress(3, 3)
        return Trial(*(a[:3] for a in trial))

    monkeypatch.setattr("saltus.studies.coloured_report.run_coloured", three_runs)
    seen = []
    run_study("coloured", tmp_path / "out", 3, 5, progress=lambda done, total: seen.append((done, total)))
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["study"] == "coloured" and metrics["runs"] == 3
    assert list(metrics["value_of_colour"]) == ["10", "3", "1", "0.3"]
    assert seen == [(3 * i, 15) for i in range(1, 6)]
    pictures = sorted(p.name for p in (tmp_path / "out").glob("*.png"))
    assert len(pictures) == 3
    assert all((tmp_path / "out" / name).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" for name in pictures)
