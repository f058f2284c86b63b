"""Gaussian sums: every mode's density is a few Gaussians, which switching multiplies and merging reduces.

Half of the switching acts before the propagation and half after it (Strang): applied once per interval it would be of
first order in the rate times the interval, whatever the number of Gaussians.

Source: moment-filter notes, sections 5 (switching splitting) and 11 (GS4, Strang switching).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.filters.estimates import Estimates
from saltus.filters.moments.basis import basis
from saltus.filters.moments.belief import Moments, Points, moments_of, root_of
from saltus.filters.moments.history import Kept, estimates_of
from saltus.filters.moments.recursion import Recursion, Setting
from saltus.filters.observation import Observation, observation
from saltus.linalg import symmetric
from saltus.models import DiffusionSensor, HybridModel, SwitchingSDE, exponential

__all__ = ["GaussianSumFilter"]

_Array = npt.NDArray[np.float64]

_SPLIT = 0.1  # largest rate of switching times substep
_NEVER = -690.0  # log weight of a Gaussian that is not there
_NODES = {1: 24, 2: 10}


@dataclass(frozen=True, slots=True)
class GaussianSumFilter:
    """Filters a switching diffusion by a few Gaussians per mode, each updated by quadrature.

    Best where restoration makes separate clumps, and for linear models; in nonlinear ones more components do not help,
    because each of them widens.

    Attributes:
        components: Gaussians per mode.
        nodes: quadrature nodes per axis; absent means by dimension.
        per_mode: keep every mode's mean and covariance.
    """

    components: int = 4
    nodes: int | None = None
    per_mode: bool = False

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
        """Filter runs of measurements; arguments, results and errors are those of `MomentFilter.run`."""
        del rng
        if self.components < 1:
            raise ModelError(f"a Gaussian sum needs at least one component per mode, got {self.components}.")
        if self.nodes is not None and self.nodes < 3:
            raise ModelError(f"a Gaussian needs nodes >= 3 on each axis, got {self.nodes}; None chooses.")
        given = observation(model, sensor, z, times, t0)
        return estimates_of(given, list(_Sum(given, self.components, self.nodes).rows()), self.per_mode)


class _Sum:
    """A Gaussian-sum filter of K components per mode; the components are modes of a model that never switches."""

    def __init__(self, given: Observation, components: int, nodes: int | None) -> None:
        """Prepare the filter of an observation."""
        self.given, self.k = given, components
        model, sensor = given.model, given.sensor
        copies = [s for s in range(model.n_modes) for _ in range(components)]
        still = SwitchingSDE(
            drift=[model.drift[s] for s in copies],
            diffusion=[model.diffusion[s] for s in copies],
            intensity={},
            probs0=np.full(len(copies), 1 / len(copies)),
            mean0=model.means0[copies],
            cov0=model.covs0[copies],
        )
        spread = DiffusionSensor(
            h=[sensor.h[s] for s in copies],
            R=[sensor.R[s] for s in copies],
            angular=sensor.angular,
            continuous=sensor.continuous,
        )
        count = nodes or _NODES.get(model.n_state, 5)
        self._each = Recursion(given._replace(model=still, sensor=spread), Setting("gaussian", 2, count, True, None))

    def rows(self) -> Iterator[Kept]:
        """Filter all measurements."""
        model, n_runs = self.given.model, len(self.given.z)
        with np.errstate(divide="ignore"):
            first = np.maximum(np.log(np.asarray(model.probs0)), _NEVER)
        log_w = np.full((n_runs, model.n_modes, self.k), _NEVER)
        log_w[..., 0] = first
        shape = (n_runs, model.n_modes, self.k)
        means = np.broadcast_to(model.means0[:, None], (*shape, model.n_state))
        covs = np.broadcast_to(model.covs0[:, None], (*shape, model.n_state, model.n_state))
        fastest = max(float(model.exit_rate(mode, mean)) for mode, mean in enumerate(model.means0))
        for k, dt in enumerate(self.given.dts):
            n_steps = max(1, ceil(float(dt) * fastest / _SPLIT))
            step = float(dt) / n_steps
            for i in range(n_steps):
                log_w, means, covs = self._switched(log_w, means, covs, step / 2 if i == 0 else step)
                law = self._each.predict(self._points(self._moments(log_w, means, covs)), step)
                log_w, means, covs = self._parts(law)
            log_w, means, covs = self._switched(log_w, means, covs, step / 2)
            row = self._each.condition(self._moments(log_w, means, covs), k)
            law = moments_of(basis(model.n_state, 2), [[cloud] for cloud in row.points.clouds()])
            log_w, means, covs = self._parts(law)
            yield _kept(log_w, means, covs, row.log_likelihood, row.nis)

    def _moments(self, log_w: _Array, means: _Array, covs: _Array) -> Moments:
        n_runs, n = len(log_w), means.shape[-1]
        h = np.zeros((n_runs, log_w[0].size, len(basis(n, 2).indices)))
        h[..., 0] = 1.0
        flat = log_w.reshape(n_runs, -1)
        flat = flat - np.log(np.exp(flat).sum(axis=-1, keepdims=True))
        return Moments(flat, means.reshape(n_runs, -1, n), root_of(covs.reshape(n_runs, -1, n, n)), h)

    def _points(self, law: Moments) -> Points:
        return self._each.closing.points(law)

    def _parts(self, law: Moments) -> tuple[_Array, _Array, _Array]:
        n_runs, n = len(law.mean), law.mean.shape[-1]
        shape = (n_runs, -1, self.k)
        log_w = np.maximum(law.log_probs, _NEVER).reshape(shape)
        return log_w, law.mean.reshape(*log_w.shape, n), law.cov.reshape(*log_w.shape, n, n)

    def _switched(self, log_w: _Array, means: _Array, covs: _Array, dt: float) -> tuple[_Array, _Array, _Array]:
        """Switch for a time with the state at rest, then merge each mode's Gaussians back to K."""
        model, n_modes = self.given.model, self.given.model.n_modes
        if not model.switches:
            return log_w, means, covs
        G = np.zeros((*log_w.shape, n_modes, n_modes))  # rates at the means, of mode l's component: row of each mode
        restored = [s for s in model.switches if model.restored(s) is not None]
        for source, target in model.switches:
            rate = model.rate((source, target), means)
            G[..., source, source] -= rate
            if (source, target) not in restored:
                G[..., source, target] += rate
        step = exponential(G * dt)
        merged: list[tuple[_Array, _Array, _Array]] = []
        for target in range(n_modes):
            w = np.stack([np.exp(log_w[:, s]) * step[:, s, :, s, target] for s in range(n_modes)], axis=1)
            own_w = [w.reshape(len(w), -1)]
            own_m = [means.reshape(len(w), -1, means.shape[-1])]
            own_c = [covs.reshape(len(w), -1, *covs.shape[-2:])]
            for source, to in restored:
                if to == target:
                    law = model.restored((source, to))
                    if law is not None:
                        share = _restoring(model, (source, to), means[:, source], step[:, source, :, source], restored)
                        own_w.append((np.exp(log_w[:, source]) * share).sum(-1, keepdims=True))
                        own_m.append(np.broadcast_to(law[0], (len(w), 1, len(law[0]))))
                        own_c.append(np.broadcast_to(law[1], (len(w), 1, *law[1].shape)))
            everything = (np.concatenate(own_w, axis=1), np.concatenate(own_m, axis=1), np.concatenate(own_c, axis=1))
            merged.append(_merged(*everything, self.k))
        weights, new_means, new_covs = (np.stack(a, axis=1) for a in zip(*merged, strict=True))
        return np.log(np.maximum(weights, np.exp(_NEVER))), new_means, new_covs


def _restoring(
    model: SwitchingSDE, switch: tuple[int, int], y: _Array, row: _Array, restored: list[tuple[int, int]]
) -> _Array:
    """Share of a component's weight that leaves by one restored switch."""
    ways = [s for s in restored if s[0] == switch[0]]
    total = sum((model.rate(s, y) for s in ways), np.zeros(y.shape[:-1]))
    return np.asarray((1 - row.sum(axis=-1)) * model.rate(switch, y) / np.maximum(total, 1e-300))


def _merged(w: _Array, means: _Array, covs: _Array, k: int) -> tuple[_Array, _Array, _Array]:
    """Merge Gaussians, two at a time, those first whose merging changes the mixture least (Runnalls 2007)."""
    w, means, covs = w.copy(), means.copy(), covs.copy()
    rows, n = np.arange(len(w)), means.shape[-1]
    scale = np.trace(covs.mean(axis=(0, 1))) / n
    covs = covs + 1e-12 * scale * np.eye(n)
    while w.shape[1] > k:
        i, j = np.triu_indices(w.shape[1], 1)
        total = w[:, i] + w[:, j] + 1e-300
        a = (w[:, i] / total)[..., None]
        off = means[:, i] - means[:, j]
        cov = a[..., None] * covs[:, i] + (1 - a)[..., None] * covs[:, j]
        cov += (a * (1 - a) * off)[..., :, None] * off[..., None, :]
        logdet = np.linalg.slogdet(covs)[1]
        cost = total * np.linalg.slogdet(cov)[1] - w[:, i] * logdet[:, i] - w[:, j] * logdet[:, j]
        best = cost.argmin(axis=1)
        one, other = i[best], j[best]
        share = a[rows, best]
        means[rows, one] = share * means[rows, one] + (1 - share) * means[rows, other]
        covs[rows, one], w[rows, one] = cov[rows, best], total[rows, best]
        keep = np.ones(w.shape, dtype=bool)
        keep[rows, other] = False
        left = w.shape[1] - 1
        w, means, covs = w[keep].reshape(-1, left), means[keep].reshape(-1, left, n), covs[keep].reshape(-1, left, n, n)
    pad = k - w.shape[1]
    if pad > 0:
        w = np.concatenate([w, np.zeros((len(w), pad))], axis=1)
        means = np.concatenate([means, np.repeat(means[:, :1], pad, axis=1)], axis=1)
        covs = np.concatenate([covs, np.repeat(covs[:, :1], pad, axis=1)], axis=1)
    return w, means, covs


def _kept(log_w: _Array, means: _Array, covs: _Array, log_likelihood: _Array, nis: _Array) -> Kept:
    w = np.exp(log_w)
    probs = w.sum(axis=-1)
    share = (w / probs[..., None])[..., None]
    mean = (share * means).sum(axis=2)
    off = means - mean[:, :, None]
    cov = symmetric((share[..., None] * (covs + off[..., :, None] * off[..., None, :])).sum(axis=2))
    log_probs = np.log(probs / probs.sum(axis=-1, keepdims=True))
    return Kept(log_probs, mean, cov, np.full(log_probs.shape, np.nan), log_likelihood, nis)
