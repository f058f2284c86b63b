"""Sensor errors that have a memory: Markov processes in continuous time, as a sensor's noise.

`first_order` and `second_order` describe noise by correlation time and standard deviation; `MarkovNoise` takes any
linear system. What depends on chains is given as everywhere (see `saltus.models.dependence`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.models.chain import Chain
from saltus.models.checks import FloatArray, axes, covariance, numbers, same
from saltus.models.dependence import Matrix, fixed, is_fixed, resolve
from saltus.shapes import Float

__all__ = ["GaussMarkov", "MarkovNoise", "first_order", "second_order", "stationary_covariance"]


@dataclass(frozen=True, slots=True, eq=False)
class MarkovNoise:
    """Noise with a memory, and perhaps a white part.

    du = F u dt + G dW,   noise = L u + v,   cov v = white

    u is continuous when a chain jumps: only its dynamics change.

    Args:
        F: (p, p), 1/s; may depend on chains, as G, cov0 and white may.
        G: (p, q), measurement unit / sqrt(s).
        L: what of u is seen, (m, p), the same in every mode; absent means all of it.
        cov0: covariance of u at the first sample, (p, p); absent means the stationary one, mode by mode.
        white: covariance of the white part, (m, m); absent means none.

    Raises:
        ModelError: shapes do not fit, or there is no stationary covariance and none is given.

    Source: Detkov (2023), equation 3, with output and white part added.
    """

    F: Matrix
    G: Matrix
    L: npt.ArrayLike | None = None
    cov0: Matrix | None = None
    white: Matrix | None = None

    def __post_init__(self) -> None:
        put = object.__setattr__
        for name in ("F", "G", "L"):
            value = getattr(self, name)
            if is_fixed(value):
                put(self, name, numbers(value, f"MarkovNoise {name}"))
        for name in ("cov0", "white"):
            value = getattr(self, name)
            if is_fixed(value):
                put(self, name, covariance(value, f"MarkovNoise {name}"))
        if self.L is not None and np.ndim(self.L) != 2:
            raise ModelError(f"MarkovNoise L must be a matrix (m, p), got shape {np.shape(self.L)}.")

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    @property
    def output(self) -> Float[np.ndarray, "m p"]:
        """L of bound noise."""
        p = int(fixed(self.F, "MarkovNoise F").shape[-1])
        return np.eye(p) if self.L is None else np.asarray(self.L)

    def total(self) -> Float[np.ndarray, "*lead m m"]:
        """Covariance L cov0 L' + white of bound noise at the first sample: of white noise of the same strength."""
        L = self.output
        R = L @ fixed(self.cov0, "MarkovNoise cov0") @ L.T
        return np.asarray(R if self.white is None else R + fixed(self.white, "MarkovNoise white"))

    def bind(self, chains: Sequence[Chain]) -> "MarkovNoise":
        """Replace functions and tables by arrays with one mode axis per chain, and fill in the stationary law."""
        F = fixed(resolve(self.F, chains, "MarkovNoise F", 2), "MarkovNoise F")
        G = fixed(resolve(self.G, chains, "MarkovNoise G", 2), "MarkovNoise G")
        p = F.shape[-1]
        m, seen = (p, p) if self.L is None else np.asarray(self.L).shape
        if F.shape[-2] != p or G.shape[-2] != p or seen != p:
            raise ModelError(f"MarkovNoise F {F.shape[-2:]}, G {G.shape[-2:]} and L {(m, seen)} do not fit.")
        if self.cov0 is None:
            cov0 = stationary_covariance(F, G)
        else:
            cov0 = covariance(resolve(self.cov0, chains, "MarkovNoise cov0", (p, p)), "MarkovNoise cov0")
        white = None if self.white is None else resolve(self.white, chains, "MarkovNoise white", (m, m))
        return replace(self, F=F, G=G, cov0=cov0, white=white)


@dataclass(frozen=True, slots=True, eq=False)
class GaussMarkov:
    """First- or second-order noise on each of `dims` components; made by `first_order` and `second_order`."""

    order: int
    tau: Matrix
    sigma: Matrix
    dims: int
    damping: float = 1.0
    white: Matrix | None = None

    def __post_init__(self) -> None:
        axes("components", self.dims)
        if not self.damping > 0:
            raise ModelError(f"damping must be positive, got {self.damping!r}.")
        for name in ("tau", "sigma"):
            if is_fixed(getattr(self, name)):
                object.__setattr__(self, name, _positive(name, numbers(getattr(self, name), name)))

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    def bind(self, chains: Sequence[Chain]) -> MarkovNoise:
        """The linear system this is, with one mode axis per chain."""
        tau, sigma = (
            _positive(name, fixed(resolve(value, chains, name, (self.dims,)), name))
            for name, value in (("tau", self.tau), ("sigma", self.sigma))
        )
        white = self.white
        if white is not None and is_fixed(white):
            given = fixed(white, "white")
            white = given if given.ndim > 1 else given * np.eye(self.dims)
        if self.order == 1:
            F, G = _diagonal(-1.0 / tau), _diagonal(sigma * np.sqrt(2.0 / tau))
            return MarkovNoise(F, G, white=white).bind(chains)
        one = np.ones_like(tau)
        F = _interleave(np.array([[0.0, 1.0], [0.0, 0.0]]), one)
        F = F + _interleave(np.array([[0.0, 0.0], [-1.0, 0.0]]), tau**-2.0)
        F = F + _interleave(np.array([[0.0, 0.0], [0.0, -2.0 * self.damping]]), 1.0 / tau)
        G = _interleave(np.array([[0.0, 0.0], [0.0, 2.0 * np.sqrt(self.damping)]]), sigma * tau**-1.5)
        return MarkovNoise(F, G[..., 1::2], L=np.eye(2 * self.dims)[::2], white=white).bind(chains)


def first_order(tau: Matrix, sigma: Matrix, dims: int = 1, white: Matrix | None = None) -> GaussMarkov:
    """First-order Gauss-Markov noise: E w(t) w(t+s) = sigma^2 exp(-|s|/tau).

    dw = -w/tau dt + sigma sqrt(2/tau) dW

    Args:
        tau: correlation time, s, for all components or each (dims,); may depend on chains.
        sigma: standard deviation in the measurement's unit, likewise.
        dims: number of components, independent of each other.
        white: covariance of a white part, (dims, dims), or a variance for all; absent means none.

    Raises:
        ModelError: tau or sigma is not positive.
    """
    return GaussMarkov(1, tau, sigma, dims, white=white)


def second_order(
    tau: Matrix, sigma: Matrix, dims: int = 1, damping: float = 1.0, white: Matrix | None = None
) -> GaussMarkov:
    """Second-order Gauss-Markov noise, a damped oscillator driven by white noise; differentiable once.

    d2w + 2 damping/tau dw + w/tau^2 = white;  critically damped: E w(t) w(t+s) = sigma^2 (1 + |s|/tau) exp(-|s|/tau)

    Args:
        tau: 1 / natural frequency, s, for all components or each (dims,); may depend on chains.
        sigma: standard deviation in the measurement's unit, likewise.
        dims: number of components, independent of each other.
        damping: below 1 the noise swings, with period 2 pi tau / sqrt(1 - damping^2).
        white: covariance of a white part, (dims, dims), or a variance for all; absent means none.

    Raises:
        ModelError: tau, sigma or damping is not positive.
    """
    return GaussMarkov(2, tau, sigma, dims, damping, white)


def stationary_covariance(F: npt.ArrayLike, G: npt.ArrayLike) -> Float[np.ndarray, "*lead p p"]:
    """Solve F P + P F' + G G' = 0.

    Args:
        F: (..., p, p), every eigenvalue left of the imaginary axis.
        G: (..., p, q).

    Raises:
        ModelError: F is not stable, so that there is no stationary law.
    """
    f, g = numbers(F, "F"), numbers(G, "G")
    if np.linalg.eigvals(f).real.max() >= 0:
        raise ModelError(
            "the noise has no stationary law: F has an eigenvalue that does not decay. "
            "Give its covariance at the first sample, cov0=."
        )
    p = f.shape[-1]
    eye = np.eye(p)
    lyapunov = (f[..., :, None, :, None] * eye[:, None, :] + eye[:, None, :, None] * f[..., None, :, None, :]).reshape(
        *f.shape[:-2], p * p, p * p
    )
    S = g @ g.swapaxes(-1, -2)
    lead = np.broadcast_shapes(f.shape[:-2], S.shape[:-2])
    right = np.broadcast_to(S, (*lead, p, p)).reshape(*lead, p * p, 1)
    P = -np.linalg.solve(lyapunov, right).reshape(*lead, p, p)
    return np.asarray(0.5 * (P + P.swapaxes(-1, -2)))


def _positive(name: str, a: FloatArray) -> FloatArray:
    if a.size and a.min() <= 0:
        raise ModelError(f"{name} of coloured noise must be positive, got {a.min():g}.")
    return a


def _diagonal(a: FloatArray) -> FloatArray:
    """(..., d) -> diagonal matrices (..., d, d)."""
    return np.asarray(a[..., None] * np.eye(a.shape[-1]))


def _interleave(block: FloatArray, scale: FloatArray) -> FloatArray:
    """One 2 x 2 block per component, scaled: (..., d) -> (..., 2d, 2d)."""
    d = scale.shape[-1]
    out = np.einsum("...i,ij,ab->...iajb", scale, np.eye(d), block)
    return np.asarray(out.reshape(*scale.shape[:-1], 2 * d, 2 * d))
