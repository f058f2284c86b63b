"""The bound on the multimode ratio that a stated share of different objects reaches, by importance sampling."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from saltus.errors import DataError, ModelError
from saltus.identify.local import PairSettings
from saltus.identify.matched import Schedule, different_pairs, wide_spreads
from saltus.identify.pairs import Ratios, pair_ratios
from saltus.models.checks import FloatArray
from saltus.shapes import Float

__all__ = ["FalseRatios", "false_ratios", "filled"]

_FEWEST = 200  # draws
_AIMS = (1e-1, 1e-2, 1e-3, 1e-4)  # probabilities that the draws tell best
_WIDER = 1.5  # variance of the draws over that of the pairs beyond a bound: no weight is large in the tails
_ENOUGH = 25.0  # draws, in effect, beyond a bound: a probability known within 20 %


class FalseRatios(NamedTuple):
    """Ratios of simulated pairs of different objects, weighted to their own law."""

    llr: Float[np.ndarray, "d k"]  # after each common row, nats
    weight: Float[np.ndarray, " d"]

    def probability(self, bound: float) -> tuple[float, float]:
        """Return P(llr after the last row >= bound | two objects), and the standard error of this estimate."""
        hit = self.weight * (self.llr[:, -1] >= bound)
        return float(hit.mean()), float(hit.std(ddof=1) / np.sqrt(len(hit)))

    def bound(self, p_false: float) -> float:
        """Return the smallest bound with P(llr after the last row >= bound | two objects) <= p_false.

        Raises:
            ModelError: p_false not in (0, 1).
            DataError: too few draws to tell.
        """
        if not 0.0 < p_false < 1.0:
            raise ModelError(f"p_false must lie between 0 and 1, both excluded; got {p_false!r}.")
        order = np.argsort(self.llr[:, -1])[::-1]
        reached = np.cumsum(self.weight[order]) / len(order)
        allowed = int(np.searchsorted(reached, p_false, side="right"))
        inside = self.weight[order[:allowed]]
        effective = float(inside.sum() ** 2 / np.square(inside).sum()) if allowed else 0.0
        if effective < _ENOUGH:
            raise DataError(
                f"{len(order)} draws cannot tell a probability of {p_false:g}: in effect {effective:.0f} lie beyond "
                f"the bound and {_ENOUGH:.0f} are needed. Take more draws."
            )
        ratios = self.llr[order, -1]
        return float(np.nextafter(ratios[allowed], np.inf)) if allowed < len(order) else float(ratios[-1])


@lru_cache(maxsize=256)
def false_ratios(schedule: Schedule, settings: PairSettings, *, draws: int, seed: int) -> FalseRatios:
    """Return ratios of pairs of different objects that are measured by a schedule.

    The objects are simulated from the settings, near each other on purpose, and weighted (see `different_pairs`), so
    that some ten thousand draws tell probabilities of 1e-1 to 1e-4 and less; a fifth as many find out how near.
    Results are kept in memory for equal arguments; a schedule whose times are rounded is met again more often.

    Args:
        schedule: times, systems and covariances of the rows.
        settings: objects, offset and region.
        draws: pairs to simulate.
        seed: of their generator, >= 0.

    Raises:
        ModelError: too few draws.
    """
    if draws < _FEWEST:
        raise ModelError(f"draws must be at least {_FEWEST}, got {draws}.")
    rng = np.random.default_rng(seed)
    pilot = _drawn(schedule, settings, max(_FEWEST, draws // 5), rng, wide_spreads(schedule, settings))
    return _drawn(schedule, settings, draws, rng, _spreads(*pilot))[0]


def _drawn(
    schedule: Schedule, settings: PairSettings, draws: int, rng: np.random.Generator, spreads: FloatArray
) -> tuple[FalseRatios, FloatArray]:
    """Ratios, and how far apart the objects were."""
    drawn = different_pairs(schedule, settings, draws, rng, spreads)
    pairs = np.repeat(np.arange(draws)[:, None], 2, axis=1)
    return FalseRatios(filled(pair_ratios(drawn.a, drawn.b, pairs, settings)), drawn.weight), drawn.apart


def _spreads(pilot: FalseRatios, apart: FloatArray) -> FloatArray:
    """Covariances of the differences of pairs beyond the bounds of several probabilities, widened."""
    order = np.argsort(pilot.llr[:, -1])[::-1]
    weight, off = pilot.weight[order], apart[order]
    reached = np.cumsum(weight) / len(order)
    found = []
    for p in _AIMS:
        beyond = max(_FEWEST // 10, int(np.searchsorted(reached, p, side="right")))
        share = weight[:beyond] / weight[:beyond].sum()
        found.append(_WIDER * np.einsum("d,di,dj->ij", share, off[:beyond], off[:beyond]))
    return np.array(found)


def filled(ratios: Ratios) -> Float[np.ndarray, "p k"]:
    """Return the ratios with the last one of each pair carried to the end, as `sprt` and `posterior` take them.

    Raises:
        DataError: a pair without rows.
    """
    if (ratios.count == 0).any():
        raise DataError(f"pair {int(ratios.count.argmin())} has no common rows and hence no ratio; leave it out.")
    last = np.minimum(np.arange(ratios.llr.shape[1]), ratios.count[:, None] - 1)
    return np.take_along_axis(ratios.llr, last, axis=1)
