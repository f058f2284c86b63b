"""A bank of multimode filters over some axes of space, and what it is begun with and told."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.filters import Bank, Belief
from saltus.models import Chain, Motion
from saltus.tracks.colour import Colours
from saltus.tracks.intervals import Matrices
from saltus.tracks.modes import Mode

__all__ = ["MOTION", "Channel", "Plan", "Start", "make_channel"]

_Array = npt.NDArray[np.float64]
_Rows = npt.NDArray[np.intp]

_HEIGHT = 2  # component of a measurement
MOTION = 6  # states of position and velocity; those of lasting errors follow


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


def make_channel(axes: list[int], chains: tuple[Chain, ...], motion: Motion) -> Channel:
    """Make an empty channel over axes, of chains and a motion that depends on them."""
    bank = Bank(2 * len(axes), tuple(len(chain) for chain in chains))
    position = 2 * np.array(axes)
    states = np.stack([position, position + 1], axis=-1).ravel()
    turns = tuple(k for k, mode in enumerate(chains[0].values) if isinstance(mode, Mode) and mode.turn)
    return Channel(np.array(axes), chains, states, motion.bind(chains), turns, bank)
