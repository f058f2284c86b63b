"""Which Hermite moments belong to a density, and how those that do not are mended."""

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from saltus.filters.moments.basis import Basis, basis
from saltus.shapes import Bool, Float

__all__ = ["MARGIN", "deviation", "margin", "shrunk"]

# Least eigenvalue of the moment matrix that is left alone, by order: a wider margin at order 6 doubles the error.
MARGIN = {2: 0.0, 3: 3e-3, 4: 3e-3, 5: 3e-5, 6: 3e-5}
_BISECTIONS = 16
_ABSURD = 1e6  # moments of whitened variables are of size 1


@lru_cache(maxsize=16)
def _products(n: int, order: int) -> npt.NDArray[np.float64]:
    of = basis(n, order)
    return of.products(order // 2)


def margin(of: Basis, h: Float[np.ndarray, "*lead a"]) -> Float[np.ndarray, "*lead"]:
    """Least eigenvalue of the moment matrix <psi_a psi_b>, |a|, |b| <= order / 2: not negative for a density.

    In one dimension a positive margin suffices (Hankel); in more it is necessary. For order 4 and one dimension it
    says that gamma_2 + 3 > 1 + gamma_1^2.

    Source: moment-filter notes, section 4.6.
    """
    sane = np.abs(h).max(axis=-1) < _ABSURD  # NaN is not
    G = np.einsum("...k,ijk->...ij", np.where(sane[..., None], h, 0.0), _products(of.indices.shape[-1], of.order))
    return np.asarray(np.where(sane, np.linalg.eigvalsh(G)[..., 0], -np.inf))


def shrunk(
    of: Basis, h: Float[np.ndarray, "r a"], least: float | None = None
) -> tuple[Float[np.ndarray, "r a"], Bool[np.ndarray, " r"]]:
    """Draw moments towards those of the Gaussian, h <- t h with the largest t that leaves the margin.

    The moments of densities are a convex set that holds the Gaussian inside, so bisection finds t.

    Returns:
        The moments, and which were changed.
    """
    want = MARGIN[of.order] if least is None else least
    bad = ~(margin(of, h) >= want)  # NaN is bad
    if not bad.any():
        return h, bad
    rows = np.where(np.abs(h[bad]) < _ABSURD, h[bad], 0.0)
    low, high = np.zeros(len(rows)), np.ones(len(rows))
    rest = rows.copy()
    rest[:, 0] = 0.0
    unit = np.zeros(rows.shape[-1])
    unit[0] = 1.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        fits = margin(of, unit + middle[:, None] * rest) >= want
        low, high = np.where(fits, middle, low), np.where(fits, high, middle)
    mended = h.copy()
    mended[bad] = unit + low[:, None] * rest
    return mended, bad


def deviation(of: Basis, h: Float[np.ndarray, "*lead a"]) -> Float[np.ndarray, "*lead"]:
    """Distance from the Gaussian in nats, J = sum_{|a| = 3, 4} h_a^2 / 2, to leading order the Kullback divergence.

    In one dimension gamma_1^2 / 12 + gamma_2^2 / 48. It does not depend on the choice of axes.

    Source: moment-filter notes, section 8.
    """
    high = (of.degree == 3) | (of.degree == 4)
    return np.asarray(0.5 * np.square(h[..., high]).sum(-1))
