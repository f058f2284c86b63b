"""The tracker fed in pieces, saved and restored: whatever the pieces, the same bytes."""

import copy
from itertools import pairwise

import numpy as np
import pytest
from tracking_scenes import fed, flights, measured, observed, polar_noise, tracker_of

from saltus.geo import Plane, Site
from saltus.simulate import Leg, Radar, Trajectory, observe
from saltus.tracks.rows import assignments, join_fates, join_rows


def radars(rng):
    """Two radars see turning aircraft, with clutter and faulty plots; some have addresses."""
    site = Site(float(np.radians(48.0)), float(np.radians(11.0)), 500.0)
    other = Site(float(np.radians(48.2)), float(np.radians(11.3)), 400.0)
    plane = Plane(site.latitude, site.longitude)
    pair = [
        Radar(place, period, 30.0, 1.4e-3, 10.0, clutter_per_scan=3.0) for place, period in ((site, 4.0), (other, 5.0))
    ]
    legs = (Leg(60.0), Leg(30.0, turn_rate=0.03), Leg(60.0))
    aircraft = [
        Trajectory(
            (*rng.uniform(-3e4, 3e4, 2).tolist(), 5000.0),
            float(rng.uniform(0.0, 6.28)),
            float(rng.uniform(120, 250)),
            legs,
        )
        for _ in range(12)
    ]
    seen = [observe(r, aircraft, plane, 0.0, 150.0, rng) for r in pair]
    codes = np.where(rng.random(12) < 0.5, np.arange(12) + 0xA0, -1).astype(np.int32)
    m, _ = observed(seen, pair, [polar_noise(r) for r in pair], plane, codes)
    wrong = rng.random(len(m)) < 0.05
    m.position[wrong, :2] += rng.normal(0.0, 600.0, (int(wrong.sum()), 2))
    return m, {"periods": (4.0, 5.0)}


def positions(rng):
    """Aircraft that report often and at times of their own, without addresses, and single reports among them."""
    time, xy = flights(rng.uniform(-2e3, 2e3, (8, 2)), rng.uniform(-60, 60, (8, 2)), np.arange(60.0))
    time = time + rng.uniform(-0.4, 0.4, len(time))
    clutter = 80
    time = np.concatenate([time, rng.uniform(0, 60, clutter)])
    xy = np.concatenate([xy + 5.0 * rng.standard_normal(xy.shape), rng.uniform(-4e3, 4e3, (clutter, 2))])
    return measured(time, xy, 5.0, altitude=rng.uniform(0.0, 300.0, len(time))), {"periods": (1.0,), "identity": False}


SCENES = {"radars": radars, "positions": positions}


def same(a, b):
    """Equal to the byte, NaN included."""
    for name in a._fields:
        x, y = getattr(a, name), getattr(b, name)
        if hasattr(x, "_fields"):
            same(x, y)
        else:
            assert x.dtype == y.dtype and x.tobytes() == y.tobytes(), name


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("chunk", [1, 7, 1000])
def test_pieces_of_any_size_give_the_same_bytes(name, chunk):
    m, options = SCENES[name](np.random.default_rng(3))
    whole, found = fed(tracker_of(m, **options), m)
    rows, raw = fed(tracker_of(m, **options), m, chunk)
    assert len(whole.time) > 300 and len(found.confirmed) > 5
    same(whole, rows)
    for a, b in zip(found[:4], raw[:4], strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(found.sources, raw.sources, strict=True):
        same(a.history, b.history)


@pytest.mark.parametrize("name", SCENES)
def test_a_tracker_restored_goes_on_as_if_nothing_had_been(name, rng):
    """At twenty moments, by a tracker that has seen nothing."""
    m, options = SCENES[name](np.random.default_rng(4))
    whole, found = fed(tracker_of(m, **options), m)
    cuts = [0, *np.sort(rng.choice(len(m), 20, replace=False)).tolist(), len(m)]
    tracker, parts = tracker_of(m, **options), []
    for begin, end in pairwise(cuts):
        state = copy.deepcopy(tracker.state())
        tracker.feed(
            m.take(np.arange(begin, min(begin + 200, len(m)))), until=np.inf
        )  # leave no trace in what was saved
        tracker = tracker_of(m, **options)
        tracker.restore(state)
        parts.append(tracker.feed(m.take(np.arange(begin, end)), until=np.inf if end == len(m) else -np.inf))
    same(whole, join_rows([p.rows for p in parts]))
    raw = assignments(m.plot, join_fates([p.fates for p in parts]), [p.confirmed for p in parts], tracker.conditions)
    for a, b in zip(found[:4], raw[:4], strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_is_not_complete_is_not_told(rng):
    """Four seconds of a radar make a slice; it is told when something later has come, and not before."""
    m, options = radars(rng)
    options = {**options, "periods": (4.0, 4.0)}
    tracker = tracker_of(m, **options)
    told = tracker.feed(m)
    width = 0.4 * 4.0
    last = m.time[np.isin(m.plot, told.fates.plot)].max()
    assert m.time[-1] - width - width < last < m.time[-1]
    rest = tracker.feed(m.take(np.zeros(0, int)), until=np.inf)
    assert len(told.fates.plot) < len(m)
    assert set(told.fates.plot) | set(rest.fates.plot) == set(m.plot.tolist())


def test_memory_does_not_grow_with_time(rng):
    """The same traffic for five minutes and for half an hour leaves a state of one size."""
    sizes = []
    for minutes in (5, 30):
        beat = np.arange(0.0, 60.0 * minutes, 4.0)
        tracks = [
            (beat + 0.1 * k, np.column_stack([5e3 * np.sin(beat / 100 + k), 5e3 * np.cos(beat / 100 + k)]))
            for k in range(5)
        ]
        clutter = rng.uniform(0.0, beat[-1], 3 * len(beat))
        time = np.concatenate([*(t for t, _ in tracks), clutter])
        xy = np.concatenate([*(p for _, p in tracks), rng.uniform(-2e4, 2e4, (len(clutter), 2))])
        m = measured(time, xy, 20.0)
        tracker = tracker_of(m, identity=False)
        for begin in range(0, len(m), 500):
            tracker.feed(m.take(np.arange(begin, min(begin + 500, len(m)))))
            tracker.drained()
        sizes.append(size(tracker.state()))
    assert sizes[1] < 1.5 * sizes[0]


def size(state):
    return sum(size(v) if isinstance(v, dict) else v.nbytes for v in state.values())
