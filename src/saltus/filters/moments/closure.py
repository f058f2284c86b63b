"""Closures: a density for moments, as something to evaluate and as weighted nodes."""

from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.filters.moments.basis import Basis, Rule, basis, gauss_hermite, gauss_legendre
from saltus.filters.moments.belief import Moments, Points
from saltus.filters.moments.maxent import Fit, fit, gaussian_parameter, tables
from saltus.filters.moments.realisable import margin, shrunk
from saltus.shapes import Float

__all__ = ["Closing", "ClosureName", "Density", "Tally", "reach"]

_Array = npt.NDArray[np.float64]
ClosureName = Literal["maxent", "hermite", "gaussian"]

# Half width of the box by order, in standard deviations. Laws that switching makes have heavy tails: sixth moments feel
# what lies beyond 5.5, and a box that cannot hold it bends the density inside.
_REACH = {2: 5.5, 4: 5.5, 6: 6.5}
NEAR = 4.2  # the same about a posterior, whose nodes are spread by 1.3
_HOPELESS = -1e3  # moment matrix so far from positive that even the raw closure begins anew
_HALF_LOG_2PI = 0.5 * float(np.log(2 * np.pi))


def reach(order: int) -> float:
    """Half width of the box of maximum-entropy densities of an order, in standard deviations."""
    return _REACH[order]


class Density(NamedTuple):
    """Densities of the whitened variable xi = root^-1 (y - mean), one per run and mode."""

    name: ClosureName
    law: Moments
    coefficients: Float[np.ndarray, "b s a"]  # lambda of all polynomials, or h
    basis: Basis

    def log_value(self, xi: Float[np.ndarray, "b s q n"]) -> tuple[_Array, _Array]:
        """Log of the modulus and sign of the densities at points."""
        if self.name == "maxent":
            # Off the box, where the polynomial may rise, go on as a Gaussian does: an edge would spoil quadratures.
            near = np.clip(xi, -reach(self.basis.order), reach(self.basis.order))
            series = self.basis.series(self.coefficients, near)
            return series - 0.5 * (np.square(xi) - np.square(near)).sum(-1), np.ones_like(series)
        series = self.basis.series(self.coefficients, xi)
        n = xi.shape[-1]
        normal = -0.5 * np.square(xi).sum(-1) - n * _HALF_LOG_2PI
        return normal + np.log(np.maximum(np.abs(series), 1e-300)), np.sign(series)

    def log_pdf(self, y: Float[np.ndarray, "b s q n"]) -> _Array:
        """Log density of states given the mode; -inf where a Hermite series is not positive."""
        xi = (y - self.law.mean[:, :, None]) @ np.linalg.inv(self.law.root).swapaxes(-1, -2)
        value, sign = self.log_value(xi)
        scale = np.log(np.diagonal(self.law.root, axis1=-2, axis2=-1)).sum(-1)[..., None]
        return np.asarray(np.where(sign > 0, value, -np.inf) - scale)


class Tally(NamedTuple):
    """Repairs of one interval per run."""

    restarted: npt.NDArray[np.int64]  # Newton began anew from the Gaussian
    shrunk: npt.NDArray[np.int64]  # moments drawn towards the Gaussian
    dropped: npt.NDArray[np.int64]  # moments above order 4, or above 2, given up
    unrealisable: npt.NDArray[np.int64]  # moments of no density that were used as they are (raw Hermite)


class Closing:
    """Finds densities for moments; remembers the last ones to start from, and what it had to mend."""

    def __init__(self, name: ClosureName, n: int, order: int, count: int, protected: bool, n_runs: int) -> None:
        """Make a closure for states of dimension n.

        Args:
            name: which.
            n: dimension of the state.
            order: of the moments kept.
            count: nodes per axis.
            protected: Hermite moments are made realisable and the density's negative part left out.
            n_runs: number of runs.
        """
        self.name: ClosureName = name
        self.basis = basis(n, order)
        self.protected = protected
        self.rule: Rule = gauss_legendre(n, count, reach(order)) if name == "maxent" else gauss_hermite(n, count)
        # Where a posterior is looked at its spread is known: fewer deviations need be covered.
        self.near: Rule = gauss_legendre(n, count, NEAR) if name == "maxent" else self.rule
        self._tables = tables(n, order, count, reach(order)) if name == "maxent" else None
        self._last: _Array | None = None
        self._n_runs = n_runs
        self.tally = self._none()

    def taken(self) -> Tally:
        """The repairs since the last call."""
        tally, self.tally = self.tally, self._none()
        return tally

    def density(self, law: Moments) -> Density:
        """Density with the given moments."""
        return self.closed(law)[0]

    def points(self, law: Moments) -> Points:
        """The density as weighted nodes."""
        weights = self.closed(law)[1]
        return Points(law.log_probs, self.places(law.mean, law.root), weights)

    def places(
        self, mean: Float[np.ndarray, "b s n"], root: Float[np.ndarray, "b s n n"], rule: Rule | None = None
    ) -> _Array:
        """Nodes of a rule, by default the closure's, about means: mean + root xi, (b, s, q, n)."""
        nodes = (self.rule if rule is None else rule).nodes
        return np.asarray(mean[:, :, None] + nodes @ root.swapaxes(-1, -2))

    def _none(self) -> Tally:
        return Tally(*(np.zeros(self._n_runs, dtype=np.int64) for _ in Tally._fields))

    def _count(self, what: str, rows: npt.NDArray[np.bool_], n_modes: int) -> None:
        getattr(self.tally, what)[:] += rows.reshape(-1, n_modes).sum(axis=1)

    def closed(self, law: Moments) -> tuple[Density, _Array]:
        """Density with the given moments, and its probabilities on the nodes."""
        if self._tables is not None:
            return self._maxent(law)
        h: _Array = law.h.reshape(-1, law.h.shape[-1])
        n_modes = law.h.shape[1]
        if self.name == "gaussian":
            h = np.where(self.basis.degree == 0, h, 0.0)
        elif self.protected:
            h, changed = shrunk(self.basis, h)
            self._count("shrunk", changed, n_modes)
        else:
            least = margin(self.basis, h)
            self._count("unrealisable", ~(least > 0), n_modes)
            h = np.where((least > _HOPELESS)[:, None], h, np.where(self.basis.degree == 0, 1.0, 0.0))
        h = h.reshape(law.h.shape)
        density = Density(self.name, law, h, self.basis)
        series = h @ self.basis.evaluate(self.rule.nodes).T
        normal = self.rule.log_weights - 0.5 * np.square(self.rule.nodes).sum(-1)
        weights = np.exp(normal - self.rule.nodes.shape[-1] * _HALF_LOG_2PI) * series
        if self.protected:
            weights = np.maximum(weights, 0.0)
        return density, weights / weights.sum(axis=-1, keepdims=True)

    def _maxent(self, law: Moments) -> tuple[Density, _Array]:
        by = self._tables
        if by is None:
            raise AssertionError("only the maximum-entropy closure has tables")
        h = law.h.reshape(-1, law.h.shape[-1])
        n_modes, normal = law.h.shape[1], gaussian_parameter(self.basis)
        plain = np.broadcast_to(normal, (len(h), len(normal)))
        found = fit(by, h[:, 1:], plain if self._last is None else self._last)
        if found.failed.any():
            found = self._mended(found, h, n_modes)
        parameter, log_norm, probs = found.parameter, found.log_norm, found.probs
        self._last = parameter
        full = np.concatenate([-log_norm[:, None], parameter], axis=-1).reshape(law.h.shape)
        return Density(self.name, law, full, self.basis), probs.reshape(*law.h.shape[:2], -1)

    def _mended(self, found: Fit, h: _Array, n_modes: int) -> Fit:
        """Fits that failed: begun anew, with moments made realisable, with fewer moments; last the Gaussian."""
        n, order = self.basis.indices.shape[-1], self.basis.order
        for attempt, kept in (("restarted", order), ("shrunk", order), ("dropped", 4), ("dropped", 2)):
            bad = found.failed
            if not bad.any():
                break
            if kept > order or (attempt == "dropped" and kept == order):
                continue
            rows, changed = shrunk(self.basis, h[bad]) if attempt != "restarted" else (h[bad], np.ones(bad.sum(), bool))
            if attempt == "shrunk" and not changed.any():
                continue
            marked = bad.copy()
            marked[bad] = changed if attempt == "shrunk" else True
            self._count(attempt, marked, n_modes)
            by = tables(n, kept, len(np.unique(self.rule.nodes[:, 0])), reach(order))
            size = by.values.shape[0]
            if kept == 2:
                rows = np.where(self.basis.degree == 0, 1.0, 0.0) * np.ones_like(rows)
            start = np.broadcast_to(gaussian_parameter(by.basis), (len(rows), size))
            again = fit(by, rows[:, 1 : size + 1], start)
            parameter, failed = found.parameter.copy(), bad.copy()
            parameter[bad] = 0.0
            parameter[np.flatnonzero(bad)[:, None], np.arange(size)] = again.parameter
            log_norm, probs = found.log_norm.copy(), found.probs.copy()
            log_norm[bad], probs[bad], failed[bad] = again.log_norm, again.probs, again.failed
            found = Fit(parameter, log_norm, probs, failed, found.evaluations + again.evaluations)
        return found
