"""The identification study: curves, the published demonstration, calibration, promises."""

import json

import numpy as np
import pytest

from saltus.identify import p_correct, p_false
from saltus.studies import identification as experiment
from saltus.studies import run_study
from saltus.studies.identification import FARTHEST, POINTS, TRUTHS, run_calibration, run_recursive, run_static
from saltus.studies.identification_report import calibration_bins

# P("same") after 4, 10, 20 measurements and the mean ratio at 20, of 150 runs (identification notes, section 5).
NOTED = {
    "one object": ((0.980, 0.980, 0.993), 6.6),
    "two, the second from the prior": ((0.087, 0.020, 0.000), -253.0),
    "two, 400 m apart": ((0.007, 0.000, 0.000), -59.0),
    "two, 200 m apart": ((0.547, 0.227, 0.087), -10.5),
    "two, 100 m apart": ((0.893, 0.833, 0.673), 2.0),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The whole study, with fewer draws for the bounds."""
    folder = tmp_path_factory.mktemp("studies") / "identification"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiment, "_DRAWS", 20_000)
        run_study("identification", folder, 100, 5)
    return folder


def test_draws_lie_on_the_curves():
    found, n = run_static(4000, 1), 4000
    for d, dim in enumerate((2, 3)):
        pairs = [(found.correct[d], p_correct(POINTS, dim))]
        pairs += [(found.false[d, u], p_false(POINTS, (0.0, high), dim)) for u, high in enumerate(FARTHEST)]
        for seen, curve in pairs:
            assert np.abs(seen - curve).max() < 5.0 * 0.5 / np.sqrt(n)


def test_the_demonstration_is_that_of_the_notes():
    runs = 400
    llr = run_recursive(runs, 2).llr
    for s, truth in enumerate(TRUTHS):
        shares, mean = NOTED[truth]
        ratio = llr[:, s]
        for k, noted in zip((4, 10, 20), shares, strict=True):
            seen = (ratio[:, k - 1] >= 0).mean()
            p = 0.5 * (seen + noted)
            assert abs(seen - noted) <= 5.0 * np.sqrt(max(p * (1 - p), 0.005) * (1 / runs + 1 / 150))
        assert abs(ratio[:, -1].mean() - mean) < 5.0 * ratio[:, -1].std() * np.sqrt(1 / runs + 1 / 150)


def test_probabilities_are_honest(monkeypatch):
    monkeypatch.setattr(experiment, "_DRAWS", 20_000)
    for found in run_calibration(1500, 3).values():
        stated, share, error = calibration_bins(found)
        assert (np.abs(share - stated) < 5.0 * error).all() and len(stated) == 10


def test_metrics_and_pictures(written):
    metrics = json.loads((written / "metrics.json").read_text())
    assert metrics["runs"] == 100 and set(metrics["recursive"]) == set(TRUTHS)
    assert [b["asked"] for b in metrics["bounds"]] == [1e-1, 1e-2, 1e-3, 1e-4]
    assert len(list(written.glob("figure*.png"))) == 5
    for test in metrics["sprt"]:
        assert test["false"] < test["promised"]["false"] and test["missed"] < test["promised"]["missed"]


def test_false_identifications_are_as_many_as_asked_for(written):
    """In plain pairs, and by the identity of ratios where it tells anything; 5 standard errors of both numbers."""
    for found in json.loads((written / "metrics.json").read_text())["bounds"]:
        seen, asked, error = found["observed"], found["asked"], found["standard_error"]
        assert abs(seen["value"] - asked) < 5.0 * np.hypot(np.sqrt(asked / seen["pairs"]), error)
        assert abs(found["weighted"]["value"] - asked) < 5.0 * np.hypot(error, found["weighted"]["standard_error"])
        if found["bound"] > 0:
            assert found["identity"] == pytest.approx(asked, rel=0.3) and found["recognised"] > 0.9
