"""Chains without memory: their axis costs no stored modes.

A chain whose rows are equal is drawn afresh at every measurement, so nothing about its present state helps to
predict the next. Between measurements the modes along its axis may be merged into one, and the next mixing, with one
row of the transition matrix, spreads them out again:

    belief = merge(belief, axis, n_chains)              # (..., 1, ...)
    belief = mix(*belief, [..., trans[:1], ...])        # (..., M, ...), the same as without the merge

What such a chain may be at one measurement are hypotheses; where each was carried out on a copy of a belief, their
number may differ from belief to belief, and `merge_copies` puts the copies together.
"""

import numpy as np
import numpy.typing as npt

from saltus.filters.steps import FLOOR, Belief, mix
from saltus.linalg import symmetric
from saltus.shapes import Float

__all__ = ["merge", "merge_copies"]


def merge(belief: Belief, axis: int, n_chains: int) -> Belief:
    """Merge the modes along one chain's axis by moments; exact for all later rows if the chain has no memory.

    P = sum_i P_i,   x = sum_i P_i x_i / P,   R = sum_i P_i [R_i + (x_i - x)(x_i - x)'] / P

    For a chain with memory it is an approximation: what its state was is lost.

    Args:
        belief: log_probs (*lead, M1, ..., MC), means, covs.
        axis: position of the chain, counted from 0.
        n_chains: C.

    Returns:
        The belief with length 1 on that axis.

    Source: theory notes on fusion, section 5: with equal rows every sum over i is the same for every j.
    """
    size = belief.log_probs.shape[belief.log_probs.ndim - n_chains + axis]
    return mix(*belief, [np.ones((size, 1)) if c == axis else None for c in range(n_chains)])


def merge_copies(belief: Belief, start: npt.NDArray[np.intp], log_weights: Float[np.ndarray, " c"]) -> Belief:
    """Merge copies of beliefs, each group of them into one belief, mode by mode and by moments.

    With w_c the weights of one group's copies and its sums over them,

    P_j = sum_c w_c P_cj,   x_j = sum_c w_c P_cj x_cj / P_j,   R_j = sum_c w_c P_cj [R_cj + (x_cj - x_j)(.)'] / P_j

    Args:
        belief: log_probs (c, M1, ..., MC), means, covs of all copies.
        start: where each group begins, and c at the end: (k + 1,), no group empty.
        log_weights: log w of each copy, (c,), each group's sum of w being 1.

    Returns:
        The belief of every group, (k, M1, ..., MC).

    Source: theory notes on fusion, section 5, one axis of hypotheses.
    """
    log_probs, means, covs = belief
    first, group = start[:-1], np.repeat(np.arange(len(start) - 1), np.diff(start))
    if not len(first):
        return belief
    joint = log_weights.reshape(-1, *(1 for _ in log_probs.shape[1:])) + log_probs
    top = np.maximum.reduceat(joint, first, axis=0)
    top = np.where(np.isfinite(top), top, 0.0)
    weight = np.exp(joint - top[group])
    with np.errstate(divide="ignore"):
        merged = np.log(np.add.reduceat(weight, first, axis=0)) + top
    share = weight + FLOOR
    share = (share / np.add.reduceat(share, first, axis=0)[group])[..., None]
    mean = np.add.reduceat(share * means, first, axis=0)
    away = means - mean[group]
    cov = np.add.reduceat(share[..., None] * (covs + away[..., :, None] * away[..., None, :]), first, axis=0)
    return Belief(merged, mean, symmetric(cov))
