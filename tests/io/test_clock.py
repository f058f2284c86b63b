"""Midnight, late reports and clocks that jump."""

import numpy as np
import pytest

from saltus.io.clock import DAY, complete, day_offsets, impossible, order_faults, standing, told_clock


def test_midnight_counts_on():
    tod = np.array([86398.0, 86399.5, 0.5, 2.0])
    assert day_offsets(tod).tolist() == [0, 0, 1, 1]


def test_late_reports_around_midnight_stay_on_their_day():
    tod = np.array([86399.0, 0.1, 86399.8, 0.3, np.nan, 86399.9, 0.4])
    assert day_offsets(tod).tolist() == [0, 1, 0, 1, 0, 0, 1]


def test_two_midnights():
    tod = np.arange(0.0, 2.5 * 86400, 600.0)
    assert day_offsets(tod % 86400).tolist() == (tod // 86400).astype(int).tolist()


@pytest.mark.parametrize("wild", [[80000.0], [50000.0, 7000.0], [60000.0, 20000.0, 70000.0]])
def test_wild_times_start_no_day(wild):
    tod = np.concatenate([np.arange(100.0, 120.0), wild, np.arange(120.0, 140.0)])
    days = day_offsets(tod)
    assert not np.any(days[:20]) and not np.any(days[-20:])


def test_wild_first_time_starts_no_day():
    tod = np.concatenate([[60000.0], np.arange(100.0, 120.0)])
    assert not np.any(day_offsets(tod)[1:])


def test_within_the_window_all_is_well():
    time = np.array([0.0, 1.9, 0.0, 3.0, 1.0, 4.0])
    late, jump, steps, *_ = order_faults(time)
    assert not late.any() and not jump.any() and steps == ()


def test_a_late_report_is_late_and_nothing_else():
    time = np.arange(0.0, 60.0)
    time[30] = 20.0
    late, jump, steps, *_ = order_faults(time)
    assert np.flatnonzero(late).tolist() == [30]
    assert not jump.any() and steps == ()


@pytest.mark.parametrize("wild", [5000.0, -5000.0, 100.0])
@pytest.mark.parametrize("where", [0, 1, 30, 58, 59])
def test_one_wild_time_does_not_touch_its_neighbours(wild, where):
    time = np.arange(1000.0, 1060.0)
    time[where] += wild
    late, jump, steps, *_ = order_faults(time)
    expected = [where]
    if where == 59 and wild == 100.0:
        expected = []  # the last report of a file 100 s ahead may as well follow a gap
    if where == 0 and wild < 0:
        expected = []  # a first report long before the others may as well precede a gap
    assert np.flatnonzero(late | jump).tolist() == expected
    assert steps == ()


def test_a_gap_is_no_fault():
    time = np.concatenate([np.arange(0.0, 50.0), np.arange(5000.0, 5050.0)])
    late, jump, steps, *_ = order_faults(time)
    assert not late.any() and not jump.any() and steps == ()


def test_a_clock_set_back_for_good_keeps_the_rest():
    """40 s after the start it is set back by 10 s: what it repeats, 30 to 40 s, is dropped from the earlier part."""
    time = np.concatenate([np.arange(0.0, 40.0, 0.1), np.arange(30.0, 80.0, 0.1)])
    late, jump, steps, *_ = order_faults(time)
    assert steps == (400,)
    assert not late.any() and not jump[400:].any()
    assert np.flatnonzero(jump).tolist() == list(range(300, 400))


def test_a_clock_set_back_before_the_start_loses_nothing():
    time = np.concatenate([np.arange(3600.0, 3700.0), np.arange(0.0, 100.0)])
    late, jump, steps, *_ = order_faults(time)
    assert steps == (100,)
    assert not late.any() and not jump.any()


@pytest.mark.parametrize("period", [0.2, 2.0])
@pytest.mark.parametrize("order", [(1, 0, 2), (2, 0, 1), (0, 2, 1), (2, 1, 0)])
def test_stretches_out_of_order_lose_nothing(period, order):
    stretches = np.split(period * np.arange(900.0), 3)
    late, jump, steps, *_ = order_faults(np.concatenate([stretches[k] for k in order]))
    assert not late.any() and not jump.any()
    assert steps


def test_a_sparse_clock_set_back_drops_what_it_repeats():
    """One report every 2 s: the intervals between the later reports are no silence."""
    time = np.concatenate([np.arange(0.0, 200.0, 2.0), np.arange(101.0, 400.0, 2.0)])
    late, jump, steps, *_ = order_faults(time)
    assert steps == (100,)
    assert time[jump].tolist() == np.arange(102.0, 200.0, 2.0).tolist()
    assert not late.any() and not jump[100:].any()


def test_a_passing_leap_ahead_is_dropped():
    time = np.arange(0.0, 200.0)
    time[60:90] += 1000.0
    late, jump, steps, *_ = order_faults(time)
    assert np.flatnonzero(jump).tolist() == list(range(60, 90))
    assert not late.any() and steps == ()


def test_truncated_times_are_completed_by_one_near_them():
    """512 s do not divide the day: 86400 = 168 x 512 + 384, and truncation starts again at 0 after midnight."""
    told = np.array([100.0, 100.0, 383.0, 1.0, 1.0, 383.0, np.nan, 5.0])
    near = np.array([600.0, 700.0, 86399.0, 86399.0, 2.0, 2.0, 50.0, np.nan])
    expected = [612.0, 612.0, 86399.0, 1.0, 1.0, 86399.0, np.nan, np.nan]
    np.testing.assert_array_equal(complete(told, 512.0, near), expected)


def test_every_truncated_time_of_two_days_is_found_within_half_a_turn(rng):
    time = rng.uniform(0.0, 2 * DAY, 5000)
    # the last turn of a day has 384 s: times within half of them are told apart
    near = (time + rng.uniform(-180.0, 180.0, 5000)) % DAY
    np.testing.assert_allclose(complete(time % DAY % 512.0, 512.0, near), time % DAY, atol=1e-6)


def test_a_passing_step_back_is_dropped():
    time = np.arange(1000.0, 1200.0)
    time[60:110] -= 600.0
    late, jump, steps, *_ = order_faults(time)
    assert np.flatnonzero(jump).tolist() == list(range(60, 110))
    assert not late.any() and steps == ()


def test_steps_and_leaps_are_told_with_their_size():
    faults = order_faults(np.concatenate([np.arange(0.0, 100.0), np.arange(3700.0, 3800.0), np.arange(-500.0, -400.0)]))
    assert (faults.leaps, faults.pauses) == ((100,), (3601.0,))
    assert (faults.steps, faults.sizes) == ((200,), (4299.0,))
    assert order_faults(np.arange(0.0, 1e6, 900.0)).leaps == ()  # its usual interval is no gap


def test_times_past_the_end_of_the_day_are_none():
    tod = np.array([0.0, 86399.99, 86400.5, 86401.0, 131071.99, -1.0, np.nan])
    assert impossible(tod).tolist() == [False, False, False, True, True, True, False]


def test_a_clock_that_stands_is_found_by_targets_told_again():
    time = np.concatenate([np.arange(0.0, 50.0), np.full(60, 50.0), np.full(40, 60.0)])
    targets = np.concatenate([np.arange(50) % 10, np.arange(60) % 10, np.arange(40)])
    assert np.flatnonzero(standing(time, targets)).tolist() == list(range(60, 110))
    assert not standing(time, np.full(len(time), -1)).any()


def test_a_capture_s_clock_far_from_the_reports_is_told():
    captured = 1e9 + np.arange(10.0)
    assert told_clock(captured, captured - 3.0) == ""
    assert told_clock(np.full(10, np.nan), captured) == ""
    assert "7200 s ahead of the clock that captured them" in told_clock(captured, captured + 7200.0)
