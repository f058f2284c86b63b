"""How far a filter is from the optimum: figures against closed answers, model files, the command."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from oracles import error
from saltus import Chain, Gaussian, HybridModel, LinearSensor, ModelError, PositionSensor, constant_velocity
from saltus.cli import main
from saltus.filters import imm_filter
from saltus.gap import Scenario, load_scenario, optimality_gap
from saltus.gap.bound import informed_covariance
from saltus.gap.contenders import FAST, Problem, candidates, reference_of
from saltus.gap.result import Candidate, Figure, verdict
from saltus.models import FunctionSensor

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("gap_*.toml"))


def turning(sensor=None, sigma=1.0, **chain):
    turn = Chain("manoeuvre", ["cruise", "turn"], **(chain or {"trans": [[0.95, 0.05], [0.2, 0.8]]}))
    accel = {"by": {"manoeuvre": {"cruise": 0.1, "turn": 5.0}}}
    sensors = {"radar": PositionSensor(1, sigma=sigma) if sensor is None else sensor}
    return HybridModel([turn], constant_velocity(1, accel=accel), sensors, Gaussian([0.0, 1.0], np.diag([1.0, 1.0])))


def test_one_mode_loses_nothing_and_meets_the_bound():
    """A Kalman filter is optimal: no loss to the last digit, the bound is its covariance, NEES / n is 1."""
    model = HybridModel([], constant_velocity(1, 1.0), {"a": PositionSensor(1, 1.0)}, Gaussian([0, 0], np.eye(2)))
    gap = optimality_gap(model, runs=40, steps=20)
    for group in gap.groups.values():
        assert np.allclose(group.loss, 0.0, atol=1e-12)
        assert np.isclose(group.bound, group.stated_fast) and np.isclose(group.stated_fast, group.stated_reference)
        assert group.rmse_fast.low < group.bound < group.rmse_fast.high
    assert gap.nees_fast.low < 1 < gap.nees_fast.high
    assert gap.probability.value == 0 and abs(gap.log_likelihood.value) < 1e-9
    assert "as good as optimal" in gap.verdict and not gap.candidates


def test_figures_are_those_of_the_filters():
    model = turning()
    gap = optimality_gap(model, runs=30, steps=15, particles=400, judge={"place": [0], "both": [0, 1]})
    assert set(gap.groups) == {"place", "both"}
    for group in gap.groups.values():
        # The bound knows the modes, the reference does not; a filter's RMSE is within chance of what it claims.
        assert group.bound < group.stated_reference < 1.1 * group.stated_fast
        assert group.loss.low <= group.rmse_fast.value / group.rmse_reference.value - 1 <= group.loss.high
        assert np.isclose(group.loss.value, group.rmse_fast.value / group.rmse_reference.value - 1)
    assert 0 < gap.probability.value < 0.2 and gap.log_likelihood.high > 0
    assert 0 < gap.reference_error < 0.1
    again = optimality_gap(model, runs=30, steps=15, particles=400, judge={"place": [0], "both": [0, 1]})
    assert again.groups == gap.groups  # the same seed


def test_bound_is_the_kalman_filter_that_is_told_the_modes(rng):
    problem = Problem(turning(), 1.0, 12)
    modes = rng.integers(0, 2, size=(3, 12))
    arrays = problem.arrays
    P = informed_covariance(problem.flat, modes)
    for run in range(3):
        Q = arrays.Q[modes[run]]
        told = imm_filter(np.zeros((12, 1)), F=arrays.F[0], Q=Q, H=arrays.H[0], R=arrays.R[0], trans=[],
                          mean0=np.zeros(2), cov0=np.eye(2), probs0=1.0)  # fmt: skip
        assert error(P[run], told.cov) < 1e-10


def test_tangents_of_a_linear_function_are_its_matrix(rng):
    plain, hidden = turning(), turning(FunctionSensor(function=lambda x: x[..., :1], R=np.eye(1)))
    modes, states = rng.integers(0, 2, size=(2, 6)), rng.normal(size=(2, 6, 2))
    problem = Problem(hidden, 1.0, 6)
    straight = informed_covariance(Problem(plain, 1.0, 6).flat, modes)
    assert error(informed_covariance(problem.flat, modes, problem.sensor, states), straight) < 1e-7


def test_a_clumsy_filter_is_found_out_and_another_offered():
    """GPB1 forgets in which mode the state moved: with rare, violent turns and an accurate sensor that shows."""
    gap = optimality_gap(turning(sigma=0.3), runs=40, steps=30, particles=400, fast="GPB1")
    worst = gap.groups[gap.worst]
    assert worst.loss.value > 0 and gap.log_likelihood.low > 0
    assert gap.candidates and any(c.name == "GPB2" for c in gap.candidates)
    best = min(gap.candidates, key=lambda c: c.loss[gap.worst].value)
    assert best.loss[gap.worst].value < worst.loss.value


def test_nonlinear_sensors_take_particles_that_hold_the_state():
    model = turning(FunctionSensor(function=lambda x: np.tanh(x[..., :1] / 20), R=0.01 * np.eye(1)))
    gap = optimality_gap(model, runs=4, steps=8, particles=800)
    assert gap.reference == "800 particles" and np.isfinite(gap.groups["x0"].loss.value)
    with pytest.raises(ModelError, match="exact enumeration needs linear sensors"):
        optimality_gap(model, runs=4, steps=8, reference="exact")
    with pytest.raises(ModelError, match="GPB1 needs linear sensors"):
        optimality_gap(model, runs=4, steps=8, fast="GPB1")


@pytest.mark.parametrize(
    ("chain", "steps", "name"),
    [
        ({"trans": np.eye(2), "initial": [0.5, 0.5]}, 500, "exact"),
        ({"stay": 0.9}, 12, "exact"),
        ({"stay": 0.9}, 13, "64 Rao"),
    ],
)
def test_reference_enumerates_where_histories_are_few(chain, steps, name):
    assert reference_of(Problem(turning(**chain), 1.0, steps), "auto", 64)[0].startswith(name)


def test_candidates_are_filters(rng):
    problem = Problem(turning(), 1.0, 5)
    z = rng.normal(size=(3, 5, 1))
    for contender in (*FAST.values(), *candidates(problem, 100).values()):
        answer = contender(problem, z, rng)
        assert answer.mean.shape == (3, 5, 2) and answer.probs.shape == (3, 5, 2) and answer.seconds > 0


def test_verdict_says_what_the_figures_mean():
    import dataclasses

    gap = optimality_gap(turning(), runs=4, steps=5, particles=64)
    name = next(iter(gap.groups))

    def with_loss(value, low, high, candidates=(), **more):
        group = gap.groups[name]._replace(loss=Figure(value, low, high))
        return dataclasses.replace(gap, groups={name: group}, candidates=candidates, reference_error=0.01, **more)

    fair = Figure(1.0, 0.9, 1.1)
    rest = {"nees_fast": fair, "nees_reference": fair}
    assert "as good as optimal" in verdict(with_loss(0.01, -0.01, 0.03, **rest), linear=True)
    assert "More runs would tell" in verdict(with_loss(0.04, 0.01, 0.07, **rest), linear=True)
    gpb2 = Candidate("GPB2", {name: Figure(0.01, 0.0, 0.02)}, 5.0)
    lost = verdict(with_loss(0.2, 0.1, 0.3, (gpb2,), **rest), linear=True)
    assert "loses +20.0 %" in lost and "GPB2 does not" in lost and "merges histories by their newest mode" in lost
    assert "Of the filters tried only the reference" in verdict(with_loss(0.2, 0.1, 0.3, **rest), linear=True)
    sure = {"nees_fast": Figure(2.0, 1.8, 2.2), "nees_reference": fair}
    assert "covariance is too small" in verdict(with_loss(0.01, -0.01, 0.03, **sure), linear=True)
    blind = dataclasses.replace(with_loss(0.01, -0.01, 0.03, **rest), reference_error=0.9)
    assert verdict(blind, linear=True).startswith("No verdict")


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_are_models(path):
    scenario = load_scenario(path)
    assert scenario.title and scenario.judge
    assert optimality_gap(scenario, runs=2, steps=3, particles=64).runs == 2


def test_fusion_example_is_the_study_s_model():
    from saltus.studies.fusion import matrices

    arrays, study = (
        load_scenario(next(p for p in EXAMPLES if p.stem == "gap_fusion")).model.compile(dt=1.0),
        matrices("frozen"),
    )
    for name in ("F", "Q", "H", "R"):
        ours, theirs = np.broadcast_arrays(getattr(arrays, name), getattr(study, name))
        assert error(ours, theirs) < 1e-9, name


GOOD = """
[[chain]]
name = "manoeuvre"
states = ["cruise", "turn"]
stay = 0.9
[dynamics]
kind = "constant_velocity"
dims = 1
accel = {by = {manoeuvre = {cruise = 0.1, turn = 5.0}}}
[sensor.radar]
kind = "position"
dims = 1
sigma = 1.0
[prior]
mean = [0.0, 0.0]
sd = [1.0, 1.0]
"""


MANY_CHAINS = "".join(
    f'[[chain]]\nname = "c{k}"\nstates = {[str(i) for i in range(10)]}\nstay = 0.9\n' for k in range(9)
)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            'kind = "position"',
            'kind = "sonar"',
            r"\[sensor.radar\]: kind = 'sonar': give one of position, linear, polar",
        ),
        ("stay = 0.9", "stay = 1.5", "chain 'manoeuvre'"),
        ("stay", "stey", r"\[\[chain\]\] number 1: unknown key 'stey'. Did you mean stay"),
        ("sigma = 1.0", "", r"\[sensor.radar\]: the key 'sigma' is missing"),
        ("sigma = 1.0", "sgima = 30", r"\[sensor.radar\]: unknown key 'sgima'. Did you mean sigma"),
        ("sigma = 1.0", "sigma = nan", r"\[sensor.radar\]: PositionSensor sigma holds nan"),
        ("stay = 0.9", "trans = [[0.9, 0.2], [0.1, 0.9]]", r"\[\[chain\]\] number 1: .*sums to 1\.1"),
        ("stay = 0.9", "trans = [[0.5, 0.2], [0.1, 0.9]]", "give rates per second with 'rates'"),
        ("stay = 0.9", "stay = 1.0", r"Say where it starts: initial = \{label = probability, \.\.\.\}"),
        ("stay = 0.9", "trans = [[0.9], [0.1, 0.9]]", "its rows differ in length: 1, 2\\.$"),
        ("[prior]", "[priro]", r"unknown key 'priro'. Did you mean prior"),
        ("[prior]\nmean = [0.0, 0.0]\nsd = [1.0, 1.0]\n", "", r"\[prior\] is missing: write \[prior\] with mean = "),
        ("sd = [1.0, 1.0]", "sd = [1.0, -1.0]", r"\[prior\]: sd = \[1\.0, -1\.0\]: .*none negative"),
        ("sd = [1.0, 1.0]", "sd = [1.0, nan]", r"\[prior\]: sd holds nan"),
        ("manoeuvre = {", "manoeuver = {", "manoeuver"),
        ("sd = [1.0, 1.0]", "", r"\[prior\]: give either sd"),
        ("sd = [1.0, 1.0]", "sd = [1.0, 1.0, 1.0]", "dimension"),
        ("[prior]", "steps = 1\n[prior]", "unknown key 'steps'"),
        ("[[chain]]", "[[chain", "no readable TOML"),
        ("dims = 1\n", "dims = 1_000_000_000\n", r"\[dynamics\]: dims must be .* got 1000000000"),
        ("dims = 1\nsigma", "dims = 1_000_000_000\nsigma", r"\[sensor.radar\]: dims must be"),
        ("dims = 1\n", "dims = true\n", r"\[dynamics\]: dims must be .* got True"),
        ("stay = 0.9\n", "stay = 0.9\n" + MANY_CHAINS, "chains have 2 x 10 x 10 .* joint states"),
        ("[prior]", "[judge]\nplace = [4]\n[prior]", "judge 'place' names the states"),
    ],
)
def test_files_that_are_no_model_say_what_and_where(tmp_path, old, new, message):
    path = tmp_path / "model.toml"
    path.write_text(GOOD.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ModelError, match=message) as caught:
        load_scenario(path)
    assert str(path) in str(caught.value)


def test_program_prints_a_table_and_json(tmp_path):
    path, out = tmp_path / "model.toml", tmp_path / "gap.json"
    path.write_text(GOOD, encoding="utf-8")
    options = ["gap", str(path), "--runs", "4", "--particles", "64", "-o", str(out)]
    done = CliRunner().invoke(main, options)
    assert done.exit_code == 0 and "IMM against 64 Rao-Blackwellised particles" in done.output
    written = json.loads(out.read_text())
    assert set(written["groups"]) == {"position", "velocity"} and written["verdict"]
    assert written["groups"]["position"]["loss"].keys() == {"value", "low", "high"}
    printed = json.loads(CliRunner().invoke(main, [*options, "--json"]).output)
    del printed["candidates"], written["candidates"]  # their times differ from run to run
    printed.pop("verdict"), written.pop("verdict")
    assert printed == written
    path.write_text("x = 1", encoding="utf-8")
    assert CliRunner().invoke(main, options).exit_code == 2


def test_scenario_checks_its_numbers():
    with pytest.raises(ModelError, match="interval must be positive"):
        Scenario(turning(), interval=0.0)
    with pytest.raises(ModelError, match="runs >= 2"):
        optimality_gap(turning(), runs=1)
    with pytest.raises(ModelError, match="reference is"):
        optimality_gap(turning(), runs=2, reference="oracle")


def test_several_linear_sensors_are_stacked():
    sensors = {"a": PositionSensor(1, sigma=1.0), "b": LinearSensor([[0.0, 1.0]], [[0.5]])}
    model = HybridModel([], constant_velocity(1, 1.0), sensors, Gaussian([0, 0], np.eye(2)))
    assert optimality_gap(model, runs=3, steps=4).groups["x1"].loss.value == pytest.approx(0.0, abs=1e-12)
