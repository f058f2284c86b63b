"""Whether two systems report the same object: likelihood ratios, error probabilities and decisions, on arrays."""

from saltus.identify.decide import Decisions, DecisionSettings, Episodes, decide_pairs
from saltus.identify.evidence import APART, Evidence, as_evidence, join_evidence, pair_evidence
from saltus.identify.groups import Conflict
from saltus.identify.pairs import LocalTracks, PairSettings, Ratios, candidate_pairs, pair_ratios
from saltus.identify.ratio import RatioTerms, identification_llr, identification_terms
from saltus.identify.static import p_correct, p_false, separation, threshold
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
    "DecisionSettings",
    "Decisions",
    "Episodes",
    "Evidence",
    "LocalTracks",
    "PairSettings",
    "RatioTerms",
    "Ratios",
    "Verdict",
    "as_evidence",
    "candidate_pairs",
    "decide_pairs",
    "identification_llr",
    "identification_terms",
    "join_evidence",
    "neyman_pearson_bound",
    "p_correct",
    "p_false",
    "pair_evidence",
    "pair_ratios",
    "posterior",
    "same_object",
    "separation",
    "sprt",
    "sprt_bounds",
    "threshold",
]
