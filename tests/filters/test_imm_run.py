"""Records of one object through a described model: linear and nonlinear sensors, observers that move, faults."""

import inspect

import numpy as np
import pytest
from scipy.stats import chi2

from oracles import error
from saltus import IMM, Chain, Gaussian, HybridModel, Record, constant_velocity
from saltus.errors import DataError, ModelError, NumericalError
from saltus.filters import ExactFilter, ParticleFilter
from saltus.models import FunctionSensor, LinearSensor, LinearTransition, Observer, PolarSensor, PositionSensor

METHODS = ("extended", "cubature")
TURN = Chain("manoeuvre", {"cruise": 0.5, "turn": 5.0}, stay=0.9, per=4.0)
FAULT = Chain("fault", {"ok": 1.0, "bad": 10.0}, sojourn={"ok": 100.0, "bad": 20.0})
MOTION = constant_velocity(2, accel=lambda manoeuvre: manoeuvre)
PRIOR = Gaussian([3e3, 20.0, 4e3, -30.0], np.diag([200.0, 20.0, 200.0, 20.0]) ** 2)
H, H2 = np.eye(4)[::2], np.array([[1.0, 0.0, 1.0, 0.0]])
FIELDS = ("probs", "mean", "cov", "log_likelihood", "nis", "n_observed", "mode_means", "mode_covs")


def a_model(sensors, chains=(TURN, FAULT), dynamics=MOTION, prior=PRIOR):
    return HybridModel(chains, dynamics, sensors, prior)


def as_function(matrix, **changes):
    """A linear sensor that says nothing of being linear."""
    H = np.asarray(matrix)
    return FunctionSensor(
        function=lambda x: x @ H.T, derivative=lambda x: np.broadcast_to(H, (*x.shape[:-1], *H.shape)), **changes
    )


def close(actual, expected, tolerance=1e-10):
    for name in FIELDS:
        if getattr(expected, name) is not None:
            assert error(getattr(actual, name), getattr(expected, name)) < tolerance, name


def two_rates(rng):
    """Plots every 4 s, sums every 2.5 s (both at 0, 20, 40, ...), a component and a whole plot missing."""
    plots = [(t, "plot", np.array([3e3, 4e3]) + rng.normal(size=2) * 200) for t in np.arange(0.0, 60.0, 4.0)]
    sums = [(t, "sum", [7e3 + rng.normal() * 200]) for t in np.arange(0.0, 60.0, 2.5)]
    plots[3][2][0] = np.nan
    plots[7][2][:] = np.nan
    return sorted([*plots, *sums], key=lambda record: record[0])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("iterations", [1, 2])
def test_linear_sensors_through_the_nonlinear_path_are_the_batch_filter(method, iterations, rng):
    plot = dict(R=lambda fault: fault**2 * np.diag([400.0, 900.0]))
    sum_ = dict(R=lambda t: [[100.0 + t]])

    def bias(manoeuvre, fault):
        return [manoeuvre + fault, 1.0]

    linear = a_model({"plot": LinearSensor(H=H, d=bias, **plot), "sum": LinearSensor(H=H2, **sum_)})
    curved = a_model({"plot": as_function(H, offset=bias, **plot), "sum": as_function(H2, **sum_)})
    half = a_model({"plot": LinearSensor(H=H, d=bias, **plot), "sum": as_function(H2, **sum_)})
    records = two_rates(rng)
    expected = IMM(linear, per_mode=True).run(records)
    for model in (curved, half):
        actual = IMM(model, per_mode=True, linearise=method, iterations=iterations).run(records)
        close(actual, expected)
        assert actual.chains == expected.chains == ("manoeuvre", "fault")
        np.testing.assert_array_equal(actual.times, [record[0] for record in records])


def test_no_chains_a_prior_of_its_own_time_and_motion_per_step(rng):
    dynamics = LinearTransition(F=0.9 * np.eye(2), Q=np.eye(2), b=[1.0, -1.0])
    prior = Gaussian([5.0, 6.0], np.eye(2) * 4, time=-1.0)
    records = [(float(k), "s", rng.normal(size=2)) for k in range(10)]
    expected = IMM(a_model({"s": LinearSensor(H=np.eye(2), R=np.eye(2))}, (), dynamics, prior)).run(records)
    actual = IMM(a_model({"s": as_function(np.eye(2), R=np.eye(2))}, (), dynamics, prior)).run(records)
    assert actual.mode_means is None and actual.probs.shape == (10,)
    close(actual, expected)


def test_a_row_without_measurement_is_a_prediction():
    model = a_model({"radar": PolarSensor(sigma_range=10.0, sigma_azimuth=0.01), "plot": PositionSensor(2, 10.0)})
    records = [(0.0, "plot", [3e3, 4e3]), (4.0, "radar", [np.nan, np.nan]), (8.0, "plot", [3100.0, 3900.0])]
    nothing = [(0.0, "plot", [3e3, 4e3]), (4.0, "plot", [np.nan, np.nan]), (8.0, "plot", [3100.0, 3900.0])]
    close(IMM(model, per_mode=True).run(records), IMM(model, per_mode=True).run(nothing))


def flight(rng, n=40, dt=3.0):
    """A straight flight past the origin on its south side, from south-east to south-west: azimuth jumps at 180."""
    times = np.arange(n) * dt
    x = np.stack([3e3 - 50 * times, np.full(n, -50.0), np.full(n, -2e3), np.zeros(n)], axis=-1)
    return times, x


SOUTH = Gaussian([3e3, -40.0, -2e3, 5.0], np.diag([100.0, 20.0, 100.0, 20.0]) ** 2)


@pytest.mark.parametrize("nonlinear", [False, True])
def test_a_record_without_values_changes_nothing_that_follows(nonlinear):
    sensor = as_function(H, R=[[1.0, 0.0], [0.0, 1.0]]) if nonlinear else PositionSensor(2, sigma=1.0)
    seen = [(0.0, "s", [3e3, 4e3]), (8.0, "s", [3.2e3, 3.8e3]), (9.0, "s", [3.2e3, 3.8e3])]
    without = IMM(a_model({"s": sensor}), per_mode=True).run(seen)
    between = IMM(a_model({"s": sensor}), per_mode=True).run([seen[0], (4.0, "s", [np.nan] * 2), *seen[1:]])
    assert "per-interval" not in {f.kind for f in (*without.findings, *between.findings)}
    # Modes are mixed at the record: the chain's law is that over the whole interval, the mixed moments are not.
    one = IMM(a_model({"s": sensor}, chains=(), dynamics=constant_velocity(2, accel=3.0)))
    for name in ("mean", "cov", "log_likelihood"):
        a, b = (getattr(one.run(rows), name) for rows in (seen, [seen[0], (4.0, "s", [np.nan] * 2), *seen[1:]]))
        np.testing.assert_allclose(a, b[[0, 2, 3]], rtol=1e-11)


def test_motion_per_interval_is_told_where_intervals_differ():
    scan = a_model({"s": PositionSensor(2, 1.0)}, dynamics=constant_velocity(2, accel=1.0, kind="scan"))
    rows = [(t, "s", [3e3, 4e3]) for t in (0.0, 4.0, 8.0, 16.0)]
    for bound in (IMM(scan), ExactFilter()(scan)):
        assert "per-interval" in {f.kind for f in bound.run(rows).findings}
        assert "per-interval" not in {f.kind for f in bound.run(rows[:3]).findings}
    drawn = ParticleFilter(n=16, groups=2)(scan).run(rows, rng=np.random.default_rng(1))
    assert [f.kind for f in drawn.findings] == ["per-interval"]


@pytest.mark.parametrize("method", METHODS)
def test_azimuth_may_cross_south(method, rng):
    # The same azimuths, read clockwise from south: a heading of pi puts the jump to the north, out of sight.
    times, x = flight(rng)
    plain = PolarSensor(sigma_range=20.0, sigma_azimuth=0.02)
    turned = PolarSensor(sigma_range=20.0, sigma_azimuth=0.02, observer=Observer([0.0, 0.0], heading=np.pi))
    z = plain.h(x) + rng.normal(size=(len(times), 2)) * [20.0, 0.02]
    z[:, 1] = np.mod(z[:, 1], 2 * np.pi)  # as most radars report it
    assert np.abs(np.diff(plain.h(x)[:, 1])).max() > 6
    own = np.stack([z[:, 0], z[:, 1] - np.pi], axis=-1)
    filters = IMM(per_mode=True, linearise=method, iterations=2)
    expected = filters(a_model({"s": turned}, prior=SOUTH)).run(zip(times, ["s"] * len(times), own, strict=True))
    actual = filters(a_model({"s": plain}, prior=SOUTH)).run(zip(times, ["s"] * len(times), z, strict=True))
    close(actual, expected, 1e-9)
    assert np.abs(actual.mean[-1, ::2] - x[-1, ::2]).max() < 100.0
    assert actual.nis.max() < chi2.ppf(1 - 1e-4, 2)


@pytest.mark.parametrize("method", METHODS)
def test_a_moving_observer_is_a_frame_that_moves(method, rng):
    # Constant velocity of the observer, given per record: relative to it the same motion, and an observer at rest.
    times, x = flight(rng)
    place, speed, heading = np.array([-500.0, 300.0]), np.array([8.0, -12.0]), 0.4
    own = np.zeros((len(times), 4))
    own[:, ::2], own[:, 1::2] = place + speed * times[:, None], speed
    sigmas = dict(sigma_range=20.0, sigma_azimuth=0.02, sigma_range_rate=1.0)
    z = PolarSensor(**sigmas).h(x - own) + rng.normal(size=(len(times), 3)) * [20.0, 0.02, 1.0]
    z[:, 1] -= heading
    moving = [Record(t, "s", row, Observer(o[::2], o[1::2], heading)) for t, row, o in zip(times, z, own, strict=True)]
    at_rest = PolarSensor(**sigmas, observer=Observer([0.0, 0.0], heading=heading))
    filters = IMM(linearise=method)
    actual = filters(a_model({"s": PolarSensor(**sigmas)}, prior=SOUTH)).run(moving)
    prior = Gaussian(np.asarray(SOUTH.mean) - own[0], SOUTH.cov)
    relative = filters(a_model({"s": at_rest}, prior=prior)).run(zip(times, ["s"] * len(times), z, strict=True))
    np.testing.assert_allclose(actual.mean - own, relative.mean, atol=1e-6)
    np.testing.assert_allclose(actual.cov, relative.cov, atol=1e-6)
    np.testing.assert_allclose(actual.probs, relative.probs, atol=1e-9)
    np.testing.assert_allclose(actual.log_likelihood, relative.log_likelihood, atol=1e-7)


def bearings_only(rng, sites_of):
    """Bearings of a target at constant velocity, known beforehand to 1.5 km and 2 m/s; NEES at the end, and spread."""
    sigma, times = 0.01, np.arange(0.0, 120.0, 8.0)
    mean, sd = np.array([2e3, -8.0, 8e3, 5.0]), np.array([1500.0, 2.0, 1500.0, 2.0])
    F = np.array([[1.0, 8.0], [0.0, 1.0]])
    prior = Gaussian(mean, np.diag(sd**2))
    names = [f"eye{i}" for i in range(len(sites_of(0.0)))]
    dynamics = constant_velocity(2, accel=0.01)
    model = HybridModel([], dynamics, {name: PolarSensor(sigma_azimuth=sigma) for name in names}, prior)
    nees, spread = [], []
    for _ in range(8):
        x, records = mean + sd * rng.normal(size=4), []
        for t in times:
            for name, site in zip(names, sites_of(t), strict=True):
                z = np.arctan2(x[0] - site[0], x[2] - site[1]) + sigma * rng.normal()
                records.append(Record(t, name, [z], Observer(site)))
            x = np.kron(np.eye(2), F) @ x + 0.01 * np.kron(rng.normal(size=2), [32.0, 8.0])
        x = np.kron(np.eye(2), np.linalg.inv(F)) @ x  # back to the last record, but for its last disturbance
        est = IMM(model, linearise="cubature").run(records)
        e = est.mean[-1] - x
        nees.append(e @ np.linalg.solve(est.cov[-1], e))
        spread.append(np.sqrt(np.linalg.eigvalsh(est.cov[-1][::2, ::2])[-1]))
    return np.mean(nees), np.median(spread)


def test_bearings_fix_an_object_only_from_several_places(rng):
    # Two sensors at rest, at the same times; one that passes across the line of sight; one that stays, and learns
    # next to nothing of the distance.
    low, high = chi2.ppf([5e-4, 1 - 5e-4], 4 * 8) / 8
    two = bearings_only(rng, lambda t: ([-3e3, 0.0], [3e3, 0.0]))
    moving = bearings_only(rng, lambda t: ([-4e3 + 100.0 * t, 0.0],))
    one = bearings_only(rng, lambda t: ([0.0, 0.0],))
    assert low < two[0] < high and low < moving[0] < high
    assert two[1] < 120.0 < moving[1] < 350.0 < 500.0 < one[1]


def test_a_fault_of_the_azimuth_is_not_one_of_the_range(rng):
    azimuth = Chain("azimuth", {"ok": 1.0, "bad": 20.0}, sojourn={"ok": 200.0, "bad": 15.0})
    distance = Chain("range", {"ok": 1.0, "bad": 20.0}, sojourn={"ok": 200.0, "bad": 15.0})
    radar = PolarSensor(sigma_range=lambda range: 10.0 * range, sigma_azimuth=lambda azimuth: 0.002 * azimuth)
    model = HybridModel([azimuth, distance], constant_velocity(2, accel=0.2), {"radar": radar}, SOUTH)
    times, x = flight(rng)
    z = PolarSensor(sigma_range=1.0, sigma_azimuth=1.0).h(x) + rng.normal(size=(len(times), 2)) * [10.0, 0.002]
    z[15:18, 1] += [0.05, -0.06, 0.05]
    z[28:31, 0] += [-250.0, 300.0, -200.0]
    for method in METHODS:
        est = IMM(model, linearise=method).run(zip(times, ["radar"] * len(times), z, strict=True))
        bad = np.stack([est.prob("azimuth")[:, 1], est.prob("range")[:, 1]], axis=-1)
        assert bad[15:18, 0].min() > 0.9 and bad[15:18, 1].max() < 0.5
        assert bad[28:31, 1].min() > 0.9 and bad[28:31, 0].max() < 0.5
        assert bad[5:15].max() < 0.5 and np.abs(est.mean[:, ::2] - x[:, ::2])[5:].max() < 60.0


def test_records_of_one_time_may_come_in_any_order(rng):
    # Exact for linear sensors; to the differences of linearisation points otherwise.
    model = a_model({"plot": PositionSensor(2, 30.0), "radar": PolarSensor(sigma_range=5.0, sigma_azimuth=0.001)})
    one = [(0.0, "plot", [3e3, 4e3]), (0.0, "radar", [5010.0, 0.645])]
    first, second = IMM(model).run(one), IMM(model).run(one[::-1])
    np.testing.assert_allclose(first.mean[-1], second.mean[-1], atol=0.5)
    np.testing.assert_allclose(first.cov[-1], second.cov[-1], rtol=0.02, atol=1.0)
    assert first.log_likelihood.sum() == pytest.approx(second.log_likelihood.sum(), abs=0.02)


RADAR = PolarSensor(sigma_range=10.0, sigma_azimuth=0.01)


@pytest.mark.parametrize(
    "records, message",
    [
        ([(0.0, "radar", [1.0])], r"record 0: sensor 'radar' measures 2 component\(s\), got shape \(1,\)"),
        ([(0.0, "radar", [1.0, np.inf])], r"record 0: sensor 'radar' gives \[1.0, inf\]. NaN marks"),
        ([(0.0, "radar", [5e3, 0.6]), (1.0, "sonar", [1.0])], "record 1: the model has no sensor 'sonar'"),
        ([(0.0, "sonar", [1.0])], "no sensor 'sonar'"),
        ([(2.0, "radar", [5e3, 0.6]), (1.0, "radar", [5e3, 0.6])], "record 1 at 1.0 s is older than record 0 at 2.0 s"),
        ([(0.0, "gps", [1.0, 2.0], Observer([0.0, 0.0]))], "record 0, sensor 'gps': a linear sensor has no observer"),
        (
            [(0.0, "radar", [1.0, 2.0], Observer([0.0, 0.0, 0.0]))],
            "record 0, sensor 'radar': the observer's position has 3",
        ),
        ([], "there is no record"),
    ],
)
def test_bad_records(records, message):
    model = a_model({"radar": RADAR, "gps": PositionSensor(2, 1.0)})
    with pytest.raises(DataError, match=message):
        IMM(model).run(records)


def test_bad_settings_and_a_prior_at_the_observer():
    bare = inspect.unwrap(IMM.__init__)  # without the tests' type checks
    with pytest.raises(ModelError, match=r"linearise is .* not 'unscented'"):
        bare(object.__new__(IMM), None, False, "unscented", 1)
    with pytest.raises(ModelError, match="iterations must be a whole number from 1, got 0"):
        IMM(iterations=0)
    with pytest.raises(ModelError, match="bound to no model"):
        IMM(linearise="cubature").run([(0.0, "radar", [5e3, 0.6])])
    nowhere = a_model({"radar": RADAR}, prior=Gaussian(np.zeros(4), np.eye(4)))
    with pytest.raises(NumericalError, match="coincides with the observer"):
        IMM(nowhere).run([(0.0, "radar", [5e3, 0.6])])
