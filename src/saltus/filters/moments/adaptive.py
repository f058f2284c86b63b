"""Raising the order where it matters: 2 -> 4 -> 6, judged over control intervals, run by run.

An interval is filtered at order 2. Runs whose densities stay Gaussian by the measure J keep it: the posterior's, and
what the predictions of the interval bring together. A Gaussian closure forgets at every step what the step has bent, so
that each alone says little: sqrt(J) is summed, as if nothing were forgotten. The other runs are repeated at order 4,
and where that changes means or variances by more than a limit, at order 6, which is used where it differs from order 4
by more than the limit again.

Source: moment-filter notes, section 8, which mends the paper's (23)-(30).
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.filters.moments.belief import Points, moments_of
from saltus.filters.moments.closure import Closing, Tally
from saltus.filters.moments.history import Kept, MomentHistory, estimates_of, kept, recorded
from saltus.filters.moments.posterior import MomentPosterior
from saltus.filters.moments.realisable import deviation
from saltus.filters.moments.recursion import Recursion, Setting
from saltus.filters.observation import Observation

__all__ = ["Adapt", "adaptive_rows"]

_Array = npt.NDArray[np.float64]


class Adapt(NamedTuple):
    """When to raise the order.

    Attributes:
        deviation: largest J over an interval that passes as Gaussian, nats; 0.0104 is |skewness| = 0.25 and |excess| =
            0.5 together.
        relative: largest change of a mean, in standard deviations, or of the log of a variance, that settles.
        interval: number of measurements judged together.
        max_order: 4 or 6.
    """

    deviation: float = 0.0104
    relative: float = 0.05
    interval: int = 15
    max_order: int = 6


class _Part(NamedTuple):
    """An interval of some runs at one order: moments and repairs of its rows, and the points after the last."""

    kept: list[Kept]
    foreseen: _Array  # J of the predicted densities if no row forgot the one before, (b,)
    tally: list[Tally]
    failed: list[npt.NDArray[np.bool_]]
    points: Points


def adaptive_rows(given: Observation, adapt: Adapt, settings: dict[int, Setting], per_mode: bool) -> MomentHistory:
    """Filter all runs, each at the order it needs.

    Raises:
        ModelError: limits out of range.
    """
    if adapt.deviation < 0 or adapt.relative <= 0 or adapt.interval < 1 or adapt.max_order not in (4, 6):
        raise ModelError(f"need deviation >= 0, relative > 0, interval >= 1, max_order 4 or 6: {adapt}.")
    n_steps, n_runs = len(given.times), len(given.z)
    points = Recursion(given, settings[4]).start()
    parts: list[_Part] = []
    order, unsettled = np.empty((n_runs, n_steps), np.int64), np.zeros((n_runs, n_steps), bool)
    for first in range(0, n_steps, adapt.interval):
        span = slice(first, min(first + adapt.interval, n_steps))
        part, used, doubtful = _interval(given, adapt, settings, points, span)
        order[:, span], unsettled[:, span] = used[:, None], doubtful[:, None]
        parts.append(part)
        points = part.points
    rows = [row for part in parts for row in part.kept]
    tallies = [tally for part in parts for tally in part.tally]
    failed = [found for part in parts for found in part.failed]
    record = recorded(given, rows, tallies, failed, order, unsettled)
    return MomentHistory(estimates_of(given, rows, per_mode), record, _closed(given, settings[4], points))


def _closed(given: Observation, setting: Setting, points: Points) -> MomentPosterior:
    """The last posterior as a density of order 4: the runs' own orders differ."""
    n, n_modes = given.model.n_state, given.model.n_modes
    closing = Closing(setting.closure, n, setting.order, setting.nodes, setting.protected, len(given.z))
    law = moments_of(closing.basis, [[(points.points[:, s], points.weights[:, s])] for s in range(n_modes)])
    density = closing.density(law._replace(log_probs=points.log_probs))
    nothing = np.full_like(given.z[:, -1], np.nan)
    return MomentPosterior(points, density, given.sensor, nothing, 0.0, np.zeros(len(nothing)))


def _interval(
    given: Observation, adapt: Adapt, settings: dict[int, Setting], points: Points, span: slice
) -> tuple[_Part, npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Filter one interval at rising orders: what was found, the order of each run, and which are not settled."""
    n_runs = len(given.z)
    part = _filtered(given, settings[2], points, np.arange(n_runs), span)
    used, doubtful = np.full(n_runs, 2), np.zeros(n_runs, dtype=bool)
    runs = np.flatnonzero(_mean_deviation(part) > adapt.deviation)
    for level in (4, 6):
        if not len(runs) or level > adapt.max_order:
            break
        better = _filtered(given, settings[level], points, runs, span)
        moving = _change(part, better, runs) > adapt.relative
        taken = np.ones_like(moving) if level == 4 else moving  # where order 6 confirms order 4, that is kept
        part = _joined(part, _taken(better, taken), runs[taken])
        used[runs[taken]] = level
        runs = runs[moving]
    doubtful[runs] = used[runs] == adapt.max_order
    return part, used, doubtful


def _taken(part: _Part, which: npt.NDArray[np.bool_]) -> _Part:
    """Some of the runs of a part."""
    return _Part(
        [Kept(*(a[which] for a in row)) for row in part.kept],
        part.foreseen[which],
        [Tally(*(a[which] for a in tally)) for tally in part.tally],
        [failed[which] for failed in part.failed],
        Points(*(a[which] for a in part.points)),
    )


def _filtered(given: Observation, setting: Setting, points: Points, runs: npt.NDArray[np.int64], span: slice) -> _Part:
    recursion = Recursion(given._replace(z=given.z[runs]), setting)
    rows = list(recursion.rows(Points(*(a[runs] for a in points)), span.start, span.stop))
    moments = [kept(row.points, row.log_likelihood, row.nis) for row in rows]
    laws = [row.predicted.law for row in rows]
    bent = [(np.exp(law.log_probs) * deviation(recursion.closing.basis, law.h)).sum(axis=1) for law in laws]
    foreseen = np.asarray(np.square(np.sqrt(bent).sum(axis=0)))
    return _Part(moments, foreseen, [row.tally for row in rows], [row.failed for row in rows], rows[-1].points)


def _mean_deviation(part: _Part) -> _Array:
    """J over the interval and over the modes, by their probabilities: the larger of posterior and predicted."""
    found = np.mean([(np.exp(k.log_probs) * k.deviation).sum(axis=1) for k in part.kept], axis=0)
    return np.maximum(found, part.foreseen)


def _change(before: _Part, after: _Part, runs: npt.NDArray[np.int64]) -> _Array:
    """Change between two orders: the largest over components of its mean over the interval."""
    changes = []
    for old, new in zip(before.kept, after.kept, strict=True):
        mean_a, cov_a = _collapsed(Kept(*(x[runs] for x in old)))
        mean_b, cov_b = _collapsed(new)
        var_a, var_b = (np.diagonal(c, axis1=-2, axis2=-1) for c in (cov_a, cov_b))
        moved = np.abs(mean_b - mean_a) / np.sqrt(var_b)
        changes.append(np.maximum(moved, np.abs(np.log(var_b / var_a))))
    return np.asarray(np.mean(changes, axis=0).max(axis=-1))


def _collapsed(k: Kept) -> tuple[_Array, _Array]:
    probs = np.exp(k.log_probs)
    mean = (probs[..., None] * k.means).sum(axis=1)
    off = k.means - mean[:, None]
    return mean, (probs[..., None, None] * (k.covs + off[..., :, None] * off[..., None, :])).sum(axis=1)


def _joined(everyone: _Part, some: _Part, runs: npt.NDArray[np.int64]) -> _Part:
    """Put an interval of some runs in place of what they had."""

    def put(whole: npt.NDArray[Any], part: npt.NDArray[Any]) -> npt.NDArray[Any]:
        out = whole.copy()
        out[runs] = part
        return out

    pairs = zip(everyone.kept, some.kept, strict=True)
    return _Part(
        [Kept(*(put(a, b) for a, b in zip(old, new, strict=True))) for old, new in pairs],
        put(everyone.foreseen, some.foreseen),
        [
            Tally(*(put(a, b) for a, b in zip(old, new, strict=True)))
            for old, new in zip(everyone.tally, some.tally, strict=True)
        ],
        [put(a, b) for a, b in zip(everyone.failed, some.failed, strict=True)],
        Points(*(put(a, b) for a, b in zip(everyone.points, some.points, strict=True))),
    )
