"""How targets move: the states of the chains of manoeuvre, and how one leads to another."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from saltus.models import Chain
from saltus.tracks.settings import FilterSettings

__all__ = ["Mode", "horizontal_chain", "vertical_chain"]

_IN_TURN = 0.3  # of the hardest acceleration, on top of a turn
_UNSETTLED = 0.8  # of the departures from steady motion
_SETTLES = 0.9  # of the departures from any other


class Mode(NamedTuple):
    """One state of a chain: acceleration (m/s^2, or density in m^2/s^3) and rate of turn to the right (rad/s)."""

    accel: float
    turn: float = 0.0


def horizontal_chain(settings: FilterSettings) -> Chain:
    """Steady motion, turns left and right, levels of acceleration: the most agile last.

    Each state is left after its mean stay. Steady motion goes over to an acceleration in four of five cases, for turns
    begin by turning ever faster, and to a turn in one; any other state goes back to it in nine of ten.
    """
    accel, stay = settings.accel_h, settings.sojourn_h
    levels = _levels(settings, accel)
    if not settings.turn_rate or len(accel) == 1:
        return _chain("horizontal", levels, stay)
    rates = [sign * float(np.radians(rate)) for rate in settings.turn_rate for sign in (-1.0, 1.0)]
    (hard,) = _levels(settings, [_IN_TURN * accel[-1]])
    states = {"steady": levels[0]}
    for k, rate in enumerate(rates):
        states[f"{'right' if rate > 0 else 'left'}{k // 2 + 1}"] = hard._replace(turn=rate)
    states |= {f"manoeuvre{k}": level for k, level in enumerate(levels[1:], 1)}
    turns, n = len(rates), len(states)
    share = np.full((n, n), (1.0 - _SETTLES) / (n - 2))  # of the departures from one state, to another
    share[:, 0] = _SETTLES
    share[0, 1 : 1 + turns] = (1.0 - _UNSETTLED) / turns
    share[0, 1 + turns :] = _UNSETTLED / (len(accel) - 1)
    np.fill_diagonal(share, -1.0)
    stays = np.array([stay[0], *([settings.turn_sojourn] * turns), *stay[1:]])
    return Chain("horizontal", states, rates=share / stays[:, None])


def vertical_chain(settings: FilterSettings) -> Chain:
    """Steady motion and levels of acceleration."""
    return _chain("vertical", _levels(settings, settings.accel_v), settings.sojourn_v)


def _levels(settings: FilterSettings, accel: Sequence[float]) -> list[Mode]:
    lasts = settings.accel_time
    return [Mode(a * a * lasts if lasts else a) for a in accel]


def _chain(name: str, modes: Sequence[Mode], sojourn: Sequence[float]) -> Chain:
    if len(modes) == 1:
        return Chain(name, {"steady": modes[0]}, trans=[[1.0]])
    labels = ["steady", *(f"manoeuvre{i}" for i in range(1, len(modes)))]
    return Chain(name, dict(zip(labels, modes, strict=True)), sojourn=dict(zip(labels, sojourn, strict=True)))
