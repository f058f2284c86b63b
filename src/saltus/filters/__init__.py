"""What we believe: the recursion, the batch filter and the bank of tracks."""

from saltus.filters.bank import Bank
from saltus.filters.coloured import augmented_filter, coloured_filter
from saltus.filters.estimates import Estimates
from saltus.filters.grid import GridDensity, GridFilter
from saltus.filters.imm import imm_filter
from saltus.filters.run import IMM, Record
from saltus.filters.steps import Belief

__all__ = [
    "IMM",
    "Bank",
    "Belief",
    "Estimates",
    "GridDensity",
    "GridFilter",
    "Record",
    "augmented_filter",
    "coloured_filter",
    "imm_filter",
]
