"""How far a grid must reach: where the diffusion may be, before anything is measured."""

import numpy as np

from saltus.errors import NumericalError
from saltus.filters.grid.generator import Axes, generator
from saltus.filters.grid.propagate import uniformised
from saltus.models import SwitchingSDE
from saltus.shapes import Float, Int

__all__ = ["axes_within", "reach", "start"]

_CELLS = 48  # per axis
_OUTSIDE = 1e-7  # probability that may lie beyond an edge
_LOOKS = 12  # times at which probability is looked at
_REACH = 6.0  # standard deviations
_TRIES = 16


def axes_within(low: Float[np.ndarray, " n"], high: Float[np.ndarray, " n"], cells: tuple[int, ...]) -> Axes:
    """Equal cells between bounds."""
    sides = zip(low, high, cells, strict=True)
    return Axes(tuple(a + (np.arange(n) + 0.5) * (b - a) / n for a, b, n in sides))


def start(model: SwitchingSDE, axes: Axes) -> Float[np.ndarray, "s *cells"]:
    """Probabilities of modes and cells at the start."""
    laws = zip(np.asarray(model.probs0), model.means0, model.covs0, strict=True)
    return np.stack([p * axes.gaussian(mean, cov) for p, mean, cov in laws])


def reach(model: SwitchingSDE, duration: float) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Bounds that the diffusion leaves with negligible probability within `duration`.

    A coarse grid about the prior and the laws of restoration is followed in time and widened where probability comes
    near its edge.

    Raises:
        NumericalError: it spreads without end.
    """
    laws = [model.restored(switch) for switch in model.switches]
    means = [*model.means0, *(law[0] for law in laws if law is not None)]
    covs = [*model.covs0, *(law[1] for law in laws if law is not None)]
    spread = [_REACH * np.sqrt(np.diagonal(cov)) + 1e-9 for cov in covs]
    low = np.min([m - s for m, s in zip(means, spread, strict=True)], axis=0)
    high = np.max([m + s for m, s in zip(means, spread, strict=True)], axis=0)
    for _ in range(_TRIES):
        axes = axes_within(low, high, (_CELLS,) * model.n_state)
        inside = _inside(model, axes, duration)
        width = (high - low) / _CELLS
        if (inside[:, 0] > 0).all() and (inside[:, 1] < _CELLS - 1).all():
            return low + (inside[:, 0] - 1) * width, low + (inside[:, 1] + 2) * width
        low = low - np.where(inside[:, 0] == 0, 8 * width, 0.0)
        high = high + np.where(inside[:, 1] == _CELLS - 1, 8 * width, 0.0)
    raise NumericalError(
        f"the diffusion leaves every grid within {duration:g} s: it had reached {low} to {high}.\n"
        "Give bounds=(low, high) where the measurements keep it, or follow it with a particle filter."
    )


def _inside(model: SwitchingSDE, axes: Axes, duration: float) -> Int[np.ndarray, "n 2"]:
    """First and last cell of each axis outside of which there is never any probability to speak of."""
    rates = generator(model, axes)
    p = start(model, axes)[None]
    highest = p.copy()
    move = uniformised(rates.change, rates.fastest(), duration / _LOOKS)
    for _ in range(_LOOKS):
        p = move(p)
        highest = np.maximum(highest, p)
    found = []
    for axis in range(model.n_state):
        line = highest[0].sum(axis=tuple(i for i in range(model.n_state + 1) if i != 1 + axis))
        found.append([np.argmax(np.cumsum(side) > _OUTSIDE) for side in (line, line[::-1])])
    return np.asarray(np.abs(np.array(found) - np.array([0, _CELLS - 1])))
