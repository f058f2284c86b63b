"""Errors that last: how large, and how long, from the straight stretches of a source's own tracks.

Of one component of a report, the state s = (x, v, u) of a target that flies straight, but for accelerations of density
q, and of an error that lasts,

    z = x + g u + white,   var u = 1,   cov(u(t), u(t + s)) = exp(-|s| / tau),   g = c h,

with h = 1 of positions, the ground range of an azimuth. What such a source tells of itself is w, D = 2 c^2 / tau and q;
tau only where it is short against sqrt(D / q), beyond which a target's own wandering looks the same. A prior on log tau
fills what data leave open.
"""

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.filters import imm_filter
from saltus.tracks.measurements import Measurements
from saltus.tracks.rows import Rows

__all__ = ["Lasting", "Pieces", "estimate_lasting", "straight_pieces"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]

_STRAIGHT, _MARGIN = 0.3, 8.0  # probability of a manoeuvre, and s around one that are left out
_FEWEST, _LONGEST = 20, 150  # reports of a piece
_MAX_GAP = 2.5  # periods
_PIECES, _REPORTS = 30, 1000  # from which something can be told
_MOST = 2500  # reports used
_GAIN, _PER_REPORT = 10.0, 0.01  # nats that lasting errors must explain more
_TIME, _SHORT = 60.0, 6.0  # s: the time assumed, and one at which errors that last for less show, too
_BETWEEN = (35.0, 20.0, 12.0, 3.5, 2.0)  # s: others that may be told
_CONTRADICTED = 2.5  # nats
_REACH = 9.0  # logarithms: how far estimates may lie from where the search begins
_STEP = 1e-4  # logarithm, of numeric derivatives
_DIFFUSE = 1e5  # m and m/s: what is known of a target before its first report


class Lasting(NamedTuple):
    """What was found of a source's errors."""

    white: float = float("nan")  # standard deviation of each report by itself, m or rad; NaN: nothing tells
    lasting: float = 0.0  # of what lasts, m or rad; 0: nothing does
    time: float = _TIME  # s
    told: bool = False  # whether the data tell the time, or it is assumed
    gain: float = 0.0  # nats per report that lasting errors explain more than white ones
    reports: int = 0


class Pieces(NamedTuple):
    """Straight stretches of one component, side by side: NaN behind the end of each."""

    t: _Array  # (S, K), s
    z: _Array  # (S, K), m
    h: _Array  # (S, K): m per unit of the error

    @property
    def reports(self) -> int:
        """Number of values."""
        return int(np.isfinite(self.z).sum())


def straight_pieces(m: Measurements, rows: Rows, source: int, period: float) -> Pieces:
    """Cut the tracks of a source where they manoeuvre or pause; of a radar what lies across the ray.

    Args:
        m: measurements in time order.
        rows: of the tracker that took them; `measurement` is the number of the plot.
        source: which.
        period: its update period, s.
    """
    place = np.searchsorted(m.plot, np.maximum(rows.measurement, 0))
    place = np.minimum(place, max(len(m) - 1, 0))
    own = (rows.source == source) & (rows.status > 0) & np.isfinite(m.position[place, 0]) & ~(rows.p_fault > 0.5)
    at = np.flatnonzero(own)
    at = at[np.lexsort((rows.time[at], rows.track_id[at]))]
    track, plot = rows.track_id[at], place[at]
    time = m.time[plot]
    keep = ~_near_manoeuvre(track, time, rows.moments.p_manoeuvre_h[at])
    track, plot, time = track[keep], plot[keep], time[keep]
    cut = (np.diff(track) != 0) | (np.diff(time) > _MAX_GAP * max(period, _STEP_LEAST)) | (np.diff(time) <= 0.0)
    edges = np.concatenate([[0], 1 + np.flatnonzero(cut), [len(plot)]])
    series = [part for begin, end in pairwise(edges.tolist()) for part in _parts(m, plot[begin:end])]
    out = np.full((3, len(series), max((len(t) for t, _, _ in series), default=0)), np.nan)
    for k, part in enumerate(series):
        out[:, k, : len(part[0])] = part
    return Pieces(*out)


_STEP_LEAST = 1.0  # s


def _near_manoeuvre(track: npt.NDArray[np.int64], time: _Array, p: _Array) -> npt.NDArray[np.bool_]:
    """Say which rows, sorted by track and time, lie within the margin of one that probably manoeuvres."""
    turning = p >= _STRAIGHT
    if not turning.any():
        return turning
    key = np.searchsorted(np.unique(track), track) * 1e9 + (time - time.min())
    where = key[turning]
    after = np.minimum(np.searchsorted(where, key), len(where) - 1)
    before = np.maximum(after - 1, 0)
    return np.asarray(np.minimum(np.abs(where[after] - key), np.abs(where[before] - key)) <= _MARGIN)


def _parts(m: Measurements, plot: _Index) -> Iterator[tuple[_Array, _Array, _Array]]:
    """Times, values and scales of the components of a piece, in parts not too long."""
    for begin in range(0, len(plot) - _FEWEST + 1, _LONGEST):
        part = plot[begin : begin + _LONGEST]
        if len(part) < _FEWEST:
            continue
        t, xy, ray = m.time[part], m.position[part, :2], m.ray[part]
        if np.isfinite(ray).all():
            rho = np.hypot(ray[:, 0], ray[:, 1])
            middle = ray[len(part) // 2] / rho[len(part) // 2]
            yield t, xy @ np.array([-middle[1], middle[0]]), rho
        else:
            for axis in range(2):
                yield t, xy[:, axis], np.ones(len(part))


def estimate_lasting(pieces: Pieces, white: float, q: float, distance: _Array | None = None) -> Lasting:
    """Estimate what lasts of a source's errors, if anything does.

    Lasting errors are accepted where they explain the pieces better by 10 nats and .01 a report than white ones under
    the best q. Their time is 60 s, or the longest that the pieces contradict by no more than 2.5 nats if that is less:
    taken too short, errors are thought smaller than they are, and pieces that hold the edges of turns say too short.

    Args:
        pieces: of the source.
        white: what its errors are where none lasts, to start from.
        q: acceleration density of steady motion, m^2/s^3, to start from.
        distance: of each report in the pieces from the sensor (S, K), m, if lasting errors may grow with it.

    Source: theory notes on lasting errors in the tracker, sections 3 and 5.
    """
    n = pieces.reports
    if len(pieces.t) < _PIECES and n < _REPORTS:
        return Lasting()
    pieces = Pieces(*(column[:: -(-n // _MOST)] for column in pieces))
    n = pieces.reports
    alone = _best(pieces, None, np.log([white, q]))
    start = alone.at + np.log([0.5, 1.0])  # half of what varies from report to report, and as much in half a minute
    tried = {_TIME: _best(pieces, _TIME, np.append(start, 2.0 * alone.at[0] - np.log(30.0)))}
    tried[_SHORT] = _best(pieces, _SHORT, tried[_TIME].at)
    top = max(tried.values(), key=lambda fit: fit.value)
    gain = (top.value - alone.value) / n
    if gain * n < _GAIN or gain < _PER_REPORT:
        return Lasting(float(np.exp(alone.at[0])), gain=gain, reports=n)
    for tau in _BETWEEN:
        tried[tau] = _best(pieces, tau, top.at)
    top = max(tried.values(), key=lambda fit: fit.value)
    tau = _longest(tried, top.value - _CONTRADICTED)
    fit = tried[tau] if tau in tried else _best(pieces, tau, top.at)
    w, _, D = (float(v) for v in np.exp(fit.at))
    return Lasting(w, float(np.sqrt(0.5 * D * tau)), tau, tau < _TIME, gain, n)


class _Fit(NamedTuple):
    value: float  # log-likelihood
    at: _Array  # logarithms of w, q and, if errors last, of D


def _best(pieces: Pieces, tau: float | None, start: _Array) -> _Fit:
    """Maximise the likelihood over w, q and D at a time tau; None: nothing lasts."""
    from scipy.optimize import minimize

    steps = np.vstack([np.zeros(len(start)), _STEP * np.eye(len(start))])
    likelihood = _Likelihood(pieces, tau or 1.0)

    def cost(p: _Array) -> tuple[float, _Array]:
        value = -likelihood(np.exp(p + steps))
        return float(value[0]), (value[1:] - value[0]) / _STEP

    bounds = [(v - _REACH, v + _REACH) for v in start]
    found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 40, "ftol": 1e-7})
    return _Fit(-float(found.fun), np.asarray(found.x))


class _Likelihood:
    """log f of pieces under candidates; what depends on intervals and tau alone is computed once."""

    def __init__(self, pieces: Pieces, tau: float) -> None:
        self._tau, self._h = tau, np.where(np.isfinite(pieces.h), pieces.h, 1.0)
        self._z = (pieces.z - pieces.z[:, :1])[..., None]
        dt = np.nan_to_num(np.diff(pieces.t, axis=1, prepend=pieces.t[:, :1]))
        a = np.exp(-dt / tau)
        self._F, self._moved, self._renewed = np.zeros((3, *dt.shape, 3, 3))
        self._F[..., 0, 0] = self._F[..., 1, 1] = 1.0
        self._F[..., 0, 1], self._F[..., 2, 2] = dt, a
        self._moved[..., 0, 0], self._moved[..., 1, 1] = dt**3 / 3.0, dt
        self._moved[..., 0, 1] = self._moved[..., 1, 0] = dt**2 / 2.0
        self._renewed[..., 2, 2] = 1.0 - a * a

    def __call__(self, candidates: _Array) -> _Array:
        """Return log f (P,) of candidates (P, 2|3): w, q and, if errors last, D."""
        P, each = len(candidates), (slice(None), None, None)
        w, q = candidates[:, 0], candidates[:, 1]
        D = candidates[:, 2] if candidates.shape[1] == 3 else np.zeros(P)
        H = np.zeros((P, *self._h.shape, 1, 3))
        H[..., 0, 0], H[..., 0, 2] = 1.0, np.sqrt(0.5 * D * self._tau)[each] * self._h
        found = imm_filter(
            np.broadcast_to(self._z, (P, *self._z.shape)),
            F=np.broadcast_to(self._F, (P, *self._F.shape)),
            Q=q[(*each, None, None)] * self._moved + self._renewed,
            H=H,
            R=np.square(w[each] * self._h)[..., None, None],
            trans=[],
            mean0=np.zeros(3),
            cov0=np.diag([_DIFFUSE**2, _DIFFUSE**2, 1.0]),
            probs0=np.array(1.0),
            keep="last",
        )
        return np.asarray(found.log_likelihood.sum(axis=(1, 2)))


def _longest(tried: Mapping[float, _Fit], least: float) -> float:
    """Return the longest time at which the log-likelihood, linear in log tau between those tried, is at least so."""
    taus = sorted(tried)
    k = max(i for i, tau in enumerate(taus) if tried[tau].value >= least)
    if k + 1 == len(taus):
        return taus[k]
    high, low = tried[taus[k]].value, tried[taus[k + 1]].value
    share = (high - least) / max(high - low, 1e-9)
    return float(np.exp((1.0 - share) * np.log(taus[k]) + share * np.log(taus[k + 1])))
