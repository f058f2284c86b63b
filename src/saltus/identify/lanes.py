"""Many short filters at once: each lane of the batch kernel is one track, or one pair under "same object"."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.filters.estimates import Estimates
from saltus.filters.imm import imm_filter
from saltus.identify.local import PairSettings
from saltus.linalg import block_diagonal
from saltus.models.checks import FloatArray

__all__ = [
    "Index",
    "Lanes",
    "Own",
    "Start",
    "batches",
    "flatten",
    "joint_log_likelihood",
    "own_filters",
    "region_start",
]

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
    differs: FloatArray  # (L, T, 2, D): what the lasting differences of systems (D of them) add to the row


class Own(NamedTuple):
    """What own filters said of their tracks."""

    log_likelihood: FloatArray  # (L, T)
    velocity: FloatArray  # (L, T, 2) after each row, m/s
    spread: FloatArray  # (L, T, 2, 2) its covariance
    beliefs: tuple[FloatArray, FloatArray, FloatArray]  # (W, M), (W, M, 4), (W, M, 4, 4) after the wanted rows


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


def own_filters(lanes: Lanes, settings: PairSettings, wanted: tuple[Index, Index]) -> Own:
    """Filter tracks, each by itself from the region.

    Args:
        lanes: one track each.
        settings: objects.
        wanted: lane and row (W,), (W,) of the beliefs to return.
    """
    start = region_start(settings, lanes.time[:, 0])
    matrices = _matrices(lanes.time, start.time, settings, 4)
    moving = settings.time_sigma > 0
    every, H = len(wanted[0]) > 0, np.eye(4)[None, 0::2]
    found = _filtered(lanes, matrices, H, (start.probs, start.mean, start.cov), settings, every, every or moving)
    shape, m = lanes.time.shape, len(settings.accel)
    velocity, spread = np.zeros((*shape, 2)), np.zeros((*shape, 2, 2))
    if moving:
        velocity, spread = found.mean[..., 1::2], found.cov[..., 1::2, 1::2]
    beliefs = (np.zeros((0, m)), np.zeros((0, m, 4)), np.zeros((0, m, 4, 4)))
    if found.mode_means is not None and found.mode_covs is not None:
        beliefs = (found.probs[wanted], found.mode_means[wanted], found.mode_covs[wanted])
        if settings.outlier_probability > 0:
            beliefs = _merged_outliers(*beliefs)
    return Own(found.log_likelihood, velocity, spread, beliefs)


def joint_log_likelihood(lanes: Lanes, start: Start, settings: PairSettings) -> FloatArray:
    """Return the log-likelihood of every row (L, T) where both systems see one object.

    z = position + D (o, tau) + v, with the lasting differences o ~ N(0, offset_cov) and tau ~ N(0, time_sigma^2) as
    more states: do = -o / offset_time dt + noise that keeps the covariance, tau constant.
    """
    differences = settings.differences()
    n = 4 + len(differences)
    matrices = _matrices(lanes.time, start.time, settings, n)
    if n == 4:
        return _filtered(lanes, matrices, np.eye(4)[None, 0::2], start[1:], settings, False, False).log_likelihood
    H = np.zeros((*lanes.time.shape, 1, 2, n))
    H[..., 0, 0] = H[..., 1, 2] = 1.0
    H[..., 4:] = lanes.differs[..., None, :, :]
    mean = np.concatenate([start.mean, np.zeros((*start.mean.shape[:-1], n - 4))], axis=-1)
    prior = (start.probs, mean, block_diagonal(start.cov, differences))
    return _filtered(lanes, matrices, H, prior, settings, False, False).log_likelihood


def _filtered(
    lanes: Lanes,
    matrices: tuple[FloatArray, FloatArray, FloatArray],
    H: FloatArray,
    prior: tuple[FloatArray, FloatArray, FloatArray],
    settings: PairSettings,
    per_mode: bool,
    every: bool,
) -> Estimates:
    """Run the kernel, with a chain without memory for outliers where there are any."""
    (F, Q, trans), (probs, mean, cov) = matrices, prior
    R, chains, p = lanes.R[:, :, None], [trans], settings.outlier_probability
    if p > 0:
        chains.append(np.array([[1.0 - p, p]] * 2))
        F, Q, H, cov = (np.expand_dims(a, -3) for a in (F, Q, H, cov))
        mean, probs = np.expand_dims(mean, -2), probs[..., None] * np.array([1.0 - p, p])
        R = np.stack([R, settings.outlier_factor**2 * R], axis=-3)
    return imm_filter(
        lanes.z,
        F=F,
        Q=Q,
        H=H,
        R=R,
        trans=chains,
        mean0=mean,
        cov0=cov,
        probs0=probs,
        per_mode=per_mode,
        keep="all" if every else "last",
    )


def _merged_outliers(probs: FloatArray, mean: FloatArray, cov: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Forget whether the last row was an outlier: the mixture of each mode (W, M, 2) by its moments, as mixing does."""
    weight = (probs + 1e-290) / (probs + 1e-290).sum(-1, keepdims=True)
    middle = (weight[..., None] * mean).sum(-2)
    off = mean - middle[..., None, :]
    spread = (weight[..., None, None] * (cov + off[..., :, None] * off[..., None, :])).sum(-3)
    return probs.sum(-1), middle, spread


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
        F[..., range(4, n), range(4, n)] = 1.0
    if n > 5 and np.isfinite(settings.offset_time):
        kept = np.exp(-t / settings.offset_time)
        F[..., 4, 4] = F[..., 5, 5] = kept
        Q[..., 4:6, 4:6] = (1.0 - kept**2)[..., None, None] * settings.offset_cov
    return F, Q, chain.transition(dt)
