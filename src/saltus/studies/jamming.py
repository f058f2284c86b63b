"""The jamming experiment: two sensors that fail in turn while their target manoeuvres at random.

A radar is jammed, biased and deaf, then a coarser beacon is jammed. The faults are known to us, not to the adaptive
filter, which has three chains: the target's manoeuvres and the condition of each sensor. Beside it run the same filter
told the conditions, and one that has never heard of faults.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus import montecarlo
from saltus.filters import imm_filter
from saltus.models import (
    OK,
    Chain,
    Condition,
    FaultySensor,
    Gaussian,
    HybridModel,
    PositionSensor,
    constant_velocity,
    lost,
)
from saltus.shapes import Float, Int

__all__ = [
    "FAULTS",
    "FILTERS",
    "FIRST",
    "LENGTH",
    "PERIOD",
    "SIZE",
    "STEPS",
    "Trial",
    "conditions",
    "described",
    "run_jamming",
]

FILTERS = ("adaptive", "informed", "ignorant")
FAULTS = ("radar jammed", "radar biased", "radar lost", "beacon jammed")
STEPS = 200  # measurements
PERIOD = 4.0  # s
FIRST, LENGTH = (30, 70, 110, 150), 20  # rows in which the faults begin, and their length
SIZE = 10.0  # of the faults, in standard deviations
_SIGMA = (30.0, 60.0)  # m: radar, beacon
_SPAN = 40e3  # m: where measurements fall that carry nothing
_ACCEL = (0.3, 6.0)  # m/s^2: steady, manoeuvre
_MEAN0, _SD0 = np.array([0.0, 150.0, 0.0, 100.0]), np.array([100.0, 20.0, 100.0, 20.0])  # m, m/s
_RUNS_AT_ONCE = 100

_Array = npt.NDArray[np.float64]


class Trial(NamedTuple):
    """What B runs of T measurements gave; filters in the order of FILTERS."""

    error: Float[np.ndarray, "b 3 t"]  # distance between true and estimated position, m
    nees: Float[np.ndarray, "b t"]  # of the adaptive filter, over all four states
    prob: Float[np.ndarray, "b t 4 2"]  # of the joint conditions of radar and beacon, adaptive filter
    prob_turn: Float[np.ndarray, "b t"]
    turning: Int[np.ndarray, "b t"]


def described() -> HybridModel:
    """Describe the world the adaptive filter believes in."""
    states = {
        "ok": OK,
        "jammed": Condition(noise=SIZE),
        "biased": Condition(bias=[SIZE * _SIGMA[0], 0.0]),
        "lost": lost(span=_SPAN),
    }
    return HybridModel(
        chains=[
            Chain("manoeuvre", dict(zip(("steady", "turn"), _ACCEL, strict=True)), sojourn={"steady": 80, "turn": 20}),
            Chain("radar", states, sojourn={"ok": 800.0, "jammed": 80.0, "biased": 80.0, "lost": 80.0}),
            Chain("beacon", {"ok": OK, "jammed": states["jammed"]}, sojourn={"ok": 800.0, "jammed": 80.0}),
        ],
        dynamics=constant_velocity(2, accel=lambda manoeuvre: manoeuvre, kind="scan"),
        sensors={
            "radar": FaultySensor(PositionSensor(2, _SIGMA[0]), ["radar"]),
            "beacon": FaultySensor(PositionSensor(2, _SIGMA[1]), ["beacon"]),
        },
        prior=Gaussian(_MEAN0, np.diag(_SD0**2)),
    )


def conditions(faults: bool = True) -> Int[np.ndarray, "t 2"]:
    """Return the true conditions of radar and beacon at each measurement, (T, 2): 0 where they are well."""
    out = np.zeros((STEPS, 2), np.int64)
    if faults:
        for first, radar, beacon in zip(FIRST, (1, 2, 3, 0), (0, 0, 0, 1), strict=True):
            out[first : first + LENGTH] = radar, beacon
    return out


def run_jamming(
    n_runs: int, seed: int, *, faults: bool = True, progress: Callable[[int, int], None] | None = None
) -> Trial:
    """Repeat the experiment.

    Args:
        n_runs: number of runs, each with its own manoeuvres and noises.
        seed: root of the runs' generators.
        faults: False leaves both sensors well throughout.
        progress: called with (runs done, all runs).
    """
    return montecarlo.run(
        lambda rngs: _trial(rngs, conditions(faults)), n_runs, seed, batch=_RUNS_AT_ONCE, progress=progress
    )


def _trial(rngs: Sequence[np.random.Generator], condition: npt.NDArray[np.int64]) -> Trial:
    arrays = described().compile(dt=PERIOD)._asdict()
    turning, truth, z = _drawn(rngs, arrays["trans"][0], arrays["F"][0, 0, 0], condition)
    adaptive = imm_filter(z, **arrays)
    told = arrays | {"trans": arrays["trans"][:1], "probs0": arrays["probs0"].sum((-2, -1))}
    told |= {name: arrays[name][:, 0, 0] for name in ("F", "Q", "mean0", "cov0")}
    informed, ignorant = (
        imm_filter(z, **told | {name: arrays[name][:, c[:, 0], c[:, 1]].swapaxes(0, 1) for name in ("H", "R", "d")})
        for c in (condition, np.zeros_like(condition))
    )
    off = np.stack([truth - a.mean for a in (adaptive, informed, ignorant)], axis=1)
    white = np.linalg.solve(adaptive.cov, off[:, 0, ..., None])[..., 0]
    return Trial(
        error=np.hypot(off[..., 0], off[..., 2]),
        nees=np.sum(white * off[:, 0], axis=-1),
        prob=adaptive.prob(1, 2),
        prob_turn=adaptive.prob(0)[..., 1],
        turning=turning,
    )


def _drawn(
    rngs: Sequence[np.random.Generator], trans: _Array, F: _Array, condition: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int64], _Array, _Array]:
    """Draw manoeuvres (B, T), states (B, T, 4) and measurements (B, T, 4); each run from its own generator."""
    start = np.stack([rng.standard_normal(4) for rng in rngs])
    noise = np.stack([rng.standard_normal((STEPS, 6)) for rng in rngs])
    uniform = np.stack([rng.uniform(size=(STEPS, 3)) for rng in rngs])
    x = _MEAN0 + start * _SD0
    turn = (uniform[:, 0, 0] > 0.8).astype(np.int64)  # the stationary law: 80 s against 20 s
    turning, states = np.empty((len(rngs), STEPS), np.int64), np.empty((len(rngs), STEPS, 4))
    gain = np.kron(np.eye(2), [[PERIOD**2 / 2], [PERIOD]])
    for k in range(STEPS):
        if k:
            turn = (uniform[:, k, 0] < trans[turn, 1]).astype(np.int64)
        x = x @ F.T + np.array(_ACCEL)[turn, None] * (noise[:, k, :2] @ gain.T)
        turning[:, k], states[:, k] = turn, x
    radar, beacon = condition.T
    sd = np.stack([np.where(radar == 1, SIZE, 1.0) * _SIGMA[0], np.where(beacon == 1, SIZE, 1.0) * _SIGMA[1]], axis=-1)
    z = np.concatenate([states[..., ::2]] * 2, axis=-1) + np.repeat(sd, 2, axis=-1) * noise[..., 2:]
    z[..., 0] += SIZE * _SIGMA[0] * (radar == 2)
    z[..., :2] = np.where((radar == 3)[:, None], _SPAN * (uniform[..., 1:] - 0.5), z[..., :2])
    return turning, states, z
