"""How good an answer is: errors of estimates, distances between sets, scores of tracks."""

from saltus.metrics.estimation import Consistency, Interval, consistency, mean_over_runs, nees, nis, rmse
from saltus.metrics.sets import GOSPA, OSPA, gospa, ospa
from saltus.metrics.tracking import FalseTracks, TrackScores, false_tracks, track_scores

__all__ = [
    "GOSPA",
    "OSPA",
    "Consistency",
    "FalseTracks",
    "Interval",
    "TrackScores",
    "consistency",
    "false_tracks",
    "gospa",
    "mean_over_runs",
    "nees",
    "nis",
    "ospa",
    "rmse",
    "track_scores",
]
