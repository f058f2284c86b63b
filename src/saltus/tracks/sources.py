"""What a tracker is told of its sources before it sees a report of theirs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from saltus.records import Kind
from saltus.tracks.background import Background, flat, learn_background
from saltus.tracks.colour import Colour
from saltus.tracks.measurements import Measurements
from saltus.tracks.slices import slice_width

__all__ = ["SourceSetup", "TrackerSetup", "learn_setup"]


@dataclass(frozen=True, slots=True, eq=False)
class SourceSetup:
    """One source."""

    period: float  # update period, s
    wait: float  # s between two reports of a target that it leaves waiting longest, before one counts as missed
    kind: int  # what it measures: `Kind.POLAR`, `Kind.PLANE` (any position) or `Kind.BEARING`
    background: Background
    colour: Colour


@dataclass(frozen=True, slots=True, eq=False)
class TrackerSetup:
    """All sources of one tracker, and how long its slices are."""

    sources: tuple[SourceSetup, ...]
    width: float  # s


def learn_setup(
    m: Measurements,
    periods: Sequence[float],
    waits: Sequence[float] | None = None,
    density: float | None = None,
    colours: Sequence[Colour] = (),
) -> TrackerSetup:
    """Learn from a stretch of measurements what a tracker is told.

    Args:
        m: the stretch; sources without a measurement in it make no slice shorter.
        periods: update period of each source, s.
        waits: see `SourceSetup`; the update periods if not given.
        density: of clutter and new targets per m^2 and scan, the same everywhere; None: estimated.
        colours: lasting errors of each source; none if not given.
    """
    sources = []
    for s, (period, wait) in enumerate(zip(periods, periods if waits is None else waits, strict=True)):
        kind = _kind(m, s)
        polar = kind == Kind.POLAR
        background = flat(density) if density is not None else learn_background(m, s, period, polar=polar)
        colour = colours[s] if colours else Colour()
        sources.append(SourceSetup(float(period), float(wait), kind, background, colour))
    used = [sources[s] for s in np.unique(m.source).tolist()]
    return TrackerSetup(tuple(sources), slice_width([s.period for s in used], [s.kind == Kind.POLAR for s in used]))


def _kind(m: Measurements, source: int) -> int:
    own = m.source == source
    placed = own & np.isfinite(m.position[:, 0])
    if not placed.any():
        return Kind.BEARING if own.any() else Kind.PLANE
    return Kind.POLAR if np.isfinite(m.ray[placed, 0]).all() else Kind.PLANE
