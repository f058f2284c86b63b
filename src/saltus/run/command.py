"""`saltus track`: recordings in, tracks, assignments, summary and report out."""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import pyarrow as pa

from saltus.config import Config, load_config
from saltus.engine import Result
from saltus.io.inputs import expand, left_out
from saltus.io.write import output_directory, write_batches, write_json, write_table
from saltus.progress import Progress, progress_bar
from saltus.records import Plots, Recording
from saltus.run.follow import Feeding, fingerprint, follow
from saltus.run.identified import (
    address_lines,
    conflict_lines,
    identification_summary,
    system_lines,
    systems_found,
)
from saltus.run.problems import called, set_up, without_tracks
from saltus.run.seen import Seen
from saltus.run.window import Window
from saltus.summary import noise_rows, show_summary, summarise, why_no_track

__all__ = ["Options", "track_files", "track_recording", "write_tracks"]

_REPORT = "report.html"


@dataclass(frozen=True, slots=True)
class Options:
    """How recordings are tracked.

    Attributes:
        config: TOML configuration.
        date: YYYY-MM-DD of the recording; wins over the configuration's.
        identity: "use" or "ignore" the codes that plots carry.
        time_from: first time used, HH:MM[:SS] of the recording's day or ISO 8601, UTC.
        time_to: last time used.
        report: whether to write the report; without it, the report of an earlier run is removed.
        framing: of ASTERIX recordings, one of `saltus.framing.NAMES`; None has it guessed.
        feeding: in which pieces, and where states are saved.
    """

    config: Path | None = None
    date: str | None = None
    identity: str = "use"
    time_from: str | None = None
    time_to: str | None = None
    report: bool = True
    framing: str | None = None
    feeding: Feeding = field(default_factory=Feeding)


def track_files(
    inputs: Sequence[Path],
    output: Path,
    config_path: Path | None = None,
    date_text: str | None = None,
    identity: str = "use",
    time_from: str | None = None,
    time_to: str | None = None,
    *,
    report: bool = True,
    framing: str | None = None,
    feeding: Feeding | None = None,
) -> dict[str, object]:
    """Track recordings and write `tracks.parquet`, `assignments.parquet`, `summary.json` and `report.html`.

    Args:
        inputs: recordings; several are merged by time.
        output: directory to write into; its files appear together at the end, or not at all.
        config_path: see `Options`, as all that follow.
        date_text: date.
        identity: codes.
        time_from: first time used.
        time_to: last time used.
        report: whether to write it.
        framing: of ASTERIX recordings.
        feeding: in which pieces.

    Returns:
        The summary, as written.

    Raises:
        DataError: an input cannot be read, or nothing in it can be tracked.
        ModelError: the configuration is wrong.
    """
    given = Options(config_path, date_text, identity, time_from, time_to, report, framing, feeding or Feeding())
    with progress_bar() as bar, output_directory(output, "track") as folder:
        summary, lines = write_tracks(inputs, folder, bar, given)
    show_summary(summary, output, report, lines)
    return summary


def write_tracks(
    inputs: Sequence[Path], folder: Path, bar: Progress, given: Options
) -> tuple[dict[str, object], Sequence[str]]:
    """Track recordings as `track_files` does, into a folder whose files another has yet to publish.

    Returns:
        The summary, and lines on what the systems have in common: `show_summary` says both.
    """
    began = time.perf_counter()
    config = load_config(given.config, date=given.date, framing=given.framing)
    told = _told(inputs, given) if given.feeding.folder is not None else {}
    pieces = config.read_in_order(inputs, bar.reading)
    window, reading = Window.told(given.time_from, given.time_to, pieces.span), _Reading(time.perf_counter() - began)
    use_identity = given.identity == "use"
    result, seen, lines = follow(
        map(window.marked, reading.of(pieces)),
        config,
        bar,
        given.feeding,
        told,
        use_identity=use_identity,
        span=pieces.span,
    )
    done = time.perf_counter()
    summary, names = _summary(inputs, result, [*left_out(inputs), *seen.problems, *lines], seen), called(result.setup)
    summary["settings"] = {
        "identity": given.identity,
        **{
            name: asdict(getattr(config, name))
            for name in ("intake", "setup", "periods", "lasting", "tracker", "filter", "systems", "registration")
        },
    }
    summary["seconds"] = {
        "decoding": round(reading.seconds, 2),
        "tracking": round(done - began - reading.seconds, 2),
    }
    _write(folder, result, summary)
    if given.report:
        _report(folder / _REPORT, seen, result, summary)
    return summary, system_lines(result.whole, names)


def _summary(inputs: Sequence[Path], result: Result, lines: Sequence[str], seen: Seen) -> dict[str, object]:
    """Sum up a run; `lines` are of its reading."""
    names, whole = called(result.setup), result.whole
    problems = [
        *lines,
        *set_up(result.setup, seen.unplaced),
        *(without_tracks(result) if result.outcome.confirmed else [why_no_track(result)]),
        *address_lines(whole, names),
        *conflict_lines(whole, names),
    ]
    return {**summarise(inputs, result, problems), "systems": identification_summary(whole)}


def track_recording(
    recording: Recording, config: Config, bar: Progress | None = None
) -> tuple[Plots, pa.Table, pa.Table]:
    """Track a recording in memory as `track_files` does, identities used.

    Args:
        recording: as read, or changed since.
        config: sites, noise and settings.
        bar: where to show progress.

    Returns:
        The reports with the reasons why some are not used; the columns of `tracks.parquet`; those of
        `assignments.parquet`, one row for each report in the same order.
    """
    result = follow([recording], config, bar or Progress()).result
    return replace(recording.plots, reason=result.reason), result.tracks, result.assignments


@dataclass(slots=True)
class _Reading:
    """How long the pieces of a recording took to read, s."""

    seconds: float

    def of(self, pieces: Iterable[Recording]) -> Iterator[Recording]:
        began = time.perf_counter()
        for piece in pieces:
            self.seconds += time.perf_counter() - began
            yield piece
            began = time.perf_counter()


def _told(inputs: Sequence[Path], given: Options) -> dict[str, object]:
    """What must be the same where a run is taken up again."""
    config = {} if given.config is None else fingerprint([given.config])
    options = {"--date": given.date, "--identity": given.identity, "--from": given.time_from, "--to": given.time_to}
    return {"inputs": fingerprint(expand(inputs)), "--config": config, **options, "--framing": given.framing}


def _report(path: Path, seen: Seen, result: Result, summary: dict[str, object]) -> None:
    from saltus.report import write_report

    names, sensors = called(result.setup), result.setup.sensors
    plots, number = seen.sample()
    write_report(
        path,
        tracks=result.tracks,
        plots=replace(plots, reason=result.reason[number]),
        assignments=result.assignments,
        number=number,
        innovations=result.gates,
        summary={**summary, "noise": noise_rows(summary)},
        sites={str(s.source.system): s.site for s in sensors if s.site is not None},
        sensors=result.sensors(),
        systems=systems_found(result.whole, result.setup.config.systems, names),
        names=names,
    )


def _write(folder: Path, result: Result, summary: dict[str, object]) -> None:
    for name, table in result.stored.items():
        write_batches(folder / f"{name}.parquet", table.batches())
    write_table(folder / "identifications.parquet", result.identifications)
    write_json(folder / "biases.json", result.biases)
    write_json(folder / "summary.json", summary)
