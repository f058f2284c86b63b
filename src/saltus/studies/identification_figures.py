"""The figures of the identification experiments."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from saltus.identify import p_correct, p_false
from saltus.studies.identification import ASKED, DIMS, FARTHEST, POINTS, TRUTHS, Bounds, Recursive, Static
from saltus.studies.style import BLUE, GREY, INK, ORANGE, TEAL, new_figure, save

__all__ = ["draw_identification"]

_Array = npt.NDArray[np.float64]
_FINE = np.linspace(0.0, 5.0, 201)
_COLOURS = (INK, BLUE, TEAL, ORANGE, "#a23b72")


def draw_identification(
    folder: Path,
    static: Static,
    recursive: Recursive,
    bins: dict[str, tuple[_Array, _Array, _Array]],
    bounds: Bounds,
) -> None:
    """Draw all figures as PNG into `folder`."""
    for d, dim in enumerate(DIMS):
        _static(folder / f"figure{d + 1}_single_estimates_{dim}d.png", static, d, dim)
    _recursive(folder / "figure3_recursive.png", recursive)
    _calibration(folder / "figure4_calibration.png", bins)
    _bounds(folder / "figure5_false_identification.png", bounds)


def _static(path: Path, static: Static, d: int, dim: int) -> None:
    with new_figure(5.6, f"Single estimates in {dim}-D: curves, and {static.draws} draws (dots)") as figure:
        axes = figure.subplots()
        axes.plot(_FINE, p_correct(_FINE, dim), color=INK, label="P(correct): one object")
        axes.plot(POINTS, static.correct[d], "o", color=INK, ms=4)
        for u, (high, colour) in enumerate(zip(FARTHEST, (ORANGE, TEAL, BLUE), strict=True)):
            axes.plot(_FINE, p_false(_FINE, (0.0, high), dim), color=colour, label=f"mean P(false): λ ~ U(0, {high:g})")
            axes.plot(POINTS, static.false[d, u], "o", color=colour, ms=4)
        axes.set_xlim(0, 5)
        axes.set_ylim(0, 1.01)
        axes.set_xlabel("threshold h, standard deviations of the difference")
        axes.set_ylabel("probability of being declared one object")
        axes.legend(loc="center left", bbox_to_anchor=(0.0, 0.8))
        save(figure, path)


def _recursive(path: Path, recursive: Recursive) -> None:
    runs, _, rows = recursive.llr.shape
    k = np.arange(1, rows + 1)
    with new_figure(7.2, f"The ratio from measurement to measurement ({runs} runs)") as figure:
        share, ratio = figure.subplots(2, 1, sharex=True)
        for s, (truth, colour) in enumerate(zip(TRUTHS, _COLOURS, strict=True)):
            llr = recursive.llr[:, s]
            share.plot(k, (llr >= 0.0).mean(0), color=colour, label=truth)
            low, mid, high = np.quantile(llr, [0.1, 0.5, 0.9], axis=0)
            ratio.fill_between(k, low, high, color=colour, alpha=0.15, lw=0)
            ratio.plot(k, mid, color=colour)
        share.set_ylabel("P(declared one object)")
        share.set_ylim(0, 1.02)
        ratio.axhline(0.0, color=GREY, lw=0.8)
        ratio.set_ylim(-40, 12)
        ratio.set_ylabel("log-likelihood ratio, nats\n(median, 80 % of the runs)")
        ratio.set_xlabel("measurements, 50 m and 100 m in turn")
        ratio.set_xlim(1, rows)
        ratio.set_xticks([1, 5, 10, 15, 20])
        figure.align_ylabels([share, ratio])
        figure.legend(*share.get_legend_handles_labels(), loc="outside lower left", ncols=3)
        save(figure, path)


def _calibration(path: Path, bins: dict[str, tuple[_Array, _Array, _Array]]) -> None:
    with new_figure(6.6, "Calibration: how often pairs are one object that are given this probability") as figure:
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1], color=GREY, lw=1, label="honest")
        labels = {"linear": "linear, 6 measurements", "multimode": "multimode with offset, 8 measurements, prior 1e-3"}
        for (name, (stated, share, error)), colour, mark in zip(bins.items(), (BLUE, ORANGE), "os", strict=True):
            axes.errorbar(
                stated, share, 2 * error, fmt=mark, color=colour, ms=6, lw=1.2, label=f"{labels[name]}, ± 2 SE"
            )
        axes.set_xlim(0, 1)
        axes.set_ylim(0, 1)
        axes.set_aspect("equal")
        axes.set_xlabel("stated probability of one object")
        axes.set_ylabel("share of pairs that are one")
        axes.legend(loc="upper left")
        save(figure, path)


def _bounds(path: Path, bounds: Bounds) -> None:
    asked = np.array(ASKED)
    observed = bounds.reached / bounds.pairs
    error = np.sqrt(np.maximum(bounds.reached, 1.0)) / bounds.pairs
    with new_figure(5.6, "False identifications: observed over asked for, multimode") as figure:
        axes = figure.subplots()
        axes.axhline(1.0, color=GREY, lw=1)
        axes.errorbar(
            asked * 1.06, observed / asked, 2 * error / asked, fmt="o", color=BLUE, ms=6, label="plain pairs, ± 2 SE"
        )
        axes.errorbar(
            asked / 1.06,
            bounds.fresh / asked,
            2 * bounds.fresh_error / asked,
            fmt="s",
            color=ORANGE,
            ms=6,
            label="another weighted sample, ± 2 SE",
        )
        axes.set_xscale("log")
        axes.set_ylim(0, 2)
        axes.set_xlabel("probability asked for")
        axes.set_ylabel("observed / asked for")
        axes.legend(loc="upper right")
        save(figure, path)
