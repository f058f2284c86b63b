"""The multimode filter of a described model, over records of one object."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError, SaltusError
from saltus.filters import steps
from saltus.filters.coloured_run import filter_coloured
from saltus.filters.estimates import Estimates, described
from saltus.filters.linearise import Linearisation, sensor_update
from saltus.filters.merging import filter_and_tell, findings, merging_loss
from saltus.filters.refusals import check_evidence
from saltus.models import Arrays, BoundSensor, HybridModel, LinearSensor, Observer
from saltus.models.augment import coloured_sensors

__all__ = ["IMM", "Record", "in_order"]

_Array = npt.NDArray[np.float64]


class Record(NamedTuple):
    """One measurement of one object: time (s), name of the sensor, values (m,), and where the sensor was.

    The observer is left out for sensors that stand where the model puts them.
    """

    time: float
    sensor: str
    z: npt.ArrayLike
    observer: Observer | None = None


@dataclass(frozen=True, slots=True)
class IMM:
    """The interacting-multiple-model filter on the product of a model's chains.

    `IMM(model).run(records)` filters records; `IMM(per_mode=True)` holds settings, and a call with a model binds it.
    Linear sensors need none of the settings of linearisation.

    Attributes:
        model: the model it is bound to, or None.
        per_mode: keep every mode's mean and covariance.
        linearise: how each mode sees a nonlinear sensor: "extended", by the tangent at its predicted mean, or
            "cubature", by the moments of sigma points, which also covers how much the sensor bends.
        iterations: number of linearisations in an update, each about the posterior of the one before; 1 is the plain
            update.
    """

    model: HybridModel | None = None
    per_mode: bool = False
    linearise: Linearisation = "extended"
    iterations: int = 1

    def __post_init__(self) -> None:
        if self.linearise not in ("extended", "cubature"):
            raise ModelError(f'linearise is "extended" or "cubature", not {self.linearise!r}.')
        if not isinstance(self.iterations, int) or self.iterations < 1:
            raise ModelError(f"iterations must be a whole number from 1, got {self.iterations!r}.")

    def __call__(self, model: HybridModel) -> "IMM":
        """Bind the settings to a model."""
        return replace(self, model=model)

    def run(
        self, records: Iterable[Record | tuple[float, str, npt.ArrayLike] | tuple[float, str, npt.ArrayLike, Observer]]
    ) -> Estimates:
        """Filter records of one object, in time order, from any of the model's sensors, at any intervals.

        The prior holds at the first record, unless it names a time. Records of the same time are separate rows with
        no interval between them. Records of linear sensors alone go through `imm_filter`; with a nonlinear one among
        them they are taken one by one, linearised in each mode. With coloured noise `saltus.models.treatment`
        says which way is taken; the estimates are those of the model's own state.

        Args:
            records: (time, sensor, values) each, and the observer for a sensor that moves; NaN is a missing component.

        Returns:
            Estimates with one row per record.

        Raises:
            ModelError: the filter is bound to no model.
            DataError: there is no record, time goes back, or a record does not fit its sensor.
            NumericalError: an innovation covariance is not positive definite, or a predicted position coincides with
                the observer.
        """
        if self.model is None:
            raise ModelError("this filter is bound to no model: write IMM(model).run(records).")
        listed, times = in_order(records)
        sensors = self.model.sensors
        plain = all(isinstance(sensors.get(r.sensor), LinearSensor | None) and r.observer is None for r in listed)
        if coloured_sensors(self.model):
            moving = next((k for k, record in enumerate(listed) if record.observer is not None), None)
            if moving is not None:
                raise DataError(f"record {moving}: beside coloured noise sensors are linear and have no observer.")
            names, values = [record.sensor for record in listed], [record.z for record in listed]
            found = filter_coloured(self.model, names, values, times, per_mode=self.per_mode)
        else:
            found = self._at_once(self.model, listed, times) if plain else self._one_by_one(self.model, listed, times)
        return described(found, self.model, times)

    def _at_once(self, model: HybridModel, records: Sequence[Record], times: _Array) -> Estimates:
        names = [record.sensor for record in records]
        layout, arrays = model.arrays_for(times, names)
        z = layout.stack(names, [record.z for record in records])
        return filter_and_tell(z, arrays, self.per_mode)

    def _one_by_one(self, model: HybridModel, records: Sequence[Record], times: _Array) -> Estimates:
        arrays = model.compile(times=times, sensor=())
        sizes, n = arrays.probs0.shape, model.n_state
        with np.errstate(divide="ignore"):
            log_probs = np.asarray(np.log(arrays.probs0))
        belief = steps.Belief(
            log_probs, np.broadcast_to(arrays.mean0, (*sizes, n)), np.broadcast_to(arrays.cov0, (*sizes, n, n))
        )
        sensors = {name: sensor for name, sensor in model.sensors.items() if isinstance(sensor, BoundSensor)}
        rows, lost = [], []
        for k, record in enumerate(records):
            sensor = _sensor_of(sensors, record, k)
            z = _checked(record, sensor, k)
            mixed = steps.mix(*belief, [_of_row(trans, k, 2) for trans in arrays.trans])
            lost.append(float(merging_loss(belief, mixed, len(sizes))))
            row = self._step(_propagated(mixed, arrays, k), sensor, z, k)
            belief = row.belief
            rows.append(row)
        told = np.array(lost)
        return replace(_estimates(rows, self.per_mode), lost=told, findings=findings(told, n))

    def _step(self, belief: steps.Belief, sensor: BoundSensor, z: _Array, k: int) -> "_Row":
        """Condition every mode on one measurement, and the modes."""
        seen, n_chains = ~np.isnan(z), belief.log_probs.ndim
        if not seen.any():
            return _Row(belief, 0.0, 0.0, 0)
        linear = isinstance(sensor, LinearSensor)
        prediction, done = sensor_update(
            belief.means,
            belief.covs,
            sensor,
            z,
            seen,
            method="extended" if linear else self.linearise,  # exact, and once is enough
            iterations=1 if linear else self.iterations,
        )
        nis = steps.mixture_nis(belief.log_probs, prediction, z, seen, n_chains)
        log_probs, log_f = steps.reweigh(belief.log_probs, done.loglik, n_chains)
        check_evidence(log_f, prediction.y, prediction.Y, z, seen, k)
        return _Row(steps.Belief(log_probs, done.mean, done.cov), float(log_f), float(nis), int(seen.sum()))


class _Row(NamedTuple):
    """What one record leaves behind."""

    belief: steps.Belief
    log_likelihood: float
    nis: float
    n_observed: int


def in_order(
    records: Iterable[Record | tuple[float, str, npt.ArrayLike] | tuple[float, str, npt.ArrayLike, Observer]],
) -> tuple[list[Record], _Array]:
    """List records with their times.

    Raises:
        DataError: there is no record, one is none, or time goes back.
    """
    try:
        listed = [_read(Record(*record), k) for k, record in enumerate(records)]
    except TypeError as error:
        raise DataError(f"records are (time, sensor, values) each, with an observer or without: {error}.") from None
    if not listed:
        raise DataError("there is no record to filter.")
    times = np.array([record.time for record in listed], dtype=np.float64)
    back = np.flatnonzero(np.diff(times) < 0)
    if len(back):
        k = int(back[0]) + 1
        raise DataError(f"record {k} at {times[k]} s is older than record {k - 1} at {times[k - 1]} s; sort by time.")
    return listed, times


def _read(record: Record, k: int) -> Record:
    """A record with its numbers read.

    Raises:
        DataError: its time is no number, its sensor no name, or its values are no array of numbers.
    """
    if not isinstance(record.sensor, str):
        raise DataError(f"record {k}: the sensor is given by its name, got {record.sensor!r}.")
    if record.observer is not None and not isinstance(record.observer, Observer):
        raise DataError(f"record {k}: the observer must be an Observer, got {record.observer!r}.")
    try:
        time, z = np.asarray(record.time), np.asarray(record.z)
        if time.ndim or time.dtype.kind not in "biuf" or z.dtype.kind not in "biufO":
            raise TypeError("not real numbers")
        return record._replace(time=float(time), z=z.astype(np.float64))
    except (TypeError, ValueError) as error:
        raise DataError(
            f"record {k}: a time in seconds and an array of numbers, NaN for what is missing, not {record.time!r} and "
            f"{record.z!r} ({error})."
        ) from None


def _propagated(belief: steps.Belief, arrays: Arrays, k: int) -> steps.Belief:
    """Move mixed modes over the interval that ends at record k."""
    n_chains = belief.log_probs.ndim
    b = None if arrays.b is None else _of_row(arrays.b, k, n_chains + 1)
    F, Q = _of_row(arrays.F, k, n_chains + 2), _of_row(arrays.Q, k, n_chains + 2)
    return steps.Belief(belief.log_probs, *steps.propagate(belief.means, belief.covs, F, b, Q))


def _of_row(a: _Array, k: int, n_constant: int) -> _Array:
    return a[k if len(a) > 1 else 0] if a.ndim > n_constant else a


def _sensor_of(sensors: Mapping[str, BoundSensor], record: Record, k: int) -> BoundSensor:
    if record.sensor not in sensors:
        raise DataError(f"record {k}: the model has no sensor {record.sensor!r}. Sensors: {', '.join(sensors)}.")
    try:
        return sensors[record.sensor].at(float(record.time), record.observer)
    except SaltusError as error:
        raise DataError(f"record {k}, sensor {record.sensor!r}: {error}") from None


def _checked(record: Record, sensor: BoundSensor, k: int) -> _Array:
    z = np.asarray(record.z, dtype=np.float64)
    m = sensor.noise().shape[-1]
    if z.shape != (m,):
        raise DataError(f"record {k}: sensor {record.sensor!r} measures {m} component(s), got shape {z.shape}.")
    if np.isinf(z).any():
        raise DataError(f"record {k}: sensor {record.sensor!r} gives {z.tolist()}. NaN marks what is missing.")
    return z


def _estimates(rows: Sequence[_Row], per_mode: bool) -> Estimates:
    def column(values: Iterator[npt.ArrayLike]) -> _Array:
        return np.array(list(values), dtype=np.float64)

    beliefs = [row.belief for row in rows]
    log_probs, means, covs = (np.stack(part) for part in zip(*beliefs, strict=True))
    mean, cov = steps.collapse(log_probs, means, covs, log_probs.ndim - 1)
    return Estimates(
        probs=np.exp(log_probs),
        mean=mean,
        cov=cov,
        log_likelihood=column(row.log_likelihood for row in rows),
        log_likelihood_start=np.zeros(()),
        nis=column(row.nis for row in rows),
        n_observed=column(row.n_observed for row in rows),
        mode_means=means if per_mode else None,
        mode_covs=covs if per_mode else None,
    )
