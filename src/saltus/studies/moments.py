"""Five switching diffusions with strongly non-Gaussian posteriors, and how close filters come to a grid's answer.

a1, a2: a double well and a linear mode, seen by a weak linear sensor with rates of switching that depend on the state,
or by a cubic one. b: two linear modes, the state kept at a switch. br: the same, the state drawn anew. c: two linear
modes in the plane, seen by range and bearing.

Source: moment-filter notes, section 11, whose cases these are.
"""

import time
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from saltus import montecarlo
from saltus.filters import Estimates, GaussianSumFilter, GridFilter, MomentFilter
from saltus.models import DiffusionSensor, SwitchingSDE
from saltus.shapes import Float
from saltus.simulate import DiffusionDraws, simulate_diffusion

__all__ = ["CASES", "FILTERS", "Case", "Errors", "Outcome", "errors", "filters", "run_case"]

_Array = npt.NDArray[np.float64]
_AT_ONCE = 30


class Case(NamedTuple):
    """A model, its sensor, and when it is seen."""

    model: SwitchingSDE
    sensor: DiffusionSensor
    times: Float[np.ndarray, " t"]
    substeps: int  # Euler steps of the simulation in an interval
    reference: GridFilter
    coarse: GridFilter


class Filter(Protocol):
    """A filter as the study runs it."""

    def run(self, model: SwitchingSDE, sensor: DiffusionSensor, z: npt.ArrayLike, times: npt.ArrayLike) -> Estimates:
        """Filter all runs."""
        ...


class Errors(NamedTuple):
    """Distances from the reference's posterior, time, and failures."""

    mean_err: float  # rms over components, in posterior standard deviations
    var_err: float  # mean of |cov - reference| / |reference| (Frobenius)
    prob_err: float  # rms of P(first mode)
    us_per_step: float  # process time of a run's step, all runs at once
    failed: float  # share of runs that broke down at least once


class Outcome(NamedTuple):
    """A case simulated and filtered."""

    case: Case
    draws: DiffusionDraws
    reference: Estimates
    filters: dict[str, Errors]
    rmse: dict[str, float]  # against the truth, and of the reference


def _well(y: _Array) -> _Array:
    return 2 * (y - y**3)


def _pull(y: _Array) -> _Array:
    return 0.5 - y


def _leave(y: _Array) -> _Array:
    return np.asarray(0.2 + 0.6 * y[..., 0] ** 2 / (1 + y[..., 0] ** 2))


def _cubed(y: _Array) -> _Array:
    return y**3


def _itself(y: _Array) -> _Array:
    return y


def _to(goal: npt.ArrayLike, rate: float) -> Callable[[_Array], _Array]:
    def drift(y: _Array) -> _Array:
        return np.asarray(-rate * (y - np.asarray(goal)))

    return drift


def _range_bearing(y: _Array) -> _Array:
    return np.stack([np.hypot(y[..., 0], y[..., 1]), np.arctan2(y[..., 1], y[..., 0])], axis=-1)


def _wells(back: Callable[[_Array], _Array] | float, sensor: DiffusionSensor) -> Case:
    rates = {(0, 1): 0.3, (1, 0): back}
    model = SwitchingSDE([_well, _pull], [0.8, 0.6], rates, probs0=[0.5, 0.5])
    return Case(model, sensor, 0.2 * np.arange(1, 61), 60, _grid(320), _grid(60))


def _lines(restore: dict[tuple[int, int], tuple[list[float], list[list[float]]]]) -> Case:
    rates = {(0, 1): 0.4, (1, 0): 0.4}
    model = SwitchingSDE([_to(1.0, 1.0), _to(-1.0, 1.0)], [0.4, 0.4], rates, restore, probs0=[0.5, 0.5])
    sensor = DiffusionSensor(h=[_itself] * 2, R=[0.49] * 2)
    return Case(model, sensor, 0.2 * np.arange(1, 61), 60, _grid(320), _grid(60))


def _plane() -> Case:
    model = SwitchingSDE(
        drift=[_to([1.5, 0.0], 0.6), _to([0.0, 1.5], 0.6)],
        diffusion=[0.35, 0.8],
        intensity={(0, 1): 0.3, (1, 0): 0.5},
        probs0=[0.5, 0.5],
        mean0=[1.2, 0.3],
        cov0=0.36 * np.eye(2),
    )
    sensor = DiffusionSensor(h=[_range_bearing] * 2, R=[np.diag([0.12**2, 0.6**2])] * 2, angular=(1,))
    return Case(model, sensor, 0.25 * np.arange(1, 41), 50, _grid(160), _grid(75))


def _grid(cells: int) -> GridFilter:
    return GridFilter(cells, estimate_error=False)


CASES: dict[str, Callable[[], Case]] = {
    "a1": lambda: _wells(_leave, DiffusionSensor(h=[_itself] * 2, R=[0.64] * 2)),
    "a2": lambda: _wells(0.3, DiffusionSensor(h=[_cubed] * 2, R=[0.25] * 2)),
    "b": lambda: _lines({}),
    "br": lambda: _lines({(0, 1): ([1.5], [[0.04]]), (1, 0): ([-1.5], [[0.04]])}),
    "c": _plane,
}

# In the order of the table: the moment filter by closure and order, Gaussian sums, and a coarse grid last.
FILTERS: dict[str, MomentFilter | GaussianSumFilter] = {
    "gaussian2": MomentFilter(order=2, closure="gaussian"),
    "maxent4": MomentFilter(order=4),
    "maxent6": MomentFilter(order=6),
    "hermite3": MomentFilter(order=3, closure="hermite"),
    "hermite4": MomentFilter(order=4, closure="hermite"),
    "hermite6": MomentFilter(order=6, closure="hermite"),
    "raw_hermite3": MomentFilter(order=3, closure="hermite", protected=False),
    "raw_hermite4": MomentFilter(order=4, closure="hermite", protected=False),
    "raw_hermite6": MomentFilter(order=6, closure="hermite", protected=False),
    "sum1": GaussianSumFilter(1),
    "sum4": GaussianSumFilter(4),
}


def filters(case: Case) -> dict[str, MomentFilter | GaussianSumFilter | GridFilter]:
    """All filters of a case by name."""
    return {**FILTERS, "grid_coarse": case.coarse}


def run_case(name: str, n_runs: int, seed: int, progress: Callable[[str], None] | None = None) -> Outcome:
    """Simulate a case, filter it with the reference and with every filter, and compare.

    Args:
        name: a key of CASES.
        n_runs: number of runs, each with its own generator.
        seed: root of the runs' generators.
        progress: told the name of each filter when it is done.
    """
    case = CASES[name]()

    def trial(rngs: list[np.random.Generator]) -> DiffusionDraws:
        return simulate_diffusion(case.model, case.sensor, case.times, rng=rngs, substeps=case.substeps)

    draws = montecarlo.run(trial, n_runs, seed, batch=_AT_ONCE)  # type: ignore[arg-type]  # a list is a sequence
    reference = case.reference.run(case.model, case.sensor, draws.z, case.times)
    found, rmse = {}, {"reference": _rmse(reference, draws)}
    for label, one in filters(case).items():
        estimates, failed, took = _timed(one, case, draws.z)
        found[label] = errors(estimates, reference, took, failed)
        rmse[label] = _rmse(estimates, draws)
        if progress is not None:
            progress(label)
    return Outcome(case, draws, reference, found, rmse)


def _timed(
    one: MomentFilter | GaussianSumFilter | GridFilter, case: Case, z: _Array
) -> tuple[Estimates, npt.NDArray[np.bool_], float]:
    """Estimates, which runs broke down, and microseconds of a run's step."""
    begin = time.process_time()
    if isinstance(one, MomentFilter):
        history = one.follow(case.model, case.sensor, z, case.times)
        estimates, failed = history.estimates, history.diagnostics.failed.any(axis=-1)
    else:
        estimates = one.run(case.model, case.sensor, z, case.times)
        failed = np.zeros(len(z), dtype=bool)
    took = time.process_time() - begin
    failed |= ~np.isfinite(estimates.mean).all(axis=(1, 2)) | ~np.isfinite(estimates.cov).all(axis=(1, 2, 3))
    return estimates, failed, 1e6 * took / (len(z) * len(case.times))


def errors(estimates: Estimates, reference: Estimates, us_per_step: float, failed: npt.NDArray[np.bool_]) -> Errors:
    """Compare estimates (b, T) with the reference's."""
    deviation = np.sqrt(np.diagonal(reference.cov, axis1=-2, axis2=-1))
    off = (estimates.mean - reference.mean) / deviation
    size = np.linalg.norm(reference.cov, axis=(-2, -1))
    change = np.linalg.norm(estimates.cov - reference.cov, axis=(-2, -1)) / size
    prob = estimates.probs[..., 0] - reference.probs[..., 0]
    return Errors(
        mean_err=float(np.sqrt(np.mean(off**2))),
        var_err=float(np.mean(change)),
        prob_err=float(np.sqrt(np.mean(prob**2))),
        us_per_step=us_per_step,
        failed=float(np.mean(failed)),
    )


def _rmse(estimates: Estimates, draws: DiffusionDraws) -> float:
    return float(np.sqrt(np.mean(np.square(estimates.mean - draws.states).sum(axis=-1))))
