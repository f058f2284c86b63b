"""The recursion of the moment filter at one order: predict, close, update, over the measurements of all runs."""

from collections.abc import Iterator, Sequence
from math import ceil
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.filters.moments.affine import Affine, affine, predict_affine
from saltus.filters.moments.basis import Basis
from saltus.filters.moments.belief import Moments, Points, moments_of
from saltus.filters.moments.closure import Closing, ClosureName, Density, Tally
from saltus.filters.moments.flow import Flow, constant_noise, predict_by_flow
from saltus.filters.moments.observed import SeenSwitch, certain, switched
from saltus.filters.moments.realisable import margin
from saltus.filters.moments.update import update
from saltus.filters.observation import Observation
from saltus.models import SwitchingSDE

__all__ = ["Recursion", "Row", "Setting", "first_moments"]

_Array = npt.NDArray[np.float64]

_MOST_STEPS = 64
_PER_RATE = 0.25  # substeps per unit of (steepness of the drift, rate of switching) times interval


class Setting(NamedTuple):
    """Closure, order and resolution."""

    closure: ClosureName
    order: int
    nodes: int
    protected: bool
    substeps: int | None


class Row(NamedTuple):
    """What one measurement leaves."""

    points: Points
    predicted: Density
    log_likelihood: _Array  # (b,)
    nis: _Array  # (b,)
    tally: Tally
    failed: npt.NDArray[np.bool_]  # (b,)


def first_moments(model: SwitchingSDE, of: Basis, n_runs: int) -> Moments:
    """The Gaussian laws of the start."""
    n_modes = model.n_modes
    h = np.zeros((n_runs, n_modes, len(of.indices)))
    h[..., 0] = 1.0
    with np.errstate(divide="ignore"):
        log_probs = np.maximum(np.log(np.asarray(model.probs0)), np.log(1e-290))
    lead = (n_runs, n_modes)
    tiny = 1e-18 * np.eye(model.n_state) * (1.0 + np.square(model.means0).max())
    root = np.linalg.cholesky(model.covs0 + tiny)
    return Moments(
        np.broadcast_to(log_probs, lead),
        np.broadcast_to(model.means0, (*lead, model.n_state)),
        np.broadcast_to(root, (*lead, *root.shape[1:])),
        h,
    )


class Recursion:
    """One order of the filter on the runs of an observation."""

    def __init__(self, given: Observation, setting: Setting, switches: Sequence[SeenSwitch] | None = None) -> None:
        """Prepare what does not change along the runs; with `switches`, even none, the modes are seen."""
        self.given, self.setting, self.switches = given, setting, switches
        model = given.model
        self.closing = Closing(
            setting.closure, model.n_state, setting.order, setting.nodes, setting.protected, len(given.z)
        )
        self.affine: Affine | None = affine(model)
        if self.affine is not None and switches is not None:  # constant rates: that none happens says nothing
            self.affine = self.affine._replace(rates=np.zeros_like(self.affine.rates), restored={})
        noise = constant_noise(model)
        self.flow = Flow(model, self.closing.basis, self.closing.points, noise, observed=switches is not None)

    def start(self) -> Points:
        """The prior as points."""
        points = self.closing.points(first_moments(self.given.model, self.closing.basis, len(self.given.z)))
        self.closing.taken()
        if self.switches is None:
            return points
        known = self.switches[0].source if self.switches else int(np.argmax(np.asarray(self.given.model.probs0)))
        return points._replace(log_probs=certain(points.log_probs, known))

    def rows(self, points: Points, first: int, last: int) -> Iterator[Row]:
        """Filter measurements first to last - 1, from the points after measurement first - 1."""
        for k in range(first, last):
            row = self.step(points, k)
            points = row.points
            yield row

    def step(self, points: Points, k: int) -> Row:
        """Predict to measurement k and condition on it."""
        dt = float(self.given.dts[k])
        start = float(self.given.times[k]) - dt
        for switch in self.switches or ():
            if start < switch.time <= self.given.times[k] or (k == 0 and switch.time == start):
                law = self.predict(points, switch.time - start)
                points = switched(
                    self.given.model, self.closing, self.closing.points(law), switch.source, switch.target
                )
                dt, start = float(self.given.times[k]) - switch.time, switch.time
        return self.condition(self.predict(points, dt), k)

    def condition(self, law: Moments, k: int) -> Row:
        """Condition predicted moments on measurement k."""
        given, z, dt = self.given, self.given.z[:, k], float(self.given.dts[k])
        density, weights = self.closing.closed(law)
        if np.isnan(z).all():
            nothing = np.zeros(len(z))
            points = Points(law.log_probs, self.closing.places(law.mean, law.root), weights)
            return Row(points, density, nothing, nothing, self.closing.taken(), nothing.astype(bool))
        done = update(self.closing, density, weights, given.sensor, z, dt, k)
        tally = self.closing.taken()
        failed = done.failed | (tally.unrealisable > 0)
        if self.setting.closure == "hermite" and not self.setting.protected:
            found = moments_of(self.closing.basis, [[cloud] for cloud in done.points.clouds()])
            failed |= ~(margin(self.closing.basis, found.h) > 0).all(axis=-1)
        seen = (~np.isnan(z)).any(axis=-1)
        return Row(done.points, density, np.where(seen, done.log_likelihood, 0.0), done.nis, tally, failed)

    def predict(self, points: Points, dt: float) -> Moments:
        """Moments after an interval: exactly if the model is affine, else by the flow of the nodes."""
        if dt <= 0.0:
            return moments_of(self.closing.basis, [[cloud] for cloud in points.clouds()])
        if self.affine is not None:
            return predict_affine(self.affine, self.setting.order, points, dt)
        n_steps = self.setting.substeps or self._substeps(points, dt)
        return predict_by_flow(self.flow, points, dt, n_steps)

    def _substeps(self, points: Points, dt: float) -> int:
        """Substeps that follow the drift's steepness where the probability is, and the rates of switching."""
        model, n = self.given.model, self.given.model.n_state
        fastest = 0.0
        for mode, (y, w) in enumerate(points.clouds()):
            share = np.abs(w) / np.maximum(np.abs(w).sum(axis=-1, keepdims=True), 1e-290)
            mean = (share[..., None] * y).sum(axis=1)
            spread = np.sqrt((share[..., None] * np.square(y - mean[:, None])).sum(axis=1))
            side = mean[:, None] + spread[:, None] * np.concatenate([np.eye(n), -np.eye(n)])
            slope = (model.drift_at(mode, side[:, :n]) - model.drift_at(mode, side[:, n:])) / (
                2 * spread[:, :, None] + 1e-300
            )
            rate = np.linalg.norm(slope, axis=(-2, -1)) + model.exit_rate(mode, mean)
            weight = np.abs(w).sum(axis=-1)
            fastest = max(fastest, float((weight * rate).sum() / weight.sum()))
        factor = 1.0 if self.flow.noise is not None else 3.0  # noise that depends on the state is of first order
        return min(_MOST_STEPS, max(1, ceil(fastest * dt * factor / _PER_RATE)))
