"""State estimation and tracking for systems that jump."""

from importlib import import_module
from typing import Any

# Lazy (PEP 562): the program's --version and --help need none of the numerics.
_EXPORTS = {
    "Chain": "saltus.models",
    "DataError": "saltus.errors",
    "DiffusionSensor": "saltus.models",
    "Estimates": "saltus.filters",
    "ExactFilter": "saltus.filters",
    "Gaussian": "saltus.models",
    "GridFilter": "saltus.filters",
    "HybridModel": "saltus.models",
    "IMM": "saltus.filters",
    "LinearSDE": "saltus.models",
    "ParticleFilter": "saltus.filters",
    "PositionSensor": "saltus.models",
    "Record": "saltus.filters",
    "coloured_filter": "saltus.filters",
    "SwitchingSDE": "saltus.models",
    "constant_acceleration": "saltus.models",
    "constant_velocity": "saltus.models",
    "decide": "saltus.decisions",
    "exact_filter": "saltus.filters",
    "identification_llr": "saltus.identify",
    "optimality_gap": "saltus.gap",
    "p_correct": "saltus.identify",
    "p_false": "saltus.identify",
    "singer": "saltus.models",
    "LinearSensor": "saltus.models",
    "ModelError": "saltus.errors",
    "MomentFilter": "saltus.filters",
    "NumericalError": "saltus.errors",
    "SaltusError": "saltus.errors",
    "Session": "saltus.engine",
    "discretise": "saltus.models",
    "imm_filter": "saltus.filters",
    "imm_smoother": "saltus.filters",
    "spherical_to_cartesian": "saltus.geo",
    "threshold": "saltus.identify",
}

__all__ = sorted(_EXPORTS)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("saltus")
    if name in _EXPORTS:
        return getattr(import_module(_EXPORTS[name]), name)
    raise AttributeError(f"module 'saltus' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
