"""Reports of moving observers in the tracker's plane, against PROJ."""

from dataclasses import replace

import numpy as np
import pyproj
import pytest
from tracking_scenes import measured

from saltus.config import SensorConfig
from saltus.engine.setup import given_noise
from saltus.errors import DataError
from saltus.geo import Plane, Site
from saltus.io.assemble import CATEGORIES
from saltus.records import Kind, Plots, Source, System
from saltus.tracks.local import local_system
from saltus.tracks.measurements import Noise, default_noise, make_plane, place_plots
from saltus.tracks.rows import Assignments, join_rows

N = 30
NOISE = Noise(range=3.0, azimuth=0.01, elevation=0.02, xy=2.0, altitude=1.0)


@pytest.fixture
def sea(rng):
    """A ship's track, and targets east, north and up of it with their places by PROJ."""
    ship = np.stack([63.4 + 0.05 * rng.random(N), 10.4 + 0.1 * rng.random(N), 40.0 + rng.random(N)])
    enu = np.stack([800.0 * rng.standard_normal(N), 800.0 * rng.standard_normal(N), 50.0 * rng.random(N)])
    places = []
    for (lat, lon, h), offset in zip(ship.T, enu.T, strict=True):
        to_geodetic = pyproj.Transformer.from_pipeline(
            f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0={lat} +lon_0={lon} +h_0={h} "
            "+step +inv +proj=cart +ellps=WGS84"
        )
        places.append(to_geodetic.transform(*offset))
    return ship, enu, np.array(places).T


def reports(ship, kind, **columns):
    latitude, longitude = np.radians(ship[:2])
    observer = {"observer_latitude": latitude, "observer_longitude": longitude, "observer_height": ship[2]}
    common = {"time": np.arange(N, dtype=float), "source": np.zeros(N), "kind": np.full(N, kind)}
    return Plots.build(N, (Source(System(None, None, None, "ship")),), ("t",), common | observer | columns)


def placed(plots):
    plane = make_plane(plots, [None])
    return place_plots(plots, plane, [None], {0: NOISE}, (0.0, 30.0)), plane


def test_the_plane_lies_about_the_observers(sea):
    ship, _, _ = sea
    plane = make_plane(reports(ship, Kind.PLANE), [None])
    assert isinstance(plane, Plane)
    np.testing.assert_allclose(np.degrees([plane.latitude, plane.longitude]), np.median(ship[:2], axis=1))
    with pytest.raises(DataError, match="no report can be placed"):
        make_plane(reports(np.full((3, N), np.nan), Kind.PLANE), [None])


def test_east_north_up_of_a_moving_observer(sea):
    ship, (x, y, z), (lon, lat, h) = sea
    m, plane = placed(reports(ship, Kind.PLANE, x=x, y=y, z=z))
    np.testing.assert_allclose(m.position[:, :2], plane.forward(np.radians(lat), np.radians(lon)), atol=1e-3)
    np.testing.assert_allclose(m.position[:, 2], h, atol=1e-3)
    np.testing.assert_allclose(m.cov[:, [0, 1, 2], [0, 1, 2]], [[4.0, 4.0, 1.0]] * N, rtol=1e-3)
    assert np.isnan(m.ray).all()
    flat, _ = placed(reports(ship, Kind.PLANE, x=x, y=y))
    assert np.isnan(flat.position[:, 2]).all()
    np.testing.assert_allclose(flat.position[:, :2], m.position[:, :2], atol=0.2)  # its height is taken for the ship's


def test_range_and_azimuth_from_a_moving_observer(sea):
    ship, (x, y, z), (lon, lat, h) = sea
    plots = reports(
        ship,
        Kind.POLAR,
        range=np.sqrt(x * x + y * y + z * z),
        azimuth=np.arctan2(x, y),
        elevation=np.where(np.arange(N) % 2, np.arctan2(z, np.hypot(x, y)), np.nan),
        altitude=h,
    )
    m, plane = placed(plots)
    # The bias removed is rho sigma^2 / 2, of the azimuth and (where measured) the elevation: below 1 m here.
    np.testing.assert_allclose(m.position[:, :2], plane.forward(np.radians(lat), np.radians(lon)), atol=1.0)
    np.testing.assert_allclose(m.ray, m.position[:, :2] - plane.forward(*np.radians(ship[:2])), atol=1e-9)
    across = np.stack([-m.ray[:, 1], m.ray[:, 0]], axis=-1) / np.linalg.norm(m.ray, axis=-1)[:, None]
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", across, m.cov[:, :2, :2], across))
    np.testing.assert_allclose(sigma, np.hypot(x, y) * NOISE.azimuth, rtol=0.01)


def test_reports_without_observer_are_seen_from_the_source_s_site(sea):
    ship, (x, y, z), _ = sea
    fixed = Site(*np.radians([63.42, 10.45]).tolist(), 12.0)
    always = np.broadcast_to([[63.42], [10.45], [12.0]], ship.shape)
    alone = np.where(np.arange(N) % 2, ship, np.nan)
    plane = Plane(fixed.latitude, fixed.longitude)

    def place(observers, site):
        plots = reports(observers, Kind.PLANE, x=x, y=y, z=z)
        return place_plots(plots, plane, [site], {0: NOISE}, (0.0, 30.0)).position

    mixed = place(alone, fixed)
    np.testing.assert_allclose(mixed[1::2], place(ship, None)[1::2], atol=1e-6)
    np.testing.assert_allclose(mixed[::2], place(always, None)[::2], atol=1e-6)
    with pytest.raises(DataError, match="unknown site"):
        place(alone, None)


@pytest.mark.parametrize("tau", [0.3, 4.0])
def test_errors_that_last_average_to_what_evidence_believes(tau):
    """The mean of many reports with errors of correlation a^|k|, against what each is taken to tell."""
    n, dt = 500, 0.5
    a, k = np.exp(-dt / tau), np.arange(n)
    cov = 4.0 * a ** np.abs(k[:, None] - k)
    m = measured(dt * k, np.zeros((n, 2)), 2.0)
    m = replace(m, lasting=np.broadcast_to(2.0 * np.eye(2), (n, 2, 2)), lasting_time=np.full(n, tau))
    rows = join_rows([])
    found = Assignments(np.ones(n, np.int64), np.zeros(n, bool), np.zeros(n, bool), np.array([1]), [])
    R = local_system("s", m, found, rows, np.full(n, -1), use_identity=True).view.tracks.R
    assert R[5, 0, 0] / n == pytest.approx(cov.mean(), rel=0.05)
    assert R[0, 0, 0] == 4.0  # the first of a track has none before it


def test_a_configured_correlation_time_is_that_of_the_deviation_given():
    radar = Source(System(48, 1, 2), CATEGORIES[48].traits, azimuth_lsb=1e-4)
    ship = Source(System(None, None, None, "ship"))
    given = given_noise(SensorConfig(name="ship", sigma_xy=2.0, correlation_time=5.0), ship, Kind.PLANE, 0.2)
    assert np.hypot(given["lasting"], given["xy"]) == pytest.approx(2.0)
    assert (given["xy"], given["lasting_time"]) == (pytest.approx(0.4), 5.0)
    given = given_noise(
        SensorConfig(sac=1, sic=2, sigma_azimuth=0.1, sigma_range=9.0, correlation_time=5.0), radar, Kind.POLAR, 0.2
    )
    assert np.hypot(given["lasting"], given["azimuth"]) == pytest.approx(np.radians(0.1))
    assert (given["azimuth"], given["range"]) == (pytest.approx(np.radians(0.02)), 9.0)
    given = given_noise(
        SensorConfig(name="ship", sigma_xy=2.0, sigma_lasting=7.0, lasting_scale_distance=9e3), ship, Kind.PLANE, 0.2
    )
    assert (given["lasting"], given["xy"], given["lasting_distance"]) == (7.0, 2.0, 9e3)
    alone = SensorConfig(name="ship", sigma_lasting=7.0)
    assert given_noise(alone, ship, Kind.PLANE, 0.2) == {"lasting": 7.0}  # m, whatever else is told
    assert given_noise(alone, ship, Kind.BEARING, 0.2) == {"lasting": np.radians(7.0)}
    assert "lasting" not in given_noise(SensorConfig(name="ship", sigma_xy=2.0), ship, Kind.PLANE, 0.2)


@pytest.mark.parametrize(("told", "time"), [({"sigma_time": 0.05}, 0.05), ({"sigma_xy": 3.0}, 0.0), ({}, None)])
def test_a_position_whose_noise_is_configured_has_exact_times_unless_told(told, time):
    ship = Source(System(None, None, None, "ship"))
    assert given_noise(SensorConfig(name="ship", **told), ship, Kind.PLANE, 0.2).get("time") == time


@pytest.mark.parametrize(("category", "time"), [(21, 0.2 / np.sqrt(12.0)), (10, 0.0)])
def test_transponders_send_positions_a_little_off_their_time(sea, category, time):
    assert default_noise(Source(System(1, 1, 1), CATEGORIES[category].traits)).time == time
    coarse = Source(System(1, 1, 1), CATEGORIES[category].traits, time_lsb=1.0)
    assert default_noise(coarse).time == pytest.approx(1.0 / np.sqrt(12.0))  # the clock's step
    ship, (x, y, _), _ = sea
    noise = {0: Noise(time=0.3)}
    m = place_plots(reports(ship, Kind.PLANE, x=x, y=y), Plane(1.1, 0.18), [None], noise, (0.0, 30.0))
    velocity = np.column_stack([np.arange(len(m)), np.full(len(m), 2.0)])
    added = m.stamped(np.arange(len(m)), velocity)
    np.testing.assert_allclose(added[:, :2, :2], 0.09 * np.einsum("ki,kj->kij", velocity, velocity))
    assert not added[:, 2].any() and not added[:, :, 2].any()


def test_lasting_errors_are_part_of_the_covariance_and_grow_with_distance(sea):
    ship, (x, y, _), site = sea
    noise = {0: Noise(xy=3.0, lasting=7.0, lasting_time=9.0, lasting_distance=2e3)}
    m = place_plots(reports(ship, Kind.PLANE, x=x, y=y), Plane(1.1, 0.18), [site], noise, (0.0, 30.0))
    white = place_plots(reports(ship, Kind.PLANE, x=x, y=y), Plane(1.1, 0.18), [site], {0: Noise(xy=3.0)}, (0.0, 30.0))
    scale = 7.0 * np.sqrt(1.0 + (np.hypot(x, y) / 2e3) ** 2)
    np.testing.assert_allclose(m.lasting, scale[:, None, None] * np.eye(2), rtol=2e-3)
    np.testing.assert_allclose((m.cov - white.cov)[:, 0, 0], scale**2, rtol=4e-3)
    assert not white.lasting.any() and (m.lasting_time == 9.0).all()
