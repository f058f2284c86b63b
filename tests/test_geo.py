"""Geometry: PROJ, decimal arithmetic and Monte Carlo are the oracles; none shares code with saltus.geo."""

from decimal import Decimal, getcontext

import numpy as np
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from saltus import geo
from saltus.errors import DataError, ModelError

NM = 1852.0
BARCELONA = geo.Site(np.radians(41.3), np.radians(2.1), 27.3)
GEOD = pyproj.Geod(ellps="WGS84")
TO_ECEF = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def ecef(lat, lon, height):
    return np.stack(TO_ECEF.transform(np.degrees(lon), np.degrees(lat), height), axis=-1)


def centred_plane(site=BARCELONA):
    return geo.Plane(site.latitude, site.longitude)


def slant_and_azimuth(lat, lon, height, site):
    """Slant range and azimuth of points seen from a site, by PROJ's topocentric conversion."""
    to_local = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 "
        f"+lat_0={np.degrees(site.latitude)} +lon_0={np.degrees(site.longitude)} +h_0={site.height}"
    )
    e, n, u = to_local.transform(np.degrees(lon), np.degrees(lat), height)
    return np.sqrt(e**2 + n**2 + u**2), np.arctan2(e, n) % (2 * np.pi)


# --- angles, ellipsoid -------------------------------------------------------------------------------------


@settings(deadline=None)  # nothing here is about time
@given(st.floats(-1e4, 1e4))
def test_wrap_is_the_same_angle_in_range(angle):
    wrapped = geo.wrap(angle)
    assert -np.pi <= wrapped < np.pi
    assert abs(np.exp(1j * wrapped) - np.exp(1j * angle)) < 1e-11  # 1e4 rad hold 2e-12


@pytest.mark.parametrize("angle", [np.pi, -np.pi, np.nextafter(-np.pi, -4), np.nextafter(np.pi, 0), 1e-300])
def test_wrap_at_the_edges(angle):
    wrapped = geo.wrap(angle)
    assert -np.pi <= wrapped < np.pi
    if -np.pi <= angle < np.pi:
        assert wrapped == angle


def test_ecef_agrees_with_proj_both_ways(rng):
    lat = np.append(rng.uniform(-1.57, 1.57, 500), [np.pi / 2, -np.pi / 2, 0.0])
    lon = rng.uniform(-np.pi, np.pi, 503)
    height = rng.uniform(-400, 40000, 503)
    xyz = ecef(lat, lon, height)
    np.testing.assert_allclose(geo.geodetic_to_ecef(lat, lon, height), xyz, atol=1e-8)
    back = geo.ecef_to_geodetic(xyz)
    np.testing.assert_allclose(back[0], lat, atol=1e-14)
    np.testing.assert_allclose(geo.wrap(back[1] - lon)[:500], 0, atol=1e-14 / np.cos(1.57))
    np.testing.assert_allclose(back[2], height, atol=1e-8)


def decimal_ground_range(r, h, hs, radius):
    """Law of cosines in 60 digits, the arc from its sine by series (|x| < 0.1)."""
    getcontext().prec = 60
    r, h, hs, radius = (Decimal(v) for v in (r, h, hs, radius))
    a, b = radius + hs, radius + h
    cosine = (a * a + b * b - r * r) / (2 * a * b)
    x = (1 - cosine * cosine).sqrt()
    term, total = x, x
    for n in range(1, 60):
        term *= x * x * (2 * n - 1) / (2 * n)
        total += term / (2 * n + 1)
    return radius * total


@pytest.mark.parametrize("range_nm", [0.2, 0.5, 1.7, 5.0, 20.0, 60.0, 120.0, 250.0])
@pytest.mark.parametrize("elevation", [0.001, 0.05, 0.5, 0.99])
def test_ground_range_to_a_millimetre(range_nm, elevation):
    r = range_nm * NM
    h = min(27.3 + elevation * r, 20000.0)
    radius = 6378137.0
    exact = decimal_ground_range(r, h, 27.3, radius)
    found = geo.slant_to_ground(r, h, 27.3, radius)
    assert abs(Decimal(float(found)) - exact) < Decimal("1e-6")  # a millimetre is wanted; float64 gives far more


def test_float32_input_is_converted_before_any_geometry():
    # In float32, squared earth radii would cost hundreds of metres.
    r, beta, h = (np.float32(v) for v in (123456.78, 1.2345, 9876.5))
    wide = [np.float64(v) for v in (r, beta, h)]
    plane = centred_plane()
    sigmas = {"sigma_range": 30.0, "sigma_azimuth": 1e-3, "sigma_altitude": 8.0}
    narrow_position = geo.polar_to_plane(r, beta, h, BARCELONA, plane, **sigmas)
    wide_position = geo.polar_to_plane(*wide, BARCELONA, plane, **sigmas)
    assert narrow_position.xy.dtype == np.float64
    for a, b in zip(narrow_position, wide_position, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("latitude", [-80.0, -26.75, 0.0, 41.3, 89.0])
def test_polar_to_geodetic_inverts_proj_to_a_millimetre(latitude, rng):
    site = geo.Site(np.radians(latitude), 0.4, 850.0)
    n = 400
    height = rng.uniform(-100, 20000, n)
    slant = np.abs(height - site.height) * 1.0001 + rng.uniform(0.2, 250, n) * NM
    azimuth = rng.uniform(0, 2 * np.pi, n)
    lat, lon, elevation_t, azimuth_t = geo.polar_to_geodetic(slant, azimuth, height, site)
    found_slant, found_azimuth = slant_and_azimuth(lat, lon, height, site)
    np.testing.assert_allclose(found_slant, slant, atol=1e-3)
    np.testing.assert_allclose(geo.wrap(found_azimuth - azimuth) * slant, 0, atol=1e-3)
    # The direction at the target: the way back to the site, reversed.
    ray = ecef(lat, lon, height) - ecef(site.latitude, site.longitude, site.height)
    further = ecef(lat, lon, height) + ray / slant[:, None]
    up = ecef(lat, lon, height + 1) - ecef(lat, lon, height)
    sine = np.einsum("ni,ni->n", up, further - ecef(lat, lon, height))
    np.testing.assert_allclose(np.sin(elevation_t), sine, atol=1e-8)
    back_azimuth, _, _ = GEOD.inv(
        np.degrees(lon), np.degrees(lat), *np.degrees([np.full(n, site.longitude), np.full(n, site.latitude)])
    )
    # Ray and geodesic differ by the skew of the normals: below 0.02 degrees at these ranges.
    np.testing.assert_allclose(geo.wrap(azimuth_t - np.radians(back_azimuth) - np.pi), 0, atol=4e-4)


def test_polar_coordinates_of_points_by_proj(rng):
    lat, lon, height = rng.uniform(0.70, 0.74, 200), rng.uniform(0.01, 0.07, 200), rng.uniform(0, 15000, 200)
    slant, azimuth, elevation = geo.geodetic_to_polar(lat, lon, height, BARCELONA)
    expected_slant, expected_azimuth = slant_and_azimuth(lat, lon, height, BARCELONA)
    np.testing.assert_allclose(slant, expected_slant, atol=1e-6)
    np.testing.assert_allclose(geo.wrap(azimuth - expected_azimuth), 0, atol=1e-9)
    up = ecef(BARCELONA.latitude, BARCELONA.longitude, 1e3) - ecef(BARCELONA.latitude, BARCELONA.longitude, 0.0)
    ray = ecef(lat, lon, height) - ecef(BARCELONA.latitude, BARCELONA.longitude, BARCELONA.height)
    np.testing.assert_allclose(np.sin(elevation), ray @ up / 1e3 / slant, atol=1e-9)


def test_impossible_triangle_is_overhead():
    lat, lon, elevation, azimuth = geo.polar_to_geodetic(5000.0, 1.0, 9000.0, BARCELONA)
    assert GEOD.inv(*np.degrees([BARCELONA.longitude, BARCELONA.latitude, lon, lat]))[2] < 1e-6
    assert elevation == pytest.approx(np.pi / 2)
    assert azimuth == 1.0


@pytest.mark.parametrize("bad", [(41.3, 2.1, 27.0), (0.7, np.nan, 27.0), (0.7, 0.1, 27.0, -1.0)])
def test_site_refuses_degrees_and_nonsense(bad):
    with pytest.raises(ModelError, match="site"):
        geo.Site(*bad)


# --- plane -------------------------------------------------------------------------------------------------


def test_plane_is_conformal_and_its_factors_are_those_of_geodesics(rng):
    plane = centred_plane()
    lat = BARCELONA.latitude + rng.uniform(-0.04, 0.04, 200)
    lon = BARCELONA.longitude + rng.uniform(-0.05, 0.05, 200)
    xy = plane.forward(lat, lon)
    convergence, scale = plane.factors(xy)
    for course in np.radians([0.0, 70.0, 200.0]):
        lon1, lat1, _ = GEOD.fwd(np.degrees(lon), np.degrees(lat), np.full(200, np.degrees(course)), np.full(200, 10.0))
        step = plane.forward(np.radians(lat1), np.radians(lon1)) - xy
        in_plane = np.arctan2(step[:, 0], step[:, 1])
        np.testing.assert_allclose(geo.wrap(in_plane + convergence - course), 0, atol=2e-7)
        np.testing.assert_allclose(np.hypot(*step.T) / 10.0, scale, rtol=2e-7)
    back = plane.inverse(xy)
    np.testing.assert_allclose(back[0], lat, atol=1e-12)
    np.testing.assert_allclose(back[1], lon, atol=1e-12)


def test_convergence_at_sixty_miles_east_of_barcelona():
    convergence, scale = centred_plane().factors([60 * NM, 0.0])
    assert np.degrees(convergence) == pytest.approx(0.88, abs=0.01)  # 1.33 degrees of longitude x sin(41.3)
    assert scale == pytest.approx(1 + (60 * NM / 2 / 6.37e6) ** 2, abs=1e-6)


def test_true_velocity_of_a_great_circle_flight(rng):
    # A target going due north by the compass 100 NM east of the centre, at 11 km.
    plane, height, speed = centred_plane(), 11000.0, 250.0
    lat, lon = np.radians(41.0), np.radians(4.3)
    dt = 0.1
    ground_speed = np.linalg.norm(ecef(lat + 1e-6, lon, 0.0) - ecef(lat, lon, 0.0)) / 1e-6
    aloft = np.linalg.norm(ecef(lat + 1e-6, lon, height) - ecef(lat, lon, height)) / 1e-6
    assert aloft > ground_speed
    step = speed * dt / aloft
    a, b = plane.forward([lat - step / 2, lat + step / 2], lon)
    velocity, middle = (b - a) / dt, (a + b) / 2
    cov = np.diag([100.0, 1.0, 400.0, 4.0])
    out = plane.to_true([middle[0], velocity[0], middle[1], velocity[1]], cov, height)
    np.testing.assert_allclose(out.velocity, [0.0, speed], atol=speed * 1e-5)  # R = sqrt(M N), not M
    np.testing.assert_allclose([out.latitude, out.longitude], [lat, lon], atol=1e-9)
    # The covariance turns with the axes: against differences of true positions.
    draws = rng.multivariate_normal(middle, np.diag([100.0, 400.0]), 40000)
    lat_d, lon_d = plane.inverse(draws)
    north = (lat_d - out.latitude) * aloft
    east = (lon_d - out.longitude) * np.linalg.norm(ecef(lat, lon + 1e-6, height) - ecef(lat, lon, height)) / 1e-6
    assert_covariance(np.stack([east, north], -1), out.position_cov)
    np.testing.assert_allclose(out.velocity_cov, out.position_cov / 100.0, rtol=1e-12)


def assert_covariance(draws, cov, slack=0.0):
    """Sample covariance within five standard errors (those of a normal sample) plus a relative slack."""
    n = len(draws)
    sample = np.cov(draws.T)
    error = np.sqrt((np.outer(np.diag(cov), np.diag(cov)) + cov**2) / n)
    scale = np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    assert np.all(np.abs(sample - cov) < 5 * error + slack * scale), (sample, cov)


# --- spherical to Cartesian --------------------------------------------------------------------------------


def test_spherical_case(cases):
    case = cases("radar_conversion")
    args = [case[k] for k in ("r", "az", "el", "sr", "saz", "sel")]
    xyz, cov = geo.spherical_to_cartesian(*args)
    assert np.abs(xyz - case["exp_xyz"]).max() <= 1e-8 * np.abs(case["exp_xyz"]).max()
    assert np.abs(cov - case["exp_R"]).max() <= 1e-8 * np.abs(case["exp_R"]).max()


@pytest.mark.parametrize(
    ("r", "beta", "sd_x", "sd_y", "correlation"),
    [(250e3, 30, 445.7, 645.0, -0.655), (140e3, 45, 356.7, 356.7, -0.293), (30e3, 60, 167.8, 263.4, 0.808)],
)
def test_spherical_against_the_published_figures(r, beta, sd_x, sd_y, correlation):
    _, cov = geo.spherical_to_cartesian(r, np.radians(beta), 0.0, 300.0, *np.radians([0.166, 0.166]))
    found = [np.sqrt(cov[0, 0]), np.sqrt(cov[1, 1]), cov[0, 1] / np.sqrt(cov[0, 0] * cov[1, 1])]
    np.testing.assert_allclose(found, [sd_x, sd_y, correlation], atol=0.06)
    assert found[2] == pytest.approx(correlation, abs=6e-4)


@pytest.mark.parametrize("sigma", [(300.0, 0.003, 0.003), (300.0, 0.3, 0.2), (5e3, 0.02, 0.8)])
@pytest.mark.parametrize("place", [(50e3, 2.1, 0.1), (20e3, -1.0, 1.2)])
def test_unbiased_conversion_by_quadrature(place, sigma):
    # Gauss-Hermite rules of 60 nodes integrate these sines and cosines to round-off.
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    grid = [a.ravel() for a in np.meshgrid(nodes, nodes, nodes, indexing="ij")]
    w = np.prod([a.ravel() for a in np.meshgrid(*3 * [weights / weights.sum()], indexing="ij")], axis=0)
    measured = [m + s * g for m, s, g in zip(place, sigma, grid, strict=True)]
    found, _ = geo.spherical_to_cartesian(*measured, *sigma, unbiased=True)
    truth, _ = geo.spherical_to_cartesian(*place, 0.0, 0.0, 0.0)
    _, cov = geo.spherical_to_cartesian(*place, *sigma, unbiased=True)
    np.testing.assert_allclose(w @ found, truth, atol=1e-9 * place[0])
    error = found - truth
    np.testing.assert_allclose(np.einsum("n,ni,nj->ij", w, error, error), cov, atol=1e-10 * place[0] ** 2)


def test_unbiased_tends_to_the_linearised_covariance():
    args = (80e3, 0.7, 0.4, 1.0, 1e-6, 1e-6)
    plain, unbiased = (geo.spherical_to_cartesian(*args, unbiased=u) for u in (False, True))
    np.testing.assert_allclose(plain[1], unbiased[1], rtol=1e-8, atol=1e-12)


def test_negative_sigma_is_refused():
    with pytest.raises(DataError, match="sigma_azimuth"):
        geo.spherical_to_cartesian(1.0, 0.0, 0.0, 1.0, -0.1, 0.1)


# --- reports to the plane ----------------------------------------------------------------------------------


def observe(plane, xy, height, site):
    """Slant range and azimuth of points of the plane, by PROJ."""
    lat, lon = plane.inverse(xy)
    return slant_and_azimuth(lat, lon, height, site)


@pytest.mark.parametrize("unbiased", [False, True])
@pytest.mark.parametrize(
    ("xy", "height"), [((40e3, -90e3), 9000.0), ((-6e3, 4e3), 5000.0), ((1e3, 250e3), 11000.0), ((900.0, 400.0), 60.0)]
)
def test_polar_covariance_by_monte_carlo(xy, height, unbiased, rng):
    site = geo.Site(BARCELONA.latitude, BARCELONA.longitude, 400.0, sigma_height=25.0)
    plane = geo.Plane(site.latitude + 0.01, site.longitude - 0.02)
    xy = plane.forward(site.latitude, site.longitude) + np.array(xy)
    r, beta = observe(plane, xy, height, site)
    sigma = {"sigma_range": 25.0, "sigma_azimuth": 1.5e-3, "sigma_altitude": 30.0}
    n = 40000
    e = rng.standard_normal((4, n))
    drawn = [r + 25 * e[0], beta + 1.5e-3 * e[1], height + 30 * e[2]]
    # An error of the site's height: same report, site shifted; linear, so shifting the altitude's datum will do.
    lat, lon, _, _ = geo.polar_to_geodetic(drawn[0], drawn[1], drawn[2] - 25 * e[3], site)
    truth = np.append(xy, height)
    found = np.column_stack([plane.forward(lat, lon), drawn[2]])
    out = geo.polar_to_plane(r, beta, height, site, plane, **sigma, unbiased=unbiased)
    cov = np.block([[out.cov[0], out.cross[0][:, None]], [out.cross[0][None], out.altitude_var[0]]])
    # Slack: curvature of the ground range, second order in sigma / (r - dh).
    assert_covariance(found - truth, cov, slack=0.01)
    np.testing.assert_allclose(out.xy[0], xy, atol=1e-3 if not unbiased else 1e-3 + r * 1.5e-3**2)


def test_plain_polar_position_is_proj_to_a_millimetre(rng):
    plane = centred_plane(geo.Site(0.72, 0.05, 0.0))
    xy, height = rng.uniform(-200e3, 200e3, (300, 2)), rng.uniform(0, 12000, 300)
    r, beta = observe(plane, xy, height, BARCELONA)
    out = geo.polar_to_plane(
        r, beta, height, BARCELONA, plane, sigma_range=1.0, sigma_azimuth=1e-5, sigma_altitude=1.0, unbiased=False
    )
    np.testing.assert_allclose(out.xy, xy, atol=1e-3)


def test_unbiased_polar_has_no_bias_along_the_ray(rng):
    # 1.5 degrees at 100 km: the plain conversion falls short by r sigma^2 / 2 = 34 m.
    plane, sigma, n = centred_plane(), np.radians(1.5), 20000
    xy = np.array([0.0, 100e3])
    r, beta = observe(plane, xy, 3000.0, BARCELONA)
    drawn = beta + sigma * rng.standard_normal(n)
    kw = {"sigma_range": 1.0, "sigma_azimuth": sigma, "sigma_altitude": 1.0}
    biased = geo.polar_to_plane(r, drawn, 3000.0, BARCELONA, plane, **kw, unbiased=False).xy - xy
    error = geo.polar_to_plane(r, drawn, 3000.0, BARCELONA, plane, **kw).xy - xy
    bound = 5 * error[:, 1].std() / np.sqrt(n)
    assert abs(error[:, 1].mean()) < bound
    assert abs(biased[:, 1].mean() + 100e3 * sigma**2 / 2) < bound
    out = geo.polar_to_plane(r, beta, 3000.0, BARCELONA, plane, **kw)
    # chi-square of one degree along the ray has twice a normal's kurtosis: five of its standard errors are 12 %.
    assert np.var(error[:, 1]) == pytest.approx(out.cov[0, 1, 1], rel=0.12)
    assert np.var(error[:, 0]) == pytest.approx(out.cov[0, 0, 0], rel=5 * np.sqrt(2 / n))


def uniform_posterior(plane, site, seen, sigmas, rng, reach):
    """Weighted sample of targets over the ground given a report: positions uniform, heights as drawn."""
    r, h = seen
    n = 400000
    distance = reach * np.sqrt(rng.uniform(size=n))
    heights = rng.normal(h, sigmas[1], n)
    lon, lat, _ = GEOD.fwd(
        np.full(n, np.degrees(site.longitude)), np.full(n, np.degrees(site.latitude)), np.zeros(n), distance
    )
    slant, _ = slant_and_azimuth(np.radians(lat), np.radians(lon), heights, site)
    weight = np.exp(-0.5 * ((slant - r) / sigmas[0]) ** 2)
    return plane.forward(np.radians(lat), np.radians(lon))[:, 1], heights, weight / weight.sum()


@pytest.mark.parametrize("short", [-150.0, 0.0, 60.0, 300.0])
def test_near_overhead_is_the_posterior_of_a_uniform_target(short, rng):
    h, sigmas = 9027.3, (40.0, 60.0)
    r = h - BARCELONA.height + short
    plane = centred_plane()
    out = geo.polar_to_plane(r, 0.0, h, BARCELONA, plane, sigma_range=40.0, sigma_azimuth=1e-3, sigma_altitude=60.0)
    y, heights, w = uniform_posterior(plane, BARCELONA, (r, h), sigmas, rng, 5000.0)
    mean = w @ y
    sd = np.sqrt(w @ (y - mean) ** 2)
    n_eff = 1 / np.sum(w**2)
    assert abs(out.xy[0, 1] - mean) < 5 * sd / np.sqrt(n_eff) + 0.03 * sd
    assert np.sqrt(out.cov[0, 1, 1]) == pytest.approx(sd, rel=0.05 + 5 / np.sqrt(2 * n_eff))
    mean_h = w @ heights
    correlation = (w @ ((y - mean) * (heights - mean_h))) / sd / 60.0
    assert out.cross[0, 1] / np.sqrt(out.cov[0, 1, 1]) / 60.0 == pytest.approx(correlation, abs=0.05)


def test_quadrature_meets_linearisation():
    # A step in the answer where the method changes would be a step in a track's noise.
    h = np.full(2, 10000.0)
    threshold = 8 * np.hypot(20.0, 25.0) + h - BARCELONA.height
    out = geo.polar_to_plane(
        threshold + np.array([-1.0, 1.0]),
        0.5,
        h,
        BARCELONA,
        centred_plane(),
        sigma_range=20,
        sigma_azimuth=1e-3,
        sigma_altitude=25,
    )
    sd = np.sqrt(np.linalg.eigvalsh(out.cov)[:, 1])
    assert np.linalg.norm(out.xy[1] - out.xy[0]) < 0.1 * sd[1]
    np.testing.assert_allclose(out.cov[0], out.cov[1], atol=0.05 * sd[1] ** 2)
    np.testing.assert_allclose(out.cross[0], out.cross[1], atol=0.05 * np.abs(out.cross[1]).max())


@pytest.mark.parametrize("r", [6000.0, 20e3, 150e3])
def test_unknown_height_by_monte_carlo(r, rng):
    n = 400000
    heights = rng.normal(5000.0, 3500.0, n)
    possible = (heights > max(0.0, r**2 / 2 / (4 / 3 * 6371e3) - 900)) & (heights - BARCELONA.height < r)
    heights = heights[possible]
    sphere = 6371e3 * np.arccos(
        ((6371e3 + BARCELONA.height) ** 2 + (6371e3 + heights) ** 2 - r**2)
        / (2 * (6371e3 + BARCELONA.height) * (6371e3 + heights))
    )
    plane = centred_plane()
    out = geo.polar_to_plane(r, 0.0, np.nan, BARCELONA, plane, sigma_range=1.0, sigma_azimuth=1e-4, sigma_altitude=1.0)
    sd = sphere.std()
    # The sphere is not the ellipsoid, and the horizon above is a rough one: 3 % of the deviation.
    assert out.xy[0, 1] == pytest.approx(sphere.mean(), abs=0.03 * sd + 3e-4 * sphere.mean())
    assert np.sqrt(out.cov[0, 1, 1]) == pytest.approx(sd, rel=0.05)
    assert np.isnan(out.altitude[0])
    assert out.altitude_var[0] == np.inf
    np.testing.assert_array_equal(out.cross[0], 0.0)


@settings(deadline=None)  # nothing here is about time
@given(
    r=st.floats(50.0, 470e3),
    beta=st.floats(0, 6.28),
    h=st.one_of(st.floats(-300, 25000), st.just(np.nan)),
    sigma=st.tuples(st.floats(0, 500), st.floats(0, 0.05), st.floats(0, 500)),
    sigma_site=st.floats(0, 1000),
)
def test_polar_covariance_is_finite_and_psd_everywhere(r, beta, h, sigma, sigma_site):
    site = geo.Site(BARCELONA.latitude, BARCELONA.longitude, 27.3, sigma_site)
    out = geo.polar_to_plane(
        r, beta, h, site, centred_plane(), sigma_range=sigma[0], sigma_azimuth=sigma[1], sigma_altitude=sigma[2]
    )
    assert np.isfinite(out.xy).all()
    var_h = out.altitude_var[0] if np.isfinite(h) else 1.0
    cov = np.block([[out.cov[0], out.cross[0][:, None]], [out.cross[0][None], var_h]])
    eigenvalues = np.linalg.eigvalsh(cov)
    assert eigenvalues[0] >= -1e-9 * max(eigenvalues[-1], 1.0)


def test_contradiction_beyond_the_stated_errors_is_wide():
    out = geo.polar_to_plane(
        3000.0, 0.0, 9000.0, BARCELONA, centred_plane(), sigma_range=10.0, sigma_azimuth=1e-3, sigma_altitude=10.0
    )
    assert np.sqrt(out.cov[0, 1, 1]) > 500.0  # six kilometres of contradiction, a possible ground range of three


def test_spherical_radar_by_monte_carlo(rng):
    site = geo.Site(BARCELONA.latitude, BARCELONA.longitude, 100.0, sigma_height=50.0)
    plane = geo.Plane(0.715, 0.03)
    xy, height, n = np.array([-70e3, 120e3]), 9000.0, 40000
    lat, lon = plane.inverse(xy)
    r, beta = slant_and_azimuth(lat, lon, height, site)
    east, north, up = geo.local_basis(site.latitude, site.longitude)
    ray = (ecef(lat, lon, height) - ecef(site.latitude, site.longitude, site.height)) / r
    eps = np.arcsin(ray @ up)
    e = rng.standard_normal((4, n))
    kw = {"sigma_range": 50.0, "sigma_azimuth": 2e-3, "sigma_elevation": 2e-3}
    out = geo.spherical_to_plane(r, beta, eps, site, plane, **kw, unbiased=False)
    np.testing.assert_allclose(out.xy[0], xy, atol=1e-3)
    np.testing.assert_allclose(out.altitude[0], height, atol=1e-3)
    b, el = beta + 2e-3 * e[1], eps + 2e-3 * e[2]
    local = (r + 50 * e[0]) * np.stack([np.cos(el) * np.sin(b), np.cos(el) * np.cos(b), np.sin(el)])
    points = ecef(site.latitude, site.longitude, site.height) + local.T @ np.stack([east, north, up])
    lon_d, lat_d, h_d = TO_ECEF.transform(*points.T, direction="INVERSE")
    draws = np.column_stack([plane.forward(np.radians(lat_d), np.radians(lon_d)), h_d + 50 * e[3]])
    cov = np.block([[out.cov[0], out.cross[0][:, None]], [out.cross[0][None], out.altitude_var[0]]])
    assert_covariance(draws, cov, slack=0.002)


def test_local_reports_by_proj(rng):
    plane, n = centred_plane(geo.Site(0.715, 0.03, 0.0)), 40000
    to_geodetic = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0={np.degrees(BARCELONA.latitude)} "
        f"+lon_0={np.degrees(BARCELONA.longitude)} +h_0=27.3 +step +inv +proj=cart +ellps=WGS84"
    )
    lon, lat, h = to_geodetic.transform(80e3, -60e3, 8200.0)
    out = geo.local_to_plane(80e3, -60e3, h, BARCELONA, plane, 30.0, 100.0)
    np.testing.assert_allclose(out.xy[0], plane.forward(*np.radians([lat, lon])), atol=1e-3)
    e = rng.standard_normal((3, n))
    altitudes = h + 100 * e[2]
    many = geo.local_to_plane(80e3 + 30 * e[0], -60e3 + 30 * e[1], altitudes, BARCELONA, plane, 30.0, 100.0)
    cov = np.block([[out.cov[0], out.cross[0][:, None]], [out.cross[0][None], out.altitude_var[0]]])
    assert abs(out.cross[0]).max() > 50  # one degree of arc: 1 m of ground for 64 m of altitude
    assert_covariance(np.column_stack([many.xy, altitudes]), cov, slack=0.002)
    unknown = geo.local_to_plane(2e3, 1e3, np.nan, BARCELONA, plane, 5.0, 100.0)
    assert np.isfinite(unknown.xy).all()
    assert np.isnan(unknown.altitude[0])
    assert unknown.altitude_var[0] == np.inf


def test_geodetic_reports():
    plane = centred_plane()
    out = geo.geodetic_to_plane([0.72, 0.73], [0.03, 0.04], [3000.0, np.nan], plane, [10.0, 20.0], 8.0)
    np.testing.assert_allclose(out.xy, plane.forward([0.72, 0.73], [0.03, 0.04]))
    sd = np.sqrt(out.cov[:, [0, 1], [0, 1]])
    np.testing.assert_allclose(sd, [[10, 10], [20, 20]], rtol=1e-3)
    np.testing.assert_array_equal(out.altitude_var, [64.0, np.inf])


@pytest.mark.parametrize("kind", ["polar", "spherical", "local"])
def test_a_site_for_each_report_places_it_as_that_site_alone(kind, rng):
    n = 40
    lat, lon, h = 0.7 + 0.02 * rng.random(n), 0.02 * rng.random(n), 3000.0 * rng.random(n)
    plane = centred_plane(geo.Site(0.71, 0.01, 0.0))
    slant, azimuth = 100.0 + 60e3 * rng.random(n), 6.2 * rng.random(n)
    slant[:4] = 200.0  # below a target straight above: integrated over the height
    altitude = np.where(rng.random(n) < 0.3, np.nan, h + 9e3 * rng.random(n))

    def place(at, site):
        sigma = {"sigma_range": 30.0, "sigma_azimuth": 1e-3}
        if kind == "polar":
            return geo.polar_to_plane(slant[at], azimuth[at], altitude[at], site, plane, sigma_altitude=20.0, **sigma)
        if kind == "spherical":
            return geo.spherical_to_plane(slant[at], azimuth[at], 0.1, site, plane, sigma_elevation=2e-3, **sigma)
        x, y = slant[at] * np.sin(azimuth[at]), slant[at] * np.cos(azimuth[at])
        return geo.local_to_plane(x, y, altitude[at], site, plane, 30.0, 20.0)

    together = place(np.arange(n), geo.Sites(lat, lon, h, 5.0))
    for k in range(n):
        alone = place(np.array([k]), geo.Site(lat[k], lon[k], h[k], 5.0))
        for a, b in zip(together, alone, strict=True):
            np.testing.assert_allclose(a[k], b[0], rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("turn", [0.0, 1.0, np.pi - 0.01, np.pi, -np.pi, 2.0 * np.pi, 100.0])
def test_circular_means_do_not_depend_on_where_angles_are_cut(turn):
    angle = np.array([-0.3, -0.1, 0.0, 0.05, 0.4])
    assert abs(geo.wrap(geo.circular_mean(angle + turn) - turn - angle.mean())) < 1e-12
    assert abs(geo.wrap(geo.circular_median(geo.wrap(angle + turn)) - turn)) < 1e-12
    assert -np.pi <= geo.circular_mean(angle + turn) < np.pi


def test_a_scene_across_the_antimeridian_is_the_scene_elsewhere():
    longitude = np.radians([179.9, -179.9, 179.95, -179.7, -179.8])
    assert geo.circular_median(longitude) == pytest.approx(np.radians(-179.9), abs=1e-12)
    assert abs(geo.circular_mean(np.radians([359.0, 1.0]))) < 1e-12
