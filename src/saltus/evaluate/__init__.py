"""How good an answer is: one truth, one matching; errors of estimates, distances between sets, scores of tracks."""

from saltus.evaluate.estimation import Consistency, Interval, consistency, mean_over_runs, nees, nis, rmse
from saltus.evaluate.labels import FalseTracks, TrackScores, false_tracks, track_scores
from saltus.evaluate.matching import Matches, Tracks, match
from saltus.evaluate.reference import Reference
from saltus.evaluate.scores import target_scores
from saltus.evaluate.sets import GOSPA, OSPA, gospa, ospa

__all__ = [
    "GOSPA",
    "OSPA",
    "Consistency",
    "FalseTracks",
    "Interval",
    "Matches",
    "Reference",
    "TrackScores",
    "Tracks",
    "consistency",
    "false_tracks",
    "gospa",
    "match",
    "mean_over_runs",
    "nees",
    "nis",
    "ospa",
    "rmse",
    "target_scores",
    "track_scores",
]
