"""`ParticleFilter`: one name for the particle filters, which takes the form that the model allows."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError
from saltus.filters.align import align
from saltus.filters.bootstrap import Moves, bootstrap, diffusion_moves, hybrid_moves
from saltus.filters.estimates import Estimates, described
from saltus.filters.flat import flatten
from saltus.filters.observation import elapsed, measured, observation
from saltus.filters.particles import generator
from saltus.filters.rao_blackwell import check_groups, particle_filter
from saltus.filters.run import Record, in_order
from saltus.models import DiffusionSensor, HybridModel, LinearSensor, Observer, SwitchingSDE, as_diffusion_sensor

__all__ = ["BoundParticleFilter", "ParticleFilter"]

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ParticleFilter:
    """The Bayes filter by random draws: exact in the limit, for any model, with a stated error.

    A hybrid model whose sensors are linear is filtered by Rao-Blackwellised particles (`particle_filter`): only modes
    are drawn. Everything else by particles that hold the state too (`saltus.filters.bootstrap`).

    Attributes:
        n: number of particles for each run of measurements.
        groups: independent filters they are divided among; their spread is the error.
        proposal: of particles that hold the state: "bootstrap" moves them by the model, "auxiliary" draws those that
            lead to the measurement before moving.
        substeps: Euler steps of a switching diffusion between two measurements.
    """

    n: int
    groups: int = 8
    proposal: Literal["bootstrap", "auxiliary"] = "bootstrap"
    substeps: int = 5

    def __post_init__(self) -> None:
        check_groups(self.n, self.groups)
        if self.proposal not in ("bootstrap", "auxiliary"):
            raise ModelError(f'proposal is "bootstrap" or "auxiliary", not {self.proposal!r}.')
        if self.substeps < 1:
            raise ModelError(f"substeps must be at least 1, got {self.substeps}.")

    def __call__(self, model: HybridModel) -> "BoundParticleFilter":
        """Bind the settings to a hybrid model, for records."""
        return BoundParticleFilter(self, model)

    def run(
        self,
        model: SwitchingSDE | HybridModel,
        sensor: DiffusionSensor | str | Sequence[str] | None,
        z: npt.ArrayLike,
        times: npt.ArrayLike,
        rng: np.random.Generator | None = None,
        *,
        t0: float = 0.0,
    ) -> Estimates:
        """Filter runs of measurements, all at the same times.

        Args:
            model: a switching diffusion, or a hybrid model.
            sensor: what is measured; for a hybrid model a name, several, or None for all its sensors stacked.
            z: measurements, (..., T, m); NaN is missing.
            times: times of the measurements, (T,), s.
            rng: source of randomness; without one there is no answer.
            t0: when the prior holds, s.

        Returns:
            Estimates with probs (..., T, S), for a hybrid model (..., T, M1, ..., MC). `error` is the distance, in
            posterior standard deviations, within which the exact mean lies at 95 % confidence.

        Raises:
            ModelError: no rng, or model and sensor do not fit.
            DataError: shapes do not fit, times decrease, or a measurement is impossible for every particle.
        """
        source = generator(rng)
        if isinstance(model, HybridModel):
            names = list(model.sensors) if sensor is None else [sensor] if isinstance(sensor, str) else sensor
            if isinstance(names, DiffusionSensor):
                raise ModelError("a hybrid model has its own sensors: give a name, or None for all, stacked.")
            return self._hybrid(model, list(names), measured(z, "z"), measured(times, "times"), t0, source)
        given = observation(model, sensor, z, times, t0)
        found = self._drawn(
            diffusion_moves(given.model, given.dts, self.substeps), given.sensor, given.z, given.dts, source
        )
        return _shaped(found, given.batch, (given.model.n_modes,), given.times)

    def _hybrid(
        self, model: HybridModel, names: Sequence[str], z: _Array, times: _Array, t0: float, rng: np.random.Generator
    ) -> Estimates:
        if times.ndim != 1 or z.ndim < 2 or z.shape[-2] != len(times):
            raise DataError(f"z must be (..., T, m) for T times (T,); got z {z.shape} and times {times.shape}.")
        dts = elapsed(times, t0)
        if all(isinstance(model.sensors.get(name), LinearSensor | None) for name in names):
            arrays = model.compile(dt=dts, sensor=names)._asdict()
            found = particle_filter(z, **arrays, n_particles=self.n, groups=self.groups, rng=rng)
            return described(found, model, times)
        sensor = as_diffusion_sensor(model, names)
        arrays = model.compile(dt=dts, sensor=())._asdict()
        C, n = len(model.chains), model.n_state
        arrays["H"], arrays["R"] = np.zeros((1,) * C + (1, n)), np.ones((1,) * C + (1, 1))  # nothing linear is seen
        flat = flatten(align(np.zeros((len(times), 1)), **arrays))
        found = self._drawn(hybrid_moves(flat), sensor, z.reshape(-1, *z.shape[-2:]), dts, rng)
        return described(_shaped(found, z.shape[:-2], model.sizes, times), model, times)

    def _drawn(
        self, moves: Moves, sensor: DiffusionSensor, z: _Array, dts: _Array, rng: np.random.Generator
    ) -> Estimates:
        size = check_groups(self.n, self.groups)
        ahead = self.proposal == "auxiliary"
        return bootstrap(moves, sensor, z, dts, size=size, groups=self.groups, auxiliary=ahead, rng=rng)


@dataclass(frozen=True, slots=True)
class BoundParticleFilter:
    """A particle filter with its hybrid model."""

    settings: ParticleFilter
    model: HybridModel

    def run(
        self,
        records: Iterable[Record | tuple[float, str, npt.ArrayLike] | tuple[float, str, npt.ArrayLike, Observer]],
        *,
        rng: np.random.Generator | None = None,
    ) -> Estimates:
        """Filter records of one object, in time order; the prior holds at the first, unless it names a time.

        Args:
            records: (time, sensor, values) each; NaN is a missing component.
            rng: source of randomness.

        Raises:
            ModelError: no rng, or a sensor that moves or depends on t and is not linear.
            DataError: there is no record, time goes back, or a record does not fit its sensor.
        """
        source = generator(rng)
        listed, times = in_order(records)
        for k, record in enumerate(listed):
            if record.sensor not in self.model.sensors:
                known = ", ".join(self.model.sensors)
                raise DataError(f"record {k}: the model has no sensor {record.sensor!r}. Sensors: {known}.")
            if record.observer is not None:
                raise DataError(f"record {k}: particles take sensors that stand still; leave the observer out.")
        names = [name for name in self.model.sensors if name in {record.sensor for record in listed}]
        z = self._stacked(listed, names)
        given = self.model.prior.time
        t0 = float(times[0]) if given is None else given
        return self.settings.run(self.model, names, z, times, source, t0=t0)

    def _stacked(self, records: Sequence[Record], names: Sequence[str]) -> _Array:
        """One row per record, with NaN for the components of the other sensors."""
        now = self.model.sensors
        sizes = [now[name].at(float(records[0].time)).noise().shape[-1] for name in names]  # type: ignore[attr-defined]  # a HybridModel's sensors are bound
        first = dict(zip(names, np.cumsum([0, *sizes]), strict=False))
        z = np.full((len(records), sum(sizes)), np.nan)
        for k, record in enumerate(records):
            size = sizes[names.index(record.sensor)]
            values = np.asarray(record.z, np.float64)
            if values.shape != (size,):
                raise DataError(
                    f"record {k}: sensor {record.sensor!r} measures {size} component(s), got shape {values.shape}."
                )
            z[k, first[record.sensor] : first[record.sensor] + size] = values
        return z


def _shaped(found: Estimates, batch: tuple[int, ...], sizes: tuple[int, ...], times: _Array) -> Estimates:
    """Give (B, T, ...) its batch axes, and the modes theirs."""
    T = len(times)

    def rows(a: _Array | None) -> _Array:
        if a is None:
            raise TypeError("a particle filter has an error and an effective size")
        return a.reshape(*batch, T, *a.shape[2:])

    return replace(
        found,
        probs=found.probs.reshape(*batch, T, *sizes),
        mean=rows(found.mean),
        cov=rows(found.cov),
        log_likelihood=rows(found.log_likelihood),
        log_likelihood_start=np.zeros(batch),
        nis=rows(found.nis),
        n_observed=rows(found.n_observed),
        error=rows(found.error),
        effective=rows(found.effective),
        times=times,
    )
