"""The moment filter: settings, and which representation serves a model."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.filters.estimates import Estimates
from saltus.filters.grid import GridFilter
from saltus.filters.moments.adaptive import Adapt, adaptive_rows
from saltus.filters.moments.affine import affine, is_affine
from saltus.filters.moments.closure import Tally
from saltus.filters.moments.history import Kept, MomentHistory, estimates_of, kept, recorded
from saltus.filters.moments.mixture import GaussianSumFilter
from saltus.filters.moments.observed import SeenSwitch, checked_switches
from saltus.filters.moments.posterior import MomentPosterior
from saltus.filters.moments.recursion import Recursion, Row, Setting
from saltus.filters.observation import Observation, observation
from saltus.models import DiffusionSensor, HybridModel, SwitchingSDE

__all__ = ["MomentFilter"]

_NODES = {"maxent": {1: 48, 2: 28, 3: 14}, "hermite": {1: 36, 2: 20, 3: 10}, "gaussian": {1: 36, 2: 20, 3: 10}}
_MOST_NODES = 20_000
Closure = Literal["maxent", "hermite", "gaussian", "auto"]
Representation = Literal["grid", "sum", "maxent", "gaussian", "hermite"]


@dataclass(frozen=True, slots=True)
class MomentFilter:
    """Filters a switching diffusion by moments of every mode's density, up to a given order.

    Between measurements the unnormalised moments u_a = P <y^a> of each mode follow

        d/dt u_a = P <L y^a> - P <nu y^a> + sum_r P_r <nu_r Q y^a>_r                                      (D)

    exactly where the drift is affine, otherwise by the flow of the closure's nodes; a closure turns the moments into
    a density, and Bayes' rule weighs that with the likelihood (equation (G)), in logs and by quadrature.

    Closures: "gaussian" keeps two moments. "hermite" is the Gaussian times a series, which may be negative. "maxent"
    is the density of greatest entropy with the given moments, positive and able to have two humps; it takes even
    orders. "auto" chooses by the model: a grid in one dimension; a Gaussian sum where restoration makes separate
    clumps, where all is linear, and in three dimensions and more; order 4 of maximum entropy else.

    Attributes:
        order: highest order of the moments kept, 2 to 6.
        closure: how moments become a density.
        nodes: quadrature nodes per axis; absent means by dimension.
        substeps: parts of an interval in which a drift that is not affine is followed; absent means by its steepness.
        protected: "hermite" only: make moments realisable, and leave out the negative part of the density.
        per_mode: keep every mode's mean and covariance.
        adapt: raise the order 2 -> 4 -> 6 where that changes the result; `order` is then not used.
        components: Gaussians per mode, where "auto" takes a sum.

    Source: moment-filter notes, sections 2, 4, 5, 8 and 11a.
    """

    order: int = 4
    closure: Closure = "maxent"
    nodes: int | None = None
    substeps: int | None = None
    protected: bool = True
    per_mode: bool = False
    adapt: Adapt | None = None
    components: int = 4

    def __post_init__(self) -> None:
        if self.closure not in ("maxent", "hermite", "gaussian", "auto"):
            raise ModelError(f'closure is "maxent", "hermite", "gaussian" or "auto", not {self.closure!r}.')
        if self.order not in range(2, 7) or (self.closure in ("maxent", "auto") and self.order % 2):
            raise ModelError(
                f"order must be 2 to 6, and even for maximum entropy (an odd leading power has no positive density): "
                f"{self.order}."
            )
        least = (4 if self.closure == "gaussian" else self.order) + 1
        if self.nodes is not None and self.nodes < least:
            raise ModelError(f"order {self.order} needs nodes >= {least} on each axis, got {self.nodes}; None chooses.")
        if self.substeps is not None and self.substeps < 1:
            raise ModelError(f"substeps must be at least 1, got {self.substeps}; None chooses by the drift.")
        if self.adapt is not None and self.closure not in ("maxent", "hermite"):
            raise ModelError('adapt needs closure="maxent" or "hermite".')

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
            Estimates with probs (..., T, S).

        Raises:
            ModelError: the closure does not serve the dimension.
            DataError: shapes do not fit, or times decrease.
        """
        del rng
        given = observation(model, sensor, z, times, t0)
        chosen = self.representation(given.model, given.sensor)
        if chosen == "grid":
            return GridFilter(estimate_error=False).run(given.model, given.sensor, z, times, t0=t0)
        if chosen == "sum":
            mixture = GaussianSumFilter(self.components, self.nodes, self.per_mode)
            return mixture.run(given.model, given.sensor, z, times, t0=t0)
        return self._follow(given, chosen).estimates

    def follow(
        self,
        model: SwitchingSDE | HybridModel,
        sensor: DiffusionSensor | str | Sequence[str] | None,
        z: npt.ArrayLike,
        times: npt.ArrayLike,
        *,
        t0: float = 0.0,
        switches: Sequence[SeenSwitch | tuple[float, int, int]] | None = None,
    ) -> MomentHistory:
        """As `run`, and return the diagnostics and the last posterior too.

        Args:
            model: as for `run`, like sensor, z, times and t0.
            sensor: what is measured.
            z: measurements.
            times: their times.
            t0: when the prior holds.
            switches: (time, from, to) of every switch, if these are seen, of all runs; absent means they are not.

        Raises:
            ModelError: also where "auto" takes a grid or a Gaussian sum, which have no closure.
        """
        given = observation(model, sensor, z, times, t0)
        chosen = self.representation(given.model, given.sensor)
        if chosen in ("grid", "sum"):
            raise ModelError(f'for this model "auto" is a {chosen}, which has no closure to follow. Name a closure.')
        seen = None if switches is None else checked_switches(given, switches)
        if seen is not None and self.adapt is not None:
            raise ModelError("seen switches and adaptive order do not go together: name one order.")
        return self._follow(given, chosen, seen)

    def representation(self, model: SwitchingSDE, sensor: DiffusionSensor) -> Representation:
        """What represents the densities of a model seen by a sensor: the closure, or what "auto" takes.

        Source: moment-filter notes, section 11a.
        """
        if self.closure != "auto":
            return self.closure
        if model.n_state == 1:
            return "grid"
        clumps = any(model.restored(switch) is not None for switch in model.switches)
        linear = affine(model) is not None and is_affine(sensor, model)
        return "sum" if clumps or linear or model.n_state > 2 else "maxent"

    def setting(self, n: int, closure: Literal["maxent", "hermite", "gaussian"], order: int) -> Setting:
        """Resolution of one order in n dimensions.

        Raises:
            ModelError: the nodes of so many dimensions are too many.
        """
        count = self.nodes or _NODES[closure].get(n, 6 if closure == "gaussian" else 8)
        if count**n > _MOST_NODES:
            raise ModelError(
                f"{count} nodes on each of {n} axes are {count**n}: too many. "
                'Use closure="auto", a particle filter, or fewer nodes=.'
            )
        return Setting(closure, 2 if closure == "gaussian" else order, count, self.protected, self.substeps)

    def _follow(
        self, given: Observation, closure: Representation, switches: Sequence[SeenSwitch] | None = None
    ) -> MomentHistory:
        if closure == "grid" or closure == "sum":
            raise AssertionError("these have no closure")
        n = given.model.n_state
        if self.adapt is not None:
            settings = {2: self.setting(n, "gaussian", 2)}
            # The Gaussian's prediction is carried to order 4, to see how far from Gaussian it has become.
            settings[2] = settings[2]._replace(order=4, nodes=self.setting(n, closure, 4).nodes)
            settings |= {order: self.setting(n, closure, order) for order in (4, 6)}
            return adaptive_rows(given, self.adapt, settings, self.per_mode)
        recursion = Recursion(given, self.setting(n, closure, self.order), switches)
        rows: list[Kept] = []
        last: Row | None = None
        tallies: list[Tally] = []
        failed = []
        for row in recursion.rows(recursion.start(), 0, len(given.times)):
            rows.append(kept(row.points, row.log_likelihood, row.nis))
            tallies.append(row.tally)
            failed.append(row.failed)
            last = row
        if last is None:
            raise AssertionError("an observation has at least one row")
        shape = (len(given.z), len(given.times))
        order = np.full(shape, recursion.setting.order)
        record = recorded(given, rows, tallies, failed, order, np.zeros(shape, dtype=bool))
        posterior = MomentPosterior(
            last.points, last.predicted, given.sensor, given.z[:, -1], float(given.dts[-1]), last.log_likelihood
        )
        return MomentHistory(estimates_of(given, rows, self.per_mode), record, posterior)
