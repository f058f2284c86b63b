"""What is measured of a switching diffusion: at instants, or all the time as increments."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError
from saltus.linalg import gaussian_terms
from saltus.models.checks import FloatArray, covariance, numbers, same
from saltus.models.diffusion import Field, field_value
from saltus.models.nonlinear import wrapped_difference
from saltus.shapes import Float

__all__ = ["DiffusionSensor"]

_LOG_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True, slots=True, eq=False)
class DiffusionSensor:
    """Measurements of a switching diffusion, of different kind in different modes.

    z_k = h_l(Y(t_k)) + v,  cov v = R_l(Y);   or, if continuous,  dZ = h_l(Y) dt + R^(1/2) dV

    Continuous observation enters a filter as the increments of Z over its intervals. Its R is an intensity and must be
    one constant for all modes: another would show at once in the roughness of Z.

    Args:
        h: one per mode: function (..., n) -> (..., m), or constant (m,).
        R: noise covariance, one per mode: function (..., n) -> (..., m, m), constant (m, m), or a number where m = 1.
        angular: components in rad whose differences are wrapped to [-pi, pi); absent means none.
        continuous: z holds increments over the intervals between the times.

    Raises:
        ModelError: shapes do not fit, R is no positive covariance, or a continuous sensor whose R differs.

    Source: moment-filter notes, section 5.
    """

    h: Sequence[Field]
    R: Sequence[Field]
    angular: Sequence[int] | None = None
    continuous: bool = False

    def __post_init__(self) -> None:
        put = object.__setattr__
        for what, given in (("h", self.h), ("R", self.R), ("angular", self.angular)):
            if given is not None and (callable(given) or np.ndim(np.asarray(given, dtype=object)) == 0):
                entries = "component" if what == "angular" else "mode"
                raise ModelError(f"{what} must be a list with one entry per {entries}, got {given!r}. Write [{what}].")
        if len(self.h) != len(self.R) or not len(self.h):
            raise ModelError(f"a sensor needs one h and one R per mode: got {len(self.h)} and {len(self.R)}.")
        h = [f if callable(f) else np.atleast_1d(numbers(f, f"h[{i}]")) for i, f in enumerate(self.h)]
        R = [f if callable(f) else _noise(f, f"R[{i}]") for i, f in enumerate(self.R)]
        put(self, "h", tuple(h))
        put(self, "R", tuple(R))
        put(self, "angular", tuple(self.angular or ()))
        constant = [r for r in R if not callable(r)]
        if self.continuous and (len(constant) < len(R) or any(not np.array_equal(r, constant[0]) for r in constant)):
            raise ModelError(
                "a continuous sensor has one constant R for all modes: the quadratic variation of its output would "
                "reveal R, and with it the mode, at once.\nUse measurements at instants (continuous=False)."
            )
        if self.continuous and self.angular:
            raise ModelError("increments of an angle are not wrapped: a continuous sensor has no angular components.")

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    @property
    def n_modes(self) -> int:
        """Number of modes."""
        return len(self.h)

    def check(self, means: Float[np.ndarray, "s n"]) -> int:
        """Try the sensor at one state of each mode and return the number of components m.

        Raises:
            ModelError: another number of modes, or shapes that do not fit.
        """
        if len(means) != self.n_modes:
            raise ModelError(f"the model has {len(means)} modes, but the sensor describes {self.n_modes}.")
        sizes: set[int] = set()
        for mode, mean in enumerate(means):
            x = np.broadcast_to(mean, (2, 1, len(mean)))
            m = self.h_at(mode, x).shape[-1]
            R = self.noise_at(mode, x, m)
            if np.linalg.eigvalsh(R).min() <= 0:
                raise ModelError(f"R[{mode}] is not positive definite at state {mean}: every component needs noise.")
            sizes.add(m)
        if len(sizes) > 1:
            raise ModelError(f"h gives {sorted(sizes)} components in different modes; let them agree.")
        m = sizes.pop()
        if any(not 0 <= i < m for i in self.angular or ()):
            raise ModelError(f"angular components {self.angular} are not among the {m} that h gives.")
        return m

    def h_at(self, mode: int, x: Float[np.ndarray, "*lead n"]) -> Float[np.ndarray, "*lead m"]:
        """Expected measurement of states (..., n) in a mode."""
        return field_value(self.h[mode], x, (None,), f"h[{mode}]")

    def noise_at(
        self, mode: int, x: Float[np.ndarray, "*lead n"], m: int | None = None
    ) -> Float[np.ndarray, "*lead m m"]:
        """Noise covariance R at states (..., n) in a mode."""
        return field_value(self.R[mode], x, (m, m), f"R[{mode}]")

    def residual(self, z: npt.ArrayLike, z_pred: npt.ArrayLike) -> Float[np.ndarray, "*lead m"]:
        """Difference of measurements, angles in [-pi, pi)."""
        return wrapped_difference(z, z_pred, self.angular or ())

    def log_likelihood(
        self, mode: int, z: Float[np.ndarray, "*_z m"], x: Float[np.ndarray, "*_x n"], dt: float = 0.0
    ) -> Float[np.ndarray, "*both"]:
        """Log g of measurements (..., m) at states (..., n) in a mode; their leading axes broadcast.

        At instants: log N(z; h(x), R) of the components that are not NaN, 0 where all are. Continuous: z is the
        increment over `dt` (s) and log g = h' R^-1 z - h' R^-1 h dt / 2, the density relative to noise alone.

        Raises:
            DataError: an increment with missing components and a correlated R.
        """
        seen = ~np.isnan(z)
        expected = self.h_at(mode, x)
        if self.continuous:
            return self._increment(np.where(seen, z, 0.0), seen, expected, dt)
        nu = np.where(seen, self.residual(np.where(seen, z, 0.0), expected), 0.0)
        field = self.R[mode]
        R = self.noise_at(mode, x) if callable(field) else np.asarray(field)
        if not seen.all():
            both = seen[..., :, None] & seen[..., None, :]
            R = R * both + np.eye(nu.shape[-1]) * ~seen[..., :, None]
        if R.ndim == 2:
            L_inv = np.linalg.inv(np.linalg.cholesky(R))
            with np.errstate(over="ignore"):  # a distance may be infinite
                d2 = np.square(nu @ L_inv.T).sum(-1)
            logdet = -2.0 * np.log(np.diagonal(L_inv)).sum()
        else:
            d2, logdet, _ = gaussian_terms(nu, np.broadcast_to(R, (*nu.shape, nu.shape[-1])))
        return np.asarray(-0.5 * (d2 + logdet + seen.sum(-1) * _LOG_2PI))

    def _increment(self, z: FloatArray, seen: np.ndarray, expected: FloatArray, dt: float) -> FloatArray:
        R = np.asarray(self.R[0])
        if not seen.all() and np.count_nonzero(R - np.diag(np.diag(R))):
            raise DataError("increments with missing components need a diagonal R; give whole rows as NaN or split z.")
        weighted = np.where(seen, expected, 0.0) @ np.linalg.inv(R)
        return np.asarray((weighted * (z - 0.5 * dt * expected)).sum(-1))


def _noise(value: object, what: str) -> FloatArray:
    R = covariance([[value]] if isinstance(value, int | float) else value, what)
    if R.ndim != 2 or np.linalg.eigvalsh(R).min() <= 0:
        raise ModelError(f"{what} must be a positive definite covariance (m, m), got {value}.")
    return R
