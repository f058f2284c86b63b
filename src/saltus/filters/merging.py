"""What the multimode filter throws away when it mixes, and when that is much.

Before a row's prediction the Gaussians of all modes are merged into one per next mode. What is lost then is at most

    1/2 [sum_j Q_j log det R_j - sum_i P_i log det P_i]

nats, P_i and R_j the covariances before and after, P and Q the law of the modes before and after: the divergence of
the mixtures from the Gaussians kept in their place, bounded by their entropies. It needs the 2 M determinants and no
pairs of modes, for chains mixed one after another too, and it is 0 where modes have equal moments or cannot switch.

Source: Runnalls (2007), Kullback-Leibler approach to Gaussian mixture reduction, IEEE Trans. AES 43(3), section IV.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import prod

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.filters import steps
from saltus.filters.estimates import Estimates
from saltus.filters.imm import imm_filter
from saltus.models import Arrays, Finding
from saltus.shapes import Float

__all__ = ["filter_and_tell", "findings", "lost_by_merging", "merging_loss"]

_Array = npt.NDArray[np.float64]
_AT_ONCE = 2_000_000  # elements of all modes' covariances
_ROUND_OFF = 1e-12  # part of a variance; keeps the determinant of what is known exactly
_MUCH = 0.08  # nats a row and state: about where means are a tenth of a standard deviation off


def merging_loss(before: steps.Belief, after: steps.Belief, n_chains: int) -> Float[np.ndarray, "*lead"]:
    """Return at most how many nats mixing threw away.

    Args:
        before: what was mixed, and
        after: what `steps.mix` made of it.
        n_chains: axes of modes.
    """
    mean, cov = steps.collapse(*before, n_chains)
    sd = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    sd = np.where(sd > _ROUND_OFF * np.abs(mean), sd, np.maximum(np.abs(mean), 1.0))  # known exactly: no spread
    n = sd.shape[-1]
    scale = (sd[..., :, None] * sd[..., None, :]).reshape(*cov.shape[:-2], *(1,) * n_chains, n, n)

    def entropy(belief: steps.Belief) -> _Array:
        log_det = np.linalg.slogdet(belief.covs / scale + _ROUND_OFF * np.eye(n))[1]
        axes = tuple(range(log_det.ndim - n_chains, log_det.ndim))
        return np.asarray(0.5 * np.sum(np.exp(belief.log_probs) * log_det, axis=axes))

    return np.asarray(np.maximum(entropy(after) - entropy(before), 0.0))


def lost_by_merging(
    estimates: Estimates,
    *,
    trans: Sequence[npt.ArrayLike],
    mean0: npt.ArrayLike,
    cov0: npt.ArrayLike,
    probs0: npt.ArrayLike,
) -> Float[np.ndarray, "*rows"]:
    """Return at most how many nats the mixing before each row threw away, (*batch, T).

    Args:
        estimates: of `imm_filter` with per_mode=True.
        trans: the arguments of `imm_filter`, none of them per run.
        mean0: likewise.
        cov0: likewise.
        probs0: likewise.

    Raises:
        ModelError: the estimates have no modes' moments.
    """
    if estimates.mode_means is None or estimates.mode_covs is None:
        raise ModelError("what merging lost is told by the moments of every mode: filter with per_mode=True.")
    with np.errstate(divide="ignore"):
        rows = steps.Belief(np.log(estimates.probs), estimates.mode_means, estimates.mode_covs)
        start = steps.Belief(np.log(probs0), np.asarray(mean0), np.asarray(cov0))
    n, sizes = rows.means.shape[-1], np.shape(probs0)
    C, T, batch = len(sizes), estimates.mean.shape[-2], estimates.mean.shape[:-2]
    cores = ((), (n,), (n, n))
    first = [np.broadcast_to(a, (*batch, 1, *sizes, *core)) for a, core in zip(start, cores, strict=True)]
    axis, lost = len(batch), np.empty((*batch, T))
    size = max(1, _AT_ONCE // max(1, prod(batch) * prod(sizes) * n * n))
    for k in range(0, T, size):
        last = min(k + size, T)
        earlier = [np.take(a, range(max(k - 1, 0), last - 1), axis=axis) for a in rows]
        if k == 0:
            earlier = [np.concatenate([a, b], axis=axis) for a, b in zip(first, earlier, strict=True)]
        before = steps.Belief(*earlier)
        moves = [np.asarray(t)[k:last] if np.ndim(t) > 2 else np.asarray(t) for t in trans]
        lost[..., k:last] = merging_loss(before, steps.mix(*before, moves), C)
    return lost


def filter_and_tell(z: _Array, arrays: Arrays, per_mode: bool) -> Estimates:
    """Filter one run by `imm_filter` and say what merging lost; a long run goes a second time for that, in pieces."""
    rows = max(1, _AT_ONCE // (arrays.probs0.size * arrays.mean0.shape[-1] ** 2))
    at_once = per_mode or len(z) <= rows
    found = imm_filter(z, **arrays._asdict(), per_mode=at_once)
    lost = _lost(found, arrays) if at_once else _lost_in_pieces(z, arrays, rows)
    if not per_mode:
        found = replace(found, mode_means=None, mode_covs=None)
    return replace(found, lost=lost, findings=findings(lost, found.mean.shape[-1]))


def _lost(found: Estimates, arrays: Arrays) -> _Array:
    start = {"mean0": arrays.mean0, "cov0": arrays.cov0, "probs0": arrays.probs0}
    return lost_by_merging(found, trans=arrays.trans, **start)


def _lost_in_pieces(z: _Array, arrays: Arrays, rows: int) -> _Array:
    lost = []
    for first in range(0, len(z), rows):
        piece = slice(first, first + rows)
        now = arrays.rows(piece)
        found = imm_filter(z[piece], **now._asdict(), per_mode=True)
        lost.append(_lost(found, now))
        if found.mode_means is None or found.mode_covs is None:
            raise TypeError("the modes' moments were asked for")
        arrays = arrays._replace(mean0=found.mode_means[-1], cov0=found.mode_covs[-1], probs0=found.probs[-1])
    return np.concatenate(lost)


def findings(lost: Float[np.ndarray, "*rows"], n: int) -> tuple[Finding, ...]:
    """Say where merging throws away much: a finding, or none.

    Args:
        lost: nats by row.
        n: dimension of the state.
    """
    mean = float(lost.mean())
    if mean <= _MUCH * n:
        return ()
    most = np.unravel_index(int(lost.argmax()), lost.shape)
    row = int(most[-1])
    return (
        Finding(
            "merging",
            f"row {row} and others",
            f"merging histories of modes throws away {mean:.2g} nats a row at most, {lost[most]:.2g} before this one; "
            "the mean may be tenths of its standard deviation from the optimum. optimality_gap(model) measures what it "
            "costs; ExactFilter(rule=GPB2) keeps more, ParticleFilter nearly all.",
        ),
    )
