"""Many objects: association, lifecycle, the tracker's loop, estimation of the sensors' noise."""

from saltus.tracks.settings import FilterSettings, TrackerSettings
from saltus.tracks.tracker import Tracker

__all__ = ["FilterSettings", "Tracker", "TrackerSettings"]
