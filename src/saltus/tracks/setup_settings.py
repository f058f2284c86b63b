"""What a user may set of how reports are taken, and of what is learnt from the first of them."""

from dataclasses import dataclass

import numpy as np

from saltus.errors import ModelError
from saltus.tracks.settings import positive

__all__ = ["IntakeSettings", "LastingSettings", "PeriodSettings", "SetupSettings"]


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
        positive("setup", self, "seconds", "gap", "longest", "far")
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
        positive("intake", self, "wild")
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
        positive("periods", self, *self.__slots__)
        if not self.shortest < self.longest:
            raise ModelError(f"periods.shortest {self.shortest} s must be below periods.longest {self.longest} s.")
        if not (self.width < 1.0 and self.share <= 1.0):
            raise ModelError(f"periods.width and periods.share are shares of 1, got {self.width} and {self.share}.")


@dataclass(frozen=True, slots=True)
class LastingSettings:
    """How errors that last are estimated from the straight stretches of a source's own tracks.

    Attributes:
        time: correlation time that is assumed where the stretches do not contradict it, s.
        times: shorter ones that they may tell, s.
        scales: distances from the sensor at which lasting errors may be 1.4 times as large as there, m.
        gain: nats that lasting errors must explain more than white ones, or a larger scale more than a smaller one.
        gain_per_report: nats a report that they must explain more.
        contradicted: nats less than the best by which stretches contradict a time.
        straight: probability of a manoeuvre from which a track is not straight.
        margin: s around a manoeuvre that are left out.
        fewest: reports of a stretch, at least.
        longest: reports of a stretch, at most; what is longer is cut.
        gap: update periods, or s if these are shorter than one, without a report that end a stretch.
        moving: m/s: what moves slower repeats one rounded position.
        stretches: from so many on, or from `reports` reports on, something can be told.
        reports: see `stretches`.
        most: reports used; stretches are left out evenly where there are more.
        own_share: of a deviation configured as lasting (`correlation_time` without `sigma_lasting`), what each report
            errs by itself: reports without errors of their own would outweigh all others.
    """

    time: float = 60.0
    times: tuple[float, ...] = (35.0, 20.0, 12.0, 6.0, 3.5, 2.0)
    scales: tuple[float, ...] = (1e4, 3e3, 1e3, 3e2)
    gain: float = 10.0
    gain_per_report: float = 0.01
    contradicted: float = 2.5
    straight: float = 0.3
    margin: float = 8.0
    fewest: int = 20
    longest: int = 150
    gap: float = 2.5
    moving: float = 3.0
    stretches: int = 30
    reports: int = 1_000
    most: int = 2_500
    own_share: float = 0.2

    def __post_init__(self) -> None:
        """Refuse settings that cannot be."""
        positive("lasting", self, *(name for name in self.__slots__ if name not in ("times", "scales")))
        for name in ("times", "scales"):
            values = getattr(self, name)
            if not all(0.0 < value < np.inf for value in values):
                raise ModelError(f"lasting.{name} are positive and finite, got {values}.")
        if not all(value < self.time for value in self.times):
            raise ModelError(f"lasting.times are shorter than lasting.time, {self.time} s, got {self.times}.")
        if not (self.own_share < 1.0 and self.straight < 1.0):
            raise ModelError(
                f"lasting.own_share and lasting.straight are shares of 1, got {self.own_share} and {self.straight}."
            )
