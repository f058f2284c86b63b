"""Where tracks begin: at rest with their first plot, and by difference with their second."""

import numpy as np
import numpy.typing as npt

from saltus.tracks.channel import MOTION, Start
from saltus.tracks.colour import Colours
from saltus.tracks.measurements import Measurements
from saltus.tracks.settings import FilterSettings, TrackerSettings

__all__ = ["Starts", "erring", "two_point_start", "with_speed_prior"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]

_HELD = 0.99  # of the variance of a lasting error that a state may tell: the rest keeps the covariance definite
_CLIMB = 15.0  # m/s: standard deviation of the vertical speed of a new track


class Starts:
    """First states of tracks."""

    def __init__(self, settings: TrackerSettings, filters: FilterSettings, gate: float) -> None:
        """Fix what is known of targets; `gate` is the quantile of the horizontal gate."""
        self._settings = settings
        # The gate of a track of one plot, at rest with this deviation of speed, ends at the fastest target's.
        self._speed = settings.max_speed / np.sqrt(gate)
        sojourn = np.array(filters.sojourn_h)
        self._mean_accel_sq = float(sojourn @ np.square(filters.accel_h) / sojourn.sum())

    def of_one(self, m: Measurements, plots: _Index, colours: Colours) -> Start:
        """States of tracks with one plot each: at rest, off the plot by the opposite of its lasting error.

        Args:
            m: measurements.
            plots: the plot of each track.
            colours: a table without rows, of all sources.
        """
        mean, cov = np.zeros((len(plots), 6)), np.zeros((len(plots), 6, 6))
        mean[:, 0::2], cov[:, 0::2, 0::2] = m.with_height(plots, self._settings.height_prior)
        cov[:, [1, 3], [1, 3]] = self._speed**2
        cov[:, 5, 5] = _CLIMB**2
        colours, cross = colours.empty(len(plots)), np.zeros((len(plots), MOTION, colours.slots))
        cross[:, :3:2] = -colours.claim_each(m.source[plots], m.time[plots], m.lasting[plots])
        return Start(mean, cov).beside(colours, cross)

    def of_two(self, before: Measurements, time: _Array, m: Measurements, plots: _Index, colours: Colours) -> Start:
        """States of tracks that found their second plot.

        With lasting errors L_0 u_0 and L_1 u_1 of the two plots, and a = exp(-T / tau), where one source gave both

            cov(e_1, e_0) = a L_1 L_0',   cov(x, u) = -L_1,   cov(v, u) = -(L_1 - a L_0) / T,

        and where two did, of the first one cov(v, u_0) = a L_0 / T.

        Args:
            before: the first plot of each track, (k,).
            time: of the tracks, s.
            m: measurements.
            plots: the second plot of each track.
            colours: a table without rows, of all sources.
        """
        every, prior = np.arange(len(plots)), self._settings.height_prior
        dt = m.time[plots] - time
        way = m.position[plots, :2] - before.position[:, :2]
        slowest = np.linalg.norm(way, axis=-1) / self._settings.max_speed
        velocity = way / np.maximum(dt, slowest)[:, None]
        (z0, R0), (z1, R1) = before.with_height(every, prior), m.with_height(plots, prior)
        R0, R1 = R0 + before.stamped(every, velocity), R1 + m.stamped(plots, velocity)
        one, common = (before.source == m.source[plots])[:, None, None], np.zeros(R0.shape)
        a = colours.correlation(before.source, dt)[:, None, None]
        common[:, :2, :2] = np.where(one, a * (m.lasting[plots] @ before.lasting.swapaxes(1, 2)), 0.0)
        start = two_point_start(z0, R0, z1, R1, dt, common)
        colours, cross = colours.empty(len(plots)), np.zeros((len(plots), MOTION, colours.slots))
        L0 = colours.claim_each(before.source, time, before.lasting)
        L1 = colours.claim_each(m.source[plots], m.time[plots], m.lasting[plots])
        cross[:, :3:2], cross[:, 1:4:2] = -L1, (a * L0 - L1) / dt[:, None, None]
        start = with_speed_prior(start.beside(colours, cross), self._settings.max_speed)
        # The target may have manoeuvred between the two.
        start.cov[:, [1, 3], [1, 3]] += self._mean_accel_sq * (0.5 * dt[:, None]) ** 2
        earlier, other = np.isfinite(before.position[:, 2]), np.isfinite(m.position[plots, 2])
        flat = np.flatnonzero(~(earlier & other))
        latest = other[flat]
        start.mean[flat, 4] = np.where(latest, z1[flat, 2], z0[flat, 2])
        start.mean[flat, 5] = 0.0
        start.cov[flat, 4:6, :] = start.cov[flat, :, 4:6] = 0.0
        start.cov[flat, 4, 4] = np.where(latest, R1[flat, 2, 2], R0[flat, 2, 2])
        start.cov[flat, 5, 5] = _CLIMB**2
        return start


def erring(start: Start, colours: Colours, source: npt.NDArray[np.int32], time: _Array, effect: _Array) -> Start:
    """Give states that a source's reports alone have told of, lasting errors included, a state for these.

    The track follows p + L u, so that to the extent to which its position is not known better than its reports,
    cov(x, u) = -L and, over times short against tau, cov(v, u) = -L / tau. Both are scaled down by one factor where the
    covariance of the motion does not hold so much.

    Args:
        start: states of motion.
        colours: a table without rows, of all sources.
        source: of the report that each state was updated by last, (k,).
        time: of it, s.
        effect: L of it, (k, 2, 2).
    """
    colours, k = colours.empty(len(source)), len(source)
    L = colours.claim_each(source, time, effect)
    cross = np.zeros((k, MOTION, colours.slots))
    if L.any():
        cross[:, :3:2], cross[:, 1:4:2] = -L, -L * colours.rate(source)[:, None, None]
        held = cross.swapaxes(1, 2) @ np.linalg.solve(start.cov, cross)
        share = np.linalg.eigvalsh(held)[:, -1]
        cross *= np.sqrt(np.minimum(1.0, _HELD / np.maximum(share, 1e-12)))[:, None, None]
    return start.beside(colours, cross)


def two_point_start(
    first: _Array, first_cov: _Array, second: _Array, second_cov: _Array, dt: _Array, common: _Array | None = None
) -> Start:
    """Begin states from two positions.

    Position z1, velocity (z1 - z0)/T, and blockwise over (position, velocity)
    P = [[R1, (R1 - C)/T], [(R1 - C)'/T, (R0 + R1 - C - C')/T^2]], C = cov(error of z1, error of z0).

    Args:
        first: positions (x, y, z) at the earlier time, (k, 3).
        first_cov: their covariances R0, (k, 3, 3).
        second: positions at the later time, (k, 3).
        second_cov: their covariances R1, (k, 3, 3).
        dt: time between them T > 0, (k,), s.
        common: C, (k, 3, 3); None: 0, each position errs by itself.

    Returns:
        States (x, vx, y, vy, z, vz) at the later time.

    Source: two-point differencing; section 3 of the radar notes.
    """
    T, C = dt[:, None, None], np.zeros(second_cov.shape) if common is None else common
    mean, cov = np.empty((len(dt), 6)), np.empty((len(dt), 6, 6))
    mean[:, 0::2], mean[:, 1::2] = second, (second - first) / dt[:, None]
    cov[:, 0::2, 0::2] = second_cov
    cov[:, 0::2, 1::2] = (second_cov - C) / T
    cov[:, 1::2, 0::2] = cov[:, 0::2, 1::2].swapaxes(1, 2)
    cov[:, 1::2, 1::2] = (first_cov + second_cov - C - C.swapaxes(1, 2)) / (T * T)
    return Start(mean, cov)


def with_speed_prior(start: Start, sigma: float) -> Start:
    """Condition states on their horizontal velocity being N(0, sigma^2 I).

    With U = cov(x, v), S = cov(v) + sigma^2 I: x - U S^-1 v, P - U S^-1 U'. Two positions taken at nearly one time (two
    radars) tell no velocity; this keeps what is known of speeds, and changes nothing else.

    Args:
        start: states (x, vx, y, vy, z, vz, ...).
        sigma: standard deviation of each component, m/s.
    """
    v = np.array([1, 3])
    U = start.cov[:, :, v]
    S = start.cov[:, v[:, None], v] + sigma**2 * np.eye(2)
    gain = np.linalg.solve(S, U.swapaxes(-1, -2)).swapaxes(-1, -2)
    cov = start.cov - gain @ U.swapaxes(-1, -2)
    mean = start.mean - (gain @ start.mean[:, v, None])[..., 0]
    return start._replace(mean=mean, cov=0.5 * (cov + cov.swapaxes(-1, -2)))
