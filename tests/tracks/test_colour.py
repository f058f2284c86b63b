"""Errors that last as states of the tracks: against the joint law of all reports, and who gets a state."""

from dataclasses import replace

import numpy as np
import pytest
from tracking_scenes import measured

from saltus.tracks.channel import Start
from saltus.tracks.colour import NO_SOURCE, Colour, Colours
from saltus.tracks.faults import SourceCondition, plot_law
from saltus.tracks.gates import Gate
from saltus.tracks.kinematics import Chosen, make_kinematics
from saltus.tracks.lifecycle import Birth, Lifecycle
from saltus.tracks.measurements import Measurements
from saltus.tracks.settings import FilterSettings, TrackerSettings
from saltus.tracks.starts import Starts, erring

Q = 0.3  # m^2/s^3
ONE_MODE = FilterSettings(
    accel_h=(float(np.sqrt(Q)),), sojourn_h=(1.0,), turn_rate=(), accel_v=(0.1,), sojourn_v=(1.0,), accel_time=1.0
)
SETTINGS = TrackerSettings(plot_outlier=0.0, degraded_noise=1.0)
SOURCES = [Colour(2, 20.0), Colour(1, 5.0), Colour(0)]
L = [np.eye(2) * 12.0, np.array([[3.0, 0.0], [-6.0, 0.0]]), np.zeros((2, 2))]
WHITE = 2.0
TIMES = np.array([1.0, 1.5, 2.5, 4.0, 4.2, 7.0, 11.0, 12.0])
SOURCE = np.array([0, 1, 0, 2, 1, 0, 1, 0])


def reports(time, source, xy):
    """Reports whose lasting errors are L of their source, and the rest WHITE."""
    m = measured(time, xy, WHITE, source=source)
    lasting = np.array(L)[m.source]
    cov = m.cov.copy()
    cov[:, :2, :2] += lasting @ lasting.swapaxes(1, 2)
    return replace(m, cov=cov, lasting=lasting)


def followed(m: Measurements, start: Start, colours=SOURCES, settings=SETTINGS):
    """One track through all reports, which are known to be its own: its last moments."""
    kinematics, life = make_kinematics(ONE_MODE, colours, settings), Lifecycle(settings)
    rows = kinematics.add(start)
    life.begin(rows, Birth(np.zeros(1), np.ones(1), np.zeros(1, np.int64), start.mean[:, :6], start.cov[:, :6, :6]))
    gate = Gate(settings, ONE_MODE, np.ones(len(colours)), use_identity=False)
    for k in range(len(m)):
        source = SourceCondition(plot_law(settings, 0), settings)
        plot = np.array([k])
        gated = gate.given(kinematics, life, m, rows, plot, source, np.zeros((1, 3, 3)))
        kinematics.absorb(rows, gated.copies, Chosen.sure(gated.copy, gated.plan, gated.covs[:, 0]))
        moments = kinematics.moments(rows)
        life.hit(rows, m.time[plot], np.ones(1), plot)
        life.mean[rows], life.cov[rows] = moments.mean, moments.cov
    return moments


def joint_law(times, source, z, mean, cov, *, white=False):
    """Mean and covariance of (x, vx, y, vy) at the last time given all reports, by one big Gaussian.

    `white`: no error lasts, whatever its size.
    """
    t, n = np.append(0.0, times), len(times)
    F, W = np.zeros((n + 1, 4, 4)), np.zeros((n + 1, n + 1, 4, 4))  # from time 0 on, and covariance of what noise adds
    for i in range(n + 1):
        F[i] = np.kron(np.eye(2), [[1.0, t[i]], [0.0, 1.0]])
        for j in range(n + 1):
            s, r = min(t[i], t[j]), abs(t[i] - t[j])
            one = np.array([[s**3 / 3 + r * s**2 / 2, s**2 / 2 + r * s], [s**2 / 2, s]])
            W[i, j] = Q * np.kron(np.eye(2), one if t[i] >= t[j] else one.T)
    X = np.einsum("iab,bc,jdc->iajd", F, cov, F) + W.transpose(0, 2, 1, 3)
    H = np.kron(np.eye(2), [[1.0, 0.0]])
    Z = np.einsum("ma,iajd,nd->imjn", H, X[1:, :, 1:], H)
    for i in range(n):
        for j in range(n):
            if source[i] == source[j]:
                tau = SOURCES[source[i]].time
                a = float(i == j) if white else np.exp(-abs(times[i] - times[j]) / tau)
                Z[i, :, j] += a * L[source[i]] @ L[source[j]].T
        Z[i, :, i] += WHITE**2 * np.eye(2)
    cross = np.einsum("ajd,nd->ajn", X[-1][:, 1:], H).reshape(4, 2 * n)
    gain = np.linalg.solve(Z.reshape(2 * n, 2 * n), cross.T).T
    nu = (z - (F[1:] @ mean) @ H.T).ravel()
    return F[-1] @ mean + gain @ nu, X[-1, :, -1] - gain @ cross.T


@pytest.fixture
def begun(rng):
    """One track's start, and reports of three sources about it."""
    a = rng.normal(size=(4, 4))
    mean, cov = rng.normal(0, 30, 4), 200.0 * (a @ a.T + np.eye(4))
    z = mean[::2] + TIMES[:, None] * mean[1::2] + rng.normal(0, 15, (len(TIMES), 2))
    whole, wide = np.zeros((1, 6)), np.zeros((1, 6, 6))
    whole[0, :4], wide[0, :4, :4], wide[0, 4:, 4:] = mean, cov, np.eye(2)
    return mean, cov, z, Start(whole, wide)


def test_tracks_with_states_for_them_have_the_joint_law_of_all_reports(begun):
    mean, cov, z, start = begun
    found = followed(reports(TIMES, SOURCE, z), start)
    expected, spread = joint_law(TIMES, SOURCE, z, mean, cov)
    np.testing.assert_allclose(found.mean[0, :4], expected, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found.cov[0, :4, :4], spread, rtol=1e-8, atol=1e-8)


def test_without_states_they_are_noise_of_each_report(begun):
    mean, cov, z, start = begun
    found = followed(reports(TIMES, SOURCE, z), start, settings=replace(SETTINGS, lasting_states=0))
    expected, spread = joint_law(TIMES, SOURCE, z, mean, cov, white=True)
    np.testing.assert_allclose(found.mean[0, :4], expected, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found.cov[0, :4, :4], spread, rtol=1e-8, atol=1e-8)
    inflated = [c._replace(inflation=5.0) for c in SOURCES]
    wide = followed(reports(TIMES, SOURCE, z), start, inflated, replace(SETTINGS, lasting_states=0))
    assert np.linalg.eigvalsh(wide.cov[0, :4, :4] - spread).min() > 0.0  # so many reports tell less


@pytest.mark.parametrize("first", [0, 1, 2])
def test_two_plots_begin_a_track_as_an_even_prior_does(first, rng):
    """With hardly a prior, the two-point start is the joint law of its two plots, lasting errors among the states."""
    times, source = np.array([3.0, 4.0]), np.array([first, 0])
    m = reports(times, source, rng.normal(0, 40, (2, 2)))
    kinematics = make_kinematics(ONE_MODE, SOURCES, SETTINGS)
    fast = replace(SETTINGS, max_speed=1e6)
    still = FilterSettings(accel_h=(1e-9,), sojourn_h=(1.0,), turn_rate=(), accel_v=(1e-9,), sojourn_v=(1.0,))
    begins = Starts(fast, still, 10.0)
    start = begins.of_two(m.take(np.array([0])), times[:1], m, np.array([1]), kinematics.colours)
    later, wide = np.array([3.0, 4.0, 4.5, 6.0]), np.array([first, 0, first, 0])
    z = np.vstack([m.position[:, :2], rng.normal(0, 40, (2, 2))])
    vague = 1e8 * np.eye(4)
    expected, spread = joint_law(later - 3.0, wide, z, np.zeros(4), vague)
    rest = reports(later[2:] - 4.0, wide[2:], z[2:])
    rows = kinematics.add(start)
    life = Lifecycle(SETTINGS)
    life.begin(rows, Birth(np.zeros(1), np.ones(1), np.zeros(1, np.int64), start.mean[:, :6], start.cov[:, :6, :6]))
    gate = Gate(SETTINGS, ONE_MODE, np.ones(3), use_identity=False)
    kinematics.colours.heard[rows] = np.where(kinematics.colours.owner[rows] == NO_SOURCE, -np.inf, 0.0)
    for k in range(2):
        law = SourceCondition(plot_law(SETTINGS, 0), SETTINGS)
        gated = gate.given(kinematics, life, rest, rows, np.array([k]), law, np.zeros((1, 3, 3)))
        kinematics.absorb(rows, gated.copies, Chosen.sure(gated.copy, gated.plan, gated.covs[:, 0]))
        life.hit(rows, rest.time[[k]], np.ones(1), np.array([k]))
    found = kinematics.moments(rows)
    # What the target did between the two plots is not in the start: a little, and to a share of the deviations.
    np.testing.assert_allclose(found.mean[0, :4], expected, atol=0.15 * np.sqrt(np.diag(spread)).max())
    np.testing.assert_allclose(np.sqrt(np.diag(found.cov[0, :4, :4])), np.sqrt(np.diag(spread)), rtol=0.06)


def test_a_source_takes_what_is_free_and_never_what_another_may_come_back_to():
    table = Colours([Colour(2, 10.0), Colour(2, 10.0), Colour(1, 2.0)], TrackerSettings(lasting_states=3))
    assert table.slots == 3
    row = table.empty(1)
    row.claim(0, np.array([0.0]))
    row.claim(1, np.array([1.0]))  # two are wanted and one is left
    row.claim(2, np.array([1.0]))
    assert row.owner.tolist() == [[0, 0, 2]]
    row.claim(1, np.array([12.0]))  # of 2 nothing is known any more, of 0 there is
    assert row.owner.tolist() == [[0, 0, NO_SOURCE]]
    before = row.owner.copy()
    row.claim(1, np.array([51.0]))
    assert row.owner.tolist() == [[1, 1, NO_SOURCE]]
    np.testing.assert_array_equal(row.fade(np.array([1.0]), before), 0.0)  # what was known of 0 is not of 1
    np.testing.assert_allclose(row.fade(np.array([1.0]), row.owner)[0, :2], np.exp(-0.1))
    np.testing.assert_array_equal(row.carried(0, np.eye(2)[None]), np.zeros((1, 2, 2)))
    np.testing.assert_array_equal(row.carried(1, np.eye(2)[None]), np.eye(2)[None])


def test_rows_keep_their_states_when_a_further_source_errs_with_memory(begun):
    start = begun[3]
    kinematics = make_kinematics(ONE_MODE, SOURCES[1:], SETTINGS)
    rows = kinematics.add(start)
    before = kinematics.moments(rows)
    wider = kinematics.adopt([*SOURCES[1:], Colour(2, 30.0)], SETTINGS)
    assert (kinematics.colours.slots, wider.colours.owner.shape[1]) == (3, 3)
    np.testing.assert_array_equal(wider.moments(rows).cov, before.cov)
    ahead = wider.predicted(rows, np.ones(1), 2, np.ones(1)).mixture(np.arange(1))
    np.testing.assert_allclose(ahead[1][0, 6:, 6:], np.eye(3))
    np.testing.assert_array_equal(ahead[1][0, :6, 6:], 0.0)


@pytest.mark.parametrize("reported", [2, 10, 60])
def test_a_state_handed_on_errs_as_the_reports_it_came_from(reported):
    """Cross covariances that `erring` makes of the motion's alone, against those of the filter that had them."""
    times = np.arange(reported) + 1.0
    m = reports(times, np.zeros(reported), np.zeros((reported, 2)))
    kinematics = make_kinematics(ONE_MODE, SOURCES, SETTINGS)
    begins = Starts(replace(SETTINGS, max_speed=1e4), ONE_MODE, 10.0)
    start = begins.of_two(m.take(np.array([0])), times[:1], m, np.array([1]), kinematics.colours)
    rows, life = kinematics.add(start), Lifecycle(SETTINGS)
    life.begin(rows, Birth(times[1:2], np.ones(1), np.zeros(1, np.int64), start.mean[:, :6], start.cov[:, :6, :6]))
    gate = Gate(SETTINGS, ONE_MODE, np.ones(3), use_identity=False)
    for k in range(2, reported):
        law = SourceCondition(plot_law(SETTINGS, 0), SETTINGS)
        gated = gate.given(kinematics, life, m, rows, np.array([k]), law, np.zeros((1, 3, 3)))
        kinematics.absorb(rows, gated.copies, Chosen.sure(gated.copy, gated.plan, gated.covs[:, 0]))
        life.hit(rows, m.time[[k]], np.ones(1), np.array([k]))
    mean, cov = kinematics.mixture(rows)
    motion = Start(mean[:, :6], cov[:, :6, :6])
    handed = erring(motion, kinematics.colours, m.source[-1:], m.time[-1:], m.lasting[-1:])
    share = handed.cov[0, 0, 6] / cov[0, 0, 6]
    assert 0.8 < share < 1.25
    assert np.linalg.eigvalsh(handed.cov[0]).min() > 0.0
    np.testing.assert_array_equal(handed.cov[0, :6, :6], cov[0, :6, :6])
    # What follows p + L u has the reports' own uncertainty, and not that of the position.
    H = np.hstack([[1.0, 0, 0, 0, 0, 0], L[0][0], np.zeros(1)])
    assert np.sqrt(H @ handed.cov[0] @ H) < 0.5 * np.sqrt(cov[0, 0, 0])
