"""Models with coloured noise: which way they are filtered, and the model that has the noise in its state.

Two ways give the same posterior. *Augmentation* appends the noise's own state to x. *Differencing* filters x alone
(and what of the noise is not seen), because each measurement is known exactly once it is made. It needs measurements
without white noise, one H for all modes and times, and one sensor, so that every record measures all there is.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from saltus.errors import ModelError
from saltus.linalg import block_diagonal
from saltus.models.chain import Chain
from saltus.models.checks import FloatArray, same
from saltus.models.coloured import ColouredSensor
from saltus.models.dependence import Matrix, TimeDependent, fixed
from saltus.models.dynamics import Dynamics, Step
from saltus.models.exponential import discretise
from saltus.models.gaussian import Gaussian
from saltus.models.hybrid import HybridModel
from saltus.models.noise import MarkovNoise
from saltus.models.sensors import LinearSensor

__all__ = ["NoisyDynamics", "Treatment", "augmented", "coloured_sensors", "treatment"]


@dataclass(frozen=True, slots=True, eq=False)
class NoisyDynamics:
    """Motion with the states of coloured noises appended: a = (x, u1, u2, ...)."""

    motion: Dynamics
    noises: tuple[MarkovNoise, ...]

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    def dimension(self) -> int:
        """Dimension of the augmented state."""
        return self.motion.dimension() + int(sum(noise.output.shape[1] for noise in self.noises))

    def bind(self, chains: Sequence[Chain]) -> "NoisyDynamics":
        """Motion and noises are bound already."""
        return self

    def step(self, dt: FloatArray, t: FloatArray | None) -> Step:
        """Matrices over intervals: those of motion and noises side by side."""
        moves = self.motion.step(dt, t)
        lead = np.asarray(dt)
        lead = lead.reshape(*lead.shape, *(1,) * (moves.F.ndim - lead.ndim - 2))
        F, Q = [moves.F], [moves.Q]
        for noise in self.noises:
            Phi, cov = discretise(fixed(noise.F, "F"), fixed(noise.G, "G"), lead)
            F.append(Phi)
            Q.append(cov)
        b = moves.b
        if b is not None:
            b = np.concatenate([b, np.zeros((*b.shape[:-1], self.dimension() - b.shape[-1]))], axis=-1)
        return Step(block_diagonal(*F), block_diagonal(*Q), b)


class Treatment(NamedTuple):
    """How coloured noise is filtered: the way, the dimension filtered in every mode, and why."""

    way: Literal["white", "differencing", "augmentation"]
    dimension: int
    reason: str


def coloured_sensors(model: HybridModel) -> dict[str, ColouredSensor]:
    """The sensors of a model whose noise is coloured."""
    return {name: sensor for name, sensor in model.sensors.items() if isinstance(sensor, ColouredSensor)}


def treatment(model: HybridModel, sensors: Iterable[str] | None = None) -> Treatment:
    """Decide how records of these sensors are filtered, and say why.

    Args:
        model: any model.
        sensors: names of the sensors that occur in the records; absent means all.
    """
    names = list(model.sensors) if sensors is None else sorted(set(sensors))
    coloured = coloured_sensors(model)
    n, used = model.n_state, [name for name in names if name in coloured]
    if not used:
        return Treatment("white", n, "no sensor has coloured noise")
    grown = n + sum(sensor.bound_noise().output.shape[1] for sensor in coloured.values())
    if len(names) > 1:
        return Treatment("augmentation", grown, f"{len(names)} sensors take turns, so most of what is known is old")
    sensor = coloured[used[0]]
    noise = sensor.bound_noise()
    (m, p), H = noise.output.shape, fixed(sensor.H, "H")
    if noise.white is not None:
        return Treatment("augmentation", grown, f"sensor {used[0]!r} has a white part: no measurement is known exactly")
    offset = np.zeros(m) if sensor.d is None else fixed(sensor.d, "d")
    if any(size > 1 for size in (*H.shape[:-2], *offset.shape[:-1])):
        return Treatment("augmentation", grown, f"H or d of sensor {used[0]!r} depends on chains")
    if np.linalg.matrix_rank(noise.output) < m:
        return Treatment("augmentation", grown, f"some component of sensor {used[0]!r} has no noise of its own")
    return Treatment("differencing", n + p - m, "one sensor, no white part, one H for all modes")


def augmented(model: HybridModel) -> HybridModel:
    """The same model with the coloured noises in its state and white noise only; itself if there are none.

    a = (x, u1, u2, ...) with one u per sensor with coloured noise, in the order of the sensors. Where a sensor has no
    white part its R is 0.

    Raises:
        ModelError: a sensor is nonlinear or depends on t, or the motion depends on t.
    """
    coloured = coloured_sensors(model)
    if not coloured:
        return model
    noises = [sensor.bound_noise() for sensor in coloured.values()]
    ends = np.cumsum([model.n_state, *(noise.output.shape[1] for noise in noises)])
    place = {name: slice(a, b) for name, a, b in zip(coloured, ends[:-1], ends[1:], strict=True)}
    sensors = {name: _widened(name, sensor, int(ends[-1]), place.get(name)) for name, sensor in model.sensors.items()}
    mean, cov = fixed(model.prior.mean, "mean"), fixed(model.prior.cov, "cov")
    mean = np.concatenate([mean, np.zeros((*mean.shape[:-1], int(ends[-1]) - model.n_state))], axis=-1)
    cov = block_diagonal(cov, *(fixed(noise.cov0, "cov0") for noise in noises))
    dynamics = NoisyDynamics(model.dynamics, tuple(noises))
    return HybridModel(model.chains, dynamics, sensors, Gaussian(mean, cov, model.prior.time))


def _widened(name: str, sensor: object, n: int, place: slice | None) -> LinearSensor:
    """A linear sensor of the augmented state."""
    if isinstance(sensor, ColouredSensor):
        noise = sensor.bound_noise()
        L = noise.output
        R: Matrix = np.zeros((len(L), len(L))) if noise.white is None else noise.white
    elif isinstance(sensor, LinearSensor):
        L, R = np.zeros((0, 0)), sensor.R
    else:
        raise ModelError(f"sensor {name!r} is nonlinear; beside coloured noise every sensor must be linear.")
    if isinstance(sensor.H, TimeDependent):
        raise ModelError(f"sensor {name!r} depends on t; beside coloured noise none may.")
    H = fixed(sensor.H, "H")
    wide = np.zeros((*H.shape[:-1], n))
    wide[..., : H.shape[-1]] = H
    if place is not None:
        wide[..., place] = L
    return LinearSensor(wide, R, sensor.d, sensor.prob_detection)
