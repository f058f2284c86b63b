"""The moment equations themselves."""

import numpy as np
import numpy.typing as npt

from saltus.filters.moments.basis import Basis, gaussian_points
from saltus.filters.moments.belief import Points
from saltus.models import SwitchingSDE
from saltus.shapes import Float

__all__ = ["moment_rates"]

_Array = npt.NDArray[np.float64]


def moment_rates(
    model: SwitchingSDE, of: Basis, points: Points, origin: Float[np.ndarray, " n"], scale: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "b s a"]:
    """Right side of (D) for the polynomials of (y - origin) / scale, averages taken over weighted points.

    d/dt u_a = P <L y^a> - P <nu y^a> + sum_r P_r <nu_r Q y^a>_r

    Source: moment-filter notes, section 2, equation (D).
    """
    slopes = [of.derivative(i) for i in range(len(origin))]
    rates = np.zeros((*points.log_probs.shape, len(of.indices)))
    for mode, (y, w) in enumerate(points.clouds()):
        psi = of.evaluate((y - origin) / scale)
        a, B = model.drift_at(mode, y) / scale, model.covariance_at(mode, y) / (scale[:, None] * scale)
        change = np.zeros_like(psi)
        for i, slope in enumerate(slopes):
            change += a[..., i, None] * (psi @ slope.T)
            for j, other in enumerate(slopes):
                change += 0.5 * B[..., i, j, None] * (psi @ (slope @ other).T)
        rates[:, mode] += np.einsum("bq,bqa->ba", w, change)
        for switch in model.switches:
            if switch[0] == mode:
                leaving = w * model.rate(switch, y)
                gone = np.einsum("bq,bqa->ba", leaving, psi)
                rates[:, mode] -= gone
                law = model.restored(switch)
                rates[:, switch[1]] += gone if law is None else gone[:, :1] * _law_moments(of, law, origin, scale)
    return rates


def _law_moments(of: Basis, law: tuple[_Array, _Array], origin: _Array, scale: _Array) -> _Array:
    y, weight = gaussian_points(*law, of.order // 2 + 1)
    return np.asarray(weight @ of.evaluate((y - origin) / scale))
