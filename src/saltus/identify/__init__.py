"""Whether two systems report the same object: likelihood ratios, error probabilities and decisions, on arrays."""

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
    "RatioTerms",
    "Verdict",
    "identification_llr",
    "identification_terms",
    "neyman_pearson_bound",
    "p_correct",
    "p_false",
    "posterior",
    "same_object",
    "separation",
    "sprt",
    "sprt_bounds",
    "threshold",
]
