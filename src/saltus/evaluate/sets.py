"""Distances between a set of true positions and a set of estimates: OSPA and GOSPA."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError
from saltus.shapes import Float, Int

__all__ = ["GOSPA", "OSPA", "gospa", "ospa"]


class OSPA(NamedTuple):
    """OSPA distance and its parts, in the positions' units: distance^p = localisation^p + cardinality^p."""

    distance: float
    localisation: float
    cardinality: float


class GOSPA(NamedTuple):
    """GOSPA distance (units of the positions) and its parts: distance^p = localisation + missed + false.

    The parts are costs, already raised to the power p, so that they add up. `pairs` holds the indices
    (truth, estimate) of the assigned ones, (k, 2), in the order of the truth.
    """

    distance: float
    localisation: float
    missed: float
    false: float
    n_missed: int
    n_false: int
    pairs: Int[np.ndarray, "k 2"]


def ospa(truth: npt.ArrayLike, estimates: npt.ArrayLike, *, cutoff: float, order: float = 2.0) -> OSPA:
    """Optimal sub-pattern assignment distance between two sets of points.

    d = ( 1/n [ min over assignments sum min(c, |x_i - y_j|)^p + c^p (n - m) ] )^(1/p),  m <= n the two sizes

    Args:
        truth: true positions, (m, d).
        estimates: estimated positions, (n, d), same units; either may be empty.
        cutoff: c > 0: what a missing or surplus point costs at most, in the units of the positions.
        order: p >= 1.

    Returns:
        The distance with its localisation and cardinality parts; all 0 for two empty sets.

    Raises:
        DataError: shapes do not match or a coordinate is not finite.
        ModelError: cutoff or order out of range.

    Source: Schuhmacher, Vo, Vo (2008), definition of the OSPA metric.
    """
    d = _distances(truth, estimates, cutoff, order)
    small, large = min(d.shape), max(d.shape)
    if large == 0:
        return OSPA(0.0, 0.0, 0.0)
    costs = np.minimum(d, cutoff) ** order
    localisation = costs[_assign(costs)].sum() / large
    cardinality = cutoff**order * (large - small) / large
    distance = (localisation + cardinality) ** (1 / order)
    return OSPA(float(distance), float(localisation ** (1 / order)), float(cardinality ** (1 / order)))


def gospa(truth: npt.ArrayLike, estimates: npt.ArrayLike, *, cutoff: float, order: float = 2.0) -> GOSPA:
    """Generalised OSPA (alpha = 2): localisation of assigned pairs, plus c^p/2 for each missed or false one.

    d^p = min over partial assignments A of  sum_A |x_i - y_j|^p + c^p/2 (m - |A|) + c^p/2 (n - |A|)

    Args:
        truth: true positions, (m, d).
        estimates: estimated positions, (n, d), same units; either may be empty.
        cutoff: c > 0, in the units of the positions: a pair further apart is never assigned.
        order: p >= 1.

    Returns:
        The distance, its three parts, the counts and the assigned pairs.

    Raises:
        DataError: shapes do not match or a coordinate is not finite.
        ModelError: cutoff or order out of range.

    Source: Rahmathullah, Garcia-Fernandez, Svensson (2017), the assignment form for alpha = 2.
    """
    d = _distances(truth, estimates, cutoff, order)
    # A pair at the cut-off costs as much as one missed and one false: capping keeps the optimum, dropping the
    # capped pairs afterwards gives its partial assignment.
    rows, cols = _assign(np.minimum(d, cutoff) ** order)
    near = d[rows, cols] < cutoff
    rows, cols = rows[near], cols[near]
    localisation = float(np.sum(d[rows, cols] ** order))
    n_missed, n_false = d.shape[0] - len(rows), d.shape[1] - len(rows)
    half = cutoff**order / 2
    distance = (localisation + half * (n_missed + n_false)) ** (1 / order)
    pairs = np.stack([rows, cols], axis=1)
    return GOSPA(float(distance), localisation, half * n_missed, half * n_false, n_missed, n_false, pairs)


def _distances(truth: npt.ArrayLike, estimates: npt.ArrayLike, cutoff: float, order: float) -> Float[np.ndarray, "m n"]:
    if not (cutoff > 0 and np.isfinite(cutoff) and order >= 1):
        raise ModelError(f"need a finite cutoff > 0 and order >= 1: cutoff {cutoff}, order {order}")
    x, y = np.asarray(truth, np.float64), np.asarray(estimates, np.float64)
    if x.size == 0 or y.size == 0:
        return np.zeros((len(x), len(y)))
    if x.ndim != 2 or y.ndim != 2 or x.shape[1] != y.shape[1]:
        raise DataError(f"both sets must be (number, dimension) with one dimension: {x.shape}, {y.shape}")
    if not (np.all(np.isfinite(x)) and np.all(np.isfinite(y))):
        raise DataError("a coordinate is not finite: leave that point out of its set")
    return np.asarray(np.sqrt(np.square(x[:, None, :] - y[None, :, :]).sum(-1)))


def _assign(costs: Float[np.ndarray, "m n"]) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    from scipy.optimize import linear_sum_assignment

    rows, cols = linear_sum_assignment(costs)
    return rows, cols
