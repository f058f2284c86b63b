"""What is concluded from the probabilities of the modes: one mode and one estimate, by a stated loss.

Plain arrays: `probs (*lead, M1, ..., MC)`, `means (*lead, M1, ..., MC, n)`, `covs (*lead, M1, ..., MC, n, n)`, as in
the per-mode fields of `Estimates`.
"""

from math import prod
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError
from saltus.shapes import Float

__all__ = ["Decision", "decide", "decide_chains"]

_SUM = 1e-6  # how far a sum of probabilities may lie from 1

_Array = npt.NDArray[np.float64]


class Decision(NamedTuple):
    """A mode announced, the estimate announced with it, and how far that is off on average."""

    mode: tuple[int, ...] | tuple[npt.NDArray[np.int64], ...]  # index of each chain, () or (*lead)
    mean: Float[np.ndarray, "*lead n"]
    cov: Float[np.ndarray, "*lead n n"]  # mean-square matrix of the decided estimate over *all* modes


class _Modes(NamedTuple):
    """Checked arguments, the mode axes flattened to one in C order."""

    probs: _Array  # (*lead, M)
    means: _Array  # (*lead, M, n)
    covs: _Array  # (*lead, M, n, n)
    sizes: tuple[int, ...]


def decide(
    probs: npt.ArrayLike,
    means: npt.ArrayLike,
    covs: npt.ArrayLike,
    *,
    alpha: npt.ArrayLike = 1.0,
    beta: npt.ArrayLike = 0.0,
    scale: npt.ArrayLike | None = None,
    n_chains: int | None = None,
) -> Decision:
    """Decide on a mode and an estimate with the least expected loss.

    Loss: alpha for a wrong mode, beta (x - x^)' S (x - x^) for the right one. The Bayes rule is

        s = argmax_s P_s (alpha - beta tr(S R_s)),   x^ = X_s,   ties to the lowest flattened index;

    beta = 0 announces the most probable mode. The mean-square matrix of the announced estimate counts the modes that
    were not announced: C = sum_r P_r [R_r + (X_r - x^)(X_r - x^)'], never less than the covariance about the mean.

    Args:
        probs: P(modes), (*lead, M1, ..., MC).
        means: X, mean of each mode, (*lead, M1, ..., MC, n).
        covs: R, covariance of each mode, (*lead, M1, ..., MC, n, n).
        alpha: loss of a wrong mode, >= 0, one number or (*lead).
        beta: loss per unit of tr(S R), >= 0, one number or (*lead). An estimate worth more than a mode
            (beta tr(S R) > alpha) makes improbable modes attractive; the rule then says so.
        scale: S, (n, n), symmetric, makes mixed units comparable, for instance diag(1 / sd^2); the unit matrix by
            default.
        n_chains: C. By default the leading axes are the fewest that leave probabilities with sum 1, so that an axis
            of length 1 counts as a chain of one state.

    Returns:
        The decision; `mode` holds ints without leading axes, else index arrays (*lead).

    Raises:
        DataError: probabilities that are none, NaN or inf.
        ModelError: shapes that do not fit, a negative loss, or a scale that is not symmetric.

    Source: Detkov (2023), equations 3.15-3.17, corrected as the fusion notes, section 6: the sign before beta.
    """
    modes = _read(probs, means, covs, n_chains)
    lead, n = modes.probs.shape[:-1], modes.means.shape[-1]
    a, b = _loss("alpha", alpha, lead), _loss("beta", beta, lead)
    S = np.eye(n) if scale is None else _scale(scale, n)
    size = np.einsum("ij,...ji->...", S, modes.covs)
    best = np.asarray(np.argmax(modes.probs * (a[..., None] - b[..., None] * size), axis=-1))
    mean = np.take_along_axis(modes.means, best[..., None, None], axis=-2)[..., 0, :]
    return Decision(_chain_indices(best, modes.sizes), mean, _mean_square(modes, mean))


def decide_chains(
    probs: npt.ArrayLike, means: npt.ArrayLike, covs: npt.ArrayLike, *, n_chains: int | None = None
) -> Decision:
    """Decide on each chain by itself, and on the mean of all modes.

    Loss: 1 for each chain announced wrong, plus (x - x^)'(x - x^) whatever the mode. Its Bayes rule is the most
    probable state of every chain's marginal, and the posterior mean with the posterior covariance. The announced
    states together need not be the most probable joint mode, and may even exclude each other.

    Args:
        probs: P(modes), (*lead, M1, ..., MC).
        means: mean of each mode, (*lead, M1, ..., MC, n).
        covs: covariance of each mode, (*lead, M1, ..., MC, n, n).
        n_chains: C; by default read as by `decide`.

    Raises:
        DataError, ModelError: as `decide`.

    Source: theory notes on fusion, section 6, with a loss that adds over chains.
    """
    modes = _read(probs, means, covs, n_chains)
    lead = modes.probs.shape[:-1]
    table = modes.probs.reshape(*lead, *modes.sizes)
    axes = range(len(lead), table.ndim)
    best = [np.asarray(table.sum(axis=tuple(a for a in axes if a != c)).argmax(-1)) for c in axes]
    mean = (modes.probs[..., None, :] @ modes.means)[..., 0, :]
    index = tuple(b.astype(np.int64) for b in best) if lead else tuple(int(b) for b in best)
    return Decision(index, mean, _mean_square(modes, mean))


def _mean_square(modes: _Modes, mean: _Array) -> _Array:
    off = modes.means - mean[..., None, :]
    weighted = modes.probs[..., None] * off
    result = np.einsum("...m,...mij->...ij", modes.probs, modes.covs) + weighted.swapaxes(-1, -2) @ off
    return np.asarray((result + result.swapaxes(-1, -2)) / 2)


def _chain_indices(
    flat: npt.NDArray[np.intp], sizes: tuple[int, ...]
) -> tuple[int, ...] | tuple[npt.NDArray[np.int64], ...]:
    index = np.unravel_index(flat, sizes) if sizes else ()
    return tuple(np.asarray(i, np.int64) for i in index) if flat.ndim else tuple(int(i) for i in index)


def _read(probs: npt.ArrayLike, means: npt.ArrayLike, covs: npt.ArrayLike, n_chains: int | None) -> _Modes:
    p, x, R = (_finite(name, a) for name, a in (("probs", probs), ("means", means), ("covs", covs)))
    n_lead = _count_lead(p, n_chains)
    n = x.shape[-1] if x.ndim else 0
    for name, a, full in (("means", x, (*p.shape, n)), ("covs", R, (*p.shape, n, n))):
        if n == 0 or a.shape != full:
            raise ModelError(
                f"{name} has shape {a.shape}; with probs {p.shape} it must have the same axes, then those of the "
                f"state: {'(..., n)' if name == 'means' else full}. Filter with per_mode=True to get both."
            )
    lead, sizes = p.shape[:n_lead], p.shape[n_lead:]
    m = prod(sizes)  # spelt out: -1 cannot be told where there is no row
    return _Modes(p.reshape(*lead, m), x.reshape(*lead, m, n), R.reshape(*lead, m, n, n), sizes)


def _count_lead(p: _Array, n_chains: int | None) -> int:
    if (p < 0).any():
        raise DataError(f"probs holds {p.min():.6g}; a probability is at least 0.")
    if n_chains is not None and not 0 <= n_chains <= p.ndim:
        raise ModelError(f"n_chains = {n_chains}, but probs has {p.ndim} axes, {p.shape}.")
    for n_lead in range(p.ndim + 1) if n_chains is None else (p.ndim - n_chains,):
        totals = p.sum(axis=tuple(range(n_lead, p.ndim)))
        if (np.abs(totals - 1.0) <= _SUM).all():
            return n_lead
    where = "any choice of leading axes" if n_chains is None else f"the last {n_chains} axes"
    raise DataError(f"probs, of shape {p.shape}, must sum to 1 over the modes, but does not over {where}.")


def _finite(name: str, value: npt.ArrayLike) -> _Array:
    a = np.asarray(value, np.float64)
    if not np.isfinite(a).all():
        where = [int(i) for i in np.argwhere(~np.isfinite(a))[0]]
        raise DataError(f"{name}{where} is {a[tuple(where)]}; nothing can be decided from that.")
    return a


def _loss(name: str, value: npt.ArrayLike, lead: tuple[int, ...]) -> _Array:
    a = _finite(name, value)
    if (a < 0).any():
        raise ModelError(f"{name} is a loss and must not be negative, got {a.min():g}.")
    try:
        return np.broadcast_to(a, lead)
    except ValueError:
        raise ModelError(f"{name} must be one number or have the leading axes {lead}, got {a.shape}.") from None


def _scale(value: npt.ArrayLike, n: int) -> _Array:
    S = _finite("scale", value)
    if S.shape != (n, n) or np.abs(S - S.T).max() > 1e-9 * np.abs(S).max():
        raise ModelError(f"scale must be a symmetric matrix ({n}, {n}), got shape {S.shape}.")
    return S
