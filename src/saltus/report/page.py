"""Write the report: the frame from a template, the data inside it, nothing fetched from anywhere."""

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from saltus.io.write import output_file, write_text
from saltus.records import Plots, System
from saltus.report.colours import HEIGHT_ENDS, PROBABILITY_ENDS, colour_map
from saltus.report.data import assigned_tracks, payload, rows_within, time_span
from saltus.report.section import systems_section
from saltus.report.sensors import HEIGHT, WIDTH, sensor_rows
from saltus.report.settings import readable
from saltus.report.systems import SystemsFound
from saltus.report.tables import OUTSIDE, Block, blocks, innovation_rows, reason_rows, show
from saltus.report.updates import Updates, groups, read_updates

if TYPE_CHECKING:
    import jinja2
    import pyarrow as pa

    from saltus.geo import Site
    from saltus.tracks.health import Health

__all__ = ["write_report"]

MAX_ROWS = 2000  # tracks listed in the table
_SCRIPTS = ("base.js", "plan.js", "pointer.js", "timeline.js", "panels.js", "systems.js", "main.js")
# Keys of the summary with a place of their own.
_PLACED = ("faults", "inputs", "noise", "problems", "systems", "version")


def write_report(
    path: Path,
    *,
    tracks: "pa.Table",
    plots: Plots,
    assignments: "pa.Table",
    number: npt.NDArray[np.int64] | None = None,
    innovations: "pa.Table",
    summary: Mapping[str, object],
    sites: Mapping[str, "Site"],
    sensors: Sequence["Health"] = (),
    systems: SystemsFound | None = None,
    names: Mapping[str, str] | None = None,
) -> None:
    """Write one self-contained HTML page; it needs no network and appears whole or not at all.

    Args:
        path: file to write.
        tracks: the columns of `tracks.parquet`, any order of rows.
        plots: target reports read, rejected ones included: all, or every so many-th to be drawn.
        assignments: the columns of `assignments.parquet`, of all reports.
        number: row of `assignments` of each of `plots`; None: they are matched by file, category and record.
        innovations: one row per update: `track_id`, `time`, `source` (text), centre of the gate `latitude`,
            `longitude` (degrees), its three-sigma half widths `gate_e`, `gate_n` (m, east and north), `nis`, `dof`.
        summary: what `summary.json` holds. `inputs` (file names), `noise` (per source) and `problems` (lines) have
            their own places; every other key is laid out as it comes.
        sites: sensors' places by designation (`CAT048:20/129`) or name.
        sensors: faults of each sensor, for its timeline.
        systems: who is whom among several systems; None where there is one.
        names: what people read for a system's designation, its name as configured; None: the designation.

    Raises:
        DataError: the page cannot be written.
    """
    updates = read_updates(rows_within(tracks, plots))
    names = names or {}
    track_id = assigned_tracks(plots, assignments, number)
    drawn, notes = payload(updates, plots, track_id, innovations, sites, names)
    if len(plots) < assignments.num_rows:
        notes.insert(0, f"For the picture, {show(len(plots))} of {show(assignments.num_rows)} reports are kept.")
    jumping, busiest = groups(updates.rows)
    drawn |= {
        "colours": {"p": colour_map(PROBABILITY_ENDS), "height": colour_map(HEIGHT_ENDS)},
        "groups": {"manoeuvring": jumping, "busiest": busiest},
    }
    index = {row.id: k for k, row in enumerate(updates.rows)}
    span = time_span(plots, updates)
    section, linked = systems_section(systems, index, span)
    drawn |= linked
    page = _template().render(
        **_assets(),
        data=_script_json(drawn),
        ramp=drawn["colours"],
        notes=notes,
        sensors=sensor_rows(sensors, span),
        panel=(WIDTH, HEIGHT),
        found=section,
        index=index,
        **_header(plots, assignments, updates, summary, names),
        n_systems=len(systems.names) if systems else min(len(plots.sources), 1),
        **_tables(updates, assignments, innovations, summary, names),
    )
    with output_file(path) as temporary:
        write_text(temporary, page)


def _template() -> "jinja2.Template":
    import jinja2

    source = files("saltus.report").joinpath("template.html.j2").read_text(encoding="utf-8")
    frame = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    frame.filters |= {"show": show, "clock": _clock, "lasting": _lasting}
    return frame.from_string(source)


def _assets() -> dict[str, object]:
    """Return style and script, which are ours and go in unescaped."""
    from markupsafe import Markup

    folder = files("saltus.report")
    script = "\n".join(folder.joinpath(name).read_text(encoding="utf-8") for name in _SCRIPTS)
    return {"style": Markup(folder.joinpath("report.css").read_text(encoding="utf-8")), "script": Markup(script)}


def _script_json(value: object) -> object:
    """Write JSON that cannot end the script element it stands in, whatever the strings are."""
    from markupsafe import Markup

    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)


def _header(
    plots: Plots, assignments: "pa.Table", updates: Updates, summary: Mapping[str, object], names: Mapping[str, str]
) -> dict[str, object]:
    inputs = summary.get("inputs")
    files = [Path(str(n)).name for n in inputs] if isinstance(inputs, Sequence) and not isinstance(inputs, str) else []
    files = files or [Path(n).name for n in plots.files]
    counts = reason_rows(assignments)
    read, outside = sum(n for _, n, _ in counts), sum(n for name, n, _ in counts if name == OUTSIDE)
    used, judged = counts[0][1] if counts else 0, read - outside
    n_confirmed = sum(row.confirmed for row in updates.rows)
    figures = [
        ("Target reports read", show(read), ""),
        *([("Outside the time window", show(outside), "")] if outside else []),
        ("On a track", show(used), f"{used / judged:.1%}" if judged else ""),
        ("Rejected or unused", show(judged - used), f"{(judged - used) / judged:.1%}" if judged else ""),
        ("Confirmed tracks", show(n_confirmed), ""),
    ]
    span = time_span(plots, updates)
    return {
        "heading": ", ".join(files) if 0 < len(files) <= 2 else f"{len(files)} recordings" if files else "No recording",
        "inputs": files,
        "sources": [_designated(s.system, names) for s in plots.sources],
        "span": _span(*span) if span else "",
        "figures": figures,
        "version": version("saltus"),
    }


def _designated(system: System, names: Mapping[str, str]) -> str:
    """Write a system's name and its designation, once where they are the same."""
    designation = str(system)
    name = names.get(designation, system.name) or designation
    return name if designation in name else f"{name} ({designation})"


def _tables(
    updates: Updates,
    assignments: "pa.Table",
    innovations: "pa.Table",
    summary: Mapping[str, object],
    names: Mapping[str, str],
) -> dict[str, object]:
    confirmed = [row for row in updates.rows if row.confirmed]
    problems = summary.get("problems") or ()
    run: list[Block] = []
    for key, value in readable(summary).items():
        if key not in _PLACED:
            run += blocks(str(key), value)
    return {
        "reasons": reason_rows(assignments),
        "noise": blocks("noise", summary["noise"]) if summary.get("noise") else [],
        "innovations": [r._replace(source=names.get(r.source, r.source)) for r in innovation_rows(innovations)],
        "rows": confirmed[:MAX_ROWS],
        "n_confirmed": len(confirmed),
        "problems": [problems] if isinstance(problems, str) else [show(p) for p in _listed(problems)],
        "run": run,
    }


def _listed(value: object) -> Sequence[object]:
    return value if isinstance(value, Sequence) else [value]


def _clock(seconds: float) -> str:
    return f"{_moment(seconds):%H:%M:%S}" if np.isfinite(seconds) else "–"


def _moment(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)


def _lasting(seconds: float) -> str:
    if not np.isfinite(seconds):
        return "–"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _span(start: float, end: float) -> str:
    a, b = _moment(start), _moment(end)
    day = f"{a.day} {a:%B %Y}"
    until = f"{b:%H:%M:%S}" if a.date() == b.date() else f"{b.day} {b:%B %Y} {b:%H:%M:%S}"
    return f"{day}, {a:%H:%M:%S} – {until} UTC"
