"""The compiled bank against its definition: any order of operations, any rows."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from saltus.errors import ModelError
from saltus.filters import Bank, Belief
from strategies import law, random_cov, random_trans, rngs

some = settings(max_examples=40, deadline=None, derandomize=True)


def beliefs(rng, k, sizes, n):
    n_modes = int(np.prod(sizes))
    probs = law(rng, (k,), n_modes).reshape((k, *sizes))
    return Belief(np.log(probs), rng.normal(size=(k, *sizes, n)), random_cov(rng, (k, *sizes), n))


def axes(rng, k, sizes):
    """Leading axes an array may have: per row or not, each chain or not."""
    return (int(rng.choice([1, k])), *(int(rng.choice([1, s])) for s in sizes))


def dynamics(rng, k, sizes, n):
    def transition(size):
        kind = rng.integers(3)
        return None if kind == 0 else random_trans(rng, size, ((k,), ())[kind - 1])

    F = np.eye(n) + 0.1 * rng.normal(size=(*axes(rng, k, sizes), n, n))
    b = rng.normal(size=(*axes(rng, k, sizes), n)) if rng.random() < 0.5 else None
    return [transition(s) for s in sizes], F, b, random_cov(rng, axes(rng, k, sizes), n)


def measurement(rng, k, sizes, n, m):
    z = 3.0 * rng.normal(size=(k, m))
    z[rng.random(z.shape) < 0.2] = np.nan
    d = rng.normal(size=(*axes(rng, k, sizes), m)) if rng.random() < 0.5 else None
    return z, rng.normal(size=(*axes(rng, k, sizes), m, n)), d, random_cov(rng, axes(rng, k, sizes), m)


def close(actual, expected):
    for a, e in zip(actual, expected, strict=True):
        assert a.shape == e.shape
        np.testing.assert_allclose(a, e, rtol=1e-9, atol=1e-10)  # well-conditioned: round-off of a dozen steps


@some
@given(
    rng=rngs(),
    sizes=st.lists(st.integers(1, 3), max_size=3).map(tuple),
    n=st.integers(1, 10),
    m=st.integers(1, 5),
    n_rows=st.integers(1, 30),
)
def test_any_order_of_operations(rng, sizes, n, m, n_rows, isa, using):
    with using(isa):
        native = Bank(n, sizes, capacity=int(rng.integers(0, 5)), backend="native")
    numpy = Bank(n, sizes, capacity=3, backend="numpy")
    start = beliefs(rng, n_rows, sizes, n)
    pairs = np.stack([native.add(start), numpy.add(start)])
    assert len(native) == len(numpy) == n_rows
    for operation in rng.permutation(["step", "update", "score", "some", "take", "write"] * 2):
        k = n_rows if operation != "some" else int(rng.integers(1, n_rows + 1))
        mine, theirs = pairs[:, rng.permutation(n_rows)[:k]]
        if operation in ("step", "some"):
            model = dynamics(rng, k, sizes, n)
            native.step(mine, *model)
            numpy.step(theirs, *model)
        elif operation == "update":
            seen = measurement(rng, k, sizes, n, m)
            close(native.update(mine, *seen), numpy.update(theirs, *seen))
        elif operation == "score":
            choice = rng.integers(0, k, size=2 * k + 1)  # repeats
            seen = measurement(rng, len(choice), sizes, n, m)
            close(native.score(mine[choice], *seen), numpy.score(theirs[choice], *seen))
        elif operation == "take":
            choice = rng.integers(0, k, size=k)
            copies, originals = native.take(mine[choice]), numpy.take(theirs[choice])
            every = np.arange(k)
            model = dynamics(rng, k, sizes, n)
            copies.step(every, *model)
            originals.step(every, *model)
            close(copies.moments(every), originals.moments(every))
            native.put(mine, copies, every)
            numpy.put(theirs, originals, every)
        else:
            fresh = beliefs(rng, k, sizes, n)
            native.write(mine, fresh)
            numpy.write(theirs, fresh)
        close(native.read(mine), numpy.read(theirs))
        close(native.moments(mine), numpy.moments(theirs))


def test_rows_not_addressed_keep_every_bit(isa, using, rng):
    with using(isa):
        bank = Bank(3, (2,), backend="native")
    rows = bank.add(beliefs(rng, 21, (2,), 3))
    before = bank.read(rows)
    touched = rows[[0, 3, 4, 5, 19]]
    bank.step(touched, *dynamics(rng, 5, (2,), 3))
    bank.update(touched, *measurement(rng, 5, (2,), 3, 2))
    bank.score(rows, *measurement(rng, 21, (2,), 3, 2))
    rest = np.setdiff1d(rows, touched)
    for old, new in zip(before, bank.read(rest), strict=True):
        np.testing.assert_array_equal(new, old[rest])


def test_growth_keeps_rows_and_numbers_are_used_again(isa, using, rng):
    with using(isa):
        bank = Bank(2, (3,), capacity=1, backend="native")
    start = beliefs(rng, 100, (3,), 2)
    rows = np.concatenate([bank.add(Belief(*(a[i : i + 1] for a in start))) for i in range(100)])
    assert len(set(rows.tolist())) == 100
    for kept, given_ in zip(bank.read(rows), start, strict=True):
        np.testing.assert_allclose(kept, given_, rtol=1e-15)
    bank.remove(rows[:40])
    assert len(bank) == 60
    assert set(bank.add(beliefs(rng, 40, (3,), 2)).tolist()) == set(rows[:40].tolist())


def test_modes_of_probability_zero_and_far_outliers(isa, using, rng):
    with using(isa):
        native = Bank(2, (2, 2), backend="native")
    numpy = Bank(2, (2, 2), backend="numpy")
    start = beliefs(rng, 9, (2, 2), 2)
    start.log_probs[:5] = [[0.0, -np.inf], [-np.inf, -900.0]]
    rows = native.add(start)
    numpy.add(start)
    model = ([None, random_trans(rng, 2)], np.eye(2)[None, None, None], None, np.eye(2)[None, None, None])
    seen = measurement(rng, 9, (2, 2), 2, 2)
    seen[0][:] *= 1e3
    for bank in (native, numpy):
        bank.step(rows, *model)
    (d2, log_f), expected = native.update(rows, *seen), numpy.update(rows, *seen)
    np.testing.assert_allclose(d2, expected[0], rtol=1e-9)
    np.testing.assert_allclose(log_f, expected[1], rtol=1e-9)
    for a, e in zip(native.read(rows), numpy.read(rows), strict=True):
        np.testing.assert_allclose(a, e, rtol=1e-8, atol=1e-8)


def test_rows_that_do_not_exist_and_arrays_that_do_not_fit(rng):
    bank = Bank(2, (2,), capacity=8, backend="native")
    rows = bank.add(beliefs(rng, 3, (2,), 2))
    for wrong in (np.array([8]), np.array([-1]), np.array([10**12])):
        with pytest.raises(ModelError, match="not in this bank"):
            bank.read(wrong)
    trans, F, _, Q = [random_trans(rng, 2)], np.eye(2)[None, None], None, np.eye(2)[None, None]
    H, R = np.ones((1, 1, 1, 2)), np.ones((1, 1, 1, 1))
    with pytest.raises(ModelError, match="F has shape"):
        bank.step(rows, trans, np.eye(3)[None, None], None, Q)
    with pytest.raises(ModelError, match="Q has shape"):
        bank.step(rows, trans, F, None, np.ones((2, 1, 2, 2)))  # neither 1 nor 3 rows
    with pytest.raises(ModelError, match="trans has shape"):
        bank.step(rows, [random_trans(rng, 3)], F, None, Q)
    with pytest.raises(ModelError, match="one transition matrix"):
        bank.step(rows, [], F, None, Q)
    with pytest.raises(ModelError, match="z has shape"):
        bank.update(rows, np.zeros((2, 1)), H, None, R)
    with pytest.raises(ModelError, match="H has shape"):
        bank.update(rows, np.zeros((3, 1)), np.ones((1, 1, 2, 2)), None, R)
    with pytest.raises(ModelError, match="between banks"):
        bank.put(rows, Bank(3, (2,), capacity=8, backend="native"), rows)
    with pytest.raises(ModelError, match="1 to 256 states"):
        Bank(300, (2,), backend="native")
    with pytest.raises(ModelError, match=r"R is not positive semidefinite at index \[0, 0\]"):
        bank.update(rows, np.zeros((3, 1)), H, None, -100.0 * R)
    with pytest.raises(ModelError, match=r"Q is not positive semidefinite at index \[0, 0\]"):
        bank.step(rows, trans, F, None, -Q)


def test_other_types_and_strides(rng):
    bank, twin = Bank(3, (2,), backend="native"), Bank(3, (2,), backend="numpy")
    start = beliefs(rng, 12, (2,), 3)
    awkward = Belief(*(np.asfortranarray(a) for a in start))
    rows, same = bank.add(awkward), twin.add(start)
    trans, F, Q = [random_trans(rng, 2).T.copy().T], np.eye(3)[None, None], np.eye(3)[None, None]
    Q.flags.writeable = False
    for b, r in ((bank, rows), (twin, same)):
        b.step(r[::-2], trans, F[:, :, ::-1, ::-1], None, Q)
    close(bank.read(rows), twin.read(same))
    lanes = bank._store._lanes  # the binding itself, without the tests' type checks
    lanes.step(rows, trans, F.astype(np.float32), None, Q.astype(int))
    twin.step(same, trans, F, None, Q)
    close(bank.read(rows), twin.read(same))
    out = (np.empty((12, 3)), np.empty((12, 3, 3)), np.empty((12, 2)))
    for wrong in (rows.astype(np.float64), rows.astype(np.int32), rows > 3, rows.tolist(), rows[:, None]):
        with pytest.raises(TypeError):
            lanes.moments(wrong, *out)
    with pytest.raises(ModelError, match="wrong size"):
        lanes.moments(rows, out[0][:5], *out[1:])
    with pytest.raises(RuntimeError):  # outputs are never copies
        lanes.moments(rows, out[0].astype(np.float32), *out[1:])


@some
@given(
    rng=rngs(),
    sizes=st.lists(st.integers(1, 3), max_size=3).map(tuple),
    n=st.integers(1, 7),
    groups=st.lists(st.integers(1, 20), min_size=1, max_size=12),
)
def test_merged_copies(rng, sizes, n, groups, isa, using):
    c, start = sum(groups), np.concatenate([[0], np.cumsum(groups)])
    each = beliefs(rng, c, sizes, n)
    each.log_probs[rng.random(each.log_probs.shape) < 0.1] = -np.inf
    log_weights = 50.0 * rng.normal(size=c)
    log_weights[1 : groups[0]] = -np.inf
    rows = rng.permutation(40)[: len(groups)]
    nothing = beliefs(rng, 40, sizes, n)
    found = []
    for backend in ("native", "numpy"):
        with using(isa):
            copies, bank = (Bank(n, sizes, capacity=40, backend=backend) for _ in range(2))
        bank.add(nothing)
        numbers = copies.add(each)
        copies = copies.take(numbers)
        found.append((*bank.merge(rows, copies, start, log_weights), *bank.read(rows)))
    close(found[0][:2], found[1][:2])
    close([np.exp(found[0][2])], [np.exp(found[1][2])])
    close(found[0][3:], found[1][3:])


def test_copies_that_do_not_fit(rng):
    bank = Bank(2, (2,), capacity=8, backend="native")
    rows = bank.add(beliefs(rng, 3, (2,), 2))
    start, weights = np.array([0, 1, 2, 3]), np.zeros(3)
    lanes = bank._store._lanes
    with pytest.raises(ModelError, match="of another bank"):
        bank.merge(rows, bank, start, weights)
    with pytest.raises(ModelError, match="of another bank"):
        bank.merge(rows, Bank(3, (2,), capacity=8, backend="native"), start, weights)
    copies = bank.take(rows)
    with pytest.raises(ModelError, match="a copy per weight"):
        lanes.merge_copies(rows, copies._store._lanes, start, np.zeros(10**6))
    with pytest.raises(ModelError, match="from 0 to the number"):
        lanes.merge_copies(rows, copies._store._lanes, start + 1, weights)
    with pytest.raises(ModelError, match="every row has a copy"):
        lanes.merge_copies(rows, copies._store._lanes, np.array([0, 2, 1, 3]), weights)
    with pytest.raises(IndexError, match="not in this bank"):
        lanes.merge_copies(rows + 1000, copies._store._lanes, start, weights)
