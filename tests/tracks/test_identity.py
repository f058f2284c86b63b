"""Codes: an address settles, a Mode A code supports, and neither joins what contradicts."""

import numpy as np
import pytest
from tracking_scenes import flights, measured, run

from saltus.tracks.identity import conflicting, identity_gain

TIMES = 4.0 * np.arange(15)


def gain(track_icao=-1, plot_icao=-1, track_code=-1, plot_code=-1):
    return float(identity_gain(*(np.array([c]) for c in (track_icao, plot_icao, track_code, plot_code)))[0])


@pytest.mark.parametrize(
    ("a", "b", "expected"), [(5, 6, True), (5, 5, False), (-1, 6, False), (5, -1, False), (0, 1, True)]
)
def test_addresses_conflict_where_both_are_known_and_differ(a, b, expected):
    assert conflicting(np.array([a]), np.array([b])).tolist() == [expected]


def test_what_codes_add():
    assert gain() == 0.0
    assert gain(track_icao=7, plot_icao=7) > gain(track_code=0o1234, plot_code=0o1234) > 0.0
    assert np.isfinite(gain(track_code=0o1234, plot_code=0o4321))  # never impossible
    assert gain(track_code=0o1234, plot_code=0o4321) < 0.0
    assert gain(track_code=0o7000, plot_code=0o7000) == 0.0  # shared by many
    assert gain(track_code=0o1234) == gain(plot_code=0o1234) == 0.0
    assert gain(track_icao=7, plot_icao=7, track_code=1, plot_code=2) > 0.0  # an address outweighs a changed code


def crossing(rng, sigma, **codes):
    """Two targets side by side, 150 m apart, with noise as large: position alone cannot tell them."""
    time, xy = flights([[0.0, 0.0], [0.0, 150.0]], [[200.0, 0.0], [200.0, 0.0]], TIMES)
    xy = xy + rng.normal(0.0, sigma, xy.shape)
    return measured(time, xy, sigma, **codes)


def changes(track_id, target):
    """How often consecutive plots of a target lie on different tracks."""
    return sum(int((np.diff(track_id[target == t]) != 0).sum()) for t in np.unique(target))


@pytest.mark.parametrize("codes", [{"icao24": [5, 9]}, {"mode3a": [0o1234, 0o4321]}])
def test_codes_keep_neighbours_apart(rng, codes):
    target = np.repeat([0, 1], len(TIMES))
    column = {name: np.array(values)[target] for name, values in codes.items()}
    m = crossing(rng, 150.0, **column)
    order = np.argsort(flights([[0.0, 0.0], [0.0, 1.0]], [[1.0, 0.0]] * 2, TIMES)[0], kind="stable")
    with_codes = run(m)
    assert changes(with_codes.track_id, target[order]) == 0
    assert len(np.unique(with_codes.track_id)) == 2
    ignored = run(m, identity=False)
    assert changes(ignored.track_id, target[order]) > 0  # without codes they are exchanged
    assert (ignored.all_rows.icao24 == -1).all()
    assert (ignored.all_rows.mode3a == -1).all()


def test_different_addresses_never_share_a_track(rng):
    """A crowd of plots with addresses at random: whatever is joined, no track holds two."""
    n = 600
    m = measured(np.sort(rng.uniform(0, 60, n)), rng.uniform(-4e3, 4e3, (n, 2)), 200.0, icao24=rng.integers(-1, 6, n))
    found = run(m).raw.track_id
    several = 0
    for track in np.unique(found[found > 0]):
        codes = m.icao24[(found == track) & (m.icao24 >= 0)]
        assert len(np.unique(codes)) <= 1
        several += len(codes) > 2
    assert several >= 3  # there were tracks to go wrong
    ignored = run(m, identity=False).raw.track_id
    assert any(len(np.unique(m.icao24[(ignored == t) & (m.icao24 >= 0)])) > 1 for t in np.unique(ignored[ignored > 0]))


def test_an_address_is_one_tracks_and_a_plot_elsewhere_is_counted(rng):
    """Of two systems that put one address 20 km apart, the one heard first keeps the track."""
    time, xy = flights([[0.0, 50e3], [20e3, 50e3]], [[200.0, 50.0], [200.0, 50.0]], TIMES)
    address = np.full(len(time), 0x3C6444)
    found = run(measured(time, xy + rng.normal(0, 20, xy.shape), 20.0, icao24=address))
    live = [set(found.rows.track_id[found.rows.time == t]) for t in TIMES]
    assert max(len(ids) for ids in live) == 1
    assert found.raw.elsewhere.sum() >= len(TIMES) - 4
    assert not (found.raw.elsewhere & (found.raw.track_id > 0)).any()


def test_a_code_that_changes_in_flight_leaves_the_track_whole(rng):
    time, xy = flights([[0.0, 50e3]], [[200.0, 50.0]], TIMES)
    code = np.where(np.arange(len(TIMES)) < 7, 0o1234, 0o4321)
    found = run(measured(time, xy + rng.normal(0, 20, xy.shape), 20.0, mode3a=code))
    assert len(np.unique(found.track_id)) == 1
    assert found.track_id[0] > 0
    assert found.rows.mode3a[-1] == 0o4321  # the code is the newest one heard


def test_plots_without_an_address_join_a_track_with_one(rng):
    time, xy = flights([[0.0, 50e3]], [[200.0, 50.0]], TIMES)
    address = np.where(np.arange(len(TIMES)) % 3 == 1, -1, 0x3C6444)
    found = run(measured(time, xy + rng.normal(0, 20, xy.shape), 20.0, icao24=address))
    assert len(np.unique(found.track_id)) == 1
    assert (found.rows.icao24 == 0x3C6444).all()
