"""Mode, median and moments from a few moments: series and closed forms of the notes.

Standardised cumulants: gamma_1 skewness, gamma_2 excess kurtosis (with the -3), gamma_3 = kappa_5 / sigma^5.
"""

from math import comb

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.shapes import Float

__all__ = ["edgeworth_median", "edgeworth_mode", "paper_mode", "pearson_mode", "unconditional"]

_Out = Float[np.ndarray, "*lead"]


def edgeworth_mode(
    mean: npt.ArrayLike, var: npt.ArrayLike, g1: npt.ArrayLike, g2: npt.ArrayLike, g3: npt.ArrayLike
) -> _Out:
    """Mode to the third order: M + s (-g1/2 - 5/12 g1 g2 + g1^3/4 + g3/8).

    Source: moment-filter notes, section 6.2; the paper's formula (18) lacks the last two terms.
    """
    a, b, c = (np.asarray(g, dtype=np.float64) for g in (g1, g2, g3))
    return np.asarray(np.asarray(mean) + np.sqrt(var) * (-a / 2 - 5 / 12 * a * b + a**3 / 4 + c / 8))


def paper_mode(mean: npt.ArrayLike, var: npt.ArrayLike, g1: npt.ArrayLike, g2: npt.ArrayLike) -> _Out:
    """Mode by the paper's series (18), kept for comparison: M + s (-g1/2 - 5/12 g1 g2).

    Two terms of the same order are missing, so that it is usually worse than its first term alone.
    """
    a, b = np.asarray(g1, dtype=np.float64), np.asarray(g2, dtype=np.float64)
    return np.asarray(np.asarray(mean) + np.sqrt(var) * (-a / 2 - 5 / 12 * a * b))


def pearson_mode(mean: npt.ArrayLike, var: npt.ArrayLike, g1: npt.ArrayLike, g2: npt.ArrayLike) -> _Out:
    """Mode of the Pearson curve with four given moments: M - s g1 (g2 + 6) / (2 (6 + 5 g2 - 6 g1^2)).

    Exact for the gamma law.

    Raises:
        ModelError: the denominator is not positive, where the curve has no such mode.
    """
    a, b = np.asarray(g1, dtype=np.float64), np.asarray(g2, dtype=np.float64)
    below = 6 + 5 * b - 6 * a**2
    if not np.all(below > 0):
        raise ModelError(
            f"no Pearson mode: 6 + 5 g2 - 6 g1^2 = {np.min(below):g} is not positive.\n"
            "Maximise the density instead: MomentPosterior.mode()."
        )
    return np.asarray(np.asarray(mean) - np.sqrt(var) * a * (b + 6) / (2 * below))


def edgeworth_median(
    mean: npt.ArrayLike, var: npt.ArrayLike, g1: npt.ArrayLike, g2: npt.ArrayLike, g3: npt.ArrayLike
) -> _Out:
    """Median to the third order: M + s (-g1/6 - g1 g2/12 + 17/324 g1^3 + g3/40).

    Source: moment-filter notes, section 6.4.
    """
    a, b, c = (np.asarray(g, dtype=np.float64) for g in (g1, g2, g3))
    return np.asarray(np.asarray(mean) + np.sqrt(var) * (-a / 6 - a * b / 12 + 17 / 324 * a**3 + c / 40))


def unconditional(
    probs: Float[np.ndarray, "*lead s"], means: Float[np.ndarray, "*lead s"], central: Float[np.ndarray, "*lead s k"]
) -> tuple[Float[np.ndarray, "*lead"], Float[np.ndarray, "*lead k"]]:
    """Mean and central moments of one coordinate over all modes, from those given the modes.

    mu_k = sum_l P_l sum_j C(k, j) mu_j^l (M_l - M)^(k - j)

    Args:
        probs: of the modes.
        means: given the modes.
        central: moments of order 0, 1, ..., k - 1 about those means; the first two are 1 and 0.

    Source: moment-filter notes, section 3 (the paper's (10)-(13)).
    """
    mean = (probs * means).sum(-1)
    off = means - mean[..., None]
    orders = range(central.shape[-1])
    total = [sum(comb(k, j) * (probs * central[..., j] * off ** (k - j)).sum(-1) for j in range(k + 1)) for k in orders]
    return mean, np.stack(total, axis=-1)
