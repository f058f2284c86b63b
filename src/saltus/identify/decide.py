"""Which tracks are one object, decided again and again as evidence comes in.

At each decision the log-odds of a pair are its ratio plus those of the prior, and the assignment of greatest total
log-odds is taken, one to one or to none. A pair's margin, what that total loses without it, are its log-odds against
the best alternative. A pair becomes one object when its margin reaches log[(1 - p_false) / p_false], and stays one
until its margin, with `hysteresis` in its favour, falls below 0. Nothing later than a decision enters it.
"""

from collections.abc import Iterator, Sequence
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

__all__ = ["Decided", "Decider", "DecisionSettings", "Decisions", "Episodes", "decide_pairs", "joined_episodes"]


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
    since: Float[np.ndarray, " e"]  # s, of the last evidence that they were two before that which declared them one;
    # -inf: never any
    until: Float[np.ndarray, " e"]  # s, of the last evidence that they were one


class Decisions(NamedTuple):
    """What was decided, and what could not be."""

    episodes: Episodes
    conflicts: tuple[Conflict, ...]


class _Problem(NamedTuple):
    """What holds at one decision, for each pair."""

    pairs: Index  # (P, 2)
    system: Index  # of each track, (K,)
    address: Index  # of each track, -1 unknown, (K,)
    split: npt.NDArray[np.bool_]  # (P,) two tracks of one system
    clash: npt.NDArray[np.bool_]  # (P,) two addresses
    twin: npt.NDArray[np.bool_]  # (P,) one address
    bound: FloatArray  # (P,) log-odds that declare
    settings: DecisionSettings


class Decided(NamedTuple):
    """What one decision changed."""

    begun: Episodes  # declared; when they end is not known, NaN
    ended: Episodes
    parted: npt.NDArray[np.bool_]  # of those ended: by evidence, not by silence


class _Links(NamedTuple):
    """Pairs of which something is known, one array element each."""

    pairs: Index  # (P, 2)
    score: FloatArray  # latest log-odds
    last: FloatArray  # s, of that
    span: FloatArray  # s: since when the rows count that it is of; inf unknown
    one: FloatArray  # s: when the evidence said last that they are one; -inf never
    two: FloatArray  # or two
    on: npt.NDArray[np.bool_]  # declared
    start: FloatArray  # s, when declared
    since: FloatArray  # s, when the evidence had said last then that they were two
    prob: FloatArray  # with which they were declared

    def take(self, at: Index | npt.NDArray[np.bool_]) -> "_Links":
        return _Links._make(column[at] for column in self)

    def with_pairs(self, pairs: Index, apart: FloatArray) -> "_Links":
        """Return these with further pairs, (n, 2), that were two at times `apart`."""
        n = len(pairs)
        never, nothing = np.full(n, -np.inf), np.zeros(n)
        new = _Links(pairs, never, never, -never, never, apart, np.zeros(n, bool), nothing, never, nothing)
        return _Links._make(np.concatenate(columns) for columns in zip(self, new, strict=True))


class Decider:
    """Decides as evidence comes in; what is undecided and silent is forgotten, so memory does not grow."""

    def __init__(self, settings: DecisionSettings) -> None:
        """Begin without pairs."""
        self._settings, self._log = settings, ConflictLog(2.5 * settings.every)
        none = np.zeros(0)
        self._links = _Links(np.zeros((0, 2), np.int64), *(none,) * 5, none.astype(bool), none, none, none)

    @property
    def pairs(self) -> Int[np.ndarray, "p 2"]:
        """The pairs of which something is known."""
        return self._links.pairs

    def update(
        self,
        now: float,
        pairs: Int[np.ndarray, "n 2"],
        time: Float[np.ndarray, " n"],
        llr: Float[np.ndarray, " n"],
        *,
        system: Int[np.ndarray, " k"],
        address: Int[np.ndarray, " k"],
        prior: float | None = None,
        apart: Float[np.ndarray, " n"] | None = None,
        span: Float[np.ndarray, " n"] | None = None,
        alive: npt.NDArray[np.bool_] | None = None,
    ) -> Decided:
        """Decide.

        Args:
            now: s.
            pairs: that something new is known of, each once, (n, 2).
            time: of that, (n,), s.
            llr: log-likelihood ratio, (n,), nats.
            system: of each track so far, (K,).
            address: of each track, as known now, (K,), -1 unknown.
            prior: probability of one object before any measurement, if it is not that of the settings.
            apart: when each pair was two objects, if it is a new one, (n,), s; -inf: never known to be.
            span: since when the rows count that each ratio is of, (n,), s.
            alive: tracks of which nothing but silence on a pair says nothing: a declared pair of two holds, (K,).
        """
        s, prior = self._settings, self._settings.prior if prior is None else prior
        apart = np.full(len(pairs), -np.inf) if apart is None else apart
        links, which = self._found(np.asarray(pairs, np.int64).reshape(-1, 2), apart)
        links.span[which] = np.inf if span is None else span
        links.score[which], links.last[which] = llr + float(np.log(prior) - np.log1p(-prior)), time
        problem = _problem(links.pairs, system, address, s)
        fresh = now - links.last <= np.where(links.on, s.hold, 0.5 * s.hold)
        if alive is not None:
            fresh |= links.on & alive[links.pairs].all(axis=1)
        score = np.where(fresh, links.score, -np.inf)
        told = now - links.last <= 0.5 * s.hold
        links.one[told & (score >= problem.bound)] = now
        links.two[told & (score <= -problem.bound)] = now
        keep, probs = _decide(problem, now, score, links.on, self._log)
        on = np.zeros(len(score), bool)
        on[keep] = True
        over, new = np.flatnonzero(links.on & ~on), np.flatnonzero(on & ~links.on)
        ended = _episodes(links.take(over), np.where(fresh, now, links.last)[over])
        links.prob[keep] = np.where(links.on[keep], links.prob[keep], probs)
        links.start[new], links.since[new] = now, np.minimum(links.two, links.span)[new]
        self._links = links._replace(on=on).take(on | (now - links.last <= 2.0 * s.hold))
        begun = links.take(new)
        return Decided(_episodes(begun, np.full(len(new), np.nan)), ended, fresh[over])

    def _found(self, pairs: Index, apart: FloatArray) -> tuple[_Links, Index]:
        """Return the links, all pairs given among them, and the place of each."""
        width = 1 + int(max(pairs.max(initial=0), self._links.pairs.max(initial=0)))
        key, known = pairs[:, 0] * width + pairs[:, 1], self._links.pairs[:, 0] * width + self._links.pairs[:, 1]
        new = ~np.isin(key, known)
        links = self._links.with_pairs(pairs[new], apart[new])
        every = np.concatenate([known, key[new]])
        order = np.argsort(every, kind="stable")
        links = links.take(order)  # sorted: whatever the order in which they came
        return links, np.searchsorted(every[order], key)

    def conflicts(self) -> tuple[Conflict, ...]:
        """All conflicts so far, by time."""
        return self._log.conflicts()

    def open(self) -> Episodes:
        """Return the pairs declared now; they last until what is known of them last."""
        links = self._links.take(self._links.on)
        return _episodes(links, links.last)


def _episodes(links: _Links, ended: FloatArray) -> Episodes:
    until = np.maximum(ended, links.start)
    a, b = links.pairs.T
    return Episodes(a, b, links.start, until, links.prob, links.since, np.clip(links.one, links.start, until))


def joined_episodes(parts: Sequence[Episodes]) -> Episodes:
    """Join episodes, by time."""
    none, nobody = np.zeros(0), np.zeros(0, np.int64)
    parts = [Episodes(nobody, nobody, *(none,) * 5), *parts]
    e = Episodes._make(np.concatenate(columns) for columns in zip(*parts, strict=True))
    order = np.lexsort((e.b, e.a, e.time_from))
    return Episodes._make(column[order] for column in e)


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
    pairs, of = np.asarray(evidence.pairs).reshape(-1, 2), np.asarray(system, dtype=np.int64)
    names = np.full(of.shape, -1) if address is None else np.asarray(address, dtype=np.int64)
    if of.ndim != 1 or names.shape != of.shape:
        raise DataError(f"system {of.shape} and address {names.shape} must be one number for each track, (K,).")
    if len(pairs) and not (0 <= pairs.min() and pairs.max() < len(of)):
        raise DataError(f"evidence names tracks {pairs.min()}..{pairs.max()}, but there are {len(of)} tracks.")
    decider, found = Decider(settings), []
    for now, rows in _decisions(evidence, settings):
        which = pairs[evidence.pair[rows]]
        found.append(
            decider.update(now, which, evidence.time[rows], evidence.llr[rows], system=of, address=names).ended
        )
    return Decisions(joined_episodes([*found, decider.open()]), decider.conflicts())


def _problem(pairs: Index, system: Index, address: Index, settings: DecisionSettings) -> _Problem:
    a, b = address[pairs[:, 0]], address[pairs[:, 1]]
    known = (a >= 0) & (b >= 0)
    split = system[pairs[:, 0]] == system[pairs[:, 1]]
    p = np.where(split, settings.p_false_split, settings.p_false)
    bound = np.log1p(-p) - np.log(p)
    return _Problem(pairs, system, address, split, known & (a != b), known & (a == b), bound, settings)


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
