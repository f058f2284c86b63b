"""Two sensors that send one SAC/SIC: found by what no single one could see, told apart by the channel of each.

A target that two radars see from different sites jumps between two places, relative to one of them, from each report to
the next; antennas that turn side by side pass north at times of two rhythms. Where each channel by itself has neither,
the channels are the sensors.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from saltus.records import Kind, Plots

__all__ = ["SameCode"]

_NEAR, _FAST, _SOON = 3000.0, 1000.0, 30.0  # m, m/s, s: how far a target is at most from where it was within a while
_PAIRS, _ADDRESSES, _CODES = 6, 2, 10  # times that a target must come again; targets that tell, by address and by code
_MANY, _FEW = 0.5, 0.1  # shares of targets that jump, by which there are two sensors, and one
_TURNS, _UNEVEN, _EVEN = 8, 0.1, 0.03  # intervals between north marks, and shares of their median
_Times = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]


@dataclass(slots=True)
class _Evidence:
    """Counts over all reports of one code, and over those of each channel by itself."""

    targets: float = 0.0  # that came again often enough, over as many as are needed
    jumping: float = 0.0
    pairs: int = 0  # of their successive reports
    jumps: int = 0
    targets_by_channel: float = 0.0
    jumping_by_channel: float = 0.0
    norths: int = 0  # intervals in pieces in which the north marks are of two rhythms
    norths_by_channel: int = 0
    channels: set[int] = field(default_factory=set)

    def two(self) -> bool:
        """Whether two sensors send the code."""
        return self.jump() or self.norths >= _TURNS

    def jump(self) -> bool:
        """Whether targets are where they cannot have flown."""
        return self.targets >= 1.0 and self.jumping > _MANY * self.targets

    def by_channel(self) -> bool:
        """Whether each channel is one sensor."""
        one = self.jumping_by_channel <= _FEW * self.targets_by_channel and self.norths_by_channel < _TURNS
        return len(self.channels) > 1 and one


class SameCode:
    """Gathers evidence, piece after piece of a recording."""

    def __init__(self) -> None:
        self._evidence: dict[tuple[int, int], _Evidence] = {}  # by SAC and SIC

    def add(self, plots: Plots, channel: _Index) -> None:
        """Look at the reports of a category.

        Args:
            plots: of it, in the order received.
            channel: that brought each, -1 = not told, (N,).
        """
        codes = {(s.system.sac or 0, s.system.sic or 0) for s in plots.sources}
        for code in sorted(codes):
            some = [k for k, s in enumerate(plots.sources) if (s.system.sac or 0, s.system.sic or 0) == code]
            mine = (
                np.isin(plots.source, some) & (plots.kind == Kind.POLAR) & (plots.reason == 0) & np.isfinite(plots.time)
            )
            index = np.flatnonzero(mine & (plots.icao24 >= 0))
            need = _ADDRESSES
            if len(index) < _PAIRS:
                index, need = np.flatnonzero(mine & (plots.mode3a > 0)), _CODES
            if not len(index):
                continue
            own, of = plots.take(index), channel[index]
            seen = self._evidence.setdefault(code, _Evidence())
            seen.channels |= set(np.unique(of).tolist())
            who = np.where(own.icao24 >= 0, own.icao24.astype(np.int64), (1 << 24) + own.mode3a.astype(np.int64))
            pairs, jumps = _jumps(own, who)
            seen.pairs, seen.jumps = seen.pairs + int(pairs.sum()), seen.jumps + int(jumps.sum())
            seen.targets += len(pairs) / need
            seen.jumping += int(np.count_nonzero(jumps > _MANY * pairs)) / need
            pairs, jumps = _jumps(own, who << 20 | (of + 1))
            seen.targets_by_channel += len(pairs) / need
            seen.jumping_by_channel += int(np.count_nonzero(jumps > _MANY * pairs)) / need

    def turns(self, code: tuple[int, int], time: _Times, channel: _Index) -> None:
        """Look at the north marks of a code.

        Args:
            code: SAC and SIC.
            time: of its north marks, s, (N,).
            channel: that brought each, (N,).
        """
        seen = self._evidence.setdefault(code, _Evidence())
        seen.channels |= set(np.unique(channel).tolist())
        seen.norths += _two_rhythms(time)
        seen.norths_by_channel += sum(_two_rhythms(time[channel == c]) for c in np.unique(channel).tolist())

    def apart(self) -> frozenset[tuple[int, int]]:
        """SAC and SIC of the codes whose channels are sensors of their own."""
        return frozenset(code for code, e in self._evidence.items() if e.two() and e.by_channel())

    def problems(
        self,
        name: str,
        channels: Sequence[str],
        kept: Collection[tuple[int, int]],
        named: Collection[tuple[int, int]] = (),
    ) -> list[str]:
        """What is told of the codes that two sensors send.

        Args:
            name: of the recording.
            channels: names of the channels.
            kept: codes whose channels were kept apart.
            named: of these, those that a configuration names: nothing is told of them where channels are sensors.
        """
        return [
            _told(name, code, e, [channels[c] for c in sorted(e.channels) if c >= 0], apart=code in kept)
            for code, e in self._evidence.items()
            if e.two() and not (code in named and e.by_channel())
        ]


def _told(name: str, code: tuple[int, int], e: _Evidence, channels: Sequence[str], *, apart: bool) -> str:
    sac, sic = code
    why = (
        f"of {e.pairs} times that a target was reported again, {e.jumps} were where it cannot have flown"
        if e.jump()
        else "its north marks are those of two antennas"
    )
    if apart:
        first = channels[0]
        return (
            f"{name}: SAC/SIC {sac}/{sic} is sent by {len(channels)} sensors: {why}. They are kept apart by channel: "
            f"{', '.join(channels)}. Give each a [[sensor]] table of its own, with sac, sic and "
            f'channel = "{first}" and so on.'
        )
    where = "nothing in the recording tells them apart" if len(channels) < 2 else "its channels do not tell them apart"
    if e.by_channel():
        where = "only from some place on"
    return (
        f"{name}: SAC/SIC {sac}/{sic} is sent by two sensors: {why}, and {where}: they are used as if they were one. "
        "Correct the code of one at its source, or record each on a line or port of its own."
    )


def _jumps(plots: Plots, who: _Index) -> tuple[_Index, _Index]:
    """Of each target that comes again often enough: pairs of successive reports, and those it cannot have flown."""
    order = np.lexsort((plots.time, who))
    wait = np.diff(plots.time[order])
    east, north = (plots.range * f(plots.azimuth) for f in (np.sin, np.cos))
    way = np.hypot(np.diff(east[order]), np.diff(north[order]))
    soon = (np.diff(who[order]) == 0) & (wait < _SOON) & np.isfinite(way)
    target, pairs = np.unique(who[order][1:][soon], return_counts=True)
    place = np.searchsorted(target, who[order][1:][soon])
    jumps = np.bincount(place[(way > _NEAR + _FAST * wait)[soon]], minlength=len(target))
    often = pairs >= _PAIRS
    return pairs[often], jumps[often]


def _two_rhythms(time: _Times) -> int:
    """Intervals between north marks, if they are uneven one by one and even two by two; else 0."""
    starts = np.unique(time[np.isfinite(time)])
    if len(starts) < _TURNS + 2:
        return 0
    one, two = np.diff(starts), starts[2:] - starts[:-2]
    uneven = np.mean(np.abs(one - np.median(one)) > _UNEVEN * np.median(one))
    even = np.mean(np.abs(two - np.median(two)) < _EVEN * np.median(two))
    return len(one) if uneven > 0.4 and even > 0.8 else 0
