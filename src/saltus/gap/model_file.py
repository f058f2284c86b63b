"""A model in TOML, and what to simulate of it.

title = "a target that turns, a radar that is jammed"
interval = 4.0                          # s between measurements
steps = 60                              # measurements of one run

[[chain]]
name = "manoeuvre"
states = {cruise = 0.3, turn = 8.0}     # label = value, or a list of labels; a table is a condition of a sensor
sojourn = {cruise = 120.0, turn = 20.0} # or stay =, trans =, rates =, per =, initial =: see saltus.Chain

[[chain]]
name = "radar"
states = {ok = {}, jammed = {noise = 10.0}}
sojourn = {ok = 300.0, jammed = 30.0}

[dynamics]
kind = "constant_velocity"              # or constant_acceleration, singer, linear (F, G, drift), transition (F, Q, b)
dims = 2
accel = {by = {manoeuvre = {cruise = 0.3, turn = 8.0}}}
accel_time = 4.0                        # s that an acceleration lasts; or law = "white" or "scan", without a time

[sensor.radar]
kind = "position"                       # or linear (H, R, d), polar (sigma_range, sigma_azimuth, ...)
dims = 2
sigma = 30.0
faults = ["radar"]                      # chains of conditions; or {chain = [components]}

[prior]
mean = [0.0, 200.0, 0.0, 0.0]
sd = [100.0, 50.0, 100.0, 50.0]         # or cov

[judge]                                 # which states together make one figure; by default by their order
position = [0, 2]
"""

import difflib
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from saltus.errors import ModelError, SaltusError
from saltus.models import (
    Chain,
    Condition,
    FaultySensor,
    Gaussian,
    HybridModel,
    LinearSDE,
    LinearSensor,
    LinearTransition,
    PolarSensor,
    PositionSensor,
    constant_acceleration,
    constant_velocity,
    singer,
)
from saltus.models.checks import FloatArray, numbers
from saltus.text import brief
from saltus.toml import load_toml

__all__ = ["Scenario", "load_scenario"]

_DYNAMICS: dict[str, tuple[Callable[..., Any], tuple[str, ...], tuple[str, ...]]] = {
    # kind: builder, needed keys, further keys
    "constant_velocity": (
        lambda law="lasting", **v: constant_velocity(kind=law, **v),
        ("dims", "accel"),
        ("law", "accel_time"),
    ),
    "constant_acceleration": (constant_acceleration, ("dims", "jerk"), ()),
    "singer": (singer, ("dims", "tau", "sigma"), ()),
    "linear": (LinearSDE, ("F", "G"), ("drift",)),
    "transition": (LinearTransition, ("F", "Q"), ("b",)),
}
_SENSORS: dict[str, tuple[Callable[..., Any], tuple[str, ...], tuple[str, ...]]] = {
    "position": (PositionSensor, ("dims", "sigma"), ()),
    "linear": (LinearSensor, ("H", "R"), ("d",)),
    "polar": (
        PolarSensor,
        (),
        ("sigma_range", "sigma_azimuth", "sigma_elevation", "sigma_range_rate", "dims", "axes", "velocities", "offset"),
    ),
}
_SECTIONS = {
    "dynamics": '[dynamics] with kind = "constant_velocity", dims = 2 and accel = 1.0, or another kind',
    "sensor": '[sensor.NAME] with kind = "position", dims = 2 and sigma = 30.0, or another kind',
    "prior": "[prior] with mean = [...] and sd = [...], one number per state, or cov = [[...], ...]",
}
_OF_CHAINS = "trans|stay|sojourn|rates|per|initial"
_ORDERS = {"constant_velocity": ("position", "velocity")}
_MOST_STEPS = 100_000  # of one run: longer runs tell no more about a filter
_THREE = ("position", "velocity", "acceleration")


@dataclass(frozen=True, slots=True)
class Scenario:
    """A model, and what is simulated and judged of it.

    Attributes:
        model: the model.
        interval: between measurements, s.
        steps: measurements of one run.
        judge: states that together make one figure, by name; empty: every state by itself.
        title: for people.
    """

    model: HybridModel
    interval: float = 1.0
    steps: int = 50
    judge: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    title: str = ""

    def __post_init__(self) -> None:
        if not 0 < self.interval < np.inf or not 2 <= self.steps <= _MOST_STEPS:
            raise ModelError(
                f"interval must be positive seconds and steps from 2 to {_MOST_STEPS}, "
                f"got {self.interval}, {self.steps}."
            )
        for name, at in self.judge.items():
            if not at or any(not 0 <= i < self.model.n_state for i in at):
                raise ModelError(
                    f"judge {name!r} names the states {list(at)}, but there are {self.model.n_state}, counted from 0."
                )


def load_scenario(path: Path | str) -> Scenario:
    """Read a model file; the module's heading shows one.

    Raises:
        ModelError: the file is no TOML, a key is unknown or missing, or the model cannot be; the message names file
            and key.
    """
    content = load_toml(path)
    try:
        return _scenario(content)
    except (SaltusError, TypeError, ValueError) as error:
        raise ModelError(f"{path}: {error}") from error


def _scenario(content: dict[str, Any]) -> Scenario:
    known = ("title", "interval", "steps", "chain", "dynamics", "sensor", "prior", "judge")
    table = _table(content, "the file", (), known)
    for section, example in _SECTIONS.items():
        if section not in table:
            raise ModelError(f"the table [{section}] is missing: write {example}.")
    chains = [_chain(c, f"[[chain]] number {i + 1}") for i, c in enumerate(_list(table.get("chain", []), "chain"))]
    sensors = {name: _sensor(s, f"[sensor.{name}]") for name, s in _table(table["sensor"], "[sensor]").items()}
    dynamics = dict(_table(table["dynamics"], "[dynamics]"))
    kind = dynamics.get("kind")
    model = HybridModel(chains, _made(dynamics, "[dynamics]", _DYNAMICS), sensors, _prior(table["prior"]))
    judge = {name: tuple(_list(at, f"judge.{name}")) for name, at in _table(table.get("judge", {}), "[judge]").items()}
    if not judge and kind in ("constant_velocity", "constant_acceleration", "singer"):
        names = _ORDERS.get(kind, _THREE)
        judge = {name: tuple(range(i, model.n_state, len(names))) for i, name in enumerate(names)}
    return Scenario(
        model,
        _number(table.get("interval", 1.0), "interval", "seconds between measurements"),
        int(_number(table.get("steps", 50), "steps", "a number of measurements")),
        judge,
        str(table.get("title", "")),
    )


def _chain(value: object, where: str) -> Chain:
    keys = ("name", "states", "trans", "stay", "per", "sojourn", "rates", "initial")
    table = dict(_table(value, where, ("name", "states"), keys))
    states = table.pop("states")
    if isinstance(states, Mapping):
        states = {label: Condition(**v) if isinstance(v, Mapping) else v for label, v in states.items()}
    try:
        return Chain(table.pop("name"), states, **table)
    except (SaltusError, TypeError, ValueError) as error:
        raise ModelError(f"{where}: {_as_toml(str(error))}") from error


def _as_toml(said: str) -> str:
    """Turn a chain's arguments, as Python writes them, into keys of its table."""
    keys = re.sub(rf"\b({_OF_CHAINS})=(?=[\s,.;)]|$)", r"'\1'", said)
    return re.sub(rf"\b({_OF_CHAINS})=", r"\1 = ", keys).replace("{label: ", "{label = ")


def _sensor(value: object, where: str) -> Any:
    table = dict(_table(value, where))
    faults = table.pop("faults", None)
    sensor = _made(table, where, _SENSORS)
    return sensor if faults is None else FaultySensor(sensor, faults)


def _made(
    table: dict[str, Any], where: str, kinds: Mapping[str, tuple[Callable[..., Any], tuple[str, ...], tuple[str, ...]]]
) -> Any:
    kind = table.pop("kind", None)
    if kind not in kinds:
        raise ModelError(f"{where}: kind = {brief(kind)}: give one of {', '.join(kinds)}.")
    build, needed, further = kinds[kind]
    values = {
        name: tuple(value) if name in ("axes", "velocities") else value
        for name, value in _table(table, where, needed, (*needed, *further)).items()
    }
    try:
        return build(**values)
    except (SaltusError, TypeError, ValueError) as error:
        raise ModelError(f"{where}: {error}") from error


def _prior(value: object) -> Gaussian:
    table = _table(value, "[prior]", ("mean",), ("mean", "sd", "cov"))
    if ("sd" in table) == ("cov" in table):
        raise ModelError("[prior]: give either sd = [...], one per state, or cov = [[...], ...].")
    return Gaussian(table["mean"], np.diag(np.square(_deviations(table["sd"]))) if "sd" in table else table["cov"])


def _deviations(value: object) -> FloatArray:
    sd = numbers(value, "[prior]: sd")
    if sd.ndim != 1 or sd.min(initial=0.0) < 0:
        raise ModelError(f"[prior]: sd = {brief(value)}: give standard deviations, one per state, none negative.")
    return sd


def _table(
    value: object, where: str, needed: Iterable[str] = (), known: Iterable[str] | None = None
) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ModelError(f"{where} must be a table of keys, got {brief(value)}.")
    names = None if known is None else list(known)
    for key in value:
        if names is not None and key not in names:
            near = difflib.get_close_matches(key, names, n=1)
            hint = f"Did you mean {near[0]}?" if near else f"Known are: {', '.join(names)}."
            raise ModelError(f"{where}: unknown key {brief(key)}. {hint}")
    for key in needed:
        if key not in value:
            raise ModelError(f"{where}: the key {key!r} is missing.")
    return value


def _list(value: object, what: str) -> list[Any]:
    if not isinstance(value, list):
        raise ModelError(f"{what} must be a list, got {brief(value)}.")
    return value


def _number(value: object, what: str, meaning: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ModelError(f"{what} = {brief(value)}: give {meaning}.")
    return float(value)
