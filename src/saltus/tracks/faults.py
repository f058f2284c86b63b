"""What may be wrong with a plot: a fault of its own, without memory, and the lasting condition of its source.

A plot of a radar is right, or wrong in azimuth, or in range; that of another sensor is right, or wrong as a position.
The source is well, or degraded in the same components, all its plots alike. Every pair of the two is a covariance of
the measurement, and a plot is the mixture of them: the product of two more chains with the manoeuvres of each track.
The plot's chain forgets; the source's is one for all tracks and lives here, so no track stores a mode for either.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.linalg import logsumexp, normalised
from saltus.records import Kind
from saltus.tracks.measurements import Measurements
from saltus.tracks.settings import TrackerSettings

__all__ = ["History", "PlotLaw", "SourceCondition", "plot_law", "rays", "weighty"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]

_FAULTY_SHARE = 0.1  # of the range: faults scale with what a radar covers
_LIVE = 0.01  # probability of a condition from which gates reckon with it
_OWN_AFFAIR = 0.05  # probability that the error of a plot is its target's own affair and tells nothing of the source
_LASTING = 4.0  # s that errors of one target last: it is heard once in that time
_FORGOTTEN, _FEW_HEARD = 60.0, 64  # s, more than plots come late; and tracks that are no burden
_NEGLIGIBLE = 1e-3  # probability of all hypotheses of a plot that are left aside
_ROUGH = 0.005  # of positions that transmitters tell err as under a degraded source, each by itself


@dataclass(frozen=True, slots=True, eq=False)
class PlotLaw:
    """The h covariances that a plot of one source may have; the first is a good plot's of a source that is well."""

    components: tuple[str, ...]  # what may go wrong: azimuth and range, azimuth, or the position
    degraded: npt.NDArray[np.bool_]  # (q, components): what each condition of the source degrades; the first nothing
    condition: _Index  # (h,)
    fault: npt.NDArray[np.int8]  # (h,): 0 none, else 1 + the component
    log_own: _Array  # (q, h): log probability of the hypothesis given the condition of the source
    growth: float  # of the variance, in a degraded component
    outlier: _Array  # (components,): standard deviation of a fault, rad or m

    def covariances(self, m: Measurements, index: _Index, which: _Index | None = None) -> _Array:
        """Return covariances of plots under the hypotheses `which` (all by default), (k, h, 3, 3).

        R + sum_a e_a B_a over the components a: e_a = (growth - 1) v_a where the source is degraded in a, plus
        outlier_a^2 where the plot is wrong in it. Of a radar B = c c', u u' with u the unit vector from the site and c
        the one across it, v = c'R c, u'R u; a fault of azimuth counts times the ground range, one of range is cut to a
        tenth of it. Else B = I and v the mean of the two variances.
        """
        h = np.arange(len(self.fault)) if which is None else which
        R = m.cov[index]
        basis, variance, wrong = self._basis(m, index, R[:, :2, :2])
        lasting = (self.growth - 1.0) * self.degraded[self.condition[h]]
        own = self.fault[h, None] == 1 + np.arange(len(self.components))
        extra = lasting * variance[:, None] + own * wrong[:, None] ** 2
        cov = np.repeat(R[:, None], len(h), axis=1)
        cov[..., :2, :2] += np.einsum("kha,kaij->khij", extra, basis)
        return cov

    def angular(self, sigma: _Array, which: _Index | None = None) -> _Array:
        """Return variances of bearings (k,) of standard deviation `sigma` under hypotheses as `covariances`, (k, h).

        Of a source that measures positions, too, a faulty bearing errs like a good one.
        """
        h = np.arange(len(self.fault)) if which is None else which
        growth = np.where(self.degraded[self.condition[h], 0], self.growth, 1.0)
        wrong = np.where(self.fault[h] == 1, self.outlier[0], 0.0) if self.components[0] == "azimuth" else 0.0
        return np.asarray(growth * sigma[:, None] ** 2 + np.square(wrong))

    def faulty(self, p: _Array) -> tuple[_Array, npt.NDArray[np.int8]]:
        """Return the probability that each plot is wrong, and its likeliest fault (1 + component), 0 if none can be.

        Args:
            p: probabilities of the hypotheses, (n, h).
        """
        if not self.fault.any():
            return np.zeros(len(p)), np.zeros(len(p), np.int8)
        each = p @ (self.fault[:, None] == 1 + np.arange(len(self.components)))
        return np.minimum(each.sum(axis=1), 1.0), (1 + each.argmax(axis=1)).astype(np.int8)

    def _basis(self, m: Measurements, index: _Index, R: _Array) -> tuple[_Array, _Array, _Array]:
        """Directions B (k, a, 2, 2), variances in them (k, a), deviations of faults (k, a)."""
        if "range" not in self.components:
            each = np.ones((len(index), 1))
            return each[..., None, None] * np.eye(2), 0.5 * np.trace(R, axis1=1, axis2=2)[:, None], each * self.outlier
        ray = rays(m, index, self.outlier)
        distance = np.hypot(ray[:, 0], ray[:, 1])
        u = ray / distance[:, None]
        direction = np.stack([np.stack([-u[:, 1], u[:, 0]], axis=-1), u], axis=1)
        variance = np.einsum("kai,kij,kaj->ka", direction, R, direction)
        wrong = np.stack([self.outlier[0] * distance, np.minimum(self.outlier[1], _FAULTY_SHARE * distance)], axis=-1)
        return direction[..., :, None] * direction[..., None, :], variance, wrong


def rays(m: Measurements, index: _Index, outlier: _Array) -> _Array:
    """Return rays (k, 2) of plots of a radar; of a position told without range and azimuth, one that may be as wrong.

    Args:
        m: the measurements.
        index: of the plots.
        outlier: deviations of faulty azimuths, rad, and ranges, m: such a position may be wrong by the latter each way.
    """
    return np.where(np.isnan(m.ray[index]), [0.0, outlier[1] / outlier[0]], m.ray[index])


def weighty(p: _Array) -> tuple[_Index, _Index, _Index]:
    """Return the fewest hypotheses of each plot that hold all but 1e-3 of its probability.

    The others would move a track by less than that share of their distance.

    Args:
        p: probabilities, (k, h).

    Returns:
        Plot and hypothesis of each, sorted by plot, (c,), and where each plot's begin, (k + 1,).
    """
    order = np.argsort(-p, axis=1, kind="stable")
    before = np.cumsum(np.take_along_axis(p, order, axis=1), axis=1)
    before = np.column_stack([np.zeros(len(p)), before[:, :-1]])
    keep = np.zeros(p.shape, bool)
    np.put_along_axis(keep, order, before < 1.0 - _NEGLIGIBLE, axis=1)
    each, which = np.nonzero(keep)
    return each, which, np.append(0, np.cumsum(keep.sum(axis=1)))


def plot_law(settings: TrackerSettings, kind: int) -> PlotLaw:
    """Return what the settings say of the reports of a source.

    Args:
        settings: how often, and by how much reports err.
        kind: what it measures: range and azimuth (`Kind.POLAR`), azimuth alone (`Kind.BEARING`), or positions.
    """
    azimuth, far = np.radians(settings.outlier_azimuth), settings.outlier_range
    outlier = {
        Kind.POLAR: {"azimuth": azimuth, "range": far},
        Kind.BEARING: {"azimuth": azimuth},
    }.get(kind, {"position": settings.outlier_xy})
    components, p = tuple(outlier), settings.plot_outlier
    conditions = list(product((False, True), repeat=len(components)))
    if settings.degraded_noise == 1.0:
        conditions = conditions[:1]
    faults = range(1 + len(components)) if p > 0.0 else range(1)
    pairs = np.array(list(product(range(len(conditions)), faults)))
    rough = _ROUGH if len(conditions) > 1 and "position" in outlier else 0.0  # a radar measures all by the same means
    prior = np.array([1.0 - p * (len(faults) - 1), *([p] * (len(faults) - 1))])
    return PlotLaw(
        components,
        np.array(conditions),
        pairs[:, 0],
        pairs[:, 1].astype(np.int8),
        _log_given(np.array(conditions)[pairs[:, 0]], np.array(conditions), rough=rough) + np.log(prior)[pairs[:, 1]],
        settings.degraded_noise**2,
        np.array(list(outlier.values())),
    )


def _log_given(plot: npt.NDArray[np.bool_], source: npt.NDArray[np.bool_], *, rough: float) -> _Array:
    """Log probability that a plot errs as under each of h conditions, under q conditions of its source, (q, h).

    Component by component: as its source does, but where that is well, with probability `rough` as if it were not.
    """
    each = np.array([[1.0 - rough, rough], [0.0, 1.0]])
    given = each[source[:, None].astype(int), plot.astype(int)].prod(axis=-1)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(given))


class History(NamedTuple):
    """The condition of a source after each scan that told something of it."""

    time: _Array  # (T,), s
    probs: _Array  # (T, q)


class SourceCondition:
    """The condition of one source: a forward filter over its scans, fed by all its tracks at once.

    Its components degrade independently, each a chain of two states with the given mean stays. One scan multiplies the
    predicted probability of a condition by what all plots say of it. What a single plot says is bounded: with
    probability e its error is its target's own affair (a poor transmitter, a turn just begun, an error that lasts and
    was counted before), whatever the source does. So a source is degraded when its tracks err together or one errs for
    scans with no other to contradict, never for one bad plot.
    """

    def __init__(self, law: PlotLaw, settings: TrackerSettings) -> None:
        """Begin with the stationary probabilities."""
        self.law = law
        self._sojourn = settings.degraded_sojourn
        self._share = self._sojourn[1] / sum(self._sojourn)  # of the time that a component is degraded
        each = np.where(law.degraded, self._share, 1.0 - self._share)
        self._log_probs = np.log(each.prod(axis=1)) if len(law.degraded) > 1 else np.zeros(1)
        self._time = -np.inf
        self._heard: dict[int, float] = {}  # when each track was last asked, s
        self._kept = _FEW_HEARD
        self._history: list[tuple[float, _Array]] = []

    @property
    def history(self) -> History:
        """What has been found so far."""
        times = np.array([time for time, _ in self._history])
        return History(times, np.array([p for _, p in self._history]).reshape(-1, len(self.law.degraded)))

    def drained(self) -> History:
        """Return what has been found since the last time, and forget it."""
        found, self._history = self.history, []
        return found

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Return what `restore` goes on from: arrays by name."""
        return {
            "log_probs": self._log_probs,
            "time": np.array(self._time),
            "track": np.array(list(self._heard), np.int64),
            "heard": np.array(list(self._heard.values()), np.float64),
            "history_time": self.history.time,
            "history_probs": self.history.probs,
        }

    def restore(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Go on from arrays that `state` gave."""
        self._log_probs, self._time = np.array(state["log_probs"]), float(state["time"])
        self._heard = dict(zip(state["track"].tolist(), state["heard"].tolist(), strict=True))
        self._history = list(zip(state["history_time"].tolist(), np.array(state["history_probs"]), strict=True))

    @property
    def p_degraded(self) -> float:
        """Probability that it is not well since its last scan."""
        return float(1.0 - np.exp(self._log_probs[0]))

    @property
    def degraded(self) -> bool:
        """Whether it is probably not well since its last scan."""
        return bool(np.exp(self._log_probs[0]) < 0.5)

    def predicted(self, time: float) -> _Array:
        """Return log probabilities of the conditions at a time, (q,)."""
        if len(self._log_probs) == 1 or not np.isfinite(self._time):
            return self._log_probs
        rate = 1.0 / self._sojourn[0] + 1.0 / self._sojourn[1]
        fade = float(np.exp(-rate * max(time - self._time, 0.0)))
        law = np.array([1.0 - self._share, self._share])
        trans = fade * np.eye(2) + (1.0 - fade) * law
        probs = np.exp(self._log_probs).reshape((2,) * len(self.law.components))
        for axis in range(probs.ndim):
            probs = np.moveaxis(np.tensordot(probs, trans, (axis, 0)), -1, axis)
        return np.asarray(np.log(np.maximum(probs, 1e-300)).ravel())

    def live(self, prior: _Array) -> _Index:
        """Return the hypotheses that a gate must reckon with, given log probabilities of the conditions."""
        return np.flatnonzero(np.exp(prior)[self.law.condition] > _LIVE)

    def weights(self, prior: _Array) -> _Array:
        """Return log probabilities of all hypotheses, (h,), from those of the conditions."""
        return np.asarray(logsumexp(prior[:, None] + self.law.log_own, (0,))[0])

    def voice(self, track: npt.NDArray[np.int64], time: _Array, confirmed: npt.NDArray[np.bool_]) -> _Array:
        """Return how much plots may say of the source, (n,): w = min(1, time since the last one so used / 4 s).

        Errors last some seconds, so that of a track seen twice a second eight plots say as much as one.

        Args:
            track: the track of each plot, no two the same.
            time: of each plot, s.
            confirmed: whether the track is; others have no say.
        """
        last = np.array([self._heard.get(k, -np.inf) for k in track.tolist()])
        now = np.maximum(time, last)
        self._heard.update(zip(track[confirmed].tolist(), now[confirmed].tolist(), strict=True))
        self._forget(float(now.max(initial=-np.inf)))
        return np.where(confirmed, np.clip((time - last) / _LASTING, 0.0, 1.0), 0.0)

    def _forget(self, now: float) -> None:
        """Forget tracks heard so long ago that they have their full say again, when there are many of them."""
        if len(self._heard) > 2 * self._kept:
            self._heard = {k: t for k, t in self._heard.items() if t > now - _FORGOTTEN}
            self._kept = max(_FEW_HEARD, len(self._heard))

    def absorb(self, time: float, prior: _Array, log_f: _Array, voice: _Array) -> _Array:
        """Take in a scan; return for every plot the log probabilities of its hypotheses before it was seen itself.

        P(q | scan) ~ P(q) prod_i g_i(q)^w_i,  g_i(q) = (1 - e) f_i(q) + e max_q' f_i(q'),
        f_i(q) = sum_h P(h | q) f_i(h)

        No g_i differs between conditions by more than a factor 1 / e. For plot i its own factor is left out; its f_i
        comes in when its track is conditioned on it.

        Args:
            time: of the scan, s.
            prior: log probabilities of the conditions, (q,).
            log_f: log-likelihood of each plot under each hypothesis, (n, h).
            voice: the exponents w, (n,), of `voice`.
        """
        q, law = len(prior), self.law
        by_condition = logsumexp(law.log_own + log_f[:, None], (2,))[..., 0]
        best = by_condition.max(axis=1, keepdims=True)
        bounded = np.logaddexp(np.log1p(-_OWN_AFFAIR) + by_condition, np.log(_OWN_AFFAIR) + best)
        told = np.asarray(voice, float)[:, None] * bounded
        total = prior + told.sum(axis=0)
        if np.any(voice) and q > 1:
            self._log_probs = normalised(total, (0,))[0]
            self._time = max(self._time, time)  # a later round of a slice may hold earlier plots
            self._history.append((self._time, np.exp(self._log_probs)))
        others = normalised(total - told, (1,))[0]
        return np.asarray(logsumexp(others[:, :, None] + law.log_own, (1,))[:, 0])
