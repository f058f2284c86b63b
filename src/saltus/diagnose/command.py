"""`saltus diagnose noise`: correlation time and level of a sensor's errors, a picture and a suggestion."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from saltus.config import load_config
from saltus.diagnose.figure import draw_noise
from saltus.diagnose.fit import NoiseFit, Parameter, fit_noise
from saltus.diagnose.residuals import Phase, Residuals, from_recordings, from_table
from saltus.errors import DataError
from saltus.io.write import output_directory, write_json
from saltus.text import say

__all__ = ["diagnose_noise"]


def diagnose_noise(
    inputs: Sequence[Path],
    output: Path,
    *,
    reference: Sequence[Path] = (),
    config_path: Path | None = None,
    date: str | None = None,
    framing: str | None = None,
    columns: Sequence[str] = (),
    series: str | None = None,
    motion: bool = False,
    phase: Phase = "all",
) -> dict[str, NoiseFit]:
    """Fit noise to residuals, write `noise.json` and `noise.png`, and say what was found.

    Args:
        inputs: recordings, or one table.
        output: directory to write into.
        reference: recordings of better positions of the same aircraft; then `inputs` are recordings too.
        config_path: TOML configuration with sites and editions, for recordings.
        date: YYYY-MM-DD of the recordings.
        framing: of ASTERIX recordings, one of `saltus.framing.NAMES`; None has it guessed.
        columns: of the table: residuals, or positions with `motion`.
        series: column of the table that tells objects or passes apart.
        motion: the columns are positions.
        phase: of recordings, reports in the air or on the ground only: errors differ between them.

    Returns:
        One fit for each component.

    Raises:
        DataError: an input cannot be read or is too short, or neither columns nor a reference is given.
        ModelError: the configuration is wrong.
    """
    if bool(reference) == bool(columns):
        raise DataError("give either --reference RECORDING, or --columns of a table that holds residuals.")
    if columns and len(inputs) != 1:
        raise DataError(f"--columns reads one table, not {len(inputs)}.")
    if reference:
        config = load_config(config_path, date=date, framing=framing)
        found = from_recordings(inputs, reference, config, phase)
    else:
        found = from_table(inputs[0], columns, series)
    fits = {}
    for i, name in enumerate(found.names):
        there = np.isfinite(found.values[:, i])
        try:
            fits[name] = fit_noise(found.times[there], found.values[there, i], found.labels[there], motion=motion)
        except DataError as error:
            raise DataError(f"{', '.join(map(str, inputs))}: {name}: {error}") from error
    with output_directory(output, "noise") as folder:
        write_json(folder / "noise.json", {name: _tree(fit) for name, fit in fits.items()})
        if not motion:
            draw_noise(folder / "noise.png", found, fits)
    _show(found, fits, output)
    return fits


def _tree(fit: NoiseFit) -> dict[str, object]:
    out: dict[str, object] = {}
    for name, value in fit._asdict().items():
        if isinstance(value, Parameter):
            out[name] = value._asdict()
        else:
            out[name] = None if isinstance(value, float) and not np.isfinite(value) else value
    return {**out, "suggestion": fit.suggestion()}


def _show(found: Residuals, fits: dict[str, NoiseFit], output: Path) -> None:
    unit = f" {found.unit}" if found.unit else ""
    for name, fit in fits.items():
        say(
            f"{name}: {fit.n_values} values of {fit.n_series} series every {fit.interval:.3g} s "
            f"({fit.n_outliers} outliers left out)"
        )
        say(f"  correlation time {_said(fit.tau)} s, coloured part {_said(fit.sigma)}{unit}")
        say(f"  white part {_said(fit.white)}{unit}" + ("" if np.isnan(fit.bias) else f", bias {fit.bias:.4g}{unit}"))
        say(
            f"  {fit.verdict}; log-likelihood {fit.gain:.1f} above white noise; "
            f"successive innovations correlate {fit.lag1_white:+.2f} as white, {fit.lag1_coloured:+.2f} as coloured"
        )
        if np.isfinite(fit.overconfidence):
            say(f"  the mean of 10 errors varies {fit.overconfidence:.1f} times as much as white noise promises")
        say(f"  suggested noise: {fit.suggestion()}")
        if fit.verdict != "unexplained":
            say(f"  {_meaning(fit, found.unit)}")
    say(f"written to {output}/")


def _meaning(fit: NoiseFit, unit: str) -> str:
    """What the arguments of the suggestion are: sigma and white are not of one kind."""
    variance = f"a variance in {unit}^2" if unit else "a variance in the square of the column's unit"
    if fit.verdict == "white":
        return f"(R: {variance})"
    deviation = f"a standard deviation in {unit}" if unit else "a standard deviation in the column's unit"
    white = f"; white: {variance}" if fit.white.value > 0 else ""
    return f"(tau: s; sigma: {deviation}{white})"


def _said(p: Parameter) -> str:
    if p.low is None or p.high is None:
        return f"{p.value:.4g}" + (" (not bounded by these data)" if p.value > 0 else "")
    return f"{p.value:.4g} ({p.low:.4g} to {p.high:.4g})"
