"""All systems in one frame: each registered by way of the one it shares most objects with."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.identify import PairSettings
from saltus.tracks.bias import effects, second_order, spread, steps
from saltus.tracks.encounters import SystemTracks
from saltus.tracks.local import LocalSystem
from saltus.tracks.registration import Comparison, Registration, RegistrationSettings, Series
from saltus.tracks.settings import FilterSettings, SystemsSettings

__all__ = [
    "Frames",
    "Region",
    "Registered",
    "lasting_difference",
    "lasting_differences",
    "order_of_trust",
    "pairing_settings",
    "short_difference",
]

_Array = npt.NDArray[np.float64]


class Registered(NamedTuple):
    """How one system was registered."""

    name: str
    to: str  # the reference, whose frame the biases are against; "" for the reference
    found: Registration | None  # None for the reference
    by: str = ""  # the system it was compared with, itself in that frame already


class Frames:
    """The frames of all systems as known from time to time, each put into that of the reference.

    A system is compared with every one that comes before it in the order of trust, itself corrected by what was known
    at the times of its reports, and registered by way of the one with which it has most objects in common by then.
    """

    def __init__(
        self, names: Sequence[str], order: Sequence[int], speed: float, expected: RegistrationSettings
    ) -> None:
        """Begin with nothing known.

        Args:
            names: of the systems.
            order: their numbers, the reference first, the most trusted next.
            speed: standard deviation of each component of an object's velocity, m/s.
            expected: biases.
        """
        self._pairing, self._expected = PairSettings(speed_sigma=speed), expected
        self._names, self._order = list(names), list(order)
        self._compared: dict[tuple[int, int], Comparison] = {}
        self._series: dict[int, Series] = {}
        self._by: dict[int, int] = {}
        self._known: dict[int, Registration] = {}
        for at, k in enumerate(order[1:], start=1):
            self._begin(k, order[:at])

    def _begin(self, k: int, partners: Sequence[int]) -> None:
        self._compared |= {(k, j): Comparison(self._pairing, self._expected) for j in partners}
        self._series[k], self._by[k] = Series(self._expected.prior), self._order[0]
        self._known[k] = self._series[k].registration()

    def add(self, name: str) -> None:
        """Take in a system that appears later, less trusted than all before."""
        self._begin(len(self._names), self._order)
        self._order.append(len(self._names))
        self._names.append(name)

    def update(self, now: float, views: Sequence[SystemTracks]) -> None:
        """Estimate all biases anew from the latest rows of all systems, as reported."""
        for at, k in enumerate(self._order[1:], start=1):
            partners = self._order[:at]
            fits = {j: self._compared[k, j].update(now, views[k], self.moved(j, views[j])) for j in partners}
            best = max(partners, key=lambda j: fits[j].objects)
            self._by[k] = best
            self._series[k].append(now, fits[best], self._compared[k, best].excess())
            self._known[k] = self._series[k].registration()

    def moved(self, k: int, view: SystemTracks) -> SystemTracks:
        """Take the biases known at their times out of rows, and widen them by what is uncertain of these."""
        if k not in self._known:
            return view
        mean, cov = self._known[k].series.at(view.tracks.time)
        effect = effects(view.ray, view.velocity)
        z = view.tracks.z - np.einsum("nij,nj->ni", effect, second_order(mean))
        return view._replace(tracks=view.tracks._replace(z=z, R=view.tracks.R + spread(effect, cov)))

    def registered(self) -> list[Registered]:
        """Return how each system is registered."""
        reference = self._names[self._order[0]]
        return [
            Registered(name, reference, self._known[k], self._names[self._by[k]])
            if k in self._known
            else Registered(name, "", None)
            for k, name in enumerate(self._names)
        ]


def order_of_trust(systems: Sequence[LocalSystem], reference: str) -> list[int]:
    """Return the numbers of systems: the reference, if one is named, then the most trusted first."""
    return sorted(range(len(systems)), key=lambda k: (systems[k].name != reference, *_trust(systems[k])))


def _trust(system: LocalSystem) -> tuple[bool, bool, float]:
    """Rank systems, the most trusted first: one without tracks knows nothing, a radar has a north of its own."""
    return not len(system.ids), bool(np.isfinite(system.view.ray).any()), system.noise


class Region:
    """Where a system has seen objects, as sums over its rows so far."""

    def __init__(self) -> None:
        """Begin with nothing seen."""
        self._sums = np.zeros((3, 3))  # of (1, x, y) times itself

    def add(self, z: _Array) -> None:
        """Take rows (n, 2)."""
        one = np.column_stack([np.ones(len(z)), z])
        self._sums = self._sums + one.T @ one

    def law(self) -> tuple[_Array, _Array] | None:
        """Return mean (2,) and covariance (2, 2) of the positions; None of fewer than three."""
        n = self._sums[0, 0]
        if n < 3:
            return None
        mean = self._sums[0, 1:] / n
        return mean, (self._sums[1:, 1:] - n * np.outer(mean, mean)) / (n - 1.0)


def pairing_settings(
    regions: Sequence[Region], settings: SystemsSettings, filters: FilterSettings, lasting: float
) -> PairSettings:
    """What is assumed of objects: they move as tracks do, and are where the narrowest system sees any.

    Turns and the hardest acceleration are one level of acceleration here, that lasts as long as one of each.

    Args:
        regions: where each of the systems compared has seen objects.
        settings: speeds, and how long differences last.
        filters: the filters of tracks.
        lasting: standard deviation of the difference between systems, m.
    """
    seen = [law for law in (region.law() for region in regions) if law is not None]
    mean, cov = min(seen, key=lambda law: float(np.linalg.det(law[1])), default=(np.zeros(2), 1e8 * np.eye(2)))
    *stays, last = filters.sojourn_h
    turns = filters.turn_sojourn if stays and filters.turn_rate else 0.0
    return PairSettings(
        accel=filters.accel_h,
        sojourn=(*stays, last + turns),
        accel_time=filters.accel_time or PairSettings().accel_time,
        offset_cov=lasting**2 * np.eye(2),
        offset_time=settings.offset_time,
        region_mean=mean,
        region_cov=cov + 1e4 * np.eye(2),
        speed_sigma=settings.speed,
    )


def lasting_difference(a: Registered, b: Registered) -> float:
    """Standard deviation of what lasts between the positions that two systems give of one object, as known last, m."""
    parts = [
        r.found.series.scatter[-1] ** 2 + np.nan_to_num(r.found.excess_sd) ** 2
        for r in (a, b)
        if r.found is not None and len(r.found.series.time)
    ]
    return float(np.sqrt(sum(parts)))


def lasting_differences(registered: Sequence[Registered], time: _Array) -> _Array:
    """Return the greatest `lasting_difference` of any two systems as known at given times, (n,), m."""
    squares = []
    for r in registered:
        if r.found is None:
            squares.append(np.zeros(len(time)))
        else:
            s = r.found.series
            squares.append(steps(s.time, s.scatter**2 + np.nan_to_num(s.excess) ** 2, time))
    largest = np.sort(np.stack([np.zeros(len(time)), *squares]), axis=0)[-2:]
    return np.asarray(np.sqrt(largest.sum(axis=0)))


def short_difference(a: Registered, b: Registered) -> float:
    """Standard deviation of what two systems' positions of one object differ by beyond that, m."""
    parts = [r.found.excess_sd**2 for r in (a, b) if r.found is not None and np.isfinite(r.found.excess_sd)]
    return float(np.sqrt(sum(parts)))
