"""The study of switching diffusions: its cases are those of the notes, and it writes what it promises."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from diffusions import case, few
from saltus import GridFilter
from saltus.studies import moments, moments_report
from saltus.studies.moments import CASES, FILTERS, errors
from saltus.studies.moments_report import moments_study


@pytest.mark.parametrize("name", CASES)
def test_cases_are_those_of_the_notes(name, rng):
    ours, (model, sensor) = CASES[name](), case(name)
    n = model.n_state
    x, z = 1.5 * rng.standard_normal((20, n)), rng.standard_normal((20, sensor.check(model.means0)))
    for mode in range(2):
        np.testing.assert_allclose(ours.model.drift_at(mode, x), model.drift_at(mode, x), rtol=1e-13)
        np.testing.assert_allclose(ours.model.covariance_at(mode, x), model.covariance_at(mode, x), rtol=1e-13)
        want = sensor.log_likelihood(mode, z, x)
        np.testing.assert_allclose(ours.sensor.log_likelihood(mode, z, x), want, rtol=1e-12)
    for switch in model.switches:
        np.testing.assert_allclose(ours.model.rate(switch, x), model.rate(switch, x), rtol=1e-13)
        for a, b in zip(ours.model.restored(switch) or (), model.restored(switch) or (), strict=True):
            np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(ours.model.means0, model.means0)
    np.testing.assert_array_equal(ours.model.covs0, model.covs0)
    assert len(ours.times) * (ours.times[1] - ours.times[0]) == pytest.approx(10 if name == "c" else 12)


def test_errors_are_those_of_the_reference_posterior(cases):
    """The distances of the table, on reference data: order 4 within the limits asked for, order 2 not."""
    part = few(cases("moments_a2"), 4, 12)
    ours = CASES["a2"]()
    model, sensor = ours.model, ours.sensor
    grid = GridFilter(320, ([-4.5], [4.5]), estimate_error=False)
    reference = grid.run(model, sensor, part["z"], part["times"])
    assert np.abs(reference.mean[..., 0] - part["grid_mean"]).max() < 0.01
    fine = np.zeros(4, dtype=bool)
    four, two = (
        errors(FILTERS[name].run(model, sensor, part["z"], part["times"]), reference, 1.0, fine)
        for name in ("maxent4", "gaussian2")
    )
    assert four.mean_err < 0.03 and four.var_err < 0.03 and four.prob_err < 0.02 and four.failed == 0
    assert two.mean_err > 4 * four.mean_err and two.var_err > 4 * four.var_err
    same = errors(reference, reference, 2.0, ~fine)
    assert same == (0.0, 0.0, 0.0, 2.0, 1.0)


def test_the_study_writes_its_pictures_and_plain_numbers(tmp_path, monkeypatch):
    def small(make):
        whole = make()
        n = whole.model.n_state
        grid = GridFilter(48, ([-4.0] * n, [4.0] * n), estimate_error=False)
        return whole._replace(times=whole.times[:7], substeps=3, reference=grid, coarse=grid)

    short = {name: partial(small, make) for name, make in CASES.items()}
    monkeypatch.setattr(moments, "CASES", short)
    for name, one in FILTERS.items():
        monkeypatch.setitem(FILTERS, name, replace(one, nodes=14))
    told = []
    found = json.loads(json.dumps(moments_study(tmp_path, 2, 5, lambda *of: told.append(of)), allow_nan=False))
    total = 5 * (len(FILTERS) + 1)
    assert told == [(i + 1, total) for i in range(total)]
    assert len(list(tmp_path.glob("*.png"))) == 4
    for name in CASES:
        for label in (*FILTERS, "grid_coarse"):
            assert set(found[name][label]) == {"mean_err", "var_err", "prob_err", "us_per_step", "failed"}
            assert all(isinstance(value, float) for value in found[name][label].values())
        assert found["runs"][name] == 2 and found["steps"][name] == 7
        assert found[name]["maxent4"]["failed"] == 0
    assert moments_report.moments_study is moments_study
