"""One estimate from each system: are they of the same object? The probabilities of both answers, and thresholds.

Two estimates x_a, x_b with independent errors of covariance C_a, C_b are declared one object where

    l^2 = (x_a - x_b)' (C_a + C_b)^-1 (x_a - x_b) < h^2.

For objects a distance apart, l^2 is non-central chi-square with as many degrees of freedom as the estimates have
coordinates; h and the distance are in units of the standard deviation of the difference, without dimension.

Source: Chervakov, Bogdanov and Zhironkin (2016), equations 25-28, with h dimensionless throughout.
"""

import operator

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError
from saltus.models.checks import FloatArray, covariance, numbers
from saltus.shapes import Float

__all__ = ["p_correct", "p_false", "separation", "threshold"]

_REACH = 12.0  # standard deviations; what lies farther weighs less than 1e-31
_PANEL = 8.0  # length of a panel of the quadrature, standard deviations
_NODES = 32  # of Gauss and Legendre on a panel: exact to round-off for the normal density
_POINT = 1e-6  # a range shorter than this is a point to 1e-13
_HALVINGS = 120  # bisection to the last bit


def p_correct(h: npt.ArrayLike, dim: int) -> Float[np.ndarray, "*shape"]:
    """Return the probability that two estimates of one object are declared one object.

    P_correct = P(chi^2_dim < h^2); 1 - exp(-h^2 / 2) in two dimensions

    Args:
        h: threshold for the normalised distance l, dimensionless, not negative, any shape.
        dim: number of coordinates.

    Raises:
        DataError: h is negative or NaN.
        ModelError: dim is no positive integer.

    Source: Chervakov, Bogdanov and Zhironkin (2016), section on single estimates.
    """
    from scipy.special import gammainc

    return np.asarray(gammainc(0.5 * _dimension(dim), 0.5 * _nonnegative("h", h) ** 2))


def p_false(h: npt.ArrayLike, distance: npt.ArrayLike | tuple[float, ...], dim: int) -> Float[np.ndarray, "*shape"]:
    """Return the probability that estimates of two different objects are declared one object.

    P_false = P(chi^2_dim(distance^2) < h^2)
            = int_-h^h phi(u - distance) P(chi^2_(dim-1) < h^2 - u^2) du,

    u being the coordinate along the line between the objects; with distance 0 it is `p_correct`. For distances
    uniform between two ends, phi is replaced by its mean over them.

    Args:
        h: threshold for the normalised distance l, dimensionless, not negative.
        distance: true distance in units of the standard deviation of the difference (`separation` for any
            covariance), an array that broadcasts with h; or a tuple (low, high): the mean over distances uniform
            between these.
        dim: number of coordinates.

    Raises:
        DataError: h or a distance is negative or NaN, low exceeds high, or shapes do not broadcast.
        ModelError: dim is no positive integer.

    Source: Chervakov, Bogdanov and Zhironkin (2016), the 2-D and 3-D formulas; this one holds in any dimension.
    """
    low, high = _ends(distance)
    radius = _nonnegative("h", h)
    try:
        shape = np.broadcast_shapes(radius.shape, low.shape)
    except ValueError:
        raise DataError(
            f"h {radius.shape} and distance {low.shape} do not broadcast. Add axes of length 1, h[None, :] and "
            "distance[:, None], or give the ends of a range as a tuple."
        ) from None
    radius, low, high = (np.broadcast_to(a, shape) for a in (radius, low, high))
    return _false(radius, low, high, _dimension(dim))


def threshold(
    *,
    dim: int,
    p_correct: npt.ArrayLike | None = None,
    p_false: npt.ArrayLike | None = None,
    distance: npt.ArrayLike | tuple[float, ...] | None = None,
) -> Float[np.ndarray, "*shape"]:
    """Return the threshold h that gives a probability of correct, or of false, identification.

    Args:
        dim: number of coordinates.
        p_correct: wanted probability that one object is recognised, in (0, 1), any shape; or
        p_false: allowed probability that two objects are taken for one, in (0, 1), any shape, at
        distance: their distance, one number, or (low, high) for distances uniform between; see `p_false`.

    Returns:
        h, dimensionless, in the shape of the probability.

    Raises:
        DataError: a probability outside (0, 1), or a negative distance.
        ModelError: not exactly one of the probabilities, p_false without a distance, or p_correct with one.
    """
    n = _dimension(dim)
    if (p_correct is None) == (p_false is None):
        raise ModelError("give either p_correct or p_false: one threshold cannot promise both.")
    if p_correct is not None:
        from scipy.special import gammaincinv

        if distance is not None:
            raise ModelError("p_correct does not depend on a distance; leave it out, or give p_false.")
        return np.asarray(np.sqrt(2.0 * gammaincinv(0.5 * n, _open("p_correct", p_correct))))
    if distance is None:
        raise ModelError("p_false needs the distance of the objects: a number, or (low, high) for a uniform range.")
    if np.shape(distance) not in ((), (2,)):
        raise DataError(f"distance must be one number or (low, high), got shape {np.shape(distance)}.")
    given = np.asarray(distance, dtype=np.float64)
    low, high = _ends(given if given.ndim == 0 else (float(given[0]), float(given[1])))
    return _root(_open("p_false", p_false), low, high, n)


def separation(difference: npt.ArrayLike, cov: npt.ArrayLike) -> Float[np.ndarray, "*shape"]:
    """Return the Mahalanobis length of a difference: the l of two estimates, or the distance of two objects.

    l = sqrt(d' cov^-1 d). With it the formulas of this module are exact for any covariance.

    Args:
        difference: d, (*lead, dim), SI units.
        cov: covariance of the difference, (dim, dim) or (*lead, dim, dim): C_a + C_b for independent errors, less
            C_ab + C_ab' where they are correlated.

    Raises:
        ModelError: shapes do not fit, or cov is not positive definite.
    """
    d, C = numbers(difference, "difference"), covariance(cov, "cov")
    if d.ndim < 1 or d.shape[-1] != C.shape[-1]:
        raise ModelError(
            f"difference {d.shape} and cov {C.shape} do not fit: they are (*lead, dim), (*lead, dim, dim)."
        )
    try:
        white = np.linalg.solve(np.linalg.cholesky(C), d[..., None])
    except np.linalg.LinAlgError:
        raise ModelError("cov must be positive definite: some direction has no error at all.") from None
    except ValueError:
        raise ModelError(f"leading axes do not broadcast: difference {d.shape}, cov {C.shape}.") from None
    return np.asarray(np.sqrt((white[..., 0] ** 2).sum(-1)))


def _false(h: FloatArray, low: FloatArray, high: FloatArray, dim: int) -> FloatArray:
    """Quadrature over the angle t, u = h cos t, which takes the root out of the ends; all arrays of one shape."""
    from scipy.special import gammainc

    with np.errstate(divide="ignore"):  # h = 0: the clipped infinities span all angles of a sphere without volume
        nearest = np.clip(np.stack([high + _REACH, np.minimum(low, h) - _REACH]) / h, -1.0, 1.0)
        begin, end = np.arccos(nearest)
    x, w = _rule(float((h * (end - begin)).max(initial=0.0)))
    angle = begin[..., None] + (end - begin)[..., None] * x
    sine = h[..., None] * np.sin(angle)
    across = np.ones_like(sine) if dim == 1 else gammainc(0.5 * (dim - 1), 0.5 * sine**2)
    along = _density(h[..., None] * np.cos(angle), low[..., None], high[..., None])
    total = (end - begin) * ((along * across * sine) @ w)
    return np.asarray(np.clip(total, 0.0, 1.0))


def _density(u: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Mean of phi(u - d) over d between the ends."""
    from scipy.special import ndtr

    width, centre = high - low, 0.5 * (low + high)
    point = np.exp(-0.5 * (u - centre) ** 2) / np.sqrt(2.0 * np.pi)
    side = np.where(u > centre, -1.0, 1.0)  # both arguments on the lower side, where ndtr keeps its digits
    mass = side * (ndtr(side * (u - low)) - ndtr(side * (u - high)))
    return np.where(width < _POINT, point, mass / np.where(width < _POINT, 1.0, width))


def _rule(length: float) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights on (0, 1), in as many panels as a length in standard deviations needs."""
    panels = max(1, int(np.ceil(length / _PANEL)))
    x, w = np.polynomial.legendre.leggauss(_NODES)
    nodes = (np.arange(panels)[:, None] + 0.5 * (x + 1.0)) / panels
    return nodes.ravel(), np.tile(0.5 * w / panels, panels)


def _root(wanted: FloatArray, low: FloatArray, high: FloatArray, dim: int) -> FloatArray:
    """Bisection: the probability grows with h, from 0 to 1 to the last bit at the upper end."""
    below, above = np.zeros(wanted.shape), np.full(wanted.shape, float(high) + np.sqrt(dim) + 40.0)
    near, far = np.broadcast_to(low, wanted.shape), np.broadcast_to(high, wanted.shape)
    for _ in range(_HALVINGS):
        middle = np.asarray(0.5 * (below + above))
        if ((middle == below) | (middle == above)).all():
            break
        small = _false(middle, near, far, dim) < wanted
        below, above = np.where(small, middle, below), np.where(small, above, middle)
    return np.asarray(0.5 * (below + above))


def _ends(distance: npt.ArrayLike | tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    if not isinstance(distance, tuple):
        at = _nonnegative("distance", distance)
        return at, at
    if len(distance) != 2:
        raise DataError(f"a range of distances is a tuple (low, high), got {len(distance)} values; give an array.")
    low, high = (_nonnegative("distance", end) for end in distance)
    if low.ndim or high.ndim or low > high:
        raise DataError(f"a range of distances is (low, high) with low <= high, got {distance}.")
    return low, high


def _nonnegative(name: str, value: npt.ArrayLike) -> FloatArray:
    array = np.asarray(value, dtype=np.float64)
    if not (np.isfinite(array) & (array >= 0.0)).all():
        raise DataError(f"{name} must be finite and not negative, in standard deviations; got {value!r}.")
    return array


def _open(name: str, value: npt.ArrayLike | None) -> FloatArray:
    array = np.asarray(value, dtype=np.float64)
    if not ((array > 0.0) & (array < 1.0)).all():
        raise DataError(f"{name} must lie between 0 and 1, both excluded; got {value!r}.")
    return array


def _dimension(dim: int) -> int:
    try:
        n = operator.index(dim)
    except TypeError:
        n = 0
    if n < 1:
        raise ModelError(f"dim must be the number of coordinates, an integer of at least 1; got {dim!r}.")
    return n
