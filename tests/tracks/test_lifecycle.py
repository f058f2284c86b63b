"""M of N, coasting, deletion, ids and rows, against hand counts."""

import numpy as np
import pytest
from tracking_scenes import flights, measured, run

from saltus.tracks.lifecycle import COASTED, CONFIRMED, SEED, TENTATIVE, Birth, Lifecycle
from saltus.tracks.settings import TrackerSettings

PERIOD = 4.0


def _birth(k, time):
    return Birth(np.full(k, time), np.full(k, PERIOD), np.arange(k), np.zeros((k, 6)), np.zeros((k, 6, 6)))


def born(life, rows, time=0.0):
    rows = np.asarray(rows)
    life.begin(rows, _birth(len(rows), time))


def hit(life, rows, time):
    rows = np.asarray(rows)
    life.hit(rows, np.full(len(rows), time), np.full(len(rows), PERIOD), np.zeros(len(rows), int))


@pytest.mark.parametrize(("m", "n"), [(2, 2), (3, 5), (2, 3), (1, 1), (4, 6)])
def test_every_pattern_of_hits_confirms_when_m_of_n_are_there(m, n):
    """All 2^8 patterns of eight scans after the first plot, one row each, against a count over a list."""
    life = Lifecycle(TrackerSettings(confirm_hits=m, confirm_scans=n))
    born(life, range(256))
    patterns = [[1] for _ in range(256)]
    confirmed = np.zeros(256, bool)
    for scan in range(1, 9):
        hits = [p for p in range(256) if p >> (scan - 1) & 1]
        for p, pattern in enumerate(patterns):
            pattern.append(p >> (scan - 1) & 1)
            if pattern[-1]:
                confirmed[p] |= sum(pattern[-n:]) >= m
        hit(life, hits, scan * PERIOD + 0.3)
        assert ((life.status[:256] == CONFIRMED) == confirmed).all()


def test_a_plot_early_or_late_within_its_scan_counts_for_that_scan():
    life = Lifecycle(TrackerSettings(confirm_hits=3, confirm_scans=3))
    born(life, [0, 1])
    for row, times in ((0, (4.9, 8.0)), (1, (4.0, 12.0))):  # the second misses the scan at 8 s
        for t in times:
            hit(life, [row], t)
    assert life.status[0] == CONFIRMED
    assert life.status[1] == TENTATIVE


def test_tracks_are_dropped_when_they_cannot_be_confirmed_or_coasted_out():
    settings = TrackerSettings(confirm_hits=3, confirm_scans=5, coast_scans=4, coast_seconds=6.0)
    life = Lifecycle(settings)
    born(life, [0, 1, 2])
    hit(life, [1, 2], 4.0)
    hit(life, [2], 8.0)
    assert list(life.status[:3]) == [SEED, TENTATIVE, CONFIRMED]
    # Not confirmable once 3 = N - M + 1 plots are missed in a row; a plot is missed when 0.6 scans late.
    last = np.array([0.0, 4.0, 8.0])
    patience = np.array([3 * PERIOD, 3 * PERIOD, 4 * PERIOD]) + 0.6 * PERIOD
    for row, end in enumerate(last + patience):
        assert row not in life.overdue(end - 0.01)
        assert row in life.overdue(end + 0.01)


@pytest.mark.parametrize(("seconds", "expected"), [(6.0, [12, 16, 20]), (21.0, [12, 16, 20, 24, 28])])
def test_coasted_rows_come_at_the_times_plots_were_due(seconds, expected):
    """The longer of three scans and `coast_seconds` decides: 12 s, or 21 s with its five whole scans."""
    life = Lifecycle(TrackerSettings(confirm_hits=2, confirm_scans=2, coast_scans=3, coast_seconds=seconds))
    born(life, [0])
    hit(life, [0], 4.0)
    hit(life, [0], 8.0)
    times = []
    for now in np.arange(8.0, 60.0, 0.5):
        rows, due = life.to_coast(now)
        assert (now - due > 0.6 * PERIOD).all()  # only after it is clear that the plot is missed
        times += due.tolist()
        assert len(rows) <= 1
    assert times == expected


def test_a_plot_resets_coasting():
    life = Lifecycle(TrackerSettings(confirm_hits=2, confirm_scans=2, coast_scans=3, coast_seconds=1.0))
    born(life, [0])
    hit(life, [0], 4.0)
    assert life.to_coast(11.0)[1].tolist() == [8.0]
    assert life.to_coast(11.0)[1].tolist() == []
    hit(life, [0], 12.0)
    assert life.to_coast(19.0)[1].tolist() == [16.0]


def test_rows_are_recycled_and_ids_are_not(rng):
    life, seen, rows_used = Lifecycle(TrackerSettings()), [], {0}
    born(life, [0])
    seen.append(int(life.id[0]))
    for _ in range(300):
        if len(life.rows()) and rng.random() < 0.5:
            life.end(rng.choice(life.rows(), 1))
        else:
            row = next(k for k in range(400) if k not in life.rows())
            hit_before = len(life.active) > row
            if hit_before:
                life.icao24[row], life.mode3a[row], life.coasted[row], life.has_altitude[row] = 5, 5, 5, True
            born(life, [row])
            rows_used.add(row)
            seen.append(int(life.id[row]))
            assert (life.icao24[row], life.mode3a[row], life.callsign[row]) == (-1, -1, "")
            assert (life.coasted[row], life.has_altitude[row], life.status[row]) == (0, False, SEED)
    assert len(set(seen)) == len(seen) > len(rows_used)
    assert min(seen) >= 1


def test_the_table_grows_without_forgetting():
    life = Lifecycle(TrackerSettings())
    born(life, range(10), time=3.0)
    before = life.id[:10].copy()
    born(life, range(10, 500), time=7.0)
    np.testing.assert_array_equal(life.id[:10], before)
    np.testing.assert_array_equal(life.time[:10], 3.0)
    assert len(life.rows()) == 500


def test_a_target_that_goes_and_another_that_comes(rng):
    """Ten scans, twenty of silence, ten scans at the same place: two tracks, the first coasted and then dropped."""
    settings = TrackerSettings(coast_scans=5, coast_seconds=20.0)
    times = np.concatenate([np.arange(10), np.arange(30, 40)]) * PERIOD
    time, xy = flights([[0.0, 50e3]], [[0.0, 0.0]], times)
    found = run(measured(time, xy + rng.normal(0, 20, xy.shape), 20.0), settings=settings)
    first, second = found.track_id[0], found.track_id[-1]
    assert first != second
    assert (found.track_id[:10] == first).all()
    assert (found.track_id[10:] == second).all()
    coasted = found.rows.status == COASTED
    np.testing.assert_allclose(
        found.rows.time[coasted & (found.rows.track_id == first)], 36.0 + PERIOD * np.arange(1, 6)
    )
    assert (found.rows.measurement[coasted] == -1).all()
    spread = np.trace(found.rows.moments.cov[coasted][:, [[0], [2]], [0, 2]], axis1=1, axis2=2)
    assert (np.diff(spread) > 0).all()  # the longer unseen, the less known


def test_a_single_plot_is_no_track(rng):
    found = run(measured([0.0, 100.0, 200.0], rng.uniform(-5e4, 5e4, (3, 2)), 20.0))
    assert (found.track_id == 0).all()
    assert len(found.raw.confirmed) == 0
    assert len(np.unique(found.raw.track_id)) == 3


def test_an_altitude_is_told_until_it_is_vague_for_what_told_it():
    life = Lifecycle(TrackerSettings())
    rows, cov = np.arange(3), np.zeros((3, 6, 6))
    life.begin(rows, Birth(np.zeros(3), np.ones(3), np.zeros(3, int), np.zeros((3, 6)), cov))
    assert not life.knows_altitude(rows, cov).any()
    # Mode C of 10 m, an elevation that makes 1500 m at that range, and nothing.
    life.heard_altitude(rows, np.array([True, True, False]), np.array([10.0, 1500.0, 1.0]) ** 2)
    for sigma, told in ((400.0, [True, True, False]), (600.0, [False, True, False]), (5000.0, [False] * 3)):
        cov[:, 4, 4] = sigma**2
        assert life.knows_altitude(rows, cov).tolist() == told
