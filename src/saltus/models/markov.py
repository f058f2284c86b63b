"""Matrices and laws behind a chain's description, each checked with the chain's own words."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.models.checks import FloatArray, numbers
from saltus.models.exponential import exponential

__all__ = [
    "Labelled",
    "generator",
    "initial_law",
    "jump_matrices",
    "logarithm",
    "sojourn_matrix",
    "stay_matrix",
    "stochastic",
]


class Labelled(NamedTuple):
    """A chain's name and the labels of its states, for messages and mappings."""

    name: str
    labels: tuple[str, ...]


def _per_label(chain: Labelled, given: Mapping[str, float], what: str) -> FloatArray:
    if not isinstance(given, Mapping):
        raise ModelError(
            f"chain {chain.name!r}: {what} gives each state its own, {{{chain.labels[0]!r}: ..., ...}}; got {given!r}."
        )
    if set(given) != set(chain.labels):
        raise ModelError(
            f"chain {chain.name!r}: {what} must name each state once: "
            f"states are {', '.join(chain.labels)}; got {', '.join(map(str, given)) or 'none'}."
        )
    try:
        return np.array([float(given[label]) for label in chain.labels])
    except (TypeError, ValueError):
        raise ModelError(f"chain {chain.name!r}: {what} must be numbers; got {dict(given)!r}.") from None


def _leave_equally(stay: FloatArray, leave: FloatArray) -> FloatArray:
    """Matrix with `stay` on the diagonal and `leave` shared by the other states of each row."""
    n = len(stay)
    share: FloatArray = np.repeat((leave / max(n - 1, 1))[:, None], n, axis=1)
    np.fill_diagonal(share, stay)
    return share


def stay_matrix(chain: Labelled, stay: float | Mapping[str, float]) -> FloatArray:
    """Transition matrix (M, M) from probabilities of staying."""
    if isinstance(stay, Mapping):
        probs = _per_label(chain, stay, "stay")
    else:
        one = numbers(stay, f"chain {chain.name!r}: stay")
        if one.ndim:
            raise ModelError(
                f"chain {chain.name!r}: stay is one probability, or one for each label, {{{chain.labels[0]!r}: ..., "
                f"...}}; got an array of shape {one.shape}."
            )
        probs = np.full(len(chain.labels), float(one))
    if not ((probs >= 0) & (probs <= 1)).all() or (len(chain.labels) == 1 and probs[0] != 1):
        raise ModelError(
            f"chain {chain.name!r}: stay must be a probability for each state (1 if there is only one), "
            f"got {', '.join(f'{label}: {p:g}' for label, p in zip(chain.labels, probs, strict=True))}."
        )
    return _leave_equally(probs, 1 - probs)


def sojourn_matrix(chain: Labelled, sojourn: Mapping[str, float]) -> FloatArray:
    """Rates (M, M), 1/s, from mean sojourn times: a state is left at rate 1 / sojourn."""
    seconds = _per_label(chain, sojourn, "sojourn")
    if not (seconds > 0).all():
        label = chain.labels[int(np.argmin(seconds > 0))]
        raise ModelError(
            f"chain {chain.name!r}: mean sojourn times must be positive seconds, got {sojourn[label]} for {label!r}."
        )
    leave = 1 / seconds if len(chain.labels) > 1 else np.zeros(1)
    return _leave_equally(-leave, leave)


def stochastic(chain: Labelled, trans: npt.ArrayLike | None) -> FloatArray:
    """Check a transition matrix (M, M): not negative, rows sum to 1 (then made to, exactly)."""
    what = f"transition matrix of chain {chain.name!r}"
    array = numbers(trans, what)
    n = len(chain.labels)
    if array.shape != (n, n):
        raise ModelError(f"{what} must have shape ({n}, {n}), one row per state; got {array.shape}.")
    if array.min() < 0:
        i, j = np.argwhere(array < 0)[0]
        raise ModelError(
            f"{what} holds a negative probability: [{i}, {j}] = {array[i, j]:g}.\nGive rates per second with rates=."
        )
    sums = array.sum(axis=1)
    worst = int(np.abs(sums - 1).argmax())
    if abs(sums[worst] - 1) > 1e-8:
        columns = np.abs(array.sum(axis=0) - 1).max() < 1e-8
        mend = (
            "Its columns do: transpose it."
            if columns
            else "Pass probabilities *from* that state, or give rates per second with rates=."
        )
        raise ModelError(
            f"{what} rows must sum to 1: row {worst} ({chain.labels[worst]}) sums to {sums[worst]:.10g}.\n{mend}"
        )
    array = np.asarray(array / sums[:, None])
    array.flags.writeable = False
    return array


def generator(chain: Labelled, rates: npt.ArrayLike | None) -> FloatArray:
    """Check rates (M, M): off-diagonal not negative, rows sum to 0 (then made to, exactly)."""
    what = f"rates of chain {chain.name!r}"
    array = numbers(rates, what)
    n = len(chain.labels)
    if array.shape != (n, n):
        raise ModelError(f"{what} must have shape ({n}, {n}), one row per state; got {array.shape}.")
    off = array - np.diag(np.diag(array))
    if off.min() < 0:
        i, j = np.argwhere(off < 0)[0]
        raise ModelError(f"{what}: [{i}, {j}] = {array[i, j]:g}, but rates between states must not be negative.")
    sums = array.sum(axis=1)
    worst = int(np.abs(sums).argmax())
    if abs(sums[worst]) > 1e-8 * max(np.abs(array).max(), 1e-300):
        raise ModelError(
            f"{what}: rows must sum to 0, row {worst} ({chain.labels[worst]}) sums to {sums[worst]:.6g}.\n"
            "Put minus the sum of the other entries on the diagonal; give probabilities with trans= and per=."
        )
    array = off - np.diag(off.sum(axis=1))
    array.flags.writeable = False
    return array


def jump_matrices(rates: FloatArray, dt: FloatArray) -> FloatArray:
    """Transition matrices expm(rates dt), (..., M, M), rows sum to 1.

    Two states that leave at rates a and b: [[1 - a e, a e], [b e, 1 - b e]], e = (1 - exp(-(a + b) dt)) / (a + b).
    """
    if len(rates) == 2:
        leave = -np.diagonal(rates)
        total = leave.sum()
        share = leave / total if total > 0 else leave
        gone = np.multiply.outer(-np.expm1(-total * dt), share)  # (..., 2): a e, b e
        result = np.stack([1.0 - gone, gone], axis=-1)  # (..., 2, 2): stay, leave
        result[..., 1, :] = result[..., 1, ::-1]
        return result
    result = np.maximum(exponential(rates * dt[..., None, None]), 0.0)
    return np.asarray(result / result.sum(axis=-1, keepdims=True))


def logarithm(trans: FloatArray, per: float) -> FloatArray | None:
    """Rates with expm(rates per) = trans, from the principal logarithm; None where that is no generator."""
    eigenvalues = np.linalg.eigvals(trans)
    on_cut = (eigenvalues.real <= 1e-12) & (np.abs(eigenvalues.imag) < 1e-12)
    if on_cut.any():
        return None
    from scipy.linalg import logm

    log = np.asarray(logm(trans))
    off = log.real - np.diag(np.diag(log.real))
    size = np.abs(log).max()
    if np.abs(log.imag).max() > 1e-9 * max(size, 1e-300) or off.min() < -1e-9 * size:
        return None
    off = np.maximum(off, 0.0)
    rates = off - np.diag(off.sum(axis=1))
    if np.abs(exponential(rates) - trans).max() > 1e-9:
        return None
    return np.asarray(rates / per)


def initial_law(chain: Labelled, initial: npt.ArrayLike | Mapping[str, float] | None, jumps: FloatArray) -> FloatArray:
    """Law of the first state (M,); None asks for the stationary law of `jumps`, a transition or rate matrix."""
    what = f"initial law of chain {chain.name!r}"
    if initial is None:
        array = _stationary(chain, jumps)
    elif isinstance(initial, Mapping):
        array = numbers(_per_label(chain, initial, "initial"), what)
    else:
        array = numbers(initial, what)
    n = len(chain.labels)
    if array.shape != (n,):
        raise ModelError(f"{what} must have {n} entries, one per state; got shape {array.shape}.")
    if array.min() < 0 or abs(array.sum() - 1) > 1e-8:
        raise ModelError(f"{what} must be probabilities that sum to 1; got {array.tolist()}.")
    array = np.asarray(array / array.sum())
    array.flags.writeable = False
    return array


def _stationary(chain: Labelled, jumps: FloatArray) -> FloatArray:
    """Stationary law, by state reduction (Grassmann, Taksar and Heyman 1985), which subtracts nothing."""
    jumps = jumps.copy()
    np.fill_diagonal(jumps, 0.0)
    n = len(jumps)
    reach = np.eye(n, dtype=bool) | (jumps > 0)
    for _ in range(n.bit_length()):
        reach = (reach.astype(np.int64) @ reach) > 0
    recurrent = ~(reach & ~reach.T).any(axis=1)  # whatever it reaches comes back
    core = np.flatnonzero(recurrent)
    if not reach[core[0], core].all():
        raise ModelError(
            f"chain {chain.name!r} has more than one stationary law: from state {chain.labels[core[0]]!r} "
            "not every lasting state is reached.\nSay where it starts: initial={label: probability, ...}."
        )
    work = jumps[np.ix_(core, core)]
    m = len(core)
    for k in range(m - 1, 0, -1):
        work[:k, k] /= work[k, :k].sum()
        work[:k, :k] += np.outer(work[:k, k], work[k, :k])
    weights = np.ones(m)
    for k in range(1, m):
        weights[k] = weights[:k] @ work[:k, k]
    law = np.zeros(n)
    law[core] = weights / weights.sum()
    return law
