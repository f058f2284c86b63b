"""`ParticleFilter` on switching diffusions, on hybrid models with linear and with nonlinear sensors, on records."""

import numpy as np
import pytest

from diffusions import case
from oracles import error
from saltus import (
    Chain,
    DataError,
    Gaussian,
    HybridModel,
    LinearSensor,
    ModelError,
    ParticleFilter,
    PositionSensor,
    constant_velocity,
)
from saltus.filters import exact_filter, imm_filter
from saltus.models import FunctionSensor, PolarSensor


def off(est, d):
    """Distance of the mean from the grid's, in posterior standard deviations."""
    mean, cov = d["grid_mean"], d["grid_cov"] if "grid_cov" in d else d["grid_var"][..., None, None]
    gap = (est.mean - mean.reshape(est.mean.shape))[..., None]
    return np.sqrt((gap.swapaxes(-1, -2) @ np.linalg.solve(cov, gap))[..., 0, 0])


@pytest.mark.parametrize(
    ("name", "proposal", "limit"),
    # Errors of the notes' bootstrap filter with 400 particles, section 11, with a third for seed and fewer trials.
    [("a1", "bootstrap", 0.1), ("a1", "auxiliary", 0.1), ("br", "bootstrap", 0.16), ("b", "auxiliary", 0.1)],
)
def test_grid_posteriors_of_switching_diffusions(cases, name, proposal, limit):
    d, trials = cases(f"moments_{name}"), slice(0, 20)
    model, sensor = case(name)
    d = {key: value if key == "times" else value[trials] for key, value in d.items()}
    est = ParticleFilter(480, proposal=proposal).run(
        model, sensor, d["z"][..., None], d["times"], np.random.default_rng(0)
    )
    assert est.probs.shape == (20, 60, 2) and np.allclose(est.probs.sum(-1), 1.0)
    assert np.sqrt(np.mean(off(est, d) ** 2)) < limit
    assert np.sqrt(np.mean((est.probs[..., 0] - d["grid_prob1"]) ** 2)) < limit
    # Groups of 60 particles are biased by a part of their spread: a few of a hundred fall out besides the five.
    assert 0.85 < np.mean(off(est, d) <= est.error) < 0.995


def test_error_falls_with_the_root_of_the_number(cases):
    d = cases("moments_a1")
    model, sensor = case("a1")
    z = d["z"][:, :, None]
    few, many = (ParticleFilter(n).run(model, sensor, z, d["times"], np.random.default_rng(1)) for n in (128, 1152))
    ratio = np.sqrt(np.mean(off(few, d) ** 2) / np.mean(off(many, d) ** 2))
    assert 2.0 < ratio < 4.5  # sqrt(9) = 3
    assert 2.0 < np.sqrt(np.mean(few.error**2) / np.mean(many.error**2)) < 4.5


def turning(sensors):
    turn = Chain("manoeuvre", {"cruise": 0.3, "turn": 3.0}, trans=[[0.9, 0.1], [0.2, 0.8]])
    motion = constant_velocity(1, accel=lambda manoeuvre: manoeuvre)
    return HybridModel([turn], motion, sensors, Gaussian([0.0, 1.0], np.diag([4.0, 1.0])))


def test_linear_hybrid_models_take_the_rao_blackwellised_form(rng):
    model = turning({"radar": PositionSensor(1, sigma=1.0), "rate": LinearSensor([[0.0, 1.0]], [[0.25]])})
    z = rng.normal(size=(4, 6, 2)) * 3
    times = np.arange(1.0, 7.0)
    est = ParticleFilter(600).run(model, None, z, times, rng)
    exact = exact_filter(z, **model.compile(dt=1.0)._asdict())
    assert est.chains == ("manoeuvre",) and est.probs.shape == (4, 6, 2)
    assert error(est.mean, exact.mean) < 0.01 and np.abs(est.probs - exact.probs).max() < 0.05
    one = ParticleFilter(600).run(model, "radar", z[0, :, :1], times, rng)
    alone = exact_filter(z[0, :, :1], **model.compile(dt=1.0, sensor="radar")._asdict())
    assert error(one.mean, alone.mean) < 0.02


@pytest.mark.parametrize("proposal", ["bootstrap", "auxiliary"])
def test_particles_that_hold_the_state_agree_with_the_exact_answer_of_a_linear_function(rng, proposal):
    """A sensor that is linear but does not say so goes through the other form."""
    plain = turning({"radar": PositionSensor(1, sigma=1.0)})
    hidden = turning({"radar": FunctionSensor(function=lambda x: x[..., :1], R=np.eye(1))})
    z = np.cumsum(rng.normal(size=(5, 6, 1)), axis=1)
    z[0, 2] = np.nan
    times = np.arange(1.0, 7.0)
    est = ParticleFilter(6000, proposal=proposal).run(hidden, None, z, times, rng)
    exact = exact_filter(z, **plain.compile(dt=1.0)._asdict())
    gap = (est.mean - exact.mean)[..., None]
    distance = np.sqrt((gap.swapaxes(-1, -2) @ np.linalg.solve(exact.cov, gap))[..., 0, 0])
    assert np.sqrt(np.mean(distance**2)) < 0.1 and np.mean(distance <= est.error) > 0.8
    assert np.abs(est.log_likelihood - exact.log_likelihood).max() < 0.15
    assert np.abs(est.nis - exact.nis).max() < 0.3
    assert est.log_likelihood[0, 2] == pytest.approx(0.0, abs=1e-12)


def test_records_of_several_sensors(rng):
    model = turning({"radar": PositionSensor(1, sigma=1.0), "rate": LinearSensor([[0.0, 1.0]], [[0.25]])})
    records = [(0.0, "radar", [0.3]), (1.0, "rate", [1.1]), (2.0, "radar", [2.2])]
    est = ParticleFilter(400)(model).run(records, rng=rng)
    layout, arrays = model.arrays_for([0.0, 1.0, 2.0], ["radar", "rate", "radar"])
    exact = imm_filter(layout.stack(["radar", "rate", "radar"], [[0.3], [1.1], [2.2]]), **arrays._asdict())
    assert est.times.tolist() == [0.0, 1.0, 2.0] and np.abs(est.mean - exact.mean).max() < 0.1
    with pytest.raises(DataError, match="record 0: the model has no sensor 'sonar'"):
        ParticleFilter(400)(model).run([(0.0, "sonar", [1.0])], rng=rng)
    with pytest.raises(DataError, match="record 0: sensor 'rate' measures 1 component"):
        ParticleFilter(400)(model).run([(0.0, "rate", [1.0, 2.0])], rng=rng)


def test_a_radar_s_range_and_azimuth(rng):
    motion = constant_velocity(2, accel=1.0)
    radar = PolarSensor(sigma_range=1.0, sigma_azimuth=0.02)
    model = HybridModel([], motion, {"radar": radar}, Gaussian([40.0, 0.0, 30.0, 0.0], np.diag([9.0, 1.0, 9.0, 1.0])))
    z = np.array([[[50.0, np.arctan2(40.0, 30.0)], [50.5, np.arctan2(40.0, 30.0)]]])
    est = ParticleFilter(4000).run(model, None, z, [1.0, 2.0], rng)
    assert est.probs.shape == (1, 2)
    assert np.linalg.norm(est.mean[0, -1, ::2] - [40.4, 30.3]) < 1.0
    assert np.linalg.eigvalsh(est.cov)[..., 0].min() > 0


def test_what_cannot_be_says_so(rng):
    model, sensor = case("a1")
    z, times = np.zeros((3, 1)), [0.2, 0.4, 0.6]
    with pytest.raises(ModelError, match=r"pass rng="):
        ParticleFilter(100).run(model, sensor, z, times)
    with pytest.raises(ModelError, match="at least two groups"):
        ParticleFilter(3)
    with pytest.raises(DataError, match="times"):
        ParticleFilter(100).run(model, sensor, z, times[::-1], rng)
    with pytest.raises(ModelError, match="own sensors"):
        ParticleFilter(100).run(turning({"radar": PositionSensor(1, sigma=1.0)}), sensor, z, times, rng)
