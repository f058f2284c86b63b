"""Plots that may be faulty and sources that may be degraded: covariances, the filter over scans, and the tracker."""

from dataclasses import fields, replace
from itertools import product

import numpy as np
import pytest
from scipy.linalg import expm
from tracking_scenes import SITE, flights, measured, observed, polar_noise, run

from saltus.errors import ModelError
from saltus.geo import Plane
from saltus.records import Kind
from saltus.simulate import Leg, Radar, Trajectory, observe
from saltus.tracks.faults import History, SourceCondition, plot_law, weighty
from saltus.tracks.health import degraded_intervals, flagged, sensor_health
from saltus.tracks.rows import ConditionFound
from saltus.tracks.settings import TrackerSettings

DT = 4.0
SETTINGS = TrackerSettings(plot_outlier=0.01, degraded_noise=4.0, degraded_sojourn=(300.0, 50.0))
OFF = replace(SETTINGS, plot_outlier=0.0, degraded_noise=1.0)


def polar_plots(rng, n, sigma_range, sigma_azimuth):
    """Plots round a radar with independent errors of range and azimuth."""
    distance, azimuth = rng.uniform(20e3, 80e3, n), rng.uniform(0.0, 2 * np.pi, n)
    u = np.stack([np.sin(azimuth), np.cos(azimuth)], axis=-1)
    m = measured(np.arange(float(n)), u * distance[:, None] + [5e3, -7e3], 1.0)
    turned = np.stack([np.stack([u[:, 1], -u[:, 0]], axis=-1), u], axis=-1)  # columns: across, along
    return replace(m, ray=u * distance[:, None]), turned, distance, sigma_azimuth * distance, sigma_range


def test_a_fault_widens_what_it_makes_wrong(rng):
    m, turned, distance, across, along = polar_plots(rng, 7, 30.0, 0.002)

    def plane(variance_across, variance_along):
        D = np.zeros((7, 2, 2))
        D[:, 0, 0], D[:, 1, 1] = variance_across, variance_along
        return turned @ D @ turned.swapaxes(1, 2)

    cov = m.cov.copy()
    cov[:, :2, :2] = plane(across**2, along**2)
    law = plot_law(SETTINGS, Kind.POLAR)
    found = law.covariances(replace(m, cov=cov), np.arange(7))
    wrong = (
        (np.radians(SETTINGS.outlier_azimuth) * distance) ** 2,
        np.minimum(SETTINGS.outlier_range, 0.1 * distance) ** 2,
    )
    for h, (condition, fault) in enumerate(zip(law.condition, law.fault, strict=True)):
        worse = np.where(law.degraded[condition], 16.0, 1.0)
        expected = plane(
            across**2 * worse[0] + (wrong[0] if fault == 1 else 0.0),
            along**2 * worse[1] + (wrong[1] if fault == 2 else 0.0),
        )
        np.testing.assert_allclose(found[:, h, :2, :2], expected, rtol=1e-9, atol=1e-6)
        np.testing.assert_array_equal(found[:, h, 2], cov[:, 2])
    assert len(set(zip(law.condition.tolist(), law.fault.tolist(), strict=True))) == 12
    # A radar's plots err as it does: the condition of each is the radar's.
    np.testing.assert_allclose(np.exp(law.log_own), np.kron(np.eye(4), [0.98, 0.01, 0.01]), atol=1e-15)


def test_positions_are_wrong_as_a_whole():
    m = measured([0.0], [[1e3, 2e3]], 30.0)
    law = plot_law(SETTINGS, Kind.PLANE)
    found = law.covariances(m, np.arange(1))[0, :, :2, :2]
    variances = [900.0, 900.0 + 200.0**2, 16 * 900.0, 16 * 900.0 + 200.0**2]
    np.testing.assert_allclose(found, np.array(variances)[:, None, None] * np.eye(2), rtol=1e-12)
    # One in two hundred errs as under a degraded source while that is well.
    np.testing.assert_allclose(
        np.exp(law.log_own), [[0.995 * 0.99, 0.995 * 0.01, 0.005 * 0.99, 0.005 * 0.01], [0.0, 0.0, 0.99, 0.01]]
    )
    alone = plot_law(replace(SETTINGS, degraded_noise=1.0), Kind.PLANE)
    np.testing.assert_allclose(np.exp(alone.log_own), [[0.99, 0.01]])


@pytest.mark.parametrize("polar", [True, False])
def test_the_condition_is_that_of_all_sequences(rng, polar):
    """Three scans of two confirmed tracks and a tentative one: every sequence of conditions and faults, enumerated.

    One of the two was seen a second before and counts as a quarter of a plot.
    """
    law = plot_law(SETTINGS, Kind.POLAR if polar else Kind.PLANE)
    source, times = SourceCondition(law, SETTINGS), [0.0, 7.0, 11.0]
    log_f = rng.normal(-10.0, 3.0, (3, 3, len(law.fault)))
    heard = np.array([1.0, 0.25, 0.0])
    rate = 1.0 / np.array(SETTINGS.degraded_sojourn)
    generator = np.array([[-rate[0], rate[0]], [rate[1], -rate[1]]])
    share = rate[0] / rate.sum()

    def chain(dt):
        T = expm(generator * dt)
        return np.kron(T, T) if polar else T

    first = np.where(law.degraded, share, 1 - share).prod(axis=1)
    trans = [chain(7.0), chain(4.0)]
    q = len(first)
    rough, p = (0.0, [0.98, 0.01, 0.01]) if polar else (0.005, [0.99, 0.01])

    def own(c, i, k):
        """Joint densities of plot i and its hypotheses, the source in condition c."""
        given = [
            np.prod(
                [(rough if b else 1 - rough) if not a else float(b) for a, b in zip(law.degraded[c], d, strict=True)]
            )
            for d in law.degraded[law.condition]
        ]
        return np.exp(log_f[k, i]) * np.array(p)[law.fault] * given

    of = [np.array([[own(c, i, k).sum() for c in range(q)] for i in range(3)]) for k in range(3)]
    # What a plot says of the source: with probability 0.05 nothing, and then it is as likely as it can be.
    told = [(0.95 * f + 0.05 * f.max(axis=1, keepdims=True)) ** heard[:, None] for f in of]
    for k in range(3):
        weight = np.zeros((q, 3, len(law.fault)))  # joint law of the last condition and each plot's hypothesis
        posterior = np.zeros(q)
        for path in product(range(q), repeat=k + 1):
            weigh = first[path[0]] * np.prod([trans[s][path[s], path[s + 1]] for s in range(k)])
            for s in range(k):
                weigh *= told[s][:2, path[s]].prod()
            posterior[path[-1]] += weigh * told[k][:2, path[-1]].prod()
            for i in range(3):
                others = np.prod([told[k][j, path[-1]] for j in (0, 1) if j != i])
                weight[path[-1], i] += weigh * others * own(path[-1], i, k)
        prior = source.predicted(times[k])
        weights = source.absorb(times[k], prior, log_f[k], heard)
        np.testing.assert_allclose(source.history.probs[k], posterior / posterior.sum(), rtol=1e-9)
        found = np.exp(weights + log_f[k])
        expected = weight.sum(axis=0)
        np.testing.assert_allclose(
            found / found.sum(axis=1, keepdims=True), expected / expected.sum(axis=1, keepdims=True), rtol=1e-9
        )


def test_a_track_is_heard_once_in_four_seconds():
    source = SourceCondition(plot_law(SETTINGS, Kind.POLAR), SETTINGS)
    confirmed = np.array([True, True, False])
    first = source.voice(np.array([3, 7, 9]), np.array([10.0, 10.5, 10.0]), confirmed)
    again = source.voice(np.array([7, 9, 3]), np.array([11.5, 20.0, 16.0]), np.array([True, True, True]))
    late = source.voice(np.array([3]), np.array([15.0]), np.array([True]))  # a plot that comes late
    np.testing.assert_array_equal(first, [1.0, 1.0, 0.0])
    np.testing.assert_array_equal(again, [0.25, 1.0, 1.0])
    np.testing.assert_array_equal(late, [0.0])


def test_tentative_tracks_say_nothing_of_a_source(rng):
    source = SourceCondition(plot_law(SETTINGS, Kind.POLAR), SETTINGS)
    prior = source.predicted(0.0)
    source.absorb(0.0, prior, rng.normal(size=(4, 12)) * 50.0, np.zeros(4))
    assert len(source.history.time) == 0
    np.testing.assert_array_equal(source.predicted(100.0), prior)


def radar(**kwargs):
    settings = dict(period=DT, sigma_range=20.0, sigma_azimuth=float(np.radians(0.03)), sigma_altitude=5.0)
    return Radar(SITE, **{**settings, "prob_detection": 1.0, **kwargs})


def flown(rng, seconds=240.0):
    """Ten aircraft round a radar, three of them turning; plots and whose they are."""
    turn = (Leg(70.0), Leg(60.0, turn_rate=0.03), Leg(seconds))
    way = [
        Trajectory(
            (40e3 * np.cos(a), 40e3 * np.sin(a), 7e3 + 300.0 * k), a + 1.5, 200.0, turn if k < 3 else (Leg(300.0),)
        )
        for k, a in enumerate(np.arange(10) * 0.628)
    ]
    seen = observe(radar(), way, Plane(SITE.latitude, SITE.longitude), 0.0, seconds, rng)
    return observed([seen], [radar()], [polar_noise(radar())], Plane(SITE.latitude, SITE.longitude))


def moved(m, which, azimuth=0.0, along=0.0):
    """Turn plots about the radar by an angle, and push them along their rays."""
    position, ray = m.position.copy(), m.ray[which]
    across = np.stack([ray[:, 1], -ray[:, 0]], axis=-1)
    u = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    position[which, :2] += across * np.reshape(azimuth, (-1, 1)) + u * np.reshape(along, (-1, 1))
    return replace(m, position=position)


def judged(found, m):
    """p_fault and fault of each plot that updated a track; NaN elsewhere."""
    p, fault = np.full(len(m), np.nan), np.zeros(len(m), int)
    rows = found.all_rows
    at = rows.measurement >= 0
    p[rows.measurement[at]], fault[rows.measurement[at]] = rows.p_fault[at], rows.fault[at]
    return p, fault


def test_faulty_plots_are_told_and_good_ones_not(rng):
    m, label = flown(rng)
    late = np.flatnonzero((m.time > 30.0) & (label >= 0))
    wrong = rng.choice(late, 24, replace=False)
    signs = rng.choice([-1.0, 1.0], 12)
    faulty = moved(moved(m, wrong[:12], azimuth=np.radians(signs)), wrong[12:], along=700.0 * signs)
    found = run(faulty)
    p, fault = judged(found, m)
    assert (p[wrong] > 0.5).mean() >= 0.9
    assert (fault[wrong[:12]][p[wrong[:12]] > 0.5] == 1).all()
    assert (fault[wrong[12:]][p[wrong[12:]] > 0.5] == 2).all()
    good = np.setdiff1d(late, wrong)
    assert np.isfinite(p[good]).all()
    assert (p[good] > 0.5).mean() <= 0.005  # turning ones among them
    assert (p[late] >= 0.0).all() and (p[late] <= 1.0).all()
    # A start tells nothing of its plots; what coasts keeps what was found of the last plot.
    first = [np.flatnonzero(label == k)[:2] for k in range(10)]
    assert np.isnan(p[np.concatenate(first)]).all()
    # The same without faults in the model: the plots break tracks or bend them.
    blind, _ = judged(run(faulty, settings=OFF), m)
    assert np.nanmax(blind) == 0.0


def test_a_coasted_row_tells_of_the_last_plot(rng):
    m, label = flown(rng, seconds=160.0)
    of_five = np.flatnonzero(label == 5)
    last = of_five[20]
    m = moved(m, [last], azimuth=np.radians(1.2)).take(np.flatnonzero((label != 5) | (m.time <= m.time[last])))
    rows = run(m).all_rows
    track = rows.track_id[rows.measurement == np.flatnonzero(m.time == m.time[last])[0]][0]
    mine = rows.track_id == track
    coasted = mine & (rows.status == 3)
    assert coasted.sum() >= 3
    p_last = rows.p_fault[mine & (rows.measurement >= 0)][-1]
    assert p_last > 0.9
    np.testing.assert_array_equal(rows.p_fault[coasted], p_last)


@pytest.mark.parametrize(("component", "name"), [(0, "azimuth"), (1, "range")])
def test_a_degraded_radar_is_told_from_turns_and_outliers(rng, component, name):
    """From 100 s to 160 s one component errs six times as much, all tracks alike; it is found, and found to end."""
    m, label = flown(rng)
    bad = np.flatnonzero((m.time > 100.0) & (m.time < 160.0))
    size = 6.0 * rng.standard_normal(len(bad))
    sick = moved(m, bad, azimuth=size * np.radians(0.03)) if component == 0 else moved(m, bad, along=size * 20.0)
    found = run(sick)
    history = found.raw.sources[0].history
    law = found.raw.sources[0].law
    degraded = history.probs @ law.degraded
    during = (history.time > 108.0) & (history.time < 158.0)
    apart = (history.time < 100.0) | (history.time > 172.0)
    assert law.components[component] == name
    assert (degraded[during, component] > 0.9).all()
    assert (degraded[during, 1 - component] < 0.5).all()
    assert (degraded[apart] < 0.05).all()
    # A degraded source is no fault of each plot, nor a manoeuvre of each aircraft.
    p, _ = judged(found, m)
    assert (p[bad] > 0.5).mean() < 0.05
    assert len(np.unique(found.track_id[label >= 0])) == 10
    rows, off = found.rows, run(sick, settings=OFF).rows
    straight = (np.isin(rows.measurement, bad[label[bad] >= 3])), np.isin(off.measurement, bad[label[bad] >= 3])
    p_known, p_off = rows.moments.p_manoeuvre_h[straight[0]].mean(), off.moments.p_manoeuvre_h[straight[1]].mean()
    assert p_known < 0.3 < p_off


@pytest.mark.parametrize("wrong", [0, 1])
def test_a_track_begun_with_a_fault_begins_anew_as_another(rng, wrong):
    """An azimuth off by two degrees in one of the first two plots: no row of the track comes from it."""
    m, label = flown(rng, seconds=60.0)
    mine = np.flatnonzero(label == 6)
    m = replace(moved(m, mine[[wrong]], azimuth=np.radians(2.0)), icao24=(1000 + label).astype(np.int32))
    found = run(m)
    rows = found.rows
    assert set(found.track_id[mine[:2]]) == {0}
    assert len(set(found.track_id[mine[2:]])) == 1 and found.track_id[mine[2]] > 0
    speed = np.hypot(rows.moments.mean[:, 1], rows.moments.mean[:, 3])[np.isin(rows.measurement, mine)]
    assert len(speed) == len(mine) - 3  # a first plot gives no row
    np.testing.assert_allclose(speed, 200.0, atol=30.0)
    assert len(np.unique(found.track_id[found.track_id > 0])) == 10


def reports(rng, bad):
    """Eight aircraft that tell their positions every second; errors of 5 m, 30 m where `bad` says so of (8, 180)."""
    times = np.arange(180.0)
    angle = np.arange(8) * 0.785
    start = 20e3 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    t, xy = flights(start, 100.0 * np.stack([-np.sin(angle), np.cos(angle)], axis=-1), times)
    xy = xy + 5.0 * rng.standard_normal(xy.shape) * np.where(bad, 6.0, 1.0).reshape(-1, 1)
    return measured(t + np.repeat(0.01 * np.arange(8), 180), xy, 5.0, icao24=np.repeat(np.arange(8), 180))


def test_reports_every_second_tell_a_jammed_source_within_a_few_scans(rng):
    bad = np.broadcast_to((np.arange(180) >= 80) & (np.arange(180) < 120), (8, 180))
    source = run(reports(rng, bad), periods=(1.0,)).raw.sources[0]
    (spell,) = degraded_intervals(source.history, source.law)
    assert 80.0 <= spell.time_from <= 84.0
    assert 118.0 <= spell.time_to <= 126.0


def test_a_bad_transmitter_is_not_the_source(rng):
    """One of eight errs six times as much all the time."""
    bad = np.zeros((8, 180), bool)
    bad[3] = True
    found = run(reports(rng, bad), periods=(1.0,))
    source = found.raw.sources[0]
    assert degraded_intervals(source.history, source.law) == []
    assert source.history.probs[:, 1].max() < 0.1
    assert len(np.unique(found.track_id[found.track_id > 0])) == 8


def test_a_radar_that_is_well_stays_so(rng):
    m, _ = flown(rng)
    found = run(m)
    history = found.raw.sources[0].history
    assert history.time.shape == (len(history.probs),)
    assert history.probs[:, 0].min() > 0.99


def test_impossible_settings_of_faults_are_refused():
    for wrong in (
        dict(plot_outlier=0.5),
        dict(plot_outlier=-0.1),
        dict(degraded_noise=0.5),
        dict(degraded_noise=np.inf),
        dict(degraded_sojourn=(0.0, 10.0)),
    ):
        with pytest.raises(ModelError, match=next(iter(wrong))):
            TrackerSettings(**wrong)


@pytest.mark.parametrize("known", [False, True])
def test_a_target_that_looks_like_a_fault_of_another_gets_its_own_track(rng, known):
    """It comes up 400 m beside one that stands still, between two of its plots, where targets are few."""
    first, second = 4.0 * np.arange(30), 2.0 + 4.0 * np.arange(10, 30)
    time = np.concatenate([first, second, first])
    xy = np.concatenate([np.zeros((30, 2)), np.tile([400.0, 0.0], (20, 1)), np.tile([300e3, 300e3], (30, 1))])
    code = np.repeat([7, 8, 9], [30, 20, 30]) if known else -1
    m = measured(time, xy + 5.0 * rng.standard_normal(xy.shape), 5.0, icao24=code)
    found = run(m)
    beside = (np.abs(m.position[:, 0] - 400.0) < 50.0) & (m.time > 50.0)
    at_rest = np.abs(m.position[:, 0]) < 50.0
    assert len(np.unique(found.track_id[beside])) == 1
    assert len(np.unique(found.track_id[at_rest])) == 1
    assert 0 < found.track_id[beside][0] != found.track_id[at_rest][0]


def test_single_faults_begin_no_track(rng):
    time = 4.0 * np.arange(60)
    xy = np.column_stack([100.0 * time, np.zeros(60)])
    wrong = np.arange(10, 60, 7)
    xy[wrong, 1] += rng.choice([-1.0, 1.0], len(wrong)) * rng.uniform(350.0, 600.0, len(wrong))
    far = measured(time, np.full((60, 2), 300e3), 5.0)  # the region is large
    near = measured(time, xy + 5.0 * rng.standard_normal(xy.shape), 5.0)
    m = both(near, far)
    found = run(m)
    assert len(found.raw.confirmed) == 2
    mine = found.rows.measurement[found.rows.p_fault > 0.5]
    np.testing.assert_array_equal(np.sort(m.time[mine]), time[wrong])


def both(a, b):
    """Measurements of two sets, in time order."""
    columns = {f.name: np.concatenate([getattr(a, f.name), getattr(b, f.name)]) for f in fields(a)}
    columns["plot"] = np.arange(len(a) + len(b))
    return replace(a, **columns).take(np.argsort(columns["time"], kind="stable"))


def test_spells_of_a_degraded_source():
    law = plot_law(SETTINGS, Kind.POLAR)
    p = np.zeros((10, 4))
    p[:, 0] = [1.0, 0.6, 0.4, 0.0, 0.3, 0.9, 1.0, 0.1, 0.6, 0.6]
    p[:, 2] = 1.0 - p[:, 0]  # azimuth
    p[7:, 3], p[7:, 2] = p[7:, 2], 0.0
    spells = degraded_intervals(History(10.0 * np.arange(10), p), law)
    assert [(s.time_from, s.time_to, s.condition) for s in spells] == [
        (20.0, 40.0, "azimuth degraded"),
        (70.0, 90.0, "azimuth and range degraded"),
    ]
    np.testing.assert_allclose([s.probability for s in spells], [2.3 / 3, 1.7 / 3])
    assert degraded_intervals(History(np.zeros(0), np.zeros((0, 4))), law) == []


def test_health_counts_by_source_and_component():
    laws = [plot_law(SETTINGS, Kind.POLAR if polar else Kind.PLANE) for polar in (True, False)]
    sources = [ConditionFound(law, History(np.zeros(0), np.zeros((0, len(law.degraded))))) for law in laws]
    found = sensor_health(
        ["radar", "ads-b"],
        sources,
        np.array([0, 1, 0, 0, 1], np.int32),
        np.array([3.0, 1.0, 2.0, 5.0, 4.0]),
        flagged(np.array([0.9, 0.9, 0.1, 0.6, 0.4]), np.array([1, 1, 2, 2, 1], np.int8)),
    )
    assert [h.name for h in found] == ["radar", "ads-b"]
    assert found[0].time.tolist() == [2.0, 3.0, 5.0] and found[0].fault.tolist() == [0, 1, 2]
    assert found[1].time.tolist() == [1.0, 4.0] and found[1].fault.tolist() == [1, 0]
    assert found[0].p_degraded.shape == (0, 2) and found[1].intervals == []


def test_hypotheses_of_no_weight_are_left_aside():
    p = np.array([[0.9991, 0.0, 0.0009], [0.5, 0.3, 0.2], [0.0005, 0.3, 0.6995], [0.0, 0.0, 1.0]])
    each, which, start = weighty(p)
    assert each.tolist() == [0, 1, 1, 1, 2, 2, 3]
    assert which.tolist() == [0, 0, 1, 2, 1, 2, 2]
    assert start.tolist() == [0, 1, 4, 6, 7]
    assert [part.tolist() for part in weighty(p[:0])] == [[], [], [0]]
