"""Times of day to times, and the reports whose time cannot be right."""

from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.shapes import Float, Int

__all__ = [
    "DAY",
    "SORTING_WINDOW",
    "ClockJudge",
    "OrderFaults",
    "complete",
    "day_offsets",
    "impossible",
    "order_faults",
    "standing",
    "told_clock",
]

DAY = 86400.0  # s
_LEAP_SECOND = 1.0  # s past the end of a day
SORTING_WINDOW = 2.0  # s: radars send sector by sector, multi-channel receivers a little late
_WILD = 60.0  # s: a report this far behind is no late report, its clock jumped
_LONE = 600.0  # s: the last reports of a file have no followers to confirm a leap of this size
_SILENT = 10.0, 20.0  # s and median intervals: where later reports are silent for longer, they repeat no time
_AHEAD, _FOR_GOOD, _EXCURSION = 10, 50, 100  # reports looked at to tell wild, lasting and passing steps apart
_RUN, _AGAIN = 20, 0.5  # reports at one time, and the share of targets told again, by which a clock stands
_APART = 600.0  # s between the clock of a capture and the times of its reports that is no delay


class OrderFaults(NamedTuple):
    """Which reports of one source stand at a time that cannot be right."""

    late: npt.NDArray[np.bool_]  # older than the newest by more than the sorting window
    jump: npt.NDArray[np.bool_]  # a wild time, or one the clock repeated after it was set back
    steps: tuple[int, ...]  # indices at which the clock stepped back for good
    sizes: tuple[float, ...] = ()  # by how much, s, for each step
    leaps: tuple[int, ...] = ()  # indices at which times go on long after all before: a gap, or a clock that was set
    pauses: tuple[float, ...] = ()  # by how much, s, for each leap


def impossible(time_of_day: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Say which times of day are none: before midnight, or past the end of the day (a leap second counts), (N,)."""
    tod = np.asarray(time_of_day, np.float64)
    return np.asarray((tod < 0.0) | (tod >= DAY + _LEAP_SECOND))


def told_clock(captured: npt.ArrayLike, time: npt.ArrayLike) -> str:
    """Say how far the times of reports are from the clock of the capture they lie in, "" where no more than delayed.

    Args:
        captured: when each report was captured, s, UTC, NaN unknown, (N,).
        time: of the reports, s, UTC, (N,).
    """
    apart = np.asarray(time, np.float64) - np.asarray(captured, np.float64)
    apart = apart[np.isfinite(apart)]
    if not len(apart) or abs(float(np.median(apart))) < _APART:
        return ""
    middle = float(np.median(apart))
    return (
        f"the times of its reports are {abs(middle):.0f} s {'ahead of' if middle > 0 else 'behind'} the clock that "
        "captured them: one of the two is wrong, or tells local time. The reports' own times are used."
    )


def standing(time: Float[np.ndarray, " n"], identity: Int[np.ndarray, " n"]) -> npt.NDArray[np.bool_]:
    """Find reports of one source, in the order received, at a time at which its clock stands still.

    Of twenty or more reports at one time, more than half of those that tell a target tell one that had been told at
    that very time: no sensor sees everything twice at once. From the first of these on, the run's times are none.

    Args:
        time: (N,) s.
        identity: what tells targets apart, -1 = not given, (N,).
    """
    stands = np.zeros(len(time), np.bool_)
    edges = np.flatnonzero(np.diff(time, prepend=np.nan, append=np.nan) != 0)
    long = np.flatnonzero(np.diff(edges) >= _RUN)
    for start, stop in zip(edges[long].tolist(), edges[long + 1].tolist(), strict=True):
        known = start + np.flatnonzero(identity[start:stop] >= 0)
        if not len(known):
            continue
        first = np.unique(identity[known], return_index=True)[1]
        if len(known) - len(first) > _AGAIN * len(known):
            stands[np.delete(known, first)[0] : stop] = True
    return stands


def complete(
    truncated: Float[np.ndarray, " n"], modulus: float, near: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Complete times of day that are given modulo a time that does not divide the day.

    Of the times of day t with t mod modulus = truncated, the one nearest to `near` on the circle of the day: candidates
    are the nearest on this day, the day before and the day after, where truncation starts again at midnight.

    Args:
        truncated: (N,) s, NaN = not given.
        modulus: s.
        near: (N,) s after midnight, within half a modulus; NaN = unknown.

    Returns:
        s after midnight, (N,), NaN where either is NaN.
    """
    best, distance = np.full(len(truncated), np.nan), np.full(len(truncated), np.inf)
    for day in (0.0, -DAY, DAY):
        reference = near - day
        time = truncated + modulus * np.round((reference - truncated) / modulus)
        time = np.where(time < 0, time + modulus, np.where(time >= DAY, time - modulus, time))
        closer = np.abs(time - reference) < distance
        best, distance = np.where(closer, time, best), np.where(closer, np.abs(time - reference), distance)
    return best


def day_offsets(time_of_day: npt.ArrayLike) -> Int[np.ndarray, " n"]:
    """Count midnights: the number of days to add to each time of day, in the order received.

    Each time is put within half a day of the median of the last 15, so a wild time starts no new day.

    Args:
        time_of_day: (N,) s after midnight; NaN is passed over and gets 0.

    Returns:
        Days since the first report's, (N,).
    """
    tod = np.asarray(time_of_day, np.float64)
    days = np.zeros(len(tod), np.int64)
    valid = np.flatnonzero(np.isfinite(tod))
    times = tod[valid]
    if not np.any(np.abs(np.diff(times)) > DAY / 2):
        return days
    head = times[:15]
    apart = np.abs((head[:, None] - head + DAY / 2) % DAY - DAY / 2)  # on the circle of the day
    anchor = int(np.argmin(np.median(apart, axis=1)))
    recent = deque([float(head[anchor])], maxlen=15)
    found = np.empty(len(times), np.int64)
    for k, t in enumerate(times.tolist()):
        reference = sorted(recent)[len(recent) // 2]
        found[k] = round((reference - t) / DAY)
        recent.append(t + DAY * found[k])
    first = int(np.argmax(apart[anchor] < DAY / 4))  # the first that agrees with its neighbours
    days[valid] = found - found[first]
    return days


def order_faults(time: Float[np.ndarray, " n"]) -> OrderFaults:
    """Find late reports and clock jumps among the times of one source, in the order received.

    The newest credible time is the watermark. A report ahead of it is credible unless most of the next ten are
    older than it (a lone wild time must not make its neighbours late). A report behind it by more than the sorting
    window is late, or a jump when it is a minute or more behind. When nine in ten of the next fifty are behind
    as well, the clock was set back for good: the reports from there on are right and keep their times, and of the
    earlier ones those among the times that the clock then repeats are jumps (if the clock had only leapt ahead for
    up to a hundred reports, these are; likewise if it goes on, within a hundred reports, where it was before it was set
    back). Leaps ahead for good are gaps, and what an earlier stretch tells of a gap is no repetition: recordings
    joined out of order keep their reports.

    Args:
        time: (N,) s, finite.
    """
    return ClockJudge().faults(time)


@dataclass(slots=True)
class ClockJudge:
    """Judges the times of one source in the order received, a piece at a time: what was judged is not taken back."""

    mark: float = -np.inf  # the newest credible time
    before: float = np.inf  # the newest before the last leap ahead, and
    leap: int = 0  # where that leap is, from the beginning of the piece

    def faults(self, time: Float[np.ndarray, " n"]) -> OrderFaults:
        """Judge the next times by the rule of `order_faults`."""
        n = len(time)
        late, jump = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
        steps: list[int] = []
        sizes: list[float] = []
        newest = np.maximum.accumulate(np.append(self.mark, time))[1:]
        if np.any(newest - time > SORTING_WINDOW) or np.any(np.diff(time[-4:]) > _LONE):
            self._go(time, late, jump, steps, sizes)
            _mark_repeated(time, late, jump, steps)
        else:
            self.mark = float(newest[-1]) if n else self.mark
        self.leap -= n
        return OrderFaults(late & ~jump, jump, tuple(steps), tuple(sizes), *_leaps(time, late | jump))

    def _go(
        self,
        time: npt.NDArray[np.float64],
        late: npt.NDArray[np.bool_],
        jump: npt.NDArray[np.bool_],
        steps: list[int],
        sizes: list[float],
    ) -> None:
        """Mark what is late, what jumps, and where the clock steps back for good."""
        resumed = 0  # where the clock goes on after a passing step back
        for k in range(len(time)):
            if k < resumed:
                continue
            t = float(time[k])
            if t >= self.mark - SORTING_WINDOW:
                if t > self.mark + SORTING_WINDOW:
                    if _stands_alone(time, k, self.mark):
                        jump[k] = True
                        continue
                    if t > self.mark + _WILD and np.isfinite(self.mark):
                        self.leap, self.before = k, self.mark
                self.mark = max(self.mark, t)
                continue
            ahead = time[k : k + _FOR_GOOD]
            lasting = len(ahead) >= _AHEAD and np.mean(ahead < self.mark - SORTING_WINDOW) >= 0.9
            if lasting and abs(t - np.median(ahead[:_AHEAD])) < _WILD:
                if t >= self.before - SORTING_WINDOW and k - self.leap <= _EXCURSION:
                    jump[max(self.leap, 0) : k] = True
                    self.mark = max(self.before, t)
                elif resumed := _goes_on(time, k, self.mark):
                    jump[k:resumed] = True
                    continue
                else:
                    steps.append(k)
                    sizes.append(self.mark - t)
                    self.mark = t
                self.before = np.inf
            elif self.mark - t > _WILD:
                jump[k] = True
            else:
                late[k] = True


def _goes_on(time: npt.NDArray[np.float64], k: int, mark: float) -> int:
    """Where, soon after a step back at k, the times go on from the watermark; 0 where they do not."""
    ahead = np.diff(time[k : k + _EXCURSION + 1], prepend=time[k])
    again = (time[k : k + _EXCURSION + 1] >= mark - SORTING_WINDOW) & (ahead > 0.5 * (mark - time[k]))
    for j in (k + np.flatnonzero(again)).tolist():
        ahead = time[j : j + _AHEAD]
        if len(ahead) >= _AHEAD and np.mean(np.abs(ahead - mark) < _WILD) > 0.5:
            return int(j)
    return 0


def _leaps(time: npt.NDArray[np.float64], wrong: npt.NDArray[np.bool_]) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Indices of right reports before which no time of their source is for long, and for how long."""
    right = np.flatnonzero(~wrong)
    newest = np.maximum.accumulate(time[right])
    pause = np.diff(newest)
    usual = float(np.median(pause)) if len(pause) else 0.0
    long = pause > max(_LONE, _SILENT[1] * usual)
    return tuple(right[1:][long].tolist()), tuple(pause[long].tolist())


def _stands_alone(time: npt.NDArray[np.float64], k: int, mark: float) -> bool:
    followers = time[k + 1 : k + 1 + _AHEAD]
    if len(followers) < 3 and np.isfinite(mark) and time[k] - mark > _LONE:
        return True
    return len(followers) > 0 and float(np.mean(followers < time[k] - SORTING_WINDOW)) > 0.5


def _mark_repeated(
    time: npt.NDArray[np.float64],
    late: npt.NDArray[np.bool_],
    jump: npt.NDArray[np.bool_],
    steps: list[int],
) -> None:
    """Mark the reports before each step back among those that came after it, unless these are silent there."""
    for step, end in pairwise([*steps, len(time)]):
        again = np.unique(time[step:end][~(late | jump)[step:end]])
        if len(again) < 2:
            continue
        pause = np.diff(again)
        silent = np.append(pause > max(_SILENT[0], _SILENT[1] * float(np.median(pause))), False)
        before = np.searchsorted(again, time[:step], side="right") - 1  # the last of the later ones not after it
        inside = (before >= 0) & (time[:step] <= again[-1])
        jump[:step] |= inside & (~silent[before] | (time[:step] == again[before]))
