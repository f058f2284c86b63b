"""How sensors fared: plots found faulty, and times at which a source was degraded."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.tracks.faults import History, PlotLaw
from saltus.tracks.rows import ConditionFound

__all__ = ["NIS_FITS", "Degraded", "Health", "degraded_intervals", "flagged", "nis_interval", "sensor_health"]

NIS_FITS = (1.1, 2.2)  # mean NIS of two components, see `nis_interval`

_Array = npt.NDArray[np.float64]

_FLAG = 0.5  # probability of a fault from which a plot is flagged
_BEGIN, _END = 0.5, 0.2  # P(degraded) at which an interval begins and ends


class Degraded(NamedTuple):
    """A stretch of time in which a source was probably degraded."""

    time_from: float
    time_to: float  # of the last scan in it
    condition: str  # the likeliest over the stretch
    probability: float  # mean of P(degraded) over its scans


class Health(NamedTuple):
    """One source's plots and condition."""

    name: str
    components: tuple[str, ...]
    time: _Array  # (N,): of its plots that updated a track past its start, s
    fault: npt.NDArray[np.int8]  # (N,): 0 right, else 1 + component
    scans: _Array  # (T,), s
    p_degraded: _Array  # (T, components)
    intervals: list[Degraded]


def degraded_intervals(history: History, law: PlotLaw) -> list[Degraded]:
    """Return the stretches in which P(not well) reached one half, each until it fell below a fifth."""
    p = 1.0 - history.probs[:, 0]
    inside, begin, out = False, 0, []
    for k, value in enumerate(np.append(p, 0.0)):
        if not inside and value >= _BEGIN:
            inside, begin = True, k
        elif inside and value < _END:
            inside = False
            mean = history.probs[begin:k].mean(axis=0)
            worst = law.degraded[1 + int(mean[1:].argmax())]
            names = [name for name, bad in zip(law.components, worst, strict=True) if bad]
            out.append(
                Degraded(
                    float(history.time[begin]),
                    float(history.time[k - 1]),
                    " and ".join(names) + " degraded",
                    float(p[begin:k].mean()),
                )
            )
    return out


def flagged(p_fault: _Array, fault: npt.NDArray[np.int8]) -> npt.NDArray[np.int8]:
    """Return the fault of each plot, 1 + component, 0 where it is more probably right; (N,) probabilities and kinds."""
    return np.where(p_fault > _FLAG, fault, 0).astype(np.int8)


def sensor_health(
    names: Sequence[str],
    sources: Sequence[ConditionFound],
    source: npt.NDArray[np.int32],
    time: _Array,
    fault: npt.NDArray[np.int8],
) -> list[Health]:
    """Gather what was found of each source.

    Args:
        names: of the sources.
        sources: their conditions.
        source: of each plot that updated a confirmed track and was judged, index, (N,).
        time: of it, s.
        fault: its fault (`flagged`).
    """
    out = []
    for s, (name, condition) in enumerate(zip(names, sources, strict=True)):
        mine = np.flatnonzero(source == s)
        mine = mine[np.argsort(time[mine], kind="stable")]
        history, law = condition.history, condition.law
        p = history.probs @ law.degraded
        intervals = degraded_intervals(history, law)
        out.append(Health(name, law.components, time[mine], fault[mine], history.time, p, intervals))
    return out


def nis_interval(updates: int) -> tuple[float, float]:
    """Return the interval of the mean NIS of a source's updates outside which its noise does not fit.

    A filter whose model draws the motion has mean 2 with variance 4 / n: innovations of one object are uncorrelated and
    their squares nearly so. Objects that move more steadily than their model have less, as the predicted covariance
    spreads over modes they do not use: with matched noise the demonstration's radars have 1.4 to 1.6, with standard
    deviations 1.5 times too large 0.84 to 0.91, and 1.5 times too small 2.4 to 2.5. NIS_FITS parts these, and three
    standard errors, 2 / sqrt(n) each, are added for few updates.
    """
    error = 3.0 * 2.0 / np.sqrt(max(updates, 1))
    return max(NIS_FITS[0] - error, 0.0), NIS_FITS[1] + error
