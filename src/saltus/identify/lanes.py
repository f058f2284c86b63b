"""Many short filters at once: each lane of the batch kernel is one track, or one pair under "same object"."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.filters.imm import imm_filter
from saltus.identify.local import PairSettings
from saltus.linalg import block_diagonal
from saltus.models.checks import FloatArray

__all__ = ["Index", "Lanes", "Start", "batches", "flatten", "joint_log_likelihood", "own_filters", "region_start"]

Index = npt.NDArray[np.int64]

_ELEMENTS = 1_000_000  # numbers in the matrices of one batch: 8 MB stay near the processor


class Start(NamedTuple):
    """What a lane believes before its first row."""

    time: FloatArray  # (L,) s
    probs: FloatArray  # (L, M)
    mean: FloatArray  # (L, M, 4) of (x, vx, y, vy)
    cov: FloatArray  # (L, M, 4, 4)


class Lanes(NamedTuple):
    """Rows of every lane, filled up at the end with NaN at the lane's last time."""

    time: FloatArray  # (L, T) s
    z: FloatArray  # (L, T, 2) m
    R: FloatArray  # (L, T, 2, 2) m^2
    offset: npt.NDArray[np.bool_]  # (L, T): the row's system carries the relative offset


def flatten(first: Index, count: Index) -> tuple[Index, Index]:
    """Return lane and row of every element of the ranges [first, first + count), lane after lane."""
    lane = np.repeat(np.arange(len(count)), count)
    within = np.arange(len(lane)) - np.repeat(np.cumsum(count) - count, count)
    return lane, first[lane] + within


def batches(length: Index, states: int, modes: int) -> Iterator[Index]:
    """Yield lanes of similar length, so many that their matrices stay within a fixed memory; none of length 0."""
    order = np.argsort(length, kind="stable")
    order = order[length[order] > 0]
    per_row = states * states * (2 + 2 * modes)
    at = 0
    while at < len(order):
        # The longest lane of a batch sets its size: take lanes while count * longest fits.
        rows = np.arange(1, len(order) - at + 1) * length[order[at:]] * per_row
        take = max(1, int(np.searchsorted(rows, _ELEMENTS, side="right")))
        yield order[at : at + take]
        at += take


def region_start(settings: PairSettings, time: FloatArray) -> Start:
    """Return the belief about objects of which nothing is known but the region, at `time` (L,)."""
    (mean, cov), law = settings.prior(), settings.chain().law
    lead = (len(time), len(law))
    return Start(
        time,
        np.broadcast_to(law, lead),
        np.broadcast_to(mean, (*lead, 4)),
        np.broadcast_to(cov, (*lead, 4, 4)),
    )


def own_filters(
    lanes: Lanes, settings: PairSettings, wanted: tuple[Index, Index]
) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray]]:
    """Filter tracks, each by itself from the region.

    Args:
        lanes: one track each.
        settings: objects.
        wanted: lane and row (W,), (W,) of the beliefs to return.

    Returns:
        Log-likelihood of every row (L, T), and probs (W, M), means (W, M, 4), covs (W, M, 4, 4) after the wanted rows.
    """
    start = region_start(settings, lanes.time[:, 0])
    F, Q, trans = _matrices(lanes.time, start.time, settings, 4)
    found = imm_filter(
        lanes.z,
        F=F,
        Q=Q,
        H=_position(4),
        R=lanes.R[:, :, None],
        trans=[trans],
        mean0=start.mean,
        cov0=start.cov,
        probs0=start.probs,
        per_mode=len(wanted[0]) > 0,
        keep="all" if len(wanted[0]) else "last",
    )
    if found.mode_means is None or found.mode_covs is None:
        m = len(settings.accel)
        return found.log_likelihood, (np.zeros((0, m)), np.zeros((0, m, 4)), np.zeros((0, m, 4, 4)))
    return found.log_likelihood, (found.probs[wanted], found.mode_means[wanted], found.mode_covs[wanted])


def joint_log_likelihood(lanes: Lanes, start: Start, settings: PairSettings) -> FloatArray:
    """Return the log-likelihood of every row (L, T) where both systems see one object.

    z = position + v, or position + o + v in the rows that carry the offset o ~ N(0, offset_cov): two more states,
    do = -o / offset_time dt + noise that keeps the covariance.
    """
    offset = np.asarray(settings.offset_cov)
    F, Q, trans = _matrices(lanes.time, start.time, settings, 6 if offset.any() else 4)
    H, mean, cov = _position(4), start.mean, start.cov
    if offset.any():
        mean = np.concatenate([mean, np.zeros((*mean.shape[:-1], 2))], axis=-1)
        cov = block_diagonal(cov, offset)
        H = np.zeros((*lanes.offset.shape, 1, 2, 6))
        H[..., 0, 0] = H[..., 1, 2] = 1.0
        H[..., 0, 4] = H[..., 1, 5] = lanes.offset[..., None]
    found = imm_filter(
        lanes.z,
        F=F,
        Q=Q,
        H=H,
        R=lanes.R[:, :, None],
        trans=[trans],
        mean0=mean,
        cov0=cov,
        probs0=start.probs,
        keep="last",
    )
    return found.log_likelihood


def _matrices(
    time: FloatArray, before: FloatArray, settings: PairSettings, n: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """F (L, T, 1, n, n), Q (L, T, M, n, n) and transition matrices (L, T, M, M) over the interval before each row.

    `constant_velocity` of kind "white", filled in place: matrices of this size cost more to copy than to use.
    """
    dt = np.diff(time, axis=1, prepend=before[:, None])
    chain = settings.chain()
    t = dt[..., None]
    F, Q = np.zeros((*t.shape, n, n)), np.zeros((*dt.shape, len(chain), n, n))
    F[..., range(4), range(4)] = 1.0
    corner, side, end = (power * settings.densities() for power in (t**3 / 3, t**2 / 2, t))
    for x, v in ((0, 1), (2, 3)):
        F[..., x, v] = t
        Q[..., x, x], Q[..., x, v], Q[..., v, x], Q[..., v, v] = corner, side, side, end
    if n > 4:
        kept = np.exp(-t / settings.offset_time)
        F[..., 4, 4] = F[..., 5, 5] = kept
        if np.isfinite(settings.offset_time):
            Q[..., 4:, 4:] = (1.0 - kept**2)[..., None, None] * np.asarray(settings.offset_cov)
    return F, Q, chain.transition(dt)


def _position(n: int) -> FloatArray:
    H = np.zeros((1, 2, n))
    H[0, 0, 0] = H[0, 1, 2] = 1.0
    return H
