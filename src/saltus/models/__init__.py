"""What the world is: chains, motion, sensors and priors, as descriptions that compile to arrays."""

from saltus.models.arrays import Arrays, Layout
from saltus.models.chain import Chain
from saltus.models.dynamics import Dynamics, LinearSDE, LinearTransition, Step
from saltus.models.exponential import discretise, exponential
from saltus.models.findings import Finding
from saltus.models.gaussian import Gaussian
from saltus.models.hybrid import HybridModel
from saltus.models.motion import Motion, constant_acceleration, constant_velocity, singer
from saltus.models.sensors import SENSORS, LinearSensor, PositionSensor, Sensor

__all__ = [
    "SENSORS",
    "Arrays",
    "Chain",
    "Dynamics",
    "Finding",
    "Gaussian",
    "HybridModel",
    "Layout",
    "LinearSDE",
    "LinearSensor",
    "LinearTransition",
    "Motion",
    "PositionSensor",
    "Sensor",
    "Step",
    "constant_acceleration",
    "constant_velocity",
    "discretise",
    "exponential",
    "singer",
]
