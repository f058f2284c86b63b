"""Which pairs of local tracks are one object, as far as registration needs to know: the largest set that agrees."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.tracks.bias import GROUPS
from saltus.tracks.encounters import Blocks, medians

__all__ = ["accept_pairs"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]

_GATE = 9.21  # chi-square of two degrees of freedom, 0.99
_STEADY = 4.0  # deviations of the stated noise and the scatter that the residual of one object keeps within
_FEWEST = 3  # objects that must agree before a bias is believed
_LEAST_BLOCKS = 3  # of a pair without a common name
_FULL_VOTE = 12  # blocks from which a pair's vote counts no more
_PROPOSALS = 300  # pairs, the longest ones, whose bias is tried
_CLEAR = 0.75  # of the winner's votes: a rival with more leaves the matter open


class _Pairs(NamedTuple):
    """Each pair as one residual."""

    residual: _Array  # (P, 2): median over its blocks, m
    effect: _Array  # (P, 2, q)
    cov: _Array  # (P, 2, 2): stated noise of one report, m^2
    spread: _Array  # (P,): robust standard deviation of its blocks, each axis, m
    size: _Index  # (P,): blocks
    begin: _Array  # (P,), s
    end: _Array


def accept_pairs(
    blocks: Blocks,
    tracks: _Index,
    told: _Mask,
    known: tuple[_Array, _Array] | None,
    prior: _Array,
    scatter: float,
) -> _Mask:
    """Choose the pairs that one set of biases explains, (P,); none where too few agree.

    Pairs named alike are taken. Where there are none, every other pair proposes the bias of the one group with the
    greatest expected effect that would explain it, and the proposal on which most pairs agree wins: false pairs
    disagree with each other. Once biases are known from many objects, pairs are gated about them instead. A track is
    in one pair at a time.

    Args:
        blocks: residuals, pairs numbered from 0 without gaps.
        tracks: the two tracks of each pair, (P, 2).
        told: pairs that both systems name alike, (P,).
        known: mean and covariance of the biases, if they were estimated from many objects before.
        prior: standard deviations of the biases before anything is known.
        scatter: between objects, m.
    """
    if told.any():
        return told if told.sum() >= _FEWEST else np.zeros(len(tracks), bool)
    pairs = _summed(blocks, len(tracks))
    steady = (pairs.size >= _LEAST_BLOCKS) & (pairs.spread <= _STEADY * np.sqrt(_variance(pairs.cov) + scatter**2))
    if known is None:
        start, wide = _agreed(pairs, tracks, np.flatnonzero(steady), prior, scatter), np.zeros((len(prior), len(prior)))
    else:
        start, wide = known
    if start is None:
        return np.zeros(len(tracks), bool)
    d2 = _distance(pairs, np.arange(len(tracks)), start, wide, scatter)
    chosen = _one_to_one(pairs, tracks, np.flatnonzero(steady & (d2 < _GATE)), d2)
    return chosen if chosen.sum() >= _FEWEST else np.zeros(len(tracks), bool)


def _summed(blocks: Blocks, n: int) -> _Pairs:
    first = np.searchsorted(blocks.pair, np.arange(n))
    stop = np.searchsorted(blocks.pair, np.arange(n), side="right")
    count = stop - first
    middle = np.stack([medians(blocks.residual[:, c], blocks.pair, first, count) for c in (0, 1)], axis=-1)
    away = np.linalg.norm(blocks.residual - middle[blocks.pair], axis=-1)
    return _Pairs(
        middle,
        np.add.reduceat(blocks.effect, first, axis=0) / count[:, None, None],
        np.add.reduceat(blocks.cov, first, axis=0) / count[:, None, None],
        medians(away, blocks.pair, first, count) / 1.1774,  # the median of a Rayleigh law
        count,
        blocks.time[first],
        blocks.time[stop - 1],
    )


def _variance(cov: _Array) -> _Array:
    return np.asarray(np.trace(cov, axis1=-2, axis2=-1)) / 2.0


def _distance(pairs: _Pairs, at: _Index, mean: _Array, cov: _Array, scatter: float) -> _Array:
    """Squared distance of the residual from what biases (..., q) explain."""
    effect = pairs.effect[at]
    left = pairs.residual[at] - np.einsum("pij,...j->...pi", effect, mean)
    S = pairs.cov[at] + effect @ cov @ effect.swapaxes(-1, -2) + (2.0 * scatter) ** 2 * np.eye(2)
    return np.asarray(np.einsum("...pi,pij,...pj->...p", left, np.linalg.inv(S), left))


def _agreed(pairs: _Pairs, tracks: _Index, at: _Index, prior: _Array, scatter: float) -> _Array | None:
    """Return the bias of one group on which most pairs agree, or None where none is clear."""
    if len(at) < _FEWEST:
        return None
    proposals = _proposals(pairs, at[np.argsort(-pairs.size[at], kind="stable")[:_PROPOSALS]], prior)
    at = at[np.argsort(tracks[at, 0], kind="stable")]
    agree = _distance(pairs, at, proposals, np.zeros((len(prior), len(prior))), scatter) < _GATE
    vote = np.where(agree, np.minimum(pairs.size[at], _FULL_VOTE), 0)
    first = np.flatnonzero(np.diff(tracks[at, 0], prepend=-1))
    votes = np.maximum.reduceat(vote, first, axis=1).sum(axis=1)  # a track has one vote
    best = int(votes.argmax())
    overlap = (agree & agree[best]).sum(axis=1)
    rival = overlap < 0.5 * agree.sum(axis=1)
    if rival.any() and votes[rival].max() > _CLEAR * votes[best]:
        return None
    return np.asarray(proposals[best])


def _proposals(pairs: _Pairs, at: _Index, prior: _Array) -> _Array:
    """Biases of the group with the greatest expected effect that would explain each pair alone, (k, q)."""
    effect = pairs.effect[at]
    size = {name: np.linalg.norm(effect[..., list(g)] * prior[list(g)]) for name, g in GROUPS.items()}
    group = list(GROUPS[max(size, key=lambda name: float(size[name]))])
    out = np.zeros((len(at), len(prior)))
    out[:, group] = np.einsum("pij,pj->pi", np.linalg.pinv(effect[..., group]), pairs.residual[at])
    return out


def _one_to_one(pairs: _Pairs, tracks: _Index, at: _Index, d2: _Array) -> _Mask:
    """Take the pairs in the order of their distance, none that shares a track with one taken at the same time."""
    chosen = np.zeros(len(tracks), bool)
    for k in at[np.argsort(d2[at] / np.minimum(pairs.size[at], _FULL_VOTE), kind="stable")]:
        taken = np.flatnonzero(chosen)
        shares = (tracks[taken] == tracks[k]).any(axis=-1)
        meets = (pairs.begin[taken] < pairs.end[k]) & (pairs.end[taken] > pairs.begin[k])
        chosen[k] = not (shares & meets).any()
    return chosen
