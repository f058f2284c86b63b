"""The Rao-Blackwellised particle filter of a jump linear system: particles are histories of modes, a Gaussian each.

Given its modes the system is linear and Gaussian, so a particle carries a Kalman filter and only the modes are drawn.
A step asks every particle what each next mode would make of the measurement, and chooses as many of these (particle,
next mode) pairs as there are particles (`particles.thinned`): the likely ones all, each with its probability, of the
others some by chance. Particles are therefore different histories, and while there are no more histories than particles
of a group, the answer is exact.

Particles live in independent groups, each a filter of its own; the answer is their average, and its spread over the
groups is the filter's own error, as long as some mode explains the measurements (`particles.stated_error`).

Source: Doucet, de Freitas, Murphy and Russell (2000); all next modes before choosing: Doucet, Gordon and Krishnamurthy
(2001), Particle filters for state estimation of jump Markov linear systems, IEEE Trans. SP 49(3); Fearnhead and
Clifford (2003), On-line inference for hidden Markov models via particle filters, JRSS B 65(4), for the choice.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError, NumericalError, SaltusError
from saltus.filters import steps
from saltus.filters.align import align
from saltus.filters.backend import Backend
from saltus.filters.bank import Bank
from saltus.filters.estimates import Estimates
from saltus.filters.flat import Flat, flatten
from saltus.filters.particles import Tables, effective_size, generator, group_error, stated_error, thinned
from saltus.filters.refusals import NotPositive, check_evidence, not_finite, of_runs, place
from saltus.linalg import logsumexp, normalised

__all__ = ["check_groups", "particle_filter"]

_Array = npt.NDArray[np.float64]
_Modes = npt.NDArray[np.int64]
_AT_ONCE = 4_000_000  # particles times modes held at once


def particle_filter(
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
    n_particles: int = 1000,
    groups: int = 8,
    rng: np.random.Generator | None = None,
    per_mode: bool = False,
    backend: Backend | None = None,
) -> Estimates:
    """Filter with particles for the modes and a Kalman filter in each; other arguments are those of `imm_filter`.

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
        n_particles: particles of each run, all groups together; rounded up to a multiple of groups.
        groups: independent filters they are divided among, for the error.
        rng: source of randomness.
        per_mode: also return every mode's mean and covariance (zeros where no particle is).
        backend: "numpy" for the definition, "native" for the compiled bank; None chooses.

    Returns:
        Estimates; `error` is the distance, in posterior standard deviations, within which the exact mean lies of the
        one returned, at 95 % confidence (`particles.group_error`); 0 as long as there are particles for all histories;
        infinite, with a finding, from the first measurement on that no mode explains (`particles.stated_error`).
        `effective` is the share of particles that count.

    Raises:
        ModelError: a shape or a law that cannot be, too few particles, or no rng.
        DataError: inf in z, NaN or inf elsewhere.
        NumericalError: an innovation covariance is not positive definite.
    """
    source = generator(rng)
    size = check_groups(n_particles, groups)
    model = align(z, F=F, Q=Q, H=H, R=R, trans=trans, mean0=mean0, cov0=cov0, probs0=probs0, b=b, d=d)
    flat = flatten(model)
    parts: list[_Rows] = []
    for part in _divided(flat, size * groups):
        first = sum(len(done.mean) for done in parts)
        try:
            parts.append(_filter(part, size, groups, source, backend, first))
        except SaltusError as error:  # of a part: which of all runs
            if error.runs is not None:
                error.runs = np.pad(error.runs, (first, flat.n_runs - first - len(error.runs)))
            raise
    rows = _Rows(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))
    return _estimates(rows, flat, model.z.shape[:-2], per_mode)


def check_groups(n_particles: int, groups: int) -> int:
    """Return the particles per group.

    Raises:
        ModelError: fewer than two groups, or of two particles.
    """
    if groups < 2 or n_particles < 2 * groups:
        raise ModelError(
            f"n_particles = {n_particles} in {groups} groups: give at least two groups (their spread is the error) "
            "of at least two particles; hundreds each are usual."
        )
    return -(-n_particles // groups)


class _Rows(NamedTuple):
    """What each run and row gives."""

    probs: _Array  # (B, T, M)
    group_means: _Array  # (B, T, G, n)
    mean: _Array  # (B, T, n)
    cov: _Array
    mode_means: _Array  # (B, T, M, n)
    mode_covs: _Array
    log_likelihood: _Array  # (B, T)
    nis: _Array
    effective: _Array
    nearest: _Array  # squared distance of the measurement from the nearest mode's prediction
    drawn: _Array  # 1 once a choice was left to chance, else 0


def _divided(flat: Flat, n_particles: int) -> list[Flat]:
    """Runs at once: one where matrices differ from run to run, else as many as memory is meant for."""
    arrays = [a for a in (*flat.arrays, *flat.chains, flat.log_probs0, flat.mean0, flat.cov0) if a is not None]
    own = any(len(a) > 1 for a in arrays)
    count = 1 if own else max(1, _AT_ONCE // (n_particles * flat.n_modes))

    def cut(a: _Array, runs: slice) -> _Array:
        return a if len(a) == 1 else a[runs]

    parts = []
    for first in range(0, flat.n_runs, count):
        runs = slice(first, first + count)
        parts.append(
            replace(
                flat,
                z=flat.z[runs],
                seen=flat.seen[runs],
                chains=tuple(None if c is None else cut(c, runs) for c in flat.chains),
                arrays=tuple(None if a is None else cut(a, runs) for a in flat.arrays),
                log_probs0=cut(flat.log_probs0, runs),
                mean0=cut(flat.mean0, runs),
                cov0=cut(flat.cov0, runs),
            )
        )
    return parts


def _filter(flat: Flat, size: int, groups: int, rng: np.random.Generator, backend: Backend | None, first: int) -> _Rows:
    B, M = flat.n_runs, flat.n_modes
    lots = B * groups  # independent filters of `size` particles
    rows = np.arange(lots * size)
    bank, mode, log_w = _start(flat, lots, size, rng, backend)
    drawn = np.full(B, float(M > size))
    of_lot = np.repeat(np.arange(lots), size)
    z_all = np.where(flat.seen, flat.z, np.nan)
    now = _moments(bank, rows, log_w, of_lot * M + mode, (B, groups, M))[0]
    out = []
    for k in range(flat.n_steps):
        tables, trans = _tables(flat, k), flat.trans(k)[0]
        z = np.repeat(z_all[:, k], groups * size, axis=0)
        with _by_run(B, first, k):
            law, log_f = bank.expand(rows, mode, trans, z, tables)
        prediction, law_now = _predicted(now, flat, k)
        log_w, likelihood = normalised(log_w + log_f.reshape(lots, size), (1,))
        least = likelihood.reshape(B, groups).min(-1)
        check_evidence(least, prediction.y, prediction.Y, flat.z[:, k], flat.seen[:, k], k, first)
        share = np.exp(log_w)
        probs = (share[:, None, :] @ law.reshape(lots, size, M))[:, 0]
        bank, mode, log_w, lost = _branched(bank, log_w, law, rng)
        drawn = np.maximum(drawn, lost.reshape(B, groups).any(-1))
        F, b, Q, H, d, R = tables
        bank.step(rows, [], F, b, Q, mode=mode)
        bank.update(rows, z, H, d, R, mode=mode)
        nis = steps.mixture_nis(law_now, prediction, flat.z[:, k], flat.seen[:, k], 1)
        with _by_run(B, first, k):
            nearest = _nearest(law_now, prediction, flat, k)
        now, group_means, mean, cov = _moments(bank, rows, log_w, of_lot * M + mode, (B, groups, M))
        log_f_runs = logsumexp(likelihood.reshape(B, groups), (1,))[:, 0] - np.log(groups)
        out.append(
            _Rows(
                probs.reshape(B, groups, M).mean(1),
                group_means,
                mean,
                cov,
                now.means,
                now.covs,
                np.where(flat.seen[:, k].any(-1), log_f_runs, 0.0),
                nis,
                effective_size(share).reshape(B, groups).mean(1) / size,
                nearest,
                drawn,
            )
        )
    return _Rows(*(np.stack(arrays, axis=1) for arrays in zip(*out, strict=True)))


@contextmanager
def _by_run(n_runs: int, first: int, row: int) -> Iterator[None]:
    """Let the bank's refusal of particles name their run, counted from `first`, and the row."""
    try:
        yield
    except NumericalError as error:
        if error.runs is None:
            raise
        refused = error.runs.reshape(n_runs, -1).any(axis=1)
        run = [first + int(refused.argmax())]
        told: NumericalError = not_finite(place(run, row))
        if isinstance(error, NotPositive):
            told = NotPositive(place(run, row, error.component), error.component)
        raise of_runs(told, refused) from error


def _start(
    flat: Flat, lots: int, size: int, rng: np.random.Generator, backend: Backend | None
) -> tuple[Bank, _Modes, _Array]:
    """One particle per mode of the prior, each with the prior's Gaussian; the other places are empty."""
    M, n = flat.n_modes, flat.mean0.shape[-1]
    mode, log_w = thinned(np.broadcast_to(flat.log_probs0[0], (lots, M)), size, rng)
    mean0 = np.broadcast_to(flat.mean0[0], (M, n))[mode.ravel()]
    cov0 = np.broadcast_to(flat.cov0[0], (M, n, n))[mode.ravel()]
    bank = Bank(n, (), capacity=lots * size, backend=backend)
    bank.add(steps.Belief(np.zeros(lots * size), mean0, cov0))
    return bank, mode.ravel(), normalised(log_w, (1,))[0]


def _tables(flat: Flat, k: int) -> Tables:
    """Matrices of row k, spelt out by mode where they depend on it."""
    every = np.arange(flat.n_modes)
    F, b, Q, H, d, R = (None if a is None else a[0] for a in flat.matrices(k, every))
    if F is None or Q is None or H is None or R is None:
        raise TypeError("F, Q, H and R are always there")
    return Tables(F, b, Q, H, d, R)


def _branched(
    bank: Bank, log_w: _Array, law: _Array, rng: np.random.Generator
) -> tuple[Bank, _Modes, _Array, npt.NDArray[np.bool_]]:
    """Choose among all (particle, next mode) pairs of each group; says too for which groups this left some out.

    Pairs of one next mode lie side by side: the particles that follow are sorted by mode, as the kernel likes them.
    """
    lots, size = log_w.shape
    with np.errstate(divide="ignore"):
        pairs = log_w[:, None, :] + np.log(law).reshape(lots, size, -1).swapaxes(1, 2)
    pairs = pairs.reshape(lots, -1)
    chosen, log_w = thinned(pairs, size, rng)
    mode, parents = np.divmod(chosen, size)
    bank = bank.take((parents + size * np.arange(lots)[:, None]).ravel())
    return bank, mode.ravel(), normalised(log_w, (1,))[0], np.isfinite(pairs).sum(1) > size


def _moments(
    bank: Bank, rows: _Modes, log_w: _Array, labels: _Modes, shape: tuple[int, int, int]
) -> tuple[steps.Belief, _Array, _Array, _Array]:
    """Belief by mode (B, M), means of the groups (B, G, n), mean and covariance (B, n[, n])."""
    B, G, M = shape
    mass, means, covs = bank.merged(rows, np.exp(log_w).ravel(), labels, B * G * M)
    n = means.shape[-1]
    with np.errstate(divide="ignore"):
        log_mass = np.log(mass).reshape(B, G, M)
    means, covs = means.reshape(B, G, M, n), covs.reshape(B, G, M, n, n)
    groups = steps.collapse(log_mass, means, covs, 1)
    mean, cov = steps.collapse(np.full((B, G), -np.log(G)), *groups, 1)
    # Modes without any particle have zeros for moments, and weigh nothing.
    given, total = normalised(np.moveaxis(log_mass, 1, -1), (2,))
    merged = steps.collapse(given, np.moveaxis(means, 1, -2), np.moveaxis(covs, 1, -3), 1)
    return steps.Belief(total[..., 0] - np.log(G), *merged), groups[0], mean, cov


def _predicted(now: steps.Belief, flat: Flat, k: int) -> tuple[steps.Joint, _Array]:
    """Predict row k in every mode, and the modes; merging by mode leaves the prediction's two moments exact."""
    log_probs, means, covs = steps.mix(*now, [flat.trans(k)])
    F, b, Q, H, d, R = flat.matrices(k, np.arange(flat.n_modes))
    return steps.measure(*steps.propagate(means, covs, F, b, Q), H, d, R), log_probs


def _nearest(law: _Array, prediction: steps.Joint, flat: Flat, k: int) -> _Array:
    """Squared distance of the measurement from what the nearest of the possible modes predicts."""
    of_mode = steps.condition(prediction, flat.z[:, k, None], flat.seen[:, k, None], n_runs=1).d2
    return np.asarray(np.min(np.where(np.isfinite(law), of_mode, np.inf), axis=-1))


def _estimates(rows: _Rows, flat: Flat, batch: tuple[int, ...], per_mode: bool) -> Estimates:
    n = rows.mean.shape[-1]

    def shaped(a: _Array, *core: int) -> _Array:
        return np.ascontiguousarray(a).reshape(*batch, flat.n_steps, *core)

    n_observed = shaped(flat.seen.sum(-1).astype(float))
    spread = group_error(rows.group_means, rows.cov) * rows.drawn  # without chance, groups differ by round-off
    error, findings = stated_error(shaped(spread), shaped(rows.nearest), n_observed, shaped(rows.drawn) > 0)
    return Estimates(
        probs=shaped(rows.probs, *flat.sizes),
        mean=shaped(rows.mean, n),
        cov=shaped(rows.cov, n, n),
        log_likelihood=shaped(rows.log_likelihood),
        log_likelihood_start=np.zeros(batch),
        nis=shaped(rows.nis),
        n_observed=n_observed,
        mode_means=shaped(rows.mode_means, *flat.sizes, n) if per_mode else None,
        mode_covs=shaped(rows.mode_covs, *flat.sizes, n, n) if per_mode else None,
        error=error,
        effective=shaped(rows.effective),
        findings=findings,
    )
