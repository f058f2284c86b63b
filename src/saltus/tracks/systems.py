"""All systems in one frame: each registered by way of the one it shares most objects with."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.identify import PairSettings
from saltus.tracks.bias import effects, second_order, spread
from saltus.tracks.local import LocalSystem
from saltus.tracks.registration import Registration, RegistrationSettings, register
from saltus.tracks.settings import FilterSettings, SystemsSettings

__all__ = ["Registered", "lasting_difference", "pairing_settings", "register_all", "short_difference"]

_Array = npt.NDArray[np.float64]


class Registered(NamedTuple):
    """How one system was registered."""

    name: str
    to: str  # the reference, whose frame the biases are against; "" for the reference
    found: Registration | None  # None for the reference
    by: str = ""  # the system it was compared with, itself in that frame already


def register_all(
    systems: Sequence[LocalSystem], settings: SystemsSettings, expected: RegistrationSettings
) -> tuple[list[LocalSystem], list[Registered]]:
    """Put every system into the frame of the reference, each by way of the system it shares most with.

    Returns:
        The systems with registered positions, covariances widened by what is still uncertain of their biases, and how
        each was registered, in the order of `systems`.

    Raises:
        ModelError: the reference is none of the systems.
    """
    names = [s.name for s in systems]
    if settings.reference and settings.reference not in names:
        raise ModelError(f"systems.reference = {settings.reference!r} names none of the systems: {', '.join(names)}.")
    pairing = PairSettings(speed_sigma=settings.speed)
    order = sorted(range(len(systems)), key=lambda k: (systems[k].name != settings.reference, *_trust(systems[k])))
    done = {order[0]: systems[order[0]]}
    how = {order[0]: Registered(systems[order[0]].name, "", None)}
    for k in order[1:]:
        tried = {j: register(systems[k].view, done[j].view, pairing, expected) for j in done}
        best = max(tried, key=lambda j: int(tried[j].series.objects[-1]) if len(tried[j].series.time) else -1)
        how[k] = Registered(systems[k].name, systems[order[0]].name, tried[best], systems[best].name)
        done[k] = _moved(systems[k], tried[best])
    return [done[k] for k in range(len(systems))], [how[k] for k in range(len(systems))]


def _trust(system: LocalSystem) -> tuple[bool, bool, float]:
    """Rank systems, the most trusted first: one without tracks knows nothing, a radar has a north of its own."""
    return not len(system.ids), bool(np.isfinite(system.view.ray).any()), system.noise


def _moved(system: LocalSystem, found: Registration) -> LocalSystem:
    """Take the biases out of local tracks."""
    tracks = system.view.tracks
    mean, cov = found.series.at(tracks.time)
    effect = effects(system.view.ray, system.view.velocity)
    z = tracks.z - np.einsum("nij,nj->ni", effect, second_order(mean))
    view = system.view._replace(tracks=tracks._replace(z=z, R=tracks.R + spread(effect, cov)))
    return system._replace(view=view)


def pairing_settings(
    systems: Sequence[LocalSystem], settings: SystemsSettings, filters: FilterSettings, lasting: float
) -> PairSettings:
    """What is assumed of objects: they move as tracks do, and are where the narrowest system sees any.

    Turns and the hardest acceleration are one level of acceleration here, that lasts as long as one of each.

    Args:
        systems: those compared.
        settings: speeds, and how long differences last.
        filters: the filters of tracks.
        lasting: standard deviation of the difference between systems, m.
    """
    seen = [s.view.tracks.z for s in systems if len(s.view.tracks.z) > 2]
    z = min(seen, key=lambda z: float(np.linalg.det(np.cov(z.T)))) if seen else np.zeros((0, 2))
    cov = np.cov(z.T) if len(z) else 1e8 * np.eye(2)
    *stays, last = filters.sojourn_h
    turns = filters.turn_sojourn if stays and filters.turn_rate else 0.0
    return PairSettings(
        accel=filters.accel_h,
        sojourn=(*stays, last + turns),
        accel_time=filters.accel_time or PairSettings().accel_time,
        offset_cov=lasting**2 * np.eye(2),
        offset_time=settings.offset_time,
        region_mean=z.mean(axis=0) if len(z) else np.zeros(2),
        region_cov=cov + 1e4 * np.eye(2),
        speed_sigma=settings.speed,
    )


def lasting_difference(a: Registered, b: Registered) -> float:
    """Standard deviation of what lasts between the positions that two systems give of one object, m."""
    parts = [
        r.found.series.scatter[-1] ** 2 + r.found.excess_sd**2
        for r in (a, b)
        if r.found is not None and len(r.found.series.time)
    ]
    return float(np.sqrt(sum(parts)))


def short_difference(a: Registered, b: Registered) -> float:
    """Standard deviation of what two systems' positions of one object differ by beyond that, m."""
    parts = [r.found.excess_sd**2 for r in (a, b) if r.found is not None and np.isfinite(r.found.excess_sd)]
    return float(np.sqrt(sum(parts)))
