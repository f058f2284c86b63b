"""One to one, or one to none: the assignment of greatest total gain, and how far behind the next best one lies."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

__all__ = ["best_assignment", "best_with_margins"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.intp]

_AT_ONCE = 4096  # elements of a matrix up to which its clusters are not told apart


def best_assignment(row: _Index, col: _Index, gain: _Array) -> _Index:
    """Return the indices of the pairs chosen: each row and each column at most once, total gain greatest.

    Pairs of gain <= 0 are never chosen. Pairs that compete with no other are taken at once; the rest is solved
    cluster by cluster (connected components of pairs that share a row or a column).

    Args:
        row: of each pair, (P,); numbers from 0, not all of them need occur.
        col: of each pair, (P,).
        gain: log-likelihood ratio of each pair against leaving both alone, (P,), nats.
    """
    alone, contested = _split(row, col, gain)
    chosen = [alone]
    for pairs in _blocks(row, col, contested, _AT_ONCE):
        matrix, which = _table(row, col, gain, pairs)
        picked = which[_solved(matrix)]
        chosen.append(picked[picked >= 0])
    return np.concatenate(chosen)


def best_with_margins(row: _Index, col: _Index, gain: _Array) -> tuple[_Index, _Array]:
    """Return the pairs of `best_assignment`, and what the total loses when one of them is forbidden.

    The margin of a pair is the log-odds of the best assignment with it against the best one without it: the gain where
    nothing competes, less where its row or column has an alternative.

    Args:
        row: of each pair, (P,).
        col: of each pair, (P,).
        gain: log-odds of each pair, (P,), nats.

    Returns:
        Indices of the chosen pairs, (C,), and their margins, (C,), not negative.
    """
    alone, contested = _split(row, col, gain)
    chosen, margins = [alone], [gain[alone]]
    for pairs in _blocks(row, col, contested, 0):
        matrix, which = _table(row, col, gain, pairs)
        r, c = _solved(matrix)
        best = matrix[r, c].sum()
        for i, j in zip(r, c, strict=True):
            if which[i, j] < 0:
                continue
            kept, matrix[i, j] = matrix[i, j], 0.0
            margins.append(np.array([best - matrix[_solved(matrix)].sum()]))
            chosen.append(which[i, j : j + 1])
            matrix[i, j] = kept
    return np.concatenate(chosen), np.concatenate(margins)


def _split(row: _Index, col: _Index, gain: _Array) -> tuple[_Index, _Index]:
    """Pairs of positive gain: those that compete with no other, and the rest."""
    good = np.flatnonzero(gain > 0.0)
    r, c = row[good], col[good]
    alone = (np.bincount(r)[r] == 1) & (np.bincount(c)[c] == 1) if len(good) else np.zeros(0, bool)
    return good[alone], good[~alone]


def _blocks(row: _Index, col: _Index, contested: _Index, at_once: int) -> Iterator[_Index]:
    """Yield the contested pairs cluster by cluster, or together where their matrix is small."""
    if not len(contested):
        return
    (rows, r), (cols, c) = (np.unique(side[contested], return_inverse=True) for side in (row, col))
    if len(rows) * len(cols) <= at_once:  # clusters are blocks of one matrix, and its optimum theirs
        yield contested
        return
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    size = len(rows) + len(cols)
    links = coo_array((np.ones(len(contested)), (r, len(rows) + c)), shape=(size, size))
    _, label = connected_components(links, directed=False)
    order = np.argsort(label[r], kind="stable")
    for cluster in np.split(order, np.flatnonzero(np.diff(label[r][order])) + 1):
        yield contested[cluster]


def _table(row: _Index, col: _Index, gain: _Array, pairs: _Index) -> tuple[_Array, _Index]:
    """The gains of some pairs as a rectangle in which 0 leaves both alone, and the pair of each place or -1."""
    (rows, r), (cols, c) = (np.unique(side[pairs], return_inverse=True) for side in (row, col))
    matrix, which = np.zeros((len(rows), len(cols))), np.full((len(rows), len(cols)), -1)
    matrix[r, c], which[r, c] = gain[pairs], pairs
    return matrix, which


def _solved(matrix: _Array) -> tuple[_Index, _Index]:
    from scipy.optimize import linear_sum_assignment

    r, c = linear_sum_assignment(matrix, maximize=True)
    return r, c
