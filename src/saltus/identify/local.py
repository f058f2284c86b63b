"""Local tracks of a system as arrays, and what is assumed about objects when two of them are compared."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from saltus.errors import DataError, ModelError
from saltus.linalg import block_diagonal
from saltus.models import Chain
from saltus.models.checks import FloatArray, covariance, numbers, same
from saltus.shapes import Bool, Float, Int

__all__ = ["LocalTracks", "PairSettings", "Spans", "spans", "thinned"]


class LocalTracks(NamedTuple):
    """All local tracks of one system: one row for each measurement, sorted by track, then by time."""

    track: Int[np.ndarray, " n"]  # 0..K-1, index of the local track
    time: Float[np.ndarray, " n"]  # s
    z: Float[np.ndarray, "n 2"]  # position in the plane, m, registered
    R: Float[np.ndarray, "n 2 2"]  # its covariance, m^2; lasting errors already made up for


@dataclass(frozen=True, slots=True, eq=False)
class PairSettings:
    """The objects that systems see, and the errors that lie between systems.

    Every hypothesis runs the same multimode filter: white acceleration whose level is a Markov chain. White, because
    the filter of both systems meets other intervals than that of one and must not take one object for another thing.

    Attributes:
        accel: level of acceleration of each mode, m/s^2, steady motion first.
        sojourn: mean stay in each mode, s.
        accel_time: s that an acceleration lasts: the spectral density is accel^2 accel_time.
        offset_cov: covariance of the constant offset left between the systems, (2, 2), m^2; zeros: none.
        offset_time: correlation time of that offset, s; inf: it is constant.
        time_sigma: standard deviation of an object's constant difference of clocks between the systems, s: on-board
            latency displaces it along its course.
        outlier_probability: of a measurement whose error is `outlier_factor` times as large; 0: there are none.
        outlier_factor: see there.
        region_mean: centre of the region under surveillance, (2,), m.
        region_cov: covariance of an object's position in it before it is seen, (2, 2), m^2.
        speed_sigma: standard deviation of each component of an object's velocity, m/s.

    Raises:
        ModelError: values that describe no objects.
    """

    accel: tuple[float, ...] = (0.15, 3.0)
    sojourn: tuple[float, ...] = (120.0, 25.0)
    accel_time: float = 4.0
    offset_cov: FloatArray | Sequence[Sequence[float]] = field(default_factory=lambda: np.zeros((2, 2)))
    offset_time: float = np.inf
    time_sigma: float = 0.0
    outlier_probability: float = 0.0
    outlier_factor: float = 10.0
    region_mean: FloatArray | Sequence[float] = (0.0, 0.0)
    region_cov: FloatArray | Sequence[Sequence[float]] = field(default_factory=lambda: 1e10 * np.eye(2))
    speed_sigma: float = 100.0

    def __post_init__(self) -> None:
        """Check and store arrays."""
        put = object.__setattr__
        for name in ("accel", "sojourn"):
            value = tuple(float(v) for v in getattr(self, name))
            if not value or not all(0 < v < np.inf for v in value):
                raise ModelError(f"PairSettings.{name} must be positive numbers, one per mode; got {value}.")
            put(self, name, value)
        if len(self.accel) != len(self.sojourn):
            raise ModelError(
                f"PairSettings has {len(self.accel)} levels of acceleration and {len(self.sojourn)} mean stays; "
                "give one of each per mode."
            )
        for name in ("accel_time", "speed_sigma"):
            if not 0 < getattr(self, name) < np.inf:
                raise ModelError(f"PairSettings.{name} must be positive and finite, got {getattr(self, name)}.")
        if not (
            0 <= self.time_sigma < np.inf and 0 <= self.outlier_probability < 1 and 1 <= self.outlier_factor < np.inf
        ):
            raise ModelError(
                f"PairSettings: time_sigma must not be negative, outlier_probability lie in [0, 1) and outlier_factor "
                f"be at least 1; got {self.time_sigma}, {self.outlier_probability} and {self.outlier_factor}."
            )
        if not self.offset_time > 0:
            raise ModelError(f"PairSettings.offset_time must be positive or inf, got {self.offset_time}.")
        for name in ("offset_cov", "region_cov"):
            matrix = covariance(getattr(self, name), f"PairSettings.{name}")
            if matrix.shape != (2, 2):
                raise ModelError(f"PairSettings.{name} must be a covariance (2, 2), got shape {matrix.shape}.")
            put(self, name, matrix)
        if np.linalg.eigvalsh(np.asarray(self.region_cov)).min() <= 0:
            raise ModelError("PairSettings.region_cov must be positive definite: objects are somewhere in a region.")
        mean = numbers(self.region_mean, "PairSettings.region_mean")
        if mean.shape != (2,):
            raise ModelError(f"PairSettings.region_mean must be a position (2,), got shape {mean.shape}.")
        put(self, "region_mean", mean)

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    def __hash__(self) -> int:
        arrays = (self.offset_cov, self.region_mean, self.region_cov)
        plain = (self.accel, self.sojourn, self.accel_time, self.offset_time, self.time_sigma, self.speed_sigma)
        outliers = (self.outlier_probability, self.outlier_factor)
        return hash((*plain, *outliers, *(np.asarray(a).tobytes() for a in arrays)))

    def densities(self) -> FloatArray:
        """Return the spectral density of acceleration in each mode, (M,), m^2/s^3."""
        return np.square(self.accel) * self.accel_time

    def chain(self) -> Chain:
        """Return the chain of manoeuvres."""
        labels = [f"level{i}" for i in range(len(self.accel))]
        if len(labels) == 1:
            return Chain("manoeuvre", labels, trans=[[1.0]])
        return Chain("manoeuvre", labels, sojourn=dict(zip(labels, self.sojourn, strict=True)))

    def differences(self) -> FloatArray:
        """Return the covariance of the lasting differences between systems: the offset, then the clock, where any."""
        parts = [np.asarray(self.offset_cov)] if np.any(self.offset_cov) else []
        if self.time_sigma > 0:
            parts.append(np.array([[self.time_sigma**2]]))
        return block_diagonal(*parts) if parts else np.zeros((0, 0))

    def prior(self) -> tuple[FloatArray, FloatArray]:
        """Return mean (4,) and covariance (4, 4) of (x, vx, y, vy) at an object's first measurement."""
        mean, cov = np.zeros(4), self.speed_sigma**2 * np.eye(4)
        mean[0::2], cov[0::2, 0::2] = self.region_mean, self.region_cov
        return mean, cov


def thinned(tracks: LocalTracks, spacing: float) -> LocalTracks:
    """Keep the last row of each track in each stretch of `spacing` seconds."""
    last = np.ones(len(tracks.time), bool)
    last[:-1] = (np.diff(np.floor(tracks.time / spacing)) != 0) | (np.diff(tracks.track) != 0)
    return LocalTracks(*(column[last] for column in tracks))


class Spans(NamedTuple):
    """Where the rows of each track lie, and when it lived."""

    first: Int[np.ndarray, " k"]  # its first row
    stop: Int[np.ndarray, " k"]  # one behind its last
    begin: Float[np.ndarray, " k"]  # s
    end: Float[np.ndarray, " k"]  # s

    @property
    def empty(self) -> Bool[np.ndarray, " k"]:
        """Tracks without a row."""
        return np.asarray(self.first == self.stop)


def spans(tracks: LocalTracks, name: str) -> Spans:
    """Check local tracks and find the rows of each.

    Raises:
        DataError: rows out of order, numbers that are not finite, or shapes that do not fit; `name` says whose.
    """
    track, time = np.asarray(tracks.track), np.asarray(tracks.time, dtype=np.float64)
    n = len(track)
    shapes = (track.shape, time.shape, np.shape(tracks.z), np.shape(tracks.R))
    if shapes != ((n,), (n,), (n, 2), (n, 2, 2)):
        raise DataError(f"local tracks of {name} have shapes {shapes}; they are (N,), (N,), (N, 2) and (N, 2, 2).")
    for what, values in (("time", time), ("z", tracks.z), ("R", tracks.R)):
        if not np.isfinite(values).all():
            row = int(np.argwhere(~np.isfinite(np.reshape(values, (n, -1))).all(-1))[0, 0])
            raise DataError(f"local tracks of {name}: {what} of row {row} is not finite. Leave out what is not known.")
    wrong = (np.diff(track) < 0) | ((np.diff(track) == 0) & (np.diff(time) < 0))
    if wrong.any() or (n and track[0] < 0):
        row = int(wrong.argmax()) + 1 if wrong.any() else 0
        raise DataError(
            f"local tracks of {name}: row {row} (track {track[row]}, {time[row]:.9g} s) is out of order. "
            "Sort by track, then by time: np.lexsort((time, track)); tracks count from 0."
        )
    count = int(track[-1]) + 1 if n else 0
    edge = np.searchsorted(track, np.arange(count + 1))
    first, stop = edge[:-1], edge[1:]
    begin, end = np.full(count, np.inf), np.full(count, -np.inf)
    alive = first < stop
    begin[alive], end[alive] = time[first[alive]], time[stop[alive] - 1]
    return Spans(first, stop, begin, end)
