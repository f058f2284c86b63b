"""A switching diffusion as a Markov chain on a grid: probability is kept and stays positive, whatever the step.

From a cell of width h the chain jumps to its neighbours on each axis at rates

    r+ = D / h^2 + a / (2 h),   r- = D / h^2 - a / (2 h),   D = max(B / 2, |a| h / 2),

which have the diffusion's own mean and, where the cells are fine enough, its own variance: second order in h. An axis
without noise of its own (position, where acceleration is noise) would be blurred by |a| h per second; over an interval
its lines are shifted instead (`saltus.filters.grid.propagate`).
"""

from typing import NamedTuple

import numpy as np

from saltus.errors import ModelError
from saltus.models import SwitchingSDE
from saltus.shapes import Float

__all__ = ["Axes", "Generator", "Switch", "generator"]

_CORRELATED = 1e-9


class Axes(NamedTuple):
    """A grid of 1 or 2 axes: centres of its cells."""

    centres: tuple[Float[np.ndarray, " n"], ...]

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of cells of each axis."""
        return tuple(len(c) for c in self.centres)

    @property
    def widths(self) -> tuple[float, ...]:
        """Width of a cell on each axis."""
        return tuple(float(c[1] - c[0]) for c in self.centres)

    @property
    def states(self) -> Float[np.ndarray, "*cells n"]:
        """States at the centres, (*cells, n)."""
        return np.stack(np.meshgrid(*self.centres, indexing="ij"), axis=-1)

    def gaussian(self, mean: Float[np.ndarray, " n"], cov: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "*cells"]:
        """Probabilities of the cells under a Gaussian, widened where it is narrower than half a cell."""
        floor = np.diag(np.square(self.widths)) / 4
        wide = np.diag(np.diagonal(cov)) < floor
        cov = np.where(wide, floor, cov)
        off = self.states - mean
        log_p = -0.5 * np.einsum("...i,ij,...j->...", off, np.linalg.inv(cov), off)
        p = np.exp(log_p - log_p.max())
        return np.asarray(p / p.sum())


class Switch(NamedTuple):
    """A switch (source, target): its rate in every cell, and the law of the cell after it (None: kept)."""

    source: int
    target: int
    rate: Float[np.ndarray, "*cells"]
    law: Float[np.ndarray, "*cells"] | None


class Generator(NamedTuple):
    """Rates of jumping up and down each axis, (S, *cells), and of switching."""

    up: tuple[Float[np.ndarray, "s *cells"], ...]
    down: tuple[Float[np.ndarray, "s *cells"], ...]
    velocity: tuple[Float[np.ndarray, "s *cells"] | None, ...]  # cells / s, of axes without noise; else None
    coupling: float  # how fast the drift of one axis changes along the other, 1/s
    switches: tuple[Switch, ...]

    def transport(self, p: Float[np.ndarray, "b s *cells"], axis: int) -> Float[np.ndarray, "b s *cells"]:
        """Change per second of probabilities by the jumps along one axis."""
        up, down = p * self.up[axis], p * self.down[axis]
        change = -(up + down)
        inner = (slice(None),) * (2 + axis)
        change[(*inner, slice(1, None))] += up[(*inner, slice(None, -1))]
        change[(*inner, slice(None, -1))] += down[(*inner, slice(1, None))]
        return np.asarray(change)

    def switching(self, p: Float[np.ndarray, "b s *cells"]) -> Float[np.ndarray, "b s *cells"]:
        """Change per second of probabilities by the switches."""
        change = np.zeros_like(p)
        for switch in self.switches:
            leaving = p[:, switch.source] * switch.rate
            change[:, switch.source] -= leaving
            if switch.law is not None:
                total = leaving.reshape(len(p), -1).sum(-1)
                leaving = total.reshape(-1, *(1,) * (p.ndim - 2)) * switch.law
            change[:, switch.target] += leaving
        return change

    def change(self, p: Float[np.ndarray, "b s *cells"]) -> Float[np.ndarray, "b s *cells"]:
        """Change per second of probabilities, p G."""
        total = self.switching(p)
        for axis in range(len(self.up)):
            total += self.transport(p, axis)
        return total

    def exit_rate(self) -> float:
        """Largest rate of switching out of a mode."""
        return float(self._exits().max())

    def fastest(self) -> float:
        """Largest rate of leaving a cell in any way."""
        return float((self._exits() + sum(self.up) + sum(self.down)).max())

    def _exits(self) -> Float[np.ndarray, "s *cells"]:
        total = np.zeros_like(self.up[0])
        for switch in self.switches:
            total[switch.source] += switch.rate
        return total


def generator(model: SwitchingSDE, axes: Axes) -> Generator:
    """Rates of a model on a grid; nothing crosses its edges.

    Raises:
        ModelError: noises of the two components are correlated.
    """
    x = axes.states
    drift = np.stack([model.drift_at(mode, x) for mode in range(model.n_modes)])
    B = np.stack([model.covariance_at(mode, x) for mode in range(model.n_modes)])
    n = model.n_state
    if n == 2 and np.abs(B[..., 0, 1]).max() > _CORRELATED * np.abs(B).max():
        raise ModelError(
            "the grid's axes must have uncorrelated noises, but B[0, 1] is not 0 for this diffusion.\n"
            "Choose coordinates in which b b' is diagonal, or use a particle filter."
        )
    up, down, velocity = [], [], []
    for axis, h in enumerate(axes.widths):
        a = drift[..., axis]
        D = np.maximum(B[..., axis, axis] / 2, np.abs(a) * h / 2)
        rise, fall = D / h**2 + a / (2 * h), D / h**2 - a / (2 * h)
        velocity.append(a / h if not B[..., axis, axis].any() else None)
        edge = (slice(None),) * (1 + axis)
        rise[(*edge, -1)] = 0.0
        fall[(*edge, 0)] = 0.0
        up.append(np.maximum(rise, 0.0))
        down.append(np.maximum(fall, 0.0))
    switches = []
    for pair in model.switches:
        law = model.restored(pair)
        switches.append(Switch(*pair, model.rate(pair, x), None if law is None else axes.gaussian(*law)))
    return Generator(tuple(up), tuple(down), tuple(velocity), _coupling(drift, axes), tuple(switches))


def _coupling(drift: Float[np.ndarray, "s *cells n"], axes: Axes) -> float:
    if len(axes.widths) == 1:
        return 0.0
    first = np.abs(np.diff(drift[..., 0], axis=2)).max() / axes.widths[1]
    second = np.abs(np.diff(drift[..., 1], axis=1)).max() / axes.widths[0]
    return float(max(first, second))
