r"""The exact filter of a jump linear system: one Gaussian per history of modes, and one rule that merges histories.

After k rows the posterior is a mixture with one Gaussian for every sequence of modes. A step branches every history
into each next mode, then propagates, measures, conditions and reweighs all of them as `steps` does for modes. What
keeps their number down is one rule with three settings (`MergingRule`): histories whose `last` modes agree are merged
by their moments, after the update or between branching and propagation, and the `most` probable ones are kept.

    exact: merge nothing          GPB1: last=0, after        GPB2: last=1, after        IMM: last=1, before
    k-best: most=k                GPBn: last=n-1, after

From two modes on, before and after are the same: given the mode before it, the newest says nothing of older ones.

The filter's own error is what its rule threw away, in nats. Dropping histories of mass delta costs -log(1 - delta);
merging the histories h of a group g, weights w, at most sum_g 1/2 [w_g log det P_g - sum_h w_h log det P_h]. With
the sum I of both, the mean lies within sqrt(2 I) posterior standard deviations of the exact one for laws with Gaussian
tails. Nothing is forgotten in that sum, so it is cautious, and on long records of a merging rule far too cautious.

Source: Ackerson and Fu (1970) for GPB1; Chang and Athans (1978) for GPB2; Blom and Bar-Shalom (1988) for the IMM;
Runnalls (2007), Kullback-Leibler approach to Gaussian mixture reduction, IEEE Trans. AES 43(3), section IV, for the
cost of a merge; Bobkov and Goetze (1999) for the distance of means.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.filters import steps
from saltus.filters.align import Aligned, align
from saltus.filters.estimates import Estimates, described
from saltus.filters.flat import Flat, flatten
from saltus.filters.histories import EXACT, Histories, MergingRule, merged
from saltus.filters.run import Record, in_order
from saltus.linalg import logsumexp, normalised
from saltus.models import HybridModel, Observer

__all__ = ["ExactFilter", "exact_filter"]

_Array = npt.NDArray[np.float64]
_Codes = npt.NDArray[np.int64]
_MOST_AT_ONCE = 4_000_000  # elements of all histories' covariances


def exact_filter(
    z: npt.ArrayLike,
    *,
    F: npt.ArrayLike,
    Q: npt.ArrayLike,
    H: npt.ArrayLike,
    R: npt.ArrayLike,
    trans: Sequence[npt.ArrayLike],
    mean0: npt.ArrayLike,
    cov0: npt.ArrayLike,
    probs0: npt.ArrayLike,
    b: npt.ArrayLike | None = None,
    d: npt.ArrayLike | None = None,
    rule: MergingRule = EXACT,
    per_mode: bool = False,
) -> Estimates:
    """Filter with one Gaussian per history of modes; the arguments are those of `imm_filter`.

    Without a rule the answer is exact and costs M^T Gaussians, fewer where transitions are impossible: for short
    records, or chains that cannot switch. `rule=INTERACTING` gives what `imm_filter` gives.

    Args:
        z: measurements, (*batch, T, m); NaN is a missing component.
        F: transition matrices, (..., n, n), over (t_{k-1}, t_k].
        Q: process noise covariances, (..., n, n).
        H: measurement matrices, (..., m, n).
        R: measurement noise covariances, (..., m, m).
        trans: one matrix per chain, trans[c][i, j] = P(next = j | now = i).
        mean0: prior mean one interval before z[0].
        cov0: its covariance.
        probs0: prior law of the modes.
        b: known input, (..., n).
        d: known measurement offset, (..., m).
        rule: which histories are merged and how many are kept.
        per_mode: also return every mode's mean and covariance.

    Returns:
        Estimates, with `error` as the module says: 0 where nothing was thrown away.

    Raises:
        ModelError: a shape or a law that cannot be, or too many histories; the message says what to set.
        DataError: inf in z, NaN or inf elsewhere.
        NumericalError: an innovation covariance is not positive definite.
    """
    model = align(z, F=F, Q=Q, H=H, R=R, trans=trans, mean0=mean0, cov0=cov0, probs0=probs0, b=b, d=d)
    return _filter(model, flatten(model), rule, per_mode)


@dataclass(frozen=True, slots=True)
class ExactFilter:
    """The exact filter of a described model, or an approximation to it by a rule of merging.

    `ExactFilter(rule=GPB2)(model).run(records)`; see `exact_filter`.

    Attributes:
        rule: which histories are merged and how many are kept.
        per_mode: keep every mode's mean and covariance.
        model: the model it is bound to, or None.
    """

    rule: MergingRule = EXACT
    per_mode: bool = False
    model: HybridModel | None = None

    def __call__(self, model: HybridModel) -> "ExactFilter":
        """Bind the settings to a model."""
        return replace(self, model=model)

    def run(
        self, records: Iterable[Record | tuple[float, str, npt.ArrayLike] | tuple[float, str, npt.ArrayLike, Observer]]
    ) -> Estimates:
        """Filter records of one object, in time order, from the model's linear sensors, at any intervals.

        Args:
            records: (time, sensor, values) each; NaN is a missing component.

        Raises:
            ModelError: the filter is bound to no model, a sensor is not linear, or there are too many histories.
            DataError: there is no record, time goes back, or a record does not fit its sensor.
            NumericalError: an innovation covariance is not positive definite.
        """
        if self.model is None:
            raise ModelError("this filter is bound to no model: write ExactFilter(rule)(model).run(records).")
        listed, times = in_order(records)
        names = [record.sensor for record in listed]
        layout, arrays = self.model.arrays_for(times, names)
        z = layout.stack(names, [record.z for record in listed])
        found = exact_filter(z, **arrays._asdict(), rule=self.rule, per_mode=self.per_mode)
        return described(found, self.model, times)


class _Row(NamedTuple):
    probs: _Array  # (B, M)
    mean: _Array
    cov: _Array
    log_likelihood: _Array
    nis: _Array
    error: _Array
    lost: _Array
    mode_means: _Array | None
    mode_covs: _Array | None


def _filter(model: Aligned, flat: Flat, rule: MergingRule, per_mode: bool) -> Estimates:
    now, lost = _start(flat), np.zeros(flat.n_runs)
    since = lost  # the row before
    rows = []
    for k in range(flat.n_steps):
        now, modes = _branch(now, flat.trans(k), rule, k)
        if rule.before and rule.last is not None:
            now, cost = merged(now, flat.n_modes**rule.last)
            since = since + cost
            modes = np.tile(np.arange(flat.n_modes), flat.n_modes ** (rule.last - 1))
        lost = lost + since
        now, log_f, nis = _update(now, modes, flat, k)
        rows.append(_row(now, modes, flat.n_modes, log_f, nis, np.sqrt(2.0 * lost), since, per_mode))
        now, since = _reduced(now, modes, flat.n_modes, rule)
    return _estimates(rows, model)


def _start(flat: Flat) -> Histories:
    """The prior: one history where all modes share the Gaussian, else one per mode."""
    M, B = flat.n_modes, flat.n_runs
    shared = flat.mean0.shape[1] == flat.cov0.shape[1] == 1
    H = 1 if shared else M
    codes = np.zeros((B, 1), np.int64) if shared else np.broadcast_to(np.arange(M), (B, M))
    log_probs = flat.log_probs0[:, None, :]
    if not shared:
        log_probs = np.where(np.eye(M, dtype=bool), log_probs, -np.inf)
    n = flat.mean0.shape[-1]
    return Histories(
        np.broadcast_to(log_probs, (B, H, M)),
        codes,
        np.broadcast_to(flat.mean0, (B, H, n)),
        np.broadcast_to(flat.cov0, (B, H, n, n)),
    )


def _branch(now: Histories, trans: _Array, rule: MergingRule, k: int) -> tuple[Histories, _Codes]:
    """Every history into every next mode that some run can reach; returns the newest mode of each column too."""
    B, H, M = now.log_probs.shape
    with np.errstate(divide="ignore"):
        log_probs = logsumexp(now.log_probs[..., None] + np.log(trans)[:, None], (2,))[:, :, 0].reshape(B, H * M)
    columns = np.flatnonzero(np.isfinite(log_probs).any(axis=0))
    parents, modes = columns // M, columns % M
    size = len(columns) * B * now.means.shape[-1] ** 2
    if size > _MOST_AT_ONCE:
        raise ModelError(
            f"row {k} needs {len(columns)} histories of modes for each of {B} run(s), more than memory is meant for.\n"
            "Keep the most probable ones, rule=MergingRule(most=1000), merge, rule=GPB2, or filter fewer runs at once."
        )
    kept = 1 if rule.last is None else M ** max(rule.last, 1)
    codes = (now.codes[:, parents] * M + modes) % kept
    return Histories(log_probs[:, columns, None], codes, now.means[:, parents], now.covs[:, parents]), modes


def _update(now: Histories, modes: _Codes, flat: Flat, k: int) -> tuple[Histories, _Array, _Array]:
    """Propagate, measure, condition and reweigh: the histories are the states of one chain."""
    F, b, Q, H, d, R = flat.matrices(k, modes)
    means, covs = steps.propagate(now.means, now.covs, F, b, Q)
    z, seen, log_probs = flat.z[:, k], flat.seen[:, k], now.log_probs[..., 0]
    if not seen.any():
        return now._replace(means=means, covs=covs), np.zeros(len(z)), np.zeros(len(z))
    prediction = steps.measure(means, covs, H, d, R)
    nis = steps.mixture_nis(log_probs, prediction, z, seen, 1)
    belief, log_f = steps.update(log_probs, prediction, z, seen, 1, k)
    return Histories(belief.log_probs[..., None], now.codes, belief.means, belief.covs), log_f, nis


def _row(
    now: Histories,
    modes: _Codes,
    n_modes: int,
    log_f: _Array,
    nis: _Array,
    error: _Array,
    lost: _Array,
    per_mode: bool,
) -> _Row:
    log_probs = now.log_probs[..., 0]
    mean, cov = steps.collapse(log_probs, now.means, now.covs, 1)
    onto = (modes[:, None] == np.arange(n_modes)).astype(float)
    by_mode = None
    if per_mode:
        by_mode, _ = merged(now._replace(codes=np.broadcast_to(modes, now.codes.shape)), n_modes)
    return _Row(
        np.exp(log_probs) @ onto,
        mean,
        cov,
        log_f,
        nis,
        error,
        lost,
        None if by_mode is None else by_mode.means,
        None if by_mode is None else by_mode.covs,
    )


def _reduced(now: Histories, modes: _Codes, n_modes: int, rule: MergingRule) -> tuple[Histories, _Array]:
    """Keep the most probable, merge after the update; give every history its law of the newest mode."""
    B, H = now.codes.shape
    lost = np.zeros(B)
    newest = np.broadcast_to(modes, (B, H))
    if rule.most is not None and rule.most < H:
        order = np.argsort(-now.log_probs[..., 0], axis=1, kind="stable")[:, : rule.most]
        log_probs, kept = normalised(np.take_along_axis(now.log_probs, order[..., None], 1), (1,))
        lost = np.maximum(0.0, -kept[:, 0, 0])
        newest, codes = np.take_along_axis(newest, order, 1), np.take_along_axis(now.codes, order, 1)
        means = np.take_along_axis(now.means, order[..., None], 1)
        covs = np.take_along_axis(now.covs, order[..., None, None], 1)
        now = Histories(log_probs, codes, means, covs)
    log_law = np.where(newest[..., None] == np.arange(n_modes), now.log_probs, -np.inf)
    if rule.last is None or rule.before:
        return now._replace(log_probs=log_law), lost
    if rule.last == 0:
        one, cost = merged(now._replace(codes=np.zeros_like(now.codes)), 1)
        return one._replace(log_probs=logsumexp(log_law, (1,)), codes=one.codes), lost + cost
    groups, cost = merged(now, n_modes**rule.last)
    law = np.where(np.arange(n_modes**rule.last)[:, None] % n_modes == np.arange(n_modes), groups.log_probs, -np.inf)
    return groups._replace(log_probs=law), lost + cost


def _estimates(rows: Sequence[_Row], model: Aligned) -> Estimates:
    batch, sizes = model.z.shape[:-2], model.sizes

    def column(values: Sequence[_Array | None], *core: int) -> _Array:
        stacked = np.stack([v for v in values if v is not None], axis=1)
        return stacked.reshape(*batch, len(rows), *core)

    n = rows[0].mean.shape[-1]
    by_mode = rows[0].mode_means is not None
    return Estimates(
        probs=column([r.probs for r in rows], *sizes),
        mean=column([r.mean for r in rows], n),
        cov=column([r.cov for r in rows], n, n),
        log_likelihood=column([r.log_likelihood for r in rows]),
        log_likelihood_start=np.zeros(batch),
        nis=column([r.nis for r in rows]),
        n_observed=model.seen.sum(-1).astype(float),
        mode_means=column([r.mode_means for r in rows], *sizes, n) if by_mode else None,
        mode_covs=column([r.mode_covs for r in rows], *sizes, n, n) if by_mode else None,
        error=column([r.error for r in rows]),
        lost=column([r.lost for r in rows]),
    )
