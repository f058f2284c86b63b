"""Which system track a local track belongs to, by hand-made decisions."""

from itertools import pairwise

import numpy as np
import pytest

from saltus.tracks.membership import KnownSince, Local, Membership, Merger

DEATH, PART, BIRTH, JOIN = range(4)  # the order of what becomes known at one time


def events(tracks, ready, end, rows):
    """Deaths, partings, births and joins; rows are (a, b, time_from, time_to, probability[, since[, until]])."""
    for k, track in enumerate(tracks):
        if np.isfinite(ready[k]):
            yield ready[k], BIRTH, k, (k, track, ready[k])
            yield end[k], DEATH, k, (k, end[k])
    for r in rows:
        a, b, start, stop, p, since, until = map(float, (*r, *(-np.inf, r[3])[len(r) - 5 :]))
        a, b = int(a), int(b)
        if stop >= max(ready[a], ready[b]):
            known = max(start, ready[a], ready[b])
            yield known, JOIN, a, (a, b, since, known, p)
            if stop < min(end[a], end[b]):  # both live on: a change of mind
                yield max(stop, known), PART, a, (a, b, until, max(stop, known))


def cut(begin, end, *rows, ready=None, system=None, address=None, foreign=None):
    n = len(begin)
    columns = (begin, system or range(n), address or [-1] * n, foreign or [False] * n)
    tracks = [Local(float(b), s, a, f) for b, s, a, f in zip(*columns, strict=True)]
    ready = np.array(begin, float) + 3.0 if ready is None else np.array(ready, float)
    membership = Membership()
    does = (membership.death, membership.part, membership.birth, membership.join)
    for _, kind, _, given in sorted(events(tracks, ready.tolist(), [float(e) for e in end], rows), key=lambda e: e[:3]):
        does[kind](*given)
    found = membership.segments(np.array(end, float))
    out = {}
    for k, *row in zip(*found, strict=True):
        out.setdefault(int(k), []).append(tuple(float(v) for v in row))
    return out, membership, found


def test_alone_every_track_is_its_own():
    got, *_ = cut([0, 10, 5], [100, 90, 80])
    assert got == {0: [(0, 100, 1, 1.0, 3)], 1: [(10, 90, 3, 1.0, 13)], 2: [(5, 80, 2, 1.0, 8)]}


def test_a_decision_holds_backwards_and_tells_when_it_was_made():
    """One number from the first report; that the other number was merged is announced when it became known."""
    got, membership, _ = cut([0, 10], [100, 90], (0, 1, 40, 90, 0.97))
    assert got == {0: [(0, 100, 1, 1.0, 3)], 1: [(10, 90, 1, 0.97, 40)]}
    assert membership.mergers == [Merger(1, 2, 1, 10.0, 40.0)]
    rows = KnownSince(membership.changes).at(np.array([1, 1, 1, 2, 9]), np.array([5.0, 10.0, 60.0, 60.0, 60.0]))
    assert rows.tolist() == [3.0, 40.0, 40.0, 40.0, -np.inf]
    assert KnownSince([]).at(np.array([1]), np.array([5.0])).tolist() == [-np.inf]


def test_it_holds_no_further_back_than_the_evidence():
    """Two until 30: the later track came from another object, under its own number until then."""
    got, membership, _ = cut([0, 10], [100, 90], (0, 1, 40, 90, 0.97, 30))
    assert got[0] == [(0, 100, 1, 1.0, 3)]
    assert got[1] == [(10, 30, 2, 1.0, 13), (30, 90, 1, 0.97, 40)]
    assert [m[:3] for m in membership.mergers] == [(1, 2, 1)]
    named, *_ = cut([0, 10], [100, 90], (0, 1, 40, 90, 0.97, 30), address=[-1, 0x3C6444])
    assert [s[:3] for s in named[0]] == [(0, 30, 1), (30, 100, 2)]  # an address does not go over
    assert named[1] == [(10, 90, 2, 1.0, 13)]


def test_parted_tracks_keep_their_own_from_where_they_parted():
    got, *_ = cut([0, 10], [100, 90], (0, 1, 40, 70, 0.9, -np.inf, 62))
    assert got[0] == [(0, 100, 1, 1.0, 3)]
    assert got[1] == [(10, 62, 1, 0.9, 40), (62, 90, 3, 1.0, 70)]  # 2 was merged into 1 and is not used again
    got, *_ = cut([0, 10], [60, 90], (0, 1, 40, 60, 0.9))  # the older one ends; the other goes on under its number
    assert got[1] == [(10, 90, 1, 0.9, 40)]


def test_where_a_decision_flips_the_final_one_rules():
    rows = (0, 1, 40, 50, 0.9, -np.inf, 45), (0, 1, 70, 90, 0.95)
    got, *_ = cut([0, 10], [100, 90], *rows)
    assert [s[:3] for s in got[1]] == [(10, 45, 1), (45, 90, 1)]
    assert [s[4] for s in got[1]] == [40, 70]
    # 2 is found to be 0's object, then 1 to have been it all the time, of the same system as 2.
    rows = (0, 2, 40, 60, 0.9, -np.inf, 58), (0, 1, 60, 100, 0.95)
    got, *_ = cut([0, 10, 10], [100, 100, 100], *rows, system=[0, 1, 1])
    assert {s[2] for s in got[0]} == {s[2] for s in got[1]} == {1}
    assert 1 not in {s[2] for s in got[2]}


def test_a_number_stays_with_the_tracks_that_have_measurements():
    """A centre's track, older, is found one with a measured one, given up again, and found once more."""
    rows = (0, 1, 40, 60, 0.97), (0, 1, 70, 90, 0.95)
    got, *_ = cut([0, 10], [100, 90], *rows, foreign=[True, False])
    assert got[1] == [(10, 90, 1, 1.0, 13)]  # tracks of centres are counted apart
    assert {s[2] for s in got[0]} == {1}
    measured, *_ = cut([0, 10], [100, 90], *rows)
    assert {s[2] for s in measured[0]} == {1} and measured[1][0][3] < 1.0  # here the older track names the object


def test_what_ended_with_another_partner_was_no_part_of_this_one():
    """0 and 1 were one until 1 ended; 2, of 1's system, stood beside them, and is not taken for 1 in hindsight."""
    rows = (0, 1, 20, 60, 1.0), (0, 2, 75, 80, 0.99, 30)
    got, *_ = cut([0, 0, 5], [80, 60, 200], *rows, system=[0, 1, 1], ready=[3, 3, 8])
    assert {s[2] for s in got[1]} == {1}
    assert [s for s in got[2] if s[0] < 60 and s[2] == 1] == []


def test_gap_in_one_system_is_bridged_by_the_other():
    """Two pieces of a radar track on one long track of another system: one system track throughout."""
    got, *_ = cut([0, 0.5, 60], [100, 40, 100], (0, 1, 6, 40, 1.0), (0, 2, 70, 100, 1.0), system=[0, 1, 1])
    assert {s[2] for k in got for s in got[k]} == {1}


def test_third_system_joins_through_either():
    """1-2 and 0-1 make 0, 1, 2 one; parting 1-2 leaves 0 and 1 together."""
    got, *_ = cut([0, 1, 2], [100, 100, 100], (1, 2, 20, 50, 0.9), (0, 1, 30, 100, 0.9))
    assert {s[2] for s in got[0] + got[1]} == {1}
    assert [s[:3] for s in got[2]] == [(2, 50, 1), (50, 100, 4)]


def test_another_address_is_another_object():
    """A radar's track was on one aircraft, which ended, and is then on another: the numbers stay with the aircraft."""
    rows = (0, 1, 20, 60, 1.0), (0, 2, 70, 100, 1.0)
    got, *_ = cut([0, 0, 50], [100, 60, 100], *rows, system=[0, 1, 1], address=[-1, 0xA, 0xB], ready=[3, 4, 53])
    assert [s[:3] for s in got[0]] == [(0, 60, 1), (60, 100, 3)]
    assert {s[2] for s in got[1]} == {1} and {s[2] for s in got[2]} == {3}


@pytest.mark.parametrize("seed", range(4))
def test_segments_cover_each_life_once_and_what_is_known_stays(seed):
    """Decisions later than a time change nothing of what was known by then."""
    rng = np.random.default_rng(seed)
    n = 30
    begin = rng.uniform(0, 100, n)
    end = begin + rng.uniform(10, 200, n)
    rows = []
    for _ in range(60):
        a, b = sorted(rng.choice(n, 2, replace=False))
        low, high = max(begin[a], begin[b]) + 3.0, min(end[a], end[b])
        if low < high:
            since, until = np.sort(rng.uniform(low, high, 2))
            back = rng.choice([-np.inf, rng.uniform(low, since)])
            rows.append((a, b, since, until if rng.random() < 0.5 else high, rng.random(), back, until))
    system = rng.integers(0, 3, n).tolist()
    got, _, found = cut(begin, end, *rows, system=system)
    for k in range(n):
        pieces = got[k]
        assert pieces[0][0] == begin[k]
        assert pieces[-1][1] == end[k]
        assert all(x[1] == y[0] and x[0] < x[1] for x, y in pairwise(pieces))
    t = np.array([rng.uniform(begin[k], end[k]) for k in range(n)])
    at = found.at(np.arange(n), t)
    assert (found.track[at] == np.arange(n)).all()
    assert ((found.time_from[at] <= t) & (t <= found.time_to[at])).all()

    now = 120.0
    until = [(*r[:3], min(r[3], 1e9 if r[3] > now else r[3]), *r[4:]) for r in rows if r[2] <= now]
    alive = [e if e <= now else 1e9 for e in end]  # nobody knows when it will end
    before, *_ = cut(begin, alive, *until, system=system, ready=[b + 3 if b + 3 <= now else np.inf for b in begin])
    for k, pieces in got.items():
        early = {(s[0], s[2], s[4]) for s in pieces if s[4] <= now}
        assert early <= {(s[0], s[2], s[4]) for s in before.get(k, [])}, k


def test_track_never_confirmed_has_no_segment():
    *_, found = cut([0, 10], [100, 90], ready=[3, np.inf])
    assert found.track.tolist() == [0]
    *_, empty = cut([], [])
    assert len(empty.track) == 0
    assert len(empty.at(np.zeros(0, np.int64), np.zeros(0))) == 0
