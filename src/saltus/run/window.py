"""The stretch of a recording that is used: --from and --to."""

from dataclasses import dataclass, replace

import numpy as np

from saltus.records import REASONS, Recording
from saltus.times import time_window

__all__ = ["Window"]

_OUTSIDE = REASONS.index("outside time window")


@dataclass(frozen=True, slots=True)
class Window:
    """Times used, s, UTC; infinite where there is no bound."""

    first: float = -np.inf
    last: float = np.inf

    @classmethod
    def told(cls, time_from: str | None, time_to: str | None, span: tuple[float, float]) -> "Window":
        """Read --from and --to against the span of the recording, s, UTC; NaN: nothing in it tells its time.

        Raises:
            DataError: a time cannot be read, or lies outside the recording.
        """
        if not np.isfinite(span).all():
            return cls()
        first, last = time_window(time_from, time_to, *span)
        return cls(-np.inf if time_from is None else first, np.inf if time_to is None else last)

    def marked(self, recording: Recording) -> Recording:
        """Mark the reports outside, whatever else is wrong with them."""
        plots = recording.plots
        outside = (plots.time < self.first) | (plots.time > self.last)
        reason = np.where(outside, _OUTSIDE, plots.reason).astype(np.int8)
        return replace(recording, plots=replace(plots, reason=reason))
