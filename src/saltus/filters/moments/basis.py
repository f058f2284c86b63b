"""Normalised Hermite polynomials of several variables: the coordinates in which densities and moments are kept.

psi_a(xi) = prod_i He_{a_i}(xi_i) / sqrt(a_i!) is orthonormal under the standard normal law, so that the moments
h_a = <psi_a> of a whitened variable are all of the size of one and vanish for a Gaussian when |a| >= 1.
"""

from collections.abc import Iterator
from functools import lru_cache
from itertools import product
from math import factorial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.shapes import Float, Int

__all__ = [
    "Basis",
    "Rule",
    "basis",
    "convolved",
    "gauss_hermite",
    "gauss_legendre",
    "gaussian_points",
    "normal_nodes",
]

_Array = npt.NDArray[np.float64]


class Rule(NamedTuple):
    """A quadrature rule for integrals over the plane measure: sum_i w_i f(x_i)."""

    nodes: Float[np.ndarray, "q n"]
    log_weights: Float[np.ndarray, " q"]


class Basis(NamedTuple):
    """The polynomials of n variables up to an order, by their multi-indices in graded order; the first is 1."""

    indices: Int[np.ndarray, "a n"]
    order: int

    @property
    def degree(self) -> Int[np.ndarray, " a"]:
        """|a| of each polynomial."""
        return np.asarray(self.indices.sum(axis=-1))

    def evaluate(self, xi: Float[np.ndarray, "*lead n"]) -> Float[np.ndarray, "*lead a"]:
        """Values of all polynomials at points."""
        return np.stack([np.broadcast_to(psi, xi.shape[:-1]) for psi in self._each(xi)], axis=-1)

    def series(
        self, coefficients: Float[np.ndarray, "*some a"], xi: Float[np.ndarray, "*some q n"]
    ) -> Float[np.ndarray, "*some q"]:
        """sum_a c_a psi_a at points, one polynomial after the other: the points are many."""
        total = np.zeros(xi.shape[:-1])
        for a, psi in enumerate(self._each(xi)):
            total += coefficients[..., a, None] * psi
        return total

    def moments(self, xi: Float[np.ndarray, "b q n"], weights: Float[np.ndarray, "b q"]) -> Float[np.ndarray, "b a"]:
        """sum_q w_q psi_a(xi_q)."""
        ones = np.ones(xi.shape[:-1])
        return np.stack([np.einsum("bq,bq->b", ones * psi, weights) for psi in self._each(xi)], axis=-1)

    def _each(self, xi: _Array) -> Iterator[_Array | float]:
        """Values of one polynomial after the other; 1.0 for the constant."""
        axes: list[list[_Array | float]] = []
        for axis in range(xi.shape[-1]):
            x = np.ascontiguousarray(xi[..., axis])
            line: list[_Array | float] = [1.0, x]
            for k in range(1, self.order):
                line.append((x * line[k] - np.sqrt(k) * line[k - 1]) / np.sqrt(k + 1))
            axes.append(line)
        for a in self.indices.tolist():
            value: _Array | float = 1.0
            for line, k in zip(axes, a, strict=True):
                if k:
                    value = line[k] if isinstance(value, float) else value * line[k]
            yield value

    def derivative(self, axis: int) -> Float[np.ndarray, "a a"]:
        """D psi_a / d xi_axis = sum_b D_ab psi_b, with D = sqrt(a_axis) at b = a - e_axis."""
        D = np.zeros((len(self.indices), len(self.indices)))
        place = {tuple(a): i for i, a in enumerate(self.indices.tolist())}
        for i, a in enumerate(self.indices.tolist()):
            if a[axis] > 0:
                lower = [k - (j == axis) for j, k in enumerate(a)]
                D[i, place[tuple(lower)]] = np.sqrt(a[axis])
        return D

    def multiplication(self, axis: int) -> Float[np.ndarray, "a a"]:
        """xi_axis psi_a = sum_b X_ab psi_b, with what exceeds the order left out."""
        X = np.zeros((len(self.indices), len(self.indices)))
        place = {tuple(a): i for i, a in enumerate(self.indices.tolist())}
        for i, a in enumerate(self.indices.tolist()):
            for step, size in ((1, a[axis] + 1), (-1, a[axis])):
                b = place.get(tuple(k + step * (j == axis) for j, k in enumerate(a)))
                if b is not None:
                    X[i, b] = np.sqrt(size)
        return X

    def products(self, order: int) -> Float[np.ndarray, "s s a"]:
        """C[i, j, k] = <psi_i psi_j psi_k> under the normal law, for |i|, |j| <= order; |k| <= 2 order is complete."""
        nodes, weight = normal_nodes(self.indices.shape[-1], order + self.order // 2 + 1)
        values = self.evaluate(nodes)
        small = values[:, self.degree <= order]
        return np.asarray(np.einsum("q,qi,qj,qk->ijk", weight, small, small, values, optimize=True))


@lru_cache(maxsize=32)
def basis(n: int, order: int) -> Basis:
    """The basis of n variables up to an order."""
    found = sorted((a for a in product(range(order + 1), repeat=n) if sum(a) <= order), key=lambda a: (sum(a), a[::-1]))
    return Basis(np.array(found), order)


@lru_cache(maxsize=32)
def gauss_hermite(n: int, count: int) -> Rule:
    """Tensor Gauss-Hermite rule with `count` nodes per axis, as a rule for the plane measure."""
    x, w = np.polynomial.hermite_e.hermegauss(count)
    return _tensor(n, x, np.log(w) + 0.5 * x * x)


@lru_cache(maxsize=32)
def normal_nodes(n: int, count: int) -> tuple[Float[np.ndarray, "q n"], Float[np.ndarray, " q"]]:
    """Nodes and probabilities of the standard normal law, exact for polynomials of degree 2 count - 1."""
    rule = gauss_hermite(n, count)
    weights = np.exp(rule.log_weights - 0.5 * np.square(rule.nodes).sum(-1))
    return rule.nodes, np.asarray(weights / weights.sum())


def gaussian_points(
    mean: Float[np.ndarray, " n"], cov: Float[np.ndarray, "n n"], count: int
) -> tuple[Float[np.ndarray, "q n"], Float[np.ndarray, " q"]]:
    """Points and probabilities of a Gaussian, which may be singular."""
    nodes, weights = normal_nodes(len(mean), count)
    values, vectors = np.linalg.eigh(cov)
    return mean + nodes @ (vectors * np.sqrt(np.maximum(values, 0.0))).T, weights


@lru_cache(maxsize=32)
def gauss_legendre(n: int, count: int, reach: float) -> Rule:
    """Tensor Gauss-Legendre rule on the box |x_i| <= reach."""
    x, w = np.polynomial.legendre.leggauss(count)
    return _tensor(n, reach * x, np.log(reach * w))


def _tensor(n: int, x: _Array, log_w: _Array) -> Rule:
    nodes = np.stack(np.meshgrid(*(x,) * n, indexing="ij"), axis=-1).reshape(-1, n)
    weights = np.stack(np.meshgrid(*(log_w,) * n, indexing="ij"), axis=-1).reshape(-1, n).sum(-1)
    return Rule(nodes, weights)


def convolved(
    of: Basis, h: Float[np.ndarray, "*lead a"], A: Float[np.ndarray, "*lead n n"]
) -> Float[np.ndarray, "*lead a"]:
    """Hermite moments of A xi + e, e normal with covariance I - A A': tensors of each order, turned by A.

    E exp(t'x - t't/2) generates the Hermite moments, and that of A xi + e at t is that of xi at A't.
    """
    n = A.shape[-1]
    if n == 1:
        return np.asarray(h * A[..., 0, :] ** np.arange(of.order + 1))
    out = np.empty(h.shape)
    out[..., 0] = h[..., 0]
    for k in range(1, of.order + 1):
        flat, own, scale = _tensor_index(n, k)
        start = int(np.searchsorted(of.degree, k))
        size = len(own)
        part = h[..., start : start + size] * scale
        tensor = part[..., flat].reshape(*h.shape[:-1], *(n,) * k)
        for axis in range(k):
            moved = np.moveaxis(tensor, h.ndim - 1 + axis, -1)[..., None]
            A_k = A.reshape(*A.shape[:-2], *(1,) * (k - 1), n, n)
            tensor = np.moveaxis((A_k @ moved)[..., 0], -1, h.ndim - 1 + axis)
        out[..., start : start + size] = tensor.reshape(*h.shape[:-1], -1)[..., own] / scale
    return out


@lru_cache(maxsize=32)
def _tensor_index(n: int, k: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], _Array]:
    """Which multi-index each entry of a symmetric tensor has, one entry of each multi-index, and sqrt(a!)."""
    index = [tuple(a) for a in basis(n, k).indices.tolist() if sum(a) == k]
    place = {a: i for i, a in enumerate(index)}
    entries = list(product(range(n), repeat=k))
    flat = np.array([place[tuple(e.count(i) for i in range(n))] for e in entries])
    own = np.array([int(np.flatnonzero(flat == i)[0]) for i in range(len(index))])
    scale = np.sqrt([np.prod([factorial(j) for j in a]) for a in index])
    return flat, own, scale
