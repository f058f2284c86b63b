"""`saltus study faults`: track a recording as it is and with faults put into it, with and without the chains."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from saltus.config import Config, load_config
from saltus.demo import write_demo
from saltus.errors import ModelError
from saltus.evaluate.plots import OWN_RUN, Followed, Motion, downlinked, followed, from_run, simulated
from saltus.evaluate.tables import read_reference
from saltus.injection.figures import RUNS, draw, errors, found, growth
from saltus.injection.plots import inject
from saltus.io.write import output_directory, write_json
from saltus.progress import progress_bar
from saltus.records import Kind, Recording
from saltus.run import track_recording
from saltus.simulate.scene import demo_aircraft
from saltus.text import say

__all__ = ["study_faults"]

_SHARE = 0.02  # of the plots
_WANTED = {"growth_at_most": 0.2, "injected_told_at_least": 0.9, "clean_suspected_at_most": 0.005}


def study_faults(
    recordings: Sequence[Path],
    output: Path,
    config_path: Path | None = None,
    date: str | None = None,
    reference: Path | None = None,
    seed: int = 0,
    framing: str | None = None,
) -> dict[str, object]:
    """Put faults into 2 % of the radar plots of a recording and see what the tracker makes of them.

    A recording without a `reference` is judged against the tracks of its clean plots. Without any recording the demo's
    scene is used, which has a truth.

    Args:
        recordings: to be tracked together; none for a simulated scene.
        output: directory for metrics.json and pictures.
        config_path: TOML configuration.
        date: of the recording, YYYY-MM-DD; wins over the configuration's.
        reference: Parquet of the same plots with what aircraft downlinked (BDS 5,0).
        seed: of the faults, and of the simulated scene.
        framing: of ASTERIX recordings, one of `saltus.framing.NAMES`; None has it guessed.

    Returns:
        The metrics, as written.

    Raises:
        DataError: an input cannot be used.
        ModelError: the configuration or the seed is wrong.
    """
    if seed < 0:
        raise ModelError(f"seed must be >= 0, got {seed}.")
    with output_directory(output, "study") as folder:
        if recordings:
            config = load_config(config_path, date=date, framing=framing)
            recording = config.read(recordings)
            truth = None if reference is None else downlinked(recording.plots, reference)
        else:
            recording, config, truth = _scene(folder, seed)
        fault, runs = _track(recording, config, seed)
        truth = truth or from_run(runs["clean_with"])
        metrics = {
            "study": "faults",
            "seed": seed,
            "recording": [Path(p).name for p in recordings] or "simulated",
            **_metrics(recording, fault, runs, truth, folder),
        }
        write_json(folder / "metrics.json", metrics)
    _show(metrics)
    return metrics


def _scene(folder: Path, seed: int) -> tuple[Recording, Config, Motion]:
    """Simulate in a folder of its own within `folder`, so that a kill leaves nothing elsewhere."""
    scene = write_demo(folder / "scene", seed)
    config = load_config(scene.config)
    recording = config.read(scene.files)
    truth = read_reference(scene.config.with_name("truth.parquet"))
    shutil.rmtree(folder / "scene")
    files = {path.name: labels for path, labels in zip(scene.files, scene.labels, strict=True)}
    plots = recording.plots
    label = np.full(len(plots), -1, np.int64)
    for f, file in enumerate(plots.files):
        mine = (plots.file == f) & (plots.kind == Kind.POLAR)
        label[mine] = files[Path(file).name][plots.record[mine]]
    names = np.array([*(truth.names.index(craft.name) for craft in demo_aircraft()), -1])
    return recording, config, simulated(names[label], plots.time, truth)


def _track(recording: Recording, config: Config, seed: int) -> tuple[npt.NDArray[np.int8], dict[str, Followed]]:
    """Track clean and faulty plots, with the chains of faults as configured and without."""
    faulty = inject(recording.plots, _SHARE, np.random.default_rng(seed))
    without = replace(config.tracker, plot_outlier=0.0, degraded_noise=1.0)
    inputs = {"clean": recording, "injected": replace(recording, plots=faulty.plots)}
    settings = {"with": config, "without": config.model_copy(update={"tracker": without})}
    runs = {}
    with progress_bar() as bar:
        for k, name in enumerate(RUNS):
            what, chains = name.split("_")
            runs[name] = followed(*track_recording(inputs[what], settings[chains]))
            bar.working("tracking four times", (k + 1) / len(RUNS))
    return faulty.fault, runs


def _metrics(
    recording: Recording, fault: npt.NDArray[np.int8], runs: dict[str, Followed], truth: Motion, folder: Path
) -> dict[str, object]:
    plots = recording.plots
    judged = {name: errors(run, truth) for name, run in runs.items()}
    radar = (plots.kind == Kind.POLAR) & (plots.reason == 0)
    draw(folder, {name: parts for name, (_, parts) in judged.items()}, fault, runs["injected_with"], plots.range)
    figures = {name: table for name, (table, _) in judged.items()}
    return {
        "reference": truth.name,
        "units": "knots, degrees, shares of 1",
        "plots": int(radar.sum()),
        "injected": {"share": _SHARE, "azimuth": int((fault == 1).sum()), "range": int((fault == 2).sum())},
        "figures": figures,
        "growth": {
            chains: growth(figures[f"clean_{chains}"], figures[f"injected_{chains}"], own=truth.name == OWN_RUN)
            for chains in ("with", "without")
        },
        "p_fault": found(fault, runs["clean_with"], runs["injected_with"], plots),
        "wanted": _WANTED,
    }


def _show(metrics: dict[str, object]) -> None:
    """Print the table."""
    figures, grown, p = metrics["figures"], metrics["growth"], metrics["p_fault"]
    assert isinstance(figures, dict) and isinstance(grown, dict) and isinstance(p, dict)
    say(f"reference: {metrics['reference']}")
    say(f"{'':32}{'clean':>9}{'faulty':>9}{'growth':>9}{'without chains':>16}{'growth':>9}")
    for name in ("plots_straight", "plots_turn"):
        counts = [figures[run][name] for run in ("clean_with", "injected_with", "injected_without")]
        say(f"{name:32}{counts[0]:9.0f}{counts[1]:9.0f}{'':9}{counts[2]:16.0f}")
    for name in grown["with"]:
        values = [figures[run][name] for run in ("clean_with", "injected_with", "injected_without")]
        more = [grown[chains][name] for chains in ("with", "without")]
        a, b, c = ("–" if v is None else f"{v:.3f}" for v in values)
        x, y = ("–" if v is None else f"{v:+.0%}" for v in more)
        say(f"{name:32}{a:>9}{b:>9}{x:>9}{c:>16}{y:>9}")
    for name, row in p.items():
        if isinstance(row, list):
            say(f"{name}: {', '.join(row) or 'none'}")
            continue
        value = "–" if row["value"] is None else f"{row['value']:.2%}"
        say(f"{name:32}{value:>9} of {row['plots']:.0f} plots")
    for line in _explained(metrics["reference"] == OWN_RUN, figures["clean_with"], p):
        say(line)


def _explained(own: bool, clean: Mapping[str, float | None], p: Mapping[str, object]) -> list[str]:
    """What the labels mean, and why a dash stands where it does."""
    lines = [
        "straight, turn: by the reference, on tracks of 5 plots and more and faster than 100 kt; confirmed: of "
        "confirmed tracks; told, suspected: p_fault above 0.5; left_out: on no track; "
        "airborne: not said to be on the ground."
    ]
    absent = [what for what in ("straight", "turn") if not clean[f"plots_{what}"]]
    if absent:
        lines.append(f"– for {' and '.join(absent)}: there is no such plot whose course and speed the reference knows.")
    if any(isinstance(row, dict) and row["value"] is None for row in p.values()):
        lines.append("– of 0 plots: there is no such plot that updated a track past its start.")
    if own:
        lines.append(
            "– for growth: the reference is the run over clean plots itself, whose errors are none by definition; "
            "the errors are departures from it. --reference names a truth."
        )
    return lines
