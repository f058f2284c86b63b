"""What is doubtful about a model, as values: nothing here raises."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.models.arrays import Arrays
from saltus.models.checks import FloatArray, equal_intervals, numbers
from saltus.models.coloured import ColouredSensor
from saltus.models.dependence import TimeDependent, fixed
from saltus.models.dynamics import LinearSDE, LinearTransition
from saltus.models.hybrid import HybridModel
from saltus.models.sensors import BoundSensor, LinearSensor

__all__ = ["Finding", "check", "per_interval"]

_ALIKE = 1e-12  # relative difference below which two modes' matrices are equal
_DIVIDES = 1e-6  # part of a standard deviation by which two intervals may differ from one


@dataclass(frozen=True, slots=True)
class Finding:
    """One doubt about a model: its kind (a stable word), where it lies, and what to do."""

    kind: str
    where: str
    message: str

    def __str__(self) -> str:
        return f"{self.where}: {self.message}"


def check(model: HybridModel, times: npt.ArrayLike | None = None) -> list[Finding]:
    """Look for what is admissible but probably not meant.

    Kinds: `indistinguishable` modes, `undiscretised`, `not-continuous` and `unstable` matrices, `per-interval` motion,
    `no-noise`, `unobservable` state components, `unreachable` states. Matrices that depend on `t` are not looked at,
    and with a nonlinear sensor nothing is said of observability, which then depends on where the object is.

    Args:
        model: any model.
        times: of the measurements it is meant for, s: motion that serves equal intervals only is then named where
            intervals differ, else always.
    """
    found = [*_motion(model), *per_interval(model, times), *_unreachable(model)]
    if not _depends_on_t(model):
        linear = [name for name, sensor in model.sensors.items() if isinstance(sensor, LinearSensor)]
        arrays = model.compile(dt=1.0, sensor=linear)  # any interval tells modes apart
        found += [*_alike(model, arrays), *_noiseless(arrays)]
        if len(linear) == len(model.sensors):
            found += _unobservable(model, arrays)
    return found


def per_interval(model: HybridModel, times: npt.ArrayLike | None = None) -> list[Finding]:
    """Say where motion over an interval is not that over its two halves.

    Whether F(2h) = F(h)^2, Q(2h) = F(h) Q(h) F(h)' + Q(h) and b(2h) = F(h) b(h) + b(h), h the median interval.

    Args:
        model: any model.
        times: of the measurements, s; with equal intervals nothing is said. None says it in any case.
    """
    steps = np.ones(1) if times is None else np.diff(numbers(times, "times").reshape(-1))
    steps = steps[steps > 0]
    if (times is not None and equal_intervals(steps)) or _asks_for_t(model.dynamics):
        return []
    h = float(np.median(steps))
    try:
        F, Q, b = model.dynamics.step(np.array([h, 2 * h]), None)
    except ModelError:  # a description per step refuses unequal intervals by itself
        return []
    twice = F[0] @ Q[0] @ F[0].swapaxes(-1, -2) + Q[0]
    one, two = (np.sqrt(np.maximum(np.diagonal(a, axis1=-2, axis2=-1), 0.0)) for a in (Q[1], twice))
    sd = np.where((two > 0) | (one > 0), np.maximum(one, two), 1.0)
    off = np.abs(Q[1] - twice) / (sd[..., :, None] * sd[..., None, :])
    moved = np.abs(F[1] - F[0] @ F[0]) / np.maximum(np.abs(F[1]), 1.0)
    drifted = np.zeros(1) if b is None else np.abs(b[1] - (F[0] @ b[0][..., None])[..., 0] - b[0])
    if max(off.max(), moved.max()) <= _DIVIDES and drifted.max() <= _DIVIDES * (1.0 if b is None else np.abs(b).max()):
        return []
    at = np.unravel_index(int(np.argmax(np.abs(one - two) / sd)), sd.shape)
    return [
        Finding(
            "per-interval",
            "dynamics",
            f"over {2 * h:.6g} s x[{at[-1]}] is disturbed by {one[at]:.3g}, over two intervals of {h:.6g} s by "
            f"{two[at]:.3g}: a missed measurement, or a record without values, changes the answer. Give motion that "
            "belongs to time, constant_velocity of kind 'lasting' or a LinearSDE, or measure at equal intervals.",
        )
    ]


def _depends_on_t(model: HybridModel) -> bool:
    return any(_asks_for_t(part) for part in (model.dynamics, *model.sensors.values()))


def _asks_for_t(part: object) -> bool:
    values = [getattr(part, f.name) for f in fields(part)] if is_dataclass(part) else []
    return any(isinstance(value, TimeDependent) and "t" in value.words for value in values)


def _mode_name(model: HybridModel, index: tuple[int, ...]) -> str:
    pairs = zip(model.chains, index, strict=True)
    return ", ".join(f"{chain.name}={chain.labels[i]}" for chain, i in pairs) or "the only mode"


def _flat(model: HybridModel, array: FloatArray, n_core: int) -> FloatArray:
    """One row per joint mode, (M, *core)."""
    core = array.shape[array.ndim - n_core :]
    return np.broadcast_to(array, (*model.sizes, *core)).reshape(model.n_modes, *core)


def _motion(model: HybridModel) -> Iterator[Finding]:
    """Stability, and whether continuous and discrete time were mixed up; at most one finding of a kind."""
    dynamics = model.dynamics
    if not isinstance(dynamics, LinearSDE | LinearTransition) or isinstance(dynamics.F, TimeDependent):
        return
    F = _flat(model, fixed(dynamics.F, "F"), 2)
    names = [_mode_name(model, index) for index in np.ndindex(model.sizes)]
    eigenvalues = np.linalg.eigvals(F)
    if isinstance(dynamics, LinearSDE):
        unit = (np.diagonal(F, axis1=1, axis2=2) == 1).all(axis=1) & (eigenvalues.real > 0.5).all(axis=1)
        growth = eigenvalues.real.max(axis=1)
        unstable = (growth > 1e-9 * np.abs(F).max(axis=(1, 2))) & ~unit
        yield from _first(
            "not-continuous",
            names,
            unit,
            "F of dx = F x dt has ones on its diagonal and looks like a transition matrix over an interval; "
            "use LinearTransition, or give F in 1/s.",
        )
        yield from _first("unstable", names, unstable, f"F grows like exp({growth.max():.3g} t).")
        return
    # exp(A dt) is invertible and has no real negative eigenvalue of odd multiplicity.
    singular = np.abs(eigenvalues).min(axis=1) < 1e-12
    sinking = (eigenvalues.real <= 0).all(axis=1)
    radius = np.abs(eigenvalues).max(axis=1)
    yield from _first(
        "undiscretised",
        names,
        singular | sinking,
        "F is no transition matrix exp(A dt) (singular, or all eigenvalues in the left half-plane) and looks like "
        "continuous time; use LinearSDE, or discretise first.",
    )
    unstable = (radius > 1 + 1e-6) & ~singular & ~sinking
    yield from _first("unstable", names, unstable, f"F grows by a factor {radius.max():.6g} a step.")


def _first(kind: str, names: list[str], mask: np.ndarray, message: str) -> Iterator[Finding]:
    where = [name for name, hit in zip(names, mask, strict=True) if hit]
    if where:
        more = f" (and {len(where) - 1} more modes)" if len(where) > 1 else ""
        yield Finding(kind, f"dynamics, {where[0]}{more}", message)


def _unreachable(model: HybridModel) -> Iterator[Finding]:
    for chain in model.chains:
        jumps = np.asarray(chain.trans if chain.rates is None else chain.rates)
        reached = chain.law > 0
        for _ in range(len(chain)):
            reached = reached | ((jumps * reached[:, None]) > 0).any(axis=0)
        for i in np.flatnonzero(~reached):
            yield Finding(
                "unreachable",
                f"chain {chain.name}, state {chain.labels[i]}",
                "never entered: it starts with probability 0 and no reachable state leads to it. "
                "Give initial=, or leave the state out.",
            )


def _signature(model: HybridModel, arrays: Arrays) -> FloatArray:
    """Everything a measurement can depend on, one row per joint mode, each array scaled to at most 1."""
    parts = []
    shapes = ((arrays.F, 2), (arrays.Q, 2), (arrays.b, 1), (arrays.H, 2), (arrays.R, 2), (arrays.d, 1))
    for array, n_core in (*shapes, (arrays.mean0, 1), (arrays.cov0, 2), *_nonlinear(model, arrays.mean0)):
        if array is not None:
            flat = _flat(model, array, n_core).reshape(model.n_modes, -1)
            parts.append(flat / np.maximum(np.abs(flat).max(axis=0, initial=0.0), 1e-300))
    return np.concatenate(parts, axis=1)


def _nonlinear(model: HybridModel, mean: FloatArray) -> Iterator[tuple[FloatArray, int]]:
    """Noise and expected measurement, at the prior's mean, of every sensor without matrices."""
    for sensor in model.sensors.values():
        if isinstance(sensor, BoundSensor) and not isinstance(sensor, LinearSensor):
            now = sensor.at(0.0)
            with np.errstate(invalid="ignore", divide="ignore"):  # a range rate at the observer's place
                yield from ((now.noise(), 2), (np.nan_to_num(now.h(mean)), 1))
        if isinstance(sensor, ColouredSensor):  # modes may differ in the noise's memory alone
            noise = sensor.bound_noise()
            yield from ((fixed(noise.F, "F"), 2), (fixed(noise.G, "G"), 2))


def _alike(model: HybridModel, arrays: Arrays) -> Iterator[Finding]:
    rows = _signature(model, arrays)
    table = rows.reshape(*model.sizes, -1)
    explained = [list(range(size)) for size in model.sizes]  # state -> first state like it
    for axis, chain in enumerate(model.chains):
        for i, j in combinations(range(len(chain)), 2):
            a, b = np.take(table, i, axis=axis), np.take(table, j, axis=axis)
            if explained[axis][j] == j and np.abs(a - b).max() < _ALIKE:
                explained[axis][j] = explained[axis][i]
                yield Finding(
                    "indistinguishable",
                    f"chain {chain.name}, states {chain.labels[i]} and {chain.labels[j]}",
                    "all matrices are equal, so no measurement can tell them apart; their probabilities follow "
                    "the chain alone.",
                )
    indices = [i for i in np.ndindex(model.sizes) if all(explained[c][s] == s for c, s in enumerate(i))]
    for one, other in combinations(indices, 2):
        if sum(a != b for a, b in zip(one, other, strict=True)) > 1:
            if np.abs(table[one] - table[other]).max() < _ALIKE:
                yield Finding(
                    "indistinguishable",
                    f"modes ({_mode_name(model, one)}) and ({_mode_name(model, other)})",
                    "all matrices are equal, so no single measurement can tell them apart.",
                )


def _noiseless(arrays: Arrays) -> Iterator[Finding]:
    if not arrays.Q.any():
        yield Finding(
            "no-noise",
            "dynamics",
            "there is no process noise in any mode: covariances shrink to 0 and the filter stops listening.",
        )


def _unobservable(model: HybridModel, arrays: Arrays) -> Iterator[Finding]:
    """State components that no sensor sees, in units of the prior's and the sensors' standard deviations."""
    F, H = _flat(model, arrays.F, 2), _flat(model, arrays.H, 2)
    sd = np.sqrt(np.diagonal(_flat(model, arrays.cov0, 2), axis1=1, axis2=2)).max(axis=0)
    sd = np.where(sd > 0, sd, 1.0)
    F, H = F * sd / sd[:, None], H * sd
    powers = [H]
    for _ in range(model.n_state - 1):
        powers.append(powers[-1] @ F)
    stacked = np.concatenate(powers, axis=1)  # (M, n m, n)
    blind = [_null_components(matrix) for matrix in stacked]
    never = _null_components(stacked.reshape(-1, model.n_state))
    if never:
        yield Finding(
            "unobservable",
            f"state components {_listed(never)}",
            "no sensor sees them in any mode: their variance only grows. Do not judge them, or leave them out.",
        )
    names = [_mode_name(model, index) for index in np.ndindex(model.sizes)]
    lost = [(name, extra) for name, b in zip(names, blind, strict=True) if (extra := set(b) - set(never))]
    if lost:
        name, extra = lost[0]
        more = f" (and {len(lost) - 1} more modes)" if len(lost) > 1 else ""
        yield Finding(
            "unobservable-in-mode",
            f"{name}{more}",
            f"state components {_listed(sorted(extra))} cannot be seen while this mode lasts.",
        )


def _null_components(matrix: FloatArray) -> list[int]:
    """Components with a part in the null space of an observability matrix."""
    size = np.abs(matrix).max(axis=1, keepdims=True)
    _, s, vt = np.linalg.svd(matrix / np.where(size > 0, size, 1.0))
    rank = int((s > 1e-10 * max(s[0], 1e-300)).sum()) if s[0] > 0 else 0
    null = vt[rank:]
    return [int(i) for i in np.flatnonzero((np.abs(null) > 1e-6).any(axis=0))]


def _listed(components: list[int]) -> str:
    return ", ".join(f"x[{i}]" for i in components)
