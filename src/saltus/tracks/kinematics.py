"""The filters of all tracks as rows: horizontal and vertical side by side, or jointly in three dimensions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import NumericalError
from saltus.filters import Bank, Belief
from saltus.models import Chain, Motion, constant_velocity
from saltus.tracks.colour import NO_SOURCE, Colour, Colours
from saltus.tracks.intervals import Intervals, Matrices
from saltus.tracks.modes import Mode, horizontal_chain, vertical_chain
from saltus.tracks.settings import FilterSettings, TrackerSettings

__all__ = [
    "MOTION",
    "Channel",
    "Chosen",
    "Kinematics",
    "Moments",
    "Plan",
    "Start",
    "make_kinematics",
    "two_point_start",
    "with_speed_prior",
]

_Array = npt.NDArray[np.float64]
_Rows = npt.NDArray[np.intp]

_HEIGHT = 2  # component of a measurement
MOTION = 6  # states of position and velocity; those of lasting errors follow


class Moments(NamedTuple):
    """What is published of a row: state (x, vx, y, vy, z, vz), its covariance, probabilities of manoeuvre."""

    mean: _Array  # (k, 6)
    cov: _Array  # (k, 6, 6)
    p_manoeuvre_h: _Array  # (k,)
    p_manoeuvre_v: _Array  # (k,)


class Plan(NamedTuple):
    """Measurements z = C x + v of states (x, vx, y, vy, z, vz, lasting errors), one for each of k rows.

    Two components measure in the plane, the third height: a filter of one takes its own. What is not measured is NaN.
    """

    z: _Array  # (k, m)
    C: _Array  # (k, m, 6 + slots)

    @classmethod
    def of_positions(cls, position: _Array, offset: _Array, lasting: _Array | None = None) -> "Plan":
        """Return measurements of positions.

        Args:
            position: (k, 3).
            offset: s from the time of their row along its velocity, (k,).
            lasting: how states of lasting errors enter, (k, 2, slots).
        """
        slots = 0 if lasting is None else lasting.shape[2]
        C, axis = np.zeros((len(position), 3, MOTION + slots)), np.arange(3)
        C[:, axis, 2 * axis] = 1.0
        C[:, axis, 2 * axis + 1] = offset[:, None]
        if lasting is not None:
            C[:, :2, MOTION:] = lasting
        return cls(position, C)

    def take(self, index: _Rows) -> "Plan":
        """Return the measurements selected."""
        return Plan(self.z[index], self.C[index])


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


class Start(NamedTuple):
    """Where rows begin: state (k, n) with covariance (k, n, n), and whose lasting errors stand behind the motion's."""

    mean: _Array
    cov: _Array
    colours: Colours | None = None  # None: of motion alone, n = 6

    def beside(self, colours: Colours, cross: _Array | None = None) -> "Start":
        """Add states of lasting errors N(0, I), with covariances `cross` (k, 6, slots) to those of the motion."""
        k, n = len(self.mean), MOTION + colours.slots
        mean, cov = np.zeros((k, n)), np.zeros((k, n, n))
        mean[:, :MOTION], cov[:, :MOTION, :MOTION] = self.mean, self.cov
        cov[:, MOTION:, MOTION:] = np.eye(colours.slots)
        if cross is not None:
            cov[:, :MOTION, MOTION:], cov[:, MOTION:, :MOTION] = cross, cross.swapaxes(1, 2)
        return Start(mean, cov, colours)


@dataclass(frozen=True, slots=True)
class Channel:
    """A bank of multimode filters over some axes of space (0 x, 1 y, 2 z), constant velocity along each, or turns."""

    axes: npt.NDArray[np.intp]
    chains: tuple[Chain, ...]
    states: npt.NDArray[np.intp]  # positions of the channel's states among all
    motion: Motion  # bound to the chains
    turns: tuple[int, ...]  # states of the first chain that turn
    bank: Bank

    def belief(self, start: Start) -> Belief:
        """Give every mode the same Gaussian, and the chains their stationary law."""
        k, n, sizes = len(start.mean), len(self.states), self.bank.sizes
        log_probs = np.zeros(sizes)
        for c, chain in enumerate(self.chains):
            log_probs = log_probs + np.log(chain.law).reshape([-1 if i == c else 1 for i in range(len(sizes))])
        lift = (k, *(1 for _ in sizes))
        mean = start.mean[:, self.states].reshape((*lift, n))
        cov = start.cov[:, self.states[:, None], self.states].reshape((*lift, n, n))
        return Belief(
            np.broadcast_to(log_probs, (k, *sizes)),
            np.broadcast_to(mean, (k, *sizes, n)),
            np.broadcast_to(cov, (k, *sizes, n, n)),
        )

    def predicted(self, rows: _Rows, over: Matrices, fade: _Array) -> "Channel":
        """Copies of rows, numbered from 0, mixed and moved forward; what lasts of lasting errors is `fade` (k, slots).

        The matrices are the caller's own: those of lasting errors are written into them.
        """
        ahead = self.bank.take(rows)
        at = np.flatnonzero(self.states >= MOTION)
        if len(at):
            each = fade.reshape(len(rows), *(1 for _ in self.chains), len(at))
            over.F[..., at, at], over.Q[..., at, at] = each, 1.0 - each * each
        ahead.step(np.arange(len(rows)), over.trans, over.F, None, over.Q)
        return replace(self, bank=ahead)

    def widened(self, slots: int, more: int) -> "Channel":
        """Return the channel with more states of lasting errors, `slots` in all, N(0, 1) in every row."""
        if 0 not in self.axes or not more:
            return self
        return replace(
            self,
            states=np.append(self.states, np.arange(MOTION + slots - more, MOTION + slots)),
            bank=self.bank.widened(more),
        )

    def score(self, rows: _Rows, plan: Plan, covs: _Array) -> _Array:
        """Log-likelihood of what this channel measures under h covariances (k, h, m, m) of each measurement, (k, h)."""
        (k, h), each = covs.shape[:2], np.repeat(np.arange(len(rows)), covs.shape[1])
        _, log_f = self.bank.score(rows[each], *self._measured(plan.take(each), covs.reshape(k * h, *covs.shape[2:])))
        return log_f.reshape(k, h)

    def conditioned(self, rows: _Rows, plan: Plan, covs: _Array) -> tuple[Bank, _Array]:
        """Return copies of rows (repeats allowed) conditioned on measurements, and log-likelihoods of these, (c,)."""
        copies = self.bank.take(rows)
        _, log_f = copies.update(np.arange(len(rows)), *self._measured(plan, covs))
        return copies, log_f

    def _measured(self, plan: Plan, cov: _Array) -> tuple[_Array, _Array, None, _Array]:
        """What a bank asks of measurements, and their noise, in this channel."""
        components = np.array([c for c in range(plan.z.shape[1]) if (c if c == _HEIGHT else 0) in self.axes])
        lift = (len(plan.z), *(1 for _ in self.bank.sizes))
        C = plan.C[:, components[:, None], self.states]
        R = cov[:, components[:, None], components]
        return plan.z[:, components], C.reshape((*lift, *C.shape[1:])), None, R.reshape((*lift, *R.shape[1:]))


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
        return _kinematics((_channel([0, 1, 2], (h, v), motion),), none)
    horizontal = constant_velocity(2, accel=lambda horizontal: horizontal.accel, kind=kind, turn=turn)
    vertical = constant_velocity(1, accel=lambda vertical: vertical.accel, kind=kind)
    return _kinematics((_channel([0, 1], (h,), horizontal), _channel([2], (v,), vertical)), none)


def _kinematics(channels: tuple[Channel, ...], colours: Colours) -> Kinematics:
    parts = [(channel.motion, channel.chains, int((channel.states >= MOTION).sum())) for channel in channels]
    return Kinematics(channels, Intervals(parts), colours)


def _channel(axes: list[int], chains: tuple[Chain, ...], motion: Motion) -> Channel:
    bank = Bank(2 * len(axes), tuple(len(chain) for chain in chains))
    position = 2 * np.array(axes)
    states = np.stack([position, position + 1], axis=-1).ravel()
    turns = tuple(k for k, mode in enumerate(chains[0].values) if isinstance(mode, Mode) and mode.turn)
    return Channel(np.array(axes), chains, states, motion.bind(chains), turns, bank)


def two_point_start(
    first: _Array, first_cov: _Array, second: _Array, second_cov: _Array, dt: _Array, common: _Array | None = None
) -> Start:
    """Begin states from two positions.

    Position z1, velocity (z1 - z0)/T, and blockwise over (position, velocity)
    P = [[R1, (R1 - C)/T], [(R1 - C)'/T, (R0 + R1 - C - C')/T^2]], C = cov(error of z1, error of z0).

    Args:
        first: positions (x, y, z) at the earlier time, (k, 3).
        first_cov: their covariances R0, (k, 3, 3).
        second: positions at the later time, (k, 3).
        second_cov: their covariances R1, (k, 3, 3).
        dt: time between them T > 0, (k,), s.
        common: C, (k, 3, 3); None: 0, each position errs by itself.

    Returns:
        States (x, vx, y, vy, z, vz) at the later time.

    Source: two-point differencing; section 3 of the radar notes.
    """
    T, C = dt[:, None, None], np.zeros(second_cov.shape) if common is None else common
    mean, cov = np.empty((len(dt), 6)), np.empty((len(dt), 6, 6))
    mean[:, 0::2], mean[:, 1::2] = second, (second - first) / dt[:, None]
    cov[:, 0::2, 0::2] = second_cov
    cov[:, 0::2, 1::2] = (second_cov - C) / T
    cov[:, 1::2, 0::2] = cov[:, 0::2, 1::2].swapaxes(1, 2)
    cov[:, 1::2, 1::2] = (first_cov + second_cov - C - C.swapaxes(1, 2)) / (T * T)
    return Start(mean, cov)


def with_speed_prior(start: Start, sigma: float) -> Start:
    """Condition states on their horizontal velocity being N(0, sigma^2 I).

    With U = cov(x, v), S = cov(v) + sigma^2 I: x - U S^-1 v, P - U S^-1 U'. Two positions taken at nearly one time (two
    radars) tell no velocity; this keeps what is known of speeds, and changes nothing else.

    Args:
        start: states (x, vx, y, vy, z, vz, ...).
        sigma: standard deviation of each component, m/s.
    """
    v = np.array([1, 3])
    U = start.cov[:, :, v]
    S = start.cov[:, v[:, None], v] + sigma**2 * np.eye(2)
    gain = np.linalg.solve(S, U.swapaxes(-1, -2)).swapaxes(-1, -2)
    cov = start.cov - gain @ U.swapaxes(-1, -2)
    mean = start.mean - (gain @ start.mean[:, v, None])[..., 0]
    return start._replace(mean=mean, cov=0.5 * (cov + cov.swapaxes(-1, -2)))
