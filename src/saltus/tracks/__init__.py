"""Many objects: association, lifecycle, the tracker's loop, estimation of the sensors' noise."""

from typing import TYPE_CHECKING

from saltus.tracks.settings import FilterSettings, TrackerSettings

if TYPE_CHECKING:
    from saltus.tracks.tracker import Tracker

__all__ = ["FilterSettings", "Tracker", "TrackerSettings"]


def __getattr__(name: str) -> object:
    """Import the tracker when it is asked for: the settings alone, which the configuration needs, come at once."""
    if name == "Tracker":
        from saltus.tracks.tracker import Tracker

        return Tracker
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
