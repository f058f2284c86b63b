"""Particle filters for what is not conditionally linear: bootstrap and auxiliary, in independent groups.

A particle is a mode and a state. Bootstrap: move by the model, weigh by the likelihood, draw anew by `systematic` when
fewer than half of a group's particles count. Auxiliary: before moving, draw by the likelihood of where each particle
would be without noise, and divide by it afterwards; better for accurate sensors and quiet motion, worse otherwise.

Source: Gordon, Salmond and Smith (1993); Pitt and Shephard (1999); moment-filter notes, section 11, for the cases they
are held against.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError
from saltus.filters import steps
from saltus.filters.estimates import Estimates
from saltus.filters.flat import Flat
from saltus.filters.observation import impossible, innovation_nis
from saltus.filters.particles import effective_size, group_error, stated_error, systematic
from saltus.linalg import normalised, symmetric
from saltus.models import DiffusionSensor, SwitchingSDE
from saltus.simulate import advance

__all__ = ["Moves", "bootstrap", "diffusion_moves", "hybrid_moves"]

_Array = npt.NDArray[np.float64]
_Modes = npt.NDArray[np.int64]
_COUNTS_BELOW = 0.5  # share of particles that count, below which a group is drawn anew
# A group whose particles went astray tells by its likelihood; of the log of its weight so much is kept at each row.
_REMEMBERED = 0.8


class Moves(NamedTuple):
    """How particles start and move: modes (k,), states (k, n)."""

    n_modes: int
    start: Callable[[int, np.random.Generator], tuple[_Modes, _Array]]
    move: Callable[[int, _Modes, _Array, np.random.Generator], tuple[_Modes, _Array]]
    guess: Callable[[int, _Modes, _Array], _Array]  # where a state goes without noise, in its mode


class _Cloud(NamedTuple):
    mode: _Modes  # (lots, size)
    x: _Array  # (lots, size, n)
    log_w: _Array  # (lots, size), normalised within a lot


class _Row(NamedTuple):
    probs: _Array  # (B, M)
    group_means: _Array  # (B, G, n)
    mean: _Array
    cov: _Array
    log_likelihood: _Array
    nis: _Array
    effective: _Array
    nearest: _Array


def diffusion_moves(model: SwitchingSDE, dts: _Array, substeps: int) -> Moves:
    """Moves of a switching diffusion by Euler steps."""
    bounds, roots = np.cumsum(np.asarray(model.probs0))[:-1], _root(np.asarray(model.covs0))

    def start(count: int, rng: np.random.Generator) -> tuple[_Modes, _Array]:
        mode = np.searchsorted(bounds, _spread(count, rng), side="right").astype(np.int64)
        return mode, model.means0[mode] + _pushed(roots[mode], rng)

    def guess(k: int, mode: _Modes, x: _Array) -> _Array:
        for _ in range(substeps):
            x = x.copy()
            for i in range(model.n_modes):
                x[mode == i] += model.drift_at(i, x[mode == i]) * dts[k] / substeps
        return x

    return Moves(model.n_modes, start, lambda k, mode, x, rng: advance(model, mode, x, dts[k], substeps, rng), guess)


def hybrid_moves(flat: Flat) -> Moves:
    """Exact moves of a hybrid model: the modes by their transition matrix, the state by F, b and Q of its mode."""
    M, n = flat.n_modes, flat.mean0.shape[-1]
    mean0, roots = np.broadcast_to(flat.mean0[0], (M, n)), np.broadcast_to(_root(flat.cov0[0]), (M, n, n))
    bounds = np.cumsum(np.exp(flat.log_probs0[0]))[:-1]

    def start(count: int, rng: np.random.Generator) -> tuple[_Modes, _Array]:
        mode = np.searchsorted(bounds, _spread(count, rng), side="right").astype(np.int64)
        return mode, mean0[mode] + _pushed(roots[mode], rng)

    def guess(k: int, mode: _Modes, x: _Array) -> _Array:
        F, b = (None if a is None else a[0] for a in flat.matrices(k, np.arange(M))[:2])
        if F is None:
            raise TypeError("F is always there")
        moved = x @ F[0].T if len(F) == 1 else (F[mode] @ x[..., None])[..., 0]
        return np.asarray(moved if b is None else moved + (b[0] if len(b) == 1 else b[mode]))

    def move(k: int, mode: _Modes, x: _Array, rng: np.random.Generator) -> tuple[_Modes, _Array]:
        rows = np.cumsum(flat.trans(k)[0], axis=-1)[mode]
        mode = np.asarray((rng.uniform(size=(len(mode), 1)) >= rows[:, :-1]).sum(-1), np.int64)
        root = np.broadcast_to(_root(flat.matrices(k, np.arange(M))[2][0]), (M, n, n))
        return mode, guess(k, mode, x) + _pushed(root[mode], rng)

    return Moves(M, start, move, guess)


def bootstrap(
    moves: Moves,
    sensor: DiffusionSensor,
    z: _Array,
    dts: _Array,
    *,
    size: int,
    groups: int,
    auxiliary: bool,
    rng: np.random.Generator,
) -> Estimates:
    """Filter B runs of measurements with `groups` independent filters of `size` particles each.

    Args:
        moves: of the model.
        sensor: what is measured, in each mode.
        z: (B, T, m); NaN is missing.
        dts: interval before each row, (T,), s.
        size: particles per group.
        groups: independent groups per run.
        auxiliary: draw before moving.
        rng: source of randomness.

    Returns:
        Estimates with leading axes (B, T).

    Raises:
        DataError: a measurement is impossible for every particle of a group.
    """
    B, lots = len(z), len(z) * groups
    mode, x = moves.start(lots * size, rng)
    cloud = _Cloud(mode.reshape(lots, size), x.reshape(lots, size, -1), np.full((lots, size), -np.log(size)))
    rows = []
    log_group = np.full((B, groups), -np.log(groups))
    for k in range(z.shape[1]):
        seen = np.repeat(z[:, k], groups, axis=0)
        moved = _moved(cloud, moves, k, rng)
        nis, nearest = _distances(moved, moves.n_modes, sensor, z[:, k], dts[k])
        before = None
        if auxiliary:  # the innovation is that of all, the update that of those drawn
            drawn, before = _drawn_ahead(cloud, moves, sensor, k, z, dts[k], rng)
            moved = _moved(drawn, moves, k, rng)
        log_w = moved.log_w + _log_likelihood(moved, sensor, seen, dts[k]) - (0.0 if before is None else before.log_g)
        log_w, log_f = normalised(log_w, (1,))
        _possible(log_f, moved, moves, sensor, z, k)
        cloud = moved._replace(log_w=log_w)
        evidence = log_f[:, 0] + (0.0 if before is None else before.log_f)
        told = log_group + evidence.reshape(B, groups)
        told, total = normalised(told, (1,))
        rows.append(_row(cloud, moves.n_modes, told, total[:, 0], nis, nearest))
        log_group, _ = normalised(_REMEMBERED * told, (1,))
        cloud = _drawn_anew(cloud, rng)
    stacked = _Row(*(np.stack(parts, axis=1) for parts in zip(*rows, strict=True)))
    n_observed = (~np.isnan(z)).sum(-1).astype(float)
    spread, by_chance = group_error(stacked.group_means, stacked.cov), np.ones(n_observed.shape, bool)
    error, findings = stated_error(spread, stacked.nearest, n_observed, by_chance)
    return Estimates(
        probs=stacked.probs,
        mean=stacked.mean,
        cov=stacked.cov,
        log_likelihood=stacked.log_likelihood,
        log_likelihood_start=np.zeros(B),
        nis=stacked.nis,
        n_observed=n_observed,
        error=error,
        effective=stacked.effective,
        findings=findings,
    )


def _moved(cloud: _Cloud, moves: Moves, k: int, rng: np.random.Generator) -> _Cloud:
    shape = cloud.mode.shape
    mode, x = moves.move(k, cloud.mode.ravel(), cloud.x.reshape(cloud.mode.size, -1), rng)
    return cloud._replace(mode=mode.reshape(shape), x=x.reshape(*shape, -1))


def _log_likelihood(cloud: _Cloud, sensor: DiffusionSensor, seen: _Array, dt: float, x: _Array | None = None) -> _Array:
    """Log g of each lot's measurement at its particles, or at other states of theirs."""
    lots, size = cloud.mode.shape
    flat = (cloud.x if x is None else x).reshape(lots * size, -1)
    z = np.repeat(seen, size, axis=0)
    out = np.zeros(lots * size)
    for i in range(sensor.n_modes):
        own = np.flatnonzero(cloud.mode.ravel() == i)
        if len(own):
            out[own] = sensor.log_likelihood(i, z[own], flat[own], dt)
    return out.reshape(lots, size)


def _possible(log_f: _Array, cloud: _Cloud, moves: Moves, sensor: DiffusionSensor, z: _Array, k: int) -> None:
    """Refuse a measurement that is impossible for every particle of a group."""
    if np.isfinite(log_f).all():
        return
    lot = int(np.argmin(np.isfinite(log_f[:, 0])))
    run = lot * len(z) // len(cloud.mode)
    told = impossible(
        sensor, z[run, k], [(i, cloud.x[lot, cloud.mode[lot] == i]) for i in range(moves.n_modes)], run, k
    )
    raise DataError(f"{told} is impossible for every particle.\nCheck its unit, or take more particles.")


class _Ahead(NamedTuple):
    log_g: _Array  # (lots, size): by what the particles drawn were weighed
    log_f: _Array  # (lots,)


def _drawn_ahead(
    cloud: _Cloud, moves: Moves, sensor: DiffusionSensor, k: int, z: _Array, dt: float, rng: np.random.Generator
) -> tuple[_Cloud, _Ahead]:
    lots, size = cloud.mode.shape
    seen = np.repeat(z[:, k], lots // len(z), axis=0)
    ahead = moves.guess(k, cloud.mode.ravel(), cloud.x.reshape(lots * size, -1))
    # Half the log: a state without its noise is a doubtful witness, and weights stay bounded.
    log_g = 0.5 * _log_likelihood(cloud, sensor, seen, dt, ahead)
    first = cloud.log_w + log_g
    log_share, log_f = normalised(first, (1,))
    _possible(log_f, cloud, moves, sensor, z, k)
    taken = systematic(np.exp(log_share), rng)
    drawn = _Cloud(
        np.take_along_axis(cloud.mode, taken, 1),
        np.take_along_axis(cloud.x, taken[..., None], 1),
        np.full((lots, size), -np.log(size)),
    )
    return drawn, _Ahead(np.take_along_axis(log_g, taken, 1), log_f[:, 0])


def _drawn_anew(cloud: _Cloud, rng: np.random.Generator) -> _Cloud:
    """Draw those groups anew of whose particles too few count; in order of mode and first state, which spreads them."""
    size = cloud.mode.shape[1]
    w = np.exp(cloud.log_w)
    few = np.flatnonzero(effective_size(w) < _COUNTS_BELOW * size)
    if not len(few):
        return cloud
    order = np.lexsort((cloud.x[few, :, 0], cloud.mode[few]), axis=-1)
    taken = np.take_along_axis(order, systematic(np.take_along_axis(w[few], order, 1), rng), 1)
    mode, x, log_w = cloud.mode.copy(), cloud.x.copy(), cloud.log_w.copy()
    mode[few], log_w[few] = np.take_along_axis(cloud.mode[few], taken, 1), -np.log(size)
    x[few] = np.take_along_axis(cloud.x[few], taken[..., None], 1)
    return _Cloud(mode, x, log_w)


def _row(cloud: _Cloud, n_modes: int, log_group: _Array, log_f: _Array, nis: _Array, nearest: _Array) -> _Row:
    """Moments over groups by their weights (B, G).

    The mean's error is sum_g W_g (x_g - exact): to the error of groups it is that of even weights and means
    mean + G W_g (x_g - mean).
    """
    (lots, _), (B, groups), n = cloud.mode.shape, log_group.shape, cloud.x.shape[-1]
    share = np.exp(log_group)[..., None]
    w = np.exp(cloud.log_w)
    labels = cloud.mode + n_modes * np.arange(lots)[:, None]
    probs = np.bincount(labels.ravel(), w.ravel(), lots * n_modes).reshape(B, groups, n_modes)
    means = (w[:, None] @ cloud.x)[:, 0]
    off = cloud.x - means[:, None]
    covs = symmetric((w[..., None] * off).swapaxes(1, 2) @ off)
    group_means = means.reshape(B, groups, n)
    mean, cov = steps.collapse(log_group, group_means, covs.reshape(B, groups, n, n), 1)
    group_means = mean[:, None] + groups * share * (group_means - mean[:, None])
    size = cloud.mode.shape[1]
    effective = effective_size(w).reshape(B, groups).mean(1) / size
    return _Row((share * probs).sum(1), group_means, mean, cov, log_f, nis, effective, nearest)


def _distances(cloud: _Cloud, n_modes: int, sensor: DiffusionSensor, z: _Array, dt: float) -> tuple[_Array, _Array]:
    """Squared distances of the measurement from its prediction, and from that of the nearest mode."""
    B, n = len(z), cloud.x.shape[-1]
    x, mode = cloud.x.reshape(B, -1, n), cloud.mode.reshape(B, -1)
    w = np.exp(cloud.log_w).reshape(B, -1)
    if np.isnan(z).all():
        return np.zeros(B), np.zeros(B)
    of_mode = [np.where(mode == i, w, 0.0) for i in range(n_modes)]
    present = [i for i in range(n_modes) if of_mode[i].any()]
    away = (x[:, :1], np.zeros((B, 1)))  # of a mode that has no particle, or is not asked for

    def distance(modes: list[int]) -> _Array:
        total = np.sum([of_mode[i].sum(-1, keepdims=True) for i in modes], axis=0)
        scale = np.where(total > 0, total, 1.0)
        d2 = innovation_nis(sensor, z, dt, [(x, of_mode[i] / scale) if i in modes else away for i in range(n_modes)])
        return np.where(total[:, 0] > 0, d2, np.inf)

    return distance(present), np.min([distance([i]) for i in present], axis=0)


def _spread(count: int, rng: np.random.Generator) -> _Array:
    """Uniform numbers, one in each of `count` equal pieces of (0, 1), in random order."""
    return np.asarray(rng.permutation((rng.uniform(size=count) + np.arange(count)) / count))


def _pushed(root: _Array, rng: np.random.Generator) -> _Array:
    return np.asarray((root @ rng.standard_normal((*root.shape[:-1], 1)))[..., 0])


def _root(cov: _Array) -> _Array:
    """Symmetric square root of covariances, singular ones too."""
    values, vectors = np.linalg.eigh(cov)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :] @ vectors.swapaxes(-1, -2))
