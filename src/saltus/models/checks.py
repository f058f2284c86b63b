"""Checks that descriptions share: finite numbers, covariances, intervals, equality by value."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.text import brief

__all__ = [
    "FloatArray",
    "axes",
    "covariance",
    "equal_intervals",
    "intervals",
    "numbers",
    "probability",
    "same",
    "unit_steps",
]

FloatArray: TypeAlias = npt.NDArray[np.float64]

_MOST_AXES = 1000  # matrices of the state beyond it outgrow any memory
_EQUAL_INTERVALS = 1e-3  # relative: clocks are quantised, a step is still a step


def numbers(value: object, what: str) -> FloatArray:
    """Copy a value into a read-only float64 array of finite numbers.

    Raises:
        ModelError: `what` is ragged, not real numbers, or holds NaN or inf.
    """
    try:
        array = np.array(value)
    except ValueError:
        rows = [len(r) for r in value if isinstance(r, list | tuple)] if isinstance(value, list | tuple) else []
        told = f": {', '.join(map(str, rows))}" if len(set(rows)) > 1 else ""
        raise ModelError(f"{what} is not an array: its rows differ in length{told}.") from None
    if array.dtype.kind not in "biuf":
        raise ModelError(f"{what} must be real numbers, got {brief(value)}.")
    array = array.astype(np.float64)
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        index = tuple(int(i) for i in bad[0])
        where = f" at index {list(index)}" if index else ""
        raise ModelError(f"{what} holds {array[index]}{where}; give a finite number.")
    array.flags.writeable = False
    return array


def axes(kind: str, dims: object) -> None:
    """Refuse what is no number of axes or components, and one whose matrices no memory holds.

    Raises:
        ModelError: `dims` is no whole number from 1 to 1000.
    """
    if not isinstance(dims, int) or isinstance(dims, bool) or not 1 <= dims <= _MOST_AXES:
        raise ModelError(f"dims must be a positive whole number of {kind}, got {brief(dims)}; at most {_MOST_AXES}.")


def covariance(value: object, what: str) -> FloatArray:
    """Check covariances (..., n, n): symmetric and positive semi-definite, judged in units of their own diagonal.

    Raises:
        ModelError: not square, not symmetric, or a negative eigenvalue.
    """
    array = numbers(value, what)
    if array.ndim < 2 or array.shape[-1] != array.shape[-2]:
        raise ModelError(
            f"{what} must be a covariance matrix (n, n), got shape {array.shape}.\n"
            "Pass variances on the diagonal: np.diag(sigma**2)."
        )
    variance = np.diagonal(array, axis1=-2, axis2=-1)
    scale = np.sqrt(np.where(variance > 0, variance, 1.0))
    scaled = array / (scale[..., :, None] * scale[..., None, :])
    skew = np.abs(scaled - np.swapaxes(scaled, -1, -2))
    if array.size and skew.max() > 1e-8:
        i, j = np.unravel_index(int(skew.argmax()), skew.shape)[-2:]
        raise ModelError(
            f"{what} must be symmetric: entries [{i}, {j}] and [{j}, {i}] differ.\nSymmetrise it: (P + P.T) / 2."
        )
    if array.size and np.linalg.eigvalsh(scaled).min() < -1e-8:
        smallest = np.linalg.eigvalsh((array + np.swapaxes(array, -1, -2)) / 2).min()
        raise ModelError(
            f"{what} must be positive semi-definite: its smallest eigenvalue is {smallest:.6g}.\n"
            "Check signs, and that correlations stay within [-1, 1]."
        )
    array = (array + np.swapaxes(array, -1, -2)) / 2
    array.flags.writeable = False
    return array


def intervals(dt: object, what: str = "dt") -> FloatArray:
    """Check intervals in seconds: finite, not negative.

    Raises:
        ModelError: an interval is negative or not finite.
    """
    array = numbers(dt, what)
    if array.size and array.min() < 0:
        raise ModelError(f"{what} must not be negative, got {array.min():g} s. Sort measurements by time.")
    return array


def probability(value: float, what: str) -> None:
    """Refuse what is no positive probability.

    Raises:
        ModelError: the value does not lie in (0, 1].
    """
    if not isinstance(value, int | float | np.integer | np.floating) or not 0 < value <= 1:
        raise ModelError(f"{what} must lie in (0, 1], got {value!r}.")


def equal_intervals(steps: FloatArray) -> bool:
    """Whether positive intervals differ by no more than 0.1 %."""
    return not steps.size or bool(steps.max() - steps.min() <= _EQUAL_INTERVALS * steps.max())


def unit_steps(dt: FloatArray, what: str, remedy: str) -> npt.NDArray[np.int64]:
    """Count steps for a description that is per step: 0 where dt is 0, 1 elsewhere.

    Raises:
        ModelError: the positive intervals differ by more than 0.1 %.
    """
    positive = dt[dt > 0]
    if not equal_intervals(positive):
        raise ModelError(
            f"{what} is per step and needs equal intervals, "
            f"but they range from {positive.min():g} to {positive.max():g} s.\n{remedy}"
        )
    return np.asarray(dt > 0, dtype=np.int64)


def same(a: object, b: object) -> bool:
    """Compare two descriptions by value, arrays included."""
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return bool(np.array_equal(a, b))
    if is_dataclass(a) and not isinstance(a, type):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b)
