"""What became of every report, and what every local track is called: a few bytes of each, from the journal."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.engine.journal import Journal
from saltus.engine.setup import Setup
from saltus.tracks.lifecycle import CONFIRMED
from saltus.tracks.local import Party

__all__ = ["BEARING", "ELSEWHERE", "POSITION", "SPLIT", "LocalNames", "PartyTally", "Tally", "tally"]

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]
SPLIT, ELSEWHERE, BEARING, POSITION = 1, 2, 4, 8  # bits


class LocalNames(NamedTuple):
    """Codes of local tracks as each gave most often, -1 none, (K,)."""

    icao24: _Index
    local_id: _Index
    mode3a: _Index


@dataclass(frozen=True, slots=True, eq=False)
class PartyTally:
    """What is known of the local tracks of one system; arrays over the tracks are (K,).

    Attributes:
        party: the system.
        ever: numbers of all tracks confirmed at some time, sorted.
        ids: of those, the ones with a position, sorted.
        ready: when each of these was confirmed, s.
        begin: first report of each with a position, s.
        end: last one, s.
        names: what each is called.
    """

    party: Party
    ever: _Index
    ids: _Index
    ready: _Array
    begin: _Array
    end: _Array
    names: LocalNames


@dataclass(frozen=True, slots=True, eq=False)
class Tally:
    """What became of every report.

    Attributes:
        reason: why each was not used, index into `records.REASONS`, (N,).
        system: place among `parties` of each that was placed, -1 else, (N,).
        track: its local track, 0 none, (N,).
        bits: SPLIT, ELSEWHERE, BEARING, POSITION, (N,).
        rows: how many rows its tracker published of it, (N,).
        parties: the systems that gave measurements.
        source: reports with a position of each source, (S,).
        tracked: of those, the ones on tracks confirmed at some time, (S,).
        span: first and last time of the usable ones, s.
        placed: first and last time of those placed, s.
    """

    reason: npt.NDArray[np.int8]
    system: npt.NDArray[np.int8]
    track: npt.NDArray[np.int32]
    bits: npt.NDArray[np.uint8]
    rows: npt.NDArray[np.uint8]
    parties: list[PartyTally]
    source: _Index
    tracked: _Index
    span: tuple[float, float]
    placed: tuple[float, float]


def tally(journal: Journal, setup: Setup) -> Tally:
    """Read the journal once."""
    reason, local_id, span = _reports(journal)
    n = len(reason)
    track, bits, rows = np.zeros(n, np.int32), np.zeros(n, np.uint8), np.zeros(n, np.uint8)
    for part in journal.parts("fates"):
        track[part["plot"]] = part["track_id"]
        bits[part["plot"]] = SPLIT * part["split"] + ELSEWHERE * part["elsewhere"]
    parties = [p for p in setup.parties() if any(setup.sensors[s].heard for s in p.sources)]
    locals_ = [_Local(journal, party) for party in parties]
    for part in journal.parts("rows", ["system", "track_id", "status", "time_known", "measurement"]):
        np.add.at(rows, part["measurement"][part["measurement"] >= 0], 1)
        for local in locals_:
            local.confirm(part)
    system, n_sources = np.full(n, -1, np.int8), len(setup.sensors)
    source, tracked, first, last = np.zeros(n_sources, np.int64), np.zeros(n_sources, np.int64), np.inf, -np.inf
    for part in journal.parts("plots", ["plot", "time", "source", "position", "bearing", "icao24", "mode3a"]):
        plot, there, alone = part["plot"], np.isfinite(part["position"][:, 0]), np.isfinite(part["bearing"])
        bits[plot] |= (BEARING * alone + POSITION * there).astype(np.uint8)
        source += np.bincount(part["source"][there], minlength=n_sources)
        first, last = min(first, float(part["time"].min())), max(last, float(part["time"].max()))
        for k, local in enumerate(locals_):
            own = np.flatnonzero(np.isin(part["source"], local.party.sources))
            system[plot[own]] = k
            at = own[there[own] & local.confirmed(track[plot[own]])]
            tracked += np.bincount(part["source"][at], minlength=n_sources)
            codes = {"icao24": part["icao24"], "local_id": local_id[plot], "mode3a": part["mode3a"]}
            local.add(track[plot[at]], part["time"][at], [codes[name][at] for name in LocalNames._fields])
    gave = [k for k in range(len(parties)) if (system == k).any()]
    places = np.full(len(parties) + 1, -1, np.int8)  # the last one: of those not placed
    places[gave] = np.arange(len(gave))
    return Tally(
        reason,
        places[system],
        track,
        bits,
        rows,
        [locals_[k].found() for k in gave],
        source,
        tracked,
        span,
        (first, last),
    )


def _reports(journal: Journal) -> tuple[npt.NDArray[np.int8], npt.NDArray[np.int32], tuple[float, float]]:
    """Return why each report was not used, its number in its own system, and first and last time of those used, s."""
    n, begin, first, last = journal.count("reports"), 0, np.inf, -np.inf
    reason, local_id = np.zeros(n, np.int8), np.zeros(n, np.int32)
    for part in journal.parts("refused"):
        reason[part["plot"]] = part["reason"]
    for part in journal.parts("reports", ["reason", "local_id", "time"]):
        own = slice(begin, begin + len(part["reason"]))
        reason[own] = np.where(reason[own] > 0, reason[own], part["reason"])
        local_id[own], begin = part["local_id"], own.stop
        used = reason[own] == 0
        first = min(first, float(part["time"].min(where=used, initial=np.inf)))
        last = max(last, float(part["time"].max(where=used, initial=-np.inf)))
    return reason, local_id, (first, last)


class _Local:
    """One system's tracks while the journal is read."""

    def __init__(self, journal: Journal, party: Party) -> None:
        self.party, own = party, party.sources[0]
        told = [part["track_id"][part["system"] == own] for part in journal.parts("confirmed")]
        self._ever = np.unique(np.concatenate([np.zeros(0, np.int64), *told]))
        size = int(self._ever.max(initial=0)) + 2  # the last one: of tracks beyond
        self._sure = np.zeros(size, np.bool_)
        self._sure[self._ever] = True
        self._ready = np.full(size, np.inf)
        self._begin, self._end = np.full(size, np.inf), np.full(size, -np.inf)
        self._votes: list[list[_Index]] = [[np.zeros((3, 0), np.int64)] for _ in LocalNames._fields]

    def confirmed(self, track: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
        """Say which tracks are confirmed at some time."""
        return np.asarray(self._sure[np.minimum(track, len(self._sure) - 1)])

    def confirm(self, rows: dict[str, npt.NDArray[Any]]) -> None:
        """Note when tracks were confirmed."""
        own = (rows["system"] == self.party.sources[0]) & (rows["status"] == CONFIRMED)
        own &= self.confirmed(rows["track_id"])
        np.minimum.at(self._ready, rows["track_id"][own], rows["time_known"][own])

    def add(self, track: npt.NDArray[np.int32], time: _Array, codes: Sequence[npt.NDArray[np.integer]]) -> None:
        """Note reports with a position on confirmed tracks."""
        np.minimum.at(self._begin, track, time)
        np.maximum.at(self._end, track, time)
        for votes, code in zip(self._votes, codes, strict=True):
            told = np.flatnonzero(code >= 0)
            pairs, count = np.unique(np.stack([track[told], code[told]]).astype(np.int64), axis=1, return_counts=True)
            votes.append(np.concatenate([pairs, count[None]]))

    def found(self) -> PartyTally:
        """Return everything."""
        ids = np.flatnonzero(np.isfinite(self._begin))
        names = LocalNames(*(_commonest(np.concatenate(votes, axis=1), ids) for votes in self._votes))
        return PartyTally(self.party, self._ever, ids, self._ready[ids], self._begin[ids], self._end[ids], names)


def _commonest(votes: _Index, ids: _Index) -> _Index:
    """Return what each track was called most often, the least of equals, -1 never; votes are track, code and count."""
    out = np.full(len(ids), -1)
    if votes.shape[1]:
        pairs, place = np.unique(votes[:2], axis=1, return_inverse=True)
        count = np.bincount(place.reshape(-1), votes[2])
        order = np.lexsort((pairs[1], -count, pairs[0]))
        first = order[np.flatnonzero(np.diff(pairs[0][order], prepend=-1))]
        out[np.searchsorted(ids, pairs[0][first])] = pairs[1][first]
    return out
