"""Biases of one system against another over time, from the objects that both see."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.identify import PairSettings, candidate_pairs
from saltus.tracks.bias import PARAMETERS, BiasSeries, effects, spread
from saltus.tracks.bias_fit import Fit, fit_biases, unknown
from saltus.tracks.common_objects import accept_pairs
from saltus.tracks.encounters import Blocks, SystemTracks, encounters
from saltus.tracks.settings import RegistrationSettings

__all__ = ["Registration", "RegistrationSettings", "register"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]


class Registration(NamedTuple):
    """The biases of a system over time, and what could not be told."""

    series: BiasSeries
    not_estimated: dict[str, str]  # group of parameters -> why, at the last time
    excess_sd: float  # m: of what differs within an object beyond the stated noise, each axis


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
    blocks, tracks, told = _blocks(a, b, pairing, settings)
    fit = unknown(settings.prior, settings.scatter)
    fits, times = [], []
    if len(blocks.time):
        for now in np.arange(blocks.time.min(), blocks.time.max() + settings.interval, settings.interval):
            fit = _estimate(blocks.until(now - settings.memory, now), tracks, told, fit, settings)
            fits.append(fit)
            times.append(now)
    stated = np.trace(blocks.cov, axis1=-2, axis2=-1) / 2.0
    sd = float(np.sqrt(max(fit.noise - 1.0, 0.0) * np.median(stated))) if len(stated) else 0.0
    return Registration(_series(times, fits, settings), fit.refused, sd)


def _series(times: list[float], fits: list[Fit], settings: RegistrationSettings) -> BiasSeries:
    q = len(PARAMETERS)
    return BiasSeries(
        time=np.array(times),
        mean=np.array([f.mean for f in fits]).reshape(-1, q),
        cov=np.array([f.cov for f in fits]).reshape(-1, q, q),
        estimated=np.array([np.isin(np.arange(q), f.chosen) for f in fits], dtype=bool).reshape(-1, q),
        scatter=np.array([f.scatter for f in fits]),
        objects=np.array([f.objects for f in fits], dtype=np.int64),
        prior=settings.prior,
    )


def _blocks(
    a: SystemTracks, b: SystemTracks, pairing: PairSettings, settings: RegistrationSettings
) -> tuple[Blocks, _Index, npt.NDArray[np.bool_]]:
    """Residuals of all pairs that may be one object, their tracks, and which of them both systems name alike."""
    nothing = Blocks(*(np.zeros((0, *s)) for s in ((), (), (2,), (2, len(PARAMETERS)), (2, 2))))
    nothing = nothing._replace(pair=np.zeros(0, np.int64))
    if not len(a.tracks.time) or not len(b.tracks.time):
        return nothing, np.zeros((0, 2), np.int64), np.zeros(0, bool)
    wide = spread(effects(a.ray, a.velocity), np.diag(settings.prior**2)) + a.tracks.R
    reach = 3.0 * float(np.sqrt(np.quantile(np.trace(wide, axis1=-2, axis2=-1), 0.95)))
    pairs = candidate_pairs(a.tracks, b.tracks, pairing, reach=reach)
    code_a, code_b = a.icao24[pairs[:, 0]], b.icao24[pairs[:, 1]]
    both = (code_a >= 0) & (code_b >= 0)
    pairs, told = pairs[~both | (code_a == code_b)], both[~both | (code_a == code_b)]
    if not len(pairs):
        return nothing, pairs, told
    blocks = encounters(a, b, pairs, settings.block)
    near = np.linalg.norm(blocks.residual, axis=-1) < reach
    return Blocks(*(column[near] for column in blocks)), pairs, told


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
