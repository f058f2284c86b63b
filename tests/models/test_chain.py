import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm

from saltus.errors import ModelError
from saltus.models import Chain


@st.composite
def rates(draw):
    n = draw(st.integers(2, 4))
    off = draw(arrays(np.float64, (n, n), elements=st.floats(0.01, 3)))
    np.fill_diagonal(off, 0.0)
    return off - np.diag(off.sum(axis=1))


def chain_of(rates):
    return Chain("c", [f"s{i}" for i in range(len(rates))], rates=rates)


@given(rates(), st.floats(0, 5), st.floats(0, 5))
@settings(deadline=None)
def test_over_a_and_b_is_over_a_then_b(rates, a, b):
    chain = chain_of(rates)
    both = chain.transition([a, b, a + b])
    np.testing.assert_allclose(both[2], both[0] @ both[1], atol=1e-13)
    np.testing.assert_allclose(both.sum(axis=-1), 1, atol=1e-14)
    assert both.min() >= 0
    np.testing.assert_allclose(both, [expm(rates * t) for t in (a, b, a + b)], atol=1e-12)


@given(rates())
@settings(deadline=None)
def test_stationary_law_stays(rates):
    chain = chain_of(rates)
    np.testing.assert_allclose(chain.law @ chain.transition(1.7), chain.law, atol=1e-13)
    np.testing.assert_allclose(chain.law @ rates, 0, atol=1e-13)


@given(rates(), st.floats(0.05, 2.0))
@settings(deadline=None)
def test_matrix_with_a_time_finds_its_rates(rates, per):
    rates = rates / np.abs(rates).max()  # one jump per 1/rate: the logarithm stays on its branch
    trans = expm(rates * per)
    chain = Chain("c", [f"s{i}" for i in range(len(rates))], trans=trans, per=per)
    np.testing.assert_allclose(chain.transition([per, per / 3]), [trans, expm(rates * per / 3)], atol=1e-9)


def test_two_states_in_closed_form():
    chain = Chain("radar", {"ok": 1.0, "jammed": 10.0}, sojourn={"ok": 600.0, "jammed": 20.0})
    out, back = 1 / 600, 1 / 20
    np.testing.assert_allclose(chain.law, [600 / 620, 20 / 620], rtol=1e-14)
    dt = np.array([[0.0, 1e-6], [30.0, 1e9]])
    decay = np.exp(-(out + back) * dt)
    trans = chain.transition(dt)
    assert trans.shape == (2, 2, 2, 2)
    np.testing.assert_allclose(trans[..., 0, 0], (back + out * decay) / (out + back), rtol=1e-13)
    lost = -np.expm1(-(out + back) * dt) * out / (out + back)
    np.testing.assert_allclose(trans[..., 0, 1], lost, rtol=1e-12)


def test_rows_are_from():
    chain = Chain("c", ["a", "b"], trans=[[0.9, 0.1], [0.5, 0.5]])
    np.testing.assert_allclose(chain.transition(1.0)[0], [0.9, 0.1])
    np.testing.assert_allclose(chain.law, [5 / 6, 1 / 6])


def test_stay_scalar_and_per_label():
    chain = Chain("c", {"a": 1, "b": 2, "d": 3}, stay={"a": 0.9, "b": 0.5, "d": 1.0}, initial=[1, 0, 0])
    np.testing.assert_allclose(chain.trans, [[0.9, 0.05, 0.05], [0.25, 0.5, 0.25], [0, 0, 1]])
    turn = Chain("manoeuvre", {"cruise": 3.0, "turn": 35.0}, stay=0.9, per=4.0)
    np.testing.assert_allclose(turn.transition(4.0), [[0.9, 0.1], [0.1, 0.9]], atol=1e-15)
    np.testing.assert_allclose(turn.transition(8.0), [[0.82, 0.18], [0.18, 0.82]], atol=1e-15)
    np.testing.assert_allclose(turn.transition(2.0)[0, 1], (1 - np.sqrt(0.8)) / 2, rtol=1e-13)


def test_sojourn_may_be_endless():
    chain = Chain("c", ["ok", "dead"], sojourn={"ok": 100.0, "dead": np.inf}, initial={"ok": 1, "dead": 0})
    np.testing.assert_allclose(chain.transition(50.0), [[np.exp(-0.5), -np.expm1(-0.5)], [0, 1]], rtol=1e-13)


def test_per_step_serves_equal_intervals():
    chain = Chain("c", ["a", "b"], stay=0.8)
    steps = chain.transition([0.0, 4.0, 4.0001])
    np.testing.assert_array_equal(steps[0], np.eye(2))
    np.testing.assert_allclose(steps[1:], [chain.trans] * 2)
    with pytest.raises(ModelError, match=r"chain 'c' is per step and needs equal intervals.*1 to 4 s.*\n.*per="):
        chain.transition([1.0, 4.0])


def test_matrix_without_generator_serves_multiples():
    flip = Chain("c", ["a", "b"], trans=[[0.1, 0.9], [0.9, 0.1]], per=2.0)
    np.testing.assert_allclose(flip.transition([0.0, 2.0, 4.0])[2], [[0.82, 0.18], [0.18, 0.82]])
    with pytest.raises(ModelError, match=r"cannot jump over 3 s.*only multiples"):
        flip.transition(3.0)


def test_memoryless_is_drawn_at_every_measurement():
    plot = Chain("plot", {"good": 1.0, "outlier": 10.0}, trans=[[0.95, 0.05]] * 2)
    assert plot.memoryless
    np.testing.assert_allclose(plot.transition([0.0, 1.0, 7.0]), np.broadcast_to([0.95, 0.05], (3, 2, 2)))
    assert not Chain("c", ["a", "b"], stay=0.9).memoryless
    assert not Chain("c", ["a", "b"], sojourn={"a": 1, "b": 1}).memoryless


def test_transient_states_have_no_stationary_mass():
    chain = Chain("c", ["u", "v", "w"], trans=[[0, 1, 0], [0, 0.5, 0.5], [0, 1, 0]])
    np.testing.assert_allclose(chain.law, [0, 2 / 3, 1 / 3], atol=1e-15)


def test_stationary_law_of_very_different_rates():
    # 1e-9/s against 1/s: the law is their ratio to full precision.
    chain = Chain("c", ["a", "b"], rates=[[-1e-9, 1e-9], [1.0, -1.0]])
    assert chain.law[1] == pytest.approx(1e-9 / (1 + 1e-9), rel=1e-14)


def test_compares_prints_and_pickles():
    one, other = (Chain("c", {"a": 1.0, "b": 2.0}, stay=0.9, per=p) for p in (4.0, 5.0))
    assert pickle.loads(pickle.dumps(one)) == one != other
    assert "name='c'" in repr(one) and "per=4.0" in repr(one)
    assert one.labels == ("a", "b") and one.values == (1.0, 2.0) and one.index("b") == 1
    assert Chain("c", ["a", "b"], stay=0.9).values == ("a", "b")


AB = ["a", "b"]
BAD = [
    (dict(), "exactly one of trans=, stay=, sojourn=, rates=; got none"),
    (dict(stay=0.9, trans=np.eye(2)), "got trans, stay"),
    (dict(trans=[[0.9, 0.1]]), r"must have shape \(2, 2\)"),
    (dict(trans=[[0.9, 0.1], [0.27, 0.7]]), r"row 1 \(b\) sums to 0.97.\nPass probabilities \*from\*"),
    (dict(trans=[[0.9, 0.3], [0.1, 0.7]]), "transpose it"),
    (dict(trans=[[1.1, -0.1], [0, 1]]), r"negative probability: \[0, 1\] = -0.1"),
    (dict(trans=[[np.nan, 0.1], [0, 1]]), r"holds nan at index \[0, 0\]"),
    (dict(rates=[[-1.0, 1.0]]), r"rates of chain 'c' must have shape \(2, 2\)"),
    (dict(rates=[[1.0, -1.0], [1.0, -1.0]]), r"\[0, 1\] = -1, but rates between states must not be negative"),
    (dict(rates=[[-1.0, 1.0], [1.0, -2.0]]), r"rows must sum to 0, row 1 \(b\) sums to -1"),
    (dict(rates=[[-1.0, 1.0], [1.0, -1.0]], per=2.0), "rates= is already in seconds"),
    (dict(stay=0.9, per=0.0), "per must be a positive number"),
    (dict(stay=1.2), "stay must be a probability"),
    (dict(stay={"a": 0.9}), "stay must name each state once: states are a, b; got a"),
    (dict(sojourn={"a": 10.0, "b": 0.0}), "must be positive seconds, got 0.0 for 'b'"),
    (dict(sojourn={"a": 10.0, "b": "x"}), "sojourn must be numbers"),
    (dict(stay=1.0), "more than one stationary law.*\nSay where it starts: initial="),
    (dict(stay=0.9, initial=[0.5, 0.6]), "must be probabilities that sum to 1"),
    (dict(stay=0.9, initial=[1.0]), "must have 2 entries"),
    (dict(stay=0.9, initial={"a": 1.0, "z": 0.0}), "initial must name each state once"),
]


@pytest.mark.parametrize("words, message", BAD)
def test_bad_descriptions(words, message):
    with pytest.raises(ModelError, match=message):
        Chain("c", AB, **words)


@pytest.mark.parametrize(
    "name, states, message",
    [
        ("dt", AB, "a word other than x, t, dt"),
        ("", AB, "a chain's name must be a word"),
        ("c", [], "needs states"),
        ("c", ["a", "a"], "two states called 'a'"),
    ],
)
def test_bad_names(name, states, message):
    with pytest.raises(ModelError, match=message):
        Chain(name, states, stay=0.9)


def test_unknown_label_and_interval():
    chain = Chain("c", AB, stay=0.9)
    with pytest.raises(ModelError, match="no state 'z'; it has a, b"):
        chain.index("z")
    with pytest.raises(ModelError, match="must not be negative"):
        chain.transition(-1.0)
