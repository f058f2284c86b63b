"""Several systems on the page: who has how many objects in common, biases, and what contradicts itself."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from saltus.identify import Conflict, Decisions, DecisionSettings, Evidence
from saltus.shapes import Int
from saltus.tracks.membership import Segments

__all__ = [
    "CONFLICTS",
    "MAX_CONFLICTS",
    "BiasBlock",
    "ConflictRow",
    "Named",
    "SystemRow",
    "SystemsFound",
    "bias_blocks",
    "conflict_counts",
    "conflict_rows",
    "contributions",
    "system_rows",
]

MAX_CONFLICTS = 40

CONFLICTS = {
    "rival": "look like one object, but one of them has another partner there",
    "addresses": "are one object by their positions and two by their addresses",
    "places": "have one address at two places",
    "inconsistent": "are one object by themselves, but not with the others of their group",
}
_PARAMETERS = {  # key in biases.json: name, unit
    "east_m": ("position, east", "m"),
    "north_m": ("position, north", "m"),
    "azimuth_deg": ("azimuth", "°"),
    "range_m": ("range", "m"),
    "range_scale": ("range scale", ""),
    "time_s": ("time", "s"),
}


@dataclass(frozen=True, slots=True, eq=False)
class SystemsFound:
    """Who is whom among several systems; local tracks are numbered through all systems in their order."""

    names: tuple[str, ...]
    titles: tuple[str, ...]  # as configured, else the names
    system: Int[np.ndarray, " k"]  # of each local track
    local_id: tuple[str, ...]  # the system's own number or address of each local track, "" none
    address: Int[np.ndarray, " k"]  # of each local track, -1 unknown
    segments: Segments  # those published
    decisions: Decisions
    evidence: Evidence
    rule: DecisionSettings  # behind the decisions
    biases: Mapping[str, Any]  # what biases.json holds


class Named(NamedTuple):
    """A local track as the page names it."""

    system: int
    name: str


class SystemRow(NamedTuple):
    """One row of the matrix."""

    name: str
    common: tuple[int, ...]  # objects in common with each system; its own local tracks on the diagonal
    identified: int  # local tracks that are one object with another system's
    alone: int  # the others
    reference: bool


class BiasBlock(NamedTuple):
    """Biases of one system against another."""

    name: str
    relative_to: str
    objects: int
    scatter: float | None  # m between objects
    rows: tuple[tuple[str, str, str], ...]  # parameter, value with standard deviation and unit, why there is none


class ConflictRow(NamedTuple):
    """Two tracks about which the evidence contradicts itself."""

    a: Named
    b: Named
    words: str
    tracks: tuple[int, ...]  # system tracks of both
    time_from: float
    time_to: float


def named(found: SystemsFound, k: int) -> Named:
    """Return a local track's system and its name: own number or address, and the address where that is another."""
    own = found.local_id[k] or f"track {k + 1}"
    address = "" if found.address[k] < 0 else f"{found.address[k]:06X}"
    return Named(int(found.system[k]), own if address in ("", own.upper()) else f"{own} ({address})")


def contributions(found: SystemsFound) -> dict[int, tuple[int, ...]]:
    """Return the systems of each system track."""
    of: dict[int, set[int]] = {}
    for track, k in zip(found.segments.system_track.tolist(), found.segments.track.tolist(), strict=True):
        of.setdefault(track, set()).add(int(found.system[k]))
    return {track: tuple(sorted(systems)) for track, systems in of.items()}


def system_rows(found: SystemsFound) -> list[SystemRow]:
    """Count local tracks of each system and objects in common: system tracks that hold tracks of both."""
    n = len(found.names)
    common = np.zeros((n, n), np.int64)
    joint = contributions(found)
    for systems in joint.values():
        common[np.ix_(systems, systems)] += 1
    np.fill_diagonal(common, np.bincount(found.system, minlength=n))
    shared = np.array([len(joint[t]) > 1 for t in found.segments.system_track.tolist()], bool)
    identified = np.bincount(found.system[np.unique(found.segments.track[shared])], minlength=n)
    reference = found.biases.get("reference")
    return [
        SystemRow(
            name, tuple(common[k].tolist()), int(identified[k]), int(common[k, k] - identified[k]), name == reference
        )
        for k, name in enumerate(found.names)
    ]


def bias_blocks(biases: Mapping[str, Any]) -> list[BiasBlock]:
    """Lay out what `biases.json` holds, as of the end: one block for each system but the reference."""
    out = []
    for name, table in biases.get("systems", {}).items():
        known = table["biases"]
        rows = [
            (label, f"{_with_sd(known[key]['value'], known[key]['sd'])} {unit}".strip(), "")
            for key, (label, unit) in _PARAMETERS.items()
            if key in known
        ]
        rows += [(str(group), "–", str(why)) for group, why in table["not_estimated"].items()]
        scatter = table.get("scatter_between_objects_m")
        out.append(BiasBlock(name, table["relative_to"], table["common_objects"], scatter, tuple(rows)))
    return out


def _with_sd(value: float | None, sd: float | None) -> str:
    """Write both to the second figure of the standard deviation."""
    if value is None or sd is None:
        return "–"
    digits = 0 if sd <= 0 else max(0, 1 - int(np.floor(np.log10(sd))))
    return f"{value:.{digits}f} ± {sd:.{digits}f}".replace("-", "\u2212")


def conflict_rows(found: SystemsFound) -> list[ConflictRow]:
    """Return the longest conflicts in words."""
    lasting = sorted(found.decisions.conflicts, key=lambda c: (c.time_from - c.time_to, c.time_from))
    return [_conflict_row(found, c) for c in lasting[:MAX_CONFLICTS]]


def _conflict_row(found: SystemsFound, c: Conflict) -> ConflictRow:
    s = found.segments
    meanwhile = np.isin(s.track, (c.a, c.b)) & (s.time_from <= c.time_to) & (s.time_to >= c.time_from)
    tracks = tuple(np.unique(s.system_track[meanwhile]).tolist())
    return ConflictRow(named(found, c.a), named(found, c.b), CONFLICTS[c.kind], tracks, c.time_from, c.time_to)


def conflict_counts(conflicts: Sequence[Conflict]) -> list[tuple[str, int]]:
    """Return how many pairs of tracks contradict themselves in each way."""
    pairs = {(c.kind, c.a, c.b) for c in conflicts}
    return [(words, n) for kind, words in CONFLICTS.items() if (n := sum(k == kind for k, _, _ in pairs))]
