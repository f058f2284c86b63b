"""The stretch of a recording that is used: --from and --to."""

from dataclasses import replace

import numpy as np

from saltus.records import REASONS, Plots
from saltus.times import time_window

__all__ = ["windowed"]

_OUTSIDE = REASONS.index("outside time window")


def windowed(plots: Plots, time_from: str | None, time_to: str | None) -> Plots:
    """Mark the reports outside of the times given, whatever else is wrong with them.

    Raises:
        DataError: a time cannot be read, or no report lies between them.
    """
    usable = (plots.reason == 0) & np.isfinite(plots.time)
    if not usable.any():
        return plots
    first, last = time_window(time_from, time_to, float(plots.time[usable].min()), float(plots.time[usable].max()))
    early = plots.time < (-np.inf if time_from is None else first)
    late = plots.time > (np.inf if time_to is None else last)
    return replace(plots, reason=np.where(early | late, _OUTSIDE, plots.reason).astype(np.int8))
