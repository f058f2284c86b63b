"""Errors that last: how large, and how long, from the straight stretches of a source's own tracks.

Of one component of a report, the state s = (x, v, u) of a target that flies straight, but for accelerations of density
q, and of an error that lasts,

    z = x + g u + white,   var u = 1,   cov(u(t), u(t + s)) = exp(-|s| / tau),   g = c h sqrt(1 + (d / d_s)^2),

with h = 1 of positions, the ground range of an azimuth, and d the distance from the sensor. What such a source tells of
itself is w, D = 2 c^2 / tau and q; tau only where it is short against sqrt(D / q), beyond which a target's own
wandering looks the same.
"""

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.filters import imm_filter
from saltus.tracks.measurements import Measurements
from saltus.tracks.rows import Rows
from saltus.tracks.setup_settings import LastingSettings

__all__ = ["Lasting", "Pieces", "estimate_lasting", "straight_pieces"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]

_SLOW = 1.0  # s: what ends a stretch is no shorter for sources that report more often
_REACH = 9.0  # logarithms: how far estimates may lie from where the search begins
_STEP = 1e-4  # logarithm, of numeric derivatives
_DIFFUSE = 1e5  # m and m/s: what is known of a target before its first report


class Lasting(NamedTuple):
    """What was found of a source's errors."""

    white: float = float("nan")  # standard deviation of each report by itself, m or rad; NaN: nothing tells
    lasting: float = 0.0  # of what lasts, m or rad; 0: nothing does
    time: float = float("nan")  # s
    distance: float = float("inf")  # m: where it is 1.4 times as large as at the sensor
    told: bool = False  # whether the data tell the time, or it is assumed
    gain: float = 0.0  # nats per report that lasting errors explain more than white ones
    reports: int = 0


class Pieces(NamedTuple):
    """Straight stretches of one component, side by side: NaN behind the end of each."""

    t: _Array  # (S, K), s
    z: _Array  # (S, K), m
    h: _Array  # (S, K): m per unit of the error
    d: _Array  # (S, K): distance from the sensor, m; 0 where lasting errors do not grow with it

    @property
    def reports(self) -> int:
        """Number of values."""
        return int(np.isfinite(self.z).sum())


def straight_pieces(
    m: Measurements, rows: Rows, source: int, period: float, settings: LastingSettings, site: _Array | None = None
) -> Pieces:
    """Cut the tracks of a source where they manoeuvre or pause; of a radar what lies across the ray.

    Args:
        m: measurements in time order.
        rows: of the tracker that took them; `measurement` is the number of the plot.
        source: which.
        period: its update period, s.
        settings: what is straight, and long enough.
        site: where the sensor stands in the plane, (2,), m; None: in its middle.
    """
    place = np.searchsorted(m.plot, np.maximum(rows.measurement, 0))
    place = np.minimum(place, max(len(m) - 1, 0))
    own = (rows.source == source) & (rows.status > 0) & np.isfinite(m.position[place, 0]) & ~(rows.p_fault > 0.5)
    at = np.flatnonzero(own)
    at = at[np.lexsort((rows.time[at], rows.track_id[at]))]
    track, plot = rows.track_id[at], place[at]
    time = m.time[plot]
    turning = rows.moments.p_manoeuvre_h[at] >= settings.straight
    keep = ~_near(track, time, turning, settings.margin)
    track, plot, time = track[keep], plot[keep], time[keep]
    step = np.diff(time)
    cut = (np.diff(track) != 0) | (step > settings.gap * max(period, _SLOW)) | (step <= 0.0)
    edges = np.concatenate([[0], 1 + np.flatnonzero(cut), [len(plot)]])
    ends = pairwise(edges.tolist())
    series = [part for begin, end in ends for part in _parts(m, plot[begin:end], settings, site)]
    out = np.full((4, len(series), max((len(part[0]) for part in series), default=0)), np.nan)
    for k, part in enumerate(series):
        out[:, k, : len(part[0])] = part
    return Pieces(*out)


def _near(
    track: npt.NDArray[np.int64], time: _Array, turning: npt.NDArray[np.bool_], margin: float
) -> npt.NDArray[np.bool_]:
    """Say which rows, sorted by track and time, lie within the margin of one that turns."""
    if not turning.any():
        return turning
    key = np.searchsorted(np.unique(track), track) * 1e9 + (time - time.min())
    where = key[turning]
    after = np.minimum(np.searchsorted(where, key), len(where) - 1)
    before = np.maximum(after - 1, 0)
    return np.asarray(np.minimum(np.abs(where[after] - key), np.abs(where[before] - key)) <= margin)


def _parts(
    m: Measurements, plot: _Index, settings: LastingSettings, site: _Array | None
) -> Iterator[tuple[_Array, ...]]:
    """Times, values, factors and distances of the components of a piece, in parts not too long."""
    for begin in range(0, len(plot) - settings.fewest + 1, settings.longest):
        part = plot[begin : begin + settings.longest]
        t, xy, ray = m.time[part], m.position[part, :2], m.ray[part]
        if len(part) < settings.fewest or np.hypot(*(xy[-1] - xy[0])) < settings.moving * (t[-1] - t[0]):
            continue  # what stands still repeats one rounded position
        if np.isfinite(ray).all():
            rho = np.hypot(ray[:, 0], ray[:, 1])
            middle = ray[len(part) // 2] / rho[len(part) // 2]
            yield t, xy @ np.array([-middle[1], middle[0]]), rho, np.zeros(len(part))
        else:
            for axis in range(2):
                yield t, xy[:, axis], np.ones(len(part)), np.hypot(*(xy if site is None else xy - site).T)


def estimate_lasting(
    pieces: Pieces, white: float, q: float, settings: LastingSettings, told: float | None = None
) -> Lasting:
    """Estimate what lasts of a source's errors, if anything does.

    Lasting errors are accepted where they explain the pieces better by so many nats, and so many a report, than white
    ones under the best q. Their time is the one assumed, or the longest that the pieces do not contradict if that is
    less: taken too short, errors are thought smaller than they are, and pieces that hold the edges of turns say too
    short.

    Args:
        pieces: of the source.
        white: what its errors are where none lasts, to start from.
        q: acceleration density of steady motion, m^2/s^3, to start from.
        settings: what is accepted, and which times and scales may be.
        told: the time, where it is known, s.

    Source: theory notes on lasting errors in the tracker, sections 3 and 5.
    """
    n = pieces.reports
    if len(pieces.t) < settings.stretches and n < settings.reports:
        return Lasting()
    pieces = Pieces(*(column[:: -(-n // settings.most)] for column in pieces))
    n, assumed = pieces.reports, told or settings.time
    alone = _best(pieces, None, np.log([white, q]))
    pieces, distance, fit = _grown(pieces, alone, assumed, settings)
    tried = {assumed: fit}
    if told is None and settings.times:  # one of half way shows errors that last for less, too
        short = settings.times[len(settings.times) // 2]
        tried[short] = _best(pieces, short, fit.at)
    top = max(tried.values(), key=lambda fit: fit.value)
    if top.value - alone.value < max(settings.gain, settings.gain_per_report * n):
        return Lasting(float(np.exp(alone.at[0])), gain=(top.value - alone.value) / n, reports=n)
    times = sorted((assumed, *settings.times)) if told is None else [assumed]
    while (time := _wanting(tried, times, settings.contradicted)) is not None:
        tried[time] = _best(pieces, time, top.at)
    top = max(tried.values(), key=lambda fit: fit.value)
    tau = _longest(tried, top.value - settings.contradicted)
    fit = tried[tau] if tau in tried else _best(pieces, tau, top.at)
    w, _, D = (float(v) for v in np.exp(fit.at))
    gain = (fit.value - alone.value) / n
    return Lasting(w, float(np.sqrt(0.5 * D * tau)), tau, distance, tau < assumed, gain, n)


def _grown(pieces: Pieces, alone: "_Fit", tau: float, settings: LastingSettings) -> tuple[Pieces, float, "_Fit"]:
    """Fit lasting errors, which grow with distance if that explains the pieces better; say by what scale.

    Args:
        pieces: with distances in m.
        alone: the best that white errors do.
        tau: the time that they last, s.
        settings: scales that may be.

    Returns:
        Pieces with distances in units of the scale, the scale, and the fit.
    """
    w, q = alone.at  # half of what varies from report to report, and as much of what lasts in half a minute
    start = np.array([w + np.log(0.5), q, 2.0 * w - np.log(30.0)])
    flat = pieces._replace(d=0.0 * pieces.d)
    best, distance, fit = flat, float("inf"), _best(flat, tau, start)
    for scale in settings.scales if np.nanmax(pieces.d) > 0.0 else ():
        scaled = pieces._replace(d=pieces.d / scale)
        less = np.log(float(np.nanmean(1.0 + scaled.d**2)))
        other = _best(scaled, tau, fit.at - [0.0, 0.0, less])
        if other.value > fit.value + settings.gain:
            best, distance, fit = scaled, scale, other
    return best, distance, fit


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
    found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 25, "ftol": 2e-6})
    return _Fit(-float(found.fun), np.asarray(found.x))


class _Likelihood:
    """log f of pieces under candidates; what depends on intervals and tau alone is computed once."""

    def __init__(self, pieces: Pieces, tau: float) -> None:
        self._tau, self._h = tau, np.where(np.isfinite(pieces.h), pieces.h, 1.0)
        self._g = self._h * np.sqrt(1.0 + np.nan_to_num(pieces.d) ** 2)
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
        H[..., 0, 0], H[..., 0, 2] = 1.0, np.sqrt(0.5 * D * self._tau)[each] * self._g
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


def _wanting(tried: Mapping[float, _Fit], times: list[float], contradicted: float) -> float | None:
    """Return a time not yet tried that the best, or the longest that the data do not contradict, may yet turn on."""
    top = max(tried, key=lambda tau: tried[tau].value)
    least, k = tried[top].value - contradicted, times.index(top)
    if k > 0 and times[k - 1] not in tried:
        return times[k - 1]
    for tau in times[k + 1 : k + 2] if tried[times[-1]].value >= least else times[k + 1 :]:
        if tau not in tried:
            return tau
        if tried[tau].value < least:
            break
    return None


def _longest(tried: Mapping[float, _Fit], least: float) -> float:
    """Return the longest time at which the log-likelihood, linear in log tau between those tried, is at least so."""
    taus = sorted(tried)
    k = max(i for i, tau in enumerate(taus) if tried[tau].value >= least)
    if k + 1 == len(taus):
        return taus[k]
    high, low = tried[taus[k]].value, tried[taus[k + 1]].value
    share = (high - least) / max(high - low, 1e-9)
    return float(np.exp((1.0 - share) * np.log(taus[k]) + share * np.log(taus[k + 1])))
