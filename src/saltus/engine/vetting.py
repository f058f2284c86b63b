"""Whether a setup that was learnt before is one for the reports that come."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from saltus.engine.setup import Setup
from saltus.errors import DataError
from saltus.records import Plots

__all__ = ["Vetting"]

_Array = npt.NDArray[np.float64]

_EARTH = 6.371e6  # m
_LEARN = "Learn one from these reports with saltus setup."


class Vetting:
    """Judges by the first usable reports (`SetupSettings.vetted`), whatever the pieces in which they come."""

    def __init__(self, state: Mapping[str, Any] | None = None) -> None:
        """Begin without a report, or go on from what `state` gave."""
        state = state or {}
        self._source = np.array(state.get("source", np.zeros(0)), np.int64)
        self._place = np.array(state.get("place", np.zeros((0, 2))), np.float64)

    def fits(self, setup: Setup, plots: Plots, *, last: bool) -> bool:
        """Take usable reports; say whether enough have come to tell that the setup fits, and it does.

        Args:
            setup: learnt before.
            plots: reports, whose sources are numbered as in the setup, and behind it.
            last: whether no more will come: then those so far must do.

        Raises:
            DataError: none of the reports' sources is in the setup, or they lie elsewhere.
        """
        wanted = setup.config.setup.vetted
        place = np.column_stack([plots.latitude, plots.longitude])
        self._source = np.concatenate([self._source, plots.source])[:wanted]
        self._place = np.concatenate([self._place, place])[:wanted]
        if len(self._source) < (1 if last else wanted):
            return last
        known = [s.source.system for s in setup.sensors]
        found = np.unique(self._source)
        if found[0] >= len(known):
            of, here = (
                ", ".join(map(str, names)) for names in (known, (plots.sources[k].system for k in found.tolist()))
            )
            raise DataError(f"the setup is one of other sources: of {of}; the reports are of {here}. {_LEARN}")
        self._refuse_elsewhere(setup, found)
        return True

    def _refuse_elsewhere(self, setup: Setup, found: npt.NDArray[np.int64]) -> None:
        heard = [setup.sensors[k].site for k in found[found < len(setup.sensors)].tolist()]
        sites = np.array([(s.latitude, s.longitude) for s in heard if s is not None]).reshape(-1, 2)
        places = np.concatenate([self._place[np.isfinite(self._place).all(axis=1)], sites])
        if not len(places):
            return
        there = np.median(_directions(places), axis=0)
        middle = _directions(np.array([[setup.plane.latitude, setup.plane.longitude]]))[0]
        away = _EARTH * float(np.arctan2(np.linalg.norm(np.cross(there, middle)), there @ middle))
        if away > setup.config.setup.far:
            raise DataError(f"the setup is one of another place, {away / 1000:.0f} km from the reports. {_LEARN}")

    def state(self) -> dict[str, Any]:
        """Return what another one goes on from."""
        return {"source": self._source, "place": self._place}


def _directions(place: _Array) -> _Array:
    """Return unit vectors (n, 3) of places (n, 2) on a sphere."""
    latitude, longitude = place.T
    c = np.cos(latitude)
    return np.column_stack([c * np.cos(longitude), c * np.sin(longitude), np.sin(latitude)])
