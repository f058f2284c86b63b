import numpy as np
import pytest

from saltus.errors import ModelError
from saltus.models import Chain
from saltus.models.dependence import TimeDependent, resolve

A = Chain("a", {"one": 1.0, "two": 2.0}, stay=0.9)
B = Chain("b", ["u", "v", "w"], stay=0.9)
CHAINS = [A, B]
R0 = np.array([[2.0, 0.5], [0.5, 1.0]])


def test_the_signature_says_what_depends_on_what():
    assert resolve(lambda: R0, CHAINS, "R", 2).shape == (1, 1, 2, 2)
    by_a = resolve(lambda a: a**2 * R0, CHAINS, "R", 2)
    assert by_a.shape == (2, 1, 2, 2)
    np.testing.assert_array_equal(by_a[1, 0], 4 * R0)
    both = resolve(lambda b, a, scale=10.0: scale * a * "uvw".index(b) * R0, CHAINS, "R", 2)
    assert both.shape == (2, 3, 2, 2)  # mode axes in the order of the chains, not of the parameters
    np.testing.assert_array_equal(both[1, 2], 40 * R0)


def test_a_function_is_called_once_per_combination():
    calls = []

    def R(a, b):
        calls.append((a, b))
        return R0

    resolve(R, CHAINS, "R", 2)
    assert sorted(calls) == [(a, b) for a in (1.0, 2.0) for b in "uvw"]


def test_a_table_is_the_same_as_a_function():
    table = {"by": {"b": {"u": R0, "v": 2 * R0, "w": {"by": {"a": {"one": 3 * R0, "two": 4 * R0}}}}}}
    got = resolve(table, CHAINS, "R", 2)

    def R(a, b):
        return {"u": 1, "v": 2, "w": 2 + a}[b] * R0

    np.testing.assert_array_equal(got, resolve(R, CHAINS, "R", 2))


def test_arrays_may_bring_their_mode_axes():
    stacked = np.stack([R0, 2 * R0, 3 * R0])[None]
    np.testing.assert_array_equal(resolve(stacked, CHAINS, "R", 2), stacked)
    assert resolve(R0, CHAINS, "R", 2).shape == (1, 1, 2, 2)
    assert resolve(R0, [], "R", 2).shape == (2, 2)
    assert resolve(3.0, CHAINS, "sigma", (2,)).tolist() == [[[3.0, 3.0]]]


def test_reserved_words_wait_for_times():
    value = resolve(lambda t, a: a * t * R0, CHAINS, "R", 2, ("t",))
    assert isinstance(value, TimeDependent)
    out = value.at(np.array([1.0, 5.0, 1.0]), np.zeros(3))
    assert out.shape == (3, 2, 1, 2, 2)
    np.testing.assert_array_equal(out[:, 1, 0, 0, 0], [4.0, 20.0, 4.0])
    with pytest.raises(ModelError, match="compile the model with times="):
        value.at(None, np.zeros(3))


def _star(*args):
    return R0


def _kwargs(**kwargs):
    return R0


@pytest.mark.parametrize(
    "value, message",
    [
        (lambda manoeuvre: R0, r"asks for 'manoeuvre', which is no chain of this model. Chains: a, b;"),
        (lambda x: R0, "asks for 'x', but here a matrix may depend on chains only"),
        (lambda t: R0, "asks for 't', but here"),
        (_star, "plain parameters named after chains"),
        (_kwargs, "plain parameters named after chains"),
        (np.add, "plain parameters named after chains"),
        (lambda a: np.eye(int(a)), r"R at a=two has shape \(2, 2\), but \(1, 1\)"),
        (lambda a: [[np.nan]], r"R at a=one holds nan at index \[0, 0\]"),
        (lambda a: a, r"R at a=one must be a matrix \(2 axes\), got shape \(\)"),
        (lambda a: "x", "R at a=one must be real numbers"),
        ({"a": {"one": R0}}, "a table must read .*got keys a"),
        ({"by": {"a": {"one": R0, "two": R0}, "b": {}}}, "one chain per level"),
        ({"by": {"z": {"one": R0}}}, "depends on 'z', which is no chain of this model. Chains: a, b"),
        ({"by": {"a": {"one": R0}}}, "one value for each of one, two; got one"),
        (np.zeros((2, 2, 2)), r"R has shape \(2, 2, 2\); expected 2 axes, or one mode axis per chain"),
        (np.zeros((3, 2, 2, 2)), r"\(2 or 1 \(a\), 3 or 1 \(b\), ...\)"),
        (np.zeros(2), r"R has shape \(2,\)"),
    ],
)
def test_bad_dependence(value, message):
    with pytest.raises(ModelError, match=message):
        resolve(value, CHAINS, "R", 2)


def test_vectors_must_fit():
    with pytest.raises(ModelError, match=r"sigma at a=one must be a number or have shape \(2,\)"):
        resolve(lambda a: [1.0, 2.0, 3.0], CHAINS, "sigma", (2,))
