"""The filters of all tracks as rows: horizontal and vertical side by side, or jointly in three dimensions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import NumericalError
from saltus.models import constant_velocity
from saltus.tracks.channel import MOTION, Channel, Plan, Start, make_channel
from saltus.tracks.colour import NO_SOURCE, Colour, Colours
from saltus.tracks.intervals import Intervals
from saltus.tracks.modes import Mode, horizontal_chain, vertical_chain
from saltus.tracks.settings import FilterSettings, TrackerSettings

__all__ = ["Chosen", "Kinematics", "Moments", "make_kinematics"]

_Array = npt.NDArray[np.float64]
_Rows = npt.NDArray[np.intp]


class Moments(NamedTuple):
    """What is published of a row: state (x, vx, y, vy, z, vz), its covariance, probabilities of manoeuvre."""

    mean: _Array  # (k, 6)
    cov: _Array  # (k, 6, 6)
    p_manoeuvre_h: _Array  # (k,)
    p_manoeuvre_v: _Array  # (k,)


class Chosen(NamedTuple):
    """Hypotheses of k rows, those of row i from start[i] to start[i + 1] - 1."""

    copy: _Rows  # (c,): row of the copy that each is carried out on
    start: _Rows  # (k + 1,)
    plan: Plan  # (c,)
    covs: _Array  # (c, m, m)
    log_weights: _Array  # (c,)

    @classmethod
    def sure(cls, copy: _Rows, plan: Plan, covs: _Array) -> "Chosen":
        """Return the only hypothesis of each row: measurements with covariances (k, m, m)."""
        return cls(copy, np.arange(len(copy) + 1), plan, covs, np.zeros(len(copy)))


@dataclass(frozen=True, slots=True)
class Kinematics:
    """The rows of all tracks; every channel numbers them alike.

    Two channels, horizontal and vertical, are the decomposition of the radar notes (their equations 16-25): the
    covariance of height with horizontal position is dropped. One channel keeps it.
    """

    channels: tuple[Channel, ...]
    intervals: Intervals  # of the channels
    colours: Colours  # whose lasting errors the states behind the motion's are

    def adopt(self, sources: Sequence[Colour], settings: TrackerSettings) -> "Kinematics":
        """Return the same rows, with room for the lasting errors of further sources."""
        before = self.colours.slots
        self.colours.adopt(sources, settings)
        more = self.colours.slots - before
        if not more:
            return self
        channels = tuple(channel.widened(self.colours.slots, more) for channel in self.channels)
        return _kinematics(channels, self.colours)

    def state(self) -> dict[str, Any]:
        """Return what `restore` goes on from: by channel, and whose the states of lasting errors are."""
        banks = {str(k): channel.bank.state() for k, channel in enumerate(self.channels)}
        return banks | {"colours": self.colours.state()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Hold the rows that `state` gave, of filters of the same settings."""
        for k, channel in enumerate(self.channels):
            channel.bank.restore(state[str(k)])
        self.colours.restore(state["colours"])

    def add(self, start: Start) -> _Rows:
        """Store new rows."""
        start = self._whole(start)
        first, *others = [channel.bank.add(channel.belief(start)) for channel in self.channels]
        if any((rows != first).any() for rows in others):
            raise NumericalError("internal: banks used alike gave rows of different numbers")
        self._own(first, start)
        return first

    def write(self, rows: _Rows, start: Start) -> None:
        """Begin rows anew."""
        start = self._whole(start)
        for channel in self.channels:
            channel.bank.write(rows, channel.belief(start))
        self._own(rows, start)

    def _whole(self, start: Start) -> Start:
        return start if start.colours is not None else start.beside(self.colours.empty(len(start.mean)))

    def _own(self, rows: _Rows, start: Start) -> None:
        if start.colours is not None:
            self.colours.put(rows, start.colours, np.arange(len(rows)))

    def move(self, rows: _Rows, shift: _Array, turn: _Array) -> None:
        """Move the frame of rows: positions by `shift` (k, 2), m; velocities turn anticlockwise by `turn` (k,), rad."""
        for channel in self.channels:
            if 0 not in channel.axes:
                continue
            belief = channel.bank.read(rows)
            lift = (len(rows), *(1 for _ in channel.bank.sizes))
            (c, s), (x, y) = ((a.reshape(lift), b.reshape(lift)) for a, b in ((np.cos(turn), np.sin(turn)), shift.T))
            means = belief.means.copy()
            means[..., 0], means[..., 2] = means[..., 0] + x, means[..., 2] + y
            vx, vy = belief.means[..., 1], belief.means[..., 3]
            means[..., 1], means[..., 3] = c * vx - s * vy, s * vx + c * vy
            channel.bank.write(rows, belief._replace(means=means))

    def remove(self, rows: _Rows) -> None:
        """Free rows."""
        for channel in self.channels:
            channel.bank.remove(rows)

    def predicted(self, rows: _Rows, dt: _Array, source: int = NO_SOURCE, time: _Array | None = None) -> "Kinematics":
        """Copies of rows (repeats allowed), numbered from 0, moved forward by dt >= 0.

        Args:
            rows: which.
            dt: (k,), s.
            source: one that reports all of them and may take states for its lasting errors.
            time: of its reports, (k,), s.
        """
        colours = self.colours.take(rows)
        before = colours.owner
        if source != NO_SOURCE and time is not None:
            before = before.copy()
            colours.claim(source, time)
        fade = colours.fade(dt, before)
        parts = zip(self.channels, self.intervals.at(dt), strict=True)
        channels = tuple(channel.predicted(rows, over, fade) for channel, over in parts)
        return Kinematics(channels, self.intervals, colours)

    def absorb(self, rows: _Rows, copies: "Kinematics", chosen: "Chosen") -> None:
        """Make of each row the mixture of its hypotheses, each a copy of the row conditioned on a measurement.

        Args:
            rows: k rows, none twice.
            copies: rows moved to the measurements' times.
            chosen: the hypotheses of each row.
        """
        parts = [channel.conditioned(chosen.copy, chosen.plan, chosen.covs) for channel in copies.channels]
        log_weights = chosen.log_weights + sum(log_f for _, log_f in parts)
        for channel, (conditioned, _) in zip(self.channels, parts, strict=True):
            channel.bank.merge(rows, conditioned, chosen.start, log_weights)
        self.colours.put(rows, copies.colours, chosen.copy[chosen.start[:-1]])

    def score(self, rows: _Rows, plan: Plan, covs: _Array) -> _Array:
        """Return log-likelihoods of measurements under each of h covariances (k, h, m, m); repeats allowed.

        The covariances of one measurement differ in the plane alone.
        """
        parts = [channel.score(rows, plan, covs if 0 in channel.axes else covs[:, :1]) for channel in self.channels]
        return np.asarray(sum(parts))

    def widest(self, rows: _Rows) -> tuple[_Array, _Array]:
        """What a gate must not cut off, as mean and covariance of every channel.

        P + sum_t d_t d_t' / n over the n turns t: the most agile mode's covariance P, and the distances d_t of the
        means in turns from its own.
        """
        mean, cov = self._empty(len(rows))
        for channel in self.channels:
            s = channel.states
            belief = channel.bank.read(rows)
            last: tuple[slice | int, ...] = (slice(None), *(-1 for _ in channel.chains))
            mean[:, s], cov[:, s[:, None], s] = belief.means[last], belief.covs[last]
            if channel.turns:
                apart = belief.means[(slice(None), list(channel.turns), *last[2:])] - mean[:, None, s]
                cov[:, s[:, None], s] += np.einsum("kti,ktj->kij", apart, apart) / len(channel.turns)
        return mean, cov

    def put(self, rows: _Rows, other: "Kinematics", other_rows: _Rows) -> None:
        """Overwrite rows with those of a set of copies."""
        for mine, theirs in zip(self.channels, other.channels, strict=True):
            mine.bank.put(rows, theirs.bank, other_rows)
        self.colours.put(rows, other.colours, other_rows)

    def moments(self, rows: _Rows) -> Moments:
        """Mean, covariance, and the probability of any state but the first of each chain: what is published."""
        mean, cov, p_manoeuvre = self._mixture(rows)
        return Moments(mean[:, :MOTION], cov[:, :MOTION, :MOTION], p_manoeuvre["horizontal"], p_manoeuvre["vertical"])

    def mixture(self, rows: _Rows) -> tuple[_Array, _Array]:
        """Mean and covariance of motion and lasting errors."""
        return self._mixture(rows)[:2]

    def _empty(self, k: int) -> tuple[_Array, _Array]:
        n = MOTION + self.colours.slots
        return np.zeros((k, n)), np.zeros((k, n, n))

    def _mixture(self, rows: _Rows) -> tuple[_Array, _Array, dict[str, _Array]]:
        mean, cov = self._empty(len(rows))
        p_manoeuvre = {}
        for channel in self.channels:
            s = channel.states
            mean[:, s], cov[:, s[:, None], s], probs = channel.bank.moments(rows)
            for c, chain in enumerate(channel.chains):
                others = tuple(1 + i for i in range(len(channel.chains)) if i != c)
                p_manoeuvre[chain.name] = 1.0 - probs.sum(axis=others)[:, 0]
        return mean, cov, p_manoeuvre


def make_kinematics(
    settings: FilterSettings, sources: Sequence[Colour] = (), tracker: TrackerSettings | None = None
) -> Kinematics:
    """Build the empty filters that the settings describe.

    Args:
        settings: motion.
        sources: the lasting errors of each source.
        tracker: how many states may stand for those.
    """
    kinematics = _of_motion(settings)
    return kinematics if tracker is None else kinematics.adopt(sources, tracker)


def _of_motion(settings: FilterSettings) -> Kinematics:
    kind: Literal["scan", "white"] = "white" if settings.accel_time else "scan"
    h, v, none = horizontal_chain(settings), vertical_chain(settings), Colours((), TrackerSettings())
    turn = (
        (lambda horizontal: horizontal.turn) if any(isinstance(mode, Mode) and mode.turn for mode in h.values) else None
    )
    if settings.form == "joint":
        motion = constant_velocity(
            3,
            accel=lambda horizontal, vertical: [horizontal.accel, horizontal.accel, vertical.accel],
            kind=kind,
            turn=turn,
        )
        return _kinematics((make_channel([0, 1, 2], (h, v), motion),), none)
    horizontal = constant_velocity(2, accel=lambda horizontal: horizontal.accel, kind=kind, turn=turn)
    vertical = constant_velocity(1, accel=lambda vertical: vertical.accel, kind=kind)
    return _kinematics((make_channel([0, 1], (h,), horizontal), make_channel([2], (v,), vertical)), none)


def _kinematics(channels: tuple[Channel, ...], colours: Colours) -> Kinematics:
    parts = [(channel.motion, channel.chains, int((channel.states >= MOTION).sum())) for channel in channels]
    return Kinematics(channels, Intervals(parts), colours)
