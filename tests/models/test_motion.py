import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss

from saltus.errors import ModelError
from saltus.models import Chain, constant_acceleration, constant_velocity, discretise, singer

WHITE = [
    constant_velocity(2, accel=[0.5, 2.0], kind="white"),
    constant_velocity(2, accel=[0.5, 2.0]),
    constant_velocity(2, accel=3.0, accel_time=[2.0, 0.5]),
    constant_velocity(3, accel=[0.5, 0.5, 0.1], accel_time=10.0, turn=0.05),
    constant_acceleration(2, jerk=0.3),
    singer(2, tau=20.0, sigma=[1.0, 3.0]),
    constant_velocity(2, accel=0.5, kind="white", turn=0.03),
    constant_velocity(3, accel=[0.5, 0.5, 0.1], kind="white", turn=-0.2),
]


def assert_same_cov(actual, expected):
    """Each entry to 1e-11 of itself, or to round-off of the two deviations where it is exactly 0."""
    sd = np.sqrt(np.diagonal(expected, axis1=-2, axis2=-1))
    bound = 1e-11 * np.abs(expected) + 1e-15 * sd[..., :, None] * sd[..., None, :]
    assert (np.abs(actual - expected) <= bound).all()


@pytest.mark.parametrize("motion", WHITE, ids=lambda m: m.law if m.turn is None else f"turn {float(m.turn)}")
def test_closed_forms_agree_with_discretise(motion):
    dt = np.array([0.0, 1e-3, 0.1, 1.0, 4.0, 19.9, 20.1, 300.0])
    step, sde = motion.step(dt), motion.sde()
    Phi, Q = discretise(sde.F, sde.G, dt)
    n = motion.dimension()
    assert step.F.shape == step.Q.shape == (8, n, n)
    # Entries differ by many orders of magnitude (dt^5 to dt): compare each with itself.
    np.testing.assert_allclose(step.F, Phi, rtol=1e-11, atol=1e-14)
    assert_same_cov(step.Q, Q)


@pytest.mark.parametrize("u", [1e-9, 1e-4, 0.1, 0.999999, 1.000001, 3.0, 60.0])
def test_singer_by_quadrature(u):
    # Gauss-Legendre of the impulse response, itself written without cancellation by phi functions.
    tau, sigma = 5.0, 2.0
    dt = u * tau
    nodes, weights = leggauss(60)
    pieces = max(1, int(u))  # the rule is exact to round-off over pieces of length tau
    s = np.concatenate([(nodes + 1) / 2 * dt / pieces + k * dt / pieces for k in range(pieces)])
    w = np.tile(weights / 2 * dt / pieces, pieces)
    x = s / tau
    phi2 = np.where(x < 0.5, sum((-x) ** k / np.prod(np.arange(1.0, k + 3)) for k in range(18)), 0)
    phi2 = np.where(x < 0.5, phi2, (x + np.expm1(-x)) / np.where(x > 0, x, 1) ** 2)
    response = np.stack([s**2 * phi2, -np.expm1(-x) * tau, np.exp(-x)])
    expected = 2 * sigma**2 / tau * (response * w) @ response.T
    np.testing.assert_allclose(singer(1, tau, sigma).step(np.asarray(dt)).Q, expected, rtol=2e-13)


def test_singer_tends_to_constant_acceleration():
    # Entry by entry, where a closed form in u = dt/tau = 1e-8 would have lost every digit.
    dt, tau, sigma = np.array([0.1, 1.0]), 1e8, 3.0
    limit = constant_acceleration(1, jerk=2 * sigma**2 / tau).step(dt)
    step = singer(1, tau, sigma).step(dt)
    np.testing.assert_allclose(step.Q, limit.Q, rtol=1e-7)
    np.testing.assert_allclose(step.F, limit.F, rtol=1e-7)
    assert np.linalg.eigvalsh(step.Q[1]).min() > 0


def test_singer_published_values():
    # A widely used toolbox's documentation prints these for dt = 1 s, tau = 20 s, sigma = 1 m/s^2 (4 decimals).
    step = singer(1, 20.0, 1.0).step(np.asarray(1.0))
    Q = [[0.0049, 0.0121, 0.0159], [0.0121, 0.0321, 0.0476], [0.0159, 0.0476, 0.0952]]
    np.testing.assert_allclose(step.Q, Q, atol=5e-5)
    np.testing.assert_allclose(step.F, [[1, 1, 0.4918], [0, 1, 0.9754], [0, 0, 0.9512]], atol=5e-5)


def test_singer_acceleration_is_stationary():
    step = singer(1, 5.0, 2.0).step(np.array([0.3, 7.0]))
    np.testing.assert_allclose(step.F[:, 2, 2] ** 2 * 4.0 + step.Q[:, 2, 2], 4.0, rtol=1e-14)


def test_acceleration_constant_within_a_scan():
    T, sigma = 10.0, np.array([3.0, 35.0])
    step = constant_velocity(2, accel=sigma, kind="scan").step(np.asarray(T))
    g = np.array([T**2 / 2, T])
    F, Q = np.zeros((4, 4)), np.zeros((4, 4))
    for axis in range(2):  # x, vx, y, vy
        part = slice(2 * axis, 2 * axis + 2)
        F[part, part], Q[part, part] = [[1, T], [0, 1]], sigma[axis] ** 2 * np.outer(g, g)
    np.testing.assert_allclose(step.F, F)
    np.testing.assert_allclose(step.Q, Q)


def test_acceleration_that_lasts_spreads_the_velocity_of_its_time_as_a_constant_one():
    lasting = constant_velocity(1, accel=3.0, accel_time=10.0).step(np.asarray(10.0)).Q
    scan = constant_velocity(1, accel=3.0, kind="scan").step(np.asarray(10.0)).Q
    np.testing.assert_allclose(lasting[1, 1], scan[1, 1])
    np.testing.assert_allclose(lasting, constant_velocity(1, accel=90.0, kind="white").step(np.asarray(10.0)).Q)


@pytest.mark.parametrize("motion", WHITE, ids=lambda m: m.law if m.turn is None else f"turn {float(m.turn)}")
def test_two_intervals_are_one(motion):
    F, Q, _ = motion.step(np.array([1.3, 2.9, 4.2]))
    np.testing.assert_allclose(F[2], F[1] @ F[0], rtol=1e-12, atol=1e-14)
    assert_same_cov(F[1] @ Q[0] @ F[1].T + Q[1], Q[2])


def test_parameters_depend_on_chains():
    mode = Chain("mode", {"calm": 1.0, "wild": 9.0}, stay=0.9)
    place = Chain("place", ["near", "far"], stay=0.5)
    motion = singer(2, tau=lambda place: 5.0 if place == "near" else 50.0, sigma=lambda mode: [mode, 2 * mode])
    step = motion.bind([mode, place]).step(np.array([1.0, 2.0, 3.0]))
    assert step.F.shape == (3, 1, 2, 6, 6) and step.Q.shape == (3, 2, 2, 6, 6)
    one = singer(2, tau=50.0, sigma=[9.0, 18.0]).step(np.asarray(2.0))
    np.testing.assert_allclose(step.Q[1, 1, 1], one.Q, rtol=1e-14)
    np.testing.assert_allclose(step.F[1, 0, 1], one.F, rtol=1e-14)


@pytest.mark.parametrize(
    "build, message",
    [
        (lambda: constant_velocity(0, accel=1.0), "positive whole number of axes, got 0"),
        (lambda: constant_velocity(2, accel=-1.0), "accel must be not negative, got -1"),
        (lambda: constant_velocity(2, accel=[1.0, 2.0, 3.0]), r"accel must be a number or one per axis \(2,\)"),
        (lambda: constant_velocity(2, accel=1.0, kind="scan").sde(), "has no stochastic differential equation"),
        (lambda: constant_velocity(1, accel=1.0, turn=0.1), "a turn needs a plane: dims must be 2 or more, got 1"),
        (lambda: constant_velocity(2, accel=[1.0, 2.0], turn=0.1), "accel must be equal on the first two axes"),
        (lambda: constant_velocity(2, accel=1.0, accel_time=[1.0, 2.0], turn=0.1), "accel_time must be equal on the"),
        (lambda: constant_velocity(2, accel=1.0, accel_time=0.0), "accel_time must be positive, got 0"),
        (lambda: constant_velocity(2, accel=1.0, kind="white", accel_time=1.0), "goes with kind='lasting', not with"),
        (lambda: constant_acceleration(1, jerk=np.nan), "jerk holds nan"),
        (lambda: singer(1, tau=0.0, sigma=1.0), "tau must be positive, got 0"),
        (lambda: singer(1, tau=1.0, sigma="big"), "sigma must be real numbers"),
        (lambda: singer(1, tau=1.0, sigma=lambda m: m).step(np.asarray(1.0)), "put it into a HybridModel"),
    ],
)
def test_bad_motion(build, message):
    with pytest.raises(ModelError, match=message):
        build()


def test_a_turn_goes_to_the_right_along_a_circle():
    # North at 10 m/s, 90 degrees to the right in 30 s: a quarter of the circle of radius v/turn about (r, 0).
    T, turn = 30.0, np.pi / 60.0
    radius = 10.0 / turn
    for kind in ("lasting", "scan", "white"):
        F = constant_velocity(2, accel=1.0, kind=kind, turn=turn).step(np.asarray(T)).F
        np.testing.assert_allclose(F @ [0.0, 0.0, 0.0, 10.0], [radius, 10.0, radius, 0.0], atol=1e-12)


@pytest.mark.parametrize("u", [1e-8, 1e-3, 0.5, 0.999999, 1.000001, 4.0])
def test_acceleration_constant_in_a_turn_by_quadrature(u):
    # Impulse responses by Gauss-Legendre from F alone, which its own test checks; entries down to dt^4 u.
    T, sigma = 4.0, 3.0
    motion = constant_velocity(2, accel=sigma, kind="scan", turn=u / T)
    nodes, weights = leggauss(30)
    F = motion.step((nodes + 1) / 2 * T).F
    gain = np.einsum("s,sij->ij", weights / 2 * T, F[:, :, [1, 3]])  # to accelerations along x and y
    expected = sigma**2 * gain @ gain.T
    np.testing.assert_allclose(motion.step(np.asarray(T)).Q, expected, rtol=1e-12, atol=1e-13 * expected.max())


@pytest.mark.parametrize("kind", ["lasting", "scan", "white"])
def test_without_turn_it_is_constant_velocity(kind):
    chain = Chain("way", {"straight": 0.0, "right": 0.05}, stay=0.9)
    dt = np.array([0.0, 0.5, 4.0])
    step = constant_velocity(3, accel=[2.0, 2.0, 1.0], kind=kind, turn=lambda way: way).bind([chain]).step(dt)
    plain = constant_velocity(3, accel=[2.0, 2.0, 1.0], kind=kind).step(dt)
    assert step.F.shape == step.Q.shape == (3, 2, 6, 6)
    np.testing.assert_allclose(step.F[:, 0], plain.F, rtol=1e-14)
    np.testing.assert_allclose(step.Q[:, 0], plain.Q, rtol=1e-14)
    np.testing.assert_array_equal(step.Q[:, 1, 4:, :], plain.Q[:, 4:, :])  # height does not turn


def test_negative_values_of_a_chain_are_found():
    chain = Chain("c", {"a": 1.0, "b": -1.0}, stay=0.9)
    with pytest.raises(ModelError, match="accel must be not negative, got -1"):
        constant_velocity(1, accel=lambda c: c).bind([chain])
