"""A setup as words and arrays, for checkpoints; nothing is lost."""

import json
from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from saltus.config import Config
from saltus.engine.setup import SensorSetup, Setup
from saltus.geo import Plane, Site
from saltus.records import Source, System, Traits
from saltus.tracks.background import Background
from saltus.tracks.measurements import Noise
from saltus.tracks.noise import NoiseEstimate

__all__ = ["config_from", "sensor_words", "setup_from", "setup_state", "source_from", "source_words"]


def source_words(source: Source) -> dict[str, Any]:
    """Return a source as words."""
    return asdict(source)


def source_from(words: Mapping[str, Any]) -> Source:
    """Return the source that `source_words` wrote."""
    return Source(**{**words, "system": System(**words["system"]), "traits": Traits(**words["traits"])})


def setup_state(setup: Setup) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a setup's arrays and its words."""
    words = {
        "config": setup.config.model_dump(mode="json"),
        "use_identity": setup.use_identity,
        "time": setup.time,
        "plane": [setup.plane.latitude, setup.plane.longitude],
        "sensors": [sensor_words(s) for s in setup.sensors],
        "order": list(setup.order),
    }
    arrays = {str(k): _background_arrays(s.background) for k, s in enumerate(setup.sensors)}
    return arrays, words


def setup_from(arrays: Mapping[str, Any], words: Mapping[str, Any]) -> Setup:
    """Return the setup that `setup_state` made these of."""
    return Setup(
        config=config_from(words["config"]),
        use_identity=bool(words["use_identity"]),
        time=float(words["time"]),
        plane=Plane(*words["plane"]),
        sensors=tuple(_sensor(w, arrays[str(k)]) for k, w in enumerate(words["sensors"])),
        order=tuple(words["order"]),
    )


def config_from(words: Mapping[str, Any]) -> Config:
    """Return the configuration that `Config.model_dump` wrote as words."""
    return Config.model_validate_json(json.dumps(words))


def sensor_words(sensor: SensorSetup) -> dict[str, Any]:
    """Return a sensor as words, without its background."""
    plain = {f.name: getattr(sensor, f.name) for f in fields(sensor)}
    del plain["background"]
    site = None if sensor.site is None else asdict(sensor.site)
    return plain | {
        "source": source_words(sensor.source),
        "site": site,
        "given": dict(sensor.given),
        "noise": asdict(sensor.noise),
        "estimate": sensor.estimate._asdict(),
    }


def _sensor(words: Mapping[str, Any], arrays: Mapping[str, Any]) -> SensorSetup:
    return SensorSetup(
        **{
            **words,
            "source": source_from(words["source"]),
            "site": None if words["site"] is None else Site(**words["site"]),
            "noise": Noise(**words["noise"]),
            "estimate": NoiseEstimate(**words["estimate"]),
            "background": _background(arrays),
        }
    )


def _background_arrays(background: Background) -> dict[str, Any]:
    return {f.name: np.asarray(getattr(background, f.name)) for f in fields(background)}


def _background(arrays: Mapping[str, Any]) -> Background:
    columns = {f.name: np.array(arrays[f.name]) for f in fields(Background) if f.name != "even"}
    return Background(even=float(arrays["even"]), **columns)
