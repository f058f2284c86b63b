"""The grid filter of switching diffusions in one and two dimensions."""

from saltus.filters.grid.filter import GridDensity, GridFilter

__all__ = ["GridDensity", "GridFilter"]
