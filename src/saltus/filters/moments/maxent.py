"""The maximum-entropy density with given moments: log-polynomial on a box, found by damped Newton steps.

omega(xi) = exp(lambda' psi(xi) - log N(lambda))  on |xi_i| <= L,   <psi> = h

lambda minimises the convex dual log N(lambda) - lambda' h, whose gradient is <psi> - h and whose Hessian is the
covariance of psi.

Source: moment-filter notes, section 4.4.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.filters.moments.basis import Basis, Rule, basis, gauss_legendre
from saltus.shapes import Bool, Float, Int

__all__ = ["Fit", "Tables", "fit", "gaussian_parameter", "tables"]

_Array = npt.NDArray[np.float64]

_CLOSE = 1e-7  # moments agree to this; the moments are of size 1
_MOST = 60  # evaluations
_RIDGE = 1e-11
_BACK = 1e-4  # share of the promised decrease that a step must bring


class Tables(NamedTuple):
    """What all fits of one order share: the basis on the nodes, and all products of two of its polynomials."""

    basis: Basis
    rule: Rule
    values: Float[np.ndarray, "a q"]  # without the constant
    columns: Float[np.ndarray, "q c"]  # psi, then psi_i psi_j for i >= j
    lower: tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]


class Fit(NamedTuple):
    """Parameters of densities, the probabilities of the nodes, and where Newton did not get there."""

    parameter: Float[np.ndarray, "r a"]  # of the polynomials of order >= 1
    log_norm: Float[np.ndarray, " r"]
    probs: Float[np.ndarray, "r q"]
    failed: Bool[np.ndarray, " r"]
    evaluations: int


@lru_cache(maxsize=16)
def tables(n: int, order: int, count: int, reach: float) -> Tables:
    """Tables of a basis on a Gauss-Legendre rule."""
    of, rule = basis(n, order), gauss_legendre(n, count, reach)
    psi = of.evaluate(rule.nodes)[:, 1:]
    i, j = np.tril_indices(psi.shape[1])
    columns = np.concatenate([psi, psi[:, i] * psi[:, j]], axis=1)
    return Tables(of, rule, np.ascontiguousarray(psi.T), np.ascontiguousarray(columns), (i, j))


def gaussian_parameter(of: Basis) -> Float[np.ndarray, " a"]:
    """Parameter of the standard normal density: -xi'xi / 2."""
    squares = (of.indices == 2).any(axis=-1) & (of.degree == 2)
    return np.where(squares, -np.sqrt(0.5), 0.0)[1:]


def fit(by: Tables, h: Float[np.ndarray, "r a"], start: Float[np.ndarray, "r a"]) -> Fit:
    """Fit densities to moments.

    Args:
        by: tables of the basis.
        h: moments of the polynomials of order >= 1, one row per density.
        start: parameters to start from.
    """
    n_rows = len(h)
    parameter, log_norm = start.copy(), np.zeros(n_rows)
    probs = np.empty((n_rows, by.values.shape[1]))
    rows = np.arange(n_rows)
    target, now = h, start.copy()
    log_n, p = _density(by, now)
    value = log_n - np.einsum("ra,ra->r", now, target)
    step, slope, done = _newton(by, p, target)
    length = np.ones(len(rows))
    count = 1
    while True:
        keep = ~done
        over = np.flatnonzero(done)
        parameter[rows[over]], log_norm[rows[over]], probs[rows[over]] = now[over], log_n[over], p[over]
        if not keep.any() or count >= _MOST:
            break
        if len(over):
            rows, target, now, value = rows[keep], target[keep], now[keep], value[keep]
            step, slope, length, log_n, p = step[keep], slope[keep], length[keep], log_n[keep], p[keep]
        tried = now + length[:, None] * step
        new_log_n, new_p = _density(by, tried)
        new_value = new_log_n - np.einsum("ra,ra->r", tried, target)
        count += 1
        good = new_value <= value + _BACK * length * slope + 1e-13 * np.abs(value)
        if good.all():
            now, log_n, p, value = tried, new_log_n, new_p, new_value
        else:
            now = np.where(good[:, None], tried, now)
            log_n, value = np.where(good, new_log_n, log_n), np.where(good, new_value, value)
            p = np.where(good[:, None], new_p, p)
        new_step, new_slope, done = _newton(by, p, target)
        length = np.where(good, 1.0, 0.5 * length)
        step, slope = np.where(good[:, None], new_step, step), np.where(good, new_slope, slope)
    failed = np.zeros(n_rows, dtype=bool)
    left = ~done
    failed[rows[left]] = True
    parameter[rows[left]], log_norm[rows[left]], probs[rows[left]] = now[left], log_n[left], p[left]
    return Fit(parameter, log_norm, probs, failed, count)


def _density(by: Tables, parameter: _Array) -> tuple[_Array, _Array]:
    """Log of the norm, and the probabilities of the nodes."""
    exponent = parameter @ by.values
    exponent += by.rule.log_weights
    top = exponent.max(axis=-1, keepdims=True)
    exponent -= top
    p = np.exp(exponent, out=exponent)
    total = p.sum(axis=-1, keepdims=True)
    p /= total
    return np.log(total[:, 0]) + top[:, 0], p


def _newton(by: Tables, p: _Array, h: _Array) -> tuple[_Array, _Array, npt.NDArray[np.bool_]]:
    """Newton steps, slopes along them, and which densities have their moments already."""
    size = h.shape[1]
    moments = p @ by.columns
    mean = moments[:, :size]
    gradient = mean - h
    done = np.abs(gradient).max(axis=-1) <= _CLOSE
    i, j = by.lower
    F = np.empty((len(p), size, size))
    F[:, i, j] = moments[:, size:] - mean[:, i] * mean[:, j]
    F[:, j, i] = F[:, i, j]
    F[:, range(size), range(size)] += _RIDGE * (1.0 + F[:, range(size), range(size)])
    step = -np.linalg.solve(F, gradient[..., None])[..., 0]
    return step, np.einsum("ra,ra->r", step, gradient), done
