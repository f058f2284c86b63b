"""What is concluded from log-likelihood ratios: the same object, different ones, or not yet known.

A ratio `llr` is log f(measurements | one object) - log f(measurements | two objects), nats, as
`identification_llr` returns it, with the rows on the last axis where rows matter.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError
from saltus.shapes import Bool, Float, Int

__all__ = [
    "DIFFERENT",
    "SAME",
    "UNDECIDED",
    "Verdict",
    "neyman_pearson_bound",
    "posterior",
    "same_object",
    "sprt",
    "sprt_bounds",
]

SAME, UNDECIDED, DIFFERENT = 1, 0, -1


class Verdict(NamedTuple):
    """The end of a sequential test."""

    verdict: Int[np.ndarray, "*pairs"]  # SAME, DIFFERENT, or UNDECIDED where the rows ended first
    row: Int[np.ndarray, "*pairs"]  # that decided; the number of rows where none did


def posterior(llr: npt.ArrayLike, prior: npt.ArrayLike = 0.5) -> Float[np.ndarray, "*shape"]:
    """Return the probability of one object, P = 1 / (1 + exp(-llr) (1 - p) / p).

    Args:
        llr: any shape, nats.
        prior: p, probability of one object before the measurements, in (0, 1), broadcasts with llr.

    Raises:
        DataError: llr is NaN, or p not in (0, 1).

    Source: Bayes' rule for two hypotheses.
    """
    log_odds = _ratio(llr) + _log_odds(prior)
    grown = np.exp(-np.abs(log_odds))  # at most 1: nothing overflows
    return np.asarray(np.where(log_odds >= 0, 1.0, grown) / (1.0 + grown))


def same_object(
    llr: npt.ArrayLike, *, prior: npt.ArrayLike = 0.5, loss_false: float = 1.0, loss_missed: float = 1.0
) -> Bool[np.ndarray, "*shape"]:
    """Declare one object where that has the smaller expected loss.

    llr >= log [(1 - p) loss_false / (p loss_missed)]

    Args:
        llr: any shape, nats.
        prior: p, probability of one object before the measurements, in (0, 1).
        loss_false: loss of taking two objects for one, positive.
        loss_missed: loss of taking one object for two, positive.

    Raises:
        DataError: llr is NaN, or p not in (0, 1).
        ModelError: a loss that is not positive.

    Source: Bayes' rule; equal losses give the most probable hypothesis.
    """
    for name, loss in (("loss_false", loss_false), ("loss_missed", loss_missed)):
        if not 0 < loss < np.inf:
            raise ModelError(f"{name} must be positive and finite, got {loss!r}.")
    return np.asarray(_ratio(llr) >= np.log(loss_false / loss_missed) - _log_odds(prior))


def neyman_pearson_bound(llr_different: npt.ArrayLike, p_false: float) -> float:
    """Return the bound on the ratio that a stated share of different objects reaches.

    The smallest bound with P(llr >= bound | two objects) <= p_false in the sample: declare one object at or above it.

    Args:
        llr_different: ratios of simulated pairs of different objects with the measurements' schedule, any shape; take
            at least 100 / p_false of them for a bound that holds within 10 %.
        p_false: allowed probability of taking two objects for one, in (0, 1).

    Raises:
        DataError: a ratio is NaN, or fewer than 1 / p_false of them.
        ModelError: p_false not in (0, 1).

    Source: the lemma of Neyman and Pearson (1933); the quantile is empirical.
    """
    _error_rate("p_false", p_false)
    sample = np.sort(_ratio(llr_different), axis=None)
    allowed = int(np.floor(p_false * sample.size * (1.0 + 1e-12)))
    if allowed < 1:
        raise DataError(f"{sample.size} ratios cannot tell a probability of {p_false:g}: simulate {100 / p_false:.0f}.")
    # Above the first value that may not be reached, so that ties with it stay out.
    return float(np.nextafter(sample[-allowed - 1], np.inf)) if allowed < sample.size else float(sample[0])


def sprt_bounds(p_false: float, p_missed: float) -> tuple[float, float]:
    """Return the lower and the upper bound of the sequential test.

    Different at llr <= log [p_missed / (1 - p_false)], same at llr >= log [(1 - p_missed) / p_false]. Because the
    ratio steps over a bound, the true error probabilities obey P_false <= p_false / (1 - p_missed) and
    P_missed <= p_missed / (1 - p_false), and are usually less than asked for.

    Args:
        p_false: allowed probability of taking two objects for one.
        p_missed: allowed probability of taking one object for two; p_false + p_missed < 1.

    Raises:
        ModelError: a probability outside (0, 1), or a sum of at least 1.

    Source: Wald (1945), Sequential tests of statistical hypotheses.
    """
    _error_rate("p_false", p_false)
    _error_rate("p_missed", p_missed)
    if p_false + p_missed >= 1.0:
        raise ModelError(
            f"p_false + p_missed must be less than 1, got {p_false:g} + {p_missed:g}: a coin does as well."
        )
    return float(np.log(p_missed / (1.0 - p_false))), float(np.log((1.0 - p_missed) / p_false))


def sprt(llr: npt.ArrayLike, *, p_false: float, p_missed: float) -> Verdict:
    """Decide each pair at the first row where its ratio leaves the bounds of `sprt_bounds`, and keep to it.

    Args:
        llr: cumulative ratios, (*pairs, K).
        p_false: allowed probability of taking two objects for one.
        p_missed: allowed probability of taking one object for two.

    Raises:
        DataError: no row axis, or NaN.
        ModelError: error probabilities that no test can have.
    """
    ratio = _ratio(llr)
    if ratio.ndim < 1:
        raise DataError("llr must have a last axis of rows, (*pairs, K).")
    low, high = sprt_bounds(p_false, p_missed)
    side = np.where(ratio >= high, SAME, np.where(ratio <= low, DIFFERENT, UNDECIDED))
    side = np.concatenate([side, np.full((*side.shape[:-1], 1), UNDECIDED)], axis=-1)
    out = side != UNDECIDED
    row = np.where(out.any(-1), out.argmax(-1), ratio.shape[-1])
    return Verdict(np.take_along_axis(side, row[..., None], axis=-1)[..., 0], np.asarray(row))


def _ratio(llr: npt.ArrayLike) -> npt.NDArray[np.float64]:
    ratio = np.asarray(llr, dtype=np.float64)
    if np.isnan(ratio).any():
        raise DataError("a log-likelihood ratio is NaN; rows without measurements carry the ratio before them.")
    return ratio


def _log_odds(prior: npt.ArrayLike) -> npt.NDArray[np.float64]:
    p = np.asarray(prior, dtype=np.float64)
    if not ((p > 0.0) & (p < 1.0)).all():
        raise DataError(f"the prior probability of one object must lie between 0 and 1, both excluded; got {prior!r}.")
    return np.asarray(np.log(p) - np.log1p(-p))


def _error_rate(name: str, value: float) -> None:
    if not 0.0 < value < 1.0:
        raise ModelError(f"{name} must lie between 0 and 1, both excluded; got {value!r}.")
