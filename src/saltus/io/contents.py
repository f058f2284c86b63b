"""Lines of contents of pieces of a recording, added up."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from saltus.records import Contents

__all__ = ["Tally", "line_key", "sum_contents"]


class Tally:
    """Lines of contents by file, system and edition, over all pieces of recordings."""

    def __init__(self) -> None:
        self._lines: dict[tuple[str, str, str], Contents] = {}
        self._periods: dict[tuple[str, str, str], list[float]] = {}

    def add(self, lines: Iterable[Contents]) -> None:
        """Count what a further piece holds."""
        for line in lines:
            key = line_key(line)
            known = self._lines.get(key)
            self._lines[key] = line if known is None else sum_contents(known, line)
            if np.isfinite(line.update_period):
                self._periods.setdefault(key, []).append(line.update_period)

    def lines(self) -> tuple[Contents, ...]:
        """The sums; an update period is the median of the pieces'."""
        return tuple(
            replace(line, update_period=float(np.median(self._periods.get(key, [np.nan]))))
            for key, line in self._lines.items()
        )


def line_key(line: Contents) -> tuple[str, str, str]:
    """What tells lines apart: file, system and edition."""
    return line.file, str(line.system), line.edition


def sum_contents(a: Contents, b: Contents) -> Contents:
    """Contents of two pieces together; of the update period, the first that is told."""
    return replace(
        a,
        n_records=a.n_records + b.n_records,
        n_reports=a.n_reports + b.n_reports,
        time_from=float(np.fmin(a.time_from, b.time_from)),
        time_to=float(np.fmax(a.time_to, b.time_to)),
        update_period=b.update_period if np.isnan(a.update_period) else a.update_period,
        fields=_added(a.fields, b.fields, ordered=bool(a.titles or b.titles)),
        rejected=dict(Counter(a.rejected) + Counter(b.rejected)),
        n_by_type=dict(Counter(a.n_by_type) + Counter(b.n_by_type)),
        notes=tuple(dict.fromkeys((*a.notes, *b.notes))),
        titles={**a.titles, **b.titles},
        site=a.site if b.site is None else b.site,
    )


def _added(a: Mapping[str, int], b: Mapping[str, int], *, ordered: bool) -> dict[str, int]:
    both = {name: a.get(name, 0) + b.get(name, 0) for name in [*a, *b]}
    return dict(sorted(both.items())) if ordered else both
