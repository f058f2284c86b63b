"""Algebra on stacks of small matrices, where NumPy has no word for it."""

import numpy as np

from saltus.shapes import Float

__all__ = [
    "NOTHING",
    "block_diagonal",
    "cholesky",
    "gaussian_terms",
    "logsumexp",
    "normalised",
    "quadratic_form",
    "symmetric",
]

NOTHING = 2.0**-1000  # a variance below it is none: its reciprocal would overflow
_ROUNDING = 2.0 * float(np.finfo(np.float64).eps)  # share of a variance below which what is left of it is rounding


def symmetric(a: Float[np.ndarray, "*lead n n"]) -> Float[np.ndarray, "*lead n n"]:
    """Return (A + A') / 2."""
    return np.asarray(0.5 * (a + a.swapaxes(-1, -2)))


def quadratic_form(
    a: Float[np.ndarray, "*lead p n"], b: Float[np.ndarray, "*other n n"]
) -> Float[np.ndarray, "*both p p"]:
    """Return A B A', symmetric when B is."""
    return symmetric(a @ b @ a.swapaxes(-1, -2))


def logsumexp(a: Float[np.ndarray, "*shape"], axes: tuple[int, ...]) -> Float[np.ndarray, "*reduced"]:
    """Return log sum exp over `axes`, kept as axes of length 1; -inf where every term is.

    scipy.special.logsumexp does the same through the array-API layer at ten times the price per call.
    """
    top = np.max(a, axis=axes, keepdims=True, initial=-np.inf)
    shift = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(np.sum(np.exp(a - shift), axis=axes, keepdims=True)) + shift)


def normalised(
    log_w: Float[np.ndarray, "*shape"], axes: tuple[int, ...]
) -> tuple[Float[np.ndarray, "*shape"], Float[np.ndarray, "*reduced"]]:
    """Return log w - log sum w, and log sum w with `axes` kept as axes of length 1.

    The greatest is subtracted first: weights sum to 1 to rounding whatever their size, where subtracting the logarithm
    of the sum would leave its rounding, 2 nats at 1e16. Where no weight is possible (the sum is 0) none becomes so.
    """
    top = np.max(log_w, axis=axes, keepdims=True, initial=-np.inf)
    shift = np.where(np.isfinite(top), top, 0.0)
    near = log_w - shift
    with np.errstate(divide="ignore"):
        log_sum = np.log(np.sum(np.exp(near), axis=axes, keepdims=True))
    return np.asarray(near - np.where(log_sum > -np.inf, log_sum, 0.0)), np.asarray(log_sum + shift)


def cholesky(P: Float[np.ndarray, "*lead n n"]) -> Float[np.ndarray, "*lead n n"]:
    """Return lower triangular L with L L' = P, for singular P too: where nothing is left, its column is zero.

    What rounding has left of a variance, or has taken from it below zero, is nothing: L L' is positive semidefinite
    whatever P is.
    """
    try:
        L = np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        return _semidefinite(np.asarray(P))
    pivots, variances = (np.diagonal(a, axis1=-2, axis2=-1) for a in (L, P))
    rounding = np.square(pivots) <= np.maximum(P.shape[-1] * _ROUNDING * variances, NOTHING)
    return _semidefinite(np.asarray(P)) if rounding.any() else L


def _semidefinite(P: Float[np.ndarray, "*lead n n"]) -> Float[np.ndarray, "*lead n n"]:
    """Cholesky's columns one by one; a pivot at rounding ends its column. NaN stays NaN, and what overflowed is NaN."""
    n = P.shape[-1]
    L = np.zeros_like(P)
    for j in range(n):
        rest = P[..., :, j] - (L[..., :, :j] @ L[..., j, :j, None])[..., 0]
        pivot = rest[..., j]
        nothing = pivot <= np.maximum(n * _ROUNDING * P[..., j, j], NOTHING)
        column = rest / np.sqrt(np.where(nothing, 1.0, pivot))[..., None]
        L[..., j:, j] = np.where(nothing[..., None], 0.0, column[..., j:])
        with np.errstate(invalid="ignore"):
            L[..., j, j] += 0.0 * pivot
    return L


def gaussian_terms(
    nu: Float[np.ndarray, "*lead m"], S: Float[np.ndarray, "*lead m m"]
) -> tuple[Float[np.ndarray, "*lead"], Float[np.ndarray, "*lead"], Float[np.ndarray, "*lead m m"]]:
    """Return nu' S^-1 nu, log det S and L^-1 with S = L L'.

    Raises:
        numpy.linalg.LinAlgError: an S is not positive definite.
    """
    L = np.linalg.cholesky(S)
    L_inv = np.linalg.inv(L)
    white = (L_inv @ nu[..., None])[..., 0]
    logdet = 2.0 * np.log(np.diagonal(L, axis1=-2, axis2=-1)).sum(-1)
    with np.errstate(over="ignore"):  # a distance may be infinite
        d2 = np.asarray(np.sum(white * white, axis=-1))
    return d2, np.asarray(logdet), L_inv  # arrays without leading axes too


def block_diagonal(*blocks: Float[np.ndarray, "..."]) -> Float[np.ndarray, "*lead p p"]:
    """Set square matrices (..., n_i, n_i) along the diagonal; leading axes broadcast from the right."""
    lead = np.broadcast_shapes(*(a.shape[:-2] for a in blocks))
    ends = np.cumsum([a.shape[-1] for a in blocks])
    out = np.zeros((*lead, ends[-1], ends[-1]))
    for a, end in zip(blocks, ends, strict=True):
        out[..., end - a.shape[-1] : end, end - a.shape[-1] : end] = a
    return out
