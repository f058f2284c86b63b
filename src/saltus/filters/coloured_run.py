"""Records of a model with coloured noise, filtered the way the model layer chooses."""

import logging
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from saltus.filters import steps
from saltus.filters.coloured import of_state, run_differenced
from saltus.filters.coloured_model import Augmented
from saltus.filters.estimates import Estimates
from saltus.filters.imm import imm_filter
from saltus.models import Arrays, HybridModel
from saltus.models.augment import augmented, coloured_sensors, treatment
from saltus.models.dependence import fixed

__all__ = ["filter_coloured"]

_Array = npt.NDArray[np.float64]


def filter_coloured(
    model: HybridModel,
    names: Sequence[str],
    measurements: Sequence[npt.ArrayLike],
    times: npt.NDArray[np.float64],
    *,
    per_mode: bool,
) -> Estimates:
    """Filter records of linear sensors, some of them with coloured noise; one row per record, of the model's state.

    The way, from `saltus.models.treatment`, is written to the log.

    Args:
        model: with coloured noise.
        names: sensor of each record.
        measurements: values of each record, NaN where missing.
        times: of each record, s, not decreasing.
        per_mode: keep every mode's mean and covariance.

    Raises:
        ModelError: a sensor is nonlinear or depends on t.
        DataError: a record does not fit its sensor.
        NumericalError: a sensor without white noise measured twice at one time.
    """
    wide = augmented(model)
    layout, arrays = wide.arrays_for(times, names)
    z = layout.stack(names, measurements)
    how = treatment(model, names)
    logging.getLogger("saltus").info("coloured noise: %s, %d states; %s", how.way, how.dimension, how.reason)
    if how.way != "differencing" or len(names) == 1:
        found = imm_filter(z, **arrays._asdict(), per_mode=per_mode)
        return of_state(found, model.n_state)
    return _differenced(model, arrays, names[0], z, per_mode)


def _differenced(model: HybridModel, arrays: Arrays, name: str, z: _Array, per_mode: bool) -> Estimates:
    sensor = coloured_sensors(model)[name]
    H = fixed(sensor.H, "H").reshape(-1, *np.shape(fixed(sensor.H, "H"))[-2:])[0]
    if sensor.d is not None:
        z = z - fixed(sensor.d, "d").reshape(-1, z.shape[-1])[0]
    n_chains = len(arrays.trans)
    first, later = _row(arrays, 0, n_chains), _from_second(arrays, n_chains)
    own = _own(model, name)
    described = Augmented(
        F=later.F[..., own, :][..., own],
        Q=later.Q[..., own, :][..., own],
        b=None if later.b is None else later.b[..., own],
        H=H,
        L=sensor.bound_noise().output,
        mean0=first.means[..., own],
        cov0=first.covs[..., own, :][..., own],
    )
    return run_differenced(z, described, later.trans, np.exp(first.log_probs), per_mode=per_mode)


def _own(model: HybridModel, name: str) -> npt.NDArray[np.intp]:
    """Indices of x and of this sensor's noise in the augmented state: the others are independent of its records."""
    n, start = model.n_state, model.n_state
    for other, sensor in coloured_sensors(model).items():
        p = sensor.bound_noise().output.shape[1]
        if other == name:
            return np.concatenate([np.arange(n), np.arange(start, start + p)])
        start += p
    raise KeyError(name)


def _row(arrays: Arrays, k: int, n_chains: int) -> steps.Belief:
    """The prior, moved over the interval that ends at record k."""
    sizes, n = arrays.probs0.shape, arrays.F.shape[-1]

    def at(a: _Array, constant: int) -> _Array:
        return a[k if len(a) > 1 else 0] if a.ndim > constant else a

    with np.errstate(divide="ignore"):
        log_probs = np.asarray(np.log(arrays.probs0))
    means, covs = np.broadcast_to(arrays.mean0, (*sizes, n)), np.broadcast_to(arrays.cov0, (*sizes, n, n))
    mixed = steps.mix(log_probs, means, covs, [at(t, 2) for t in arrays.trans])
    b = None if arrays.b is None else at(arrays.b, n_chains + 1)
    F, Q = at(arrays.F, n_chains + 2), at(arrays.Q, n_chains + 2)
    return steps.Belief(mixed.log_probs, *steps.propagate(mixed.means, mixed.covs, F, b, Q))


def _from_second(arrays: Arrays, n_chains: int) -> Arrays:
    """The arrays of the rows after the first."""

    def later(a: _Array, constant: int) -> _Array:
        return a[1:] if a.ndim > constant and len(a) > 1 else a

    return arrays._replace(
        F=later(arrays.F, n_chains + 2),
        Q=later(arrays.Q, n_chains + 2),
        b=None if arrays.b is None else later(arrays.b, n_chains + 1),
        trans=tuple(later(t, 2) for t in arrays.trans),
    )
