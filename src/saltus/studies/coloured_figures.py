"""The pictures of the experiment with coloured noise."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from saltus.studies.coloured import FILTERS, STEPS, Trial
from saltus.studies.style import BLUE, GREY, INK, ORANGE, TEAL, new_figure, save, shade

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_paper", "draw_value"]

_DT = 0.5  # s
_COLOUR = {"adaptive": BLUE, "nominal": ORANGE, "clairvoyant": INK, "white": TEAL}
_LABEL = {"adaptive": "adaptive", "nominal": "nominal", "clairvoyant": "told the modes", "white": "colour ignored"}

_Array = npt.NDArray[np.float64]


def draw_paper(folder: Path, trial: Trial) -> None:
    """Draw one run of the published experiment, and the errors of all, as PNG into `folder`."""
    _one_run(folder / "figure1_one_run.png", trial)
    _errors(folder / "figure2_errors.png", trial)


def _one_run(path: Path, trial: Trial) -> None:
    time = _DT * np.arange(1, STEPS + 1)
    x, mean = trial.states[0], trial.estimate[0, FILTERS.index("adaptive")]
    with new_figure(9.4, "One run: jumps of the agitation and of the noise") as figure:
        panels = figure.subplots(4, 1, sharex=True, height_ratios=[1.5, 1.2, 0.8, 0.8])
        panels[0].plot(time, trial.z[0, :, 0], ".", ms=2.6, color=GREY, label="measured")
        for i, axes in enumerate(panels[:2]):
            axes.plot(time, x[:, i], color=INK, lw=1.3, label="true")
            axes.plot(time, mean[:, i], color=BLUE, lw=1.3, label="estimated")
        panels[0].set_ylabel("position x")
        panels[1].set_ylabel("velocity v, 1/s")
        for chain, axes in enumerate(panels[2:]):
            prob = trial.probs[:, 0].sum(axis=3 - chain)[..., 1]
            shade(axes, time, trial.modes[0, :, chain] == 1, "true")
            axes.plot(time, prob.mean(0), color=BLUE, label="mean over the runs")
            axes.plot(time, prob[0], color=GREY, lw=0.8, label="this run")
            axes.set_ylim(0, 1)
            axes.set_yticks([0, 0.5, 1])
        panels[2].set_ylabel("P(agitated)")
        panels[3].set_ylabel("P(noisy)")
        panels[3].set_xlabel("time, s")
        panels[3].set_xlim(0, time[-1])
        figure.align_ylabels(panels)
        handles, labels = panels[0].get_legend_handles_labels()
        more, names = panels[2].get_legend_handles_labels()
        names[0] = "true interval"
        figure.legend(handles + more, labels + names, loc="outside lower left", ncols=6)
        save(figure, path)


def _errors(path: Path, trial: Trial) -> None:
    time = _DT * np.arange(1, STEPS + 1)
    errors = trial.estimate - trial.states[:, None]
    rms = np.sqrt(np.square(errors).mean(axis=0))
    with new_figure(6.4, f"Root mean square errors over {len(errors)} runs") as figure:
        panels = figure.subplots(2, 1, sharex=True)
        for i, axes in enumerate(panels):
            for chain in range(2):
                shade(axes, time, trial.modes[0, :, chain] == 1, "agitated, then noisy" if chain == 0 else None)
            for f, name in enumerate(FILTERS):
                if name != "white":  # at the published sampling it lies on the adaptive one
                    axes.plot(time, rms[f, :, i], color=_COLOUR[name], lw=1.3, label=_LABEL[name])
            axes.set_ylim(0)
        panels[0].set_ylabel("position x")
        panels[1].set_ylabel("velocity v, 1/s")
        panels[1].set_xlabel("time, s")
        panels[1].set_xlim(0, time[-1])
        figure.align_ylabels(panels)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower left", ncols=4)
        save(figure, path)


def draw_value(folder: Path, value: Mapping[str, Any]) -> None:
    """Draw what modelling the colour is worth against the noise's correlation time, as PNG into `folder`."""
    tau = np.array([1.0 / float(rate) for rate in value])
    with new_figure(6.4, "Value of modelling the colour") as figure:
        (position, velocity), (honesty, mode) = figure.subplots(2, 2, sharex=True)
        for name in FILTERS:
            for i, (axes, state) in enumerate(((position, "x"), (velocity, "v"))):
                if i == 0 or name != "nominal":
                    _line(axes, tau, [v["rmse"][name][state] for v in value.values()], name)
            if name in ("adaptive", "white"):
                _line(honesty, tau, [v["nees"][name] for v in value.values()], name)
                _line(mode, tau, [v["map_mode_correct"][name] for v in value.values()], name)
        honesty.axhline(2.0, color=GREY, lw=1, ls="--")
        honesty.annotate("honest", (tau[0], 2.0), xytext=(0, -12), textcoords="offset points", color=GREY, fontsize=9)
        titles = ("RMSE of position x", "RMSE of velocity v, 1/s", "NEES (2 expected)", "share of right MAP modes")
        for axes, title in zip((position, velocity, honesty, mode), titles, strict=True):
            axes.set_title(title, fontsize=10, fontweight="normal")
            axes.set_xscale("log")
            axes.set_xticks(tau, [f"{t:.2g}" for t in tau])
            axes.minorticks_off()
        honesty.set_ylim(0)
        mode.set_ylim(0)
        for axes in (honesty, mode):
            axes.set_xlabel("correlation time of the noise / that of the state")
        handles, labels = position.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower left", ncols=4)
        save(figure, folder / "figure3_value_of_colour.png")


def _line(axes: "Axes", tau: _Array, figures: list[dict[str, float]], name: str) -> None:
    axes.plot(tau, [f["value"] for f in figures], "o-", ms=4, color=_COLOUR[name], lw=1.4, label=_LABEL[name])
    axes.fill_between(
        tau, [f["low"] for f in figures], [f["high"] for f in figures], color=_COLOUR[name], alpha=0.18, lw=0
    )
