"""Bearings on tracks: against the extended Kalman filter written out, and in scenes with cameras."""

from dataclasses import replace

import numpy as np
import pytest
from tracking_scenes import fed, tracker_of

from saltus.geo import Plane
from saltus.records import Kind, Plots, Source, System
from saltus.tracks.channel import Start
from saltus.tracks.colour import Colour
from saltus.tracks.faults import SourceCondition, plot_law
from saltus.tracks.gates import Gate
from saltus.tracks.kinematics import Chosen, make_kinematics
from saltus.tracks.lifecycle import CONFIRMED, SEED, Birth, Lifecycle
from saltus.tracks.measurements import Noise, place_plots
from saltus.tracks.settings import FilterSettings, TrackerSettings
from saltus.tracks.sights import sight

LATITUDE, LONGITUDE = np.radians([63.4, 10.4])
PLANE = Plane(float(LATITUDE), float(LONGITUDE))
ONE_MODE = FilterSettings(accel_h=(0.1,), sojourn_h=(100.0,), accel_v=(0.01,), sojourn_v=(100.0,), accel_time=0.0)
SETTINGS = TrackerSettings(
    detection_probability=0.9, clutter_density=1e-6, max_speed=15.0, coast_seconds=8.0, height_prior=(0.0, 10.0)
)
NO_FAULT = TrackerSettings(plot_outlier=0.0, degraded_noise=1.0)
GATE = 15.137  # chi-square, one degree of freedom, 0.9999
SIGMA = 0.02


def observed(time, source, kind, origin, xy=None, bearing=None, sigma_xy=2.0):
    """Reports from observers at plane positions `origin`, in time order."""
    order = np.argsort(time, kind="stable")
    n = len(order)
    latitude, longitude = PLANE.inverse(np.asarray(origin, float))
    columns = {
        "time": time,
        "source": source,
        "kind": kind,
        "observer_latitude": latitude,
        "observer_longitude": longitude,
        "observer_height": np.zeros(n),
        "azimuth": np.full(n, np.nan) if bearing is None else bearing,
        "x": np.full(n, np.nan) if xy is None else xy[:, 0],
        "y": np.full(n, np.nan) if xy is None else xy[:, 1],
    }
    sources = tuple(Source(System(None, None, None, name)) for name in ("radar", "camera"))
    plots = Plots.build(n, sources, ("t",), {k: np.asarray(v)[order] for k, v in columns.items()})
    noise = {0: Noise(xy=sigma_xy), 1: Noise(azimuth=SIGMA)}
    return place_plots(plots, PLANE, [None, None], noise, (0.0, 10.0))


def bearings(time, origin, bearing):
    n = len(time)
    return observed(np.asarray(time, float), np.ones(n), np.full(n, Kind.BEARING), origin, bearing=np.asarray(bearing))


def seen_by(kinematics, life, m, index):
    source = SourceCondition(plot_law(NO_FAULT, Kind.BEARING), NO_FAULT)
    gate = Gate(SETTINGS, ONE_MODE, np.ones(2), use_identity=False)
    return sight(kinematics, life, m, index, gate, source, source.predicted(0.0))


def one_track(mean, cov, status=CONFIRMED):
    kinematics, life = make_kinematics(ONE_MODE), Lifecycle(SETTINGS)
    rows = kinematics.add(Start(mean[None], cov[None]))
    life.begin(rows, Birth(np.zeros(1), np.ones(1), np.zeros(1, np.intp), mean[None], cov[None]))
    life.status[rows] = status
    return kinematics, life


def test_bearings_in_the_plane():
    """Rows and columns are the azimuth from the plane's north, and the place where it was taken."""
    m = bearings([0.0, 1.0], [[100.0, -200.0], [30e3, 40e3]], [0.5, 6.0])
    np.testing.assert_allclose(m.origin, [[100.0, -200.0], [30e3, 40e3]], atol=1e-6)
    convergence = PLANE.factors([[100.0, -200.0], [30e3, 40e3]])[0]
    np.testing.assert_allclose(m.bearing, np.array([0.5, 6.0]) - convergence)
    assert abs(convergence[1]) > 1e-3
    np.testing.assert_array_equal(m.sigma_bearing, SIGMA)
    assert np.isnan(m.position).all()


@pytest.mark.parametrize("angle", [0.3, 1.7, 3.1, -3.1, -1.0])
def test_one_update_is_the_extended_kalman_filter_s(angle, rng):
    """beta = atan2(x, y) with its Jacobian (y, -x) / rho^2, prediction by hand; the origin is not the plane's."""
    origin = np.array([60.0, -90.0])
    place = origin + 150.0 * np.array([np.sin(angle), np.cos(angle)])
    mean = np.array([place[0], 3.0, place[1], -2.0, 0.0, 0.0])
    root = rng.standard_normal((4, 4)) * [3.0, 0.5, 3.0, 0.5]
    cov = np.eye(6)
    cov[:4, :4] = root.T @ root
    kinematics, life = one_track(mean, cov)
    dt = 0.7
    F = np.kron(np.eye(2), [[1.0, dt], [0.0, 1.0]])
    G = np.kron(np.eye(2), [[0.5 * dt**2], [dt]])
    x, P = F @ mean[:4], F @ cov[:4, :4] @ F.T + 0.1**2 * G @ G.T
    away = x[[0, 2]] - origin
    predicted = np.arctan2(away[0], away[1])
    z = predicted + 0.01
    # The Jacobian is taken across the measured line of sight, a hundredth of a radian from the predicted one.
    u, c = np.array([np.sin(z), np.cos(z)]), np.array([np.cos(z), -np.sin(z)])
    rho = away @ u
    H = np.zeros((1, 4))
    H[0, [0, 2]] = c / rho
    S = (H @ P @ H.T)[0, 0] + SIGMA**2
    nu = -(c @ away) / rho
    assert nu == pytest.approx(0.01, rel=1e-3)
    K = P @ H.T / S
    expected, expected_cov = x + K[:, 0] * nu, P - K @ H @ P
    m = bearings([dt], [origin], [z + PLANE.factors([origin])[0][0]])
    seen = seen_by(kinematics, life, m, np.array([0]))
    kinematics.absorb(seen.pairs.track, seen.copies, Chosen.sure(seen.copy, seen.plan, seen.covs[:, 0]))
    moments = kinematics.moments(seen.pairs.track)
    np.testing.assert_allclose(moments.mean[0, :4], expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(moments.cov[0, :4, :4], expected_cov, rtol=1e-4, atol=1e-5)
    # Density of the bearing, per radian.
    assert seen.score()[0, 0] == pytest.approx(-0.5 * (nu**2 / S + np.log(2 * np.pi * S)), abs=1e-4)


def test_lasting_errors_taken_for_noise_widen_the_update_and_no_gate():
    """Where a track has no state for them, so many bearings tell less; with one, they are told apart from its place."""
    origin, mean = [[0.0, 0.0]], np.array([200.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    cov = np.diag([9.0, 0.01, 9.0, 0.01, 1.0, 1.0])
    m = bearings([1e-3], origin, [np.pi / 2 + 0.05])
    lasting = np.zeros((1, 2, 2))
    lasting[0, 0, 0] = 2.0 * SIGMA
    lasting_m = replace(m, lasting=lasting, sigma_bearing=np.array([np.sqrt(5.0) * SIGMA]))

    def after(seen, colours, states):
        kinematics, life = one_track(mean, cov)
        kinematics = kinematics.adopt(colours, TrackerSettings(lasting_states=states))
        found = seen_by(kinematics, life, seen, np.array([0]))
        kinematics.absorb(found.pairs.track, found.copies, Chosen.sure(found.copy, found.plan, found.covs[:, 0]))
        return found, kinematics.moments(found.pairs.track)

    colours = [Colour(), Colour(1, 9.0, 4.0)]
    noise, moments = after(lasting_m, colours, 0)
    _, coarse = after(replace(m, sigma_bearing=np.array([np.sqrt(1.0 + 4.0 * 4.0) * SIGMA])), [], 0)
    np.testing.assert_allclose(moments.mean, coarse.mean, atol=1e-6)
    np.testing.assert_allclose(moments.cov, coarse.cov, atol=1e-6)
    state, held = after(lasting_m, colours, 4)
    _, plain = after(replace(m, sigma_bearing=np.array([np.sqrt(5.0) * SIGMA])), [], 0)
    np.testing.assert_allclose(held.mean, plain.mean, atol=1e-6)  # the first one tells as much as noise so large
    np.testing.assert_allclose(held.cov, plain.cov, atol=1e-6)
    assert noise.d2[0] == pytest.approx(state.d2[0])


def test_gates_of_bearings():
    """Across pi, behind the observer, beyond the gate, and tracks that are not confirmed."""
    origin = [[0.0, 0.0]]
    mean = np.array([0.0, 0.0, -200.0, 0.0, 0.0, 0.0])  # south
    cov = np.diag([4.0, 0.01, 4.0, 0.01, 1.0, 1.0])
    limit = np.sqrt(GATE * (SIGMA**2 + 4.0 / 200.0**2))

    def pairs(bearing, status=CONFIRMED):
        kinematics, life = one_track(mean, cov, status)
        return len(seen_by(kinematics, life, bearings([1e-3], origin, [bearing]), np.array([0])).pairs.track)

    assert pairs(np.pi) == pairs(np.pi - 0.9 * limit) == pairs(0.9 * limit - np.pi) == 1
    assert pairs(np.pi - 1.1 * limit) == pairs(0.0) == 0
    assert pairs(np.pi, SEED) == 0


def scene(rng, *, until=60.0, radar_until=None, camera=True, clutter=0):
    """A radar and a camera on a ship that moves, two boats; bearings and positions with their truth."""
    rows = []
    for t in np.arange(0.0, until, 1.0):
        ship = np.array([2.0 * t, -1.0 * t])
        boats = np.array([[150.0 + 1.5 * t, 60.0 - 2.0 * t], [-120.0 + 2.5 * t, 100.0 + 1.0 * t]])
        if radar_until is None or t < radar_until:
            rows += [(t, 0, Kind.PLANE, *ship, *(b - ship + 2.0 * rng.standard_normal(2)), np.nan) for b in boats]
        if camera:
            away = boats - ship
            seen = np.arctan2(away[:, 0], away[:, 1]) + SIGMA * rng.standard_normal(2)
            seen = np.concatenate([seen, rng.uniform(-np.pi, np.pi, clutter)])
            rows += [(t + 0.5, 1, Kind.BEARING, *ship, np.nan, np.nan, b) for b in seen]
    table = np.array(rows)
    return observed(
        table[:, 0], table[:, 1], table[:, 2].astype(np.int8), table[:, 3:5], xy=table[:, 5:7], bearing=table[:, 7]
    )


def tracked(m):
    return fed(tracker_of(m, settings=SETTINGS, filters=ONE_MODE, periods=[1.0, 1.0], identity=False), m)


def test_bearings_alone_start_nothing(rng):
    m = scene(rng, until=20.0, radar_until=0.0)
    rows, found = tracked(m)
    assert len(m) == 40
    assert len(rows.time) == 0
    assert len(found.confirmed) == 0
    assert np.all(found.track_id == 0)


def test_bearings_go_to_their_boats_and_clutter_to_none(rng):
    m = scene(rng, clutter=5)
    rows, found = tracked(m)
    assert len(found.confirmed) == 2
    is_bearing = np.isfinite(m.bearing)
    late = m.time > 6.0
    assigned = found.track_id[is_bearing & late].reshape(-1, 7)
    true, false = assigned[:, :2], assigned[:, 2:]
    assert np.mean(true > 0) > 0.9
    assert np.mean(false > 0) < 0.06  # two gates of 0.3 rad among 2 pi, taken only where the boat's own is farther
    for k in (0, 1):  # each boat's bearings to one track
        assert len(np.unique(true[true[:, k] > 0, k])) == 1
    assert np.isnan(rows.d2[np.isin(rows.measurement, np.flatnonzero(is_bearing))]).all()


def test_bearings_shrink_the_error_across_the_line_of_sight(rng):
    """At 150 m 0.02 rad are 3 m, about as good as the radar, across one of two axes."""
    with_camera, _ = tracked(scene(np.random.default_rng(7)))
    without, _ = tracked(scene(np.random.default_rng(7), camera=False))

    def area(rows):
        late = (rows.time > 30.0) & (rows.measurement >= 0)
        return np.median(np.linalg.det(rows.moments.cov[late][:, :3:2, :3:2]))

    assert area(with_camera) < 0.85 * area(without)


def test_bearings_keep_no_track_alive(rng):
    """Without the radar's plots tracks end after `coast_seconds`, whatever the camera sees, and are not coasted."""
    rows, found = tracked(scene(rng, radar_until=20.0))
    assert len(found.confirmed) == 2
    assert 26.0 < rows.time.max() < 30.0
    from_camera = rows.time > 20.0
    assert np.all(rows.measurement[from_camera] >= 0)
