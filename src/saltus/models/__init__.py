"""What the world is: chains, motion, sensors and priors, as descriptions that compile to arrays."""

from dataclasses import is_dataclass

from saltus.models import nonlinear, polar, sensors
from saltus.models.arrays import Arrays, Layout
from saltus.models.chain import Chain
from saltus.models.conditions import OK, Condition, FaultySensor, lost, outliers
from saltus.models.dynamics import Dynamics, LinearSDE, LinearTransition, Step
from saltus.models.exponential import discretise, exponential
from saltus.models.findings import Finding
from saltus.models.gaussian import Gaussian
from saltus.models.hybrid import HybridModel
from saltus.models.motion import Motion, constant_acceleration, constant_velocity, singer
from saltus.models.nonlinear import FunctionSensor
from saltus.models.observer import Observer
from saltus.models.polar import PolarSensor
from saltus.models.sensors import BoundSensor, LinearSensor, PositionSensor, Sensor

__all__ = [
    "OK",
    "SENSORS",
    "Arrays",
    "BoundSensor",
    "Chain",
    "Condition",
    "Dynamics",
    "FaultySensor",
    "Finding",
    "FunctionSensor",
    "Gaussian",
    "HybridModel",
    "Layout",
    "LinearSDE",
    "LinearSensor",
    "LinearTransition",
    "Motion",
    "Observer",
    "PolarSensor",
    "PositionSensor",
    "Sensor",
    "Step",
    "constant_acceleration",
    "constant_velocity",
    "discretise",
    "exponential",
    "lost",
    "outliers",
    "singer",
]

# Every sensor: the dataclasses that the modules of sensors offer.
SENSORS = {
    name: getattr(module, name)
    for module in (sensors, polar, nonlinear)
    for name in module.__all__
    if is_dataclass(getattr(module, name))
}
