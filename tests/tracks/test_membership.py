"""Which system track a local track belongs to, by hand-made decisions."""

from itertools import pairwise

import numpy as np

from saltus.identify import Episodes
from saltus.tracks.membership import segments


def episodes(*rows):
    a, b, since, until, p = zip(*rows, strict=True) if rows else ((),) * 5
    return Episodes(
        np.array(a, np.int64), np.array(b, np.int64), np.array(since, float), np.array(until, float), np.array(p, float)
    )


def cut(begin, end, *rows, ready=None, settle=5.0):
    begin, end = np.array(begin, float), np.array(end, float)
    ready = begin + 3.0 if ready is None else np.array(ready, float)
    found = segments(begin, ready, end, episodes(*rows), settle)
    out = {}
    for k, since, until, of, p in zip(*found, strict=True):
        out.setdefault(int(k), []).append((float(since), float(until), int(of), float(p)))
    return found, out


def test_alone_every_track_is_its_own():
    _, got = cut([0, 10, 5], [100, 90, 80])
    assert got == {0: [(0, 100, 1, 1.0)], 1: [(10, 90, 3, 1.0)], 2: [(5, 80, 2, 1.0)]}


def test_older_track_survives():
    _, got = cut([0, 10], [100, 90], (0, 1, 40, 90, 0.97))
    assert got[0] == [(0, 100, 1, 1.0)]
    assert got[1] == [(10, 40, 2, 1.0), (40, 90, 1, 0.97)]


def test_a_number_stays_with_the_tracks_that_have_measurements():
    """A centre's track, older, is found one with a measured one, given up again, and found once more."""
    begin, end = np.array([0.0, 10.0]), np.array([100.0, 90.0])
    rows = episodes((0, 1, 40, 60, 0.97), (0, 1, 70, 90, 0.95))
    found = segments(begin, begin + 3.0, end, rows, 5.0, foreign=np.array([True, False]))
    mine = found.track == 1
    assert len(np.unique(found.system_track[mine])) == 1
    np.testing.assert_array_equal(found.probability[mine], 1.0)
    assert found.time_from[mine].min() == 10.0 and found.time_to[mine].max() == 90.0
    assert len(np.unique(found.system_track[~mine])) > 1
    measured = segments(begin, begin + 3.0, end, rows, 5.0)
    assert len(np.unique(measured.system_track[measured.track == 1])) > 1


def test_quick_decision_holds_from_the_beginning():
    _, got = cut([0, 10], [100, 90], (0, 1, 17, 90, 0.97))
    assert got[1] == [(10, 90, 1, 0.97)]


def test_change_of_mind_gives_a_new_track_and_a_death_does_not():
    _, got = cut([0, 10], [100, 90], (0, 1, 40, 60, 0.9))
    assert got[0] == [(0, 100, 1, 1.0)]
    assert [s[:2] for s in got[1]] == [(10, 40), (40, 60), (60, 90)]
    assert got[1][2][2] not in (got[1][0][2], got[0][0][2])
    _, got = cut([0, 10], [60, 90], (0, 1, 40, 60, 0.9))  # the older one ends; the other goes on under its number
    assert got[1] == [(10, 40, 2, 1.0), (40, 90, 1, 0.9)]


def test_gap_in_one_system_is_bridged_by_the_other():
    """Two pieces of a radar track on one long track of another system: one system track throughout."""
    _, got = cut([0, 0.5, 60], [100, 40, 100], (0, 1, 6, 40, 1.0), (0, 2, 70, 100, 1.0), settle=5.0)
    assert {s[2] for s in got[0]} == {s[2] for s in got[1]} == {1}
    assert got[2][-1][2] == 1


def test_third_system_joins_through_either():
    """1-2 and 0-1 make 0, 1, 2 one; parting 1-2 leaves 0 and 1 together."""
    _, got = cut([0, 1, 2], [100, 100, 100], (1, 2, 20, 50, 0.9), (0, 1, 30, 100, 0.9))
    assert got[0] == [(0, 100, 1, 1.0)]
    assert [s[2] for s in got[2]][-2] == 1
    assert got[2][-1][:2] == (50, 100)
    assert got[2][-1][2] not in (1, got[2][0][2])
    assert got[1][-1][2] == 1


def test_segments_cover_each_life_once():
    rng = np.random.default_rng(5)
    n = 30
    begin = rng.uniform(0, 100, n)
    end = begin + rng.uniform(10, 200, n)
    rows = []
    for _ in range(60):
        a, b = sorted(rng.choice(n, 2, replace=False))
        low, high = max(begin[a], begin[b]) + 3.0, min(end[a], end[b])
        if low < high:
            since, until = np.sort(rng.uniform(low, high, 2))
            rows.append((a, b, since, until if rng.random() < 0.5 else high, rng.random()))
    found, got = cut(begin, end, *rows)
    for k in range(n):
        pieces = got[k]
        assert pieces[0][0] == begin[k]
        assert pieces[-1][1] == end[k]
        assert all(x[1] == y[0] and x[0] < x[1] for x, y in pairwise(pieces))
    t = np.array([rng.uniform(begin[k], end[k]) for k in range(n)])
    at = found.at(np.arange(n), t)
    assert (found.track[at] == np.arange(n)).all()
    assert ((found.time_from[at] <= t) & (t <= found.time_to[at])).all()
    first = [found.time_from[found.system_track == of].min() for of in np.unique(found.system_track)]
    assert (np.diff(first) >= 0).all()
    assert (np.unique(found.system_track) == 1 + np.arange(len(first))).all()


def test_track_never_confirmed_has_no_segment():
    found, _ = cut([0, 10], [100, 90], ready=[3, np.inf])
    assert found.track.tolist() == [0]
    empty, _ = cut([], [])
    assert len(empty.track) == 0
    assert len(empty.at(np.zeros(0, np.int64), np.zeros(0))) == 0
