"""The section of several systems: tables for the template, series for the script."""

from typing import NamedTuple

from saltus.report.colours import system_colours
from saltus.report.pairs import HEIGHT, WIDTH, PairRow, pair_payload, pair_rows, probable_pairs, thinned_series
from saltus.report.systems import (
    BiasBlock,
    ConflictRow,
    SystemRow,
    SystemsFound,
    bias_blocks,
    conflict_counts,
    conflict_rows,
    contributions,
    system_rows,
)

__all__ = ["Section", "systems_section"]


class Section(NamedTuple):
    """What the template shows of several systems."""

    names: tuple[str, ...]  # designations
    titles: tuple[str, ...]  # what people read
    title_of: dict[str, str]
    colours: list[str]
    matrix: list[SystemRow]
    reference: str
    biases: list[BiasBlock]
    conflicts: list[ConflictRow]
    more_conflicts: int  # not listed
    kinds: list[tuple[str, int]]  # of conflicts, with the pairs of each
    pairs: list[PairRow]
    small: tuple[float, float]  # size of a pair's picture
    held: int  # pairs whose series the page holds
    probable: int  # of so many
    of_track: dict[int, tuple[int, ...]]  # systems of each system track


def systems_section(
    found: SystemsFound | None, index: dict[int, int], span: tuple[float, float] | None
) -> tuple[Section | None, dict[str, object]]:
    """Return what the template shows, and what the script draws; nothing of one system.

    Args:
        found: who is whom.
        index: place of each system track in the page's list.
        span: first and last time of the page, s, None without any.
    """
    if found is None or span is None:
        return None, {}
    series, conflicts = thinned_series(found), conflict_rows(found)
    section = Section(
        names=found.names,
        titles=found.titles,
        title_of=dict(zip(found.names, found.titles, strict=True)),
        colours=system_colours(len(found.names)),
        matrix=system_rows(found),
        reference=str(found.biases.get("reference", "")),
        biases=bias_blocks(found.biases),
        conflicts=conflicts,
        more_conflicts=len(found.decisions.conflicts) - len(conflicts),
        kinds=conflict_counts(found.decisions.conflicts),
        pairs=pair_rows(found, series, span),
        small=(WIDTH, HEIGHT),
        held=len(series),
        probable=probable_pairs(found),
        of_track=contributions(found),
    )
    return section, {"systems": pair_payload(found, series, index, span[0])}
