"""The order in which plots are taken: slices of time, and rounds in which no target has two plots."""

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from saltus.tracks.measurements import Measurements

__all__ = ["rounds", "shortest_share", "slice_width", "slices"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]

# A target gives a source at most one plot in this share of the shortest update period: a rotating radar keeps its
# period, other systems report more often now and then. The slices of one such system are longer, and taken in rounds.
_ROTATING, _OTHER, _IN_ROUNDS = 0.9, 0.4, 4.0
_LONGEST = 4.0  # s
_DEVIATIONS = 4.0  # of two plots of one target


def shortest_share(*, polar: bool) -> float:
    """Return the share of its period within which a target gives a source at most one plot."""
    return _ROTATING if polar else _OTHER


def slice_width(periods: Sequence[float], polar: Sequence[bool]) -> float:
    """Return how long a slice lasts, s.

    Args:
        periods: update period of each source that gives reports, s.
        polar: which of them measure range and azimuth.
    """
    share = _OTHER if len(periods) > 1 else _ROTATING if all(polar) else _IN_ROUNDS
    return min(_LONGEST, share * min(periods, default=_LONGEST))


def slices(time: _Array, width: float, until: float) -> Iterator[tuple[int, int]]:
    """Divide times in order into short stretches; yield begin and end of each that is complete.

    Args:
        time: s, (n,).
        width: of a slice, s.
        until: nothing will follow up to this time, s; a slice is complete when it ends before, or something later came.
    """
    begin = 0
    while begin < len(time):
        end = int(np.searchsorted(time, time[begin] + width, side="right"))
        if end == len(time) and time[begin] + width >= until:
            return
        yield begin, end
        begin = end


def rounds(m: Measurements, index: _Index, period: float, max_speed: float, *, use_identity: bool) -> list[_Index]:
    """Divide the plots of one source in one slice so that no target has two in a round, its earlier ones first.

    Two plots may be one target's if they have one address. Without addresses, they may be if it could fly from one to
    the other, and if they are more than 0.4 of an update period apart: what is nearer in time are two targets, or two
    plots of one, and contend for one track in one round.

    Args:
        m: all measurements.
        index: those of the source in the slice, in time order.
        period: its update period, s.
        max_speed: fastest target, m/s.
        use_identity: whether addresses count.
    """
    time, code = m.time[index], m.icao24[index]
    if time[-1] - time[0] <= _OTHER * period or np.isfinite(m.ray[index[0], 0]):
        return [index]
    named = (code >= 0) & use_identity
    turn = np.zeros(len(index), np.intp)
    if named.all():
        order = np.argsort(code, kind="stable")
        first = np.searchsorted(code[order], code[order])
        turn[order] = np.arange(len(order)) - first
    else:
        xy, deviation = m.position[index, :2], np.sqrt(m.cov[index, 0, 0] + m.cov[index, 1, 1])
        for j in range(1, len(index)):
            dt = time[j] - time[:j]
            reach = max_speed * dt + _DEVIATIONS * (deviation[:j] + deviation[j])
            near = (np.hypot(*(xy[:j] - xy[j]).T) <= reach) & (dt > _OTHER * period)
            met = np.where(named[:j] & named[j], code[:j] == code[j], near)
            turn[j] = 1 + turn[:j][met].max() if met.any() else 0
    return [index[turn == k] for k in range(int(turn.max()) + 1)]
