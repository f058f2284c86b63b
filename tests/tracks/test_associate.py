"""Pairs against loops, assignments against enumeration."""

import numpy as np
import pytest

from saltus.tracks.associate import Pairs, assign, near_pairs, nearest_pairs


def best_total(pairs, gain):
    """The greatest total gain over every way to use each track and each plot at most once."""
    if not len(gain):
        return 0.0
    rest = slice(1, None)
    without = best_total(pairs[rest], gain[rest])
    clash = (pairs[rest] == pairs[0]).any(axis=1)
    return max(without, gain[0] + best_total(pairs[rest][~clash], gain[rest][~clash]))


@pytest.mark.parametrize("density", [0.3, 0.6, 0.9])
def test_no_assignment_is_better(rng, density):
    for _ in range(60):
        at = np.argwhere(rng.random(rng.integers(1, 5, size=2)) < density)
        at = at[rng.permutation(len(at))]
        gain = rng.normal(1.0, 2.0, len(at))
        chosen = assign(Pairs(at[:, 0] + 7, at[:, 1] + 3), gain)  # numbers need not start at 0
        assert (gain[chosen] > 0).all()
        for side in at[chosen].T:
            assert len(np.unique(side)) == len(side)
        assert gain[chosen].sum() == pytest.approx(best_total(at, gain), abs=1e-12)


def test_separate_clusters_are_solved_apart(rng):
    """Five independent problems in one call: the total is the sum of the five enumerated optima."""
    problems = []
    for k in range(5):
        at = np.argwhere(rng.random((3, 3)) < 0.7)
        problems.append((at + 10 * k, rng.normal(1.0, 2.0, len(at))))
    at, gain = (np.concatenate(column) for column in zip(*problems, strict=True))
    shuffle = rng.permutation(len(at))
    chosen = assign(Pairs(*at[shuffle].T), gain[shuffle])
    expected = sum(best_total(a, g) for a, g in problems)
    assert gain[shuffle][chosen].sum() == pytest.approx(expected, abs=1e-12)


def test_a_nearer_plot_is_given_up_where_the_total_demands_it():
    # Track 0 likes plot 0 best (5), but track 1 has nothing else: 4 + 4 > 5.
    pairs = Pairs(np.array([0, 0, 1]), np.array([0, 1, 0]))
    assert sorted(assign(pairs, np.array([5.0, 4.0, 4.0]))) == [1, 2]


def test_nothing_to_assign():
    none = np.zeros(0, int)
    assert len(assign(Pairs(none, none), np.zeros(0))) == 0
    assert len(assign(Pairs(np.array([0, 0]), np.array([0, 1])), np.array([-1.0, 0.0]))) == 0


def test_near_pairs_are_those_of_a_loop(rng):
    tracks, plots = rng.uniform(-1e4, 1e4, (40, 2)), rng.uniform(-1e4, 1e4, (55, 2))
    reach = rng.uniform(0.0, 5e3, 40)
    expected = {
        (i, j)
        for i in range(40)
        for j in range(55)
        if (tracks[i, 0] - plots[j, 0]) ** 2 + (tracks[i, 1] - plots[j, 1]) ** 2 <= reach[i] ** 2
    }
    assert len(expected) > 50
    found = near_pairs(tracks, reach, plots)
    assert len(found.track) == len(expected)
    assert set(zip(found.track.tolist(), found.plot.tolist(), strict=True)) == expected


@pytest.mark.parametrize("most", [1, 3, 10])
def test_a_crowded_track_keeps_its_nearest(rng, most):
    tracks, plots = rng.uniform(-1e4, 1e4, (80, 2)), rng.uniform(-1e4, 1e4, (90, 2))
    reach = rng.uniform(0.0, 6e3, 80)
    found, every = near_pairs(tracks, reach, plots, most), near_pairs(tracks, reach, plots)
    apart = np.linalg.norm(tracks[every.track] - plots[every.plot], axis=1)
    expected, crowded = set(), 0
    for i in range(80):
        mine = np.flatnonzero(every.track == i)
        crowded += len(mine) > most
        expected |= {(i, int(every.plot[j])) for j in mine[np.argsort(apart[mine])][:most]}
    assert 0 < crowded < 80
    assert sorted(zip(found.track.tolist(), found.plot.tolist(), strict=True)) == sorted(expected)
    keep = nearest_pairs(every, apart, most)
    assert set(zip(every.track[keep].tolist(), every.plot[keep].tolist(), strict=True)) == expected


def test_of_equal_distances_the_earlier_pair_is_nearer():
    keep = nearest_pairs(Pairs(np.array([1, 0, 1, 1]), np.array([5, 6, 7, 8])), np.array([2.0, 9.0, 2.0, 1.0]), 2)
    assert keep.tolist() == [True, True, False, True]


@pytest.mark.parametrize(("n_tracks", "n_plots"), [(0, 3), (3, 0), (0, 0), (2, 2)])
def test_near_pairs_of_few(n_tracks, n_plots):
    found = near_pairs(np.zeros((n_tracks, 2)), np.ones(n_tracks), np.full((n_plots, 2), 5.0))
    assert len(found.track) == len(found.plot) == 0  # none there, or none within reach


def test_clusters_told_apart_give_the_same_total(rng, monkeypatch):
    """Large scenes are solved cluster by cluster, small ones at once: one optimum."""
    pairs = Pairs(rng.integers(0, 60, 150), rng.integers(0, 60, 150))
    pairs = Pairs(*np.unique(np.stack(pairs), axis=1))
    gain = rng.normal(3.0, 4.0, len(pairs.track))
    at_once = assign(pairs, gain)
    monkeypatch.setattr("saltus.identify.assignment._AT_ONCE", 0)
    apart = assign(pairs, gain)
    assert gain[apart].sum() == pytest.approx(gain[at_once].sum(), rel=1e-12)
    assert len(np.unique(pairs.track[apart])) == len(np.unique(pairs.plot[apart])) == len(apart)
