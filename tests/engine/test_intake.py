"""The intake: reports in order of time whatever the order and the pieces they come in; wild clocks told and refused."""

import copy
from itertools import pairwise

import numpy as np
import pytest

from saltus.engine.arrays import flattened, from_table, nested, to_table
from saltus.engine.intake import Intake
from saltus.engine.stretch import Stretch
from saltus.records import REASONS, Plots, Source, System
from saltus.tracks.setup_settings import IntakeSettings, SetupSettings

SOURCES = tuple(Source(System(None, None, None, name)) for name in "abc")
LATE, JUMP = REASONS.index("out of order"), REASONS.index("clock jump")


def reports(time, source=0):
    time = np.asarray(time, float)
    return Plots.build(len(time), SOURCES, ("f",), {"time": time, "source": np.broadcast_to(source, len(time))})


def through(intake, plots, cuts):
    """Everything let go and refused when the reports come in pieces: numbers in order, times, refused by reason."""
    number, time, refused = [], [], {}
    edges = [0, *cuts, len(plots)]
    for begin, end in pairwise(edges):
        told = [intake.add(plots.take(slice(begin, end)), np.arange(begin, end))]
        told += [intake.end(plots)] if end == len(plots) else []
        for part in told:
            number += part.number.tolist()
            time += part.plots.time.tolist()
            refused |= dict(zip(part.refused.tolist(), part.reason.tolist(), strict=True))
    return number, time, refused


def test_reports_are_let_go_in_order_of_time(rng):
    """Each up to 2 s late: none is lost, and all come out sorted, whatever the pieces."""
    time = np.arange(300) * 0.1
    arrival = np.argsort(time + rng.uniform(0.0, 1.9, 300), kind="stable")
    plots = reports(time[arrival])
    whole = through(Intake(IntakeSettings()), plots, [])
    assert whole[1] == sorted(time.tolist()) and not whole[2]
    for cuts in ([150], list(range(1, 300)), sorted(rng.choice(299, 20, replace=False) + 1)):
        assert through(Intake(IntakeSettings()), plots, cuts) == whole


def test_what_comes_later_than_the_hold_is_out_of_order():
    """At 10 s, reports of 7.9 s are too late and those of 8.1 s are not."""
    number, time, refused = through(Intake(IntakeSettings()), reports([0.0, 10.0, 8.1, 7.9, 11.0]), [])
    assert time == [0.0, 8.1, 10.0, 11.0] and number == [0, 2, 1, 4]
    assert refused == {3: LATE}


def test_the_hold_and_what_a_leap_is_are_settings():
    time = [0.0, 10.0, 8.1, 7.9, *np.arange(100.0, 104.0)]
    patient = IntakeSettings(hold=3.0, wild=200.0)
    assert through(Intake(patient), reports(time), [])[1:] == (sorted(time), {})
    quick = IntakeSettings(wild=50.0, for_good=4)
    _number, out, refused = through(Intake(quick), reports(time), [])
    assert refused == {3: LATE} and out[-4:] == [100.0, 101.0, 102.0, 103.0]
    slow = Intake(IntakeSettings(wild=50.0, for_good=5))
    assert slow.add(reports([0.0]), np.array([0])) is not None
    assert not len(slow.add(reports(time[4:]), np.arange(1, 5)).plots)  # in doubt: a fifth would settle it


@pytest.mark.parametrize("cuts", [[], [15], list(range(1, 43))])
def test_one_wild_time_is_a_jump_and_a_clock_that_leaps_for_good_is_followed(cuts):
    time = [*np.arange(20.0), 5000.0, *np.arange(20.0, 24.0), *np.arange(900.0, 918.0)]
    intake = Intake(IntakeSettings())
    _, out, refused = through(intake, reports(time), cuts)
    assert refused == {20: JUMP}
    assert out == [*np.arange(24.0), *np.arange(900.0, 918.0)]
    (leap,) = intake.leaps
    assert (leap.source, leap.before, leap.after, leap.followed) == (0, 23.0, 900.0, True)


@pytest.mark.parametrize("cuts", [[], list(range(1, 60))])
def test_a_clock_that_leaps_while_others_go_on_is_not_followed(cuts):
    """Source 1 is an hour ahead from 10 s on; source 0 goes on: nothing of it is lost."""
    time = np.repeat(np.arange(30.0), 2) + np.tile([0.0, 0.5], 30)
    source = np.tile([0, 1], 30)
    time[(source == 1) & (time > 10)] += 3600.0
    intake = Intake(IntakeSettings())
    _, out, refused = through(intake, reports(time, source), cuts)
    assert set(refused) == set(np.flatnonzero(time > 3000).tolist()) and set(refused.values()) == {JUMP}
    assert out == np.sort(time[time < 3000]).tolist()
    assert all(not leap.followed and leap.source == 1 for leap in intake.leaps) and len(intake.leaps) == 2


def test_an_intake_restored_goes_on(rng):
    time = np.concatenate([np.arange(30.0) + rng.uniform(0, 1.5, 30), np.arange(900.0, 920.0)])
    plots = reports(time)
    whole = through(Intake(IntakeSettings()), plots, [])
    for cut in (7, 29, 35, 44):
        first = Intake(IntakeSettings())
        told = first.add(plots.take(slice(0, cut)), np.arange(cut))
        state = nested(dict(flattened(copy.deepcopy(first.state()))))
        second = Intake(IntakeSettings())
        second.restore(state, plots)
        rest = [second.add(plots.take(slice(cut, None)), np.arange(cut, len(plots))), second.end(plots)]
        assert [*told.number, *rest[0].number, *rest[1].number] == whole[0]


@pytest.mark.parametrize("chunk", [1, 777, 100_000])
def test_the_first_stretch_ends_when_every_source_gave_enough(chunk):
    """A gives twenty reports a second, B one: 60 s end it, or six times that; alone, A's 500th does."""
    a, b = np.arange(0.0, 420.0, 0.05), np.arange(0.1, 420.0, 1.0)
    both = np.concatenate([a, b]), np.repeat([0, 1], [len(a), len(b)])
    leap = np.where(both[0] > 20.0, 1e6, 0.0)  # a gap counts as a minute
    for time, source, length, fewest in (
        (a, np.zeros(len(a), int), 500, 1),
        (*both, 1201 + 60, 60),
        (*both, 7201 + 360, 61_000),
        (both[0] + leap, both[1], 401 + 20 + 1, 20),
    ):
        order = np.argsort(time, kind="stable")
        plots, taken, stretch = reports(time[order], source[order]), 0, Stretch(SetupSettings(500, 60.0, fewest))
        for begin in range(0, len(plots), chunk):
            part = plots.take(slice(begin, begin + chunk))
            stop = stretch.add(part, np.arange(begin, begin + len(part)))
            taken += min(stop, len(part))
            if stop <= len(part):
                break
        assert taken == length == len(stretch.collected()[0])


def test_arrays_survive_a_table_to_the_byte(rng):
    columns = {
        "a": rng.standard_normal((5, 2, 3)),
        "b": np.array([np.nan, np.inf, -0.0, 1.0, 2.0]),
        "c": np.arange(5, dtype=np.int16),
        "d": np.array(["", "DLH1", "é", "x", ""], "U8"),
        "e": np.array([True, False, True, True, False]),
    }
    for part in (slice(0, 5), slice(0, 0)):
        some = {name: values[part] for name, values in columns.items()}
        found = from_table(to_table(some))
        for name, values in some.items():
            assert found[name].dtype == values.dtype and found[name].shape == values.shape
            assert found[name].tobytes() == values.tobytes()
