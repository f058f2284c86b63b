"""What a run found of identity and biases, as tables and lines: identifications.parquet, biases.json, the report."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from saltus.engine.identified import Identified, bias_tables, biases, published_tracks
from saltus.report.systems import CONFLICTS, SystemsFound
from saltus.tracks.membership import Segments
from saltus.tracks.picture import decision_settings
from saltus.tracks.settings import SystemsSettings

__all__ = [
    "address_lines",
    "conflict_lines",
    "identification_summary",
    "system_lines",
    "systems_found",
]

_LASTING = 20.0  # s: a conflict shorter than this is no line for the user
_MOST_LINES = 8
_FEWEST, _FAR = 3, 1000.0  # addresses in common, and m apart, from which a system's set-up is doubted


def identification_summary(whole: Identified) -> dict[str, Any]:
    """Count what each system had and how much of it was found in other systems too."""
    s = whole.segments
    owner = np.repeat(np.arange(len(whole.systems)), [len(x.ids) for x in whole.systems])
    out: dict[str, Any] = {}
    for k, system in enumerate(whole.systems):
        mine = owner[s.track] == k
        others = np.unique(s.system_track[~mine])
        shared = np.unique(s.track[mine & np.isin(s.system_track, others)])
        out[system.name] = {"local_tracks": len(system.ids), "identified_with_another_system": len(shared)}
    return out


def conflict_lines(whole: Identified, titles: Mapping[str, str]) -> list[str]:
    """Say which identities contradict each other, the longest first; none is resolved silently.

    Args:
        whole: who is whom.
        titles: what people read for a system's name.
    """
    names = np.repeat([titles.get(x.name, x.name) for x in whole.systems], [len(x.ids) for x in whole.systems])
    labels = [label for x in whole.systems for label in x.local_id]

    def named(k: int) -> str:
        return f"{names[k]} {labels[k] or f'track {k + 1}'}"

    found = [c for c in whole.decisions.conflicts if c.time_to - c.time_from >= _LASTING]
    found.sort(key=lambda c: c.time_from - c.time_to)
    lines = [
        f"identity conflict: {named(c.a)} and {named(c.b)} {CONFLICTS[c.kind]}, for {c.time_to - c.time_from:.0f} s."
        for c in found[:_MOST_LINES]
    ]
    if len(found) > _MOST_LINES:
        lines.append(f"{len(found) - _MOST_LINES} more identity conflicts lasted {_LASTING:.0f} s or longer.")
    return lines


def address_lines(whole: Identified, titles: Mapping[str, str]) -> list[str]:
    """Say of which two systems the same addresses are far from each other, or seen at other times."""
    lines = []
    for i, a in enumerate(whole.systems):
        for j, b in enumerate(whole.systems[i + 1 :], start=i + 1):
            common = np.intersect1d(a.address[a.address >= 0], b.address)
            if len(common) < _FEWEST:
                continue
            apart = [whole.apart[i, j, code] for code in common.tolist() if (i, j, code) in whole.apart]
            both = (
                f"{titles.get(a.name, a.name)} and {titles.get(b.name, b.name)} have {len(common)} addresses in common"
            )
            if not apart:
                lines.append(f"{both}, and none at one time: check dates and clocks.")
            elif len(apart) >= _FEWEST and float(np.median(apart)) > _FAR:
                far = float(np.median(apart)) / 1000.0
                lines.append(f"{both}, {far:.1f} km apart at one time (median): check sites, units, dates and clocks.")
    return lines


def system_lines(whole: Identified, titles: Mapping[str, str]) -> list[str]:
    """Say how each of several systems differs from the reference, and how much of it was identified."""
    if len(whole.systems) < 2:
        return []
    counts, out = identification_summary(whole), []
    for r in whole.registered:
        own = counts[r.name]
        known = f"{own['identified_with_another_system']} of {own['local_tracks']} tracks identified with another's"
        if r.found is None:
            out.append(f"system {titles.get(r.name, r.name)}: the reference; {known}")
            continue
        told = ", ".join(_in_words(name, b) for name, b in biases(r)["biases"].items()) or "no bias told"
        common = int(r.found.series.objects[-1]) if len(r.found.series.time) else 0
        pair = f"{titles.get(r.name, r.name)} minus {titles.get(r.to, r.to)}"
        way = "" if r.by == r.to else f" with {titles.get(r.by, r.by)}"
        out.append(f"system {pair} ({common} common objects{way}): {told}; {known}")
    return out


def _in_words(name: str, bias: Mapping[str, float]) -> str:
    what, _, unit = name.rpartition("_")
    if (what, unit) == ("range", "scale"):
        what, unit = "range scale", ""
    digits = max(0, 1 - int(np.floor(np.log10(bias["sd"])))) if bias["sd"] > 0 else 3
    return f"{what} {bias['value']:.{digits}f} ± {bias['sd']:.{digits}f} {unit.replace('deg', '°')}".rstrip()


def systems_found(whole: Identified, settings: SystemsSettings, titles: Mapping[str, str]) -> SystemsFound | None:
    """Return what the report shows of several systems, None of one; `titles` are the sources' names as configured."""
    if len(whole.systems) < 2:
        return None
    published = np.isin(whole.segments.system_track, published_tracks(whole))
    rule = decision_settings(settings)
    return SystemsFound(
        names=tuple(x.name for x in whole.systems),
        titles=tuple(titles.get(x.name, x.name) for x in whole.systems),
        system=np.repeat(np.arange(len(whole.systems)), [len(x.ids) for x in whole.systems]),
        local_id=tuple(label for x in whole.systems for label in x.local_id),
        address=np.concatenate([x.address for x in whole.systems]),
        segments=Segments(*(column[published] for column in whole.segments)),
        decisions=whole.decisions,
        evidence=whole.evidence,
        rule=replace(rule, hold=rule.hold * whole.told_every),
        biases=bias_tables(whole),
    )
