"""Biases of one system against another over time, from the objects that both see."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.identify import LocalTracks, PairSettings, candidate_pairs
from saltus.tracks.bias import PARAMETERS, BiasSeries, effects, spread
from saltus.tracks.bias_fit import Fit, fit_biases, unknown
from saltus.tracks.common_objects import accept_pairs
from saltus.tracks.encounters import Blocks, SystemTracks, encounters
from saltus.tracks.settings import RegistrationSettings

__all__ = ["Comparison", "Registration", "RegistrationSettings", "Series", "register"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]

_LONGEST_GAP = 30.0  # s: a report waits so long for the next one of the other system, between which it is compared


class Registration(NamedTuple):
    """The biases of a system over time, and what could not be told."""

    series: BiasSeries
    not_estimated: dict[str, str]  # group of parameters -> why, at the last time

    @property
    def excess_sd(self) -> float:
        """What differs within an object beyond the stated noise, each axis, m; NaN before anything is known."""
        return float(self.series.excess[-1]) if len(self.series.time) else float("nan")


class Comparison:
    """One system compared with another as time goes on, for its biases against it.

    Blocks of residuals are taken over once they are complete, and forgotten after `memory` seconds.
    """

    def __init__(self, pairing: PairSettings, settings: RegistrationSettings) -> None:
        """Begin without anything to compare.

        Args:
            pairing: for the speed of objects.
            settings: what to expect.
        """
        self._pairing, self._settings = pairing, settings
        self._done = -np.inf  # number of the last block taken
        self._tracks = np.zeros((0, 2), np.int64)  # of each block kept
        self._blocks = _no_blocks()
        self.fit = unknown(settings.prior, settings.scatter)

    def update(self, now: float, a: SystemTracks, b: SystemTracks) -> Fit:
        """Estimate the biases of a against b as known at `now`, from what was kept and what is new.

        Args:
            now: s.
            a: rows of the system that is registered: those of the last `interval` and a minute at least. The addresses
                are those of all its tracks, as known now.
            b: rows of the system it is compared with, registered itself.
        """
        last = np.floor((now - _LONGEST_GAP) / self._settings.block) - 1.0
        tracks, blocks = self._new(a, b, last)
        kept = self._blocks.time > now - self._settings.memory
        self._tracks = np.concatenate([self._tracks[kept], tracks])
        both = zip(self._blocks, blocks, strict=True)
        self._blocks = Blocks._make(np.concatenate([old[kept], new]) for old, new in both)
        self._done = max(self._done, last)
        self.fit = self._estimated(a.icao24, b.icao24)
        return self.fit

    def excess(self) -> float:
        """Return what differs within an object beyond the stated noise, each axis, m; NaN before anything is known."""
        if not len(self._blocks.time):
            return float("nan")
        stated = np.trace(self._blocks.cov, axis1=-2, axis2=-1) / 2.0
        return float(np.sqrt(max(self.fit.noise - 1.0, 0.0) * np.median(stated)))

    def _new(self, a: SystemTracks, b: SystemTracks, last: float) -> tuple[_Index, Blocks]:
        """Residuals of all pairs that may be one object, in the blocks complete since the last time."""
        number = np.floor(a.tracks.time / self._settings.block)
        fresh = (number > self._done) & (number <= last)
        nothing = np.zeros((0, 2), np.int64), _no_blocks()
        if not fresh.any() or not len(b.tracks.time):
            return nothing
        a = a._replace(tracks=LocalTracks(*(v[fresh] for v in a.tracks)), velocity=a.velocity[fresh], ray=a.ray[fresh])
        wide = spread(effects(a.ray, a.velocity), np.diag(self._settings.prior**2)) + a.tracks.R
        reach = 3.0 * float(np.sqrt(np.quantile(np.trace(wide, axis1=-2, axis2=-1), 0.95)))
        during = (b.tracks.time >= a.tracks.time.min() - _LONGEST_GAP) & (
            b.tracks.time <= a.tracks.time.max() + _LONGEST_GAP
        )
        b = b._replace(
            tracks=LocalTracks(*(v[during] for v in b.tracks)), velocity=b.velocity[during], ray=b.ray[during]
        )
        pairs = candidate_pairs(a.tracks, b.tracks, self._pairing, reach=reach)
        if not len(pairs):
            return nothing
        blocks = encounters(a, b, pairs, self._settings.block)
        near = np.linalg.norm(blocks.residual, axis=-1) < reach
        return pairs[blocks.pair[near]], Blocks(*(column[near] for column in blocks))

    def _estimated(self, names_a: _Index, names_b: _Index) -> Fit:
        """Return what the blocks say, with the addresses known now."""
        a, b = names_a[self._tracks[:, 0]], names_b[self._tracks[:, 1]]
        possible = np.flatnonzero((a < 0) | (b < 0) | (a == b))
        order = possible[np.lexsort((self._blocks.time[possible], *self._tracks[possible].T[::-1]))]
        tracks, pair = np.unique(self._tracks[order], axis=0, return_inverse=True)
        told = (names_a[tracks[:, 0]] >= 0) & (names_b[tracks[:, 1]] >= 0)
        blocks = Blocks(*(column[order] for column in self._blocks))._replace(pair=pair.reshape(-1))
        return _estimate(blocks, tracks, told, self.fit, self._settings)


def register(
    a: SystemTracks, b: SystemTracks, pairing: PairSettings, settings: RegistrationSettings | None = None
) -> Registration:
    """Estimate the biases of system a against system b over time.

    Every `interval` the pairs of tracks taken for common objects so far (named alike by both, else the largest set
    that one bias explains) give residuals, and `fit_biases` the biases. Nothing later than a time enters its estimate.

    Args:
        a: tracks of the system that is registered.
        b: tracks of the system it is compared with, registered itself.
        pairing: for the speed of objects.
        settings: what to expect.
    """
    settings = RegistrationSettings() if settings is None else settings
    comparison, series = Comparison(pairing, settings), Series(settings.prior)
    time = np.concatenate([a.tracks.time, b.tracks.time])
    if len(a.tracks.time) and len(b.tracks.time):
        first, last = (
            np.floor(t / settings.interval) for t in (time.min(), time.max() + _LONGEST_GAP + settings.block)
        )
        for now in (np.arange(first + 1.0, last + 2.0) * settings.interval).tolist():
            until = (_until(x, now) for x in (a, b))
            series.append(now, comparison.update(now, *until), comparison.excess())
    return series.registration()


def _until(x: SystemTracks, now: float) -> SystemTracks:
    keep = x.tracks.time <= now
    return SystemTracks(LocalTracks(*(v[keep] for v in x.tracks)), x.velocity[keep], x.ray[keep], x.icao24)


class Series:
    """Biases of one system as they became known."""

    def __init__(self, prior: _Array) -> None:
        """Begin with the standard deviations that hold before anything is known."""
        self._prior, self._times = prior, np.zeros(0)
        self._fits: list[Fit] = []
        self._excess: list[float] = []

    def append(self, now: float, fit: Fit, excess: float) -> None:
        """Add what is known from `now` on."""
        if not fit.objects and not self._fits:
            return
        self._times = np.append(self._times, now)
        self._fits.append(fit)
        self._excess.append(excess)

    def registration(self) -> Registration:
        """Return everything so far."""
        q, fits = len(PARAMETERS), self._fits
        series = BiasSeries(
            time=self._times,
            mean=np.array([f.mean for f in fits]).reshape(-1, q),
            cov=np.array([f.cov for f in fits]).reshape(-1, q, q),
            estimated=np.array([np.isin(np.arange(q), f.chosen) for f in fits], dtype=bool).reshape(-1, q),
            scatter=np.array([f.scatter for f in fits]),
            objects=np.array([f.objects for f in fits], dtype=np.int64),
            excess=np.array(self._excess),
            prior=self._prior,
        )
        why = fits[-1].refused if fits else unknown(self._prior, 1.0).refused
        return Registration(series, why)


def _no_blocks() -> Blocks:
    nothing = Blocks(*(np.zeros((0, *s)) for s in ((), (), (2,), (2, len(PARAMETERS)), (2, 2))))
    return nothing._replace(pair=np.zeros(0, np.int64))


def _estimate(
    blocks: Blocks, tracks: _Index, told: npt.NDArray[np.bool_], before: Fit, settings: RegistrationSettings
) -> Fit:
    """Return what the blocks so far say, starting from the fit before."""
    nothing = unknown(settings.prior, settings.scatter)
    if not len(blocks.time):
        return nothing
    names, blocks = _renumbered(blocks)
    known = (before.mean, before.cov) if len(before.chosen) else None
    accepted = accept_pairs(blocks, tracks[names], told[names], known, settings.prior, before.scatter)
    if not accepted.any():
        return nothing
    keep = accepted[blocks.pair]
    _, kept = _renumbered(Blocks(*(column[keep] for column in blocks)))
    prior, scatter = settings.prior, settings.scatter
    return fit_biases(kept, tracks[names[accepted]], before, prior, scatter, settings.widening)


def _renumbered(blocks: Blocks) -> tuple[_Index, Blocks]:
    names, place = np.unique(blocks.pair, return_inverse=True)
    return names, blocks._replace(pair=place)
