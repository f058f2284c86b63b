"""Pairs drawn from the model that the ratio assumes: one object seen by both systems, or two near each other."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError
from saltus.identify.lanes import Index
from saltus.identify.local import LocalTracks, PairSettings
from saltus.models.checks import FloatArray, covariance
from saltus.shapes import Float

__all__ = ["PairDraws", "Schedule", "different_pairs", "same_pairs", "wide_spreads"]

_OCTAVES = 9  # up to 256 times what the measurements can tell apart


@dataclass(frozen=True, slots=True)
class Schedule:
    """When each system measures, and how well.

    Attributes:
        times: s, not decreasing.
        system: 0 or 1 of each row; both occur.
        R: covariance of system 0 and of system 1, (2, 2) each, m^2.
    """

    times: tuple[float, ...]
    system: tuple[int, ...]
    R: tuple[tuple[tuple[float, ...], ...], tuple[tuple[float, ...], ...]]

    @classmethod
    def of(cls, times: npt.ArrayLike, system: npt.ArrayLike, R: Sequence[npt.ArrayLike]) -> "Schedule":
        """Make a schedule of arrays.

        Raises:
            DataError: rows out of order, or a system that has none.
            ModelError: a covariance that is none.
        """
        t, s = np.asarray(times, dtype=np.float64), np.asarray(system)
        if t.ndim != 1 or s.shape != t.shape or not np.isfinite(t).all() or (np.diff(t) < 0).any():
            raise DataError(f"times {t.shape} and system {s.shape} must be one row each, sorted by time.")
        if len(R) != 2 or set(s.tolist()) != {0, 1}:
            raise DataError(f"a schedule has rows of systems 0 and 1 and a covariance for each; got {set(s.tolist())}.")
        first, other = (covariance(r, f"R[{i}]") for i, r in enumerate(R))
        if first.shape != (2, 2) or other.shape != (2, 2):
            raise DataError(f"R must be two covariances (2, 2), got {first.shape} and {other.shape}.")
        rows = [tuple(tuple(row) for row in r.tolist()) for r in (first, other)]
        return cls(tuple(t.tolist()), tuple(int(k) for k in s), (rows[0], rows[1]))


class PairDraws(NamedTuple):
    """Independent pairs: track d of a and track d of b."""

    a: LocalTracks
    b: LocalTracks
    weight: Float[np.ndarray, " d"]  # density of the model over the density drawn from
    apart: Float[np.ndarray, "d 4"]  # state (x, vx, y, vy) of the later object less the other's, when it is first seen


def same_pairs(schedule: Schedule, settings: PairSettings, draws: int, rng: np.random.Generator) -> PairDraws:
    """Draw pairs of tracks of one object: the later system carries offset and clock."""
    times, _, later = _opened(schedule)
    states = _walk(_somewhere(settings, draws, rng), times, settings, rng)
    root = _root(np.asarray(settings.offset_cov))
    offset = rng.standard_normal((draws, 2)) @ root.T
    clock = settings.time_sigma * rng.standard_normal((draws, 1, 1))
    moved = states[..., 0] + clock * states[..., 1]
    for k, dt in enumerate(np.diff(times, prepend=times[0])):
        kept = np.exp(-dt / settings.offset_time)
        offset = kept * offset + np.sqrt(1.0 - kept**2) * (rng.standard_normal((draws, 2)) @ root.T)
        moved[:, k] += offset
    seen = [moved if s == later else states[..., 0] for s in (0, 1)]
    return _measured(schedule, seen, settings, np.ones(draws), rng, np.zeros((draws, 4)))


def different_pairs(
    schedule: Schedule, settings: PairSettings, draws: int, rng: np.random.Generator, spreads: FloatArray
) -> PairDraws:
    """Draw pairs of tracks of two independent objects, as near each other as asked, with their weights.

    Taking two objects for one is rare because they are rarely near each other. The state x of the later object at its
    first measurement is therefore drawn from a mixture g, in equal parts, of the region's law f and of Gaussians about
    the other object's state; f(x) / g(x), at most the number of components, is its weight. Everything after that is
    the model's own, so that weighted means are those of the model, whatever the filters leave out.

    Args:
        schedule: times, systems and covariances of the rows.
        settings: objects and region.
        draws: number of pairs.
        rng: source of randomness.
        spreads: covariances of the Gaussians, (C, 4, 4); none: the region's law alone, all weights 1.
    """
    times, first, later = _opened(schedule)
    early = _walk(_somewhere(settings, draws, rng), times, settings, rng)
    at = first[later]
    centre = early[:, at].reshape(draws, 4)
    start, weight = _near(centre, spreads, settings, rng)
    late = np.full_like(early, np.nan)
    late[:, at:] = _walk(start.reshape(draws, 2, 2), times[at:], settings, rng)
    seen = [(late if s == later else early)[..., 0] for s in (0, 1)]
    return _measured(schedule, seen, settings, weight, rng, start - centre)


def wide_spreads(schedule: Schedule, settings: PairSettings) -> Float[np.ndarray, "c 4 4"]:
    """Return covariances for `different_pairs` in octaves, from what the measurements tell apart to far more."""
    errors = sum(np.trace(np.array(r)) for r in schedule.R) + np.trace(np.asarray(settings.offset_cov))
    position = np.sqrt(0.5 * errors)
    speed = min(settings.speed_sigma, position / max(schedule.times[-1] - schedule.times[0], 1e-3))
    narrow = np.diag(np.tile([position, speed], 2) ** 2)
    return np.asarray(4.0 ** np.arange(_OCTAVES)[:, None, None] * narrow)


def _opened(schedule: Schedule) -> tuple[FloatArray, tuple[int, int], int]:
    """Times, the first row of each system, and the system that begins later (1 where both begin together)."""
    system = np.array(schedule.system)
    first = (int((system == 0).argmax()), int((system == 1).argmax()))
    times = np.array(schedule.times)
    return times, first, 1 if times[first[0]] <= times[first[1]] else 0


def _somewhere(settings: PairSettings, draws: int, rng: np.random.Generator) -> FloatArray:
    """States [axis, (position, velocity)] of objects in the region, (D, 2, 2)."""
    mean, cov = settings.prior()
    return (mean + rng.standard_normal((draws, 4)) @ _root(cov).T).reshape(draws, 2, 2)


def _walk(start: FloatArray, times: FloatArray, settings: PairSettings, rng: np.random.Generator) -> FloatArray:
    """States (D, K, 2, 2) at times, from those at the first of them."""
    chain = settings.chain()
    density = settings.densities()
    dt = np.diff(times, prepend=times[0])
    trans = chain.transition(dt)
    mode = rng.choice(len(chain), size=len(start), p=chain.law)
    x, out = start, np.empty((len(start), len(times), 2, 2))
    for k, d in enumerate(dt):
        mode = (rng.random(len(x))[:, None] > trans[k].cumsum(-1)[mode]).sum(-1).clip(max=len(chain) - 1)
        # Cholesky factor of [[d^3/3, d^2/2], [d^2/2, d]].
        L = np.sqrt(d) * np.array([[d / np.sqrt(3.0), 0.0], [np.sqrt(0.75), 0.5]])
        noise = np.sqrt(density[mode])[:, None, None] * (rng.standard_normal((len(x), 2, 2)) @ L.T)
        x = x @ np.array([[1.0, 0.0], [d, 1.0]]) + noise
        out[:, k] = x
    return out


def _near(
    centre: FloatArray, spreads: FloatArray, settings: PairSettings, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """States drawn near those of other objects or anywhere, (D, 4), and their weights (D,)."""
    (mean, cov), D = settings.prior(), len(centre)
    x = _somewhere(settings, D, rng).reshape(D, 4)
    part = rng.integers(len(spreads) + 1, size=D)
    for c, spread in enumerate(spreads):
        mine = part == c
        x[mine] = centre[mine] + rng.standard_normal((int(mine.sum()), 4)) @ _root(spread).T
    region = _log_normal(x - mean, cov)
    mixture = np.logaddexp.reduce([region, *(_log_normal(x - centre, spread) for spread in spreads)])
    return x, np.exp(region - mixture + np.log(len(spreads) + 1))


def _log_normal(off: FloatArray, cov: FloatArray) -> FloatArray:
    L = np.linalg.cholesky(cov)
    white = np.linalg.solve(L, off.T)
    return np.asarray(-0.5 * (white**2).sum(0) - np.log(np.diagonal(L)).sum() - 0.5 * len(L) * np.log(2.0 * np.pi))


def _measured(
    schedule: Schedule,
    seen: Sequence[FloatArray],
    settings: PairSettings,
    weight: FloatArray,
    rng: np.random.Generator,
    apart: FloatArray,
) -> PairDraws:
    """Add noise to the positions (D, K, 2) that each system sees, and keep its rows."""
    system, times, D = np.array(schedule.system), np.array(schedule.times), len(weight)
    tracks = []
    for s, position in enumerate(seen):
        rows: Index = np.flatnonzero(system == s)
        R = np.array(schedule.R[s])
        faulty = rng.random((D, len(rows), 1)) < settings.outlier_probability
        size = np.where(faulty, settings.outlier_factor, 1.0)
        z = position[:, rows] + size * (rng.standard_normal((D, len(rows), 2)) @ _root(R).T)
        track = np.repeat(np.arange(D), len(rows))
        R = np.broadcast_to(R, (len(track), 2, 2))
        tracks.append(LocalTracks(track, np.tile(times[rows], D), z.reshape(-1, 2), R))
    return PairDraws(tracks[0], tracks[1], weight, apart)


def _root(cov: FloatArray) -> FloatArray:
    """A square root that also a singular covariance has."""
    values, vectors = np.linalg.eigh(cov)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
