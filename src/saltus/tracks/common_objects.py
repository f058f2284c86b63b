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
    disagree with each other. Biases known from before are one more proposal, with their uncertainty. A track is in one
    pair at a time.

    Args:
        blocks: residuals, pairs numbered from 0 without gaps.
        tracks: the two tracks of each pair, (P, 2).
        told: pairs that both systems name alike, (P,).
        known: mean and covariance of the biases, if they were estimated before.
        prior: standard deviations of the biases before anything is known.
        scatter: between objects, m.
    """
    if told.any():
        return told if told.sum() >= _FEWEST else np.zeros(len(tracks), bool)
    group = _greatest(blocks, prior)
    own = _own_proposals(blocks, len(tracks), group, len(prior))
    found = [_about(_summed(blocks, own), tracks, None, own, prior, scatter)]
    if known is not None:
        everywhere = np.broadcast_to(known[0], own.shape)
        found.insert(0, _about(_summed(blocks, everywhere), tracks, known, own, prior, scatter))
    best = max(found, key=lambda chosen: int(chosen.sum()))  # the first of equals: what was known
    return best if best.sum() >= _FEWEST else np.zeros(len(tracks), bool)


def _about(
    pairs: _Pairs, tracks: _Index, known: tuple[_Array, _Array] | None, own: _Array, prior: _Array, scatter: float
) -> _Mask:
    """Choose the pairs that agree with known biases, or with the ones that most agree on."""
    steady = (pairs.size >= _LEAST_BLOCKS) & (pairs.spread <= _STEADY * np.sqrt(_variance(pairs.cov) + scatter**2))
    if known is None:
        agreed = _agreed(pairs, tracks, np.flatnonzero(steady), own, scatter)
        if agreed is None:
            return np.zeros(len(tracks), bool)
        known = agreed, np.zeros((len(prior), len(prior)))
    d2 = _distance(pairs, np.arange(len(tracks)), *known, scatter)
    return _one_to_one(pairs, tracks, np.flatnonzero(steady & (d2 < _GATE)), d2)


def _greatest(blocks: Blocks, prior: _Array) -> list[int]:
    """Return the parameters of the group with the greatest expected effect."""
    size = {name: float(np.linalg.norm(blocks.effect[..., list(g)] * prior[list(g)])) for name, g in GROUPS.items()}
    return list(GROUPS[max(size, key=lambda name: size[name])])


def _own_proposals(blocks: Blocks, n: int, group: list[int], q: int) -> _Array:
    """Biases of one group that would explain each pair alone, by least squares over its blocks, (P, q)."""
    first = np.searchsorted(blocks.pair, np.arange(n))
    B = blocks.effect[..., group]
    BB = np.add.reduceat(np.einsum("nij,nik->njk", B, B), first, axis=0)
    Br = np.add.reduceat(np.einsum("nij,ni->nj", B, blocks.residual), first, axis=0)
    out = np.zeros((n, q))
    out[:, group] = np.einsum("pij,pj->pi", np.linalg.pinv(BB, hermitian=True), Br)
    return out


def _summed(blocks: Blocks, about: _Array) -> _Pairs:
    """One residual for each pair, its scatter judged when the biases `about` (P, q) are taken out."""
    n = len(about)
    first = np.searchsorted(blocks.pair, np.arange(n))
    stop = np.searchsorted(blocks.pair, np.arange(n), side="right")
    size = stop - first
    left = blocks.residual - np.einsum("nij,nj->ni", blocks.effect, about[blocks.pair])
    middle = np.stack([medians(left[:, c], blocks.pair, first, size) for c in (0, 1)], axis=-1)
    away = np.linalg.norm(left - middle[blocks.pair], axis=-1)
    effect = np.add.reduceat(blocks.effect, first, axis=0) / size[:, None, None]
    return _Pairs(
        middle + np.einsum("pij,pj->pi", effect, about),
        effect,
        np.add.reduceat(blocks.cov, first, axis=0) / size[:, None, None],
        medians(away, blocks.pair, first, size) / 1.1774,  # the median of a Rayleigh law
        size,
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


def _agreed(pairs: _Pairs, tracks: _Index, at: _Index, own: _Array, scatter: float) -> _Array | None:
    """Return the bias of one group on which most pairs agree, or None where none is clear."""
    if len(at) < _FEWEST:
        return None
    proposals = own[at[np.argsort(-pairs.size[at], kind="stable")[:_PROPOSALS]]]
    at = at[np.argsort(tracks[at, 0], kind="stable")]
    agree = _distance(pairs, at, proposals, np.zeros((own.shape[1], own.shape[1])), scatter) < _GATE
    vote = np.where(agree, np.minimum(pairs.size[at], _FULL_VOTE), 0)
    first = np.flatnonzero(np.diff(tracks[at, 0], prepend=-1))
    votes = np.maximum.reduceat(vote, first, axis=1).sum(axis=1)  # a track has one vote
    best = int(votes.argmax())
    overlap = (agree & agree[best]).sum(axis=1)
    rival = overlap < 0.5 * agree.sum(axis=1)
    if rival.any() and votes[rival].max() > _CLEAR * votes[best]:
        return None
    return np.asarray(proposals[best])


def _one_to_one(pairs: _Pairs, tracks: _Index, at: _Index, d2: _Array) -> _Mask:
    """Take the pairs in the order of their distance, none that shares a track with one taken at the same time."""
    chosen = np.zeros(len(tracks), bool)
    for k in at[np.argsort(d2[at] / np.minimum(pairs.size[at], _FULL_VOTE), kind="stable")]:
        taken = np.flatnonzero(chosen)
        shares = (tracks[taken] == tracks[k]).any(axis=-1)
        meets = (pairs.begin[taken] < pairs.end[k]) & (pairs.end[taken] > pairs.begin[k])
        chosen[k] = not (shares & meets).any()
    return chosen
