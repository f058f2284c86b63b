"""States of system tracks from the measurements of all their local tracks: every lane of one batch filter a track."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.filters import imm_filter
from saltus.shapes import Float, Int
from saltus.tracks.intervals import Intervals
from saltus.tracks.kinematics import Channel, Moments, make_kinematics
from saltus.tracks.settings import FilterSettings, TrackerSettings

__all__ = ["Fused", "LaneRows", "fuse"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]

_CELLS = 60_000  # rows of a batch, padding included
_HEIGHT_ERROR = 5000.0  # m: standard deviation of a wrong height


class LaneRows(NamedTuple):
    """The rows of all lanes, sorted by lane, then by time; a row without a measurement is a coasted one."""

    lane: Int[np.ndarray, " n"]  # 0..L-1, every lane has a row
    time: Float[np.ndarray, " n"]  # s
    position: Float[np.ndarray, "n 3"]  # x, y, altitude, m; NaN where not measured
    cov: Float[np.ndarray, "n 3 3"]  # of a good plot
    faulty: Float[np.ndarray, "n f 3 3"]  # of a plot with each fault


class Fused(NamedTuple):
    """What is known after each row."""

    moments: Moments
    centre: Float[np.ndarray, "n 2"]  # predicted position
    gate_cov: Float[np.ndarray, "n 2 2"]  # covariance of the innovation of a good plot
    p_fault: Float[np.ndarray, "n f"]  # probability of each fault of the plot; NaN without one


class _Batch(NamedTuple):
    """Some lanes, padded: place (lane, step) of each of their rows but the first, and those rows."""

    lanes: _Index
    shape: tuple[int, int]
    at: tuple[_Index, _Index]
    row: _Index


def fuse(rows: LaneRows, start: Moments, filters: FilterSettings, settings: TrackerSettings) -> Fused:
    """Filter lanes that begin at their first row with a known state.

    The modes are the product of the manoeuvres and of what a plot may be: good, or faulty in one of f ways, drawn anew
    for each plot. A coasted row is one without measurement.

    Args:
        rows: measurements of each lane in exact time order.
        start: state at the first row of each lane, that row's measurement included, (L, ...).
        filters: manoeuvres.
        settings: probabilities of faults.
    """
    n, first = len(rows.lane), np.flatnonzero(np.diff(rows.lane, prepend=-1))
    mean, cov = np.zeros((n, 6)), np.zeros((n, 6, 6))
    manoeuvre = {"horizontal": np.zeros(n), "vertical": np.zeros(n)}
    p_fault = np.full((n, rows.faulty.shape[1]), np.nan)
    centre, gate_cov = rows.position[:, :2].copy(), rows.cov[:, :2, :2].copy()
    begun = {"horizontal": start.p_manoeuvre_h, "vertical": start.p_manoeuvre_v}
    for channel in make_kinematics(filters).channels:
        s = channel.states
        mean[first[:, None], s] = start.mean[:, s]
        cov[first[:, None, None], s[:, None], s] = start.cov[:, s[:, None], s]
        for chain in channel.chains:
            manoeuvre[chain.name][first] = begun[chain.name]
        for batch in _batches(first, np.diff(np.append(first, n))):
            _filter(channel, rows, batch, first, begun, settings, (mean, cov, manoeuvre, p_fault, centre, gate_cov))
    return Fused(Moments(mean, cov, manoeuvre["horizontal"], manoeuvre["vertical"]), centre, gate_cov, p_fault)


def _batches(first: _Index, length: _Index) -> list[_Batch]:
    """Group lanes of like length, so that little is padded; lanes of one row need no filter."""
    out = []
    order = np.argsort(length, kind="stable")
    order = order[length[order] > 1]
    k = 0
    while k < len(order):
        stop = k + 1
        while stop < len(order) and (stop + 1 - k) * (length[order[stop]] - 1) <= _CELLS:
            if length[order[stop]] > 1.5 * length[order[k]] + 16:
                break
            stop += 1
        lanes = order[k:stop]
        steps = length[lanes] - 1
        lane = np.repeat(np.arange(len(lanes)), steps)
        step = np.arange(len(lane)) - np.repeat(np.cumsum(steps) - steps, steps)
        out.append(_Batch(lanes, (len(lanes), int(steps.max())), (lane, step), first[lanes][lane] + 1 + step))
        k = stop
    return out


def _filter(
    channel: Channel,
    rows: LaneRows,
    batch: _Batch,
    first: _Index,
    begun: dict[str, _Array],
    settings: TrackerSettings,
    out: tuple[_Array, _Array, dict[str, _Array], _Array, _Array, _Array],
) -> None:
    """Run one channel over a batch of lanes and write what it finds into the columns of all rows."""
    mean, cov, manoeuvre, p_fault, centre, gate_cov = out
    axes, s, row, n_chains = channel.axes, channel.states, batch.row, len(channel.chains)
    horizontal = bool(0 in axes)
    z = np.full((*batch.shape, len(axes)), np.nan)
    z[batch.at] = rows.position[row][:, axes]
    dt = np.zeros(batch.shape)
    dt[batch.at] = rows.time[row] - rows.time[row - 1]
    good = rows.cov[row][:, axes[:, None], axes]
    if horizontal:
        faulty, p = rows.faulty[row][..., axes[:, None], axes], settings.plot_outlier
    else:
        faulty, p = good[:, None] + _HEIGHT_ERROR**2, settings.altitude_outlier
    kinds = 1 + faulty.shape[1]
    R = np.broadcast_to(np.eye(len(axes)), (*batch.shape, kinds, len(axes), len(axes))).copy()
    R[batch.at] = np.concatenate([good[:, None], faulty], axis=1)
    law = np.array([1.0 - p, *([p / (kinds - 1)] * (kinds - 1))])
    (over,) = Intervals([(channel.motion, channel.chains)]).at(dt.ravel())
    F, Q = (a.reshape((*batch.shape, *a.shape[1:-2], 1, *a.shape[-2:])) for a in (over.F, over.Q))
    H = np.zeros((len(axes), 2 * len(axes)))
    H[np.arange(len(axes)), 2 * np.arange(len(axes))] = 1.0
    trans = [
        np.ones((*batch.shape, 1, 1)) if t is None else t.reshape((*batch.shape, *t.shape[1:])) for t in over.trans
    ]
    ones = (1,) * n_chains
    found = imm_filter(
        z,
        F=F,
        Q=Q,
        H=H.reshape((*ones, 1, *H.shape)),
        R=R.reshape((*batch.shape, *ones, *R.shape[2:])),
        trans=[*trans, np.broadcast_to(law, (kinds, kinds))],
        mean0=mean[first[batch.lanes]][:, s].reshape((-1, *ones, 1, len(s))),
        cov0=cov[first[batch.lanes]][:, s[:, None], s].reshape((-1, *ones, 1, len(s), len(s))),
        probs0=_begun(channel, begun, batch.lanes, law),
    )
    mean[row[:, None], s] = found.mean[batch.at]
    cov[row[:, None, None], s[:, None], s] = found.cov[batch.at]
    probs = found.probs[batch.at]
    for c, chain in enumerate(channel.chains):
        others = tuple(1 + i for i in range(n_chains + 1) if i != c)
        manoeuvre[chain.name][row] = 1.0 - probs.sum(axis=others)[:, 0]
    if horizontal:
        seen = np.isfinite(rows.position[row, 0])
        p_fault[row] = np.where(seen[:, None], probs.sum(axis=tuple(range(1, 1 + n_chains)))[:, 1:], np.nan)
        before = _begun(channel, begun, batch.lanes, law).sum(axis=-1)[:, None]
        before = np.concatenate([before, found.probs.sum(axis=-1)[:, :-1]], axis=1)[batch.at]
        ahead = _ahead(before, [t[batch.at] for t in trans])
        x, P = mean[row - 1][:, s], cov[row - 1][:, s[:, None], s]
        x, P = _predicted(x, P, F[batch.at][..., 0, :, :], Q[batch.at][..., 0, :, :], ahead)
        centre[row], gate_cov[row] = x[:, 0:3:2], P[:, 0:3:2, 0:3:2] + np.where(seen[:, None, None], good[:, :2, :2], 0)


def _begun(channel: Channel, begun: dict[str, _Array], lanes: _Index, law: _Array) -> _Array:
    """Law of the modes at the start: what the local tracker thought of manoeuvres, the others as they last."""
    probs = np.ones((len(lanes), *(1 for _ in channel.chains), 1))
    for c, chain in enumerate(channel.chains):
        share = np.array(chain.law)
        own = np.zeros((len(lanes), len(share)))
        p = np.clip(begun[chain.name][lanes], 0.0, 1.0) if len(share) > 1 else np.zeros(len(lanes))
        own[:, 0] = 1.0 - p
        own[:, 1:] = p[:, None] * share[1:] / max(float(share[1:].sum()), 1e-300)
        probs = probs * own.reshape((len(lanes), *(-1 if i == c else 1 for i in range(len(channel.chains))), 1))
    return np.asarray(probs * law)


def _ahead(probs: _Array, trans: list[_Array]) -> _Array:
    """Law of the modes one interval later, (k, M1, ..., MC)."""
    for c, step in enumerate(trans):
        probs = np.moveaxis(np.einsum("k...i,kij->k...j", np.moveaxis(probs, 1 + c, -1), step), -1, 1 + c)
    return probs


def _predicted(mean: _Array, cov: _Array, F: _Array, Q: _Array, probs: _Array) -> tuple[_Array, _Array]:
    """Mean and covariance of the prediction, every mode from the same state: what a gate is drawn from.

    x = sum_j p_j F_j x0,   P = sum_j p_j [F_j P0 F_j' + Q_j + (F_j x0 - x)(F_j x0 - x)']
    """
    modes = tuple(range(1, probs.ndim))
    lift = (len(mean), *(1 for _ in modes))
    weight = probs[..., None]
    each = (F @ mean.reshape((*lift, -1, 1)))[..., 0]
    x = np.sum(weight * each, axis=modes)
    away = each - x.reshape((*lift, -1))
    spread = F @ cov.reshape((*lift, *cov.shape[1:])) @ F.swapaxes(-1, -2) + Q + away[..., :, None] * away[..., None, :]
    return x, np.sum(weight[..., None] * spread, axis=modes)
