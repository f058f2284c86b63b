"""The program `saltus`: each command is one function elsewhere, imported when it runs."""

import errno
import os
import sys
from pathlib import Path
from typing import Any, Literal, NoReturn

import click

from saltus.errors import SaltusError
from saltus.streams import Stopped, silence, stoppable, usable_streams, what_failed
from saltus.text import say

__all__ = ["main"]


class _Path(click.Path):
    def convert(self, value: str | os.PathLike[str], param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Refuse an empty name, which pathlib takes for the current directory."""
        if value == "":
            self.fail("the name is empty.", param, ctx)
        return Path(value)


_FILE = _Path()


class _Group(click.Group):
    def invoke(self, ctx: click.Context) -> object:
        """Turn every expected failure into one clear line and a non-zero exit status."""
        try:
            usable_streams()
            with stoppable():
                outcome = super().invoke(ctx)
                sys.stdout.flush()
                return outcome
        except SaltusError as error:
            _end(str(error), 2)
        except BrokenPipeError:
            # Whoever read the output has closed it, as head does. Commands write their files before they say so.
            silence(sys.stdout)
            sys.exit(0)
        except OSError as error:
            if error.filename is None and error.errno == errno.ENOSPC:
                silence(sys.stdout)
                _end("standard output: no space left on device", 2)
            _end(what_failed(error), 2)
        except ImportError as error:
            if os.strerror(errno.EMFILE) not in str(error):
                raise
            _end(what_failed(OSError(errno.EMFILE, os.strerror(errno.EMFILE))), 2)
        except Stopped as signal:
            _end(f"ended by {signal}; nothing half-written was left", 128 + signal.number)
        except KeyboardInterrupt as stopped:
            _end(f"interrupted; {str(stopped) or 'nothing half-written was left'}", 130)


def _end(line: str, status: int) -> NoReturn:
    say(f"saltus: {line}", err=True)
    sys.exit(status)


_FRAMING = click.option(
    "--framing",
    metavar="NAME",
    help="Container of ASTERIX: plain, gps, ioss, ioss-seq, oradis, rff, hdlc, pcap, pcapng; else told by structure.",
)


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="saltus", prog_name="saltus")
def main() -> None:
    """State estimation and tracking for systems that jump."""


@main.command()
@click.argument("inputs", nargs=-1, type=_FILE)
@click.option("--config", type=_FILE, help="TOML file: date, editions.")
@click.option("--date", help="Date of the recording, YYYY-MM-DD (ASTERIX carries only the time of day).")
@_FRAMING
@click.option("--full", is_flag=True, help="Read all of large files, not the beginning alone.")
@click.option("--skeleton", is_flag=True, help="Print a sensors.toml to begin with, and nothing else.")
@click.option("--system", is_flag=True, help="Say which kernel and instruction set this installation uses.")
def info(
    inputs: tuple[Path, ...],
    config: Path | None,
    date: str | None,
    framing: str | None,
    full: bool,
    skeleton: bool,
    system: bool,
) -> None:
    """Say what is in recordings: framing, systems, targets, where and when, items, rejected reports."""
    if system:
        from saltus.filters.backend import system_report

        for name, value in system_report().items():
            click.echo(f"{name}: {value}")
    elif not inputs:
        raise click.UsageError("name at least one recording, or --system.")
    if inputs:
        from saltus.info import show_info

        show_info(inputs, config, date, framing, full=full, as_skeleton=skeleton)


@main.command()
@click.argument("inputs", nargs=-1, required=True, type=_FILE)
@click.option("-o", "--output", required=True, type=_FILE, help="Output directory.")
@click.option("--config", type=_FILE, help="TOML file: date, [[sensor]] sites and noise, tracker settings.")
@click.option("--date", help="Date of the recording, YYYY-MM-DD (ASTERIX carries only the time of day).")
@_FRAMING
@click.option(
    "--identity", type=click.Choice(["use", "ignore"]), default="use", show_default=True, help="Codes of the plots."
)
@click.option("--from", "time_from", metavar="TIME", help="First time, HH:MM[:SS] or ISO 8601, UTC.")
@click.option("--to", "time_to", metavar="TIME", help="Last time, HH:MM[:SS] or ISO 8601, UTC.")
@click.option("--no-report", is_flag=True, help="Do not write report.html.")
@click.option("--allow-empty", is_flag=True, help="Exit with 0 also when no track was found.")
@click.option("--chunk", type=click.IntRange(min=1), metavar="N", help="Reports fed at a time; the answer is the same.")
@click.option("--checkpoint", type=_FILE, metavar="DIR", help="Save the state into DIR on the way, and on Ctrl-C.")
@click.option(
    "--checkpoint-every",
    type=click.FloatRange(min=0, min_open=True),
    default=600.0,
    show_default=True,
    metavar="SECONDS",
    help="Seconds of data between two states.",
)
@click.option("--resume", is_flag=True, help="Go on from the state in DIR, with the same inputs and options.")
def track(
    inputs: tuple[Path, ...],
    output: Path,
    config: Path | None,
    date: str | None,
    framing: str | None,
    identity: str,
    time_from: str | None,
    time_to: str | None,
    no_report: bool,
    allow_empty: bool,
    chunk: int | None,
    checkpoint: Path | None,
    checkpoint_every: float,
    resume: bool,
) -> None:
    """Track recordings: tracks.parquet, assignments.parquet, summary.json, report.html in OUTPUT.

    Without any track these are written all the same, a note says why there is none, and the exit status is 2.
    """
    if resume and checkpoint is None:
        raise click.UsageError("--resume goes on from the state that --checkpoint DIR saved: name that folder, too.")
    from saltus.run import Feeding, track_files

    feeding = Feeding(chunk or 0, checkpoint, checkpoint_every, resume)
    summary: dict[str, Any] = track_files(
        inputs,
        output,
        config,
        date,
        identity,
        time_from,
        time_to,
        report=not no_report,
        framing=framing,
        feeding=feeding,
    )
    if not summary["tracks"]["confirmed"] and not allow_empty:
        sys.exit(2)


@main.command()
@click.argument("inputs", nargs=-1, required=True, type=_FILE)
@click.option("-o", "--output", required=True, type=_FILE, help="TOML file to write.")
@click.option("--config", type=_FILE, help="TOML file: what it says goes before what is learnt.")
@click.option("--date", help="Date of the recording, YYYY-MM-DD (ASTERIX carries only the time of day).")
@_FRAMING
@click.option(
    "--identity", type=click.Choice(["use", "ignore"]), default="use", show_default=True, help="Codes of the plots."
)
def setup(
    inputs: tuple[Path, ...], output: Path, config: Path | None, date: str | None, framing: str | None, identity: str
) -> None:
    """Learn noise, update periods and backgrounds from the start of recordings, as a file that --config reads."""
    from saltus.run import setup_files

    setup_files(inputs, output, config, date, identity, framing=framing)


@main.command()
@click.argument("inputs", nargs=-1, required=True, type=_FILE)
@click.option("-o", "--output", required=True, type=_FILE, help="File to write: .parquet, .csv or .jsonl.")
@click.option("--category", "categories", multiple=True, type=click.IntRange(0, 255), help="Only this category.")
@click.option("--items", multiple=True, help="Only these items, as 040,070/MODE3A or I048/250.")
@click.option("--from", "time_from", metavar="TIME", help="First time, HH:MM[:SS] or ISO 8601, UTC.")
@click.option("--to", "time_to", metavar="TIME", help="Last time, HH:MM[:SS] or ISO 8601, UTC.")
@click.option("--native", is_flag=True, help="In the units of the format (NM, FL, degrees), not in SI and radians.")
@click.option("--config", type=_FILE, help="TOML file: date, editions, framing.")
@click.option("--date", help="Date of the recording, YYYY-MM-DD (ASTERIX carries only the time of day).")
@_FRAMING
def convert(
    inputs: tuple[Path, ...],
    output: Path,
    categories: tuple[int, ...],
    items: tuple[str, ...],
    time_from: str | None,
    time_to: str | None,
    native: bool,
    config: Path | None,
    date: str | None,
    framing: str | None,
) -> None:
    """Write every decoded item of ASTERIX recordings as a table, one row a record."""
    from saltus.convert import convert_files

    convert_files(
        inputs,
        output,
        categories=categories,
        items=items,
        time_from=time_from,
        time_to=time_to,
        native=native,
        config_path=config,
        date=date,
        framing=framing,
    )


@main.command()
@click.argument("output", type=_FILE)
@click.argument("truth", type=_FILE)
@click.option("--json", "json_path", type=_FILE, help="Write the figures to this file.")
@click.option("--cutoff", type=click.FloatRange(min=0, min_open=True), default=20.0, show_default=True, metavar="M")
def score(output: Path, truth: Path, json_path: Path | None, cutoff: float) -> None:
    """Score the tracks in OUTPUT against the table TRUTH: time, target_id, latitude, longitude."""
    from saltus.score import score_files

    score_files(output, truth, json_path, cutoff)


@main.command()
@click.argument("name")
@click.argument("recordings", nargs=-1, type=_FILE)
@click.option("-o", "--output", required=True, type=_FILE, help="Output directory.")
@click.option("--config", type=_FILE, help="Of recordings: TOML file with date, [[sensor]] sites, tracker settings.")
@click.option("--date", help="Of recordings: date, YYYY-MM-DD.")
@_FRAMING
@click.option("--reference", type=_FILE, help="Of recordings: Parquet of the same plots with BDS 5,0.")
@click.option("--runs", type=click.IntRange(min=2), help="Monte-Carlo runs (default: the study's own).")
@click.option("--seed", type=int, default=0, show_default=True)
def study(
    name: str,
    recordings: tuple[Path, ...],
    output: Path,
    config: Path | None,
    date: str | None,
    framing: str | None,
    reference: Path | None,
    runs: int | None,
    seed: int,
) -> None:
    """Run the study NAME: metrics.json and pictures in OUTPUT.

    NAME is coloured, faults, fusion, identification, jamming, moments or radar. The study faults puts faults into the
    plots of RECORDINGS, or of a simulated scene where none is named; the others simulate alone.
    """
    if name == "faults":
        if runs is not None:
            raise click.UsageError("the study faults tracks its recording; it has no --runs. Vary --seed.")
        from saltus.injection import study_faults

        study_faults(recordings, output, config, date, reference, seed, framing)
    elif recordings or config or date or framing or reference:
        raise click.UsageError(f"the study {name} simulates: it takes no recording. The study faults does.")
    else:
        from saltus.progress import progress_bar
        from saltus.studies import run_study

        with progress_bar() as bar:
            run_study(name, output, runs, seed, progress=lambda done, all_runs: bar.working(name, done / all_runs))
    say(f"written to {output}/")


@main.command()
@click.option("-o", "--output", default="saltus-demo", show_default=True, type=_FILE, help="Output directory.")
@click.option("--seed", type=int, default=0, show_default=True)
def demo(output: Path, seed: int) -> None:
    """Simulate two radars (manoeuvres, clutter, missed detections), write ASTERIX, track the files."""
    from saltus.demo import run_demo

    run_demo(output, seed)


@main.command()
@click.argument("model", type=_FILE)
@click.option("--runs", type=click.IntRange(min=2), default=100, show_default=True, help="Simulated runs.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option("--fast", type=click.Choice(["IMM", "GPB1", "GPB2"]), default="IMM", show_default=True)
@click.option(
    "--reference",
    type=click.Choice(["auto", "exact", "particles"]),
    default="auto",
    show_default=True,
    help="auto: exact enumeration where few histories of modes are possible, else particles.",
)
@click.option("--particles", type=click.IntRange(min=16), default=2000, show_default=True)
@click.option("--json", "as_json", is_flag=True, help="Print JSON in place of the table.")
@click.option("-o", "--output", type=_FILE, help="Write JSON to this file.")
def gap(
    model: Path,
    runs: int,
    seed: int,
    fast: str,
    reference: str,
    particles: int,
    as_json: bool,
    output: Path | None,
) -> None:
    """Say how far the fast filter is from the optimum for the model in MODEL (TOML)."""
    from saltus.gap.command import show_gap

    show_gap(
        model,
        runs=runs,
        seed=seed,
        fast=fast,
        reference=reference,
        particles=particles,
        as_json=as_json,
        output=output,
    )


@main.group()
def diagnose() -> None:
    """Say what a sensor's errors are like, from data."""


@diagnose.command()
@click.argument("inputs", nargs=-1, required=True, type=_FILE)
@click.option("-o", "--output", required=True, type=_FILE, help="Output directory.")
@click.option("--reference", multiple=True, type=_FILE, help="Recording of better positions of the same aircraft.")
@click.option("--config", type=_FILE, help="TOML file: date, [[sensor]] sites, editions.")
@click.option("--date", help="Date of the recordings, YYYY-MM-DD.")
@_FRAMING
@click.option("--columns", help="Of a table with a column time: the residuals, as east,north.")
@click.option("--series", help="Column of the table that tells objects or passes apart.")
@click.option(
    "--phase",
    type=click.Choice(["all", "air", "ground"]),
    default="all",
    show_default=True,
    help="Of recordings: reports in the air or on the ground only.",
)
@click.option("--motion", is_flag=True, help="The columns are positions: tell noise from motion by the innovations.")
def noise(
    inputs: tuple[Path, ...],
    output: Path,
    reference: tuple[Path, ...],
    config: Path | None,
    date: str | None,
    framing: str | None,
    columns: str | None,
    series: str | None,
    phase: Literal["all", "air", "ground"],
    motion: bool,
) -> None:
    """Estimate correlation time and level of errors: noise.json, noise.png and a suggested noise model in OUTPUT."""
    from saltus.diagnose.command import diagnose_noise

    names = [name.strip() for name in columns.split(",")] if columns else []
    diagnose_noise(
        inputs,
        output,
        reference=reference,
        config_path=config,
        date=date,
        framing=framing,
        columns=names,
        series=series,
        motion=motion,
        phase=phase,
    )
