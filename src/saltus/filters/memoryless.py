"""Chains without memory: their axis costs no stored modes.

A chain whose rows are equal is drawn afresh at every measurement, so nothing about its present state helps to
predict the next. Between measurements the modes along its axis may be merged into one, and the next mixing, with one
row of the transition matrix, spreads them out again:

    belief = merge(belief, axis, n_chains)              # (..., 1, ...)
    belief = mix(*belief, [..., trans[:1], ...])        # (..., M, ...), the same as without the merge
"""

import numpy as np

from saltus.filters.steps import Belief, mix

__all__ = ["merge"]


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
