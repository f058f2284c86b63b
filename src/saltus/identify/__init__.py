"""Whether two systems report the same object: likelihood ratios, error probabilities and decisions, on arrays."""

from saltus.identify.decide import (
    Decided,
    Decider,
    Decisions,
    DecisionSettings,
    Episodes,
    decide_pairs,
    joined_episodes,
)
from saltus.identify.evidence import (
    APART,
    Evidence,
    as_evidence,
    join_evidence,
    latest_ratios,
    pair_evidence,
    window_start,
)
from saltus.identify.groups import Conflict
from saltus.identify.local import thinned
from saltus.identify.matched import PairDraws, Schedule, different_pairs, same_pairs, wide_spreads
from saltus.identify.neyman import FalseRatios, false_ratios, filled
from saltus.identify.pairs import LocalTracks, PairSettings, Ratios, candidate_pairs, pair_ratios
from saltus.identify.ratio import RatioTerms, identification_llr, identification_terms
from saltus.identify.static import p_correct, p_false, separation, threshold
from saltus.identify.tracklets import doubled, track_updates, tracklets
from saltus.identify.verdict import (
    DIFFERENT,
    SAME,
    UNDECIDED,
    Verdict,
    neyman_pearson_bound,
    posterior,
    same_object,
    sprt,
    sprt_bounds,
)

__all__ = [
    "APART",
    "DIFFERENT",
    "SAME",
    "UNDECIDED",
    "Conflict",
    "Decided",
    "Decider",
    "DecisionSettings",
    "Decisions",
    "Episodes",
    "Evidence",
    "FalseRatios",
    "LocalTracks",
    "PairDraws",
    "PairSettings",
    "RatioTerms",
    "Ratios",
    "Schedule",
    "Verdict",
    "as_evidence",
    "candidate_pairs",
    "decide_pairs",
    "different_pairs",
    "doubled",
    "false_ratios",
    "filled",
    "identification_llr",
    "identification_terms",
    "join_evidence",
    "joined_episodes",
    "latest_ratios",
    "neyman_pearson_bound",
    "p_correct",
    "p_false",
    "pair_evidence",
    "pair_ratios",
    "posterior",
    "same_object",
    "same_pairs",
    "separation",
    "sprt",
    "sprt_bounds",
    "thinned",
    "threshold",
    "track_updates",
    "tracklets",
    "wide_spreads",
    "window_start",
]
