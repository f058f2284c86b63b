"""What we believe: the recursion, the batch filter and the bank of tracks."""

from saltus.filters.bank import Bank
from saltus.filters.coloured import augmented_filter, coloured_filter
from saltus.filters.estimates import Estimates
from saltus.filters.exact import ExactFilter, exact_filter
from saltus.filters.grid import GridDensity, GridFilter
from saltus.filters.histories import EXACT, GPB1, GPB2, INTERACTING, MergingRule
from saltus.filters.imm import imm_filter
from saltus.filters.moments import Adapt, GaussianSumFilter, MomentFilter
from saltus.filters.particle import BoundParticleFilter, ParticleFilter
from saltus.filters.rao_blackwell import particle_filter
from saltus.filters.run import IMM, Record
from saltus.filters.smoother import imm_smoother
from saltus.filters.steps import Belief

__all__ = [
    "EXACT",
    "GPB1",
    "GPB2",
    "IMM",
    "INTERACTING",
    "Adapt",
    "Bank",
    "Belief",
    "BoundParticleFilter",
    "Estimates",
    "ExactFilter",
    "GaussianSumFilter",
    "GridDensity",
    "GridFilter",
    "MergingRule",
    "MomentFilter",
    "ParticleFilter",
    "Record",
    "augmented_filter",
    "coloured_filter",
    "exact_filter",
    "imm_filter",
    "imm_smoother",
    "particle_filter",
]
