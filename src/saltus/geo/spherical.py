"""Spherical measurements to Cartesian ones, with and without the conversion bias."""

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError
from saltus.shapes import Float

__all__ = ["spherical_to_cartesian", "variance"]

Array = npt.NDArray[np.float64]


def spherical_to_cartesian(
    r: npt.ArrayLike,
    azimuth: npt.ArrayLike,
    elevation: npt.ArrayLike,
    sigma_r: npt.ArrayLike,
    sigma_azimuth: npt.ArrayLike,
    sigma_elevation: npt.ArrayLike,
    *,
    unbiased: bool = False,
) -> tuple[Float[np.ndarray, "*lead 3"], Float[np.ndarray, "*lead 3 3"]]:
    """Convert spherical measurements to Cartesian ones with their covariance.

    x = r cos(eps) cos(beta),  y = r cos(eps) sin(beta),  z = r sin(eps),  cov = J diag(sigma^2) J',
    J = d(x, y, z)/d(r, beta, eps).  The errors are independent; everything is evaluated at the measurement.

    With `unbiased`, x and y are multiplied by exp((sigma_beta^2 + sigma_eps^2)/2) and z by exp(sigma_eps^2/2), so
    that Gaussian errors of the angles, of any size, leave no bias, and cov is the exact covariance of that
    estimate for a target at the measured position.

    Args:
        r: range, m, (...,).
        azimuth: rad, from the x axis towards y.
        elevation: rad, above the xy plane.
        sigma_r: standard deviation of the range, m.
        sigma_azimuth: of the azimuth, rad.
        sigma_elevation: of the elevation, rad.
        unbiased: remove the conversion bias.

    Returns:
        xyz (..., 3) in m and cov (..., 3, 3) in m^2.

    Raises:
        DataError: a standard deviation is negative.

    Source: Zhuk, Kozheshkurt, Yuzefovich (2009), eqs. 1 and 10-15 as corrected in the theory notes; the
    multiplicative correction: Mo, Song, Zhou, Sun, Bar-Shalom (1998), Unbiased converted measurements for
    tracking, IEEE Trans. AES 34(3); its covariance is derived here from the moments of a Gaussian angle's
    sine and cosine, in the vertical plane of the ray.
    """
    r, beta, eps, var_r, var_b, var_e = np.broadcast_arrays(
        *(np.asarray(v, np.float64) for v in (r, azimuth, elevation)),
        variance("sigma_r", sigma_r),
        variance("sigma_azimuth", sigma_azimuth),
        variance("sigma_elevation", sigma_elevation),
    )
    c, s = np.asarray(np.cos(eps)), np.asarray(np.sin(eps))
    rho, z = r * c, r * s
    if unbiased:
        cov = _unbiased_covariance(r, c, s, var_r, var_b, var_e)
        rho, z = rho * np.exp((var_b + var_e) / 2), z * np.exp(var_e / 2)
    else:
        along = var_r * c**2 + z**2 * var_e
        cov = (along, rho**2 * var_b, var_r * s**2 + rho**2 * var_e, c * s * (var_r - r**2 * var_e))
    along, across, vertical, mixed = cov
    cb, sb = np.cos(beta), np.sin(beta)
    xx, yy = along * cb**2 + across * sb**2, along * sb**2 + across * cb**2
    xy, xz, yz = (along - across) * sb * cb, mixed * cb, mixed * sb
    rows = [np.stack(row, axis=-1) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, vertical))]
    return np.stack([rho * cb, rho * sb, z], axis=-1), np.stack(rows, axis=-2)


def _unbiased_covariance(r: Array, c: Array, s: Array, var_r: Array, var_b: Array, var_e: Array) -> tuple[Array, ...]:
    """Variances along, across, up and covariance along-up of the unbiased estimate, in the ray's vertical plane.

    Var(along) = E[r^2] cosh(b) (c^2 cosh(e) + s^2 sinh(e)) - r^2 c^2 with b, e the angles' variances and
    E[r^2] = r^2 + var_r, and likewise the others; grouped so that nothing cancels.
    """
    cosh_b_1, cosh_e_1 = 2 * np.sinh(var_b / 2) ** 2, 2 * np.sinh(var_e / 2) ** 2  # cosh - 1
    sinh_b, sinh_e = np.sinh(var_b), np.sinh(var_e)
    level = c**2 * (1 + cosh_e_1) + s**2 * sinh_e
    steep = s**2 * (1 + cosh_e_1) + c**2 * sinh_e
    along = r**2 * (cosh_b_1 * level + c**2 * cosh_e_1 + s**2 * sinh_e) + var_r * (1 + cosh_b_1) * level
    across = (r**2 + var_r) * sinh_b * level
    vertical = r**2 * (s**2 * cosh_e_1 + c**2 * sinh_e) + var_r * steep
    mixed = c * s * (r**2 * np.expm1(-var_e) + var_r * np.exp(-var_e))
    return np.broadcast_arrays(along, across, vertical, mixed)


def variance(name: str, sigma: npt.ArrayLike) -> Float[np.ndarray, "*lead"]:
    """Square a standard deviation, refusing negative ones.

    Raises:
        DataError: a standard deviation is negative.
    """
    s = np.asarray(sigma, np.float64)
    if np.any(s < 0.0):
        raise DataError(f"{name} must not be negative: got {s.min()}. Give standard deviations, in m and rad.")
    return np.asarray(s**2)
