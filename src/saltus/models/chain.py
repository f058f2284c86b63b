"""Finite Markov chains: what jumps, between which states, and how fast."""

from collections.abc import Mapping, Sequence
from dataclasses import InitVar, dataclass, field

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.models.checks import FloatArray, intervals, numbers, same, unit_steps
from saltus.models.markov import (
    Labelled,
    generator,
    initial_law,
    jump_matrices,
    logarithm,
    sojourn_matrix,
    stay_matrix,
    stochastic,
)
from saltus.shapes import Float

__all__ = ["RESERVED", "Chain"]

RESERVED = ("x", "t", "dt")  # words a matrix function may ask for besides chains


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """A finite Markov chain with named states.

    trans[i, j] = P(next = j | now = i) per step, or over any interval trans(dt) = expm(rates dt).

    Exactly one description of the jumps is given: `trans`, `stay`, `sojourn` or `rates`. `trans` and `stay` hold per
    step, or per `per` seconds; without a time they serve equal intervals only. A chain whose rows are equal is
    memoryless: drawn afresh at every measurement.

    Args:
        name: how functions and results refer to the chain.
        states: label -> value handed to matrix functions, or labels alone (then the value is the label).
        trans: row-stochastic matrix, (M, M).
        per: seconds that `trans` or `stay` refers to.
        rates: generator, (M, M), 1/s: off-diagonal not negative, rows sum to 0.
        initial: law of the first state, (M,) or label -> probability; by default the stationary law.
        stay: probability of staying, one number or label -> number; the rest is shared equally by the other states.
        sojourn: label -> mean seconds before leaving (inf: never); the other states are equally likely next.

    Raises:
        ModelError: the description is incomplete, contradictory or not a Markov chain.
    """

    name: str
    states: Mapping[str, object] | Sequence[str]
    trans: npt.ArrayLike | None = field(default=None, kw_only=True)
    per: float | None = field(default=None, kw_only=True)
    rates: npt.ArrayLike | None = field(default=None, kw_only=True)
    initial: npt.ArrayLike | Mapping[str, float] | None = field(default=None, kw_only=True)
    stay: InitVar[float | Mapping[str, float] | None] = field(default=None, kw_only=True)
    sojourn: InitVar[Mapping[str, float] | None] = field(default=None, kw_only=True)
    _rates: FloatArray | None = field(init=False, repr=False)  # generator, given or the logarithm of trans

    def __post_init__(self, stay: float | Mapping[str, float] | None, sojourn: Mapping[str, float] | None) -> None:
        put = object.__setattr__
        put(self, "states", _states(self.name, self.states))
        given = {"trans": self.trans, "stay": stay, "sojourn": sojourn, "rates": self.rates}
        named = [word for word, value in given.items() if value is not None]
        if len(named) != 1:
            raise ModelError(
                f"chain {self.name!r} needs exactly one of trans=, stay=, sojourn=, rates=; "
                f"got {', '.join(named) or 'none'}."
            )
        self._check_per(named[0])
        me = Labelled(self.name, self.labels)
        if self.rates is not None or sojourn is not None:
            rates = self.rates if sojourn is None else sojourn_matrix(me, sojourn)
            put(self, "rates", generator(me, rates))
            put(self, "_rates", self.rates)
        else:
            trans = stochastic(me, self.trans if stay is None else stay_matrix(me, stay))
            put(self, "trans", trans)
            put(self, "_rates", None if self.per is None else logarithm(trans, self.per))
        jumps = self.trans if self.rates is None else self.rates
        put(self, "initial", initial_law(me, self.initial, np.asarray(jumps)))

    def _check_per(self, description: str) -> None:
        if self.per is None:
            return
        if description in ("sojourn", "rates"):
            raise ModelError(
                f"chain {self.name!r}: per= goes with trans= or stay=; {description}= is already in seconds."
            )
        per = numbers(self.per, f"chain {self.name!r}: per")
        if per.ndim or per <= 0:
            raise ModelError(f"chain {self.name!r}: per must be a positive number of seconds, got {self.per}.")
        object.__setattr__(self, "per", float(per))

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    def __len__(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the states, in order."""
        return tuple(self.states)

    @property
    def values(self) -> tuple[object, ...]:
        """What matrix functions receive for each state."""
        return tuple(self.states.values()) if isinstance(self.states, Mapping) else tuple(self.states)

    @property
    def law(self) -> Float[np.ndarray, " m"]:
        """Law of the first state, (M,)."""
        return np.asarray(self.initial)

    @property
    def generator(self) -> Float[np.ndarray, "m m"]:
        """Rates of the jumps, (M, M), 1/s: as given, or the logarithm of `trans` per `per` seconds.

        Raises:
            ModelError: there are none, because the chain jumps per step.
        """
        if self._rates is None:
            raise ModelError(f"chain {self.name!r} has no rates per second: give sojourn=, rates=, or per= with trans.")
        return self._rates

    @property
    def memoryless(self) -> bool:
        """Whether the next state does not depend on the present one (all rows of `trans` equal)."""
        if self.trans is None:
            return len(self) == 1
        trans = np.asarray(self.trans)
        return bool(np.abs(trans - trans[0]).max() < 1e-12)

    def index(self, label: str) -> int:
        """Position of a state.

        Raises:
            ModelError: no state has this label.
        """
        if label not in self.labels:
            raise ModelError(f"chain {self.name!r} has no state {label!r}; it has {', '.join(self.labels)}.")
        return self.labels.index(label)

    def transition(self, dt: npt.ArrayLike) -> Float[np.ndarray, "*lead m m"]:
        """Transition matrices over intervals: expm(rates dt), or whole steps of a chain that has no rates.

        Args:
            dt: intervals, (...), s.

        Returns:
            (..., M, M), rows sum to 1; the identity where dt is 0, except for a memoryless chain per step.

        Raises:
            ModelError: a chain per step with unequal intervals, or `per` without a generator and a dt that is not a
                multiple of it.
        """
        interval = intervals(dt)
        if self._rates is not None:
            return jump_matrices(self._rates, interval)
        trans = np.asarray(self.trans)
        if self.per is None and self.memoryless:
            return np.broadcast_to(trans, (*interval.shape, *trans.shape)).copy()
        count, which = np.unique(self._steps(interval), return_inverse=True)
        powers = np.stack([np.linalg.matrix_power(trans, int(k)) for k in count])
        return np.asarray(powers[which.reshape(interval.shape)])

    def _steps(self, interval: FloatArray) -> npt.NDArray[np.int64]:
        if self.per is None:
            remedy = "Give the time it refers to (per=seconds), or sojourn= or rates=."
            return unit_steps(interval, f"the transition matrix of chain {self.name!r}", remedy)
        steps = np.asarray(np.rint(interval / self.per))
        off = np.asarray(np.abs(interval - steps * self.per))
        if off.size and off.max() > 1e-3 * self.per:
            raise ModelError(
                f"chain {self.name!r} cannot jump over {interval.flat[off.argmax()]:g} s: no chain in continuous "
                f"time has its transition matrix after {self.per:g} s, so only multiples of that are possible.\n"
                "Give sojourn= or rates=; for a memoryless chain leave per= out."
            )
        return np.asarray(steps, dtype=np.int64)


def _states(name: str, states: Mapping[str, object] | Sequence[str]) -> dict[str, object]:
    if not isinstance(name, str) or not name or name in RESERVED:
        raise ModelError(f"a chain's name must be a word other than {', '.join(RESERVED)}; got {name!r}.")
    if not isinstance(states, Mapping | Sequence):
        raise ModelError(f"chain {name!r} needs states: a mapping label -> value or a list of labels; got {states!r}.")
    pairs = list(states.items()) if isinstance(states, Mapping) else [(label, label) for label in states]
    labels = [label for label, _ in pairs]
    if isinstance(states, str) or not labels or not all(isinstance(label, str) for label in labels):
        raise ModelError(f"chain {name!r} needs states: a mapping label -> value or a list of labels; got {states!r}.")
    twice = sorted({label for label in labels if labels.count(label) > 1})
    if twice:
        raise ModelError(f"chain {name!r} has two states called {twice[0]!r}; give each its own label.")
    return dict(pairs)
