"""Rows of a bank against the batch filter, and the book-keeping of rows."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from oracles import error
from saltus.compiled import native_module
from saltus.errors import DataError, ModelError, NumericalError
from saltus.filters import Bank, Belief, imm_filter
from strategies import law, quick, random_cov, random_problem, rngs

ROUND_OFF = 1e-11
BACKENDS = ["numpy"] if native_module() is None else ["numpy", "native"]


def start(problem, n_rows):
    """The problem's prior as a Belief with one leading axis."""
    sizes = tuple(t.shape[-1] for t in problem["trans"])
    n = problem["cov0"].shape[-1]
    return Belief(
        np.log(np.broadcast_to(problem["probs0"], (n_rows, *sizes))),
        np.broadcast_to(problem["mean0"], (n_rows, *sizes, n)),
        np.broadcast_to(problem["cov0"], (n_rows, *sizes, n, n)),
    )


def at(problem, name, k):
    """The matrix of row k: (rows, modes, ...) where it differs by row, (1, modes, ...) where it does not."""
    a = problem[name]
    if a is None:
        return None
    n_rows, m, n = len(problem["z"]), problem["z"].shape[-1], problem["cov0"].shape[-1]
    sizes = tuple(t.shape[-1] for t in problem["trans"])
    core = {"F": (n, n), "Q": (n, n), "H": (m, n), "R": (m, m), "b": (n,), "d": (m,)}[name]
    a = a.reshape((1,) * (2 + len(sizes) + len(core) - a.ndim) + a.shape)
    a = a[:, k if a.shape[1] > 1 else 0]
    return np.broadcast_to(a, (n_rows, *sizes, *core)) if a.shape[0] > 1 else a


def transitions(problem, k):
    out = []
    for t in problem["trans"]:
        t = t.reshape((1,) * (4 - t.ndim) + t.shape)[:, k if t.ndim > 2 and t.shape[-3] > 1 else 0]
        out.append(None if (t == np.eye(t.shape[-1])).all() else t if len(t) > 1 else t[0])
    return out


@quick
@given(rngs(), st.lists(st.integers(1, 3), max_size=2), st.integers(1, 4), st.integers(1, 3))
def test_bank_follows_the_batch_filter_row_by_row(rng, sizes, n_rows, n):
    p = random_problem(rng, tuple(sizes), n=n, m=2, n_steps=4, batch=(n_rows,))
    est = imm_filter(**p)
    bank = Bank(n, tuple(sizes), capacity=1)
    others = bank.add(start(p, n_rows))
    rows = rng.permutation(bank.add(start(p, n_rows)))
    bank.write(rows, start(p, n_rows))
    before = bank.read(others)
    for k in range(4):
        bank.step(rows, transitions(p, k), at(p, "F", k), at(p, "b", k), at(p, "Q", k))
        measurement = (p["z"][:, k], at(p, "H", k), at(p, "d", k), at(p, "R", k))
        scored = bank.score(rows, *measurement)
        d2, log_f = bank.update(rows, *measurement)
        np.testing.assert_array_equal(scored, (d2, log_f))
        mean, cov, probs = bank.moments(rows)
        assert error(mean, est.mean[:, k]) < ROUND_OFF
        assert error(cov, est.cov[:, k]) < ROUND_OFF
        assert error(probs, est.probs[:, k]) < ROUND_OFF
        np.testing.assert_allclose(log_f, est.log_likelihood[:, k], rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(d2, est.nis[:, k], rtol=1e-10, atol=1e-10)
    for a, b in zip(before, bank.read(others), strict=True):
        np.testing.assert_array_equal(a, b)


def belief_of(value, n_rows=1, sizes=(2,), n=2):
    """Recognisable rows: means value, value + 1, ..."""
    means = np.broadcast_to(value + np.arange(n_rows).reshape(-1, *(1,) * (len(sizes) + 1)), (n_rows, *sizes, n))
    covs = np.broadcast_to(np.eye(n), (n_rows, *sizes, n, n))
    return Belief(np.full((n_rows, *sizes), -np.log(np.prod(sizes))), means.astype(float), covs)


def values(bank, rows):
    return bank.moments(rows)[0][:, 0].round(12).tolist()


def test_rows_are_distinct_recycled_and_survive_growth():
    bank = Bank(2, (2,), capacity=2)
    first = bank.add(belief_of(10.0, 2))
    assert len(bank) == 2
    more = bank.add(belief_of(20.0, 20))  # grows more than once
    assert len(bank) == 22 and len(set(first) | set(more)) == 22
    assert values(bank, first) == [10.0, 11.0] and values(bank, more) == list(range(20, 40))
    bank.remove(more[3:6])
    assert len(bank) == 19
    again = bank.add(belief_of(50.0, 3))
    assert set(again) == set(more[3:6])
    assert values(bank, again) == [50.0, 51.0, 52.0] and values(bank, more[:3]) == [20.0, 21.0, 22.0]


def test_read_gives_copies():
    bank = Bank(2, (2,))
    rows = bank.add(belief_of(1.0))
    bank.read(rows).means[...] = 7.0
    assert values(bank, rows) == [1.0]


def test_take_repeats_rows_in_a_bank_of_its_own_and_put_returns_them():
    bank = Bank(2, (2,))
    rows = bank.add(belief_of(10.0, 3))
    copies = bank.take(rows[[2, 0, 2]])
    assert len(copies) == 3 and values(copies, np.arange(3)) == [12.0, 10.0, 12.0]
    copies.step(np.array([1]), [None], np.eye(2)[None, None], np.array([[[100.0, 0.0]]]), np.zeros((1, 1, 2, 2)))
    assert values(copies, np.arange(3)) == [12.0, 110.0, 12.0]
    assert values(bank, rows) == [10.0, 11.0, 12.0]
    bank.put(rows[[0, 1]], copies, np.array([1, 2]))
    assert values(bank, rows) == [110.0, 12.0, 12.0]
    extra = copies.add(belief_of(5.0))  # a taken bank is an ordinary one: it grows
    assert len(copies) == 4 and values(copies, extra) == [5.0] and values(copies, np.arange(3)) == [12.0, 110.0, 12.0]


def test_score_of_many_plots_against_few_rows(rng):
    p = random_problem(rng, (2,), n=3, m=2, n_steps=1, batch=(2,), missing=0.0)
    bank = Bank(3, (2,))
    rows = bank.add(start(p, 2))
    H, R = rng.normal(size=(1, 1, 2, 3)), np.eye(2)[None, None]
    pairs, z = rows[[0, 1, 0, 0]], rng.normal(size=(4, 2))
    z[3, 1] = np.nan
    before = bank.read(rows)
    d2, log_f = bank.score(pairs, z, H, None, R)
    for i, row in enumerate(pairs):
        one = bank.take(np.array([row]))
        got = one.update(np.array([0]), z[i : i + 1], H, None, R)
        assert abs(got[0][0] - d2[i]) < 1e-10 * (1 + d2[i]) and abs(got[1][0] - log_f[i]) < 1e-10 * (1 + abs(log_f[i]))
    for a, b in zip(before, bank.read(rows), strict=True):
        np.testing.assert_array_equal(a, b)


def test_measurement_with_nothing_seen_changes_nothing(rng):
    bank = Bank(2, (2,))
    rows = bank.add(belief_of(3.0, 2))
    before = bank.read(rows)
    d2, log_f = bank.update(rows, np.full((2, 1), np.nan), np.ones((1, 1, 1, 2)), None, np.ones((1, 1, 1, 1)))
    assert (np.abs(d2) < 1e-12).all() and (np.abs(log_f) < 1e-12).all()
    for a, b in zip(before, bank.read(rows), strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-15, atol=1e-15)


@pytest.mark.parametrize("sizes", [(), (2, 3)])
def test_no_rows_at_all(sizes):
    bank, none = Bank(2, sizes), np.array([], dtype=np.intp)
    one = (1,) * len(sizes)
    F, H, R = np.eye(2).reshape(1, *one, 2, 2), np.ones((1, *one, 1, 2)), np.ones((1, *one, 1, 1))
    assert bank.add(belief_of(0.0, 0, sizes)).shape == (0,) and len(bank) == 0
    bank.step(none, [np.eye(s) for s in sizes], F, None, F)
    for d2, log_f in (bank.score(none, np.zeros((0, 1)), H, None, R), bank.update(none, np.zeros((0, 1)), H, None, R)):
        assert d2.shape == (0,) and log_f.shape == (0,)
    mean, cov, probs = bank.moments(none)
    assert mean.shape == (0, 2) and cov.shape == (0, 2, 2) and probs.shape == (0, *sizes)
    assert len(bank.take(none)) == 0


@pytest.mark.parametrize(("n", "sizes"), [(0, (2,)), (2, (2, 0))])
def test_impossible_bank(n, sizes):
    with pytest.raises(ModelError, match="a Bank needs n >= 1 and chains of at least one state"):
        Bank(n, sizes)


@quick
@given(rngs(), st.lists(st.integers(1, 3), max_size=2), st.integers(1, 4), st.integers(1, 3))
def test_a_mixture_of_noises_is_a_chain_drawn_afresh(rng, sizes, h, n_rows):
    """Against the batch filter with one chain more, whose rows are equal: its axis is summed over, and never stored."""
    sizes, n = tuple(sizes), 3
    p = random_problem(rng, sizes, n=n, m=2, n_steps=4, batch=(n_rows,))
    law = rng.dirichlet(np.ones(h))
    noises = np.stack([at(p, "R", k) * np.ones((n_rows, *(1 for _ in sizes), 1, 1)) for k in range(4)], axis=1)
    factor = rng.uniform(0.3, 5.0, h)
    wide = {
        name: None if p[name] is None else np.stack([at(p, name, k) for k in range(4)], axis=1)[..., None, :, :]
        for name in ("F", "Q", "H")
    }
    wide |= {
        name: None if p[name] is None else np.stack([at(p, name, k) for k in range(4)], 1)[..., None, :]
        for name in "bd"
    }
    trans = [
        np.stack(
            [np.broadcast_to(np.eye(s), (1, s, s))[0] if (t := transitions(p, k)[c]) is None else t for k in range(4)],
            axis=-3,
        )
        for c, s in enumerate(sizes)
    ]
    lift = (n_rows, *sizes, 1)
    est = imm_filter(
        p["z"],
        **wide,
        R=noises[..., None, :, :] * factor[:, None, None],
        trans=[*trans, np.tile(law, (h, 1))],
        mean0=np.broadcast_to(p["mean0"], (*lift[:-1], n))[..., None, :],
        cov0=np.broadcast_to(p["cov0"], (*lift[:-1], n, n))[..., None, :, :],
        probs0=np.broadcast_to(p["probs0"], lift[:-1])[..., None] * law,
    )
    bank = Bank(n, sizes, capacity=2)
    rows = rng.permutation(bank.add(start(p, n_rows)))
    bank.write(rows, start(p, n_rows))
    for k in range(4):
        bank.step(rows, transitions(p, k), at(p, "F", k), at(p, "b", k), at(p, "Q", k))
        R = noises[:, k][:, None] * factor.reshape(-1, *(1 for _ in sizes), 1, 1)
        H, d = (None if (a := at(p, name, k)) is None else np.broadcast_to(a, (n_rows, *a.shape[1:])) for name in "Hd")
        each = np.repeat(np.arange(n_rows), h)
        copies = bank.take(rows[each])
        offset, noise = None if d is None else d[each], R.reshape((-1, *R.shape[2:]))
        _, log_each = copies.update(np.arange(len(each)), p["z"][each, k], H[each], offset, noise)
        weights = np.tile(np.log(law), n_rows) + log_each
        log_f, posterior = bank.merge(rows, copies, h * np.arange(n_rows + 1), weights)
        posterior = posterior.reshape(n_rows, h)
        mean, cov, probs = bank.moments(rows)
        assert error(mean, est.mean[:, k]) < ROUND_OFF
        assert error(cov, est.cov[:, k]) < ROUND_OFF
        assert error(probs, est.probs[:, k].sum(-1)) < ROUND_OFF
        np.testing.assert_allclose(log_f, est.log_likelihood[:, k], rtol=1e-9, atol=1e-9)
        joint = est.probs[:, k].reshape(n_rows, -1, h).sum(1)
        np.testing.assert_allclose(np.exp(posterior), joint, rtol=1e-8, atol=1e-10)


@quick
@given(rngs(), st.lists(st.integers(1, 3), max_size=2), st.lists(st.integers(1, 5), min_size=1, max_size=4))
def test_ragged_hypotheses_are_mixtures_mode_by_mode(rng, sizes, groups):
    """Against sums over one mode and one group at a time; copies of the first group may be impossible."""
    sizes, n = tuple(sizes), 3
    c, start = sum(groups), np.concatenate([[0], np.cumsum(groups)])
    probs = law(rng, (c,), int(np.prod(sizes))).reshape((c, *sizes))
    each = Belief(np.log(probs), rng.normal(size=(c, *sizes, n)), random_cov(rng, (c, *sizes), n))
    log_weights = 20.0 * rng.normal(size=c)
    log_weights[1 : groups[0]] = -np.inf
    copies, bank = Bank(n, sizes, capacity=1), Bank(n, sizes, capacity=9)
    copies = copies.take(copies.add(each))
    rows = rng.permutation(bank.add(belief_of(0.0, 9, sizes, n)))[: len(groups)]
    log_f, log_posterior = bank.merge(rows, copies, start, log_weights)
    got = bank.read(rows)
    for g, row in enumerate(zip(*got, strict=True)):
        mine = slice(start[g], start[g + 1])
        weight = np.exp(log_weights[mine] - log_weights[mine].max())
        assert log_f[g] == pytest.approx(np.log(weight.sum()) + log_weights[mine].max())
        weight /= weight.sum()
        np.testing.assert_allclose(np.exp(log_posterior[mine]), weight, rtol=1e-9)
        for mode in np.ndindex(*sizes):
            w = weight * probs[mine][(slice(None), *mode)]
            x, P = (a[mine][(slice(None), *mode)] for a in each[1:])
            mean = w @ x / w.sum()
            second = np.einsum("c,cij->ij", w, P + x[:, :, None] * x[:, None, :]) / w.sum()
            assert np.exp(row[0][mode]) == pytest.approx(w.sum())
            np.testing.assert_allclose(row[1][mode], mean, atol=1e-10)
            np.testing.assert_allclose(row[2][mode], second - np.outer(mean, mean), atol=1e-9)


def test_groups_that_do_not_fit_and_rows_without_a_possible_hypothesis(rng):
    bank = Bank(1, (2,), capacity=4)
    rows = bank.add(Belief(np.log(np.full((2, 2), 0.5)), np.zeros((2, 2, 1)), np.ones((2, 2, 1, 1))))
    copies = bank.take(rows[[0, 0, 1]])
    for start in ([0, 2], [0, 0, 3], [0, 2, 2], [1, 2, 3], [0, 3, 2]):
        with pytest.raises(ModelError, match=r"groups of copies begin at start \(k \+ 1,\)"):
            bank.merge(rows, copies, np.array(start), np.zeros(3))
    before = bank.read(rows)
    with pytest.raises(NumericalError, match=f"row {rows[1]}: no hypothesis is possible"):
        bank.merge(rows, copies, np.array([0, 2, 3]), np.array([0.0, 0.0, -np.inf]))
    for now, then in zip(bank.read(rows), before, strict=True):
        np.testing.assert_array_equal(now, then)
    log_f, posterior = bank.merge(rows[:0], bank.take(rows[:0]), np.zeros(1, np.intp), np.zeros(0))
    assert log_f.shape == posterior.shape == (0,)


def test_one_hypothesis_is_the_copy_itself(rng):
    bank = Bank(2, (2,), capacity=4)
    rows = bank.add(Belief(np.log([[0.3, 0.7]]), rng.normal(size=(1, 2, 2)), random_cov(rng, (1, 2), 2)))
    copies = bank.take(rows)
    expected = bank.read(rows)
    log_f, posterior = bank.merge(rows, copies, np.array([0, 1]), np.array([-750.0]))
    assert (log_f, posterior) == (-750.0, 0.0)
    for now, then in zip(bank.read(rows), expected, strict=True):
        np.testing.assert_allclose(now, then, rtol=1e-14)


@pytest.mark.parametrize("backend", BACKENDS)
def test_rows_that_are_not_in_use_are_refused_everywhere(backend):
    bank = Bank(2, (2,), capacity=8, backend=backend)
    rows = bank.add(belief_of(1.0, 3))
    bank.remove(rows[1:2])
    one, z = np.eye(2)[None, None], np.zeros((1, 1))
    H, R = np.ones((1, 1, 1, 2)), np.ones((1, 1, 1, 1))
    uses = {
        "remove": bank.remove,
        "read": bank.read,
        "write": lambda r: bank.write(r, belief_of(0.0)),
        "take": bank.take,
        "put": lambda r: bank.put(r, bank, rows[:1]),
        "moments": bank.moments,
        "step": lambda r: bank.step(r, [None], one, None, one),
        "score": lambda r: bank.score(r, z, H, None, R),
        "update": lambda r: bank.update(r, z, H, None, R),
    }
    for use in uses.values():
        for row in (rows[1], 7, 8, -1, 10**12):  # removed, never added, beyond the end, before the start
            with pytest.raises(ModelError, match=f"row {row} is not in this bank: it was never added, or has been rem"):
                use(np.array([row]))
    assert len(bank) == 2 and values(bank, rows[[0, 2]]) == [1.0, 3.0]


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_row_named_twice_is_refused_where_rows_change(backend):
    bank = Bank(2, (2,), backend=backend)
    rows = bank.add(belief_of(1.0, 3))
    twice, one = rows[[0, 2, 0]], np.eye(2)[None, None]
    H, R = np.ones((1, 1, 1, 2)), np.ones((1, 1, 1, 1))
    for use in (
        lambda: bank.remove(twice),
        lambda: bank.step(twice, [None], one, None, one),
        lambda: bank.update(twice, np.zeros((3, 1)), H, None, R),
        lambda: bank.put(twice, bank, rows),
        lambda: bank.write(twice, belief_of(0.0, 3)),
    ):
        with pytest.raises(ModelError, match=f"row {rows[0]} is named twice"):
            use()
    bank.remove(rows)
    two = bank.add(belief_of(5.0, 2))
    assert len(set(two.tolist())) == 2 == len(bank)


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_is_measured_is_checked(backend):
    bank = Bank(2, (2,), backend=backend)
    rows = bank.add(belief_of(1.0, 2))
    before = bank.read(rows)
    H, R = np.ones((1, 1, 1, 2)), np.ones((1, 1, 1, 1))
    for what in (bank.update, bank.score):
        for bad in (np.inf, -np.inf):
            with pytest.raises(DataError, match=r"z\[1, 0\] is infinite\. A missing component is NaN"):
                what(rows, np.array([[0.0], [bad]]), H, None, R)
        with pytest.raises(ModelError, match=r"z has shape \(1, 1\); it is \(k, m\)"):
            what(rows, np.zeros((1, 1)), H, None, R)
    for a, b in zip(before, bank.read(rows), strict=True):
        np.testing.assert_array_equal(a, b)
    far = np.array([[0.0], [1e200]])
    assert bank.score(rows, far, H, None, R)[1][1] == -np.inf  # how far away it is may be asked
    with pytest.raises(DataError, match=r"component 0 measures 1e\+200"):
        bank.update(rows, far, H, None, R)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("part", "value", "kind", "message"),
    [
        ("log_probs", [[0.0]], ModelError, r"log_probs of a belief has shape \(1, 1\); in this bank it is \(1, 2\)"),
        ("means", [[[0.0, np.nan], [0.0, 0.0]]], DataError, r"means\[0, 0, 1\] of a belief is nan"),
        ("covs", np.ones((1, 2, 3, 3)), ModelError, r"covs of a belief has shape"),
        ("log_probs", [[0.0, np.nan]], DataError, r"log_probs\[0, 1\] of a belief is nan"),
        ("log_probs", [[0.5, 0.5]], DataError, r"log_probs\[0, 0\] of a belief is 0.5"),
    ],
)
def test_a_belief_that_is_none_is_refused(backend, part, value, kind, message):
    bank = Bank(2, (2,), backend=backend)
    with pytest.raises(kind, match=message):
        bank.add(belief_of(0.0)._replace(**{part: np.asarray(value)}))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"F": np.eye(3)[None, None]}, "F has shape"),
        ({"Q": np.ones((2, 1, 2, 2))}, "Q has shape"),
        ({"trans": [np.eye(3)]}, "trans.* has shape"),
        ({"trans": []}, "one transition matrix"),
        ({"H": np.ones((1, 1, 2, 2))}, "H has shape"),
        ({"R": np.ones((1, 3, 1, 1))}, "R has shape"),
    ],
)
def test_arrays_that_do_not_fit_a_bank(backend, change, message):
    bank = Bank(2, (2,), backend=backend)
    rows = bank.add(belief_of(1.0, 3))
    one = np.eye(2)[None, None]
    a = {"trans": [None], "F": one, "Q": one, "H": np.ones((1, 1, 1, 2)), "R": np.ones((1, 1, 1, 1))} | change
    with pytest.raises(ModelError, match=message):
        bank.step(rows, a["trans"], a["F"], None, a["Q"])
        bank.update(rows, np.zeros((3, 1)), a["H"], None, a["R"])
