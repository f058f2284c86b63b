"""Slices and rounds: every plot once, no target twice in a round, earlier plots first."""

import numpy as np
import pytest
from tracking_scenes import measured, run

from saltus.tracks.slices import rounds, slice_width, slices

SPEED = 100.0


@pytest.mark.parametrize("identity", [True, False])
def test_no_target_has_two_plots_in_a_round(rng, identity):
    """Against the definition, pair by pair: some plots have addresses, some none."""
    n = 60
    m = measured(rng.uniform(0.0, 4.0, n), rng.uniform(-900.0, 900.0, (n, 2)), 5.0, icao24=rng.integers(-1, 6, n))
    found = rounds(m, np.arange(n), 1.0, SPEED, use_identity=identity)
    np.testing.assert_array_equal(np.sort(np.concatenate(found)), np.arange(n))
    turn = np.empty(n, int)
    for k, part in enumerate(found):
        assert len(part)
        turn[part] = k
    before = np.zeros(n, int)
    for j in range(n):
        for i in range(j):
            dt = m.time[j] - m.time[i]
            if identity and min(m.icao24[i], m.icao24[j]) >= 0:
                one = m.icao24[i] == m.icao24[j]
            else:
                apart = np.hypot(*(m.position[i, :2] - m.position[j, :2]))
                one = dt > 0.4 and apart <= SPEED * dt + 4.0 * 2.0 * np.sqrt(50.0)
            if one:
                assert turn[i] < turn[j]
                before[j] = max(before[j], turn[i] + 1)
    np.testing.assert_array_equal(turn, before)  # and none later than it must be
    assert turn.max() > 2


def test_addresses_alone_are_counted_like_pairs(rng):
    n = 80
    m = measured(np.sort(rng.uniform(0.0, 4.0, n)), np.zeros((n, 2)), 5.0, icao24=rng.integers(0, 30, n))
    seen = {}
    for k, part in enumerate(rounds(m, np.arange(n), 1.0, SPEED, use_identity=True)):
        for i in part:
            code = m.icao24[i]
            assert seen.get(code, 0) == k
            seen[code] = k + 1
    assert sum(seen.values()) == n


def test_slices_cover_time_in_order(rng):
    time = np.sort(rng.uniform(0.0, 50.0, 200))
    for width in (0.6, 4.0):
        cut = list(slices(time, width, np.inf))
        assert [a for a, _ in cut] == [0, *(b for _, b in cut[:-1])]
        assert cut[-1][1] == len(time)
        assert all(time[b - 1] - time[a] <= width for a, b in cut)
        assert list(slices(time, width, -np.inf)) == cut[:-1]  # whether the last one is complete is not known
        assert list(slices(time, width, time[cut[-1][0]] + 1.01 * width)) == cut  # nothing comes within it
    assert list(slices(time[:0], 1.0, np.inf)) == []


def test_slices_are_shorter_than_targets_report():
    """A share of 0.4 of the shortest period of several sources; 0.9 of a radar's alone, four of one in rounds."""
    assert slice_width([1.5, 2.0], [True, True]) == pytest.approx(0.4 * 1.5)
    assert slice_width([4.0], [True]) == pytest.approx(3.6)
    assert slice_width([0.5], [False]) == pytest.approx(2.0)
    assert slice_width([5.0], [False]) == 4.0


def test_a_target_that_reports_often_has_all_its_plots_used(rng):
    """Two aircraft with addresses, seen 0.3 to 1.7 s apart, hundreds of metres flown in between."""
    times = np.cumsum(rng.uniform(0.3, 1.7, 80)), np.cumsum(rng.uniform(0.3, 1.7, 80))
    time = np.concatenate(times)
    xy = np.column_stack([200.0 * time, np.repeat([0.0, 4e3], 80)]) + 10.0 * rng.standard_normal((160, 2))
    m = measured(time, xy, 10.0, icao24=np.repeat([0xA, 0xB], 80))
    found = run(m, periods=(1.0,))
    assert len(np.unique(found.track_id)) == 2
    assert (found.track_id > 0).all()
    rows = found.rows
    for track in np.unique(found.track_id):
        mine = rows.time[rows.track_id == track]
        assert (np.diff(mine) > 0).all()
