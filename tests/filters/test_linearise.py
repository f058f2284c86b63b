"""Linearised measurements of nonlinear sensors: against textbook forms, quadrature of the posterior, and symmetries."""

import inspect
from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import chi2

from oracles import is_psd
from saltus.errors import ModelError, NumericalError
from saltus.filters import steps
from saltus.filters.linearise import linearise, sensor_joint, sensor_update
from saltus.linalg import cholesky
from saltus.models import Chain, FunctionSensor, LinearSensor, Observer, PolarSensor, constant_velocity

METHODS = ("extended", "cubature")
FAULT = Chain("fault", {"ok": 1.0, "bad": 10.0}, stay=0.9, per=1.0)
RADAR = PolarSensor(sigma_range=5.0, sigma_azimuth=0.03)
BEARING = PolarSensor(sigma_azimuth=0.05)


def update(sensor, mean, cov, z, **options):
    z = np.asarray(z, float)
    return sensor_update(np.asarray(mean, float), np.asarray(cov, float), sensor, z, ~np.isnan(z), **options)


def random_beliefs(rng, *lead, n=4):
    root = rng.normal(size=(*lead, n, n)) * [30.0, 5.0, 30.0, 5.0][:n]
    return rng.normal(size=(*lead, n)) * 50 + [200.0, 1.0, 300.0, 2.0][:n], root @ root.swapaxes(-1, -2) + np.eye(n)


@pytest.mark.parametrize("method", METHODS)
def test_a_linear_sensor_is_taken_as_it_is(method, rng):
    H = rng.normal(size=(2, 2, 4))
    sensor = LinearSensor(H=H, R=lambda fault: fault * np.eye(2), d=[3.0, -1.0]).bind([FAULT], 4)
    means, covs = random_beliefs(rng, 7, 2)  # seven runs, two modes
    expected = steps.measure(means, covs, sensor.H, sensor.d, sensor.R)
    joint = sensor_joint(means, covs, sensor, method)
    for name in ("mean", "y", "U", "S"):
        actual, wanted = getattr(joint, name), getattr(expected, name)
        np.testing.assert_allclose(actual, wanted, rtol=1e-10, atol=1e-10 * np.abs(wanted).max(), err_msg=name)
    z = rng.normal(size=(7, 1, 2)) * 100
    seen = ~np.isnan(z)
    wanted = steps.condition(expected, z, seen)
    for iterations in (1, 3):
        _, done = sensor_update(means, covs, sensor, z, seen, method=method, iterations=iterations)
        for actual, want in zip(done, wanted, strict=True):
            np.testing.assert_allclose(actual, want, rtol=1e-8, atol=1e-10 * np.abs(want).max())


def textbook_cubature(sensor, mean, cov, z):
    """The third-degree cubature update of one belief, point by point, where no angle comes near its edge."""
    n = len(mean)
    points = [mean + sign * np.sqrt(n) * column for column in np.linalg.cholesky(cov).T for sign in (1, -1)]
    zs = [sensor.h(point) for point in points]
    y = sum(zs) / (2 * n)
    S = sum(np.outer(v - y, v - y) for v in zs) / (2 * n) + sensor.R
    U = sum(np.outer(p - mean, v - y) for p, v in zip(points, zs, strict=True)) / (2 * n)
    K = U @ np.linalg.inv(S)
    return y, S, U, mean + K @ (z - y), cov - K @ S @ K.T


def textbook_extended(sensor, mean, cov, z):
    y, H = sensor.h(mean), sensor.jacobian(mean)
    S = H @ cov @ H.T + sensor.R
    K = cov @ H.T @ np.linalg.inv(S)
    return y, S, cov @ H.T, mean + K @ (z - y), (np.eye(len(mean)) - K @ H) @ cov


@pytest.mark.parametrize("method, textbook", [("extended", textbook_extended), ("cubature", textbook_cubature)])
def test_one_update_is_the_textbook_s(method, textbook, rng):
    sensor = PolarSensor(sigma_range=5.0, sigma_azimuth=0.03, sigma_range_rate=1.0)
    means, covs = random_beliefs(rng, 20)
    z = np.stack([sensor.h(x) for x in means]) + rng.normal(size=(20, 3)) * [5.0, 0.03, 1.0]
    joint, done = update(sensor, means, covs, z, method=method)
    for i in range(20):
        y, S, U, mean, cov = textbook(sensor, means[i], covs[i], z[i])
        for actual, wanted in ((joint.y, y), (joint.S, S), (joint.U, U), (done.mean, mean), (done.cov, cov)):
            np.testing.assert_allclose(actual[i], wanted, atol=1e-9 * np.abs(wanted).max())
        d2 = (z[i] - y) @ np.linalg.solve(S, z[i] - y)
        assert done.loglik[i] == pytest.approx(-0.5 * (d2 + np.linalg.slogdet(2 * np.pi * S)[1]), rel=1e-9)
    assert is_psd(done.cov)


def test_cubature_mean_of_a_quadratic_is_exact():
    # E x_i^2 = m_i^2 + P_ii, cov(x_i, x_j^2) = 2 m_j P_ij: a rule of third degree has both.
    sensor = FunctionSensor(function=np.square, R=np.eye(3))
    mean, cov = np.array([1.0, -2.0, 0.5]), np.array([[2.0, 0.5, 0.1], [0.5, 1.0, -0.3], [0.1, -0.3, 0.7]])
    joint = sensor_joint(mean, cov, sensor, "cubature")
    np.testing.assert_allclose(joint.y, mean**2 + np.diag(cov), rtol=1e-12)
    np.testing.assert_allclose(joint.U, 2 * cov * mean, rtol=1e-12, atol=1e-14)
    assert np.abs(sensor_joint(mean, cov, sensor, "extended").y - joint.y).max() > 0.5


def posterior(sensor, mean, cov, z, points=801):
    """Mean, covariance, log f(z) and mode of a belief in the plane, by summation over a grid of 7 sigmas."""
    root, grid = np.linalg.cholesky(cov), np.linspace(-7, 7, points)
    u = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)
    x = mean + u @ root.T
    misfit = sensor.residual(z, sensor.h(x)) / np.sqrt(np.diag(sensor.R))
    log_f = -0.5 * (u**2).sum(1) - 0.5 * (misfit**2).sum(1)
    w = np.exp(log_f - log_f.max())
    area = (grid[1] - grid[0]) ** 2
    evidence = np.log(w.sum() * area / (2 * np.pi)) + log_f.max() - 0.5 * np.linalg.slogdet(2 * np.pi * sensor.R)[1]
    w /= w.sum()
    centre = w @ x
    return centre, ((x - centre) * w[:, None]).T @ (x - centre), evidence, x[log_f.argmax()]


# What each way of linearising makes of one strong nonlinearity. `mean` is the distance of its mean from the exact one,
# in exact standard deviations; `low` and `high` are the least and greatest ratio of its variance to the exact one over
# all directions; `log_f` is the error of the log-likelihood in nats. Rounded up (down for `low`) from what is found.
SCENES = {
    # 36 degrees off where it was expected, at a distance of 1 km known to 300 m.
    "bearing": (PolarSensor(sigma_azimuth=0.02), [300.0, 1000.0], [150.0, 300.0], [np.arctan2(500, 800)]),
    # A hundred metres away, known to 30 m; one measurement fixes it.
    "radar": (RADAR, [60.0, 100.0], [30.0, 30.0], [125.0, 0.8]),
    # The same towards the south, where azimuth jumps by a turn.
    "radar, south": (PolarSensor(sigma_range=5.0, sigma_azimuth=0.1), [-10.0, -100.0], [30.0, 30.0], [105.0, 3.05]),
    # A rough azimuth at long range: the posterior is a bent, thin arc.
    "arc": (PolarSensor(sigma_range=10.0, sigma_azimuth=0.1), [3000.0, 8000.0], [1000.0, 1000.0], [8500.0, 0.2]),
}
GAPS = [  # scene, method, iterations, mean, low, high, log_f
    ("bearing", "extended", 1, 2.3, 0.11, 17.8, 0.02),
    ("bearing", "cubature", 1, 0.2, 0.42, 15.9, 0.27),
    ("bearing", "extended", 5, 0.3, 0.80, 1.1, 0.01),
    ("bearing", "cubature", 5, 0.3, 0.80, 1.1, 0.02),
    ("radar", "extended", 1, 1.1, 0.78, 1.2, 0.04),
    ("radar", "cubature", 1, 1.1, 1.0, 4.0, 0.03),
    ("radar", "extended", 5, 0.03, 0.99, 1.01, 0.002),
    ("radar", "cubature", 5, 0.05, 0.99, 1.01, 0.002),
    ("radar, south", "extended", 1, 0.4, 0.73, 1.3, 0.04),
    ("radar, south", "cubature", 1, 0.6, 0.89, 2.0, 0.02),
    ("radar, south", "extended", 5, 0.06, 0.98, 1.01, 0.004),
    ("radar, south", "cubature", 5, 0.05, 0.99, 1.01, 0.002),
    ("arc", "extended", 1, 1.7, 0.01, 3.8, 0.01),
    ("arc", "cubature", 1, 0.1, 0.30, 5.1, 0.01),
    ("arc", "extended", 5, 0.7, 0.07, 1.01, 0.01),
    ("arc", "cubature", 5, 0.01, 0.53, 1.01, 0.01),
]


@pytest.fixture(scope="module")
def exact():
    return {name: posterior(s, np.array(m), np.diag(sd) ** 2, np.array(z)) for name, (s, m, sd, z) in SCENES.items()}


@pytest.mark.parametrize("scene, method, iterations, gap, low, high, log_gap", GAPS)
def test_gap_to_the_exact_posterior(exact, scene, method, iterations, gap, low, high, log_gap):
    sensor, mean, sd, z = SCENES[scene]
    exact_mean, exact_cov, evidence, _ = exact[scene]
    _, done = update(sensor, mean, np.diag(sd) ** 2, z, method=method, iterations=iterations)
    white = np.linalg.inv(np.linalg.cholesky(exact_cov))
    assert np.linalg.norm(white @ (done.mean - exact_mean)) < gap
    ratios = np.linalg.eigvalsh(white @ done.cov @ white.T)
    assert low < ratios[0] and ratios[1] < high
    assert abs(done.loglik - evidence) < log_gap


@pytest.mark.parametrize("scene", SCENES)
def test_iterated_tangents_lead_to_the_posterior_mode(exact, scene):
    sensor, mean, sd, z = SCENES[scene]
    _, exact_cov, _, mode = exact[scene]
    white = np.linalg.inv(np.linalg.cholesky(exact_cov))
    far = [
        np.linalg.norm(white @ (update(sensor, mean, np.diag(sd) ** 2, z, iterations=k)[1].mean - mode))
        for k in (1, 2, 5)
    ]
    # The grid finds the mode to half a cell of 7 / 400 prior deviations.
    cell = np.linalg.norm(white @ sd) * 7 / 800
    assert far[1] < 0.5 * far[0] and far[2] < max(cell, 0.01)


def test_a_mild_nonlinearity_leaves_no_gap():
    # 10 km away, known to 30 m: second derivatives times variance are 0.03^2 of the standard deviation.
    sensor, mean, cov, z = RADAR, np.array([6e3, 8e3]), np.diag([900.0, 900.0]), np.array([10020.0, np.arctan2(3, 4)])
    exact_mean, exact_cov, evidence, _ = posterior(sensor, mean, cov, z)
    for method in METHODS:
        _, done = update(sensor, mean, cov, z, method=method)
        white = np.linalg.inv(np.linalg.cholesky(exact_cov))
        assert np.linalg.norm(white @ (done.mean - exact_mean)) < 0.02
        np.testing.assert_allclose(np.linalg.eigvalsh(white @ done.cov @ white.T), 1.0, atol=0.02)
        assert abs(done.loglik - evidence) < 0.01


@pytest.mark.parametrize("method", METHODS)
def test_south_is_north_turned_half_round(method, rng):
    # Every vector changes its sign and azimuth half a turn. The points of the rule turn with it exactly.
    means, covs = random_beliefs(rng, 50)
    means[:, 0] = rng.normal(size=50) * 20  # about the edge of azimuth, in front and behind
    x = means + rng.normal(size=(50, 4)) * 20
    z = RADAR.h(x)
    z_behind = RADAR.h(-x)
    for iterations in (1, 3):
        _, ahead = update(RADAR, means, covs, z, method=method, iterations=iterations)
        joint, behind = update(RADAR, -means, covs, z_behind, method=method, iterations=iterations)
        np.testing.assert_allclose(-behind.mean, ahead.mean, atol=1e-8)
        np.testing.assert_allclose(behind.cov, ahead.cov, atol=1e-8)
        np.testing.assert_allclose(behind.loglik, ahead.loglik, atol=1e-8)
        assert np.abs(joint.y - z_behind)[:, 1].max() <= np.pi  # the prediction is on the measurement's branch


def test_predicted_azimuth_of_points_on_both_sides_of_south():
    # 100 m to the south, 30 m to each side: the points lie at 163 and -163 degrees, their mean at 180.
    y = sensor_joint(np.array([0.0, -100.0]), np.diag([900.0, 1.0]), BEARING, "cubature").y
    assert abs(BEARING.residual(y, [np.pi])[0]) < 1e-12


@pytest.mark.parametrize("method", METHODS)
def test_a_missing_component_is_a_sensor_without_it(method, rng):
    means, covs = random_beliefs(rng, 10)
    x = means + rng.normal(size=(10, 4)) * 10
    z = RADAR.h(x)
    z[:, 0] = np.nan
    for iterations in (1, 3):
        joint, half = update(RADAR, means, covs, z, method=method, iterations=iterations)
        _, whole = update(PolarSensor(sigma_azimuth=0.03), means, covs, z[:, 1:], method=method, iterations=iterations)
        for a, b in zip(half, whole, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
        assert np.isfinite(joint.y).all()
    _, none = update(RADAR, means, covs, np.full((10, 2), np.nan), method=method, iterations=2)
    np.testing.assert_allclose(none.mean, means)
    np.testing.assert_allclose(none.cov, covs, rtol=1e-12, atol=1e-9)
    assert (none.loglik == 0).all()


@pytest.mark.parametrize("method", METHODS)
def test_a_batch_is_a_loop(method, rng):
    sensor = PolarSensor(
        sigma_range=lambda fault: 5.0 * fault, sigma_azimuth=0.03, observer=Observer(rng.normal(size=(6, 1, 2)) * 50)
    ).bind([FAULT], 4)
    means, covs = random_beliefs(rng, 6, 2)
    z = sensor.h(means + rng.normal(size=means.shape) * 10)[:, :1]
    _, together = sensor_update(means, covs, sensor, z, ~np.isnan(z), method=method, iterations=2)
    for run in range(6):
        for mode, value in enumerate(FAULT.values):
            alone = PolarSensor(
                sigma_range=5.0 * value, sigma_azimuth=0.03, observer=Observer(sensor.observer.position[run, 0])
            )
            _, one = update(alone, means[run, mode], covs[run, mode], z[run, 0], method=method, iterations=2)
            for a, b in zip(together, one, strict=True):
                np.testing.assert_allclose(a[run, mode], b, rtol=1e-10, atol=1e-10)


def test_iterations_never_leave_a_worse_fit(rng):
    # Close to the observer, where a whole Gauss-Newton step can land on its other side.
    n, sd = 2000, 60.0
    angle = rng.uniform(-np.pi, np.pi, n)
    means = 80.0 * np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    covs = np.broadcast_to(np.eye(2) * sd**2, (n, 2, 2))
    z = BEARING.h(means + sd * rng.normal(size=(n, 2))) + 0.05 * rng.normal(size=(n, 1))

    def misfit(x):
        return (BEARING.residual(z, BEARING.h(x))[:, 0] / 0.05) ** 2 + ((x - means) ** 2).sum(-1) / sd**2

    fits = [misfit(update(BEARING, means, covs, z, iterations=k)[1].mean) for k in (1, 2, 3, 4, 6)]
    for before, after in pairwise(fits[1:]):
        assert (after <= before * (1 + 1e-9) + 1e-9).all()
    assert (fits[1] <= np.minimum(fits[0], misfit(means)) + 1e-9).mean() > 0.95  # two tangents against one
    assert np.quantile(fits[-1], 0.99) < 0.05 * np.quantile(fits[0], 0.99)


def divergence(sensor, mean, cov, z, q, evidence):
    """KL(q, exact posterior) by 41 x 41 Gauss-Hermite nodes of q, given the grid's log f(z)."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(41)
    u, w = np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2), np.outer(weights, weights).ravel() / (2 * np.pi)
    x = q.mean + u @ np.linalg.cholesky(q.cov).T
    misfit = sensor.residual(z, sensor.h(x)) / np.sqrt(np.diag(sensor.R))
    off = np.linalg.solve(np.linalg.cholesky(cov), (x - mean).T)
    log_joint = -0.5 * (off**2).sum(0) - 0.5 * (misfit**2).sum(1)
    log_joint -= 0.5 * np.linalg.slogdet(2 * np.pi * cov)[1] + 0.5 * np.linalg.slogdet(2 * np.pi * sensor.R)[1]
    return evidence - w @ log_joint - 0.5 * np.linalg.slogdet(2 * np.pi * np.e * q.cov)[1]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("sensor", [PolarSensor(sigma_range=5.0, sigma_azimuth=0.05), PolarSensor(sigma_range=8.0)])
def test_iterating_is_never_worse_than_not(sensor, method, rng):
    # A hundred metres away, known to between 5 and 60 m, against the posterior summed over a grid: the divergence
    # from it falls in every scene (a tenth is what four points of a bent posterior mistake), and on average the
    # distance of the mean, in exact standard deviations, does not grow (of the arc of a range it is 0.2 either way).
    plain, iterated, sd = [], [], np.sqrt(np.diag(sensor.R))
    for _ in range(25):
        angle, root = rng.uniform(-np.pi, np.pi), rng.normal(size=(2, 2)) * rng.uniform(5, 30)
        mean, cov = 100 * np.array([np.sin(angle), np.cos(angle)]), root @ root.T + 9 * np.eye(2)
        z = sensor.h(mean + np.linalg.cholesky(cov) @ rng.normal(size=2)) + sd * rng.normal(size=len(sd))
        centre, exact_cov, evidence, _ = posterior(sensor, mean, cov, z, points=401)
        white = np.linalg.inv(np.linalg.cholesky(exact_cov))
        for k, into in ((1, plain), (2, iterated), (4, iterated)):
            _, q = update(sensor, mean, cov, z, method=method, iterations=k)
            into.append((divergence(sensor, mean, cov, z, q, evidence), np.linalg.norm(white @ (q.mean - centre))))
    before, after = np.array(plain)[:, None], np.array(iterated).reshape(-1, 2, 2)
    assert (after[..., 0] <= 1.1 * before[..., 0] + 0.01).all()
    assert (after.mean(0) <= before.mean(0) + np.array([0.0, 0.02])).all()


@pytest.mark.parametrize("method", METHODS)
def test_iterating_over_many_bearings_of_a_turning_observer(method, rng):
    # Sixty runs of sixty bearings of 0.02 rad from an observer that turns across the line of sight. Undamped steps
    # made of a median error of 0.4 km 0.8, and of a NEES of 2.5 (4 expected) 6 and 26.
    n, dt, sigma = 60, 20.0, 0.02
    legs = np.array([[0.0, 5.0] if k // 15 % 2 == 0 else [5.0, 0.0] for k in range(60)])
    own = np.concatenate([np.zeros((1, 2)), np.cumsum(legs[:-1] * dt, axis=0)])
    start = (1e4 + 2e3 * rng.normal(size=(n, 1))) * [np.sin(0.7), np.cos(0.7)]
    velocity, bearing = 4.0 * rng.normal(size=(n, 2)), 0.7 + sigma * rng.normal(size=n)
    along = np.stack([np.sin(bearing), np.cos(bearing)], axis=-1)
    across = along[:, ::-1] * [1.0, -1.0]
    means, covs = np.zeros((n, 4)), np.zeros((n, 4, 4))
    means[:, ::2], covs[:, 1, 1], covs[:, 3, 3] = 1e4 * along, 16.0, 16.0
    covs[:, ::2, ::2] = 2e3**2 * along[:, :, None] * along[:, None] + 200.0**2 * across[:, :, None] * across[:, None]
    F, Q, _ = constant_velocity(2, accel=1e-3, kind="white").bind([]).step(np.array(dt), None)
    seen = [start + velocity * dt * k - own[k] for k in range(60)]
    z = [np.arctan2(*line.T)[:, None] + sigma * rng.normal(size=(n, 1)) for line in seen]
    errors, nees = {}, {}
    for iterations in (1, 3):
        x, P = means, covs
        for k in range(1, 60):
            x, P = steps.propagate(x, P, F, None, Q) if k > 1 else (x, P)
            sensor = PolarSensor(sigma_azimuth=sigma, observer=Observer(own[k]))
            x, P = update(sensor, x, P, z[k], method=method, iterations=iterations)[1][:2]
        off = x - np.stack([start + velocity * dt * 59, velocity], axis=-1).reshape(n, 4)
        errors[iterations] = np.median(np.hypot(off[:, 0], off[:, 2]))
        nees[iterations] = np.einsum("ki,kij,kj->k", off, np.linalg.inv(P), off).mean()
    assert errors[3] < 1.2 * errors[1] and nees[3] < 4.0


def test_singular_covariances(rng):
    root = rng.normal(size=(30, 5, 3))
    P = root @ root.swapaxes(-1, -2) * np.outer([1, 1e3, 1e-3, 1, 1], [1, 1e3, 1e-3, 1, 1])
    P = np.concatenate([P, np.zeros((1, 5, 5)), np.diag([1.0, 0, 4, 0, 9])[None]])
    L = cholesky(P)
    sd = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 1e-300))
    np.testing.assert_allclose((L @ L.swapaxes(1, 2) - P) / (sd[:, :, None] * sd[:, None]), 0, atol=1e-12)
    assert not np.triu(L, 1).any()
    # Known exactly in one direction: nothing is learnt across it, and all is as if it were known almost exactly.
    line = np.outer([3.0, 1.0], [3.0, 1.0]) * 100
    for method in METHODS:
        _, flat = update(RADAR, [300.0, 400.0], line, [480.0, 0.7], method=method, iterations=3)
        _, thin = update(RADAR, [300.0, 400.0], line + 1e-6 * np.eye(2), [480.0, 0.7], method=method, iterations=3)
        np.testing.assert_allclose(flat.mean, thin.mean, atol=1e-3)
        np.testing.assert_allclose(flat.cov, thin.cov, atol=1e-3)
        assert (flat.mean - [300, 400]) @ [1.0, -3.0] == pytest.approx(0.0, abs=1e-9)


def test_two_bearings_triangulate(rng):
    # Two passive sensors 20 km apart, an object known to 2 km; the covariance a flat prior leaves is
    # (sum J'J / sigma^2)^-1, J = (north, -east) / distance^2 from each sensor.
    sigma, n = 2e-3, 1000
    sites = np.array([[-10e3, 0.0], [10e3, 0.0]])
    mean, prior = np.array([2e3, 15e3]), np.eye(2) * 2e3**2
    x = mean + 2e3 * rng.normal(size=(n, 2))
    means, covs = np.broadcast_to(mean, (n, 2)), np.broadcast_to(prior, (n, 2, 2))
    for site in sites:
        sensor = PolarSensor(sigma_azimuth=sigma, observer=Observer(site))
        z = sensor.h(x) + sigma * rng.normal(size=(n, 1))
        _, done = update(sensor, means, covs, z, method="cubature", iterations=3)
        means, covs = done.mean, done.cov
    error = x - means
    nees = np.einsum("ki,kij,kj->k", error, np.linalg.inv(covs), error)
    low, high = chi2.ppf([5e-4, 1 - 5e-4], 2 * n) / n
    assert low < nees.mean() < high
    line = x[:, None] - sites
    J = np.stack([line[..., 1], -line[..., 0]], axis=-1) / (line**2).sum(-1, keepdims=True)
    bound = np.linalg.inv((J.swapaxes(1, 2) @ J) / sigma**2 + np.eye(2) / 2e3**2)
    ratio = np.trace(np.linalg.solve(bound, covs), axis1=1, axis2=2) / 2
    # The filter takes its derivatives where it believes the object to be, at first with one bearing.
    assert np.median(ratio) == pytest.approx(1.0, abs=0.02)
    assert np.mean(np.abs(ratio - 1) < 0.25) > 0.95


def simulated_nees(rng, method, factor, n_runs=400, n_steps=25, dt=2.0):
    """NEES after `n_steps` of range and azimuth, in n_runs at once; the filter's Q is `factor` times the true one."""
    sensor = PolarSensor(sigma_range=20.0, sigma_azimuth=0.02)
    F, Q, _ = constant_velocity(2, accel=2.0, kind="scan").bind([]).step(np.array(dt), None)
    mean, cov = (
        np.array([-3e3, 150.0, -4e3, 20.0]),
        np.diag([400.0, 30.0, 400.0, 30.0]) ** 2,
    )  # passes south-west to south-east
    x = mean + rng.normal(size=(n_runs, 4)) * np.sqrt(np.diag(cov))
    means, covs = np.broadcast_to(mean, (n_runs, 4)), np.broadcast_to(cov, (n_runs, 4, 4))
    g = np.array([dt**2 / 2, dt])
    for _ in range(n_steps):
        x = x @ F.T + 2.0 * (rng.normal(size=(n_runs, 2, 1)) * g).reshape(n_runs, 4)
        z = sensor.h(x) + rng.normal(size=(n_runs, 2)) * [20.0, 0.02]
        means, covs = steps.propagate(means, covs, F, None, factor * Q)
        _, done = update(sensor, means, covs, z, method=method, iterations=2)
        means, covs = done.mean, done.cov
    error = x - means
    return np.einsum("ki,kij,kj->k", error, np.linalg.inv(covs), error).mean() / 4


@pytest.mark.parametrize("method", METHODS)
def test_covariances_are_honest_in_a_matched_simulation(method, rng):
    low, high = chi2.ppf([5e-4, 1 - 5e-4], 4 * 400) / (4 * 400)
    assert low < simulated_nees(rng, method, 1.0) < high
    assert simulated_nees(rng, method, 3.0) < low  # and would not be with three times the noise


def test_what_is_refused():
    bare = inspect.unwrap(linearise)  # the message of a caller without type checks
    with pytest.raises(ModelError, match='linearise is "extended" or "cubature", not \'unscented\''):
        bare(np.ones(2), np.eye(2), RADAR, "unscented")
    with pytest.raises(NumericalError, match="coincides with the observer"):
        sensor_joint(np.zeros(2), np.eye(2), RADAR)
    noiseless = FunctionSensor(function=np.square, R=np.diag([1.0, 0.0]))
    update(noiseless, [1.0, 2.0], np.eye(2), [1.0, 4.5])
    with pytest.raises(NumericalError, match=r"R is singular.*iterations=1"):
        update(noiseless, [1.0, 2.0], np.eye(2), [1.0, 4.5], iterations=2)
