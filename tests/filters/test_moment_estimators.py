"""Modes and medians: closed forms against the gamma law, densities of posteriors against the grid."""

import numpy as np
import pytest
from scipy.stats import gamma

from diffusions import case, few
from saltus import GridFilter, ModelError, MomentFilter
from saltus.filters.moments import edgeworth_median, edgeworth_mode, paper_mode, pearson_mode, unconditional


@pytest.mark.parametrize("k", [4.0, 9.0, 25.0])
def test_formulas_for_the_gamma_law(k):
    """Shape k, standardised: skewness 2/sqrt(k), excess 6/k, fifth cumulant 24/k^1.5; the mode is -1/sqrt(k)."""
    g1, g2, g3 = 2 / np.sqrt(k), 6 / k, 24 / k**1.5
    exact = -1 / np.sqrt(k)
    assert edgeworth_mode(0.0, 1.0, g1, g2, g3) == pytest.approx(exact, abs=1e-12)
    assert pearson_mode(0.0, 1.0, g1, g2) == pytest.approx(exact, abs=1e-12)
    assert paper_mode(0.0, 1.0, g1, g2) == pytest.approx(exact - 5 / k**1.5, abs=1e-12)
    median = (gamma(k).median() - k) / np.sqrt(k)
    assert edgeworth_median(0.0, 1.0, g1, g2, g3) == pytest.approx(median, abs=0.05 / k**2)


def test_numbers_of_the_notes():
    assert paper_mode(0.0, 1.0, 1.0, 1.5) == pytest.approx(-1.125)
    assert edgeworth_mode(2.0, 9.0, 1.0, 1.5, 3.0) == pytest.approx(2.0 - 3 * 0.5)
    assert edgeworth_median(0.0, 1.0, 1.0, 1.5, 3.0) == pytest.approx(-0.1642, abs=5e-5)
    assert (gamma(4).median() - 4) / 2 == pytest.approx(-0.1640, abs=5e-5)
    with pytest.raises(ModelError, match="no Pearson mode"):
        pearson_mode(0.0, 1.0, 0.0, -1.5)


@pytest.fixture(scope="module")
def posterior(cases):
    part = few(cases("moments_a1"), 6, 9)
    model, sensor = case("a1")
    history = MomentFilter().follow(model, sensor, part["z"], part["times"])
    grid = GridFilter(400, ([-3.5], [3.5])).densities(model, sensor, part["z"], part["times"])
    return history, grid.axes[0], grid.density[:, -1]


def test_density_mode_and_median_are_those_of_the_grid(posterior):
    history, y, density = posterior
    found = history.posterior
    total = density.sum(axis=1)
    h = y[1] - y[0]
    got = np.exp(found.log_pdf(y[:, None]))
    assert (0.5 * np.abs(got - total).sum(axis=-1) * h < 0.02).all()  # total variation
    np.testing.assert_allclose(got.sum(axis=-1) * h, 1.0, atol=1e-3)
    given = np.exp(found.log_pdf(y[:, None], mode=1)) * found.probs[:, 1, None]
    assert (np.abs(given - density[:, 1]).sum(axis=-1) * h < 0.04).all()
    median = np.array([np.interp(0.5, np.cumsum(p) * h, y + h / 2) for p in total])
    np.testing.assert_allclose(found.median()[:, 0], median, atol=0.015)
    # Heights at the modes agree; where humps are as high as each other either may win.
    at = np.exp(found.log_pdf(found.mode()[:, None]))[:, 0]
    assert (at >= got.max(axis=-1) - 1e-9).all()
    height = np.array([np.interp(m, y, p) for m, p in zip(found.mode()[:, 0], total, strict=True)])
    assert (height > 0.97 * total.max(axis=-1)).all()
    joint = found.mode(joint=True)[:, 0]
    best = np.array([max(np.interp(m, y, p) for p in run) for m, run in zip(joint, density, strict=True)])
    assert (best > 0.97 * density.max(axis=(1, 2))).all()


def test_moments_over_all_modes_follow_from_those_given_the_modes(posterior):
    found = posterior[0].posterior
    central = np.stack([np.stack([found.moment((k,), mode=s) for k in range(5)], axis=-1) for s in range(2)], axis=1)
    central[..., 1] = 0.0
    mean, total = unconditional(found.probs, found.mode_means()[..., 0], central)
    np.testing.assert_allclose(mean, found.mean()[:, 0], rtol=1e-12)
    for k in range(5):
        np.testing.assert_allclose(total[:, k], found.moment((k,)), rtol=1e-9, atol=1e-12)
    e = posterior[0].estimates
    np.testing.assert_allclose(total[:, 2], e.cov[:, -1, 0, 0], rtol=1e-9)
    np.testing.assert_allclose(found.mode_covs()[:, :, 0, 0], central[..., 2], rtol=1e-12)


def test_modes_and_medians_in_two_dimensions(cases):
    part = few(cases("moments_c"), 3, 5)
    model, sensor = case("c")
    found = MomentFilter().follow(model, sensor, part["z"], part["times"]).posterior
    grid = GridFilter(100).densities(model, sensor, part["z"], part["times"])
    total = grid.density[:, -1].sum(axis=1)
    x = np.stack(np.meshgrid(*grid.axes, indexing="ij"), axis=-1)
    for run, p in enumerate(total):
        at = x.reshape(-1, 2)[p.argmax()]
        assert np.linalg.norm(found.mode()[run] - at) < 0.2  # a flat top: heights decide
        assert np.exp(found.log_pdf(found.mode()[run][None])[run, 0]) > 0.95 * p.max()
        for axis in range(2):
            line = p.sum(axis=1 - axis)
            median = np.interp(0.5, np.cumsum(line) / line.sum(), grid.axes[axis] + np.diff(grid.axes[axis])[0] / 2)
            assert found.median()[run, axis] == pytest.approx(median, abs=0.03)
