"""Which tracks are one object, decided again and again as evidence comes in.

At each decision the log-odds of a pair are its ratio plus those of the prior, and the assignment of greatest total
log-odds is taken, one to one or to none. A pair's margin, what that total loses without it, are its log-odds against
the best alternative. A pair becomes one object when its margin reaches log[(1 - p_false) / p_false], and stays one
until its margin, with `hysteresis` in its favour, falls below 0. Nothing later than a decision enters it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError
from saltus.identify.assignment import best_with_margins
from saltus.identify.evidence import Evidence
from saltus.identify.groups import Conflict, ConflictLog, consistent, representatives
from saltus.identify.lanes import Index
from saltus.identify.verdict import posterior
from saltus.models.checks import FloatArray, probability
from saltus.shapes import Float, Int

__all__ = ["DecisionSettings", "Decisions", "Episodes", "decide_pairs"]


@dataclass(frozen=True, slots=True)
class DecisionSettings:
    """When two tracks become one object, and when they stop being one.

    Attributes:
        prior: probability that a candidate pair is one object, before any measurement; one in the number of tracks
            that the other system has at a time is a good choice.
        p_false: largest probability of being two objects, or another one, with which a pair is declared one.
        p_false_split: the same for two tracks of one system, which are two objects unless the evidence overwhelms.
        hysteresis: log-odds by which a declared pair may fall short of the best alternative, nats.
        every: s between decisions.
        hold: s for which the last ratio of a declared pair holds when no further row comes; of another one half as
            long.
    """

    prior: float = 0.5
    p_false: float = 1e-3
    p_false_split: float = 1e-6
    hysteresis: float = 5.0
    every: float = 4.0
    hold: float = 30.0

    def __post_init__(self) -> None:
        """Refuse settings that cannot be."""
        for name in ("prior", "p_false", "p_false_split"):
            probability(getattr(self, name), f"DecisionSettings.{name}")
            if getattr(self, name) >= 1:
                raise ModelError(f"DecisionSettings.{name} must lie between 0 and 1, both excluded.")
        for name in ("every", "hold"):
            if not 0 < getattr(self, name) < np.inf:
                raise ModelError(f"DecisionSettings.{name} must be a positive time in s, got {getattr(self, name)}.")
        if not 0 <= self.hysteresis < np.inf:
            raise ModelError(f"DecisionSettings.hysteresis must not be negative, got {self.hysteresis}.")


class Episodes(NamedTuple):
    """While which two tracks were one object, and in hindsight: since when, and until when, the evidence said so."""

    a: Int[np.ndarray, " e"]
    b: Int[np.ndarray, " e"]
    time_from: Float[np.ndarray, " e"]  # s, of the decision that declared them
    time_to: Float[np.ndarray, " e"]  # s, of the decision that parted them, or of their last row
    probability: Float[np.ndarray, " e"]  # with which they were declared
    since: Float[np.ndarray, " e"]  # s, of the last evidence before `time_from` that they were two; -inf: never any
    until: Float[np.ndarray, " e"]  # s, of the last evidence that they were one


class Decisions(NamedTuple):
    """What was decided, and what could not be."""

    episodes: Episodes
    conflicts: tuple[Conflict, ...]


class _Problem(NamedTuple):
    """What does not change between decisions, for each pair."""

    pairs: Index  # (P, 2)
    system: Index  # of each track, (K,)
    address: Index  # of each track, -1 unknown, (K,)
    split: npt.NDArray[np.bool_]  # (P,) two tracks of one system
    clash: npt.NDArray[np.bool_]  # (P,) two addresses
    twin: npt.NDArray[np.bool_]  # (P,) one address
    bound: FloatArray  # (P,) log-odds that declare
    settings: DecisionSettings


class _Links:
    """The declared pairs, and the episodes behind them."""

    def __init__(self, n: int) -> None:
        self.on = np.zeros(n, bool)
        self._two, self._one = np.full(n, -np.inf), np.full(n, -np.inf)  # s: when evidence said so last
        self._from, self._since, self._prob = np.zeros(n), np.zeros(n), np.zeros(n)
        self._done: list[tuple[Index, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]] = []

    def weigh(self, now: float, score: FloatArray, bound: FloatArray) -> None:
        """Note which pairs the evidence says to be one or two."""
        self._one[score >= bound] = now
        self._two[np.isfinite(score) & (score <= -bound)] = now

    def update(self, now: float, keep: Index, probs: FloatArray, ended: FloatArray) -> None:
        """Declare the pairs `keep` with their probabilities and part the others, which ended at `ended` (P,)."""
        on, prob = np.zeros(len(self.on), bool), np.zeros(len(self.on))
        on[keep], prob[keep] = True, probs
        self.part(np.flatnonzero(self.on & ~on), ended)
        fresh = np.flatnonzero(on & ~self.on)
        self._from[fresh], self._since[fresh], self._prob[fresh] = now, self._two[fresh], prob[fresh]
        self.on = on

    def part(self, which: Index, ended: FloatArray) -> None:
        """End episodes."""
        since, until = self._from[which], np.maximum(ended[which], self._from[which])
        last = np.clip(self._one[which], since, until)
        self._done.append((which, since, until, self._prob[which], self._since[which], last))

    def episodes(self, pairs: Index) -> Episodes:
        """All episodes, by time."""
        which, since, *rest = (np.concatenate(column) for column in zip(*self._done, strict=True))
        order = np.lexsort((which, since))
        a, b = pairs[which[order]].T
        return Episodes(a, b, since[order], *(column[order] for column in rest))


def decide_pairs(
    evidence: Evidence,
    system: npt.ArrayLike,
    settings: DecisionSettings,
    *,
    address: npt.ArrayLike | None = None,
) -> Decisions:
    """Decide over time which tracks are one object.

    Args:
        evidence: on pairs of tracks of any systems; see `pair_evidence` and `join_evidence`.
        system: of each track, (K,), numbers from 0.
        settings: when to declare.
        address: of each track, (K,), -1 where unknown. It is no evidence (give that as a prior to `pair_ratios`), but
            two tracks of different addresses are never declared one; that the measurements say so is a conflict.

    Returns:
        Episodes, and conflicts, none of which is resolved silently: "rival" (probable by itself, but a track of it is
        another's, or claimed as well), "addresses" (one object by its measurements, two by its addresses), "places"
        (one address, two objects), "inconsistent" (one object by itself, but not with the others of its group).

    Raises:
        DataError: evidence that names no tracks, or systems and addresses that are not those of the tracks.
    """
    problem = _problem(evidence, system, address, settings)
    n = len(problem.pairs)
    links, log = _Links(n), ConflictLog(2.5 * settings.every)
    score, last = np.full(n, -np.inf), np.full(n, -np.inf)
    odds = float(np.log(settings.prior) - np.log1p(-settings.prior))
    for now, rows in _decisions(evidence, settings):
        which = evidence.pair[rows]
        score[which], last[which] = evidence.llr[rows] + odds, evidence.time[rows]
        fresh = now - last <= np.where(links.on, settings.hold, 0.5 * settings.hold)
        known = np.where(fresh, score, -np.inf)
        links.weigh(now, known, problem.bound)
        keep, probs = _decide(problem, now, known, links.on, log)
        links.update(now, keep, probs, np.where(fresh, now, last))
    links.part(np.flatnonzero(links.on), last)
    return Decisions(links.episodes(problem.pairs), log.conflicts())


def _problem(
    evidence: Evidence, system: npt.ArrayLike, address: npt.ArrayLike | None, settings: DecisionSettings
) -> _Problem:
    pairs, of = np.asarray(evidence.pairs).reshape(-1, 2), np.asarray(system, dtype=np.int64)
    names = np.full(of.shape, -1) if address is None else np.asarray(address, dtype=np.int64)
    if of.ndim != 1 or names.shape != of.shape:
        raise DataError(f"system {of.shape} and address {names.shape} must be one number for each track, (K,).")
    if len(pairs) and not (0 <= pairs.min() and pairs.max() < len(of)):
        raise DataError(f"evidence names tracks {pairs.min()}..{pairs.max()}, but there are {len(of)} tracks.")
    a, b = names[pairs[:, 0]], names[pairs[:, 1]]
    known = (a >= 0) & (b >= 0)
    split = of[pairs[:, 0]] == of[pairs[:, 1]]
    p = np.where(split, settings.p_false_split, settings.p_false)
    bound = np.log1p(-p) - np.log(p)
    return _Problem(pairs, of, names, split, known & (a != b), known & (a == b), bound, settings)


def _decisions(evidence: Evidence, settings: DecisionSettings) -> Iterator[tuple[float, Index]]:
    """Yield the time of each decision, and the last new row of every pair that has one."""
    if not len(evidence.time):
        return
    start = float(evidence.time.min())
    number = np.ceil((evidence.time - start) / settings.every).astype(np.int64)
    order = np.lexsort((evidence.time, evidence.pair, number))
    pair, number = evidence.pair[order], number[order]
    final = np.ones(len(order), bool)
    final[:-1] = (np.diff(pair) != 0) | (np.diff(number) != 0)
    rows, number = order[final], number[final]
    edge = np.searchsorted(number, np.arange(int(number[-1]) + 2))
    for k in range(len(edge) - 1):
        yield start + k * settings.every, rows[edge[k] : edge[k + 1]]


def _decide(
    problem: _Problem, now: float, score: FloatArray, linked: npt.NDArray[np.bool_], log: ConflictLog
) -> tuple[Index, FloatArray]:
    """Return the pairs that are one object now, and how probable that is."""
    bonus = problem.settings.hysteresis * linked
    gain = score + bonus
    sure = score >= problem.bound
    log.add("addresses", problem.pairs[sure & problem.clash], now)
    log.add("places", problem.pairs[problem.twin & (score <= -problem.bound) & np.isfinite(score)], now)
    able = (gain > 0) & ~problem.clash
    splits = np.flatnonzero(able & problem.split & (linked | sure))
    across = np.flatnonzero(able & ~problem.split)
    chosen, margin = _across(problem, gain, across, splits)
    declared = linked[chosen] | (margin >= problem.bound[chosen])
    keep, strength = np.concatenate([splits, chosen[declared]]), np.concatenate([gain[splits], margin[declared]])
    kept, refused = consistent(problem.pairs, keep, strength, problem.system, problem.address, score)
    log.add("inconsistent", problem.pairs[refused], now)
    settled = np.zeros(len(score), bool)
    settled[keep] = True
    member = representatives(problem.pairs[keep[kept]], len(problem.system))
    same = member[problem.pairs[across, 0]] == member[problem.pairs[across, 1]]
    log.add("rival", problem.pairs[across[sure[across] & ~settled[across] & ~same]], now)
    keep, strength = keep[kept], strength[kept]
    return keep, posterior(strength - bonus[keep])


def _across(problem: _Problem, gain: FloatArray, across: Index, splits: Index) -> tuple[Index, FloatArray]:
    """Assign between systems: splits of one object stand for one, by the best of their pairs."""
    if not len(across):
        return across, np.zeros(0)
    member = representatives(problem.pairs[splits], len(problem.system))
    count = int(problem.system.max()) + 1
    a, b = problem.pairs[across].T
    row, col = member[a] * count + problem.system[b], member[b] * count + problem.system[a]
    swapped = problem.system[a] > problem.system[b]  # one side of each pair of systems is the rows
    row, col = np.where(swapped, col, row), np.where(swapped, row, col)
    if len(splits):
        order = np.lexsort((-gain[across], col, row))
        first = np.ones(len(order), bool)
        first[1:] = (np.diff(row[order]) != 0) | (np.diff(col[order]) != 0)
        across, row, col = across[order][first], row[order][first], col[order][first]
    picked, margin = best_with_margins(row, col, gain[across])
    return across[picked], margin
