"""A hybrid model as a switching diffusion: the joint states of its chains become modes."""

from collections.abc import Sequence
from types import EllipsisType

import numpy as np

from saltus.errors import ModelError
from saltus.linalg import block_diagonal
from saltus.models.checks import FloatArray
from saltus.models.dependence import fixed
from saltus.models.diffusion import Field, SwitchingSDE
from saltus.models.diffusion_sensor import DiffusionSensor
from saltus.models.dynamics import LinearSDE
from saltus.models.hybrid import HybridModel
from saltus.models.motion import Motion
from saltus.models.sensors import BoundSensor

__all__ = ["as_diffusion", "as_diffusion_sensor"]


def as_diffusion(model: HybridModel, sensor: str | Sequence[str] | None = None) -> tuple[SwitchingSDE, DiffusionSensor]:
    """Lower a hybrid model to a switching diffusion and its sensor, for the filters that take these.

    Modes are the joint states of the chains in C order: with sizes (2, 3), mode 4 is (1, 1). One chain switches at a
    time, at the rates of its generator, and the state is kept.

    Args:
        model: chains with rates, motion by a stochastic differential equation, sensors that do not depend on t.
        sensor: the sensor that measures, or several, stacked; by default all.

    Raises:
        ModelError: motion in discrete time, a chain without rates, or a sensor that depends on t or moves.
    """
    sizes = model.sizes
    sde = _sde(model)
    F, G = fixed(sde.F, "LinearSDE F"), fixed(sde.G, "LinearSDE G")
    offset = np.zeros(model.n_state) if sde.drift is None else fixed(sde.drift, "LinearSDE drift")
    modes = list(np.ndindex(sizes))
    drift = [_affine(_of_mode(F, m, 2), _of_mode(offset, m, 1)) for m in modes]
    probs = np.ones(())
    for chain in model.chains:
        probs = probs[..., None] * chain.law
    mean, cov = fixed(model.prior.mean, "Gaussian mean"), fixed(model.prior.cov, "Gaussian cov")
    lowered = SwitchingSDE(
        drift=drift,
        diffusion=[_of_mode(G, m, 2) for m in modes],
        intensity=_rates(model, modes),
        probs0=probs.reshape(-1),
        mean0=np.stack([_of_mode(mean, m, 1) for m in modes]),
        cov0=np.stack([_of_mode(cov, m, 2) for m in modes]),
    )
    return lowered, _sensor(model, sensor, modes)


def as_diffusion_sensor(model: HybridModel, sensor: str | Sequence[str] | None = None) -> DiffusionSensor:
    """The sensor part of `as_diffusion`, for any motion and any chains.

    Raises:
        ModelError: no such sensor, or one that depends on t or moves.
    """
    return _sensor(model, sensor, list(np.ndindex(model.sizes)))


def _sde(model: HybridModel) -> LinearSDE:
    if isinstance(model.dynamics, Motion):
        return model.dynamics.sde()
    if not isinstance(model.dynamics, LinearSDE):
        raise ModelError(
            f"{type(model.dynamics).__name__} moves in discrete time and has no stochastic differential equation.\n"
            "Describe the motion by LinearSDE, constant_acceleration, singer, or constant_velocity of another kind."
        )
    return model.dynamics


def _of_mode(array: FloatArray, mode: tuple[int, ...], n_core: int) -> FloatArray:
    """The matrix of one mode from an array with mode axes (M1|1, ..., MC|1, *core), or none of them."""
    axes = array.shape[: array.ndim - n_core]
    index = tuple(0 if size == 1 else i for size, i in zip(axes, mode[len(mode) - len(axes) :], strict=True))
    return np.asarray(array[index])


def _affine(F: FloatArray, offset: FloatArray) -> Field:
    def drift(x: FloatArray) -> FloatArray:
        return np.asarray(x @ F.T + offset)

    return drift


def _rates(model: HybridModel, modes: list[tuple[int, ...]]) -> dict[tuple[int, int], Field]:
    place = {mode: i for i, mode in enumerate(modes)}
    rates: dict[tuple[int, int], Field] = {}
    for c, chain in enumerate(model.chains):
        generator = chain.generator
        for mode in modes:
            for to in range(len(chain)):
                rate = float(generator[mode[c], to])
                if to != mode[c] and rate > 0:
                    rates[place[mode], place[(*mode[:c], to, *mode[c + 1 :])]] = rate
    return rates


def _sensor(model: HybridModel, chosen: str | Sequence[str] | None, modes: list[tuple[int, ...]]) -> DiffusionSensor:
    names = list(model.sensors) if chosen is None else [chosen] if isinstance(chosen, str) else list(chosen)
    parts = [_at(model, name) for name in names]
    x = np.asarray(fixed(model.prior.mean, "Gaussian mean"))
    sizes: list[int] = []
    angular: list[int] = []
    for part in parts:
        m = part.noise().shape[-1]
        z = part.h(x[(0,) * (x.ndim - 1)]).reshape(-1, m)[0]
        turned = part.residual(z + 2 * np.pi, z)
        angular += [sum(sizes) + int(i) for i in np.flatnonzero(np.abs(turned).reshape(-1, m)[0] < np.pi)]
        sizes.append(m)
    h: list[Field] = [_stacked(parts, mode) for mode in modes]
    R: list[Field] = [block_diagonal(*(_of_mode(part.noise(), mode, 2) for part in parts)) for mode in modes]
    return DiffusionSensor(h=h, R=R, angular=tuple(angular) or None)


def _at(model: HybridModel, name: str) -> BoundSensor:
    if name not in model.sensors:
        raise ModelError(f"the model has no sensor {name!r}. Sensors: {', '.join(model.sensors)}.")
    sensor = model.sensors[name]
    if not isinstance(sensor, BoundSensor):
        raise ModelError(
            f"sensor {name!r} ({type(sensor).__name__}) cannot be lowered: it has no h and R at one time.\n"
            "Where its noise is coloured, lower augmented(model)."
        )
    early, late = sensor.at(0.0), sensor.at(1.0)
    if early is not late:
        raise ModelError(f"sensor {name!r} depends on t; a switching diffusion's sensor may not.")
    return early


def _stacked(parts: list[BoundSensor], mode: tuple[int, ...]) -> Field:
    def h(x: FloatArray) -> FloatArray:
        lead = x.shape[:-1]
        spread = x.reshape(*lead, *(1,) * len(mode), x.shape[-1])  # mode axes broadcast against those of the sensor
        seen = []
        for part in parts:
            z = part.h(spread)
            index = tuple(0 if size == 1 else i for size, i in zip(z.shape[len(lead) : -1], mode, strict=True))
            own: tuple[EllipsisType | int | slice, ...] = (..., *index, slice(None))
            seen.append(z[own])
        return np.concatenate(seen, axis=-1)

    return h
