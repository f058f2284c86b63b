import pickle

import numpy as np
import pytest

from saltus.errors import DataError, ModelError
from saltus.filters import imm_filter
from saltus.models import (
    Chain,
    Gaussian,
    HybridModel,
    LinearSDE,
    LinearSensor,
    LinearTransition,
    PositionSensor,
    constant_velocity,
)

TURN = Chain("manoeuvre", {"cruise": 3.0, "turn": 35.0}, stay=0.9, per=4.0)
RADAR = Chain("radar_condition", {"ok": 1.0, "jammed": 10.0}, sojourn={"ok": 600.0, "jammed": 20.0})
R0 = np.diag([100.0, 400.0])
H = np.eye(4)[::2]
PRIOR = Gaussian(np.arange(4.0), np.diag([1e4, 100.0, 1e4, 100.0]))


def a_model(**changes):
    parts = dict(
        chains=[TURN, RADAR],
        dynamics=constant_velocity(dims=2, accel=lambda manoeuvre: manoeuvre),
        sensors={"radar": LinearSensor(H=H, R=lambda radar_condition: radar_condition**2 * R0)},
        prior=PRIOR,
    )
    return HybridModel(**(parts | changes))


def test_compiles_to_the_shapes_of_the_filter():
    a = a_model().compile(dt=4.0)
    assert a.F.shape == (1, 1, 4, 4) and a.Q.shape == (2, 1, 4, 4)
    assert a.H.shape == (1, 1, 2, 4) and a.R.shape == (1, 2, 2, 2)
    assert [t.shape for t in a.trans] == [(2, 2), (2, 2)]
    assert a.b is None and a.d is None
    assert a.mean0.shape == (1, 1, 4) and a.cov0.shape == (1, 1, 4, 4)
    np.testing.assert_allclose(a.probs0, np.outer([0.5, 0.5], [600 / 620, 20 / 620]))
    np.testing.assert_allclose(a.R[0, 1], 100 * R0)
    np.testing.assert_allclose(a.trans[0], [[0.9, 0.1], [0.1, 0.9]], atol=1e-14)


def test_irregular_times_give_each_row_its_interval():
    times = np.array([10.0, 14.0, 14.0, 21.5])
    a = a_model().compile(times=times)
    assert a.F.shape == (4, 1, 1, 4, 4) and a.Q.shape == (4, 2, 1, 4, 4)
    np.testing.assert_allclose(a.F[:, 0, 0, 0, 1], [0.0, 4.0, 0.0, 7.5])  # the prior holds at times[0]
    for k, dt in enumerate([0.0, 4.0, 0.0, 7.5]):
        np.testing.assert_allclose(a.trans[1][k], RADAR.transition(dt), atol=1e-15)
        one = a_model().compile(dt=dt)
        np.testing.assert_allclose(a.Q[k], one.Q)
    early = a_model(prior=Gaussian(PRIOR.mean, PRIOR.cov, time=8.0)).compile(times=times)
    np.testing.assert_allclose(early.F[:, 0, 0, 0, 1], [2.0, 4.0, 0.0, 7.5])


def test_equal_intervals_have_no_time_axis():
    assert a_model().compile(dt=np.full(5, 4.0)).F.shape == (1, 1, 4, 4)
    early = a_model(prior=Gaussian(PRIOR.mean, PRIOR.cov, time=6.0))
    assert early.compile(times=[10.0, 14.0, 18.0]).trans[0].shape == (2, 2)


def test_filter_takes_the_arrays(rng):
    # One row of the filter against the rows written out: two states, scalar algebra in matrix form.
    z = rng.normal(size=(1, 2)) * 50
    a = a_model(chains=[RADAR], dynamics=constant_velocity(2, accel=3.0, kind="scan")).compile(dt=4.0)
    estimates = imm_filter(z, **a._asdict())
    F = np.kron(np.eye(2), [[1.0, 4.0], [0.0, 1.0]])
    g = np.array([8.0, 4.0])
    P = F @ PRIOR.cov @ F.T + np.kron(np.eye(2), 9.0 * np.outer(g, g))
    probs = RADAR.law @ RADAR.transition(4.0)
    weights = []
    for p, factor in zip(probs, (1.0, 100.0), strict=True):
        S = H @ P @ H.T + factor * R0
        nu = z[0] - H @ F @ PRIOR.mean
        weights.append(p * np.exp(-0.5 * nu @ np.linalg.inv(S) @ nu) / np.sqrt(np.linalg.det(2 * np.pi * S)))
    np.testing.assert_allclose(estimates.probs[0], np.array(weights) / sum(weights), rtol=1e-10)
    np.testing.assert_allclose(estimates.log_likelihood[0], np.log(sum(weights)), rtol=1e-10)


def test_no_chains_is_a_kalman_filter(rng):
    model = a_model(chains=[], dynamics=constant_velocity(2, accel=1.0), sensors={"s": PositionSensor(2, 10.0)})
    a = model.compile(dt=1.0)
    assert a.F.shape == (4, 4) and a.trans == () and a.probs0.shape == ()
    assert model.n_modes == 1 and model.sizes == () and model.n_state == 4
    assert imm_filter(rng.normal(size=(3, 2)), **a._asdict()).mean.shape == (3, 4)


def test_several_sensors_are_stacked_and_absent_ones_missing(rng):
    passive = LinearSensor(H=[[0.0, 1.0, 0.0, 0.0]], R=lambda gain: [[gain]], d=[5.0])
    gain = Chain("gain", {"low": 1.0, "high": 9.0}, stay=0.9, per=1.0)
    model = a_model(
        chains=[TURN, RADAR, gain],
        sensors={
            "radar": LinearSensor(H=H, R=lambda radar_condition: radar_condition**2 * R0),
            "unused": PositionSensor(2, 1.0),
            "passive": passive,
        },
        dynamics=LinearSDE(F=np.zeros((4, 4)), G=np.eye(4)),
    )
    times, names = [0.0, 1.0, 1.0, 2.5], ["passive", "radar", "passive", "radar"]
    layout, a = model.arrays_for(times, np.array(names))
    assert layout.columns == {"radar": slice(0, 2), "passive": slice(2, 3)} and layout.n_measured == 3
    z = layout.stack(names, [[1.0], [2.0, 3.0], [4.0], [5.0, 6.0]])
    nan = np.nan
    np.testing.assert_array_equal(z, [[nan, nan, 1], [2, 3, nan], [nan, nan, 4], [5, 6, nan]])
    assert a.H.shape == (1, 2, 2, 3, 4) and a.R.shape == (1, 2, 2, 3, 3)
    np.testing.assert_array_equal(a.R[0, 1, 1], np.diag([1e4, 4e4, 9.0]))
    np.testing.assert_array_equal(a.d[0, 0, 0], [0.0, 0.0, 5.0])
    np.testing.assert_array_equal(a.H[0, 0, 0], [[1, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0]])
    assert np.isfinite(imm_filter(z, **a._asdict()).mean).all()
    assert model.compile(dt=1.0).H.shape == (1, 2, 2, 5, 4)  # by default every sensor, in every row
    assert model.compile(dt=1.0, sensor="passive").H.shape == (1, 1, 1, 1, 4)


def test_sensors_and_motion_may_depend_on_time():
    model = a_model(
        sensors={
            "radar": LinearSensor(H=H, R=lambda t, radar_condition: radar_condition * (1 + t) * np.eye(2)),
            "other": PositionSensor(2, 3.0),
        },
        dynamics=LinearTransition(F=np.eye(4), Q=lambda t, dt: t * dt * np.eye(4)),
    )
    a = model.compile(times=[1.0, 3.0, 5.0])
    assert a.R.shape == (3, 1, 2, 4, 4) and a.H.shape == (3, 1, 2, 4, 4)
    np.testing.assert_allclose(a.R[:, 0, 1, 0, 0], [20.0, 40.0, 60.0])
    np.testing.assert_allclose(a.R[:, 0, 1, 3, 3], 9.0)
    np.testing.assert_allclose(a.Q[:, 0, 0, 0, 0], [0.0, 6.0, 10.0])
    with pytest.raises(ModelError, match="depends on t: compile the model with times="):
        model.compile(dt=1.0)


def test_per_step_chain_and_first_record():
    step = Chain("manoeuvre", {"cruise": 3.0, "turn": 35.0}, stay=0.9)
    trans = a_model(chains=[step, RADAR]).compile(times=[0.0, 4.0, 8.0]).trans[0]
    np.testing.assert_allclose(trans, [np.eye(2), step.trans, step.trans])
    with pytest.raises(ModelError, match="needs equal intervals"):
        a_model(chains=[step, RADAR]).compile(times=[0.0, 4.0, 9.0])


def test_prior_depends_on_chains():
    prior = Gaussian(lambda manoeuvre: np.full(4, manoeuvre), lambda radar_condition: radar_condition * np.eye(4))
    a = a_model(prior=prior).compile(dt=1.0)
    assert a.mean0.shape == (2, 1, 4) and a.cov0.shape == (1, 2, 4, 4)


def test_compares_prints_and_pickles():
    model = a_model()
    assert pickle.loads(pickle.dumps(model)) == model == a_model()
    assert model != a_model(chains=[RADAR, TURN])
    assert "manoeuvre" in repr(model) and "law='velocity'" in repr(model)
    assert model.chain("manoeuvre") == TURN


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(chains=[TURN, TURN]), "two chains are called 'manoeuvre'"),
        (dict(chains=[RADAR]), "accel asks for 'manoeuvre', which is no chain of this model. Chains: radar_condition"),
        (dict(chains=[TURN]), "sensor 'radar': LinearSensor R asks for 'radar_condition'"),
        (dict(sensors={}), "at least one sensor"),
        (dict(sensors={"p": PositionSensor(3, 1.0)}), "sensor 'p': PositionSensor over 3 axes does not fit"),
        (dict(prior=Gaussian([0.0, 0.0], np.eye(2))), "the prior has 2 components, but the dynamics has 4"),
        (
            dict(sensors={"r": LinearSensor(H=H, R=lambda manoeuvre: [[1, manoeuvre], [manoeuvre, 1]])}),
            "sensor 'r': LinearSensor R must be positive semi-definite",
        ),
        (
            dict(sensors={"r": LinearSensor(H=H, R=lambda manoeuvre: np.eye(3))}),
            r"sensor 'r': LinearSensor R must have shape \(2, 2\)",
        ),
    ],
)
def test_bad_models(changes, message):
    with pytest.raises(ModelError, match=message):
        a_model(**changes)


@pytest.mark.parametrize(
    "call, error, message",
    [
        (lambda m: m.compile(), ModelError, "exactly one of times= and dt="),
        (lambda m: m.compile(dt=1.0, times=[0.0]), ModelError, "exactly one"),
        (lambda m: m.compile(dt=-1.0), ModelError, "must not be negative"),
        (lambda m: m.compile(dt=np.ones((2, 2))), ModelError, r"one per step \(T,\), got shape \(2, 2\)"),
        (lambda m: m.compile(dt=1.0, sensor="sonar"), ModelError, "no sensor 'sonar'. Sensors: radar"),
        (lambda m: m.compile(times=[0.0, 2.0, 1.0]), DataError, "decrease at row 2: 1.000000 s after 2.000000 s"),
        (lambda m: m.compile(times=[]), DataError, "non-empty vector"),
        (lambda m: m.compile(times=[-1.0, 2.0]), DataError, "prior holds at 0 s, after the first measurement at -1 s"),
        (lambda m: m.arrays_for([0.0, 1.0], ["radar"]), DataError, "1 sensor names for 2 times"),
        (lambda m: m.arrays_for([0.0], ["sonar"]), DataError, "row 0: the model has no sensor 'sonar'"),
        (lambda m: m.chain("c"), ModelError, "no chain is called 'c'. Chains: manoeuvre, radar_condition"),
    ],
)
def test_bad_calls(call, error, message):
    with pytest.raises(error, match=message):
        call(a_model(prior=Gaussian(PRIOR.mean, PRIOR.cov, time=0.0)))


def test_bad_stacks():
    layout, _ = a_model().arrays_for([0.0], ["radar"])
    for names, rows, message in (
        (["radar"], [], "1 sensor names for 0"),
        (["sonar"], [[1.0, 2.0]], "row 0: sensor 'sonar' is not in this layout, which has radar"),
        (["radar"], [[1.0]], r"row 0: sensor 'radar' measures 2 component\(s\), got shape \(1,\)"),
    ):
        with pytest.raises(DataError, match=message):
            layout.stack(names, rows)


@pytest.mark.parametrize(
    "mean, cov, message",
    [
        ([0.0], np.eye(2), "differ in dimension"),
        ([np.nan], np.eye(1), "mean holds nan"),
        ([0.0, 0.0], [[1, 2], [2, 1]], "positive semi-definite"),
    ],
)
def test_bad_gaussians(mean, cov, message):
    with pytest.raises(ModelError, match=message):
        Gaussian(mean, cov)
