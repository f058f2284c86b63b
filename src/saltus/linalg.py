"""Algebra on stacks of small matrices, where NumPy has no word for it."""

import numpy as np

from saltus.shapes import Float

__all__ = ["block_diagonal", "gaussian_terms", "logsumexp", "quadratic_form", "symmetric"]


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
    return np.asarray(np.sum(white * white, axis=-1)), np.asarray(logdet), L_inv  # arrays without leading axes too


def block_diagonal(*blocks: Float[np.ndarray, "..."]) -> Float[np.ndarray, "*lead p p"]:
    """Set square matrices (..., n_i, n_i) along the diagonal; leading axes broadcast from the right."""
    lead = np.broadcast_shapes(*(a.shape[:-2] for a in blocks))
    ends = np.cumsum([a.shape[-1] for a in blocks])
    out = np.zeros((*lead, ends[-1], ends[-1]))
    for a, end in zip(blocks, ends, strict=True):
        out[..., end - a.shape[-1] : end, end - a.shape[-1] : end] = a
    return out
