"""Histories of modes, a Gaussian each, and the one rule by which they are merged and dropped.

Source: Runnalls (2007), Kullback-Leibler approach to Gaussian mixture reduction, IEEE Trans. AES 43(3), section IV.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.filters import steps
from saltus.linalg import normalised

__all__ = ["EXACT", "GPB1", "GPB2", "INTERACTING", "Histories", "MergingRule", "merged"]

_Array = npt.NDArray[np.float64]
_Codes = npt.NDArray[np.int64]
_MOST_CODES = 1 << 40


@dataclass(frozen=True, slots=True)
class MergingRule:
    """Which histories of modes are merged, and how many are kept.

    Attributes:
        last: histories that agree in this many of their last modes are merged; None merges none. With 0 all are merged
            into one Gaussian beside the law of the modes.
        before: merge between branching and propagation, as the IMM does, instead of after the update.
        most: histories kept after each update, the most probable ones; None keeps all.

    Raises:
        ModelError: a number out of range, or merging of nothing `before`.
    """

    last: int | None = None
    before: bool = False
    most: int | None = None

    def __post_init__(self) -> None:
        if self.last is not None and self.last < int(self.before):
            raise ModelError(
                f"last = {self.last}: give a number of modes from {int(self.before)}"
                + (": histories merged before propagation agree at least in their newest mode." if self.before else ".")
            )
        if self.before and self.last is None:
            raise ModelError("before=True says when to merge: say with last= which histories.")
        if self.most is not None and self.most < 1:
            raise ModelError(f"most must be at least 1 history, got {self.most}.")


EXACT = MergingRule()
GPB1 = MergingRule(last=0)
GPB2 = MergingRule(last=1)
INTERACTING = MergingRule(last=1, before=True)


class Histories(NamedTuple):
    """B runs, H histories: log P(history, current mode), the modes they went through, a Gaussian each."""

    log_probs: _Array  # (B, H, M); -inf but for the newest mode, unless all modes share the Gaussian
    codes: _Codes  # (B, H): the last modes, newest in the lowest place of a number with base M
    means: _Array  # (B, H, n)
    covs: _Array  # (B, H, n, n)


def merged(now: Histories, n_groups: int) -> tuple[Histories, _Array]:
    """Merge histories of equal code by their moments; returns what that costs at most, in nats per run.

    A group that no history reaches gets the moments of all, and probability 0.
    """
    if n_groups > _MOST_CODES:
        raise ModelError("last= asks for more combinations of modes than can be told apart; use fewer, or most=.")
    (B, H), n = now.codes.shape, now.means.shape[-1]
    log_probs = now.log_probs[..., 0]
    into = now.codes + n_groups * np.arange(B)[:, None]
    w = np.exp(log_probs)

    def total(values: _Array) -> _Array:
        """Sum (B, H, p) over the histories of each group: (B, groups, p)."""
        columns = np.moveaxis(values, -1, 0).reshape(values.shape[-1], B * H)
        sums = [np.asarray(np.bincount(into.ravel(), c, B * n_groups), np.float64) for c in columns]
        return np.stack(sums, -1).reshape(B, n_groups, -1)

    top = np.full(B * n_groups, -np.inf)
    np.maximum.at(top, into.ravel(), log_probs.ravel())
    reached = np.isfinite(top)
    share = np.exp(log_probs - np.where(reached, top, 0.0)[into])
    scale = total(share[..., None])[..., 0].reshape(-1)
    share = share / np.where(reached, scale, 1.0)[into]
    with np.errstate(divide="ignore"):
        group_log_probs = (np.log(scale) + np.where(reached, top, 0.0)).reshape(B, n_groups)
    mean, cov = steps.collapse(normalised(log_probs, (1,))[0], now.means, now.covs, 1)
    there = reached.reshape(B, n_groups)
    means = np.where(there[..., None], total(share[..., None] * now.means), mean[:, None])
    spread = now.means - means.reshape(-1, n)[into]
    whole = now.covs + spread[..., :, None] * spread[..., None, :]
    covs = total((share[..., None, None] * whole).reshape(B, H, n * n)).reshape(B, n_groups, n, n)
    covs = np.where(there[..., None, None], covs, cov[:, None])
    alone = np.bincount(into.ravel(), (w > 0).ravel(), B * n_groups)[into] < 2
    cost = _merging_cost(w, alone, now.covs, covs.reshape(-1, n, n)[into])
    groups = np.broadcast_to(np.arange(n_groups), (B, n_groups))
    return Histories(group_log_probs[..., None], groups, means, covs), cost


def _merging_cost(w: _Array, alone: npt.NDArray[np.bool_], before: _Array, after: _Array) -> _Array:
    counts = (w > 0) & ~alone
    if not counts.any():
        return np.zeros(len(w))
    one = np.eye(before.shape[-1])
    here = counts[..., None, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = np.linalg.slogdet(np.where(here, after, one))[1] - np.linalg.slogdet(np.where(here, before, one))[1]
    return np.asarray(
        0.5 * np.maximum(np.sum(w * np.where(np.isfinite(gain), gain, np.inf), axis=1, where=counts), 0.0)
    )
