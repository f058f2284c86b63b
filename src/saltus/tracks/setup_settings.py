"""What a user may set of how reports are taken, and of what is learnt from the first of them."""

from dataclasses import dataclass

import numpy as np

from saltus.errors import ModelError

__all__ = ["IntakeSettings", "PeriodSettings", "SetupSettings"]


@dataclass(frozen=True, slots=True)
class SetupSettings:
    """The first stretch of reports, from which noise, update periods and backgrounds are learnt.

    It ends when every source present gave `reports` of them, or after `seconds` if each gave `fewest`, and after
    `longest` times `seconds` at the latest. Of a gap in the data no more than `gap` counts. Then the stretch is
    tracked; until then nothing is published.

    Attributes:
        reports: of each source.
        seconds: of data.
        fewest: reports of each source from which something can be learnt.
        estimated: first reports of a source whose noise is configured, or that appeared later, from which its noise is
            estimated after the end, to be told.
        gap: longest time without a report that counts in full, s.
        longest: times `seconds` that the stretch lasts at most, where sources report seldom.
        vetted: usable reports by which a setup that was learnt before is judged.
        far: m from the middle of its plane to their place, from which it is a setup of another place.
    """

    reports: int = 5_000
    seconds: float = 600.0
    fewest: int = 500
    estimated: int = 100_000
    gap: float = 60.0
    longest: float = 6.0
    vetted: int = 1_000
    far: float = 1e6

    def __post_init__(self) -> None:
        """Refuse settings that cannot be."""
        for name in ("reports", "fewest", "estimated", "vetted"):
            if not getattr(self, name) >= 1:
                raise ModelError(f"setup.{name} is a number of reports, 1 or more, got {getattr(self, name)}.")
        for name in ("seconds", "gap", "longest", "far"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ModelError(f"setup.{name} must be positive and finite, got {getattr(self, name)}.")
        if self.longest < 1.0:
            raise ModelError(f"setup.longest is a number of times, 1 or more, got {self.longest}.")


@dataclass(frozen=True, slots=True)
class IntakeSettings:
    """When reports that come late, and clocks that leap, are refused.

    Attributes:
        hold: s that a report may come late; 0: reports come in order of time, and a gap is no leap of a clock.
        wild: s ahead of all before, from which a report is in doubt: its clock leapt, or there was a gap.
        for_good: reports of one source at the new time that make it the time.
    """

    hold: float = 2.0
    wild: float = 60.0
    for_good: int = 10

    def __post_init__(self) -> None:
        """Refuse settings that cannot be."""
        if not 0.0 <= self.hold < np.inf:
            raise ModelError(f"intake.hold is a time in s, 0 or more, got {self.hold}.")
        if not 0.0 < self.wild < np.inf:
            raise ModelError(f"intake.wild must be positive and finite, got {self.wild}.")
        if not self.for_good >= 1:
            raise ModelError(f"intake.for_good is a number of reports, 1 or more, got {self.for_good}.")


@dataclass(frozen=True, slots=True)
class PeriodSettings:
    """How update periods that nothing tells are learnt from positions without identity.

    Attributes:
        seeds: reports asked for followers, at most.
        pairs: pairs of reports looked at, some, at most.
        shortest: shortest period, s.
        longest: longest period, s.
        width: of a period: intervals that differ by less are one.
        accel: what bends a way, m/s^2.
        deviations: standard deviations within which a report lies where two others lead.
        fewest: targets' ways from which a period is told.
        share: of the most ways: a shorter interval with as many is the period, and not a part of it.
    """

    seeds: int = 600
    pairs: int = 60_000
    shortest: float = 0.1
    longest: float = 20.0
    width: float = 0.15
    accel: float = 3.0
    deviations: float = 3.0
    fewest: int = 8
    share: float = 0.5

    def __post_init__(self) -> None:
        """Refuse settings that cannot be."""
        for name in self.__slots__:
            if not 0.0 < getattr(self, name) < np.inf:
                raise ModelError(f"periods.{name} must be positive and finite, got {getattr(self, name)}.")
        if not self.shortest < self.longest:
            raise ModelError(f"periods.shortest {self.shortest} s must be below periods.longest {self.longest} s.")
        if not (self.width < 1.0 and self.share <= 1.0):
            raise ModelError(f"periods.width and periods.share are shares of 1, got {self.width} and {self.share}.")
