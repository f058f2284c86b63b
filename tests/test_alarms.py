"""Alarms against direct definitions and closed forms; calibrated rates against independent simulation."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import norm

from saltus.alarms import alarms, calibrate, cusum, shiryaev
from saltus.errors import DataError, ModelError

SHIFT = 1.0  # the fault moves a unit normal by this much


def ratios(rng, runs, rows, onset=None):
    """Log-likelihood ratios of a shifted normal against a unit one."""
    z = rng.normal(size=(runs, rows))
    if onset is not None:
        z[:, onset:] += SHIFT
    return SHIFT * z - SHIFT**2 / 2


def test_cusum_is_the_largest_tail_sum(rng):
    llr = rng.normal(size=(3, 12))
    for run in range(3):
        for k in range(12):
            best = max(0.0, *(llr[run, j : k + 1].sum() for j in range(k + 1)))
            assert abs(cusum(llr)[run, k] - best) < 1e-12
    np.testing.assert_array_equal(cusum(llr[0]), cusum(llr)[0])


def test_a_limited_sum_forgets_a_long_fault_at_once():
    llr = np.concatenate([np.full(100, 2.0), np.full(5, -2.0)])
    assert cusum(llr)[-1] == 190.0
    assert cusum(llr, limit=5.0).tolist()[-4:] == [1.0, 0.0, 0.0, 0.0]


def test_shiryaev_is_bayes_rule_over_all_histories(rng):
    # Enumerate every history of a two-state chain over five rows.
    llr, begin, end, prior = rng.normal(size=5), 0.1, 0.3, 0.2
    got = shiryaev(llr, begin=begin, end=end, prior=prior)
    step = np.array([[1 - begin, begin], [end, 1 - end]])
    for k in range(5):
        weight = np.zeros(2)
        for history in np.ndindex(*(2,) * (k + 2)):
            p = (prior if history[0] else 1 - prior) * np.prod([step[a, b] for a, b in pairwise(history)])
            weight[history[-1]] += p * np.exp(llr[: k + 1] @ np.array(history[1:]))
        assert abs(got[k] - weight[1] / weight.sum()) < 1e-12


def test_shiryaev_stands_extreme_ratios():
    p = shiryaev([0.0, -np.inf, 1e4, 0.0], begin=0.1)
    assert p[1] == 0.0 and p[2] == 1.0 and p[3] == 1.0
    assert shiryaev([-5.0], begin=0.0, prior=1.0)[0] == 1.0


def test_share_of_false_rows_among_those_in_alarm_is_what_the_posterior_says(rng):
    runs, rows, begin, end = 400, 400, 0.01, 0.05
    fault = np.zeros((runs, rows), bool)
    now = np.zeros(runs, bool)
    for k in range(rows):
        u = rng.uniform(size=runs)
        now = np.where(now, u >= end, u < begin)
        fault[:, k] = now
    llr = SHIFT * (rng.normal(size=fault.shape) + SHIFT * fault) - SHIFT**2 / 2
    p = shiryaev(llr, begin=begin, end=end)
    for low, high in ((0.2, 0.4), (0.5, 0.7), (0.9, 1.0)):
        inside = (p >= low) & (p < high)
        off = ((fault - p) * inside).sum(1)  # per run: rows within a run are correlated
        assert abs(off.mean()) < 5 * off.std() / np.sqrt(runs)
        assert inside.sum() > 500
    # A wrong law does not pass: fifty times as many faults claimed.
    off = (fault - shiryaev(llr, begin=0.5, end=end)).sum(1)
    assert abs(off.mean()) > 5 * off.std() / np.sqrt(runs)


def test_alarms_stand_until_released():
    level = np.array([0.0, 0.6, 0.9, 0.6, 0.4, 0.6, 0.9, 0.95])
    on = alarms(level, threshold=0.8, release=0.5)
    assert on.standing.tolist() == [False, False, True, True, False, False, True, True]
    assert np.flatnonzero(on.raised).tolist() == [2, 6]
    assert np.flatnonzero(alarms(level, threshold=0.8).standing).tolist() == [2, 6, 7]


@pytest.mark.parametrize("statistic", [cusum, lambda llr: shiryaev(llr, begin=0.01)])
@pytest.mark.parametrize("wanted", [30.0, 200.0])
def test_the_false_alarm_rate_obtained_is_the_one_asked_for(statistic, wanted):
    rows, runs = int(10 * wanted), 400
    found = calibrate(statistic(ratios(np.random.default_rng(1), runs, rows)), mean_time=wanted)
    fresh = statistic(ratios(np.random.default_rng(2), runs, rows))
    first = np.array([np.flatnonzero(run >= found.threshold)[:1].sum() + 1 for run in fresh])
    hit = (fresh >= found.threshold).any(axis=1)
    obtained = np.where(hit, first, rows).sum() / hit.sum()
    # Two independent exponential samples of about 400 alarms each: relative standard error sqrt(1/400 + 1/400).
    assert abs(obtained / wanted - 1) < 5 * np.sqrt(2 / hit.sum())
    assert found.low < wanted * 1.001 and found.high > wanted
    assert found.high / found.low < 1.3
    # ... and the test can tell: a threshold lower by one half.
    lower = (fresh >= found.threshold - 0.5 * (1 if found.threshold > 1 else 0.8)).argmax(axis=1).mean() + 1
    assert lower < wanted * (1 - 5 * np.sqrt(2 / hit.sum()))


def test_a_memoryless_level_has_a_geometric_time_to_alarm(rng):
    level = rng.normal(size=(2000, 200))
    found = calibrate(level, mean_time=50.0)
    # P(level >= h) = 1 / mean time; 2000 alarms, five standard errors
    assert abs(norm.sf(found.threshold) * 50.0 - 1) < 5 / np.sqrt(2000)


def test_mean_time_exceeds_the_bound_of_the_sum():
    quiet = cusum(ratios(np.random.default_rng(5), 300, 3000))
    assert calibrate(quiet, mean_time=200.0).threshold < np.log(200.0)


def test_delay_of_the_calibrated_alarm_and_threshold_for_a_delay():
    quiet = cusum(ratios(np.random.default_rng(3), 300, 2000))
    faulty = cusum(ratios(np.random.default_rng(4), 4000, 60, onset=20))
    by_rate = calibrate(quiet, faulty, onset=20, mean_time=200.0)
    assert by_rate.detected > 0.99
    by_delay = calibrate(quiet, faulty, onset=20, delay=by_rate.delay)
    assert abs(by_delay.threshold - by_rate.threshold) < 0.01
    quicker = calibrate(quiet, faulty, onset=20, delay=by_rate.delay - 2)
    assert quicker.delay <= by_rate.delay - 2 and quicker.mean_time < by_rate.mean_time
    # Direct count at the same threshold: runs that alarmed too soon left out, missed faults counted to the end.
    delays = []
    for run in faulty:
        over = np.flatnonzero(run >= by_rate.threshold)
        if not len(over) or over[0] >= 20:
            delays.append(over[0] - 20 if len(over) else 40)
    assert abs(np.mean(delays) - by_rate.delay) < 1e-12


def test_no_alarm_at_all_is_an_open_interval():
    quiet = np.zeros((10, 50))
    quiet[0, 0] = 1.0
    found = calibrate(quiet, np.full((2, 5), 2.0), delay=0.0)
    assert found.threshold == 2.0 and found.mean_time == found.high == np.inf and 100 < found.low < 500
    assert found.delay == 0.0 and found.detected == 1.0


def test_faults_behind_an_alarm_are_not_counted():
    faulty = np.ones((3, 10))
    found = calibrate(np.zeros((2, 10)), faulty, onset=5, delay=1.0)
    assert found.threshold == 1.0 and np.isnan(found.delay) and np.isnan(found.detected)


QUIET = np.zeros((2, 10))


@pytest.mark.parametrize(
    ("call", "kind", "message"),
    [
        (lambda: cusum(1.0), DataError, "llr needs a time axis"),
        (lambda: cusum([0.0, np.nan]), DataError, r"llr\[1\] is nan"),
        (lambda: shiryaev([np.inf], begin=0.1), DataError, r"llr\[0\] is inf"),
        (lambda: cusum([0.0], limit=0.0), ModelError, "limit must be positive"),
        (lambda: shiryaev([0.0], begin=1.5), ModelError, "begin must be a probability"),
        (lambda: alarms([0.0], threshold=1.0, release=2.0), ModelError, "release = 2.0 lies above"),
        (lambda: calibrate(QUIET), ModelError, "exactly one of mean_time"),
        (lambda: calibrate(QUIET, delay=1.0), ModelError, "needs simulated faults"),
        (lambda: calibrate(QUIET[0], mean_time=5.0), DataError, r"\(B, T\)"),
        (lambda: calibrate(QUIET, mean_time=21.0), DataError, "simulate more"),
        (lambda: calibrate(QUIET, mean_time=5.0, confidence=1.0), ModelError, "confidence"),
        (lambda: calibrate(QUIET, QUIET, onset=10, delay=1.0), ModelError, "onset = 10 is no row"),
        (lambda: calibrate(QUIET, np.eye(2), onset=0, delay=-1.0), ModelError, "no threshold detects"),
    ],
)
def test_wrong_arguments_are_named(call, kind, message):
    with pytest.raises(kind, match=message):
        call()
