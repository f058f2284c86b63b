"""The grid filter: the posterior itself, cell by cell, in one or two dimensions."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import index
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError
from saltus.filters.estimates import Estimates
from saltus.filters.grid.bounds import axes_within, reach, start
from saltus.filters.grid.generator import Axes, Generator, generator
from saltus.filters.grid.propagate import Propagator, dense, split, uniformised
from saltus.filters.observation import Observation, impossible, innovation_nis, observation
from saltus.linalg import symmetric
from saltus.models import DiffusionSensor, HybridModel, SwitchingSDE
from saltus.shapes import Float

__all__ = ["GridDensity", "GridFilter"]

_MOST_MATRICES = 8  # different intervals for which transition matrices are made
_DEFAULT = {1: 320, 2: 120}
_ON_EDGE = 0.01  # share of a posterior that the outermost cells may hold
_NOTHING_TOLD = -1e15  # the greatest log-likelihood of a measurement too far away to tell one cell from another
_COARSER = 2  # the error is judged against a grid with so many times fewer cells


class GridDensity(NamedTuple):
    """Posterior probabilities of the cells of a grid."""

    axes: tuple[Float[np.ndarray, " cells"], ...]  # centres of the cells
    probs: Float[np.ndarray, "b t s *cells"]  # sum to 1 over modes and cells

    @property
    def density(self) -> Float[np.ndarray, "b t s *cells"]:
        """Joint density of mode and state: probability per unit of the state."""
        return np.asarray(self.probs / np.prod(Axes(self.axes).widths))


@dataclass(frozen=True, slots=True)
class GridFilter:
    """The Bayes filter of a switching diffusion on a grid, in one or two dimensions: a reference for the others.

    Between measurements the diffusion is the Markov chain of `saltus.filters.grid.generator`, which keeps probability
    and its sign; a measurement multiplies by its likelihood. Both are exact but for the width h of the cells, whose
    error is of the order of h^2, and is estimated from the same filter with half the cells on each axis.

    Attributes:
        cells: number of cells on every axis, or one per axis; absent means 320 in one dimension and 120 in two.
        bounds: (low, high) of the grid, each (n,); absent, they are found by following the diffusion before anything
            is measured.
        estimate_error: run the coarser grid too, for `Estimates.error`.

    Source: moment-filter notes, section 11 (the reference of its tables), and equation (G).
    """

    cells: int | Sequence[int] | None = None
    bounds: tuple[npt.ArrayLike, npt.ArrayLike] | None = None
    estimate_error: bool = True

    def run(
        self,
        model: SwitchingSDE | HybridModel,
        sensor: DiffusionSensor | str | Sequence[str] | None,
        z: npt.ArrayLike,
        times: npt.ArrayLike,
        *,
        t0: float = 0.0,
        rng: np.random.Generator | None = None,
    ) -> Estimates:
        """Filter runs of measurements, all at the same times.

        Args:
            model: the diffusion, or a hybrid model, which is lowered to one.
            sensor: what is measured; for a hybrid model a name, several, or None for all its sensors stacked.
            z: measurements, (..., T, m); NaN is missing. Increments over the intervals if the sensor is continuous.
            times: times of the measurements, (T,), s.
            t0: when the prior holds, s.
            rng: not used: nothing is drawn.

        Returns:
            Estimates with probs (..., T, S) and error (..., T): an estimate of the error of the mean that the width of
            the cells makes, in posterior standard deviations.

        Raises:
            ModelError: more than two dimensions, or correlated noises in two.
            DataError: shapes do not fit, or a measurement is impossible everywhere on the grid.
            NumericalError: the diffusion leaves every grid.
        """
        del rng
        given = observation(model, sensor, z, times, t0)
        low, high, cells = self._extent(given)
        found = _filtered(given, axes_within(low, high, cells))
        error = None
        if self.estimate_error:
            rough = _filtered(given, axes_within(low, high, tuple(max(8, n // _COARSER) for n in cells)))
            error = _distance(found, rough, axes_within(low, high, cells)) / (_COARSER**2 - 1)
        return _estimates(given, found, error)

    def densities(
        self,
        model: SwitchingSDE | HybridModel,
        sensor: DiffusionSensor | str | Sequence[str] | None,
        z: npt.ArrayLike,
        times: npt.ArrayLike,
        *,
        t0: float = 0.0,
    ) -> GridDensity:
        """Return the posterior on the grid after every measurement; z (..., T, m), leading axes flattened."""
        given = observation(model, sensor, z, times, t0)
        low, high, cells = self._extent(given)
        axes = axes_within(low, high, cells)
        return GridDensity(axes.centres, np.stack([step.p for step in _steps(given, axes)], axis=1))

    def _extent(self, given: Observation) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], tuple[int, ...]]:
        n = given.model.n_state
        if n not in _DEFAULT:
            raise ModelError(f"a grid serves 1 or 2 dimensions, not {n}. Use ParticleFilter or MomentFilter.")
        cells = _cells(_DEFAULT[n] if self.cells is None else self.cells, n)
        if self.bounds is None:
            return *reach(given.model, float(given.dts.sum())), cells
        try:
            low, high = (np.broadcast_to(np.asarray(side, dtype=np.float64), (n,)) for side in self.bounds)
        except (TypeError, ValueError):
            raise ModelError(f"bounds must be (low, high), each of {n} components, got {self.bounds!r}.") from None
        if not (low < high).all():
            raise ModelError(f"bounds must be (low, high) with low < high, got {self.bounds}.")
        return low, high, cells


def _cells(asked: int | Sequence[int], n: int) -> tuple[int, ...]:
    """Number of cells on each of n axes."""
    try:
        cells = tuple(index(count) for count in np.broadcast_to(np.asarray(asked), (n,)))
    except (TypeError, ValueError):
        cells = ()
    if not cells or min(cells) < 8:
        raise ModelError(f"cells must be whole numbers, at least 8 on each of {n} axes, got {asked!r}.")
    return cells


class _Step(NamedTuple):
    p: Float[np.ndarray, "b s *cells"]
    log_likelihood: Float[np.ndarray, " b"]
    nis: Float[np.ndarray, " b"]


class _Found(NamedTuple):
    probs: Float[np.ndarray, "b t s"]
    mean: Float[np.ndarray, "b t n"]
    cov: Float[np.ndarray, "b t n n"]
    log_likelihood: Float[np.ndarray, "b t"]
    nis: Float[np.ndarray, "b t"]


def _steps(given: Observation, axes: Axes) -> Iterator[_Step]:
    """Follow the posterior of all runs over the measurements."""
    rates = generator(given.model, axes)
    moves = _propagators(rates, given.dts)
    p = np.repeat(start(given.model, axes)[None], len(given.z), axis=0)
    x = axes.states.reshape(-1, given.model.n_state)
    for k, dt in enumerate(given.dts):
        p = moves[float(dt)](p)
        z = given.z[:, k]
        if np.isnan(z).all():
            yield _Step(p, np.zeros(len(z)), np.zeros(len(z)))
            continue
        flat = p.reshape(*p.shape[:2], -1)
        nis = innovation_nis(given.sensor, z, float(dt), [(x, flat[:, mode]) for mode in range(flat.shape[1])])
        log_g = np.stack(
            [given.sensor.log_likelihood(mode, z[:, None], x, float(dt)) for mode in range(flat.shape[1])], axis=1
        )
        top = log_g.max(axis=(1, 2), keepdims=True)
        flat = flat * np.exp(log_g - np.where(np.isfinite(top), top, 0.0))
        total = flat.sum(axis=(1, 2))
        lost = ~(total > 0) | (top[:, 0, 0] < _NOTHING_TOLD)
        if lost.any():
            run = int(np.argmax(lost))
            told = impossible(given.sensor, z[run], [(mode, x) for mode in range(flat.shape[1])], run, k)
            raise DataError(
                f"{told} is impossible wherever the grid holds probability.\nCheck its unit, or give wider bounds."
            )
        p = (flat / total[:, None, None]).reshape(p.shape)
        _inside(p, axes, k, z)
        seen = (~np.isnan(z)).any(-1)
        yield _Step(p, np.where(seen, np.log(total) + top[:, 0, 0], 0.0), nis)


def _inside(p: Float[np.ndarray, "b s *cells"], axes: Axes, k: int, z: Float[np.ndarray, "b m"]) -> None:
    """Refuse a posterior that leans on the edge of the grid: where it ends is then the grid's doing.

    Raises:
        DataError: the outermost cells of an axis hold more than a hundredth.
    """
    for axis in range(len(axes.centres)):
        line = p.sum(axis=tuple(i for i in range(1, p.ndim) if i != 2 + axis))
        share = line[:, 0] + line[:, -1]
        if share.max() > _ON_EDGE:
            run, c = int(share.argmax()), axes.centres[axis]
            raise DataError(
                f"row {k}: measurement {z[run]} of run {run} puts {100 * share[run]:.0f} % of the posterior on the "
                f"edge of the grid, which reaches from {c[0]:g} to {c[-1]:g} on axis {axis}.\n"
                "Check its unit, or give wider bounds=(low, high)."
            )


def _propagators(rates: Generator, dts: Float[np.ndarray, " t"]) -> dict[float, Propagator]:
    different = {float(dt) for dt in dts}
    # Equal steps of a clock differ in their last bits: one matrix serves all that agree to a millionth.
    nearest = {dt: float(f"{dt:.6g}") for dt in different}
    kinds = sorted(set(nearest.values()))
    if len(rates.up) == 2:
        made = {dt: split(rates, dt) for dt in kinds}
    elif len(kinds) <= _MOST_MATRICES:
        made = {dt: dense(rates, dt) for dt in kinds}
    else:
        made = {dt: uniformised(rates.change, rates.fastest(), dt) for dt in kinds}
    return {dt: made[kind] for dt, kind in nearest.items()}


def _filtered(given: Observation, axes: Axes) -> _Found:
    x = axes.states.reshape(-1, given.model.n_state)
    rows = []
    for step in _steps(given, axes):
        flat = step.p.reshape(*step.p.shape[:2], -1)
        p = flat.sum(axis=1)
        mean = p @ x
        away = ((law[:, None], x - at) for law, at in zip(p, mean, strict=True))  # squares, never their difference
        cov = np.array([(weight * off).T @ off for weight, off in away])
        rows.append(_Found(flat.sum(-1), mean, symmetric(cov), step.log_likelihood, step.nis))
    return _Found(*(np.stack(parts, axis=1) for parts in zip(*rows, strict=True)))


def _distance(a: _Found, b: _Found, axes: Axes) -> Float[np.ndarray, "b t"]:
    """Distance of the means in units of the posterior's standard deviations, those within a cell included."""
    off = a.mean - b.mean
    cov = a.cov + np.diag(np.square(axes.widths)) / 12
    return np.asarray(np.sqrt(np.einsum("...i,...ij,...j->...", off, np.linalg.inv(cov), off)))


def _estimates(given: Observation, found: _Found, error: Float[np.ndarray, "b t"] | None) -> Estimates:
    def shaped(a: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return a.reshape(*given.batch, *a.shape[1:])

    return Estimates(
        probs=shaped(found.probs),
        mean=shaped(found.mean),
        cov=shaped(found.cov),
        log_likelihood=shaped(found.log_likelihood),
        log_likelihood_start=np.zeros(given.batch),
        nis=shaped(found.nis),
        n_observed=shaped(given.seen.sum(-1).astype(float)),
        error=None if error is None else shaped(error),
        chains=("mode",),
        times=given.times,
    )
