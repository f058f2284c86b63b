"""Metrics against brute force: enumeration, counting with dictionaries, and the laws they claim."""

from collections import Counter
from itertools import combinations, permutations

import numpy as np
import pytest
from scipy import stats

from saltus.errors import DataError, ModelError
from saltus.evaluate import (
    Tracks,
    consistency,
    false_tracks,
    gospa,
    mean_over_runs,
    nees,
    nis,
    ospa,
    rmse,
    track_scores,
)
from saltus.evaluate.matching import match_rows
from saltus.evaluate.reference import make_reference
from saltus.geo import geodetic_to_ecef

# --- sets -------------------------------------------------------------------------------------------------


def ospa_enumerated(x, y, c, p):
    """OSPA by trying every injection of the smaller set into the larger."""
    if len(x) > len(y):
        x, y = y, x
    if len(y) == 0:
        return 0.0
    best = min(
        sum(min(c, np.linalg.norm(a - y[j])) ** p for a, j in zip(x, chosen, strict=True))
        for chosen in permutations(range(len(y)), len(x))
    )
    return ((best + c**p * (len(y) - len(x))) / len(y)) ** (1 / p)


def gospa_enumerated(x, y, c, p):
    """GOSPA by trying every partial assignment: which truths, which estimates, in which order."""
    best = np.inf
    for k in range(min(len(x), len(y)) + 1):
        for some in combinations(range(len(x)), k):
            for chosen in permutations(range(len(y)), k):
                cost = sum(np.linalg.norm(x[i] - y[j]) ** p for i, j in zip(some, chosen, strict=True))
                best = min(best, cost + c**p / 2 * (len(x) + len(y) - 2 * k))
    return best ** (1 / p)


@pytest.mark.parametrize("order", [1.0, 2.0, 3.0])
@pytest.mark.parametrize("sizes", [(0, 0), (0, 3), (4, 0), (1, 1), (3, 3), (4, 2), (2, 5)])
def test_ospa_and_gospa_equal_enumeration(rng, sizes, order):
    for cutoff in (0.3, 1.0, 10.0):
        x, y = (rng.normal(size=(n, 2)) for n in sizes)
        got, want = ospa(x, y, cutoff=cutoff, order=order), ospa_enumerated(x, y, cutoff, order)
        assert got.distance == pytest.approx(want, rel=1e-12)
        parts = (got.localisation**order + got.cardinality**order) ** (1 / order)
        assert parts == pytest.approx(got.distance, rel=1e-12)
        whole = gospa(x, y, cutoff=cutoff, order=order)
        assert whole.distance == pytest.approx(gospa_enumerated(x, y, cutoff, order), rel=1e-12)


def test_gospa_parts_add_up_and_name_the_pairs():
    truth = [[0.0, 0.0], [10.0, 0.0], [50.0, 50.0]]
    estimates = [[10.0, 1.0], [0.0, 2.0], [-40.0, 0.0], [90.0, 0.0]]
    got = gospa(truth, estimates, cutoff=5.0)
    # pairs at distances 2 and 1; one truth missed, two estimates false; 5^2 / 2 each
    assert got.localisation == pytest.approx(4 + 1)
    assert (got.n_missed, got.n_false) == (1, 2)
    assert (got.missed, got.false) == (12.5, 25.0)
    assert got.distance**2 == pytest.approx(5 + 12.5 + 25)
    assert got.pairs.tolist() == [[0, 1], [1, 0]]


def test_a_pair_beyond_the_cutoff_is_one_missed_and_one_false():
    got = gospa([[0.0]], [[100.0]], cutoff=3.0)
    assert (got.n_missed, got.n_false, got.distance) == (1, 1, 3.0)
    assert ospa([[0.0]], [[100.0]], cutoff=3.0).distance == 3.0


@pytest.mark.parametrize("metric", [ospa, gospa])
def test_sets_refuse_what_cannot_be(metric):
    with pytest.raises(ModelError, match="cutoff"):
        metric([[0.0]], [[1.0]], cutoff=0.0)
    with pytest.raises(DataError, match=r"\(1, 1\), \(1, 2\)"):
        metric([[0.0]], [[1.0, 2.0]], cutoff=1.0)
    with pytest.raises(DataError, match="finite"):
        metric([[np.nan]], [[1.0]], cutoff=1.0)


# --- estimation -------------------------------------------------------------------------------------------


def test_rmse_is_the_root_of_the_mean_square(rng):
    e = rng.normal(size=(7, 5, 3))
    where = rng.random((7, 5, 1)) < 0.6
    got = rmse(e, pool=(1,), where=where)
    for c in range(3):
        picked = [e[b, k, c] ** 2 for b in range(7) for k in range(5) if where[b, k, 0]]
        assert got.value[c] == pytest.approx(np.sqrt(np.mean(picked)), rel=1e-12)
    one = mean_over_runs(e)  # nothing pooled: the textbook standard error
    np.testing.assert_allclose(one.standard_error, e.std(0, ddof=1) / np.sqrt(7), rtol=1e-12)
    np.testing.assert_allclose(one.high - one.value, stats.t.ppf(0.975, 6) * one.standard_error, rtol=1e-10)


def test_rmse_interval_covers_the_truth_as_often_as_it_says(rng):
    # Errors correlated over the 10 times (one common part per run), true RMSE sqrt(2). 1000 repetitions: the
    # standard error of the coverage is sqrt(.95 .05 / 1000) = 0.007; with 200 skewed runs it is 0.945, not 0.95.
    e = rng.normal(size=(1000, 200, 10)) + rng.normal(size=(1000, 200, 1))
    results = [rmse(x, pool=(1,)) for x in e]
    inside = np.mean([r.low <= np.sqrt(2) <= r.high for r in results])
    assert abs(inside - 0.945) < 5 * 0.007
    spread = np.std([r.value for r in results])
    mean_se = np.mean([r.standard_error for r in results])
    assert mean_se == pytest.approx(spread, rel=0.1)
    # Times taken for independent would give an interval too narrow by half, and this test would see it.
    naive = [rmse(x.reshape(2000)) for x in e]
    assert np.mean([r.low <= np.sqrt(2) <= r.high for r in naive]) < 0.8


def test_rmse_says_what_is_wrong(rng):
    with pytest.raises(DataError, match="two runs"):
        rmse([[1.0, 2.0]])
    with pytest.raises(DataError, match=r"\(1, 0\) is nan"):
        rmse([[1.0, 2.0], [np.nan, 1.0]])
    with pytest.raises(ModelError, match="axis 0"):
        rmse(rng.normal(size=(3, 3)), pool=(-2,))
    nothing = rmse(np.ones((3, 2)), where=[True, False])
    assert nothing.value[0] == 1.0 and np.isnan(nothing.value[1]) and np.isnan(nothing.high[1])


def test_nees_of_matched_errors_lies_in_its_band_and_of_doubled_noise_does_not(rng):
    n, runs, times = 3, 60, 400
    root = rng.normal(size=(times, n, n))
    covs = root @ root.swapaxes(-1, -2) + np.eye(n)
    errors = (np.linalg.cholesky(covs) @ rng.normal(size=(runs, times, n, 1)))[..., 0]
    values = nees(errors, covs)
    e, p = errors[3, 17], covs[17]
    assert values[3, 17] == pytest.approx(e @ np.linalg.inv(p) @ e, rel=1e-9)
    np.testing.assert_array_equal(nis(errors, covs), values)
    got = consistency(values, n)
    # 400 independent times, each inside with probability 0.95: 5 standard errors are 0.055.
    assert abs(got.inside - 0.95) < 5 * np.sqrt(0.95 * 0.05 / times)
    assert consistency(nees(np.sqrt(2) * errors, covs), n).inside < 0.05


def test_band_is_the_chi_square_law_of_the_observed_components(rng):
    dof = rng.integers(0, 3, (8, 5))
    got = consistency(dof.astype(float), dof, probability=0.9)
    total = dof.sum(0)
    np.testing.assert_allclose(got.low, stats.chi2.ppf(0.05, total) / 8, rtol=1e-10)
    np.testing.assert_allclose(got.high, stats.chi2.ppf(0.95, total) / 8, rtol=1e-10)
    assert got.inside == 1.0  # a value equal to its expectation
    empty = consistency(np.zeros((4, 1)), 0)
    assert (empty.low[0], empty.high[0], empty.inside) == (0.0, 0.0, 1.0)


def test_consistency_refuses_what_cannot_be():
    with pytest.raises(DataError, match="not finite"):
        consistency([[np.nan]], 1)
    with pytest.raises(ModelError, match="dof"):
        consistency([[1.0]], -1)
    with pytest.raises(DataError, match="singular"):
        nees([1.0, 1.0], np.zeros((2, 2)))
    with pytest.raises(DataError, match=r"\(2,\)"):
        nees([1.0, 1.0], np.eye(3))


# --- tracking ---------------------------------------------------------------------------------------------


def scores_by_dictionary(track, label, confirmed, min_plots):
    majority = {}
    for t in set(track) - {-1}:
        count = Counter(o for i, o in zip(track, label, strict=True) if i == t and o >= 0)
        if count:
            majority[t] = min(count, key=lambda o, count=count: (-count[o], o))
    assigned = [(t, o) for t, o in zip(track, label, strict=True) if t >= 0 and o >= 0]
    judged = sorted(o for o, n in Counter(label).items() if o >= 0 and n >= min_plots)
    plots = [(t, o) for t, o in zip(track, label, strict=True) if o in judged]
    return {
        "purity": sum(majority[t] == o for t, o in assigned) / len(assigned),
        "completeness": sum(t in confirmed for t, _ in plots) / len(plots),
        "fragmentation": sum(majority.get(t) in judged for t in confirmed) / len(judged),
        "touching": len({(t, o) for t, o in plots if t in confirmed}) / len(judged),
    }


def test_track_scores_equal_counting_by_dictionary(rng):
    for _ in range(30):
        label = rng.integers(-1, 6, 80)
        track = np.where(rng.random(80) < 0.7, 10 * label + rng.integers(0, 2, 80), rng.integers(0, 60, 80))
        track = np.where(rng.random(80) < 0.15, -1, np.maximum(track, -1))
        confirmed = [int(t) for t in np.unique(track[track >= 0]) if rng.random() < 0.7]
        got = track_scores(track, label, confirmed=confirmed, min_plots=9)
        want = scores_by_dictionary(track.tolist(), label.tolist(), confirmed, 9)
        for name, value in want.items():
            assert getattr(got, name) == pytest.approx(value), name
        assert got.per_object_tracks.mean() == pytest.approx(want["fragmentation"])


def test_track_scores_of_a_scene_told_in_words():
    # Object 1 is cut into tracks 1 and 2; object 2 has track 3, which also took one plot of object 1; a clutter
    # plot lies on track 3; two plots of object 2 lie on nothing.
    track = [1, 1, 1, 2, 2, 3, 3, 3, 3, -1, -1, 3]
    label = [1, 1, 1, 1, 1, 1, 2, 2, 2, 2, 2, -1]
    got = track_scores(track, label, min_plots=5)
    assert (got.n_pure, got.n_assigned, got.purity) == (8, 9, 8 / 9)
    assert got.per_object_completeness.tolist() == [1.0, 3 / 5] and got.completeness == 9 / 11
    assert got.per_object_tracks.tolist() == [2, 1] and got.fragmentation == 1.5
    assert got.per_object_touching.tolist() == [3, 1]
    assert np.isnan(track_scores([-1], [-1]).purity)


def test_false_tracks_follow_no_object():
    # track 0 follows object 5, 1 is clutter, 2 has one plot of three from object 6, 3 has half of its plots
    track = [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3]
    label = [5, 5, -1, -1, -1, -1, 6, -1, -1, 6, -1]
    got = false_tracks(track, label, duration=1800.0)
    assert got.ids.tolist() == [1, 2] and (got.n_false, got.per_hour) == (2, 4.0)
    assert got.low == pytest.approx(stats.chi2.ppf(0.025, 4) / 2 * 2, rel=1e-9)
    assert got.high == pytest.approx(stats.chi2.ppf(0.975, 6) / 2 * 2, rel=1e-9)
    some = false_tracks(track, label, duration=1800.0, confirmed=[0, 2, 9])
    assert some.ids.tolist() == [2, 9]  # 9 has no plot at all
    none = false_tracks(track, label, duration=3600.0, confirmed=[0])
    assert (none.per_hour, none.low) == (0.0, 0.0) and none.high == pytest.approx(-np.log(0.025))


def test_track_scores_refuse_what_cannot_be():
    with pytest.raises(DataError, match="one length"):
        track_scores([1, 2], [1])
    with pytest.raises(DataError, match="integers"):
        track_scores([1.5], [1])
    with pytest.raises(ModelError, match="min_plots"):
        track_scores([1], [1], min_plots=0)
    with pytest.raises(ModelError, match="duration"):
        false_tracks([1], [1], duration=0.0)


def circle(time, radius=3000.0, speed=150.0):
    """A steady turn near 45 N 5 E: rad, rad, and velocity east and north."""
    angle = speed / radius * time
    lat0, lon0 = np.radians([45.0, 5.0])
    meridian, normal = (
        6378137.0 * (1 - 0.00669438) / (1 - 0.00669438 / 2) ** 1.5,
        6378137.0 / np.sqrt(1 - 0.00669438 / 2),
    )
    lat = lat0 + radius * np.sin(angle) / meridian
    lon = lon0 + radius * np.cos(angle) / (normal * np.cos(lat))
    return lat, lon, speed * np.stack([-np.sin(angle), np.cos(angle)], axis=-1)


def test_a_turn_is_interpolated_by_its_velocities():
    """A straight line cuts a turn of 7.5 m/s^2 between fixes 4 s apart by a T^2 / 8 = 15 m; the cubic by decimetres."""
    fixes, between = np.arange(0.0, 100.0, 4.0), np.arange(2.0, 90.0, 4.0)
    lat, lon, velocity = circle(fixes)
    true_lat, true_lon, true_velocity = circle(between)
    true = geodetic_to_ecef(true_lat, true_lon, 0.0)
    zero = np.zeros(len(between), np.intp)
    curved = make_reference(["x"] * len(fixes), fixes, lat, lon, velocity=velocity).at(zero, between)
    straight = make_reference(["x"] * len(fixes), fixes, lat, lon).at(zero, between)
    # a T^4 / 384 times the fourth derivative: 3000 m (0.05/s)^4 4^4 / 384 = 0.0125 m, and the ellipsoid's radii here.
    assert np.linalg.norm(curved.place - true, axis=-1).max() < 0.5
    np.testing.assert_allclose(np.linalg.norm(straight.place - true, axis=-1), 15.0, rtol=0.02)
    assert np.linalg.norm(curved.velocity - true_velocity, axis=-1).max() < 1.0
    assert np.isnan(straight.velocity).all()


def test_nothing_is_known_beyond_the_fixes_and_across_gaps():
    lat, lon, velocity = circle(np.array([0.0, 4.0, 30.0]))
    truth = make_reference(["x"] * 3, [0.0, 4.0, 30.0], lat, lon, velocity=velocity, turning=[True, False, False])
    known = np.isfinite(
        truth.at(np.array([0, 0, 0, 0, 0, 1]), np.array([-1.0, 2.0, 17.0, 30.0, 31.0, 2.0])).place[:, 0]
    )
    assert known.tolist() == [False, True, False, True, False, False]
    zero = np.zeros(4, np.intp)
    assert truth.turned(zero, np.array([1.0, 3.0, 4.0, 30.0])).tolist() == [True, False, False, False]
    assert truth.turned(zero, np.array([1.0, 3.0, 4.0, 30.0]), within=5.0).tolist() == [True, True, True, False]


def test_rows_are_judged_at_their_own_times():
    """Two targets pass each other; rows fall between the truth's seconds, and a track keeps its own target."""
    t = np.arange(0.0, 20.0)
    east = np.concatenate([10.0 * t - 100.0, 100.0 - 10.0 * t])
    north = np.repeat([0.0, 40.0], 20)
    lat0, lon0 = np.radians([45.0, 5.0])
    where = [(lat0 + n / 6.37e6, lon0 + e / (6.37e6 * np.cos(lat0))) for e, n in zip(east, north, strict=True)]
    lat, lon = np.array(where).T
    truth = make_reference(np.repeat(["a", "b"], 20), np.tile(t, 2), lat, lon)
    rows = np.arange(0.25, 19.0, 4.0)
    places = [truth.at(np.full(len(rows), k), rows).place for k in (1, 0)]
    cov = np.tile(np.eye(2), (2 * len(rows), 1, 1))
    tracks = Tracks(
        np.repeat([7, 9], len(rows)), np.tile(rows, 2), np.concatenate(places) + np.array([0.0, 0.0, 3.0]), cov
    )
    target, error = match_rows(tracks, truth, cutoff=60.0)
    assert target.tolist() == [1] * 5 + [0] * 5
    np.testing.assert_allclose(error, [[0.0, 3.0 * np.cos(lat0)]] * 10, atol=1e-3)
    far = tracks._replace(place=tracks.place + np.array([0.0, 500.0, 0.0]))
    assert (match_rows(far, truth, cutoff=60.0)[0] == -1).all()
    late = tracks._replace(time=tracks.time + 1000.0)
    assert np.isnan(match_rows(late, truth, cutoff=60.0)[1]).all()
