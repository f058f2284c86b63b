"""The biases that explain the residuals of common objects: robust, only what the geometry separates."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.tracks.bias import GROUPS, PARAMETERS, second_order
from saltus.tracks.encounters import Blocks, medians

__all__ = ["Fit", "fit_biases", "unknown"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]

_STRETCH = 300.0  # s: so long an object's own offset is one
_HUBER = 2.5  # standard deviations: stretches beyond it count less
_MEDIAN_CHI2 = 1.3863  # of two degrees of freedom
_PRIOR_OBJECTS = 2.0  # how many objects the expected scatter between objects is worth
_PRIOR_BLOCKS = 10.0
_INFORMATIVE = 0.5  # of the prior standard deviation: a parameter that stays wider is not estimated
_FREEDOM = 4  # objects more than parameters: with fewer their scatter says nothing
_ITERATIONS = 6
_SINGULAR = 1e-9
_FEW = "too few common objects"


class Fit(NamedTuple):
    """Biases at one time."""

    mean: _Array  # (q,), 0 where not estimated
    cov: _Array  # (q, q)
    chosen: _Index  # which are estimated
    scatter: float  # standard deviation between objects, each axis, m
    noise: float  # factor of the stated covariance of a block's residual
    objects: int
    refused: dict[str, str]  # group -> why it is not estimated


class _Stretches(NamedTuple):
    """Blocks of one pair within some minutes, as one residual each."""

    of: _Index  # (N,): stretch of each block
    first: _Index  # (K,): its first block
    size: _Index  # (K,): its blocks
    effect: _Array  # (K, 2, q)
    cov: _Array  # (K, 2, 2): stated noise of one report
    object: _Index  # (K,)
    share: _Array  # (K,): 1 / stretches of its object


def unknown(prior: _Array, scatter: float) -> Fit:
    """Return what holds before anything is known."""
    q = len(prior)
    return Fit(np.zeros(q), np.diag(prior**2), np.zeros(0, np.int64), scatter, 1.0, 0, dict.fromkeys(GROUPS, _FEW))


def fit_biases(blocks: Blocks, tracks: _Index, before: Fit, prior: _Array, scatter: float, widening: float) -> Fit:
    """Fit biases to the residuals of pairs taken for common objects.

    The residual of stretch k of an object is e = B c + d + v: c the biases, B their effects there, d ~ N(0, s^2 I)
    what lasts with the object, v the mean of the noise of its blocks, covariance V. The information about c is

        J = sum_k w_k B_k' S_k^-1 B_k,  S_k = V_k + s^2 I,  w_k = h(d2_k) / (stretches of the object of k)

    so that a thousand reports of one object are one object. Stretches beyond 2.5 standard deviations count less (h is
    Huber's weight), s and the noise are estimated beside c, and standard deviations are widened to what the scatter
    of the objects' scores says.

    Args:
        blocks: residuals, pairs numbered from 0 without gaps.
        tracks: the two tracks of each pair, (P, 2); pairs that share one are one object.
        before: where to start.
        prior: standard deviations of the biases.
        scatter: expected s, m.
        widening: of a standard deviation that telling a group of parameters from the others may cost; a group that
            costs more is not separable.
    """
    k = _stretched(blocks, tracks)
    geometry = np.einsum("k,kij,kil->jl", k.share, k.effect, k.effect)
    mean, s, trust = before.mean, before.scatter, np.ones(len(k.size))
    for _ in range(_ITERATIONS):
        e = blocks.residual - blocks.effect @ second_order(mean)
        left = np.stack([medians(e[:, c], k.of, k.first, k.size) for c in (0, 1)], axis=-1)
        noise = _noise(e - left[k.of], blocks.cov, k)
        V = k.cov * (noise / k.size)[:, None, None]
        W = (trust * k.share)[:, None, None] * np.linalg.inv(V + s**2 * np.eye(2))
        BW = k.effect.swapaxes(-1, -2) @ W
        J = np.einsum("kij,kjl->il", BW, k.effect)
        chosen, refused = _separable(geometry, J, prior, widening)
        step, cov = _solved(J, np.einsum("kij,kj->i", BW, left) + J @ mean, chosen, prior)
        left = left - k.effect @ (step - mean)
        mean = step
        s = _scatter(left, V, k, len(chosen), scatter)
        trust = _huber(np.einsum("ki,kij,kj->k", left, np.linalg.inv(V + s**2 * np.eye(2)), left))
    score = np.einsum("kij,kj->ki", BW, left)
    cov = _widened(cov, chosen, score, k.object) if len(chosen) else np.diag(prior**2)
    return Fit(mean, cov, chosen, s, noise, int(k.object.max()) + 1, refused)


def _stretched(blocks: Blocks, tracks: _Index) -> _Stretches:
    number = np.floor((blocks.time - blocks.time.min()) / _STRETCH).astype(np.int64)
    _, first, of, count = np.unique(
        blocks.pair * (number.max() + 1) + number, return_index=True, return_inverse=True, return_counts=True
    )
    own = _objects(tracks)[blocks.pair[first]]
    lift = count[:, None, None]
    return _Stretches(
        of,
        first,
        count,
        np.add.reduceat(blocks.effect, first, axis=0) / lift,
        np.add.reduceat(blocks.cov, first, axis=0) / lift,
        own,
        1.0 / np.bincount(own)[own],
    )


def _objects(tracks: _Index) -> _Index:
    """Number the objects: pairs that share a track see the same one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    a, b = (np.unique(column, return_inverse=True)[1] for column in tracks.T)
    size = int(a.max() + b.max()) + 2
    links = coo_array((np.ones(len(a)), (a, a.max() + 1 + b)), shape=(size, size))
    label = connected_components(links, directed=False)[1][a]
    return np.asarray(np.unique(label, return_inverse=True)[1])


def _noise(nu: _Array, cov: _Array, k: _Stretches) -> float:
    """Factor between the stated covariance of a report and that of a block's residual within its stretch."""
    several = k.size[k.of] > 2
    count = int(several.sum())
    d2 = np.einsum("ni,nij,nj->n", nu[several], np.linalg.inv(cov[several]), nu[several])
    found = float(np.median(d2)) / _MEDIAN_CHI2 if count else 1.0
    return max(1e-2, float(np.exp(count * np.log(max(found, 1e-6)) / (count + _PRIOR_BLOCKS))))


def _scatter(left: _Array, V: _Array, k: _Stretches, n_parameters: int, expected: float) -> float:
    """Standard deviation between objects from the median of |e|^2, and the expected one for a few objects more.

    E |e|^2 = 2 s^2 + tr V; the median of a squared Rayleigh law is 1.386 s^2, which a third of strange objects hardly
    move.
    """
    n = float(k.share.sum())
    freedom = max(n - n_parameters / 2.0, 0.5)
    square = np.sum(left**2, axis=-1)
    order = np.argsort(square)
    middle = order[np.searchsorted(np.cumsum(k.share[order]), 0.5 * n)]  # each object counts once
    found = float(square[middle]) / _MEDIAN_CHI2 * n / freedom
    found = max(found - float(np.median(np.trace(V, axis1=-2, axis2=-1))) / 2.0, 0.25)
    return float(np.sqrt((_PRIOR_OBJECTS * expected**2 + freedom * found) / (_PRIOR_OBJECTS + freedom)))


def _separable(geometry: _Array, J: _Array, prior: _Array, widening: float) -> tuple[_Index, dict[str, str]]:
    """Choose the groups of parameters that the geometry tells apart, the greatest expected effect first.

    With C the sum of B'B over objects, scaled to a unit diagonal, a parameter estimated beside the others has
    sqrt([C^-1]_ii) times the standard deviation that it has alone.
    """
    reach = np.sqrt(np.diag(geometry)) * prior
    order = sorted(GROUPS, key=lambda name: -float(np.linalg.norm(reach[list(GROUPS[name])])))
    chosen: list[int] = []
    refused: dict[str, str] = {}
    for name in order:
        group = list(GROUPS[name])
        if not np.all(reach[group] > 0):
            refused[name] = "has no effect on these reports"
            continue
        trial = [*chosen, *group]
        scale = 1.0 / np.sqrt(np.diag(geometry)[trial])
        C = geometry[np.ix_(trial, trial)] * scale[:, None] * scale
        values, vectors = np.linalg.eigh(C)
        if values[0] < _SINGULAR or np.diag(np.linalg.inv(C)).max() > widening**2:
            refused[name] = f"not separable from {_mixture(vectors[:, 0], trial, name)}"
            continue
        cov = np.linalg.inv(J[np.ix_(trial, trial)] + np.diag(prior[trial] ** -2.0))
        if (np.sqrt(np.diag(cov))[-len(group) :] > _INFORMATIVE * prior[group]).any():
            refused[name] = _FEW
            continue
        chosen = trial
    return np.array(sorted(chosen), dtype=np.int64), refused


def _mixture(vector: _Array, trial: list[int], name: str) -> str:
    """Name the groups that a combination of parameters without information mixes with `name`."""
    share = {
        other: float(np.linalg.norm([vector[k] for k, p in enumerate(trial) if p in GROUPS[other]]))
        for other in GROUPS
        if other != name
    }
    return " and ".join([other for other, size in share.items() if size > 0.3] or [max(share, key=share.__getitem__)])


def _solved(J: _Array, y: _Array, chosen: _Index, prior: _Array) -> tuple[_Array, _Array]:
    """Return (J + prior^-2)^-1 y of the chosen parameters, and that inverse, in units of the prior."""
    mean, cov = np.zeros(len(prior)), np.zeros((len(prior), len(prior)))
    if len(chosen):
        at, scale = np.ix_(chosen, chosen), prior[chosen]
        cov[at] = np.linalg.inv(J[at] * scale[:, None] * scale + np.eye(len(chosen))) * scale[:, None] * scale
        mean[chosen] = cov[at] @ y[chosen]
    return mean, cov


def _widened(cov: _Array, chosen: _Index, score: _Array, own: _Index) -> _Array:
    """Widen each standard deviation to what the scatter of the objects' scores says, where that is more.

    P (sum_o g_o g_o') P N / (N - p), g_o the sum of B' W e over the stretches of object o: objects may differ in more
    than an offset, as in the latency of their navigation.
    """
    by_object = np.zeros((int(own.max()) + 1, len(PARAMETERS)))
    np.add.at(by_object, own, score)
    freedom = len(by_object) - len(chosen)
    if freedom < _FREEDOM:
        return cov
    found = cov @ (by_object.T @ by_object) @ cov * len(by_object) / freedom
    grown = np.ones(len(cov))
    grown[chosen] = np.sqrt(np.maximum(1.0, np.diag(found)[chosen] / np.diag(cov)[chosen]))
    return np.asarray(cov * grown[:, None] * grown)


def _huber(d2: _Array) -> _Array:
    return np.asarray(np.minimum(1.0, _HUBER / np.sqrt(np.maximum(d2, 1e-12))))
