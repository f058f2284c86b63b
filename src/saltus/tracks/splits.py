"""Second echoes: tracks of one radar that are one object, and which of them says where it is.

The nose and the tail of an airliner on a taxiway, or its reflection in a façade, make two tracks of a surface radar.
They are told by going the same way at the same time, close together; of what stands still side by side nothing can be
told.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.identify import Evidence, LocalTracks, pair_evidence
from saltus.tracks.local import LocalSystem
from saltus.tracks.membership import Segments
from saltus.tracks.settings import FilterSettings, SystemsSettings
from saltus.tracks.systems import pairing_settings

__all__ = ["Spell", "second_echoes", "split_evidence"]

_MOVING = 2.0  # m/s
_APART = 4.0  # s between reports that count
_REACH = 5.0  # standard deviations of the distance between echoes


class Spell(NamedTuple):
    """A time in which a local track is the second echo of an object."""

    track: int  # numbered through all systems
    time_from: float  # s
    time_to: float  # s


def split_evidence(system: LocalSystem, settings: SystemsSettings, filters: FilterSettings) -> Evidence | None:
    """Return the evidence that tracks of one radar are one object, from the reports made in motion; None without any.

    Args:
        system: a radar with several local tracks; other systems tell targets apart by their transponders.
        settings: the distance between echoes to expect.
        filters: how objects move.
    """
    view = system.view
    moving = np.isfinite(view.ray[:, 0]) & (np.hypot(view.velocity[:, 0], view.velocity[:, 1]) > _MOVING)
    if not system.own or not moving.any():
        return None
    rows = LocalTracks(*(column[moving] for column in view.tracks))
    last = np.ones(len(rows.time), bool)
    last[:-1] = (np.diff(np.floor(rows.time / _APART)) != 0) | (np.diff(rows.track) != 0)
    ids, number = np.unique(rows.track[last], return_inverse=True)
    rows = LocalTracks(number, rows.time[last], rows.z[last], rows.R[last])
    pairing = pairing_settings([system], settings, filters, settings.split_offset)
    reach = _REACH * settings.split_offset
    found = pair_evidence(rows, rows, pairing, reach=reach, window=0.5 * settings.window)
    return found._replace(pairs=ids[found.pairs])


def second_echoes(segments: Segments, system: npt.NDArray[np.int64]) -> list[Spell]:
    """Return when a system track had two local tracks of one system: the one that joined it later is the second echo.

    Args:
        segments: to which system track each local track belongs, and when.
        system: of each local track, (K,).
    """
    order = np.lexsort((segments.time_from, system[segments.track], segments.system_track))
    found = []
    for place, i in enumerate(order.tolist()):
        for j in order[place + 1 :].tolist():
            same = segments.system_track[i] == segments.system_track[j]
            if not same or system[segments.track[i]] != system[segments.track[j]]:
                break
            if segments.track[i] != segments.track[j] and segments.time_from[j] < segments.time_to[i]:
                until = min(segments.time_to[i], segments.time_to[j])
                found.append(Spell(int(segments.track[j]), float(segments.time_from[j]), float(until)))
    return found
