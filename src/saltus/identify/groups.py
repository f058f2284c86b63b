"""Groups of tracks that are one object: consistent ones, and the conflicts that stand in their way."""

from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.identify.lanes import Index
from saltus.models.checks import FloatArray

__all__ = ["Conflict", "ConflictKind", "ConflictLog", "consistent", "representatives"]

ConflictKind = Literal["rival", "addresses", "places", "inconsistent"]

_CONTRADICTED = -5.0  # log-odds below which a pair of one group says that it is none


class Conflict(NamedTuple):
    """Two tracks about which the evidence contradicts itself or their names, and when."""

    kind: ConflictKind
    a: int
    b: int
    time_from: float  # s
    time_to: float  # s


class ConflictLog:
    """Conflicts at single decisions, joined while they last."""

    def __init__(self, gap: float) -> None:
        self._gap = gap  # s within which a conflict seen again is the same one
        self._found: dict[tuple[ConflictKind, int, int], list[list[float]]] = {}

    def add(self, kind: ConflictKind, pairs: Index, now: float) -> None:
        """Note a conflict of each pair (P, 2) at a time."""
        for a, b in pairs.tolist():
            spells = self._found.setdefault((kind, a, b), [])
            if spells and now - spells[-1][1] <= self._gap:
                spells[-1][1] = now
            else:
                spells.append([now, now])

    def conflicts(self) -> tuple[Conflict, ...]:
        """All of them, by time."""
        found = [Conflict(*key, *spell) for key, spells in self._found.items() for spell in spells]
        return tuple(sorted(found, key=lambda c: (c.time_from, c.kind, c.a, c.b)))


def representatives(links: Index, n: int) -> Index:
    """Return for each of n tracks a number that it shares with those linked to it, itself where there are none."""
    member = np.arange(n)
    if not len(links):
        return member
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(n, n))
    _, label = connected_components(graph, directed=False)
    first = np.full(int(label.max()) + 1, n)
    np.minimum.at(first, label, member)
    return np.asarray(first[label])


def consistent(
    pairs: Index, keep: Index, strength: FloatArray, system: Index, address: Index, score: FloatArray
) -> tuple[npt.NDArray[np.bool_], Index]:
    """Join tracks into groups, strongest link first, and leave out links that would make a group impossible.

    A group has at most one track of a system, but for those linked as splits of each other; no two addresses; and no
    pair in it whose own evidence says that it is two objects.

    Args:
        pairs: tracks of every pair, (P, 2).
        keep: pairs wanted as links, (L,).
        strength: log-odds of each link, (L,).
        system: of each track, (K,).
        address: of each track, -1 unknown, (K,).
        score: log-odds of every pair, (P,), -inf where nothing is known.

    Returns:
        Which of `keep` may stay, (L,), and the pairs that may not.
    """
    allowed = np.ones(len(keep), bool)
    ends = pairs[keep]
    seen = np.bincount(ends.ravel(), minlength=len(system)) if len(keep) else np.zeros(0, np.int64)
    knotted = np.flatnonzero((seen[ends] > 1).any(axis=1)) if len(keep) else np.zeros(0, np.int64)
    if not len(knotted):
        return allowed, keep[:0]
    inside = np.isin(pairs, np.unique(ends[knotted])).all(axis=1) & np.isfinite(score)
    odds = {(min(a, b), max(a, b)): s for (a, b), s in zip(pairs[inside].tolist(), score[inside].tolist(), strict=True)}
    split = {(min(a, b), max(a, b)) for a, b in ends[system[ends[:, 0]] == system[ends[:, 1]]].tolist()}
    group = {int(k): {int(k)} for k in np.unique(ends[knotted])}

    def possible(x: int, y: int) -> bool:
        pair = (min(x, y), max(x, y))
        if system[x] == system[y] and pair not in split:
            return False
        return not (address[x] >= 0 <= address[y] and address[x] != address[y]) and odds.get(pair, 0.0) > _CONTRADICTED

    for at in knotted[np.argsort(-strength[knotted], kind="stable")]:
        one, other = (group[int(k)] for k in ends[at])
        if one is other:
            continue
        if all(possible(x, y) for x in one for y in other):
            one |= other
            for k in other:
                group[k] = one
        else:
            allowed[at] = False
    return allowed, keep[~allowed]
