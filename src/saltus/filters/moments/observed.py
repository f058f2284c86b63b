"""Switches that are seen: which mode holds is known, and so is when it changed.

Between switches the mode has probability 1, but that none happened is information where rates depend on the state:
d/dt <phi> holds -Cov(nu, phi). At a switch r -> l,  <phi>+ = <nu_rl Q phi> / <nu_rl>.

Source: moment-filter notes, section 7.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from saltus.errors import DataError
from saltus.filters.moments.belief import Points, root_of
from saltus.filters.moments.closure import Closing
from saltus.filters.observation import Observation
from saltus.models import SwitchingSDE
from saltus.shapes import Float

__all__ = ["SeenSwitch", "certain", "checked_switches", "switched"]

_NEVER = -690.0  # log probability of what is known not to be


class SeenSwitch(NamedTuple):
    """A switch that was seen, of all runs: when (s), from which mode, to which."""

    time: float
    source: int
    target: int


def checked_switches(
    given: Observation, switches: Sequence[SeenSwitch | tuple[float, int, int]]
) -> tuple[SeenSwitch, ...]:
    """Check that switches follow on each other, can happen, and lie between the start and the last measurement.

    Raises:
        DataError: they go back in time, lie outside, do not connect, or have no rate.
    """
    wrong = [switch for switch in switches if len(switch) != 3]
    if wrong:
        raise DataError(f"switches are (time, from, to), got {wrong[0]!r}.")
    seen = tuple(SeenSwitch(*switch) for switch in switches)
    start, end = float(given.times[0] - given.dts[0]), float(given.times[-1])
    for k, switch in enumerate(seen):
        if not start <= switch.time <= end:
            raise DataError(
                f"switch {k} at {switch.time:g} s does not lie between the start, {start:g} s, and the last "
                f"measurement, {end:g} s. Leave it out, or give times with rows of NaN up to it."
            )
        if (switch.source, switch.target) not in given.model.switches:
            raise DataError(f"switch {k}, {switch.source} -> {switch.target}, has no intensity in this model.")
        if k and (switch.time < seen[k - 1].time or switch.source != seen[k - 1].target):
            raise DataError(
                f"switch {k} at {switch.time:g} s from mode {switch.source} does not follow on the one before, "
                f"at {seen[k - 1].time:g} s to mode {seen[k - 1].target}."
            )
    return seen


def certain(log_probs: Float[np.ndarray, "b s"], mode: int) -> Float[np.ndarray, "b s"]:
    """Log probabilities when the mode is known."""
    known = np.full_like(log_probs, _NEVER)
    known[:, mode] = 0.0
    return known


def switched(model: SwitchingSDE, closing: Closing, points: Points, source: int, target: int) -> Points:
    """The law just after a switch that was seen."""
    law = model.restored((source, target))
    places, weights = points.points.copy(), points.weights.copy()
    if law is None:
        y = points.points[:, source]
        w = points.weights[:, source] * model.rate((source, target), y)
        places[:, target], weights[:, target] = y, w / w.sum(axis=-1, keepdims=True)
        return Points(certain(points.log_probs, target), places, weights)
    root = root_of(law[1] + 1e-18 * np.eye(len(law[0])) * (1.0 + np.square(law[0]).max()))
    places[:, target] = closing.places(law[0][None, None], root[None, None])[0]
    log_w = closing.rule.log_weights - 0.5 * np.square(closing.rule.nodes).sum(-1)
    weights[:, target] = np.exp(log_w) / np.exp(log_w).sum()
    return Points(certain(points.log_probs, target), places, weights)
