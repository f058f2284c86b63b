"""What recordings hold, system by system, summed over files and pieces of files."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from saltus.info.figures import Figures
from saltus.io.contents import Tally, line_key
from saltus.records import Contents, FileContents, Kind, Plots, Recording, System

__all__ = ["Inventory", "Line"]


@dataclass(slots=True)
class Line:
    """One system of one file: its contents, and figures of its reports."""

    contents: Contents
    figures: Figures = field(default_factory=Figures)
    needs_site: bool = False  # some reports are relative to a site that they do not tell

    def add(self, plots: Plots) -> None:
        """Count the reports of a further piece."""
        self.figures.add(plots)
        relative = np.isin(plots.kind, (Kind.POLAR, Kind.PLANE, Kind.BEARING)) & np.isnan(plots.observer_latitude)
        self.needs_site |= bool(relative.any())


class Inventory:
    """Everything that `saltus info` shows."""

    def __init__(self) -> None:
        self.lines: dict[tuple[str, str, str], Line] = {}  # by file, system and edition
        self.files: dict[str, FileContents] = {}
        self.problems: dict[str, None] = {}
        self.n_reports = self.n_usable = self.n_tracks = 0
        self._tally = Tally()

    def add(self, recording: Recording) -> None:
        """Count a recording, or a piece of one."""
        plots = recording.plots
        names = {name: k for k, name in enumerate(plots.files)}
        for contents in recording.contents:
            line = self.lines.setdefault(line_key(contents), Line(contents))
            line.add(plots.take(_of(plots, contents.system, names.get(contents.file, -1))))
        self._tally.add(recording.contents)
        for contents in self._tally.lines():
            self.lines[line_key(contents)].contents = contents
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
