"""The step that every track takes, whoever associates: what is wrong with a report, and the update by all of that."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.linalg import normalised
from saltus.tracks.faults import SourceCondition, weighty
from saltus.tracks.gates import Gated
from saltus.tracks.kinematics import Chosen, Kinematics

__all__ = ["Judged", "absorb", "judge"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]


class Judged(NamedTuple):
    """What is thought of reports after they were seen."""

    log_weights: _Array  # (k, h): log probabilities of their hypotheses before each was seen itself
    p: _Array  # (k, h): after
    wrong: _Array  # (k,): probability of a fault of the report's own
    fault: npt.NDArray[np.int8]  # (k,): the likeliest, 1 + component

    def take(self, which: npt.NDArray[np.bool_]) -> "Judged":
        """Return some of them."""
        return Judged(self.log_weights[which], self.p[which], self.wrong[which], self.fault[which])


def judge(source: SourceCondition, time: float, prior: _Array, log_f: _Array, voice: _Array) -> Judged:
    """Say what is wrong with reports of one source, and let them tell of it.

    Args:
        source: its condition.
        time: of the last report, s.
        prior: log probabilities of the conditions, (q,).
        log_f: log densities of the reports under each hypothesis, (k, h).
        voice: what each may say of the source, (k,).
    """
    weights = source.absorb(time, prior, log_f, voice)
    p = np.asarray(np.exp(normalised(weights + log_f, (1,))[0]))
    return Judged(weights, p, *source.law.faulty(p))


def absorb(kinematics: Kinematics, rows: _Index, gated: Gated, pairs: _Index, judged: Judged) -> None:
    """Condition tracks on the reports of pairs, each a mixture of what may be wrong with it.

    Args:
        kinematics: the filters of all tracks.
        rows: of the tracks, (k,).
        gated: pairs of tracks and reports.
        pairs: the one of each track.
        judged: what is thought of the report of each.
    """
    each, which, start = weighty(judged.p)
    pair = pairs[each]
    hypotheses = Chosen(
        gated.copy[pair], start, gated.plan.take(pair), gated.covs[pair, which], judged.log_weights[each, which]
    )
    kinematics.absorb(rows, gated.copies, hypotheses)
