"""A whole model: chains, motion, sensors and prior, and the arrays a filter takes."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError
from saltus.models.arrays import Arrays, Layout, stack_sensors
from saltus.models.chain import Chain
from saltus.models.checks import FloatArray, intervals, numbers, same
from saltus.models.dependence import fixed
from saltus.models.dynamics import Dynamics, Step
from saltus.models.gaussian import Gaussian
from saltus.models.sensors import BoundSensor, LinearSensor, Measured, Sensor

if TYPE_CHECKING:
    from saltus.models.findings import Finding

__all__ = ["HybridModel"]

_MOST_CHAINS, _MOST_MODES = 24, 100_000  # each joint mode carries matrices; arrays have one axis for each chain


@dataclass(frozen=True, slots=True, eq=False)
class HybridModel:
    """A continuous state whose motion and measurements depend on independent hidden Markov chains.

    x(t_k) = F x(t_{k-1}) + b + w,  z_k = H x(t_k) + d + v, or h(x(t_k)) + v of a nonlinear sensor; each matrix depends
    on the chains it names.

    When built, functions of chains are called once per combination of states and only arrays are kept, so that models
    can be compared, printed and pickled; functions that also ask for `t` or `dt` are kept.

    Args:
        chains: independent chains, in the order of the mode axes; none for a Kalman filter.
        dynamics: LinearSDE, LinearTransition, constant_velocity(...), ...
        sensors: name -> sensor.
        prior: law of the first state.

    Raises:
        ModelError: a name is used twice or unknown, or dimensions do not fit.
    """

    chains: Sequence[Chain]
    dynamics: Dynamics
    sensors: Mapping[str, Sensor]
    prior: Gaussian

    def __post_init__(self) -> None:
        put = object.__setattr__
        chains = tuple(self.chains) if isinstance(self.chains, Iterable) else (self.chains,)
        if not all(isinstance(chain, Chain) for chain in chains):
            raise ModelError(f"chains is a list of Chain, [] for none; got {self.chains!r}.")
        names = [chain.name for chain in chains]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ModelError(f"two chains are called {twice[0]!r}; give each its own name.")
        if prod(len(chain) for chain in chains) > _MOST_MODES or len(chains) > _MOST_CHAINS:
            sizes = " x ".join(str(len(chain)) for chain in chains[:8]) + (" x ..." if len(chains) > 8 else "")
            raise ModelError(
                f"the chains have {sizes} joint states: at most {_MOST_CHAINS} chains and {_MOST_MODES} joint states "
                "can be computed. Leave chains out, or join those that always jump together."
            )
        if not isinstance(self.sensors, Mapping) or not self.sensors:
            raise ModelError("a model needs at least one sensor: sensors={'radar': PositionSensor(...)}.")
        put(self, "chains", chains)
        put(self, "dynamics", self.dynamics.bind(chains))
        n = self.dynamics.dimension()
        put(self, "sensors", {name: _bind_sensor(name, s, chains, n) for name, s in self.sensors.items()})
        put(self, "prior", self.prior.bind(chains))
        mean = fixed(self.prior.mean, "Gaussian mean")
        if mean.shape[-1] != n:
            raise ModelError(f"the prior has {mean.shape[-1]} components, but the dynamics has {n}.")

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    @property
    def n_state(self) -> int:
        """Dimension of the continuous state."""
        return self.dynamics.dimension()

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of states of each chain."""
        return tuple(len(chain) for chain in self.chains)

    @property
    def n_modes(self) -> int:
        """Number of joint modes."""
        return prod(self.sizes)

    def chain(self, name: str) -> Chain:
        """The chain of this name.

        Raises:
            ModelError: there is none.
        """
        for chain in self.chains:
            if chain.name == name:
                return chain
        known = ", ".join(c.name for c in self.chains) or "none"
        raise ModelError(f"no chain is called {name!r}. Chains: {known}.")

    def compile(
        self,
        *,
        times: npt.ArrayLike | None = None,
        dt: npt.ArrayLike | None = None,
        sensor: str | Sequence[str] | None = None,
    ) -> Arrays:
        """Lower the model to the arrays of `imm_filter`.

        With `times`, the prior holds at the prior's time, by default at times[0]: the first interval then has length
        0. With `dt`, it holds one interval before the first measurement.

        Args:
            times: times of the measurements, (T,), s, not decreasing.
            dt: one interval for all steps, or the interval before each measurement, (T,), s.
            sensor: the sensor that measures in every row, or several, stacked; by default all. With none, `()`, H and
                R have no rows, and any sensors may be left to a filter that linearises them.

        Returns:
            Arrays, without a time axis where all intervals are equal.

        Raises:
            ModelError: not exactly one of times and dt, an unknown sensor, or a description that does not serve
                these intervals.
            DataError: times decrease, or start before the prior.
        """
        if (times is None) == (dt is None):
            raise ModelError("compile needs exactly one of times= and dt=.")
        t = None if times is None else _checked_times(times)
        step = intervals(dt) if t is None else np.diff(t, prepend=self._prior_time(t))
        if step.ndim > 1:
            raise ModelError(f"dt must be one interval or one per step (T,), got shape {step.shape}.")
        motion, trans = self._moves(step, t)
        seen = self._measured(_names(sensor, list(self.sensors)), t)
        mean0 = fixed(self.prior.mean, "Gaussian mean")
        cov0 = fixed(self.prior.cov, "Gaussian cov")
        probs0 = np.ones(())
        for chain in self.chains:
            probs0 = probs0[..., None] * chain.law
        return Arrays(motion.F, motion.Q, seen.H, seen.R, trans, motion.b, seen.d, mean0, cov0, probs0)

    def arrays_for(
        self, times: npt.ArrayLike, sensor_names: Sequence[str] | npt.NDArray[np.generic]
    ) -> tuple[Layout, Arrays]:
        """Lower the model for one object seen by several sensors at irregular times.

        The components of all sensors that occur are stacked; in each row all but those of the sensor that measured
        are missing: `layout.stack(sensor_names, measurements)` makes the z that goes with the arrays.

        Args:
            times: time of each row, (T,), s, not decreasing.
            sensor_names: sensor of each row, (T,).

        Returns:
            The layout of z, and the arrays of `compile`.

        Raises:
            DataError: times decrease, lengths differ, or a sensor is not part of the model.
        """
        t = _checked_times(times)
        if len(sensor_names) != len(t):
            raise DataError(f"{len(sensor_names)} sensor names for {len(t)} times.")
        for row, name in enumerate(sensor_names):
            if name not in self.sensors:
                raise DataError(f"row {row}: the model has no sensor {name!r}. Sensors: {', '.join(self.sensors)}.")
        present = [name for name in self.sensors if name in set(sensor_names)]
        columns, first = {}, 0
        for name in present:
            size = self._sensor(name).measured(t[:1]).H.shape[-2]
            columns[name] = slice(first, first + size)
            first += size
        return Layout(columns, first), self.compile(times=t, sensor=present)

    def check(self, times: npt.ArrayLike | None = None) -> "list[Finding]":
        """Say what is doubtful about the model: a list of findings, empty when nothing is.

        Args:
            times: of the measurements it is meant for, s, where they are known: see `saltus.models.findings.check`.
        """
        from saltus.models.findings import check

        return check(self, times)

    def _sensor(self, name: str) -> LinearSensor:
        sensor = self.sensors[name]
        if not isinstance(sensor, LinearSensor):
            raise ModelError(
                f"sensor {name!r} is not linear: a {type(sensor).__name__} has no matrices.\n"
                "IMM(model).run(records) linearises it; compile takes the linear ones with sensor=[...], and where "
                "its noise is coloured, augmented(model) compiles."
            )
        return sensor

    def _prior_time(self, t: FloatArray) -> float:
        if self.prior.time is None:
            return float(t[0])
        if self.prior.time > t[0]:
            raise DataError(f"the prior holds at {self.prior.time:g} s, after the first measurement at {t[0]:g} s.")
        return self.prior.time

    def _moves(self, step: FloatArray, t: FloatArray | None) -> tuple[Step, tuple[FloatArray, ...]]:
        """Motion and transitions; each distinct (interval, time if asked for) is computed once."""
        ends = t if t is not None and _asks_for_t(self.dynamics) else None
        key = step.reshape(-1, 1) if ends is None else np.stack([step, ends], axis=-1)
        rows, which = np.unique(key, axis=0, return_inverse=True)
        motion = self.dynamics.step(rows[:, 0], None if ends is None else rows[:, 1])
        lengths, length_of = np.unique(step.reshape(-1), return_inverse=True)
        trans = tuple(chain.transition(lengths)[_pick(lengths, length_of)] for chain in self.chains)
        take = _pick(rows, which)
        b = None if motion.b is None else motion.b[take]
        return Step(motion.F[take], motion.Q[take], b), trans

    def _measured(self, names: Sequence[str], t: FloatArray | None) -> Measured:
        if not names:
            H = np.zeros((*(1,) * len(self.chains), 0, self.n_state))
            return Measured(H, H[..., :0], None)
        return stack_sensors([self._sensor(name).measured(t) for name in names])


def _bind_sensor(name: str, sensor: Sensor, chains: Sequence[Chain], n_state: int) -> BoundSensor:
    try:
        bound = sensor.bind(chains, n_state)
    except ModelError as error:
        raise ModelError(f"sensor {name!r}: {error}") from None
    if not isinstance(bound, BoundSensor):
        raise ModelError(f"sensor {name!r}: bind gave {type(bound).__name__}, which lacks at() or noise().")
    return bound


def _names(sensor: str | Sequence[str] | None, known: list[str]) -> list[str]:
    if sensor is not None and not isinstance(sensor, Iterable):
        raise ModelError(f"sensor is a name, several, or None for all; got {sensor!r}.")
    names = known if sensor is None else [sensor] if isinstance(sensor, str) else list(sensor)
    for name in names:
        if name not in known:
            raise ModelError(f"the model has no sensor {name!r}. Sensors: {', '.join(known)}.")
    return names


def _checked_times(times: npt.ArrayLike) -> FloatArray:
    t = numbers(times, "times")
    if t.ndim != 1 or not len(t):
        raise DataError(f"times must be a non-empty vector (T,), got shape {t.shape}.")
    late = np.flatnonzero(np.diff(t) < 0)
    if len(late):
        row = int(late[0]) + 1
        raise DataError(f"times decrease at row {row}: {t[row]:.6f} s after {t[row - 1]:.6f} s. Sort by time first.")
    return t


def _asks_for_t(dynamics: Dynamics) -> bool:
    words = [getattr(getattr(dynamics, name, None), "words", ()) for name in ("F", "Q", "b")]
    return any("t" in w for w in words)


def _pick(rows: FloatArray, which: npt.NDArray[np.intp]) -> npt.NDArray[np.intp] | int:
    """Index of each row's matrices, or 0 (no time axis) when there is one for all."""
    return 0 if len(rows) == 1 else which.reshape(-1)
