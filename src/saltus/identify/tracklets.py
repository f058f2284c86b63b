"""Tracks of another centre as measurements: what they say anew, and honest errors for it.

An update of a track is no measurement: it repeats what the track said before, lags behind manoeuvres, and may come from
the radar it is compared with. Two ways lead to rows that a ratio may count:

* With covariances, `tracklets` undoes the centre's filter: the information of an update less that of the prediction
  from the update before is what came in between, an equivalent measurement with independent error (inverse filter).
* Without, `track_updates` keeps one update per correlation time, three times the memory of the centre's filter, after
  which its error has forgotten 95 % of itself.

The cross-covariance with other systems' errors, through common radars or the common manoeuvre, is unknown in both. For
any C, cov(e_a - e_b) <= 2 (R_a + R_b), the bound that covariance intersection with equal weights gives: doubling both
covariances (`shared`; `doubled` for the other system) never makes one object look like two.

Source: Julier and Uhlmann (1997) for covariance intersection; the information form of the Kalman filter.
"""

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError
from saltus.identify.lanes import Index
from saltus.identify.local import LocalTracks, spans
from saltus.linalg import symmetric
from saltus.models import constant_velocity
from saltus.models.checks import FloatArray
from saltus.shapes import Float

__all__ = ["doubled", "track_updates", "tracklets"]

_FORGOTTEN = 3.0  # memories after which an error has forgotten itself: exp(-3) = 5 %


def doubled(tracks: LocalTracks) -> LocalTracks:
    """Return the tracks with covariances of twice the size: for a system whose plots feed the other's tracks."""
    return tracks._replace(R=2.0 * tracks.R)


def track_updates(
    track: npt.ArrayLike,
    time: npt.ArrayLike,
    position: npt.ArrayLike,
    *,
    sigma: float,
    memory: float,
    velocity: npt.ArrayLike | None = None,
    time_sigma: float = 0.0,
    accel_sigma: float = 0.0,
    shared: bool = True,
) -> LocalTracks:
    """Return one update per correlation time of tracks that come without covariances.

    R = [sigma^2 + (accel_sigma memory^2)^2] I + time_sigma^2 v v',  twice that where sources are shared

    A filter that forgets with time constant `memory` follows an acceleration a with the lag a memory^2.

    Args:
        track: number of each update's track, (N,), 0..K-1.
        time: of each update, (N,), s; sorted by track, then by time.
        position: (N, 2), m.
        sigma: standard deviation of a steady track's position, each axis, m.
        memory: time constant of the centre's filter, s: some two or three of its radars' periods.
        velocity: (N, 2), m/s; absent: differences of positions.
        time_sigma: standard deviation of what is left of the track's latency, s.
        accel_sigma: standard deviation of the accelerations that a track lags behind, m/s^2.
        shared: double R, because the centre may use the other system's own plots.

    Returns:
        Rows at least three memories apart in each track, the first of each included.

    Raises:
        DataError: rows out of order or not finite.
        ModelError: a deviation or a time out of range.
    """
    for name, value, least in (
        ("sigma", sigma, 1e-9),
        ("memory", memory, 0.0),
        ("time_sigma", time_sigma, 0.0),
        ("accel_sigma", accel_sigma, 0.0),
    ):
        if not least <= value < np.inf:
            raise ModelError(f"{name} must be finite and {'positive' if least else 'not negative'}, got {value}.")
    z = np.asarray(position, dtype=np.float64)
    given = LocalTracks(
        np.asarray(track, dtype=np.int64),
        np.asarray(time, dtype=np.float64),
        z,
        np.broadcast_to(np.eye(2), (*z.shape, 2)),
    )
    rows = _spaced(given, _FORGOTTEN * memory)
    v = _differences(given)[rows] if velocity is None else np.asarray(velocity, dtype=np.float64)[rows]
    R = (sigma**2 + (accel_sigma * memory**2) ** 2) * np.eye(2) + time_sigma**2 * v[:, :, None] * v[:, None, :]
    kept = LocalTracks(given.track[rows], given.time[rows], z[rows], R)
    spans(kept, "track updates")
    return doubled(kept) if shared else kept


def tracklets(
    track: npt.ArrayLike,
    time: npt.ArrayLike,
    mean: Float[np.ndarray, "n 4"],
    cov: Float[np.ndarray, "n 4 4"],
    *,
    density: float,
    spacing: float = 0.0,
) -> LocalTracks:
    """Return equivalent measurements of position from tracks that come with covariances.

    Y = P+^-1 - P-^-1,  y = P+^-1 x+ - P-^-1 x-,  R^-1 = Ypp - Ypv Yvv^- Yvp,  z = R (yp - Ypv Yvv^- yv)

    with x-, P- the prediction from the last row kept. A centre whose filter took the measurements z_k with R_k and
    white acceleration of this density is undone exactly; the first row of each track is taken as it is.

    Args:
        track: number of each row's track, (N,), 0..K-1.
        time: (N,), s; sorted by track, then by time.
        mean: (x, vx, y, vy), m and m/s.
        cov: its covariance.
        density: spectral density of acceleration in the centre's filter, m^2/s^3.
        spacing: s between rows kept; measurements in between are contained in the next one.

    Returns:
        The rows that say something new about the position.

    Raises:
        DataError: rows out of order or not finite, or a covariance without inverse.
        ModelError: density or spacing out of range.
    """
    if not (0 < density < np.inf and 0 <= spacing < np.inf):
        raise ModelError(f"density must be positive and spacing not negative, got {density} and {spacing}.")
    x, P = np.asarray(mean, dtype=np.float64), np.asarray(cov, dtype=np.float64)
    at = np.array([0, 2])
    given = LocalTracks(
        np.asarray(track, dtype=np.int64), np.asarray(time, dtype=np.float64), x[:, at], P[:, at[:, None], at]
    )
    rows = _spaced(given, spacing)
    x, P, kept = x[rows], P[rows], LocalTracks(*(part[rows] for part in given))
    follows = np.concatenate([[False], np.diff(kept.track) == 0]) if len(rows) else np.zeros(0, bool)
    later = np.flatnonzero(follows)
    step = constant_velocity(2, accel=density, kind="white").step(kept.time[later] - kept.time[later - 1])
    before = (step.F @ x[later - 1, :, None])[..., 0]
    predicted = step.F @ P[later - 1] @ step.F.swapaxes(-1, -2) + step.Q
    z, R, new = _equivalent(x[later], P[later], before, predicted)
    kept.z[later[new]], kept.R[later[new]] = z[new], R[new]
    says = ~follows
    says[later] = new
    return LocalTracks(*(part[says] for part in kept))


def _equivalent(
    x: FloatArray, P: FloatArray, before: FloatArray, predicted: FloatArray
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]:
    """Position, covariance, and whether there is information about both coordinates."""
    try:
        after, prior = np.linalg.inv(P), np.linalg.inv(predicted)
    except np.linalg.LinAlgError:
        raise DataError(
            "a track's covariance has no inverse; give tracks that are uncertain in every direction."
        ) from None
    Y = symmetric(after - prior)
    y = (after @ x[..., None] - prior @ before[..., None])[..., 0]
    p, v = np.array([0, 2]), np.array([1, 3])
    # Information is a difference: what is small beside its terms is round-off and counts as none.
    noise = 1e-9 * np.abs(prior[:, v[:, None], v]).max(axis=(-1, -2), initial=0.0)
    values, vectors = np.linalg.eigh(Y[:, v[:, None], v])
    inverse = np.where(values > noise[:, None], 1.0 / np.where(values > noise[:, None], values, 1.0), 0.0)
    gain = Y[:, p[:, None], v] @ (vectors * inverse[:, None, :]) @ vectors.swapaxes(-1, -2)
    information = symmetric(Y[:, p[:, None], p] - gain @ Y[:, v[:, None], p])
    scale = np.abs(prior[:, p[:, None], p]).max(axis=(-1, -2), initial=0.0)
    new = np.linalg.eigvalsh(information).min(-1, initial=np.inf) > 1e-9 * scale
    R = np.linalg.inv(np.where(new[:, None, None], information, np.eye(2)))
    z = (R @ (y[:, p, None] - gain @ y[:, v, None]))[..., 0]
    return z, R, new


def _spaced(tracks: LocalTracks, spacing: float) -> Index:
    """Rows of each track, the first and then each that lies at least `spacing` after the last one taken."""
    span, rows = spans(tracks, "track updates"), []
    for first, stop in zip(span.first, span.stop, strict=True):
        time, k = tracks.time[first:stop], 0
        while k < len(time):
            rows.append(int(first) + k)
            k = max(k + 1, int(np.searchsorted(time, time[k] + spacing - 1e-9)))
    return np.array(rows, dtype=np.int64)


def _differences(tracks: LocalTracks) -> FloatArray:
    """Velocities from the update before, of the first from the one behind; 0 for a single one."""
    n = len(tracks.time)
    before = np.maximum(np.arange(n) - 1, 0)
    first = tracks.track[before] != tracks.track
    first[:1] = True
    start = np.where(first, np.arange(n), before)
    stop = np.where(first, np.minimum(np.arange(n) + 1, n - 1), np.arange(n))
    alone = tracks.track[stop] != tracks.track[start]
    dt = np.where(alone, 0.0, tracks.time[stop] - tracks.time[start])
    moved = tracks.z[stop] - tracks.z[start]
    return np.where((dt > 0)[:, None], moved / np.where(dt > 0, dt, 1.0)[:, None], 0.0)
