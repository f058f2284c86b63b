"""Second echoes: tracks of one radar that are one object, and which of them says where it is.

The nose and the tail of an airliner on a taxiway, or its reflection in a façade, make two tracks of a surface radar.
They are told by going the same way at the same time, close together; of what stands still side by side nothing can be
told.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.identify import LocalTracks, thinned
from saltus.tracks.encounters import SystemTracks
from saltus.tracks.membership import Segments

__all__ = ["Spell", "echo_rows", "second_echoes"]

_MOVING = 2.0  # m/s
_APART = 4.0  # s between reports that count


class Spell(NamedTuple):
    """A time in which a local track is the second echo of an object."""

    track: int  # numbered through all systems
    time_from: float  # s
    time_to: float  # s


def echo_rows(view: SystemTracks, *, own: bool) -> LocalTracks:
    """Return the rows of a radar by which its tracks may be found to be one object: those made in motion.

    Other systems tell targets apart by their transponders: none of theirs.

    Args:
        view: rows of a system.
        own: whether they are measurements.
    """
    moving = np.isfinite(view.ray[:, 0]) & (np.hypot(view.velocity[:, 0], view.velocity[:, 1]) > _MOVING) & own
    return thinned(LocalTracks(*(column[moving] for column in view.tracks)), _APART)


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
