"""Conditions of sensors: what a jammed, biased, deaf or blind sensor does to its measurement, as states of chains.

    jam = Chain("jam", {"ok": OK, "jammed": Condition(noise=10.0), "lost": lost(span=[9e4, 6.3])},
                sojourn={"ok": 600.0, "jammed": 20.0, "lost": 20.0})
    sensors = {"radar": FaultySensor(radar, ["jam"]),           # all components of one sensor
               "camera": FaultySensor(camera, {"jam": [0]})}    # the same chain: one component of another

A sensor may depend on any number of such chains, and each sensor or component may have its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.models.chain import Chain
from saltus.models.checks import FloatArray, numbers, same
from saltus.models.dependence import TimeDependent, fixed
from saltus.models.observer import Observer
from saltus.models.sensors import BoundSensor, LinearSensor, Sensor
from saltus.shapes import Float

__all__ = ["OK", "BoundFaultySensor", "Condition", "FaultySensor", "lost", "outliers"]


@dataclass(frozen=True, slots=True, eq=False)
class Condition:
    """What one state of a sensor does to its measurement z = h(x) + v.

    z = gain h(x) + bias + noise v,   or, where `spread` is given, bias + spread v0 with cov v0 = I: nothing of x.

    Several conditions at once (several chains on one component) multiply gains and noises and add biases; a spread
    overrules the others.

    Args:
        noise: factor on the standard deviation, > 0.
        gain: factor on the signal.
        bias: added, in the units of the measurement.
        spread: standard deviation of a measurement that carries nothing, > 0; see `lost`.

    Each is one number, or one per component the condition is applied to.

    Raises:
        ModelError: noise or spread not positive, a number not finite, or unequal lengths.
    """

    noise: npt.ArrayLike = 1.0
    gain: npt.ArrayLike = 1.0
    bias: npt.ArrayLike = 0.0
    spread: npt.ArrayLike | None = None

    def __post_init__(self) -> None:
        lengths: set[int] = set()
        for name in ("noise", "gain", "bias", "spread"):
            value = getattr(self, name)
            if value is None:
                continue
            array = numbers(value, f"Condition {name}")
            if array.ndim > 1:
                raise ModelError(f"Condition {name} must be a number or one per component, got shape {array.shape}.")
            if name in ("noise", "spread") and array.size and array.min() <= 0:
                raise ModelError(
                    f"Condition {name} must be positive, got {array.min():g}: no measurement is free of noise. "
                    "For one that carries nothing use lost()."
                )
            lengths.update(array.shape)
            object.__setattr__(self, name, array)
        if len(lengths) > 1:
            raise ModelError(f"Condition: arrays of different lengths {sorted(lengths)}; give one entry per component.")

    def __eq__(self, other: object) -> bool:
        return same(self, other)


OK = Condition()


def lost(span: npt.ArrayLike | None = None, centre: npt.ArrayLike = 0.0) -> Condition:
    """Return the condition in which a measurement carries nothing about the object.

    Args:
        span: width of the interval in which such measurements fall, per component, in its units. Their flat density
            is represented by its first two moments, centre and span / sqrt(12). Absent means that the sensor's own
            noise is all that is left: no signal, noise as it is.
        centre: middle of that interval.
    """
    if span is None:
        return Condition(gain=0.0, bias=centre)
    return Condition(gain=0.0, bias=centre, spread=numbers(span, "span") / np.sqrt(12.0))


def outliers(name: str, *, share: float, noise: float = 30.0, length: float | None = None) -> Chain:
    """Return a chain of single outliers, or of bursts of them.

    Args:
        name: of the chain; its states are "ok" and "outlier".
        share: of measurements that are outliers, in (0, 1).
        noise: factor on the standard deviation of an outlier.
        length: mean number of consecutive outliers, per step and for equal intervals only; absent means that each
            measurement is by itself: a chain without memory, good for any interval.

    Raises:
        ModelError: a share outside (0, 1), or bursts that short cannot make up the share.
    """
    if not 0 < share < 1:
        raise ModelError(f"outliers {name!r}: share must lie in (0, 1), got {share}.")
    states = {"ok": OK, "outlier": Condition(noise=noise)}
    if length is None:
        return Chain(name, states, trans=[[1 - share, share]] * 2)
    enter = share / (1 - share) / length if length >= 1 else np.inf
    if not enter <= 1:
        raise ModelError(
            f"outliers {name!r}: bursts of {length} measurement(s) cannot be {share:.0%} of all; "
            f"length must be at least {max(1.0, share / (1 - share)):.3g}."
        )
    return Chain(name, states, trans=[[1 - enter, enter], [1 / length, 1 - 1 / length]])


class _Effect(NamedTuple):
    """Joint conditions per mode and component: z = gain h(x) + bias + noise v + sqrt(extra) v0."""

    gain: FloatArray  # (M1|1, ..., MC|1, m)
    bias: FloatArray
    noise: FloatArray  # 0 where the sensor's own noise is overruled
    extra: FloatArray

    def covariance(self, R: FloatArray) -> FloatArray:
        """Noise covariance under the conditions."""
        scaled = self.noise[..., :, None] * R * self.noise[..., None, :]
        return np.asarray(scaled + self.extra[..., :, None] * np.eye(R.shape[-1]))


@dataclass(frozen=True, slots=True, eq=False)
class FaultySensor:
    """A sensor whose condition depends on chains whose values are `Condition`.

    By itself (`h`, `jacobian`, `residual`) it is the healthy sensor.

    Args:
        sensor: what it is when healthy: linear or not, itself depending on chains or not.
        chains: names of the chains, each for all components; or name -> the components it acts on (None: all).

    Raises:
        ModelError: a chain twice or, in a model, unknown, without conditions, or components that do not exist.
    """

    sensor: Sensor
    chains: Sequence[str] | Mapping[str, Sequence[int] | None]

    def __post_init__(self) -> None:
        names = [self.chains] if isinstance(self.chains, str) else list(self.chains)
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice or not names:
            raise ModelError(f"FaultySensor needs chains, each once; got {', '.join(names) or 'none'}.")
        places = self.chains if isinstance(self.chains, Mapping) else dict.fromkeys(names)
        kept = {name: None if at is None else tuple(int(i) for i in at) for name, at in places.items()}
        object.__setattr__(self, "chains", kept)

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    @property
    def prob_detection(self) -> float:
        """Probability that an object present is reported, in any condition."""
        return self.sensor.prob_detection

    def h(self, x: npt.ArrayLike) -> Float[np.ndarray, "*lead m"]:
        """Expected measurement of the healthy sensor."""
        return self.sensor.h(x)

    def jacobian(self, x: npt.ArrayLike) -> Float[np.ndarray, "*lead m n"]:
        """Derivative of h."""
        return self.sensor.jacobian(x)

    def residual(self, z: npt.ArrayLike, z_pred: npt.ArrayLike) -> Float[np.ndarray, "*lead m"]:
        """Difference of measurements."""
        return self.sensor.residual(z, z_pred)

    def bind(self, chains: Sequence[Chain], n_state: int) -> BoundSensor:
        """Arrays with one mode axis per chain: a LinearSensor when the healthy one is linear and has no `t`."""
        healthy = self.sensor.bind(chains, n_state)
        places = self.chains if isinstance(self.chains, Mapping) else dict.fromkeys(self.chains)
        m = healthy.at(0.0).noise().shape[-1]
        faulty = BoundFaultySensor(healthy, _effects(places, chains, m))
        timed = isinstance(healthy, LinearSensor) and any(
            isinstance(value, TimeDependent) for value in (healthy.H, healthy.R, healthy.d)
        )
        return faulty.at(0.0) if isinstance(healthy, LinearSensor) and not timed else faulty


@dataclass(frozen=True, slots=True, eq=False)
class BoundFaultySensor:
    """A faulty sensor of one model, with mode axes; made by `FaultySensor.bind`."""

    sensor: BoundSensor
    effect: _Effect

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    @property
    def prob_detection(self) -> float:
        """Probability that an object present is reported."""
        return self.sensor.prob_detection

    def h(self, x: npt.ArrayLike) -> Float[np.ndarray, "*lead m"]:
        """What is measured on average, gain times signal plus bias, in states (..., M1|1, ..., MC|1, n)."""
        return np.asarray(self.effect.gain * self.sensor.h(x) + self.effect.bias)

    def jacobian(self, x: npt.ArrayLike) -> Float[np.ndarray, "*lead m n"]:
        """Derivative of h."""
        return np.asarray(self.effect.gain[..., None] * self.sensor.jacobian(x))

    def residual(self, z: npt.ArrayLike, z_pred: npt.ArrayLike) -> Float[np.ndarray, "*lead m"]:
        """Difference of measurements, as the healthy sensor takes it."""
        return self.sensor.residual(z, z_pred)

    def bind(self, chains: Sequence[Chain], n_state: int) -> "BoundFaultySensor":
        """Return itself: it is bound."""
        del chains, n_state
        return self

    def at(self, t: float, observer: Observer | None = None) -> BoundSensor:
        """The sensor at a time, seen from `observer` if one is given."""
        now = self.sensor.at(t, observer)
        if not isinstance(now, LinearSensor):
            return replace(self, sensor=now)
        gain, bias = self.effect.gain, self.effect.bias
        d = None if now.d is None and not bias.any() else bias
        if now.d is not None:
            d = np.asarray(gain * fixed(now.d, "d") + bias)
        H = np.asarray(gain[..., None] * fixed(now.H, "H"))
        return LinearSensor(H, self.effect.covariance(now.noise()), d, now.prob_detection)

    def noise(self) -> FloatArray:
        """Noise covariance, (M1|1, ..., MC|1, m, m)."""
        return self.effect.covariance(self.sensor.noise())


def _effects(places: Mapping[str, Sequence[int] | None], chains: Sequence[Chain], m: int) -> _Effect:
    known = {chain.name: chain for chain in chains}
    for name, at in places.items():
        if name not in known:
            raise ModelError(
                f"FaultySensor depends on {name!r}, which is no chain of this model. Chains: {', '.join(known)}."
            )
        for label, value in zip(known[name].labels, known[name].values, strict=True):
            if not isinstance(value, Condition):
                raise ModelError(
                    f"chain {name!r}: state {label!r} has the value {value!r}, which is no Condition.\n"
                    "Write {'ok': OK, 'jammed': Condition(noise=10.0), ...}."
                )
        if at is not None and (len(set(at)) < len(at) or not all(0 <= i < m for i in at)):
            raise ModelError(
                f"chain {name!r} acts on components {list(at)}, but the sensor measures {m}, counted from 0."
            )
    used = [chain for chain in chains if chain.name in places]
    axes = tuple(len(chain) if chain.name in places else 1 for chain in chains)
    rows = [_joint(used, index, places, m) for index in np.ndindex(*(len(chain) for chain in used))]
    return _Effect(*(np.stack(part).reshape(*axes, m) for part in zip(*rows, strict=True)))


def _joint(
    used: Sequence[Chain], index: tuple[int, ...], places: Mapping[str, Sequence[int] | None], m: int
) -> _Effect:
    """Conditions of several chains together, for one joint state: (m,) each."""
    gain, bias, noise, extra, centre = np.ones(m), np.zeros(m), np.ones(m), np.zeros(m), np.zeros(m)
    for chain, i in zip(used, index, strict=True):
        one, at = chain.values[i], places[chain.name]
        if not isinstance(one, Condition):
            raise TypeError("checked before")
        where = list(range(m) if at is None else at)
        for value in (one.noise, one.gain, one.bias, one.spread):
            if value is not None and np.shape(value) not in ((), (len(where),)):
                raise ModelError(
                    f"chain {chain.name!r}, state {chain.labels[i]!r}: the condition has {np.shape(value)[0]} entries, "
                    f"but acts on {len(where)} component(s)."
                )
        gain[where] *= np.asarray(one.gain)
        noise[where] *= np.asarray(one.noise)
        if one.spread is None:
            bias[where] += np.asarray(one.bias)
        else:
            extra[where] = np.maximum(extra[where], np.square(one.spread))
            centre[where] = np.asarray(one.bias)
    blind = extra > 0
    return _Effect(
        np.where(blind, 0.0, gain), np.where(blind, centre, bias), np.where(blind, 0.0, noise), np.asarray(extra)
    )
