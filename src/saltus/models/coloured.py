"""A sensor with coloured noise."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from saltus.errors import ModelError
from saltus.models.chain import Chain
from saltus.models.checks import FloatArray, probability, same
from saltus.models.dependence import Matrix, TimeDependent, fixed, is_fixed
from saltus.models.noise import GaussMarkov, MarkovNoise
from saltus.models.observer import Observer
from saltus.models.sensors import LinearSensor
from saltus.shapes import Float

__all__ = ["ColouredSensor"]


@dataclass(frozen=True, slots=True, eq=False)
class ColouredSensor:
    """A linear measurement whose noise has a memory.

    z = H x + d + L u + v,   du = F u dt + G dW,   cov v = white

    H and d may depend on chains, and so may the noise.

    Args:
        H: (m, n).
        noise_model: first_order(...), second_order(...) or MarkovNoise(...), of m components.
        d: offset, (m,); absent means 0.
        prob_detection: probability that an object present is reported.

    Raises:
        ModelError: shapes do not fit.
    """

    H: Matrix
    noise_model: MarkovNoise | GaussMarkov
    d: Matrix | None = None
    prob_detection: float = 1.0

    def __post_init__(self) -> None:
        probability(self.prob_detection, "prob_detection")

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    @property
    def R(self) -> Float[np.ndarray, "*lead m m"]:
        """Covariance of white noise of the same strength."""
        return self.noise_model.bind([]).total()

    def h(self, x: ArrayLike) -> Float[np.ndarray, "*lead m"]:
        """Expected measurement H x + d of states (..., n)."""
        return self._noiseless().h(x)

    def jacobian(self, x: ArrayLike) -> Float[np.ndarray, "*lead m n"]:
        """H, for every state (..., n)."""
        return self._noiseless().jacobian(x)

    def residual(self, z: ArrayLike, z_pred: ArrayLike) -> Float[np.ndarray, "*lead m"]:
        """Plain difference."""
        return np.asarray(z, dtype=np.float64) - np.asarray(z_pred, dtype=np.float64)

    def bind(self, chains: Sequence[Chain], n_state: int) -> "ColouredSensor":
        """Replace functions and tables by arrays with one mode axis per chain."""
        noise = self.noise_model.bind(chains)
        m = noise.output.shape[0]
        if is_fixed(self.H) and np.shape(fixed(self.H, "ColouredSensor H"))[-2:-1] != (m,):
            shape = np.shape(fixed(self.H, "ColouredSensor H"))
            raise ModelError(f"ColouredSensor H {shape} does not fit the {m} component(s) of its noise.")
        plain = LinearSensor(self.H, np.zeros((m, m)), self.d).bind(chains, n_state)
        if any(isinstance(value, TimeDependent) for value in (plain.H, plain.d)):
            raise ModelError("ColouredSensor H and d must not depend on t.")
        if fixed(plain.H, "ColouredSensor H").shape[-2] != m:
            raise ModelError(f"ColouredSensor H has other than {m} row(s), the number of components of its noise.")
        return replace(self, H=plain.H, noise_model=noise, d=plain.d)

    def at(self, t: float, observer: Observer | None = None) -> "ColouredSensor":
        """The sensor itself: nothing depends on time, and it has no observer."""
        if observer is not None:
            raise ModelError("a linear sensor has no observer: leave it out, or put its place into the offset d.")
        return self

    def noise(self) -> FloatArray:
        """Covariance of white noise of the same strength, (M1|1, ..., MC|1, m, m)."""
        return self.bound_noise().total()

    def bound_noise(self) -> MarkovNoise:
        """The noise of a bound sensor."""
        if not isinstance(self.noise_model, MarkovNoise):
            raise ModelError("this sensor is not bound: put it into a HybridModel.")
        return self.noise_model

    def _noiseless(self) -> LinearSensor:
        m = fixed(self.H, "ColouredSensor H").shape[-2]
        return LinearSensor(self.H, np.zeros((m, m)), self.d)
