"""A setup as a TOML file that `--config` reads: the configuration, and under `[learnt]` what was learnt from reports.

What the configuration says goes before what was learnt, so noise, periods and sites may be edited in its tables.
"""

import base64
import dataclasses
import zlib
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
import tomli_w
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from saltus.config import Config
from saltus.engine.setup import SensorSetup, Setup, given_noise, site_of
from saltus.engine.stored import sensor_words
from saltus.errors import ModelError
from saltus.geo import Plane
from saltus.records import Kind, Source
from saltus.text import brief
from saltus.toml import LARGEST
from saltus.tracks.background import Background
from saltus.tracks.measurements import Noise
from saltus.tracks.noise import NoiseEstimate

__all__ = ["saved_setup", "setup_toml"]

_VERSION = 1
_FORMS = {"cell": "<i8", "near": "<f8", "known": "<f8", "layer": "<i8", "count": "<f8"}  # arrays of a Background
_MOST = 1 << 27  # bytes of one array
_KINDS = {"polar": Kind.POLAR, "plane": Kind.PLANE, "bearing": Kind.BEARING}
_OF_CONFIG = ("name", "system", "site", "given")  # of a sensor: what the configuration says, and is asked anew


def _sane(noise: Noise) -> Noise:
    """Refuse deviations that cannot be."""
    for f in dataclasses.fields(noise):
        value = getattr(noise, f.name)
        if f.name == "lasting_distance" and value == np.inf:
            continue
        if not (0.0 <= value if f.name in ("time", "lasting") else 0.0 < value) or not np.isfinite(value):
            raise ValueError(f"{f.name} = {value} is no standard deviation")
    return noise


_Seconds = Annotated[float, Field(gt=0.0, le=3600.0)]


class _Map(BaseModel):
    model_config = ConfigDict(extra="forbid")

    even: Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
    cell: str
    near: str
    known: str
    layer: str
    count: str


class _Sensor(BaseModel):
    model_config = ConfigDict(extra="forbid")

    source: Source
    told_period: _Seconds | None = None
    period: _Seconds
    wait: _Seconds
    kind: Literal["polar", "plane", "bearing"]
    elevations: bool
    range_rates: bool = False
    heard: bool
    noise: Annotated[Noise, AfterValidator(_sane)]
    estimate: NoiseEstimate
    background: _Map


class _Learnt(BaseModel):
    model_config = ConfigDict(extra="forbid")

    version: Literal[1]
    time: Annotated[float, Field(allow_inf_nan=False)]
    plane: tuple[float, float]
    order: list[str] = []
    sensor: Annotated[list[_Sensor], Field(min_length=1)]


def setup_toml(setup: Setup, files: Sequence[str]) -> str:
    """Return a setup as the text of a file that `--config` reads.

    The date of the recording is left out: the file is for others.

    Args:
        setup: learnt.
        files: names of those from which it was.

    Raises:
        ModelError: the text would be longer than a configuration may be.
    """
    config = setup.config.model_dump(mode="python", exclude_defaults=True, exclude={"date", "learnt"})
    learnt = {
        "version": _VERSION,
        "time": setup.time,
        "plane": [setup.plane.latitude, setup.plane.longitude],
        "order": list(setup.order),
        "sensor": [_sensor_table(s) for s in setup.sensors],
    }
    said = f"# Learnt by saltus setup from {', '.join(files)}; give it to saltus track with --config.\n"
    said += "# Noise, periods and sites may be set in [[sensor]] tables: these go before what stands under [learnt],\n"
    said += "# where lengths are in m, angles in rad, times in s.\n\n"
    sensors = "".join(f"\n[[sensor]]\n{tomli_w.dumps(_without_none(s))}" for s in config.pop("sensor", ()))
    text = (
        said + tomli_w.dumps(_without_none(config)) + sensors + "\n" + tomli_w.dumps(_without_none({"learnt": learnt}))
    )
    if len(text) > LARGEST:
        raise ModelError(
            f"the setup takes {len(text)} bytes and a configuration {LARGEST}: learn it from a shorter stretch "
            "([setup] seconds)."
        )
    return text


def _sensor_table(sensor: SensorSetup) -> dict[str, Any]:
    words = {name: value for name, value in sensor_words(sensor).items() if name not in _OF_CONFIG}
    told = None if np.isnan(sensor.told_period) else sensor.told_period
    del words["appeared"]
    background = {name: _text(getattr(sensor.background, name), form) for name, form in _FORMS.items()}
    even = sensor.background.even
    return words | {
        "told_period": told,
        "kind": next(name for name, kind in _KINDS.items() if kind == sensor.kind),
        "background": {"even": float(even), **background},
    }


def saved_setup(config: Config, *, use_identity: bool) -> Setup | None:
    """Return the setup that a configuration holds, None where it holds none.

    Raises:
        ModelError: what stands under [learnt] is no setup; the message names file and key.
    """
    if config.learnt is None:
        return None
    where, table = config.learnt
    config = config.model_copy(update={"learnt": None})
    try:
        learnt = _Learnt.model_validate(table)
        plane, sensors = Plane(*learnt.plane), tuple(_sensor(s, config) for s in learnt.sensor)
    except ValidationError as error:
        finding = error.errors(include_url=False)[0]
        key = ".".join(str(1 + k) if isinstance(k, int) else k for k in finding["loc"])
        raise ModelError(f"{where}: [learnt] {key} = {brief(finding['input'])}: {finding['msg']}. {_CURE}") from error
    except (ValueError, ModelError) as error:
        raise ModelError(f"{where}: [learnt] {error}. {_CURE}") from error
    return Setup(config, use_identity, learnt.time, plane, sensors, tuple(learnt.order))


_CURE = "Write the file anew with saltus setup."


def _sensor(learnt: _Sensor, config: Config) -> SensorSetup:
    """Make a sensor of what was learnt; what the configuration says goes before."""
    source, background = learnt.source, _background(learnt.background)
    sensor = config.site_for(source.system)
    set_period = None if sensor is None else sensor.period
    told = set_period or learnt.told_period
    period = set_period or learnt.period
    given = given_noise(sensor, source, _KINDS[learnt.kind], config.lasting.own_share)
    return SensorSetup(
        source=source,
        name=sensor.name if sensor is not None and sensor.name else str(source.system),
        system="" if sensor is None else sensor.system,
        site=site_of(sensor),
        given=given,
        told_period=float("nan") if told is None else told,
        period=period,
        wait=learnt.wait if set_period is None else max(period, source.traits.rest_period),
        kind=_KINDS[learnt.kind],
        elevations=learnt.elevations,
        range_rates=learnt.range_rates,
        heard=learnt.heard,
        noise=dataclasses.replace(learnt.noise, **given),
        estimate=learnt.estimate,
        background=background,
    )


def _background(table: _Map) -> Background:
    arrays = {name: _array(name, getattr(table, name), form) for name, form in _FORMS.items()}
    for names, *values in (("cell", "near", "known"), ("layer", "count")):
        if not (np.diff(arrays[names]) > 0).all() or any(len(arrays[v]) != len(arrays[names]) for v in values):
            raise ValueError(f"background: {names} and {' and '.join(values)} do not fit together")
    for name in ("near", "known", "count"):
        if not (np.isfinite(arrays[name]) & (arrays[name] >= 0.0)).all():
            raise ValueError(f"background: {name} holds no densities and counts")
    return Background(even=table.even, **arrays)


def _text(values: npt.NDArray[Any], form: str) -> str:
    return base64.b64encode(zlib.compress(np.asarray(values, form).tobytes(), 9)).decode()


def _array(name: str, text: str, form: str) -> npt.NDArray[Any]:
    """Return an array that `_text` wrote."""
    try:
        unpacked = zlib.decompressobj()
        content = unpacked.decompress(base64.b64decode(text, validate=True), _MOST)
        if not unpacked.eof or len(content) % 8:
            raise ValueError("it ends early, or is too long")
    except (ValueError, zlib.error) as error:
        raise ValueError(f"background.{name}: {error}") from error
    return np.frombuffer(content, form).astype(form[1:])


def _without_none(tree: Any) -> Any:
    """Return a tree without what TOML has no word for."""
    if isinstance(tree, Mapping):
        return {str(k): _without_none(v) for k, v in tree.items() if v is not None}
    return [_without_none(v) for v in tree] if isinstance(tree, list | tuple) else tree
