"""The tracks' filters against the batch filter with matrices written out, and the two-point start against the notes."""

import numpy as np
import pytest
from scipy.linalg import block_diag, expm

from saltus.errors import ModelError
from saltus.filters import imm_filter
from saltus.tracks.channel import Plan, Start
from saltus.tracks.kinematics import Chosen, make_kinematics
from saltus.tracks.settings import FilterSettings
from saltus.tracks.starts import two_point_start, with_speed_prior

STEPS = np.array([4.0, 3.7, 4.4, 8.1, 0.2, 4.0])
SETTINGS = dict(accel_h=(0.5, 6.0), sojourn_h=(80.0, 20.0), accel_v=(0.2, 3.0, 9.0), sojourn_v=(60.0, 15.0, 5.0))
LEVELS = SETTINGS | dict(accel_time=0.0, turn_rate=())


def trans(sojourn, dt):
    """Leave state i at rate 1 / sojourn[i], to each of the others alike."""
    rates = np.full((len(sojourn),) * 2, 0.0)
    for i, s in enumerate(sojourn):
        rates[i] = 1.0 / s / (len(sojourn) - 1)
        rates[i, i] = -1.0 / s
    return expm(rates * dt)


def law(sojourn):
    """Stationary law by a long time."""
    return trans(sojourn, 1e6)[0]


def F_axis(dt):
    return np.array([[1.0, dt], [0.0, 1.0]])


def Q_axis(accel, dt):
    g = np.array([dt * dt / 2, dt])
    return accel**2 * np.outer(g, g)


def spd(rng, *lead, n):
    a = rng.normal(size=(*lead, n, n))
    return a @ a.swapaxes(-1, -2) + np.eye(n)


@pytest.fixture
def tracks(rng):
    """Three rows, six irregular steps: starts, positions with full 3 x 3 covariances, some heights missing."""
    start = Start(rng.normal(0, 100, (3, 6)), spd(rng, 3, n=6) * 400.0)
    position = start.mean[:, 0::2][:, None] + np.cumsum(rng.normal(0, 60, (3, len(STEPS), 3)), axis=1)
    position[0, 2, 2] = position[1, 0, 2] = position[2, 3:5, 2] = np.nan
    return start, position, spd(rng, 3, len(STEPS), n=3) * 100.0


def carried(settings, tracks):
    """Moments after each step, rows carried through the bank: predicted as copies, updated, put back."""
    start, position, cov = tracks
    kinematics, out = make_kinematics(settings), []
    other = kinematics.add(start)  # rows that are freed and used again
    rows = kinematics.add(start)
    kinematics.remove(other)
    kinematics.add(Start(start.mean[:2] + 5.0, start.cov[:2]))
    total = np.zeros((3, len(STEPS)))
    for k, dt in enumerate(STEPS):
        copies = kinematics.predicted(rows[::-1], np.full(3, dt))
        plan = Plan.of_positions(position[::-1, k], np.zeros(3))
        total[::-1, k] = copies.score(np.arange(3), plan, cov[::-1, k][:, None])[:, 0]
        kinematics.absorb(rows[::-1], copies, Chosen.sure(np.arange(3), plan, cov[::-1, k]))
        out.append(kinematics.moments(rows))
    return out, total


def test_decomposed_is_two_batch_filters_side_by_side(tracks):
    start, position, cov = tracks
    found, total = carried(FilterSettings(form="decomposed", **LEVELS), tracks)
    expected_total = 0.0
    for axes, accel, sojourn in (
        ([0, 1], SETTINGS["accel_h"], SETTINGS["sojourn_h"]),
        ([2], SETTINGS["accel_v"], SETTINGS["sojourn_v"]),
    ):
        states = np.ravel([[2 * a, 2 * a + 1] for a in axes])
        d = len(axes)
        p0 = law(sojourn)
        est = imm_filter(
            position[:, :, axes],
            F=np.array([block_diag(*[F_axis(dt)] * d) for dt in STEPS])[:, None],
            Q=np.array([[block_diag(*[Q_axis(a, dt)] * d) for a in accel] for dt in STEPS]),
            H=np.eye(2 * d)[0::2][None],
            R=cov[:, :, axes][..., axes][:, :, None],
            trans=[np.array([trans(sojourn, dt) for dt in STEPS])],
            mean0=np.repeat(start.mean[:, None, states], len(accel), axis=1),
            cov0=np.repeat(start.cov[:, states][:, :, states][:, None], len(accel), axis=1),
            probs0=p0,
        )
        expected_total = expected_total + est.log_likelihood
        for k, moments in enumerate(found):
            np.testing.assert_allclose(moments.mean[:, states], est.mean[:, k], rtol=1e-9, atol=1e-8)
            got = moments.cov[:, states][:, :, states]
            np.testing.assert_allclose(got, est.cov[:, k], rtol=1e-9, atol=1e-8)
            p = moments.p_manoeuvre_h if d == 2 else moments.p_manoeuvre_v
            np.testing.assert_allclose(p, 1.0 - est.probs[:, k, 0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(total, expected_total, rtol=1e-9)
    cross = found[-1].cov[:, :4, 4:]
    assert (cross == 0.0).all()  # what the decomposition drops


def test_joint_is_the_batch_filter_with_both_chains_and_full_covariance(tracks):
    start, position, cov = tracks
    found, total = carried(FilterSettings(form="joint", **LEVELS), tracks)
    h, v = SETTINGS["accel_h"], SETTINGS["accel_v"]
    lift = (3, len(h), len(v))
    est = imm_filter(
        position,
        F=np.array([block_diag(*[F_axis(dt)] * 3) for dt in STEPS])[:, None, None],
        Q=np.array([[[block_diag(Q_axis(a, dt), Q_axis(a, dt), Q_axis(b, dt)) for b in v] for a in h] for dt in STEPS]),
        H=np.eye(6)[0::2][None, None],
        R=cov[:, :, None, None],
        trans=[np.array([trans(s, dt) for dt in STEPS]) for s in (SETTINGS["sojourn_h"], SETTINGS["sojourn_v"])],
        mean0=np.broadcast_to(start.mean[:, None, None], (*lift, 6)),
        cov0=np.broadcast_to(start.cov[:, None, None], (*lift, 6, 6)),
        probs0=np.outer(law(SETTINGS["sojourn_h"]), law(SETTINGS["sojourn_v"])),
    )
    for k, moments in enumerate(found):
        np.testing.assert_allclose(moments.mean, est.mean[:, k], rtol=1e-8, atol=1e-7)
        np.testing.assert_allclose(moments.cov, est.cov[:, k], rtol=1e-8, atol=1e-7)
        np.testing.assert_allclose(moments.p_manoeuvre_h, 1.0 - est.probs[:, k, 0].sum(-1), atol=1e-10)
        np.testing.assert_allclose(moments.p_manoeuvre_v, 1.0 - est.probs[:, k, :, 0].sum(-1), atol=1e-10)
    np.testing.assert_allclose(total, est.log_likelihood, rtol=1e-8)
    assert np.abs(found[-1].cov[:, :4, 4:]).max() > 1.0  # what the decomposition would drop


TURNS = SETTINGS | dict(turn_rate=(1.5, 4.0), turn_sojourn=25.0, accel_time=5.0)
RATES = np.radians([0.0, -1.5, 1.5, -4.0, 4.0, 0.0])  # to the right: steady, two pairs of turns, manoeuvre
DENSITY = 5.0 * np.square([0.5, 1.8, 1.8, 1.8, 1.8, 6.0])  # a turn has three tenths of 6 m/s^2 besides


def turning(rate, density, dt):
    """Van Loan's form of dv = rate (vy, -vx) dt + dW."""
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    A[1, 3], A[3, 1] = rate, -rate
    both = expm(np.block([[-A, density * np.diag([0.0, 1.0, 0.0, 1.0])], [np.zeros((4, 4)), A.T]]) * dt)
    F = both[4:, 4:].T
    return F, F @ both[:4, 4:]


def turning_trans(dt):
    """Four of five departures from steady motion to the manoeuvre, nine of ten from elsewhere to steady motion."""
    away = np.full((6, 6), 0.1 / 4)
    away[0], away[1:, 0] = [0.0, 0.05, 0.05, 0.05, 0.05, 0.8], 0.9
    np.fill_diagonal(away, 0.0)
    rates = (away - np.eye(6)) / np.array([80.0, 25.0, 25.0, 25.0, 25.0, 20.0])[:, None]
    return expm(rates * dt)


def test_turns_are_modes_of_the_batch_filter(tracks):
    start, position, cov = tracks
    found, _ = carried(FilterSettings(form="decomposed", **TURNS), tracks)
    F, Q = np.moveaxis([[turning(rate, q, dt) for rate, q in zip(RATES, DENSITY, strict=True)] for dt in STEPS], 2, 0)
    est = imm_filter(
        position[..., :2],
        F=F,
        Q=Q,
        H=np.eye(4)[0::2][None],
        R=cov[:, :, :2, :2][:, :, None],
        trans=[np.array([turning_trans(dt) for dt in STEPS])],
        mean0=np.repeat(start.mean[:, None, :4], 6, axis=1),
        cov0=np.repeat(start.cov[:, None, :4, :4], 6, axis=1),
        probs0=turning_trans(1e6)[0],
    )
    for k, moments in enumerate(found):
        np.testing.assert_allclose(moments.mean[:, :4], est.mean[:, k], rtol=1e-9, atol=1e-8)
        np.testing.assert_allclose(moments.cov[:, :4, :4], est.cov[:, k], rtol=1e-9, atol=1e-8)
        np.testing.assert_allclose(moments.p_manoeuvre_h, 1.0 - est.probs[:, k, 0], rtol=1e-9, atol=1e-12)


def test_beside_turns_the_joint_form_differs_by_the_cross_covariance_alone(tracks):
    """Without covariance between height and the plane, in the start or in a plot, both forms are one filter."""
    start, position, cov = (part.copy() if isinstance(part, np.ndarray) else part for part in tracks)
    start.cov[:, :4, 4:] = 0.0
    start.cov[:, 4:, :4] = 0.0
    cov[..., :2, 2] = cov[..., 2, :2] = 0.0
    single = TURNS | dict(accel_v=(3.0,), sojourn_v=(15.0,))  # mixing over the product of modes keeps them apart
    apart, joint = (
        carried(FilterSettings(form=form, **single), (start, position, cov))[0] for form in ("decomposed", "joint")
    )
    for one, other in zip(apart, joint, strict=True):
        for field in ("mean", "cov", "p_manoeuvre_h"):
            np.testing.assert_allclose(getattr(one, field), getattr(other, field), rtol=1e-7, atol=1e-7)


def test_a_single_level_has_no_turns():
    one = make_kinematics(FilterSettings(accel_h=(1.0,), sojourn_h=(60.0,)))
    assert [channel.bank.sizes for channel in one.channels] == [(1,), (2,)]
    assert [channel.bank.sizes for channel in make_kinematics(FilterSettings()).channels] == [(4,), (2,)]


@pytest.mark.parametrize(
    "value, message",
    [
        (dict(turn_rate=(0.0,)), r"filter\.turn_rate holds rates"),
        (dict(turn_rate=(1.5, 90.0)), r"up to 45 degrees/s; got \(1\.5, 90\.0\)"),
        (dict(turn_rate=(np.nan,)), r"filter\.turn_rate"),
        (dict(turn_sojourn=0.0), r"filter\.turn_sojourn is a time"),
    ],
)
def test_turns_that_cannot_be(value, message):
    with pytest.raises(ModelError, match=message):
        FilterSettings(**value)


def test_a_plot_without_height_leaves_the_height_predicted(tracks):
    start, position, cov = tracks
    kinematics = make_kinematics(FilterSettings(**SETTINGS))
    rows = kinematics.add(start)
    copies = kinematics.predicted(rows, np.full(3, 4.0))
    predicted = copies.moments(np.arange(3))
    blind = position[:, 0].copy()
    blind[:, 2] = np.nan
    unchanged = kinematics.moments(rows)  # the originals know nothing of their copies
    np.testing.assert_allclose(unchanged.mean, start.mean, rtol=1e-12)
    plan = Plan.of_positions(blind, np.zeros(3))
    kinematics.absorb(rows, copies, Chosen.sure(np.arange(3), plan, cov[:, 0]))
    after = kinematics.moments(rows)
    np.testing.assert_allclose(after.mean[:, 4:], predicted.mean[:, 4:], rtol=1e-12)
    np.testing.assert_allclose(after.cov[:, 4:, 4:], predicted.cov[:, 4:, 4:], rtol=1e-12)
    np.testing.assert_allclose(after.p_manoeuvre_v, predicted.p_manoeuvre_v, rtol=1e-12)
    assert (
        np.trace(after.cov[:, :4, :4], axis1=1, axis2=2) < np.trace(predicted.cov[:, :4, :4], axis1=1, axis2=2)
    ).all()


def test_a_late_plot_measures_where_the_target_was(tracks):
    """A measurement 1.5 s before the row's time is z = x - 1.5 v: conditioned by the joint Gaussian of state and z."""
    start, position, cov = tracks
    one = dict(accel_h=(1.0,), sojourn_h=(60.0,), accel_v=(1.0,), sojourn_v=(60.0,))
    kinematics = make_kinematics(FilterSettings(form="joint", **one))
    rows = kinematics.add(start)
    z = np.nan_to_num(position[:, 0])
    late = Plan.of_positions(z, np.full(3, -1.5))
    kinematics.absorb(rows, kinematics.predicted(rows, np.zeros(3)), Chosen.sure(np.arange(3), late, cov[:, 0]))
    found = kinematics.moments(rows)
    A = np.zeros((3, 6))
    for axis in range(3):
        A[axis, 2 * axis], A[axis, 2 * axis + 1] = 1.0, -1.5
    for k in range(3):
        both = np.vstack([np.eye(6), A])
        joint = both @ start.cov[k] @ both.T
        joint[6:, 6:] += cov[k, 0]
        weights = np.linalg.solve(joint[6:, 6:], joint[6:, :6]).T
        np.testing.assert_allclose(found.mean[k], start.mean[k] + weights @ (z[k] - A @ start.mean[k]), rtol=1e-9)
        np.testing.assert_allclose(found.cov[k], joint[:6, :6] - weights @ joint[6:, :6], rtol=1e-9, atol=1e-8)


def test_the_widest_mode_is_the_most_agile(tracks):
    start, *_ = tracks
    kinematics = make_kinematics(FilterSettings(form="joint", **LEVELS))
    copies = kinematics.predicted(kinematics.add(start), np.full(3, 4.0))
    mean, P = copies.widest(np.arange(3))
    F = block_diag(*[F_axis(4.0)] * 3)
    Q = block_diag(Q_axis(6.0, 4.0), Q_axis(6.0, 4.0), Q_axis(9.0, 4.0))
    np.testing.assert_allclose(mean, start.mean @ F.T, rtol=1e-9)
    np.testing.assert_allclose(P, F @ start.cov @ F.T + Q, rtol=1e-9)


def test_turns_widen_what_a_gate_must_hold(tracks):
    start, *_ = tracks
    kinematics = make_kinematics(FilterSettings(**TURNS))
    copies = kinematics.predicted(kinematics.add(start), np.full(3, 4.0))
    mean, P = copies.widest(np.arange(3))
    # Every mode of a new track is alike, so mixing changes nothing and each mode's mean is its own F times the start's.
    F, Q = turning(0.0, DENSITY[-1], 4.0)
    own = start.mean[:, :4] @ F.T
    apart = np.stack([start.mean[:, :4] @ turning(rate, 1.0, 4.0)[0].T - own for rate in RATES[1:5]], axis=1)
    np.testing.assert_allclose(mean[:, :4], own, rtol=1e-9)
    expected = F @ start.cov[:, :4, :4] @ F.T + Q + np.einsum("kti,ktj->kij", apart, apart) / 4.0
    np.testing.assert_allclose(P[:, :4, :4], expected, rtol=1e-9)


def test_two_point_start_is_the_notes_formula(rng):
    T = 5.0
    z0, z1, R0, R1 = rng.normal(size=3), rng.normal(size=3), spd(rng, n=3), spd(rng, n=3)
    start = two_point_start(z0[None], R0[None], z1[None], R1[None], np.array([T]))
    # (position, velocity) = A (z0, z1): any linear map of two independent Gaussians.
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.eye(3) / T, np.eye(3) / T]])
    mean, P = A @ np.concatenate([z0, z1]), A @ block_diag(R0, R1) @ A.T
    order = [0, 3, 1, 4, 2, 5]
    np.testing.assert_allclose(start.mean[0], mean[order], rtol=1e-12)
    np.testing.assert_allclose(start.cov[0], P[np.ix_(order, order)], rtol=1e-12, atol=1e-15)


def test_two_point_start_agrees_with_the_reference_case(cases):
    case = cases("radar_track")
    start = two_point_start(case["Y"][:1], case["R"][:1], case["Y"][1:2], case["R"][1:2], np.array([10.0]))
    np.testing.assert_allclose(start.mean[0, :4], case["x0"], rtol=1e-8)
    np.testing.assert_allclose(start.cov[0, :4, :4], case["P0"], rtol=1e-8, atol=1e-8 * np.abs(case["P0"]).max())
    np.testing.assert_allclose(start.mean[0, 4:], case["z0"], rtol=1e-8)
    np.testing.assert_allclose(start.cov[0, 4:, 4:], case["Z0"], rtol=1e-8)


def test_a_speed_prior_is_a_measurement_of_no_speed(rng):
    """Against the information form: the inverse covariance gains 1 / sigma^2 on each horizontal velocity."""
    start = Start(rng.normal(0, 300, (4, 6)), spd(rng, 4, n=6) * 1e4)
    found = with_speed_prior(start, 400.0)
    for k in range(4):
        information = np.linalg.inv(start.cov[k])
        total = information + np.diag([0, 1, 0, 1, 0, 0]) / 400.0**2
        np.testing.assert_allclose(found.cov[k], np.linalg.inv(total), rtol=1e-8)
        np.testing.assert_allclose(found.mean[k], np.linalg.solve(total, information @ start.mean[k]), rtol=1e-8)
