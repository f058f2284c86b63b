"""What recordings hold, system by system, summed over files and pieces of files."""

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from saltus.info.figures import Figures
from saltus.records import Contents, FileContents, Kind, Plots, Recording, System

__all__ = ["Inventory", "Line"]


@dataclass(slots=True)
class Line:
    """One system of one file: its contents, and figures of its reports."""

    contents: Contents
    figures: Figures = field(default_factory=Figures)
    needs_site: bool = False  # some reports are relative to a site that they do not tell
    periods: list[float] = field(default_factory=list)

    def add(self, contents: Contents, plots: Plots) -> None:
        """Count what a further piece holds."""
        self.figures.add(plots)
        relative = np.isin(plots.kind, (Kind.POLAR, Kind.PLANE, Kind.BEARING)) & np.isnan(plots.observer_latitude)
        self.needs_site |= bool(relative.any())
        if np.isfinite(contents.update_period):
            self.periods.append(contents.update_period)


class Inventory:
    """Everything that `saltus info` shows."""

    def __init__(self) -> None:
        self.lines: dict[tuple[str, str, str], Line] = {}  # by file, system and edition
        self.files: dict[str, FileContents] = {}
        self.problems: dict[str, None] = {}
        self.n_reports = self.n_usable = self.n_tracks = 0

    def add(self, recording: Recording) -> None:
        """Count a recording, or a piece of one."""
        plots = recording.plots
        names = {name: k for k, name in enumerate(plots.files)}
        for contents in recording.contents:
            key = contents.file, str(contents.system), contents.edition
            line = self.lines.setdefault(key, Line(_empty(contents)))
            line.contents = _sum(line.contents, contents)
            line.add(contents, plots.take(_of(plots, contents.system, names.get(contents.file, -1))))
            if line.periods:
                line.contents = replace(line.contents, update_period=float(np.median(line.periods)))
        self.files |= {f.file: f for f in recording.files}
        self.problems |= dict.fromkeys(recording.problems)
        self.n_reports += len(plots)
        self.n_usable += int(np.count_nonzero(plots.reason == 0))
        self.n_tracks += 0 if recording.tracks is None else recording.tracks.num_rows

    def of_file(self, name: str) -> list[Line]:
        """The systems of a file."""
        return [line for (file, _, _), line in self.lines.items() if file == name]


def _of(plots: Plots, system: System, file: int) -> npt.NDArray[np.bool_]:
    own = [k for k, s in enumerate(plots.sources) if s.system == system]
    mine: npt.NDArray[np.bool_] = (plots.file == file) & np.isin(plots.source, own)
    return mine


def _empty(contents: Contents) -> Contents:
    return replace(contents, n_records=0, n_reports=0, fields={}, rejected={}, n_by_type={})


def _sum(a: Contents, b: Contents) -> Contents:
    """Contents of two pieces together."""
    return replace(
        a,
        n_records=a.n_records + b.n_records,
        n_reports=a.n_reports + b.n_reports,
        time_from=float(np.fmin(a.time_from, b.time_from)),
        time_to=float(np.fmax(a.time_to, b.time_to)),
        fields=dict(sorted((Counter(a.fields) + Counter(b.fields)).items())) if a.titles or b.titles else b.fields,
        rejected=dict(Counter(a.rejected) + Counter(b.rejected)),
        n_by_type=dict(Counter(a.n_by_type) + Counter(b.n_by_type)),
        notes=tuple(dict.fromkeys((*a.notes, *b.notes))),
        titles={**a.titles, **b.titles},
        site=a.site if b.site is None else b.site,
    )
