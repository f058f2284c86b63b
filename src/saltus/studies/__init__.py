"""Studies: experiments that measure the filters, each one function in a table."""

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from saltus.errors import ModelError
from saltus.io.write import output_directory, write_json
from saltus.studies.coloured_report import coloured_study
from saltus.studies.fusion_report import fusion_study
from saltus.studies.identification_report import identification_study
from saltus.studies.jamming_report import jamming_study
from saltus.studies.moments_report import moments_study
from saltus.studies.radar_report import radar_study

__all__ = ["STUDIES", "Study", "run_study"]


class Study(Protocol):
    """Fill a folder with pictures and return the metrics, a tree of names and numbers."""

    def __call__(
        self, folder: Path, runs: int | None, seed: int, progress: Callable[[int, int], None] | None
    ) -> dict[str, object]:
        """Do `runs` runs (None: as many as the study likes), telling `progress` (runs done, all runs)."""
        ...


STUDIES: dict[str, Study] = {
    "coloured": coloured_study,
    "fusion": fusion_study,
    "identification": identification_study,
    "jamming": jamming_study,
    "moments": moments_study,
    "radar": radar_study,
}

_OF_RECORDINGS = ("faults",)  # in saltus.injection


def run_study(
    name: str,
    output: Path,
    runs: int | None = None,
    seed: int = 0,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Run a study and write `metrics.json` and its pictures into `output`, all of them or none.

    Args:
        name: a key of STUDIES.
        output: directory, made if absent.
        runs: Monte-Carlo runs, >= 2; None for the study's own number.
        seed: root of the runs' generators, >= 0: the same seed gives the same numbers.
        progress: called with (runs done, all runs).

    Raises:
        ModelError: no such study, or a number out of range.
        DataError: `output` exists and is not a directory.
    """
    if name not in STUDIES:
        raise ModelError(f"no study named {name!r}; the studies are: {', '.join(sorted([*STUDIES, *_OF_RECORDINGS]))}.")
    if (runs is not None and runs < 2) or seed < 0:
        raise ModelError(f"need runs >= 2 (intervals come from the runs' spread) and seed >= 0: {runs}, {seed}.")
    with output_directory(output, "study") as folder:
        metrics = STUDIES[name](folder, runs, seed, progress)
        write_json(folder / "metrics.json", {"study": name, "seed": seed, **metrics})
