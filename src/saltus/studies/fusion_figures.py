"""The figures of the fusion experiment."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from saltus.studies.fusion import CHAINS, FILTERS, STEPS, Trial, fixed_chains
from saltus.studies.style import BLUE, GREY, INK, LIGHT, ORANGE, TEAL, new_figure, save, shade

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_fusion"]

_NAMES = ("φ, mrad", "ω, mrad/s", "V, m/s", "J, m/s²")
_SCALE = np.array([1e3, 1e3, 1.0, 1.0])
_MEANING = ("A: manoeuvre", "B: active sensor", "C: passive sensor")
_COLOURS = {"adaptive": BLUE, "nominal": ORANGE, "clairvoyant": TEAL}
_TIME = np.arange(1, STEPS + 1)

_Array = npt.NDArray[np.float64]


def draw_fusion(folder: Path, test: Trial, curve: tuple[_Array, _Array, _Array]) -> None:
    """Draw all figures as PNG into `folder`: three of the test chains, one of a calibration curve."""
    _one_run(folder / "figure1_one_run.png", test)
    _errors(folder / "figure2_errors.png", test)
    _probabilities(folder / "figure3_probabilities.png", test)
    _calibration(folder / "figure4_calibration.png", curve)


def _one_run(path: Path, trial: Trial) -> None:
    truth, said = trial.states[0] * _SCALE, trial.estimate[0] * _SCALE
    with new_figure(10.4, "State and chains in one run: truth, adaptive and nominal filter") as figure:
        panels = figure.subplots(5, 1, sharex=True, height_ratios=[1, 1, 1, 1, 1.35])
        for s, axes in enumerate(panels[:4]):
            _shade_chains(axes)
            axes.plot(_TIME, said[1, :, s], color=ORANGE, lw=1.2, label="nominal filter")
            axes.plot(_TIME, truth[:, s], color=INK, lw=2.4, label="truth")
            axes.plot(_TIME, said[0, :, s], color=BLUE, lw=1.2, label="adaptive filter")
            axes.set_ylabel(_NAMES[s])
        _name_chains(panels[0])
        _lanes(panels[4], trial.marginals[0])
        panels[4].set_xlabel("step (1 s)")
        panels[4].set_xlim(0, STEPS)
        figure.align_ylabels(panels)
        handles, labels = panels[0].get_legend_handles_labels()
        more, names = panels[4].get_legend_handles_labels()
        figure.legend(handles + more, labels + names, loc="outside lower left", ncols=5)
        save(figure, path)


def _lanes(axes: "Axes", prob: _Array) -> None:
    """Draw each chain in its own lane: the true second state as a bar, its probability as a curve."""
    step = 1.25
    for c in range(3):
        base = (2 - c) * step
        on = fixed_chains()[:, c] == 1
        axes.fill_between(
            _TIME - 0.5, base, base + on, step="post", color=LIGHT, lw=0, label="true second state" if c == 0 else None
        )
        axes.plot(_TIME, base + prob[:, c], color=BLUE, lw=1.2, label="its probability" if c == 0 else None)
        axes.axhline(base, color=GREY, lw=0.6)
    axes.set_yticks([(2 - c) * step + 0.5 for c in range(3)], CHAINS)
    axes.set_ylim(-0.1, 2 * step + 1.1)
    axes.set_ylabel("chain")
    axes.grid(False, axis="y")
    axes.tick_params(axis="y", length=0)


def _errors(path: Path, trial: Trial) -> None:
    rms = np.sqrt(np.mean(np.square(trial.estimate - trial.states[:, None]), axis=0)) * _SCALE
    with new_figure(9.2, f"Errors of three filters (RMS over {len(trial.states)} runs)") as figure:
        panels = figure.subplots(4, 1, sharex=True)
        for s, axes in enumerate(panels):
            _shade_chains(axes)
            for name in ("nominal", "clairvoyant", "adaptive"):
                axes.plot(_TIME, rms[FILTERS.index(name), :, s], color=_COLOURS[name], lw=1.4, label=name)
            axes.set_ylabel(_NAMES[s])
            if s < 2:  # the nominal filter is wrong by a factor of a hundred here
                axes.set_yscale("log")
                ticks = [2, 5, 10, 20, 50, 100, 200] if s == 0 else [5, 10, 20, 50]
                axes.set_yticks(ticks, [str(tick) for tick in ticks])
                axes.minorticks_off()
            else:
                axes.set_ylim(0)
        _name_chains(panels[0])
        panels[3].set_xlabel("step (1 s)")
        panels[3].set_xlim(0, STEPS)
        figure.align_ylabels(panels)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower left", ncols=3)
        save(figure, path)


def _probabilities(path: Path, trial: Trial) -> None:
    low, high = np.quantile(trial.marginals, [0.1, 0.9], axis=0)
    with new_figure(7.2, f"Probability of each chain's second state ({len(trial.states)} runs)") as figure:
        panels = figure.subplots(3, 1, sharex=True, sharey=True)
        for c, axes in enumerate(panels):
            shade(axes, _TIME, fixed_chains()[:, c] == 1, "true second state")
            axes.fill_between(_TIME, low[:, c], high[:, c], color=BLUE, alpha=0.22, lw=0, label="80 % of the runs")
            axes.plot(_TIME, trial.marginals[..., c].mean(0), color=BLUE, label="mean over the runs")
            axes.set_ylim(0, 1)
            axes.set_yticks([0, 0.5, 1])
            axes.set_ylabel(_MEANING[c])
        panels[2].set_xlabel("step (1 s)")
        panels[2].set_xlim(0, STEPS)
        figure.align_ylabels(panels)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower left", ncols=3)
        save(figure, path)


def _calibration(path: Path, curve: tuple[_Array, _Array, _Array]) -> None:
    with new_figure(6.6, "Calibration: how often a state is true that is given this probability") as figure:
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1], color=GREY, lw=1, label="honest")
        for c, (colour, mark) in enumerate(zip((BLUE, ORANGE, TEAL), "os^", strict=True)):
            stated, observed, error = (part[c] for part in curve)
            axes.errorbar(
                stated, observed, 2 * error, fmt=mark, color=colour, ms=6, lw=1.2, label=f"{_MEANING[c]}, ± 2 SE"
            )
        axes.set_xlim(0, 1)
        axes.set_ylim(0, 1)
        axes.set_aspect("equal")
        axes.set_xlabel("stated probability of the second state (chains drawn from the model)")
        axes.set_ylabel("share of steps where it is true")
        axes.legend(loc="upper left")
        save(figure, path)


def _shade_chains(axes: "Axes") -> None:
    for c in range(3):
        shade(axes, _TIME, fixed_chains()[:, c] == 1)


def _name_chains(axes: "Axes") -> None:
    for at, name in ((59.5, "B"), (105, "C"), (134.5, "A"), (169.5, "A"), (124.5, "A, C")):
        axes.annotate(name, (at, 1.0), xycoords=("data", "axes fraction"), ha="center", va="bottom", color=GREY)
