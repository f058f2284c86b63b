"""Decisions over time: told evidence with known answers, then simulated tracks from end to end."""

import numpy as np
import pytest

from saltus import DataError, ModelError
from saltus.identify import (
    APART,
    DecisionSettings,
    Evidence,
    LocalTracks,
    PairSettings,
    as_evidence,
    candidate_pairs,
    decide_pairs,
    join_evidence,
    pair_evidence,
    pair_ratios,
    posterior,
)

TOLD = DecisionSettings(p_false=1e-3, hysteresis=4.0, every=1.0, hold=3.0)  # declares at ln 999 = 6.91


def told(pairs):
    """Evidence from {(a, b): log-ratios at 0 s, 1 s, ...}; None is no row."""
    rows = [(p, k, llr) for p, ratios in enumerate(pairs.values()) for k, llr in enumerate(ratios) if llr is not None]
    pair, time, llr = (np.array(column) for column in zip(*rows, strict=True))
    return Evidence(np.array(list(pairs)), pair, time.astype(float), llr.astype(float))


def spells(decisions):
    e = decisions.episodes
    return [tuple(row) for row in np.column_stack([e.a, e.b, e.time_from, e.time_to]).tolist()]


def kinds(decisions):
    return [(c.kind, c.a, c.b, c.time_from, c.time_to) for c in decisions.conflicts]


def test_a_pair_is_declared_when_sure_and_kept_until_the_evidence_turns():
    found = decide_pairs(told({(0, 1): [0, 6, 8, 2, -3, -5, 6, 9, 9]}), [0, 1], TOLD)
    assert spells(found) == [(0, 1, 2, 5), (0, 1, 7, 8)]
    np.testing.assert_allclose(found.episodes.probability, posterior([8.0, 9.0]))  # as declared: known then
    assert found.episodes.since.tolist() == [-np.inf, -np.inf] and found.episodes.until.tolist() == [2.0, 8.0]
    assert not found.conflicts


def test_the_prior_is_part_of_the_evidence():
    assert spells(decide_pairs(told({(0, 1): [8, 8]}), [0, 1], DecisionSettings(prior=0.1))) == []
    assert len(spells(decide_pairs(told({(0, 1): [10, 10]}), [0, 1], DecisionSettings(prior=0.1)))) == 1


def test_old_evidence_ends_an_episode_at_its_last_row():
    rows = told({(0, 1): [9, 9] + 8 * [None] + [9], (2, 3): 11 * [0]})
    assert spells(decide_pairs(rows, [0, 1, 0, 1], TOLD)) == [(0, 1, 0, 1), (0, 1, 10, 10)]


def test_two_that_claim_one_are_a_conflict_until_one_is_better():
    found = decide_pairs(told({(0, 2): [9, 9, 30, 30], (1, 2): [9, 9, 9, -9]}), [0, 0, 1], TOLD)
    assert spells(found) == [(0, 2, 2, 3)]
    assert kinds(found) == [("rival", 0, 2, 0, 1), ("rival", 1, 2, 0, 2)]


def test_what_one_claims_is_given_up_where_the_whole_demands_it():
    pairs = {(0, 2): [9], (0, 3): [20], (1, 3): [30], (1, 2): [APART]}
    found = decide_pairs(told(pairs), [0, 0, 1, 1], TOLD)
    assert {s[:2] for s in spells(found)} == {(0, 2), (1, 3)}


def test_addresses_are_never_merged_nor_parted_silently():
    found = decide_pairs(
        told({(0, 1): [9, 9], (2, 3): [-20, -20], (4, 5): [9, 9]}), 3 * [0, 1], TOLD, address=[7, 8, 5, 5, 6, -1]
    )
    assert {s[:2] for s in spells(found)} == {(4, 5)}
    assert kinds(found) == [("addresses", 0, 1, 0, 1), ("places", 2, 3, 0, 1)]


def test_three_systems_make_one_group_or_say_why_not():
    agreed = decide_pairs(told({(0, 1): [9], (1, 2): [9], (0, 2): [8]}), [0, 1, 2], TOLD)
    assert len(spells(agreed)) == 3 and not agreed.conflicts
    against = decide_pairs(told({(0, 1): [20], (1, 2): [9], (0, 2): [-30]}), [0, 1, 2], TOLD)
    assert {s[:2] for s in spells(against)} == {(0, 1)}
    assert kinds(against) == [("inconsistent", 1, 2, 0, 0)]
    # Two tracks of system 0 are each linked to one that the third system calls one object.
    doubled = decide_pairs(told({(0, 2): [20], (1, 3): [9], (2, 3): [15]}), [0, 0, 1, 2], TOLD)
    assert {s[:2] for s in spells(doubled)} == {(0, 2), (2, 3)} and kinds(doubled)[0][:3] == ("inconsistent", 1, 3)
    named = decide_pairs(told({(0, 1): [20], (1, 2): [9]}), [0, 1, 2], TOLD, address=[4, -1, 5])
    assert {s[:2] for s in spells(named)} == {(0, 1)} and kinds(named)[0][0] == "inconsistent"


def test_splits_stand_for_one_object_and_need_overwhelming_evidence():
    rows = {(0, 1): [12, 20], (0, 2): [9, 9], (1, 2): [9, 9]}
    found = decide_pairs(told(rows), [0, 0, 1], TOLD)  # splits are declared at ln(1e6) = 13.8
    assert spells(found)[0] == (0, 1, 1, 1) and len(spells(found)) == 2
    assert {c[0] for c in kinds(found)} == {"rival"} and all(c[4] == 0 for c in kinds(found))


def test_no_decision_looks_ahead(rng):
    pairs = {(i, 4 + j): np.cumsum(rng.normal(0.6, 6.0, 30)) for i in range(4) for j in range(3)}
    system = [0, 0, 0, 0, 1, 1, 1]
    whole = decide_pairs(told(pairs), system, TOLD)
    assert len(spells(whole)) > 4
    for until in (8, 17, 25):
        part = decide_pairs(told({pair: llr[: until + 1] for pair, llr in pairs.items()}), system, TOLD)
        expected = [(a, b, t0, min(t1, until)) for a, b, t0, t1 in spells(whole) if t0 <= until]
        assert spells(part) == expected


def test_at_any_time_one_to_one(rng):
    pairs = {(i, 5 + j): rng.normal(5.0, 6.0, 40) for i in range(5) for j in range(5)}
    e = decide_pairs(told(pairs), 5 * [0] + 5 * [1], DecisionSettings(p_false=0.05, every=1.0)).episodes
    for now in np.arange(40):
        live = (e.time_from <= now) & (now < e.time_to)
        assert len(np.unique(e.a[live])) == len(np.unique(e.b[live])) == live.sum()


def test_what_is_no_input_is_refused():
    with pytest.raises(DataError, match="names tracks"):
        decide_pairs(told({(0, 3): [1]}), [0, 1], TOLD)
    with pytest.raises(DataError, match="for each track"):
        decide_pairs(told({(0, 1): [1]}), [0, 1], TOLD, address=[1])
    for wrong in ({"prior": 1.0}, {"p_false": 0.0}, {"every": 0.0}, {"hysteresis": -1.0}, {"hold": np.inf}):
        with pytest.raises(ModelError):
            DecisionSettings(**wrong)


# Simulated tracks

SETTINGS = PairSettings(
    accel=(0.3, 3.0), sojourn=(60.0, 20.0), offset_cov=25.0 * np.eye(2), region_cov=1e8 * np.eye(2), speed_sigma=100.0
)


def seen(rng, paths, sd, period):
    """Local tracks of the paths, functions of time with their lives (begin, end), measured every period."""
    rows = []
    for k, (path, begin, end) in enumerate(paths):
        time = np.arange(begin + rng.uniform(0, period), end, period)
        z = path(time) + sd * rng.normal(size=(len(time), 2))
        rows.append((np.full(len(time), k), time, z, np.tile(sd**2 * np.eye(2), (len(time), 1, 1))))
    return LocalTracks(*(np.concatenate(part) for part in zip(*rows, strict=True)))


def line(x, y, vx, vy):
    return lambda t: np.array([x, y]) + np.outer(t, [vx, vy])


def test_a_track_handed_over_to_another_object_changes_hands(rng):
    """Two aircraft cross; the radar's track goes on with the other one. The whole past would outweigh that."""
    first, other = line(-9000.0, 0.0, 90.0, 0.0), line(0.0, -9000.0, 0.0, 90.0)
    crossing = 100.0
    swapped = seen(rng, [(lambda t: np.where((t < crossing)[:, None], first(t), other(t)), 0.0, 200.0)], 40.0, 4.0)
    names = seen(rng, [(first, 0.0, 200.0), (other, 0.0, 200.0)], 15.0, 2.0)
    settings = DecisionSettings(p_false=1e-3)
    windowed = decide_pairs(pair_evidence_of(names, swapped, 40.0), [0, 0, 1], settings)
    e = windowed.episodes
    assert e.a.tolist() == [0, 1]
    assert e.time_from[0] < 20.0 and crossing < e.time_to[0] < crossing + 20.0
    assert crossing < e.time_from[1] < crossing + 45.0 and e.time_to[1] > 190.0
    cumulative = decide_pairs(pair_evidence_of(names, swapped, np.inf), [0, 0, 1], settings)
    assert cumulative.episodes.a.tolist() == [0], "for the ratio of all rows the second is never the radar's"


def pair_evidence_of(a, b, window, reach=2000.0):
    k = int(a.track[-1]) + 1
    return join_evidence([(pair_evidence(a, b, SETTINGS, reach=reach, window=window), 0, k)])


def test_without_a_window_evidence_is_the_ratio(rng):
    a, b = (seen(rng, [(line(0.0, 0.0, 50.0, 9.0), 0.0, 40.0)], sd, 3.0) for sd in (20.0, 30.0))
    pairs = candidate_pairs(a, b, SETTINGS, reach=500.0)
    ratios = pair_ratios(a, b, pairs, SETTINGS)
    for found in (as_evidence(ratios, pairs), pair_evidence(a, b, SETTINGS, reach=500.0)):
        np.testing.assert_array_equal(found.llr, ratios.llr[0])
        np.testing.assert_array_equal(found.time, ratios.time[0])


def test_a_window_is_the_ratio_of_its_rows_alone(rng):
    a, b = (seen(rng, [(line(0.0, 0.0, 50.0, 9.0), 0.0, 100.0)], sd, 3.0) for sd in (20.0, 30.0))
    found = pair_evidence(a, b, SETTINGS, reach=500.0, window=30.0)
    start = min(a.time[0], b.time[0])
    every = np.unique(np.concatenate([a.time, b.time]))
    assert len(found.time) >= 0.8 * len(every)  # the last row of a window waits for the other track's
    for at in (20, 40, len(found.time) - 1):
        now = found.time[at]
        begin = start + (np.floor((now - start) / 15.0) - 1.0) * 15.0
        part = [LocalTracks(*(col[(t.time >= begin) & (t.time <= now + 3.0)] for col in t)) for t in (a, b)]
        alone = pair_ratios(*part, [[0, 0]], SETTINGS)
        assert found.llr[at] == pytest.approx(alone.llr[alone.time == now][0], abs=1e-8)


def test_pairs_out_of_reach_are_told_apart(rng):
    a = seen(rng, [(line(0.0, 0.0, 50.0, 0.0), 0.0, 200.0)], 10.0, 2.0)
    b = seen(rng, [(line(0.0, 0.0, 50.0, 40.0), 0.0, 200.0)], 10.0, 2.0)  # 1200 m away after 30 s
    found = pair_evidence(a, b, SETTINGS, reach=600.0, window=20.0)
    assert (found.llr[found.time > 60.0] == APART).all() and (found.time > 60.0).sum() >= 10


def test_many_objects_of_two_systems_find_each_other(rng):
    """60 aircraft in 40 km x 40 km, 45 of them seen by both systems: none taken for another, hardly one missed."""
    n = 60
    paths = [line(*rng.uniform(-2e4, 2e4, 2), *rng.normal(0.0, 100.0, 2)) for _ in range(n)]
    a = seen(rng, [(p, 0.0, 80.0) for p in paths[:50]], 60.0, 4.0)
    b = seen(rng, [(p, rng.uniform(0.0, 20.0), 80.0) for p in paths[5:]], 20.0, 3.0)
    found = decide_pairs(
        pair_evidence_of(a, b, 60.0), 50 * [0] + 55 * [1], DecisionSettings(prior=1 / 55, p_false=1e-3)
    )
    e = found.episodes
    true = e.a == e.b - 50 + 5
    assert true.all() and len(np.unique(e.a)) >= 44


def test_splits_within_one_system_are_found_and_neighbours_are_not(rng):
    paths = [(line(0.0, 0.0, 60.0, 0.0), 0.0, 80.0), (line(0.0, 0.0, 60.0, 0.0), 15.0, 80.0)]
    a = seen(rng, [*paths, (line(0.0, 300.0, 60.0, 0.0), 0.0, 80.0)], 30.0, 4.0)
    settings = PairSettings(region_cov=1e8 * np.eye(2))
    evidence = pair_evidence(a, a, settings, reach=1000.0, window=60.0)
    assert (evidence.pairs[:, 0] < evidence.pairs[:, 1]).all()
    e = decide_pairs(evidence, [0, 0, 0], DecisionSettings(p_false_split=1e-4)).episodes
    assert set(zip(e.a.tolist(), e.b.tolist(), strict=True)) == {(0, 1)}
