"""The filters that are compared, each a function of a scenario's measurements."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.filters import GPB1, GPB2, IMM, Estimates, MergingRule, ParticleFilter, exact_filter, imm_filter
from saltus.filters.align import align
from saltus.filters.flat import Flat, flatten
from saltus.filters.merging import findings
from saltus.models import DiffusionSensor, HybridModel, LinearSensor, as_diffusion_sensor
from saltus.models.arrays import Arrays

__all__ = ["FAST", "Answer", "Problem", "candidates", "reference_of"]

_Array = npt.NDArray[np.float64]
_MOST_HISTORIES = 4096  # with fewer in all, the reference enumerates them


@dataclass(frozen=True, slots=True)
class Problem:
    """A model over equal intervals: the prior holds one interval before the first measurement."""

    model: HybridModel
    interval: float
    steps: int

    @property
    def linear(self) -> bool:
        """Whether every sensor is."""
        return all(isinstance(sensor, LinearSensor) for sensor in self.model.sensors.values())

    @property
    def arrays(self) -> Arrays:
        """The arrays; of nonlinear sensors one row that measures nothing."""
        if self.linear:
            return self.model.compile(dt=self.interval)
        arrays, C, n = self.model.compile(dt=self.interval, sensor=()), len(self.model.chains), self.model.n_state
        return arrays._replace(H=np.zeros((*(1,) * C, 1, n)), R=np.ones((*(1,) * C, 1, 1)), d=None)

    @property
    def flat(self) -> Flat:
        """The arrays with the chains merged into one."""
        arrays = self.arrays
        m = arrays.H.shape[-2]
        return flatten(align(np.zeros((self.steps, m)), **arrays._asdict()))

    @property
    def sensor(self) -> DiffusionSensor:
        """All sensors, stacked, by joint mode."""
        return as_diffusion_sensor(self.model)

    @property
    def times(self) -> _Array:
        """Times of the measurements; the prior holds at 0."""
        return np.arange(1.0, self.steps + 1) * self.interval


class Answer(NamedTuple):
    """What a filter said, and how long it took."""

    probs: _Array  # (B, T, M)
    mean: _Array
    cov: _Array
    log_likelihood: _Array
    error: _Array | None
    seconds: float


Contender = Callable[[Problem, _Array, np.random.Generator], Answer]


def _timed(run: Callable[[Problem, _Array, np.random.Generator], Estimates]) -> Contender:
    def contend(problem: Problem, z: _Array, rng: np.random.Generator) -> Answer:
        began = time.perf_counter()
        est = run(problem, z, rng)
        seconds = time.perf_counter() - began
        probs = est.probs.reshape(*est.mean.shape[:2], -1)
        return Answer(probs, est.mean, est.cov, est.log_likelihood, est.error, seconds)

    return contend


def _by_rule(rule: MergingRule) -> Contender:
    return _timed(lambda p, z, rng: exact_filter(z, **p.arrays._asdict(), rule=rule))


def _imm(settings: IMM) -> Contender:
    """The multimode filter, at once on arrays or, with nonlinear sensors, run by run."""

    def run(problem: Problem, z: _Array, rng: np.random.Generator) -> Estimates:
        del rng
        if problem.linear:
            return imm_filter(z, **problem.arrays._asdict())
        return _one_by_one(settings, problem, z)

    return _timed(run)


def _one_by_one(settings: IMM, problem: Problem, z: _Array) -> Estimates:
    """Records of a model with one nonlinear sensor; the prior is told to hold one interval before the first."""
    model = problem.model
    if len(model.sensors) > 1:
        raise ModelError("with a nonlinear sensor the fast filter takes one sensor at a time: leave one in the model.")
    bound = settings(replace(model, prior=replace(model.prior, time=0.0)))
    (name,) = model.sensors
    found = [bound.run([(t, name, row) for t, row in zip(problem.times, rows, strict=True)]) for rows in z]
    told = [f.lost for f in found if f.lost is not None]
    lost = np.stack(told) if len(told) == len(found) else None
    return replace(
        found[0],
        probs=np.stack([f.probs for f in found]),
        mean=np.stack([f.mean for f in found]),
        cov=np.stack([f.cov for f in found]),
        log_likelihood=np.stack([f.log_likelihood for f in found]),
        log_likelihood_start=np.zeros(len(z)),
        nis=np.stack([f.nis for f in found]),
        n_observed=np.stack([f.n_observed for f in found]),
        lost=lost,
        findings=() if lost is None else findings(lost, found[0].mean.shape[-1]),
    )


def _particles(n: int) -> Contender:
    return _timed(lambda p, z, rng: ParticleFilter(n).run(p.model, None, z, p.times, rng))


FAST: dict[str, Contender] = {"IMM": _imm(IMM()), "GPB1": _by_rule(GPB1), "GPB2": _by_rule(GPB2)}


def reference_of(problem: Problem, choice: str, particles: int) -> tuple[str, Contender]:
    """Return the reference by name: exact where few histories are possible, else particles.

    Raises:
        ModelError: another name, or enumeration of a nonlinear model.
    """
    if choice not in ("auto", "exact", "particles"):
        raise ModelError(f'reference is "auto", "exact" or "particles", not {choice!r}.')
    M = problem.model.n_modes
    frozen = all((np.asarray(t) == np.eye(t.shape[-1])).all() for t in problem.arrays.trans)
    few = M == 1 or frozen or M**problem.steps <= _MOST_HISTORIES
    if choice == "exact" or (choice == "auto" and problem.linear and few):
        if not problem.linear:
            raise ModelError("exact enumeration needs linear sensors: use reference='particles'.")
        return "exact enumeration", _by_rule(MergingRule())
    kind = "Rao-Blackwellised particles" if problem.linear else "particles"
    return f"{particles} {kind}", _particles(particles)


def candidates(problem: Problem, particles: int) -> dict[str, Contender]:
    """Filters to try where the fast one loses, the cheapest first."""
    if problem.linear:
        return {
            "GPB2": _by_rule(GPB2),
            "GPB3": _by_rule(MergingRule(last=2)),
            "the 30 best histories": _by_rule(MergingRule(most=30)),
            "100 Rao-Blackwellised particles": _particles(100),
        }
    return {
        "IMM with sigma points": _imm(IMM(linearise="cubature")),
        "IMM, iterated": _imm(IMM(linearise="cubature", iterations=3)),
        f"{max(200, particles // 5)} particles": _particles(max(200, particles // 5)),
    }
