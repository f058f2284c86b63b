"""Reports as a session numbers them, and what is noted in its journal of what becomes of them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from saltus.config import Config
from saltus.engine.intake import numbered
from saltus.engine.journal import Journal
from saltus.engine.learn import usable
from saltus.engine.setup import site_of
from saltus.records import REASONS, Plots, Source
from saltus.tracks.measurements import Measurements
from saltus.tracks.rows import ConditionFound, Fed, Rows

__all__ = ["local_ids", "note_fed", "placeable", "renumbered"]

_Index = npt.NDArray[np.int64]

_SITE_UNKNOWN = REASONS.index("site unknown")
_CONDITIONS = 4  # most that a source has


def renumbered(reports: Plots, sources: list[Source], files: list[str]) -> Plots:
    """Return reports whose sources and files are numbered as those known, to which new ones are added."""
    source = numbered(reports.source, reports.sources, sources)
    file = numbered(reports.file, reports.files, files)
    return replace(
        reports,
        sources=tuple(sources),
        files=tuple(files),
        source=source.astype(np.int32),
        file=file.astype(np.int32),
    )


def placeable(plots: Plots, config: Config) -> Plots:
    """Mark the reports that are relative to a site not known."""
    sites = [site_of(config.site_for(s.system)) for s in plots.sources]
    placeless = (plots.reason == 0) & ~usable(plots, sites)
    return replace(plots, reason=np.where(placeless, _SITE_UNKNOWN, plots.reason).astype(np.int8))


def local_ids(plots: Plots, number: _Index, m: Measurements) -> _Index:
    """Return a system's own track number of each measurement; `number` are the reports' own."""
    order = np.argsort(number, kind="stable")
    return plots.local_id[order[np.searchsorted(number[order], m.plot)]].astype(np.int64)


def note_fed(journal: Journal, own: int, fed: Fed, conditions: Sequence[ConditionFound]) -> None:
    """Note what the tracker of the system whose first source is `own` knows anew."""
    columns = {name: getattr(fed.rows, name) for name in Rows._fields if name != "moments"}
    journal.append("rows", {**columns, **fed.rows.moments._asdict(), "system": _all(own, fed.rows.time)})
    journal.append("fates", {**fed.fates._asdict(), "system": _all(own, fed.fates.plot)})
    journal.append("confirmed", {"track_id": fed.confirmed, "system": _all(own, fed.confirmed)})
    for source, (_, history) in enumerate(conditions):
        probs = np.zeros((len(history.time), _CONDITIONS))
        probs[:, : history.probs.shape[1]] = history.probs
        journal.append("conditions", {"source": _all(source, history.time), "time": history.time, "probs": probs})


def _all(value: int, like: npt.NDArray[Any]) -> npt.NDArray[np.int32]:
    return np.full(len(like), value, np.int32)
