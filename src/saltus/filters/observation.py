"""What the filters of switching diffusions share: reading their arguments, and the innovation of a weighted sum."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError
from saltus.filters.refusals import NotPositive
from saltus.linalg import gaussian_terms
from saltus.models import DiffusionSensor, HybridModel, SwitchingSDE, as_diffusion
from saltus.shapes import Bool, Float

__all__ = ["Observation", "elapsed", "impossible", "innovation_nis", "measured", "observation"]


class Observation(NamedTuple):
    """A model, its sensor, and B runs of measurements at T times, checked."""

    model: SwitchingSDE
    sensor: DiffusionSensor
    z: Float[np.ndarray, "b t m"]
    dts: Float[np.ndarray, " t"]  # interval before each measurement, s
    times: Float[np.ndarray, " t"]
    batch: tuple[int, ...]

    @property
    def seen(self) -> Bool[np.ndarray, "b t m"]:
        """Which components were measured."""
        return np.asarray(~np.isnan(self.z))


def observation(
    model: SwitchingSDE | HybridModel,
    sensor: DiffusionSensor | str | Sequence[str] | None,
    z: npt.ArrayLike,
    times: npt.ArrayLike,
    t0: float,
) -> Observation:
    """Check the arguments of `run`; a hybrid model is lowered, and its sensor given by name.

    Raises:
        ModelError: model and sensor do not fit, or are of different kinds.
        DataError: shapes do not fit, times decrease or precede t0, or z holds an infinity.
    """
    if isinstance(model, HybridModel):
        if isinstance(sensor, DiffusionSensor):
            raise ModelError("a hybrid model has its own sensors: give a name, or None for all, stacked.")
        model, sensor = as_diffusion(model, sensor)
    if not isinstance(model, SwitchingSDE):
        raise ModelError(f"the model must be a SwitchingSDE or a HybridModel, got {type(model).__name__}.")
    if not isinstance(sensor, DiffusionSensor):
        raise ModelError(f"a switching diffusion needs a DiffusionSensor, got {type(sensor).__name__}.")
    m = sensor.check(model.means0)
    seen, t = measured(z, "z"), measured(times, "times")
    if seen.ndim < 2 or t.shape != seen.shape[-2:-1] or seen.shape[-1] != m or not len(t):
        raise DataError(f"z must be (..., T, {m}) for T times (T,), T >= 1; got z {seen.shape} and times {t.shape}.")
    if not seen.size:
        raise DataError(f"z holds no run: its shape is {seen.shape}.")
    if np.isinf(seen).any():
        raise DataError(f"z holds infinity at {np.argwhere(np.isinf(seen))[0].tolist()}; a missing component is NaN.")
    dts = elapsed(t, t0)
    return Observation(model, sensor, seen.reshape(-1, *seen.shape[-2:]), dts, t, seen.shape[:-2])


def measured(value: npt.ArrayLike, what: str) -> Float[np.ndarray, "..."]:
    """Read an array of numbers.

    Raises:
        DataError: it is ragged, or not of numbers.
    """
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"{what} must be an array of numbers, with NaN for what is missing: {error}.") from None


def elapsed(times: Float[np.ndarray, " t"], t0: float) -> Float[np.ndarray, " t"]:
    """Intervals before each of the times, the first from t0.

    Raises:
        DataError: times decrease, precede t0, or are not finite.
    """
    dts = np.diff(times, prepend=t0)
    if not np.isfinite(dts).all():
        row = int(np.argmin(np.isfinite(times)))
        raise DataError(f"times must be finite: t0 is {t0:g} s, row {row} has {times[row]:g} s. Leave such rows out.")
    if dts.min() < 0:
        raise DataError(
            f"times must not decrease, nor precede t0 = {t0:g} s: row {int(dts.argmin())} comes "
            f"{-dts.min():g} s too early. Sort by time, or say when the prior holds: t0=."
        )
    return dts


def impossible(
    sensor: DiffusionSensor,
    z: Float[np.ndarray, " m"],
    states: Sequence[tuple[int, Float[np.ndarray, "_ n"]]],
    run: int,
    row: int,
) -> str:
    """Name a measurement that no state explains, and the component of it that is farthest from the nearest state.

    Args:
        sensor: what is measured.
        z: one measurement; NaN is missing.
        states: mode, and states in it.
        run: number of the run.
        row: number of the row.
    """
    nearest, component = np.inf, int(np.argmin(np.isnan(z)))
    for mode, x in states:
        if not len(x):
            continue
        sigma = np.sqrt(np.diagonal(sensor.noise_at(mode, x), axis1=-2, axis2=-1))
        nu = z - sensor.h_at(mode, x) if sensor.continuous else sensor.residual(z, sensor.h_at(mode, x))
        away = np.where(np.isnan(z), 0.0, np.abs(nu) / sigma)
        least = away.max(axis=-1).argmin()
        if away[least].max() < nearest:
            nearest, component = away[least].max(), int(away[least].argmax())
    return f"row {row}: measurement {z} of run {run}, component {component},"


def innovation_nis(
    sensor: DiffusionSensor,
    z: Float[np.ndarray, "b m"],
    dt: float,
    nodes: Sequence[tuple[Float[np.ndarray, "*_lead n"], Float[np.ndarray, "b _q"]]],
) -> Float[np.ndarray, " b"]:
    """Nu' S^-1 nu of the predicted measurement, nu and S the moments of z - h(x) over weighted nodes.

    S is summed about nu, never as a difference of squares: it stays positive however far off z is.

    Args:
        sensor: what is measured.
        z: one measurement of each run; NaN is missing.
        dt: the interval, for a continuous sensor.
        nodes: per mode the states (q, n) or (b, q, n) and their probabilities (b, q), which sum to 1 over all modes;
            0 for a run where all are 0.

    Raises:
        NumericalError: a measured component has neither noise nor spread.
    """
    seen = ~np.isnan(z)
    filled, m = np.where(seen, z, 0.0)[:, None], z.shape[-1]
    off, weights, S = [], [], np.zeros((len(z), m, m))
    for mode, (x, w) in enumerate(nodes):
        h = sensor.h_at(mode, x)
        off.append(filled - dt * h if sensor.continuous else sensor.residual(filled, h))
        weights.append(w[..., None])
        noise = sensor.R[mode]
        if callable(noise):
            S += np.einsum("bq,...qij->bij", w, sensor.noise_at(mode, x))
        else:
            S += w.sum(-1)[:, None, None] * np.asarray(noise) * (dt if sensor.continuous else 1.0)
    nu = np.asarray(sum((w * e).sum(1) for w, e in zip(weights, off, strict=True)))
    with np.errstate(over="ignore", invalid="ignore"):
        # About the mean: squares of what is left, where raw second moments of an outlier would leave their rounding.
        for w, e in zip(weights, off, strict=True):
            left = e - nu[:, None]
            S += np.swapaxes(w * left, -1, -2) @ left
    known = np.asarray(np.isfinite(S).all(axis=(-1, -2)))
    there = seen & known[:, None] & (np.sum([w.sum((-1, -2)) for w in weights], axis=0) > 0)[:, None]
    S = np.where(there[:, :, None] & there[:, None, :], S, np.eye(m))
    try:
        d2 = gaussian_terms(np.where(there, nu, 0.0), S)[0]
    except np.linalg.LinAlgError as error:
        raise NotPositive("the measurement") from error
    return np.where(seen.any(-1), np.where(known, d2, np.inf), 0.0)
