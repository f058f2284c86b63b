"""The moment equations (D) between measurements, for any drift: by the flow of the closure's nodes.

Over a substep the generator is split into drift with switching, and noise, in symmetric order:
exp(tA/2) exp(tN) exp(tA) exp(tN) ... exp(tA/2). The nodes of the closure follow the drift (Runge-Kutta) and share
their probability among the modes halfway; noise acts on the moments, exactly where it does not depend on the state.
After each noise the closure gives new nodes. What a substep makes are moments of a law with positive weights, so they
stay realisable, whatever the stiffness of their equations.
"""

from collections.abc import Callable
from math import ceil
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.filters.moments.basis import Basis, gaussian_points, normal_nodes
from saltus.filters.moments.belief import Cloud, Moments, Points, add_noise, moments_of
from saltus.models import SwitchingSDE, exponential

__all__ = ["Flow", "constant_noise", "predict_by_flow"]

_Array = npt.NDArray[np.float64]
_STEEP = 0.5  # largest change of the drift over half a part of a step, relative
_MOST_PARTS = 16
_IDLE = 1e-13  # nodes with less weight stay where they are: the drift there may be enormous


class Flow(NamedTuple):
    """How (D) is integrated."""

    model: SwitchingSDE
    basis: Basis
    close: Callable[[Moments], Points]
    noise: _Array | None  # B of each mode (s, n, n), or None where it depends on the state
    observed: bool = False  # switches are seen: none happened meanwhile


def constant_noise(model: SwitchingSDE) -> _Array | None:
    """B of each mode if no diffusion is a function of the state."""
    if any(callable(field) for field in model.diffusion):
        return None
    return np.stack([model.covariance_at(mode, model.means0[mode]) for mode in range(model.n_modes)])


def predict_by_flow(flow: Flow, start: Points, dt: float, n_steps: int) -> Moments:
    """Moments after an interval, by `n_steps` substeps."""
    step = dt / n_steps
    law = _noise(flow, _drift(flow, start, step / 2), step)
    for _ in range(n_steps - 1):
        law = _noise(flow, _drift(flow, flow.close(law), step), step)
    return moments_of(flow.basis, _drift(flow, flow.close(law), step / 2))


def _noise(flow: Flow, clouds: list[list[Cloud]], step: float) -> Moments:
    if flow.noise is not None:
        return add_noise(flow.basis, moments_of(flow.basis, clouds), step * flow.noise)
    spread = [[_spread(flow, mode, cloud, step) for cloud in own] for mode, own in enumerate(clouds)]
    return moments_of(flow.basis, spread)


def _spread(flow: Flow, mode: int, cloud: Cloud, step: float) -> Cloud:
    """Three points per axis of noise around every point: its first five moments."""
    y, w = cloud
    b = flow.model.diffusion_at(mode, y)
    nodes, share = normal_nodes(b.shape[-1], 3)
    moved = y[:, :, None] + np.sqrt(step) * np.einsum("bqnw,gw->bqgn", b, nodes)
    joint = w[:, :, None] * share
    return moved.reshape(len(y), -1, y.shape[-1]), joint.reshape(len(w), -1)


def _drift(flow: Flow, start: Points, step: float) -> list[list[Cloud]]:
    """Drift over half the step, switching, drift over the other half: clouds of every mode."""
    model = flow.model
    clouds: list[list[Cloud]] = [[] for _ in range(model.n_modes)]
    for mode, (y, w) in enumerate(start.clouds()):
        heavy = np.abs(start.weights[:, mode]) > _IDLE
        y = np.where(heavy[..., None], y, (start.weights[:, mode, :, None] * y).sum(1, keepdims=True))
        halfway = _carried(model, mode, y, step / 2)
        stay, moved = _shares(flow, mode, halfway, step)
        for target, share in stay.items():
            clouds[target].append((_carried(model, target, halfway, step / 2), w * share))
        for target, share in moved.items():
            mass = (w * share).sum(-1)
            clouds[target].append(_restored(model, (mode, target), mass, step / 2))
    return clouds


def _carried(model: SwitchingSDE, mode: int, y: _Array, step: float) -> _Array:
    """Follow dy = a dt for a step, by the classical Runge-Kutta rule, in parts where the drift is steep somewhere."""
    k1 = model.drift_at(mode, y)
    k2 = model.drift_at(mode, y + 0.5 * step * k1)
    size = np.abs(k1)
    change = np.abs(k2 - k1) / (size + 1e-3 * size.max() + 1e-300)
    parts = min(_MOST_PARTS, max(1, ceil(float(change.max()) / _STEEP)))
    part = step / parts
    for i in range(parts):
        if parts > 1:
            k1 = model.drift_at(mode, y) if i else k1
            k2 = model.drift_at(mode, y + 0.5 * part * k1)
        k3 = model.drift_at(mode, y + 0.5 * part * k2)
        k4 = model.drift_at(mode, y + part * k3)
        y = y + part / 6 * (k1 + 2 * (k2 + k3) + k4)
    return y


def _shares(flow: Flow, mode: int, y: _Array, step: float) -> tuple[dict[int, _Array], dict[int, _Array]]:
    """Shares of the points' probability that go to each mode with the state kept, and with the state restored."""
    model = flow.model
    exits = {s: model.rate(s, y) for s in model.switches}
    if flow.observed or not exits:
        return {mode: np.exp(-step * model.exit_rate(mode, y))}, {}
    kept = [s for s in exits if model.restored(s) is None]
    G = np.zeros((*y.shape[:-1], model.n_modes, model.n_modes))
    for (source, target), rate in exits.items():
        G[..., source, source] -= rate
        if (source, target) in kept:
            G[..., source, target] += rate
    if model.n_modes == 2 and len(kept) == 2:
        a, b = exits[0, 1], exits[1, 0]
        gone = -np.expm1(-(a + b) * step) / np.maximum(a + b, 1e-300)
        row = np.stack([1 - a * gone, a * gone] if mode == 0 else [b * gone, 1 - b * gone], axis=-1)
    else:
        row = exponential(G * step)[..., mode, :]
    stay = {
        target: row[..., target] for target in range(model.n_modes) if target == mode or _reached(kept, mode, target)
    }
    lost = 1 - row.sum(axis=-1)
    ways = [s for s in exits if s[0] == mode and s not in kept]
    total = sum((exits[s] for s in ways), np.zeros(y.shape[:-1]))
    return stay, {s[1]: lost * exits[s] / np.maximum(total, 1e-300) for s in ways}


def _reached(kept: list[tuple[int, int]], source: int, target: int) -> bool:
    """Whether kept switches lead from one mode to another, in any number."""
    known, edge = {source}, {source}
    while edge:
        edge = {t for s, t in kept if s in edge} - known
        known |= edge
    return target in known


def _restored(model: SwitchingSDE, switch: tuple[int, int], mass: _Array, step: float) -> Cloud:
    law = model.restored(switch)
    if law is None:
        raise AssertionError("only restored switches have a law")
    y, share = gaussian_points(*law, 7 if len(law[0]) == 1 else 5)
    return _carried(model, switch[1], y[None], step), mass[:, None] * share
