"""How often a source reports a target, learnt from positions that carry no identity."""

import numpy as np
import numpy.typing as npt

from saltus.tracks.setup_settings import PeriodSettings

__all__ = ["learn_period"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]


def learn_period(time: _Array, position: _Array, sigma: _Array, max_speed: float, how: PeriodSettings) -> float:
    """Return the interval at which targets come back, s; NaN where too few do.

    Three reports at t, t + T and t + 2T lie on a line when they are one target's: the third within three deviations of
    where the other two lead, and of what an acceleration bends. Every interval T has as many ways as reports from which
    such two follow; the period is the shortest interval that has half as many as any has, for twice the period has as
    many as the period itself.

    Args:
        time: of the reports, in order, s, (n,).
        position: plane positions, m, (n, 2).
        sigma: standard deviation of each, each axis, m, (n,).
        max_speed: fastest target, m/s.
        how: bounds.
    """
    first, second = _pairs(time, position, sigma, max_speed, how)
    dt = time[second] - time[first]
    good = _continued(time, position, sigma, first, second, how)
    seed, lag = first[good], dt[good]
    if not len(lag):
        return float("nan")
    bins = np.exp(np.arange(np.log(how.shortest), np.log(how.longest) + how.width / 2, how.width / 2))
    count = np.array([len(np.unique(seed[np.abs(lag / b - 1.0) < how.width])) for b in bins.tolist()])
    if count.max() < how.fewest:
        return float("nan")
    at = int((count >= how.share * count.max()).argmax())
    best = at + int(count[at : at + 3].argmax())
    return float(np.median(lag[np.abs(lag / bins[best] - 1.0) < how.width]))


def _pairs(
    time: _Array, position: _Array, sigma: _Array, max_speed: float, how: PeriodSettings
) -> tuple[_Index, _Index]:
    """Reports, and later ones within reach of a target."""
    seeds = np.unique(np.linspace(0, len(time) - 1, min(len(time), how.seeds)).astype(np.intp))
    first, second, found = [], [], 0
    for i in seeds.tolist():
        stop = int(np.searchsorted(time, time[i] + how.longest, side="right"))
        j = np.arange(i + 1, stop)
        dt = time[j] - time[i]
        reach = max_speed * dt + how.deviations * (sigma[i] + sigma[j])
        j = j[(dt >= how.shortest) & (np.hypot(*(position[j] - position[i]).T) <= reach)]
        first.append(np.full(len(j), i))
        second.append(j)
        found += len(j)
        if found > how.pairs:
            break
    none = np.zeros(0, np.intp)
    return np.concatenate([none, *first]), np.concatenate([none, *second])


def _continued(
    time: _Array, position: _Array, sigma: _Array, first: _Index, second: _Index, how: PeriodSettings
) -> npt.NDArray[np.bool_]:
    """Say of which pairs a third report lies where they lead."""
    out = np.zeros(len(first), bool)
    for k, (i, j) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
        dt = time[j] - time[i]
        low = int(np.searchsorted(time, time[j] + (1.0 - how.width) * dt))
        high = int(np.searchsorted(time, time[j] + (1.0 + how.width) * dt, side="right"))
        if low == high:
            continue
        share = (time[low:high] - time[j])[:, None] / dt
        ahead = position[j] + share * (position[j] - position[i])
        tolerance = (
            how.deviations * np.sqrt(sigma[i] ** 2 + 4.0 * sigma[j] ** 2 + sigma[low:high] ** 2) + how.accel * dt**2
        )
        out[k] = bool((np.hypot(*(position[low:high] - ahead).T) <= tolerance).any())
    return out
