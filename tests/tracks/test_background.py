"""Where clutter and new targets are expected: against counting by hand, and what the tracker makes of it."""

from dataclasses import replace

import numpy as np
import pytest
from tracking_scenes import measured, run

from saltus.tracks.background import densities, learn_background

CELL, LAYER = 500.0, 50.0


def background(m, periods):
    """The densities at measurements, looked up in maps made of themselves."""
    polar = [bool(np.isfinite(m.ray[m.source == s]).all()) for s in range(len(periods))]
    return densities(m, [learn_background(m, s, float(p), polar=polar[s]) for s, p in enumerate(periods)])


def counted(m, source, share, period):
    """The definition, plot by plot: others per scan in the square, and the density of heights there."""
    own = np.flatnonzero(m.source == source)
    square = np.floor(m.position[own, :2] / CELL)
    layer = np.floor(m.position[own, 2] / LAYER)
    time = np.floor((m.time[own] - m.time[own].min()) / (share * period))
    others, height = [], []
    for k in range(len(own)):
        near = (np.abs(square - square[k]) <= 1).all(axis=1)
        _, number = np.unique(time[near], return_counts=True)
        others.append((number * (number - 1)).sum() / number.sum() / (1.0 if share > 0.5 else share))
        known = near & np.isfinite(layer)
        beside = (np.abs(layer[known] - layer[k]) <= 1).sum() if np.isfinite(layer[k]) else 0
        height.append(beside / max(known.sum(), 1) / (3 * LAYER))
    return own, np.array(others) / (3 * CELL) ** 2, np.array(height)


@pytest.mark.parametrize("rotating", [False, True])
def test_plots_around_are_counted(rng, rotating):
    """Two sources of other periods, negative coordinates, some plots without height."""
    n = 400
    height = np.where(rng.random(n) < 0.3, np.nan, rng.uniform(-200.0, 600.0, n))
    xy, source = 2e3 * rng.standard_normal((n, 2)), rng.integers(0, 2, n)
    m = measured(rng.uniform(0.0, 40.0, n), xy, 5.0, altitude=height, source=source)
    if rotating:
        m = replace(m, ray=xy)
    periods = np.array([4.0, 1.0])
    found = background(m, periods)
    for source, period in enumerate(periods.tolist()):
        own, near, heights = counted(m, source, 0.9 if rotating else 0.4, period)
        flat = m.density(source, period)
        np.testing.assert_allclose(found.plane[own], 0.1 * flat + 0.05 * near, rtol=1e-12)
        known = np.isfinite(m.position[own, 2])
        both = (0.1 * flat / 15e3 + 0.05 * near * heights) / (0.1 * flat + 0.05 * near)
        np.testing.assert_allclose(found.height[own], np.where(known, both, 1 / 15e3), rtol=1e-12)
        assert near.max() > flat and near.min() == 0


def test_a_uniform_scene_has_the_flat_density(rng):
    """40 000 plots over 100 km by 100 km, one in a square of 1.5 km every eleven scans: known to some percent."""
    n = 40_000
    m = measured(np.linspace(0.0, 400.0, n), rng.uniform(-5e4, 5e4, (n, 2)), 5.0)
    inner = np.abs(m.position[:, :2]).max(axis=1) < 4.5e4
    near = background(m, np.array([4.0])).plane[inner] - 0.1 * m.density(0, 4.0)
    assert near.mean() == pytest.approx(0.05 * n / 100.0 / 1e10, rel=0.1)


def test_what_reports_frame_by_frame_has_no_more_others_in_a_scan(rng):
    """A camera's pictures: 400 targets at one time, every 4 s. The others are 399 and not 2.5 times as many."""
    place, beat = rng.uniform(-5e3, 5e3, (400, 2)), np.repeat(4.0 * np.arange(20), 400)
    m = measured(beat, np.tile(place, (20, 1)), 5.0)
    inner = np.abs(m.position[:, :2]).max(axis=1) < 4e3
    near = background(m, np.array([4.0])).plane[inner] - 0.1 * m.density(0, 4.0)
    assert near.mean() == pytest.approx(0.05 * 400 / 1e8, rel=0.15)


def test_a_lone_target_is_none_of_its_own_others():
    m = measured(np.arange(100.0), np.zeros((100, 2)), 5.0, altitude=300.0)
    found = background(m, np.array([1.0]))
    np.testing.assert_allclose(found.plane, 0.1 * m.density(0, 1.0))
    np.testing.assert_allclose(found.height, 1 / 15e3)


def apron(rng, n=120):
    """Aircraft parked 300 m apart, 300 km of airspace; one of them misses plots while another begins 200 m off."""
    parked = np.stack(np.meshgrid(np.arange(5) * 300.0, np.arange(4) * 400.0), axis=-1).reshape(-1, 2)
    beat = np.arange(float(n))
    cruising = np.column_stack([-150e3 + 200.0 * beat, np.full(n, 140e3)])
    rows = [(beat + 0.01 * k, np.tile(p, (n, 1))) for k, p in enumerate(parked)]
    rows[0] = (rows[0][0][(beat < 40) | (beat > 48)], rows[0][1][(beat < 40) | (beat > 48)])
    new = beat[beat >= 41] + 0.3
    rows += [(beat + 0.5, cruising), (beat + 0.5, -cruising), (new, np.tile([-190.0, 60.0], (len(new), 1)))]
    time, xy = (np.concatenate(column) for column in zip(*rows, strict=True))
    label = np.repeat(np.arange(len(rows)), [len(t) for t, _ in rows])
    order = np.argsort(time, kind="stable")
    m = measured(time, xy + rng.standard_normal(xy.shape), 1.0)
    return m, label[order]


def test_a_new_target_among_others_is_nobodys_faulty_plot(rng):
    """Where targets are, others appear: the neighbour that misses plots takes none of the new one's."""
    m, label = apron(rng)
    found = run(m, periods=(1.0,), identity=False)
    new = found.track_id[label == label.max()]
    assert len(np.unique(new)) == 1 and new[0] > 0
    assert not np.isin(new[0], found.track_id[label != label.max()])


def test_faulty_plots_of_a_target_begin_no_track(rng):
    """Every other plot of a lone target is faulty, at one place: right ones come two periods apart, none is surplus."""
    beat = np.arange(40.0)
    xy = np.where((beat % 2 == 1)[:, None] & (beat > 20)[:, None], [60.0, 20.0], [0.0, 0.0])
    far = np.column_stack([-150e3 + 200.0 * beat, np.full(40, 140e3)])
    m = measured(np.tile(beat, 2), np.concatenate([xy, far]) + rng.standard_normal((80, 2)), 1.0)
    found = run(m, periods=(1.0,), identity=False)
    lone = np.hypot(*m.position[:, :2].T) < 1e3
    assert len(np.unique(found.track_id[lone])) == 1


def test_a_target_beside_a_lone_one_is_more_than_its_faulty_plots(rng):
    """Half a period after each right plot of the first comes one 130 m off, nearer than any other target.

    The first gives one plot a second. What it takes as faulty in between begins a track of its own.
    """
    n = 40
    beat = np.arange(float(n))
    rows = [
        (beat, np.zeros((n, 2))),
        (beat[10:] + 0.5, np.tile([90.0, 90.0], (n - 10, 1))),
        (beat + 0.2, np.column_stack([-150e3 + 200.0 * beat, np.full(n, 140e3)])),
    ]
    time, xy = (np.concatenate(column) for column in zip(*rows, strict=True))
    label = np.repeat(np.arange(len(rows)), [len(t) for t, _ in rows])[np.argsort(time, kind="stable")]
    m = measured(time, xy + rng.standard_normal(xy.shape), 1.0, altitude=4.0, sigma_altitude=7.0)
    found = run(m, periods=(1.0,), identity=False)
    first, beside = found.track_id[label == 0], found.track_id[label == 1]
    assert len(np.unique(first)) == 1
    assert beside[0] == first[0]  # rare as a faulty plot is, another target here is rarer, and nothing else is known
    assert len(np.unique(beside[2:])) == 1 and 0 < beside[-1] != first[0]
