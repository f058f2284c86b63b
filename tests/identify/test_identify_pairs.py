"""Ratios of many pairs on the batch kernel, against one pair at a time: another recursion, a dense solution, loops."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from scipy.linalg import block_diag, expm

from oracles import FlatModel, Run, dense_kalman, textbook_imm
from saltus import DataError, ModelError, identification_llr
from saltus.identify import LocalTracks, PairSettings, candidate_pairs, pair_ratios
from strategies import quick, random_cov, rngs

SPREAD, SPEED = 3e3, 60.0
ONE = PairSettings(accel=(2.0,), sojourn=(1.0,), accel_time=3.0, region_cov=SPREAD**2 * np.eye(2), speed_sigma=SPEED)
OFFSET = PairSettings(
    accel=(0.3, 4.0),
    sojourn=(40.0, 15.0),
    accel_time=2.0,
    offset_cov=[[400.0, 90.0], [90.0, 150.0]],
    offset_time=50.0,
    region_mean=(500.0, -800.0),
    region_cov=SPREAD**2 * np.array([[1.0, 0.3], [0.3, 0.8]]),
    speed_sigma=SPEED,
)
CLOCK = replace(OFFSET, offset_cov=np.zeros((2, 2)), time_sigma=0.7)
FAULTY = replace(OFFSET, time_sigma=0.7, outlier_probability=0.05, outlier_factor=6.0)


def tracks_of(rng, lives, every=4.0):
    """Local tracks near one straight line, one for each (begin, end), at random times with random covariances."""
    rows = []
    for k, (begin, end) in enumerate(lives):
        time = np.array([begin, *np.sort(rng.uniform(begin, end, int((end - begin) / every))), end])
        z = np.array([40.0, -25.0]) * time[:, None] + 60.0 * k + 30.0 * rng.normal(size=(len(time), 2))
        rows.append((np.full(len(time), k), time, z, 900.0 * random_cov(rng, (len(time),), 2)))
    return LocalTracks(*(np.concatenate(part) for part in zip(*rows, strict=True)))


def merged(a, b, i, j):
    """Rows of a pair in order of time, from the first of either track to the time the first of them ends."""
    parts = [
        (s, t.time[t.track == k], t.z[t.track == k], t.R[t.track == k]) for s, (t, k) in enumerate([(a, i), (b, j)])
    ]
    end = min(parts[0][1][-1], parts[1][1][-1])
    begin = max(parts[0][1][0], parts[1][1][0])
    system = np.concatenate([np.full(len(t), s) for s, t, _, _ in parts])
    time, z, R = (np.concatenate([p[c] for p in parts]) for c in (1, 2, 3))
    order = np.argsort(time, kind="stable")
    order = order[time[order] <= end]
    later = 1 if parts[0][1][0] <= parts[1][1][0] else 0
    return system[order], time[order], z[order], R[order], begin, later


def model(settings, time, system, z, R, late, velocity=None):
    """The filter of some rows in full; rows of the system `late` (None: neither) differ by more states."""
    dt, sizes = np.diff(time, prepend=time[0]), [len(settings.accel), 2 if settings.outlier_probability else 1]
    offset = late is not None and bool(np.any(settings.offset_cov))
    clock = late is not None and settings.time_sigma > 0
    n = 4 + 2 * offset + clock
    F, Q, H = (np.zeros((len(dt), *sizes, *core)) for core in ((n, n), (n, n), (2, n)))
    leave = np.array(settings.sojourn) ** -1.0
    rates = np.array([[-leave[0], leave[0]], [leave[1], -leave[1]]]) if sizes[0] == 2 else np.zeros((1, 1))
    for k, d in enumerate(dt):
        axis = np.array([[d**3 / 3, d**2 / 2], [d**2 / 2, d]])
        kept = np.exp(-d / settings.offset_time)
        more = [[kept * np.eye(2)] * offset + [np.eye(1)] * clock]
        more += [[(1 - kept**2) * settings.offset_cov] * offset + [np.zeros((1, 1))] * clock]
        for m, accel in enumerate(settings.accel):
            F[k, m] = block_diag(*[[[1.0, d], [0.0, 1.0]]] * 2, *more[0])
            Q[k, m] = block_diag(*[accel**2 * settings.accel_time * axis] * 2, *more[1])
        H[k, ..., 0, 0] = H[k, ..., 1, 2] = 1.0
        if offset:
            H[k, ..., 4:6] = (system[k] == late) * np.eye(2)
        if clock:
            H[k, ..., -1] = (system[k] == late) * velocity[k]
    mean, cov = np.zeros(n), np.zeros((n, n))
    mean[[0, 2]] = settings.region_mean
    cov[np.ix_([0, 2], [0, 2])] = settings.region_cov
    cov[1, 1] = cov[3, 3] = settings.speed_sigma**2
    if offset:
        cov[4:6, 4:6] = settings.offset_cov
    if clock:
        cov[-1, -1] = settings.time_sigma**2
    p, size = settings.outlier_probability, np.array([1.0, settings.outlier_factor])[: sizes[1]]
    outlier = np.array([1 - p, p])[: sizes[1]]
    modes = int(np.prod(sizes))
    return FlatModel(
        z=z,
        F=F.reshape(len(dt), modes, n, n),
        Q=Q.reshape(len(dt), modes, n, n),
        H=H.reshape(len(dt), modes, 2, n),
        R=np.tile(R[:, None, None] * size[:, None, None] ** 2, (1, sizes[0], 1, 1, 1)).reshape(len(dt), modes, 2, 2),
        b=np.zeros((len(dt), modes, n)),
        d=np.zeros((len(dt), modes, 2)),
        trans=np.array([np.kron(expm(rates * d), np.tile(outlier, (sizes[1], 1))) for d in dt]),
        mean0=np.repeat(mean[None], modes, axis=0),
        cov0=np.repeat(cov[None], modes, axis=0),
        probs0=np.kron(np.array(settings.sojourn) / np.sum(settings.sojourn), outlier),
    )


def by_hand(settings, a, b, i, j, run):
    """Times and cumulative ratios from the time both tracks live, each hypothesis filtered in full."""
    system, time, z, R, begin, later = merged(a, b, i, j)
    own, velocity, wide = np.zeros(len(time)), np.zeros((len(time), 2)), R.copy()
    for s in (0, 1):
        mine = system == s
        found = run(model(settings, time[mine], system[mine], z[mine], R[mine], None))
        own[mine] = found.log_likelihood
        velocity[mine] = found.mean[:, [1, 3]]
        if s == later:
            wide[mine] += settings.time_sigma**2 * found.cov[:, [1, 3]][:, :, [1, 3]]
    step = run(model(settings, time, system, z, wide, later, velocity)).log_likelihood - own
    return time[time >= begin], np.cumsum(step)[time >= begin]


def dense(f):
    args = (f.z, *(part[:, 0] for part in (f.F, f.Q, f.H, f.R, f.b, f.d)), f.mean0[0], f.cov0[0])
    mean, cov, total = dense_kalman(*args)
    return Run(None, mean, cov, np.diff(total, prepend=0.0))


@quick
@given(rngs())
def test_one_mode_is_the_ratio_of_one_pair(rng):
    a, b = tracks_of(rng, [(0.0, 40.0)]), tracks_of(rng, [(0.0, 50.0)], every=6.0)
    system, time, z, R, _, _ = merged(a, b, 0, 0)
    F = np.kron(np.eye(2), [[0.0, 1.0], [0.0, 0.0]])
    G = np.kron(np.eye(2), [[0.0], [2.0 * np.sqrt(3.0)]])
    mean, cov = ONE.prior()
    # Both objects are somewhere in the region at their own first measurement; that function puts both priors at t0.
    back = max(a.time[0], b.time[0]) - time[0]
    A, Q = (
        np.kron(np.eye(2), [[1.0, -back], [0.0, 1.0]]),
        12.0 * np.kron(np.eye(2), [[back**3 / 3, back**2 / 2], [back**2 / 2, back]]),
    )
    priors = [(mean, cov), (mean, A @ (cov - Q) @ A.T)]
    if system[0] == 1:
        system = 1 - system
    expected = identification_llr(
        time,
        system,
        z,
        F=F,
        G=G,
        H=np.eye(4)[[0, 2]],
        R=(R, R),
        t0=time[0],
        prior_same=priors[0],
        prior_other=priors[1],
    )
    found = pair_ratios(a, b, [[0, 0]], ONE)
    np.testing.assert_array_equal(found.time[0], time[-found.count[0] :])
    np.testing.assert_allclose(found.llr[0], expected[-found.count[0] :], rtol=1e-8, atol=1e-8)


@quick
@given(rngs())
def test_offset_in_one_mode_is_a_joint_density(rng):
    settings = PairSettings(
        accel=(2.0,), sojourn=(1.0,), offset_cov=OFFSET.offset_cov, region_cov=SPREAD**2 * np.eye(2), speed_sigma=SPEED
    )
    a, b = tracks_of(rng, [(10.0, 40.0)]), tracks_of(rng, [(0.0, 25.0)])
    time, expected = by_hand(settings, a, b, 0, 0, dense)
    found = pair_ratios(a, b, [[0, 0]], settings)
    np.testing.assert_array_equal(found.time[0], time)
    np.testing.assert_allclose(found.llr[0], expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("settings", [OFFSET, CLOCK, FAULTY], ids=["offset", "clock", "offset, clock and outliers"])
def test_many_pairs_of_several_modes_agree_with_loops(rng, settings):
    a = tracks_of(rng, [(0.0, 60.0), (20.0, 50.0), (30.0, 31.0), (70.0, 90.0)])
    b = tracks_of(rng, [(10.0, 40.0), (0.0, 90.0), (85.0, 95.0)], every=2.5)
    pairs = [[0, 0], [0, 1], [1, 0], [1, 1], [2, 1], [3, 1], [3, 2], [0, 2]]
    found = pair_ratios(a, b, pairs, settings)
    for p, (i, j) in enumerate(pairs[:-1]):
        time, expected = by_hand(settings, a, b, i, j, textbook_imm)
        n = found.count[p]
        np.testing.assert_array_equal(found.time[p, :n], time)
        np.testing.assert_allclose(found.llr[p, :n], expected, rtol=1e-8, atol=1e-8)
        assert np.isnan(found.llr[p, n:]).all() and np.isnan(found.time[p, n:]).all()
    assert found.count[-1] == 0, "these two never lived together"


def test_a_late_transponder_is_no_other_object(rng):
    """Positions that are 0.8 s old, 120 m behind at 150 m/s: one object if clocks may differ, two if not."""
    time = np.arange(0.0, 60.0, 2.0)
    rows = []
    for late, sd in ((0.0, 20.0), (0.8, 15.0)):
        z = np.outer(time - late, [150.0, 0.0]) + sd * rng.normal(size=(30, 2))
        rows.append(LocalTracks(np.zeros(30, int), time, z, np.tile(sd**2 * np.eye(2), (30, 1, 1))))
    told = [
        pair_ratios(*rows, [[0, 0]], PairSettings(accel=(0.3,), sojourn=(1.0,), time_sigma=sigma)).llr[0, -1]
        for sigma in (0.0, 1.0)
    ]
    assert told[0] < -20.0 and told[1] > 5.0


def test_a_region_of_a_hundred_kilometres_costs_no_digits(rng):
    wide = PairSettings(
        accel=(0.5,), sojourn=(1.0,), offset_cov=25.0 * np.eye(2), region_cov=1e10 * np.eye(2), speed_sigma=150.0
    )
    a, b = tracks_of(rng, [(0.0, 80.0)], every=1.0), tracks_of(rng, [(2.0, 80.0)], every=3.0)
    sharp = a._replace(R=a.R / 900.0)  # metres in a region of 10^5
    system, time, z, R, begin, later = merged(sharp, b, 0, 0)
    step = exact_kalman(model(wide, time, system, z, R, later))
    for s in (0, 1):
        mine = system == s
        step[mine] -= exact_kalman(model(wide, time[mine], system[mine], z[mine], R[mine], None))
    found = pair_ratios(sharp, b, [[0, 0]], wide)
    np.testing.assert_allclose(found.llr[0], np.cumsum(step)[time >= begin], rtol=1e-8, atol=1e-7)


def exact_kalman(f):
    """The Kalman filter of one mode in long double, measured components one by one after R is made diagonal."""
    x, P = f.mean0[0].astype(np.longdouble), f.cov0[0].astype(np.longdouble)
    out = []
    for k in range(len(f.z)):
        F, Q = f.F[k, 0].astype(np.longdouble), f.Q[k, 0].astype(np.longdouble)
        x, P, R = F @ x, F @ P @ F.T + Q, f.R[k, 0].astype(np.longdouble)
        lower = R[1, 0] / R[0, 0]  # R = L D L'
        T = np.array([[1, 0], [-lower, 1]], np.longdouble)
        H, z, D = T @ f.H[k, 0], T @ f.z[k], (R[0, 0], R[1, 1] - lower * R[1, 0])
        total = np.longdouble(0)
        for h, y, r in zip(H, z, D, strict=True):
            S, nu = h @ P @ h + r, y - h @ x
            total -= (nu * nu / S + np.log(2 * np.pi * S)) / 2
            K = P @ h / S
            J = np.eye(len(x), dtype=np.longdouble) - np.outer(K, h)
            x, P = x + K * nu, J @ P @ J.T + r * np.outer(K, K)
        out.append(float(total))
    return np.array(out)


def test_identity_known_otherwise_is_added(rng):
    a, b = tracks_of(rng, [(0.0, 30.0)]), tracks_of(rng, [(5.0, 20.0)])
    plain, told = (
        pair_ratios(a, b, [[0, 0], [0, 0]], OFFSET, log_prior_identity=prior) for prior in (None, [0.0, 7.0])
    )
    np.testing.assert_allclose(told.llr[1], plain.llr[1] + 7.0)
    np.testing.assert_array_equal(told.llr[0], plain.llr[0])


def test_no_pairs_and_no_tracks():
    none = LocalTracks(np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2, 2)))
    assert candidate_pairs(none, none, ONE, reach=10.0).shape == (0, 2)
    assert pair_ratios(none, none, np.zeros((0, 2), int), ONE).llr.shape == (0, 0)


def test_candidates_are_the_tracks_that_met(rng):
    """Against the distance of interpolated positions at many times; those that are nearly at the limit may differ."""
    lives_a = [(s, s + d) for s, d in zip(rng.uniform(0, 100, 30), rng.uniform(5, 60, 30), strict=True)]
    lives_b = [(s, s + d) for s, d in zip(rng.uniform(0, 100, 30), rng.uniform(5, 60, 30), strict=True)]
    a, b = scattered(rng, lives_a), scattered(rng, lives_b)
    settings = PairSettings(speed_sigma=20.0)
    found = {tuple(pair) for pair in candidate_pairs(a, b, settings, reach=3000.0, every=1.0).tolist()}
    near, far = set(), set()
    for i in range(30):
        for j in range(30):
            ta, tb = a.time[a.track == i], b.time[b.track == j]
            t = np.linspace(max(ta[0], tb[0]), min(ta[-1], tb[-1]), 200)
            if t[0] > t[-1]:
                far.add((i, j))
                continue
            at = [[np.interp(t, when, s.z[s.track == k, c]) for c in (0, 1)] for s, k, when in ((a, i, ta), (b, j, tb))]
            distance = np.hypot(*(np.array(at[0]) - at[1])).min()
            near |= {(i, j)} if distance < 2900.0 else set()
            far |= {(i, j)} if distance > 3000.0 + 3 * 20.0 + 40.0 else set()
    assert near <= found and not found & far and len(near) > 20 and len(far) > 200


def scattered(rng, lives):
    rows = []
    for k, (begin, end) in enumerate(lives):
        time = np.linspace(begin, end, max(2, int(end - begin)))
        z = rng.uniform(-1e4, 1e4, 2) + rng.normal(0.0, 20.0, 2) * time[:, None]
        rows.append((np.full(len(time), k), time, z, np.tile(np.eye(2), (len(time), 1, 1))))
    return LocalTracks(*(np.concatenate(part) for part in zip(*rows, strict=True)))


def test_what_is_no_input_is_refused(rng):
    good = tracks_of(rng, [(0.0, 40.0), (0.0, 40.0)])
    with pytest.raises(DataError, match="out of order"):
        pair_ratios(good._replace(time=good.time[::-1]), good, [[0, 0]], ONE)
    z = good.z.copy()
    z[3, 1] = np.nan
    with pytest.raises(DataError, match="z of row 3"):
        pair_ratios(good, good._replace(z=z), [[0, 0]], ONE)
    with pytest.raises(DataError, match=r"pair \(0, 2\)"):
        pair_ratios(good, good, [[0, 2]], ONE)
    with pytest.raises(DataError, match="shapes"):
        pair_ratios(good._replace(R=good.R[:-1]), good, [[0, 0]], ONE)
    for wrong in (
        {"accel": (1.0,)},
        {"accel_time": 0.0},
        {"region_cov": np.zeros((2, 2))},
        {"offset_cov": np.eye(3)},
        {"offset_time": 0.0},
        {"time_sigma": -1.0},
        {"outlier_probability": 1.0},
        {"outlier_factor": 0.5},
        {"region_mean": (0.0,)},
        {"sojourn": (1.0, -1.0)},
    ):
        with pytest.raises(ModelError, match="PairSettings"):
            PairSettings(**wrong)
    with pytest.raises(ModelError, match="reach"):
        candidate_pairs(good, good, ONE, reach=0.0)
