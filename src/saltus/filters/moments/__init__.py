"""The moment filter of switching diffusions: moments between measurements, a closure, Bayes' rule."""

from saltus.filters.moments.adaptive import Adapt
from saltus.filters.moments.estimators import (
    edgeworth_median,
    edgeworth_mode,
    paper_mode,
    pearson_mode,
    unconditional,
)
from saltus.filters.moments.filter import MomentFilter
from saltus.filters.moments.history import Diagnostics, MomentHistory
from saltus.filters.moments.mixture import GaussianSumFilter
from saltus.filters.moments.observed import SeenSwitch
from saltus.filters.moments.posterior import MomentPosterior
from saltus.filters.moments.stationary import Stationary, stationary_moments

__all__ = [
    "Adapt",
    "Diagnostics",
    "GaussianSumFilter",
    "MomentFilter",
    "MomentHistory",
    "MomentPosterior",
    "SeenSwitch",
    "Stationary",
    "edgeworth_median",
    "edgeworth_mode",
    "paper_mode",
    "pearson_mode",
    "stationary_moments",
    "unconditional",
]
