"""Whether two systems report the same object: likelihood ratios, error probabilities and decisions, on arrays."""

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
    "DIFFERENT",
    "SAME",
    "UNDECIDED",
    "LocalTracks",
    "PairSettings",
    "RatioTerms",
    "Ratios",
    "Verdict",
    "candidate_pairs",
    "identification_llr",
    "identification_terms",
    "neyman_pearson_bound",
    "p_correct",
    "p_false",
    "pair_ratios",
    "posterior",
    "same_object",
    "separation",
    "sprt",
    "sprt_bounds",
    "threshold",
]
