"""The moment filter against reference posteriors, Kalman filters, sampled exact mixtures and the grid."""

import numpy as np
import pytest

from diffusions import case, distances, double_well, exact_mixture, few, leaving
from saltus import (
    Chain,
    DataError,
    DiffusionSensor,
    Gaussian,
    GridFilter,
    HybridModel,
    LinearSDE,
    LinearSensor,
    ModelError,
    MomentFilter,
    SwitchingSDE,
    imm_filter,
)
from saltus.filters import Adapt, GaussianSumFilter
from saltus.models import discretise
from saltus.simulate import simulate_diffusion


@pytest.fixture(scope="module")
def found(cases):
    """Distances from the reference posterior, of order 4 and of order 2, and the repairs of order 4."""
    results = {}
    for name, runs, steps in (("a1", 12, 30), ("a2", 12, 30), ("c", 6, 20)):
        part = few(cases(f"moments_{name}"), runs, steps)
        model, sensor = case(name)
        history = MomentFilter().follow(model, sensor, part["z"], part["times"])
        plain = MomentFilter(closure="gaussian").run(model, sensor, part["z"], part["times"])
        results[name] = distances(history.estimates, part), distances(plain, part), history
    return results


@pytest.mark.parametrize("name", ["a1", "a2", "c"])
def test_order_four_is_within_a_few_hundredths_of_the_posterior(found, name):
    (mean, cov, prob), _, history = found[name]
    assert mean <= 0.03 and cov <= 0.03 and prob <= 0.02
    assert not history.diagnostics.failed.any() and not history.diagnostics.dropped.any()


@pytest.mark.parametrize(("name", "times"), [("a1", 5.0), ("a2", 5.0), ("c", 4.0)])
def test_order_four_is_several_times_closer_than_order_two(found, name, times):
    """In c part of the distance, about 0.007, is the reference's own error."""
    four, two, _ = found[name]
    assert two[0] > times * four[0] and two[1] > times * four[1]


def test_orders_converge_where_posteriors_are_mildly_bent(cases):
    part = few(cases("moments_b"), 8, 30)
    model, sensor = case("b")
    off = [
        distances(MomentFilter(order=order, closure=closure).run(model, sensor, part["z"], part["times"]), part)[0]
        for order, closure in ((2, "gaussian"), (3, "hermite"), (4, "hermite"), (6, "hermite"), (4, "maxent"))
    ]
    assert off[0] > 1.5 * off[1] > 2 * off[2] and off[3] < off[1]
    assert off[3] < 0.005 and off[4] < 0.006  # the reference is good to 0.003


def test_agrees_with_the_exact_mixture():
    rng = np.random.default_rng(11)
    times, z = np.array([0.5, 1.0, 1.5]), np.array([0.9, -0.4, 0.7])
    want, error = exact_mixture(z, times, rng, 200_000)
    # Order 6 is exact here but for a ten-thousandth; the sum's switching is split at 0.1 s.
    for settings, bias in ((MomentFilter(order=6), 5e-4), (GaussianSumFilter(8), 6e-3)):
        got = settings.run(*case("b"), z[:, None], times)
        value = np.array([got.probs[-1, 0], got.mean[-1, 0], got.cov[-1, 0, 0]])
        assert (np.abs(value - want) < 5 * error + bias).all()


@pytest.mark.parametrize("closure", ["gaussian", "hermite", "maxent"])
def test_is_a_kalman_filter_for_one_linear_mode(closure):
    rng = np.random.default_rng(4)
    F, G = np.array([[0.0, 1.0], [-1.0, -0.5]]), np.array([[0.1, 0.0], [0.0, 0.7]])
    times = np.cumsum(rng.uniform(0.05, 0.4, 12))
    z = rng.standard_normal((3, 12, 1))
    z[1, 4:6] = np.nan
    model = SwitchingSDE(drift=[lambda y: y @ F.T], diffusion=[G], intensity={}, mean0=[0.3, 0.0], cov0=np.eye(2))
    got = MomentFilter(closure=closure, per_mode=True).run(
        model, DiffusionSensor(h=[lambda y: y[..., :1]], R=[0.3]), z, times
    )
    Phi, Q = discretise(F, G, np.diff(times, prepend=0.0))
    want = imm_filter(
        z,
        F=Phi,
        Q=Q,
        H=[[1.0, 0.0]],
        R=[[0.3]],
        trans=[],
        mean0=[0.3, 0.0],
        cov0=np.eye(2),
        probs0=1.0,
        backend="numpy",
    )
    # The box of the maximum-entropy density leaves out 4e-8 of a Gaussian, which its moments of order 4 feel.
    tolerance = 2e-4 if closure == "maxent" else 1e-7
    np.testing.assert_allclose(got.mean, want.mean, atol=tolerance)
    np.testing.assert_allclose(got.cov, want.cov, atol=tolerance)
    np.testing.assert_allclose(got.log_likelihood, want.log_likelihood, atol=3 * tolerance)
    np.testing.assert_allclose(got.nis, want.nis, rtol=1e-2, atol=1e-3)
    np.testing.assert_allclose(got.mode_means[:, :, 0], got.mean, atol=1e-12)


def test_kalman_bucy_limit():
    """The steady variance of continuous observation solves 0 = -2 a D + B - D^2 / R, but for the step."""
    a, B, R, dt = 0.7, 0.5, 0.2, 0.01
    model = SwitchingSDE(drift=[lambda y: -a * y], diffusion=[np.sqrt(B)], intensity={})
    sensor = DiffusionSensor(h=[lambda y: y], R=[R], continuous=True)
    times = dt * np.arange(1, 201)
    dz = np.sqrt(R * dt) * np.random.default_rng(1).standard_normal((2, 200, 1))
    got = MomentFilter(nodes=24).run(model, sensor, dz, times)
    D = R * (-a + np.sqrt(a**2 + B / R))
    np.testing.assert_allclose(got.cov[:, -1, 0, 0], D, rtol=2 * dt)
    gain = got.cov[:, 1:, 0, 0] / R
    step = got.mean[:, 1:, 0] - np.exp(-a * dt) * got.mean[:, :-1, 0]
    np.testing.assert_allclose(step, gain * (dz[:, 1:, 0] - got.mean[:, :-1, 0] * dt), atol=2e-3)


def test_continuous_observation_of_a_nonlinear_signal_agrees_with_the_grid():
    model, _ = case("a1")
    sensor = DiffusionSensor(h=[lambda y: y**3] * 2, R=[0.3] * 2, continuous=True)
    rng, times = np.random.default_rng(2), 0.02 * np.arange(1, 13)
    dz = 0.02 * 0.5 + np.sqrt(0.3 * 0.02) * rng.standard_normal((4, 12, 1))
    want = GridFilter(200, estimate_error=False).run(model, sensor, dz, times)
    got = MomentFilter().run(model, sensor, dz, times)
    assert np.abs(got.mean - want.mean).max() < 0.02
    assert np.abs(got.probs - want.probs).max() < 0.02
    np.testing.assert_allclose(got.log_likelihood, want.log_likelihood, atol=0.02)


def test_chains_that_stand_still_are_a_mixture_of_kalman_filters():
    chains = [Chain(c, {"a": 0.5, "b": 2.0}, rates=np.zeros((2, 2)), initial=[0.4, 0.6]) for c in ("turn", "radar")]
    F = np.array([[0.0, 1.0], [-0.2, -0.3]])
    motion = LinearSDE(F, lambda turn: np.array([[0.0], [turn]]))
    seen = LinearSensor(np.array([[1.0, 0.0]]), lambda radar: np.array([[radar**2]]))
    model = HybridModel(chains, motion, {"radar": seen}, Gaussian([0.0, 0.5], np.eye(2)))
    z = np.random.default_rng(6).standard_normal((2, 8, 1))
    want = imm_filter(z, **model.compile(dt=np.full(8, 0.5))._asdict(), backend="numpy")
    got = MomentFilter(closure="gaussian").run(model, None, z, 0.5 * np.arange(1, 9))
    np.testing.assert_allclose(got.probs, want.probs.reshape(2, 8, 4), atol=1e-5)
    np.testing.assert_allclose(got.mean, want.mean, atol=1e-4)
    np.testing.assert_allclose(got.cov, want.cov, atol=1e-4)


def tangled():
    """Three modes, every kind of switch, noise that depends on the state: nothing is in closed form."""
    model = SwitchingSDE(
        drift=[double_well, lambda y: 0.5 - y, lambda y: -2 * np.tanh(y)],
        diffusion=[lambda y: (0.5 + 0.2 * np.tanh(y))[..., None], 0.6, 0.4],
        intensity={(0, 1): 0.5, (1, 2): leaving, (2, 0): 0.4, (1, 0): 0.3, (2, 1): leaving},
        restore={(2, 0): ([-0.5], [[0.1]])},
        probs0=[0.5, 0.3, 0.2],
        cov0=[[0.5]],
    )
    return model, DiffusionSensor(h=[lambda y: y, lambda y: y + 0.3, lambda y: 0.5 * y], R=[0.3, 0.3, 0.6])


def test_three_modes_with_every_kind_of_switch_agree_with_the_grid():
    model, sensor = tangled()
    times = 0.2 * np.arange(1, 13)
    z = simulate_diffusion(model, sensor, times, rng=np.random.default_rng(3), batch=6).z
    want = GridFilter(240, estimate_error=False).run(model, sensor, z, times)
    got = MomentFilter().run(model, sensor, z, times)
    sd = np.sqrt(want.cov[..., 0, 0])
    off = (got.mean - want.mean)[..., 0] / sd
    assert np.quantile(np.abs(off), 0.8) < 0.03
    # One measurement is four deviations off, where the density's tail decides.
    assert np.sqrt(np.mean(off**2)) < 0.08
    assert np.quantile(np.abs(got.probs - want.probs), 0.8) < 0.015
    assert np.quantile(np.abs(got.log_likelihood - want.log_likelihood), 0.9) < 0.03


def test_a_likelihood_much_narrower_than_the_prediction_is_resolved():
    """One mode, linear: a sensor a hundred times better than the prediction, five deviations off."""
    model = SwitchingSDE(drift=[lambda y: -y], diffusion=[1.0], intensity={})
    sensor = DiffusionSensor(h=[lambda y: y], R=[1e-4])
    got = MomentFilter().run(model, sensor, [[2.0]], [0.5])
    P = np.exp(-1.0) + 0.5 * (1 - np.exp(-1.0))
    gain = P / (P + 1e-4)
    assert got.mean[0, 0] == pytest.approx(gain * 2.0, abs=2e-4)
    assert got.cov[0, 0, 0] == pytest.approx(1e-4 * gain, rel=0.02)


def test_sums_of_gaussians_follow_restoration(cases):
    """Notes, section 11: 0.031 deviations with four Gaussians and symmetric switching, 0.43 with one."""
    part = few(cases("moments_br"), 10, 25)
    model, sensor = case("br")
    four, one = (distances(GaussianSumFilter(k).run(model, sensor, part["z"], part["times"]), part) for k in (4, 1))
    assert four[0] < 0.04 and four[1] < 0.04 and four[2] < 0.015
    assert one[0] > 8 * four[0]


def test_auto_takes_what_suits_the_model():
    plane = {"mean0": [0.0, 0.0], "cov0": np.eye(2)}
    linear = SwitchingSDE(drift=[lambda y: -y], diffusion=[1.0], intensity={}, **plane)
    straight, bent = DiffusionSensor(h=[lambda y: y], R=[np.eye(2)]), DiffusionSensor(h=[lambda y: y**2], R=[np.eye(2)])
    auto = MomentFilter(closure="auto")
    assert auto.representation(*case("a1")) == "grid" and auto.representation(*case("br")) == "grid"
    assert auto.representation(*case("c")) == "maxent" and auto.representation(linear, bent) == "maxent"
    assert auto.representation(linear, straight) == "sum"
    space = SwitchingSDE(drift=[np.sin], diffusion=[1.0], intensity={}, mean0=np.zeros(3), cov0=np.eye(3))
    sensor = DiffusionSensor(h=[lambda y: y], R=[np.eye(3)])
    assert auto.representation(space, sensor) == "sum"
    z, times = np.zeros((2, 3)), [0.1, 0.2]
    assert auto.run(space, sensor, z, times).mean.shape == (2, 3)
    one, other = auto.run(*case("b"), z[:, :1], times), GridFilter().run(*case("b"), z[:, :1], times)
    np.testing.assert_array_equal(one.mean, other.mean)
    with pytest.raises(ModelError, match='"auto" is a grid'):
        auto.follow(*case("b"), z[:, :1], times)


def test_order_rises_only_where_it_changes_something(cases):
    for name in ("a1", "a2", "b", "br"):  # a Gaussian closure with a linear sensor sees Gaussians only: b, br
        part = few(cases(f"moments_{name}"), 3, 15)
        history = MomentFilter(adapt=Adapt()).follow(*case(name), part["z"], part["times"])
        assert (history.diagnostics.order >= 4).mean() > 0.8, name
        assert distances(history.estimates, part)[0] < 0.05, name  # `relative`
    alone = SwitchingSDE(drift=[lambda y: -y], diffusion=[1.0], intensity={})
    z = np.random.default_rng(0).standard_normal((2, 20, 1))
    linear = DiffusionSensor(h=[lambda y: y], R=[0.5])
    calm = MomentFilter(adapt=Adapt(interval=7)).follow(alone, linear, z, 0.2 * np.arange(1, 21))
    assert (calm.diagnostics.order == 2).all() and not calm.diagnostics.unsettled.any()
    plain = MomentFilter(closure="gaussian").run(alone, linear, z, 0.2 * np.arange(1, 21))
    np.testing.assert_allclose(calm.estimates.mean, plain.mean, atol=1e-6)
    x = np.linspace(-1, 1, 5)[:, None]
    assert np.isfinite(calm.posterior.log_pdf(x)).all()


def test_order_six_is_used_where_order_four_does_not_settle(cases):
    part = few(cases("moments_br"), 3, 12)
    model, sensor = case("br")
    adapt = Adapt(relative=1e-4, interval=12)
    history = MomentFilter(adapt=adapt).follow(model, sensor, part["z"], part["times"])
    assert (history.diagnostics.order == 6).all() and history.diagnostics.unsettled.all()
    six = MomentFilter(order=6).run(model, sensor, part["z"], part["times"])
    np.testing.assert_allclose(history.estimates.mean, six.mean, atol=1e-3)
    capped = MomentFilter(adapt=adapt._replace(max_order=4)).follow(model, sensor, part["z"], part["times"])
    assert (capped.diagnostics.order == 4).all() and capped.diagnostics.unsettled.all()
    four = MomentFilter(order=4).run(model, sensor, part["z"], part["times"])
    np.testing.assert_allclose(capped.estimates.mean, four.mean, atol=1e-3)
    assert np.abs(six.mean - four.mean).max() > 0.01


def test_order_six_is_closer_where_switching_makes_heavy_tails(cases):
    """Restoration: sixth moments feel what lies beyond a box of 5.5 deviations."""
    part = few(cases("moments_br"), 12, 30)
    model, sensor = case("br")
    four, six = (
        distances(MomentFilter(order=order).run(model, sensor, part["z"], part["times"]), part) for order in (4, 6)
    )
    assert six[0] < 0.04 and six[1] < 0.05 and six[2] < 0.02
    assert six[0] < 0.7 * four[0] and six[1] < 0.7 * four[1]


def test_runs_do_not_depend_on_each_other(cases):
    part = few(cases("moments_a1"), 3, 6)
    model, sensor = case("a1")
    settings = MomentFilter(substeps=3)
    whole = settings.run(model, sensor, part["z"].reshape(3, 1, 6, 1), part["times"])
    alone = settings.run(model, sensor, part["z"][1], part["times"])
    assert whole.probs.shape == (3, 1, 6, 2)
    np.testing.assert_allclose(whole.mean[1, 0], alone.mean, atol=1e-4)


def test_modes_may_be_listed_in_any_order(cases):
    part = few(cases("moments_a1"), 3, 10)
    one, sensor = case("a1")
    other = SwitchingSDE(
        drift=one.drift[::-1],
        diffusion=one.diffusion[::-1],
        intensity={(1, 0): one.intensity[0, 1], (0, 1): one.intensity[1, 0]},
        probs0=[0.5, 0.5],
    )
    a, b = (MomentFilter().run(m, sensor, part["z"], part["times"]) for m in (one, other))
    np.testing.assert_allclose(a.mean, b.mean, atol=1e-6)
    np.testing.assert_allclose(a.probs, b.probs[..., ::-1], atol=1e-6)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"order": 3}, "even for maximum entropy"),
        ({"order": 8, "closure": "hermite"}, "order must be 2 to 6"),
        ({"closure": "gaussian", "adapt": Adapt()}, "adapt needs"),
        ({"nodes": 4}, "order 4 needs nodes >= 5 on each axis, got 4"),
        ({"substeps": 0}, "substeps must be at least 1, got 0"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings, words):
    with pytest.raises(ModelError, match=words):
        MomentFilter(**settings)


def test_what_does_not_fit_is_refused():
    model, sensor = case("b")
    with pytest.raises(DataError, match="must not decrease"):
        MomentFilter().run(model, sensor, np.zeros((2, 1)), [0.2, 0.1])
    four = SwitchingSDE(drift=[np.sin], diffusion=[1.0], intensity={}, mean0=np.zeros(4), cov0=np.eye(4))
    with pytest.raises(ModelError, match="nodes on each of 4 axes are"):
        MomentFilter(nodes=20).run(four, DiffusionSensor(h=[lambda y: y], R=[np.eye(4)]), np.zeros((1, 4)), [1.0])
    with pytest.raises(ModelError, match="interval >= 1"):
        MomentFilter(adapt=Adapt(interval=0)).run(model, sensor, np.zeros((1, 1)), [0.2])
    with pytest.raises(ModelError, match="at least one component"):
        GaussianSumFilter(0).run(model, sensor, np.zeros((1, 1)), [0.2])
    with pytest.raises(ModelError, match="nodes >= 3"):
        GaussianSumFilter(nodes=1).run(model, sensor, np.zeros((1, 1)), [0.2])
