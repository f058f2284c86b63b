"""Conditions of sensors against measurements written out by hand."""

import numpy as np
import pytest

from oracles import error
from saltus import IMM, Chain, Gaussian, HybridModel, LinearSensor, ModelError, PositionSensor, constant_velocity
from saltus.models import PolarSensor
from saltus.models.conditions import OK, Condition, FaultySensor, lost, outliers

R = np.array([[4.0, 1.0], [1.0, 9.0]])
H = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
D = np.array([10.0, 20.0])
JAM = Chain("jam", {"ok": OK, "jammed": Condition(noise=10.0)}, stay=0.9)
DRIFT = Chain("drift", {"ok": OK, "off": Condition(bias=3.0), "gain": Condition(gain=2.0)}, stay=0.9)
TURN = Chain("turn", {"no": 0.1, "yes": 2.0}, stay=0.9)
PRIOR = Gaussian([100.0, 1.0, 200.0, 0.0], np.diag([25.0, 1.0, 25.0, 1.0]))


def model(sensors, *chains, accel=1.0):
    return HybridModel(chains, constant_velocity(2, accel=accel), sensors, PRIOR)


def linear(**change):
    return LinearSensor(H=H, R=R, d=D) if not change else LinearSensor(**({"H": H, "R": R, "d": D} | change))


@pytest.mark.parametrize(
    ("condition", "gain", "bias", "noise"),
    [
        (Condition(noise=10.0), [1, 1], [0, 0], 100 * R),
        (Condition(noise=[1.0, 10.0]), [1, 1], [0, 0], [[4, 10], [10, 900]]),
        (Condition(gain=[1.0, 2.0]), [1, 2], [0, 0], R),
        (Condition(bias=[0.0, -5.0]), [1, 1], [0, -5], R),
        (Condition(noise=2.0, gain=0.5, bias=1.0), [0.5, 0.5], [1, 1], 4 * R),
        (lost(), [0, 0], [0, 0], R),
        (lost(span=np.sqrt(12.0) * np.array([100.0, 50.0]), centre=[7.0, 8.0]), [0, 0], [7, 8], np.diag([1e4, 2500.0])),
    ],
)
def test_each_condition_is_its_equation(condition, gain, bias, noise):
    chain = Chain("state", {"ok": OK, "bad": condition}, stay=0.9)
    arrays = model({"s": FaultySensor(linear(), ["state"])}, chain).compile(dt=1.0)
    bad_H, bad_d = np.array(gain)[:, None] * H, np.array(gain) * D + bias
    for i, (want_H, want_d, want_R) in enumerate(((H, D, R), (bad_H, bad_d, noise))):
        assert error(arrays.H[i], want_H) < 1e-14
        assert error(arrays.d[i], want_d) < 1e-14
        assert error(arrays.R[i], want_R) < 1e-14


def test_a_loss_of_one_component_takes_its_correlations_along():
    chain = Chain("state", {"ok": OK, "lost": lost(span=np.sqrt(12.0) * 100.0)}, stay=0.9)
    arrays = model({"s": FaultySensor(linear(), {"state": [1]})}, chain).compile(dt=1.0)
    assert error(arrays.R[1], [[4.0, 0.0], [0.0, 1e4]]) < 1e-14
    assert error(arrays.H[1], H * [[1.0], [0.0]]) < 1e-14


def test_axes_are_those_of_the_chains_named():
    sensors = {"a": FaultySensor(linear(), ["jam"]), "b": FaultySensor(linear(), {"drift": [0]}), "c": linear()}
    m = model(sensors, TURN, JAM, DRIFT, accel=lambda turn: turn)
    assert m.sensors["a"].R.shape == (1, 2, 1, 2, 2)
    assert m.sensors["b"].d.shape == (1, 1, 3, 2)
    assert m.sensors["c"].H.shape == (1, 1, 1, 2, 4)
    assert isinstance(m.sensors["a"], LinearSensor) and m.check() == []


def test_chains_multiply_on_one_sensor():
    sensor = FaultySensor(linear(), {"drift": [0], "jam": None})
    arrays = model({"s": sensor}, JAM, DRIFT).compile(dt=1.0)
    for i, noise in enumerate((1.0, 10.0)):
        for j, (bias, gain) in enumerate(((0.0, 1.0), (3.0, 1.0), (0.0, 2.0))):
            R_ij = np.broadcast_to(arrays.R, (2, 3, 2, 2))[i, j]
            H_ij, d_ij = (np.broadcast_to(a, (2, 3, *a.shape[2:]))[i, j] for a in (arrays.H, arrays.d))
            assert error(R_ij, noise**2 * R) < 1e-14
            assert error(H_ij, H * [[gain], [1.0]]) < 1e-14
            assert error(d_ij, [gain * 10.0 + bias, 20.0]) < 1e-14


def test_a_loss_overrules_what_else_is_wrong():
    gone = Chain("gone", {"ok": OK, "gone": lost(span=np.sqrt(12.0), centre=5.0)}, stay=0.9)
    arrays = model({"s": FaultySensor(linear(), ["drift", "gone"])}, DRIFT, gone).compile(dt=1.0)
    for j in range(3):
        assert error(arrays.R[j, 1], np.eye(2)) < 1e-14
        assert np.abs(arrays.H[j, 1]).max() == 0.0
        assert arrays.d[j, 1].tolist() == [5.0, 5.0]


def test_a_sensor_that_depends_on_chains_itself():
    sensor = FaultySensor(PositionSensor(2, sigma=lambda turn: 1.0 + turn), ["jam"])
    arrays = model({"s": sensor}, TURN, JAM).compile(dt=1.0)
    for i, turn in enumerate((0.1, 2.0)):
        for j, noise in enumerate((1.0, 10.0)):
            assert error(arrays.R[i, j], (noise * (1 + turn)) ** 2 * np.eye(2)) < 1e-14


def test_one_chain_shared_by_two_sensors_is_learnt_from_both(rng):
    # A fault seen by the coarse sensor is already known to the fine one.
    noise = {"fine": 1.0, "coarse": 1.0}
    shared = model({k: FaultySensor(PositionSensor(2, s), ["jam"]) for k, s in noise.items()}, JAM)
    other = Chain("own", dict(JAM.states), stay=0.9)
    apart = HybridModel(
        [JAM, other],
        constant_velocity(2, accel=1.0),
        {
            "fine": FaultySensor(PositionSensor(2, 1.0), ["jam"]),
            "coarse": FaultySensor(PositionSensor(2, 1.0), ["own"]),
        },
        PRIOR,
    )
    records = [(0.0, "coarse", [100.0, 200.0]), (1.0, "coarse", [150.0, 160.0]), (1.0, "fine", [101.0, 200.5])]
    together, alone = IMM(shared).run(records), IMM(apart).run(records)
    assert together.prob("jam")[1, 1] > 0.99
    assert alone.prob("own")[1, 1] > 0.99 and alone.prob("jam")[1, 1] < 0.6
    joint = alone.prob("own", "jam")
    assert joint.shape == (3, 2, 2) and error(joint.sum(-1), alone.prob("own")) < 1e-12


def test_time_dependent_sensors_run_through_records():
    timed = LinearSensor(H=H, R=lambda t: (1.0 + t) * R)
    m = model({"s": FaultySensor(timed, ["jam"])}, JAM)
    now = m.sensors["s"].at(3.0)
    assert isinstance(now, LinearSensor) and error(now.noise()[1], 400 * R) < 1e-14
    plain = model({"s": LinearSensor(H=H, R=lambda jam, t: np.square(jam.noise) * (1.0 + t) * R)}, JAM)
    records = [(float(k), "s", [100.0 + k, 200.0 + 8 * (k == 2)]) for k in range(5)]
    one, two = IMM(m).run(records), IMM(plain).run(records)
    assert error(one.mean, two.mean) < 1e-9 and error(one.prob("jam"), two.prob("jam")) < 1e-9


def test_nonlinear_sensors_degrade_component_by_component():
    polar = PolarSensor(sigma_range=10.0, sigma_azimuth=0.01)
    azimuth = Chain("azimuth", {"ok": OK, "off": Condition(bias=0.1), "lost": lost(span=2 * np.pi)}, stay=0.9)
    m = model({"radar": FaultySensor(polar, {"azimuth": [1], "jam": [0]})}, azimuth, JAM)
    bound, x = m.sensors["radar"].at(0.0), np.broadcast_to([300.0, 1.0, 400.0, 0.0], (3, 2, 4))
    angle = np.arctan2(300.0, 400.0)
    want = [[[500.0, angle]] * 2, [[500.0, angle + 0.1]] * 2, [[500.0, 0.0]] * 2]
    assert error(bound.h(x), want) < 1e-14
    sd = np.sqrt(np.diagonal(np.broadcast_to(bound.noise(), (3, 2, 2, 2)), axis1=-2, axis2=-1))
    flat = 2 * np.pi / np.sqrt(12.0)
    assert error(sd[..., 0], np.tile([10.0, 100.0], (3, 1))) < 1e-14
    assert error(sd[..., 1], np.repeat([[0.01], [0.01], [flat]], 2, axis=1)) < 1e-14
    step = 1e-4
    numeric = np.stack([(bound.h(x + e) - bound.h(x - e)) / (2 * step) for e in step * np.eye(4)], axis=-1)
    assert error(bound.jacobian(x), numeric) < 1e-8
    # An azimuth that is off by ten standard deviations is found out, the range stays trusted.
    line = [(float(k), "radar", [np.hypot(100.0 + k, 200.0), np.arctan2(100.0 + k, 200.0)]) for k in range(6)]
    off = [(t, s, [r, a + 0.1 * (t >= 3)]) for t, s, (r, a) in line]
    p = IMM(m).run(off)
    assert p.prob("azimuth")[2, 0] > 0.8 and p.prob("azimuth")[5, 1] > 0.9 and p.prob("jam")[5, 0] > 0.8


def test_outliers_and_bursts_have_the_share_and_length_asked_for():
    single, burst = outliers("o", share=0.02), outliers("o", share=0.02, length=4.0)
    assert single.memoryless and not burst.memoryless
    for chain in (single, burst):
        np.testing.assert_allclose(chain.law, [0.98, 0.02], atol=1e-12)
        np.testing.assert_allclose(chain.law @ chain.transition(1.0), chain.law, atol=1e-12)
    assert abs(1 / (1 - burst.trans[1, 1]) - 4.0) < 1e-12
    assert single.values[1] == Condition(noise=30.0) and single.values[1] != OK


def test_a_lost_measurement_changes_nothing_but_the_odds():
    gone = Chain("gone", {"ok": OK, "gone": lost(span=1000.0)}, trans=[[0.0, 1.0], [0.0, 1.0]])
    m = model({"s": FaultySensor(PositionSensor(2, 1.0), ["gone"])}, gone)
    est = IMM(m).run([(0.0, "s", [17.0, -400.0]), (1.0, "s", [90.0, 300.0])])
    F = np.kron(np.eye(2), [[1.0, 1.0], [0.0, 1.0]])
    assert error(est.mean[1], F @ F @ np.linalg.inv(F) @ PRIOR.mean) < 1e-12
    assert (est.prob("gone")[:, 1] == 1.0).all()


def test_states_no_measurement_can_tell_apart_are_named():
    twins = Chain("state", {"ok": OK, "jammed": Condition(noise=3.0), "deaf": Condition(noise=3.0)}, stay=0.9)
    found = model({"s": FaultySensor(linear(), ["state"])}, twins).check()
    assert [(f.kind, f.where) for f in found] == [("indistinguishable", "chain state, states jammed and deaf")]
    unused = model({"s": FaultySensor(linear(), ["jam"])}, JAM, DRIFT).check()
    assert {f.where for f in unused} >= {"chain drift, states ok and off"}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Condition(noise=0.0), "noise must be positive, got 0: no measurement is free of noise"),
        (lambda: Condition(noise=[1.0, -2.0]), "noise must be positive, got -2"),
        (lambda: lost(span=0.0), "spread must be positive"),
        (lambda: Condition(bias=np.inf), "Condition bias holds inf"),
        (lambda: Condition(bias=np.eye(2)), "one per component"),
        (lambda: Condition(bias=[1.0, 2.0], noise=[1.0, 2.0, 3.0]), r"different lengths \[2, 3\]"),
        (lambda: FaultySensor(linear(), []), "needs chains, each once; got none"),
        (lambda: FaultySensor(linear(), ["jam", "jam"]), "each once; got jam, jam"),
        (lambda: model({"s": FaultySensor(linear(), ["fog"])}, JAM), "'fog', which is no chain of this model"),
        (lambda: model({"s": FaultySensor(linear(), ["turn"])}, TURN), "'no' has the value 0.1, which is no Condition"),
        (lambda: model({"s": FaultySensor(linear(), {"jam": [2]})}, JAM), "components .2., but the sensor measures 2"),
        (lambda: model({"s": FaultySensor(linear(), {"jam": [0, 0]})}, JAM), r"components \[0, 0\]"),
        (lambda: model({"s": linear()}, JAM, JAM), "two chains are called 'jam'"),
        (lambda: outliers("o", share=1.0), "share must lie in"),
        (lambda: outliers("o", share=0.9, length=2.0), "length must be at least 9"),
        (lambda: outliers("o", share=0.1, length=0.5), "length must be at least 1"),
    ],
)
def test_what_cannot_be_is_refused(make, message):
    with pytest.raises(ModelError, match=message):
        make()


def test_entries_must_fit_the_components():
    three = Chain("state", {"ok": OK, "bad": Condition(bias=[1.0, 2.0, 3.0])}, stay=0.9)
    with pytest.raises(ModelError, match="state 'bad': the condition has 3 entries, but acts on 2"):
        model({"s": FaultySensor(linear(), ["state"])}, three)


def test_models_with_faulty_sensors_compare_and_pickle():
    import pickle

    polar = PolarSensor(sigma_range=10.0, sigma_azimuth=0.01)
    for sensor in (linear(), polar):
        one, two = (model({"s": FaultySensor(sensor, ["jam"])}, JAM) for _ in range(2))
        assert one == two and pickle.loads(pickle.dumps(one)) == one
        assert one != model({"s": FaultySensor(sensor, {"jam": [0]})}, JAM)
