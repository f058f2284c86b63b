"""Bounds from weighted draws of near objects, against plain draws and against the identity of likelihood ratios."""

import numpy as np
import pytest

from saltus import DataError, ModelError
from saltus.identify import (
    DIFFERENT,
    SAME,
    PairSettings,
    Schedule,
    different_pairs,
    false_ratios,
    filled,
    pair_ratios,
    same_pairs,
    sprt,
    wide_spreads,
)

TURNING = PairSettings(
    accel=(0.5, 5.0), sojourn=(40.0, 10.0), offset_cov=100.0 * np.eye(2), region_cov=1e6 * np.eye(2), speed_sigma=60.0
)
STEADY = PairSettings(accel=(0.5,), sojourn=(1.0,), region_cov=4e6 * np.eye(2), speed_sigma=60.0)
SCHEDULE = Schedule.of(
    [0.0, 0.7, 4.0, 4.7, 8.0], [1, 0, 1, 0, 1], [2500.0 * np.eye(2), [[900.0, 200.0], [200.0, 400.0]]]
)


def ratios_of(draws, settings):
    pairs = np.repeat(np.arange(len(draws.weight))[:, None], 2, axis=1)
    return filled(pair_ratios(draws.a, draws.b, pairs, settings))


@pytest.fixture(scope="module")
def plain():
    rng = np.random.default_rng(3)
    draws = different_pairs(SCHEDULE, TURNING, 60_000, rng, np.zeros((0, 4, 4)))
    assert (draws.weight == 1.0).all()
    return ratios_of(draws, TURNING)


@pytest.mark.parametrize("p_false", [1e-1, 1e-2, 1e-3])
def test_plain_pairs_reach_a_bound_as_often_as_asked(plain, p_false):
    """Of multimode ratios; both the bound and the count are estimates, and 5 standard errors of the two are allowed."""
    found = false_ratios(SCHEDULE, TURNING, draws=20_000, seed=1)
    bound = found.bound(p_false)
    stated, error = found.probability(bound)
    assert stated <= p_false and stated == pytest.approx(p_false, rel=0.01)
    observed = (plain[:, -1] >= bound).mean()
    assert abs(observed - p_false) < 5.0 * np.hypot(error, np.sqrt(p_false / len(plain)))
    assert error < 0.06 * p_false, "the draws are no better than plain ones"


def test_a_rare_probability_is_the_mean_of_inverse_ratios_of_one_object():
    """P(llr >= c | two) = E[exp(-llr); llr >= c | one], exact for one mode, where the filter is."""
    found = false_ratios(SCHEDULE, STEADY, draws=20_000, seed=2)
    one = ratios_of(same_pairs(SCHEDULE, STEADY, 20_000, np.random.default_rng(4)), STEADY)[:, -1]
    for p_false in (1e-4, 1e-5):
        bound = found.bound(p_false)
        inverse = np.exp(-one) * (one >= bound)
        error = np.hypot(found.probability(bound)[1], inverse.std() / np.sqrt(len(one)))
        assert abs(inverse.mean() - p_false) < 5.0 * error and error < 0.1 * p_false


def test_weights_are_those_of_the_region():
    """Their mean is 1, and so is the mean of any function of the state over that under the law drawn from."""
    draws = different_pairs(SCHEDULE, STEADY, 40_000, np.random.default_rng(5), wide_spreads(SCHEDULE, STEADY))
    assert draws.weight.max() <= 10.0
    assert abs(draws.weight.mean() - 1.0) < 5.0 * draws.weight.std() / 200.0
    apart = draws.weight * draws.apart[:, 1] ** 2  # both 60 m/s, and nearly so 0.7 s later
    assert abs(apart.mean() - 2 * 60.0**2) < 5.0 * apart.std() / 200.0


def test_the_sequential_test_keeps_its_promise_in_several_modes(plain):
    one = ratios_of(same_pairs(SCHEDULE, TURNING, 4000, np.random.default_rng(6)), TURNING)
    p_false, p_missed = 1e-2, 5e-2
    wrong = (sprt(plain, p_false=p_false, p_missed=p_missed).verdict == SAME).mean()
    missed = (sprt(one, p_false=p_false, p_missed=p_missed).verdict == DIFFERENT).mean()
    assert wrong < p_false / (1 - p_missed) and missed < p_missed / (1 - p_false)


def test_equal_schedules_are_simulated_once():
    again = Schedule.of(np.array(SCHEDULE.times), np.array(SCHEDULE.system), [np.array(r) for r in SCHEDULE.R])
    copy = PairSettings(accel=(0.5,), sojourn=(1.0,), region_cov=4e6 * np.eye(2), speed_sigma=60.0)
    assert false_ratios(SCHEDULE, STEADY, draws=300, seed=1) is false_ratios(again, copy, draws=300, seed=1)
    assert false_ratios(SCHEDULE, STEADY, draws=300, seed=2) is not false_ratios(again, copy, draws=300, seed=1)


def test_what_cannot_be_told_is_refused():
    with pytest.raises(DataError, match="Take more draws"):
        false_ratios(SCHEDULE, STEADY, draws=300, seed=1).bound(1e-12)
    with pytest.raises(ModelError, match="p_false"):
        false_ratios(SCHEDULE, STEADY, draws=300, seed=1).bound(0.0)
    with pytest.raises(ModelError, match="draws"):
        false_ratios(SCHEDULE, STEADY, draws=1, seed=1)
    for times, system in (([1.0, 0.0], [0, 1]), ([0.0, 1.0], [0, 0]), ([0.0], [0, 1])):
        with pytest.raises(DataError):
            Schedule.of(times, system, [np.eye(2), np.eye(2)])
    with pytest.raises(DataError, match=r"\(2, 2\)"):
        Schedule.of([0.0, 1.0], [0, 1], [np.eye(2), np.eye(3)])
