"""What the world is: chains, motion, sensors and priors, as descriptions that compile to arrays."""

from dataclasses import is_dataclass

from saltus.models import coloured, nonlinear, polar, sensors
from saltus.models.arrays import Arrays, Layout
from saltus.models.augment import Treatment, augmented, treatment
from saltus.models.chain import Chain
from saltus.models.coloured import ColouredSensor
from saltus.models.conditions import OK, Condition, FaultySensor, lost, outliers
from saltus.models.diffusion import SwitchingSDE
from saltus.models.diffusion_sensor import DiffusionSensor
from saltus.models.drawing import diagram
from saltus.models.dynamics import Dynamics, LinearSDE, LinearTransition, Step
from saltus.models.exponential import discretise, exponential
from saltus.models.findings import Finding
from saltus.models.gaussian import Gaussian
from saltus.models.hybrid import HybridModel
from saltus.models.lowering import as_diffusion, as_diffusion_sensor
from saltus.models.motion import Motion, constant_acceleration, constant_velocity, singer
from saltus.models.noise import MarkovNoise, first_order, second_order
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
    "ColouredSensor",
    "Condition",
    "DiffusionSensor",
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
    "MarkovNoise",
    "Motion",
    "Observer",
    "PolarSensor",
    "PositionSensor",
    "Sensor",
    "Step",
    "SwitchingSDE",
    "Treatment",
    "as_diffusion",
    "as_diffusion_sensor",
    "augmented",
    "constant_acceleration",
    "constant_velocity",
    "diagram",
    "discretise",
    "exponential",
    "first_order",
    "lost",
    "outliers",
    "second_order",
    "singer",
    "treatment",
]

# Every sensor: the dataclasses that the modules of sensors offer.
SENSORS = {
    name: getattr(module, name)
    for module in (sensors, polar, nonlinear, coloured)
    for name in module.__all__
    if is_dataclass(getattr(module, name))
}
