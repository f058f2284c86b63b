"""The six figures of the radar experiment."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

from saltus.geo import spherical_to_cartesian
from saltus.simulate import Motion, radar_paper_trajectory
from saltus.studies.radar import FILTERS, SIGMA, Scene, Trial
from saltus.studies.style import BLUE, GREY, INK, ORANGE, TEAL, new_figure, save, shade

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_radar"]

_AXES = ("x", "y", "z")
_RANGES = ((250e3, BLUE), (140e3, TEAL), (30e3, ORANGE))  # m

_Array = npt.NDArray[np.float64]


def draw_radar(folder: Path, truth: Scene, trial: Trial) -> None:
    """Draw all figures as PNG into `folder`."""
    _horizontal_errors(folder / "figure1_horizontal_errors.png")
    _vertical_errors(folder / "figure2_vertical_errors.png")
    _trajectory(folder / "figure3_trajectory.png", truth, trial)
    _estimates(folder / "figure4_estimates.png", truth, trial)
    _predictions(folder / "figure5_predictions.png", truth, trial)
    _manoeuvres(folder / "figure6_manoeuvres_and_gates.png", truth, trial)


def _horizontal_errors(path: Path) -> None:
    azimuth = np.linspace(0.0, 90.0, 181)
    with new_figure(7.2, "Converted measurement: horizontal errors at elevation 0°") as figure:
        panels = figure.subplots(3, 1, sharex=True)
        for r, colour in _RANGES:
            cov = spherical_to_cartesian(r, np.radians(azimuth), 0.0, *SIGMA)[1]
            curves = (np.sqrt(cov[:, 0, 0]), np.sqrt(cov[:, 1, 1]), _correlation(cov, 0, 1))
            for axes, y in zip(panels, curves, strict=True):
                axes.plot(azimuth, y, color=colour, label=f"range {r / 1e3:.0f} km")
        _name(panels, ("σx, m", "σy, m", "correlation γxy"))
        panels[0].set_ylim(0)
        panels[1].set_ylim(0)
        panels[2].set_ylim(-1, 1)
        panels[2].set_xlabel("azimuth from the x axis, degrees")
        panels[2].set_xlim(0, 90)
        panels[2].set_xticks(np.arange(0, 91, 15))
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower left", ncols=3)
        save(figure, path)


def _vertical_errors(path: Path) -> None:
    elevation = np.linspace(0.0, 90.0, 361)
    with new_figure(7.2, "Converted measurement: vertical errors at azimuth 60°") as figure:
        panels = figure.subplots(3, 1, sharex=True)
        for r, colour in _RANGES:
            cov = spherical_to_cartesian(r, np.radians(60.0), np.radians(elevation), *SIGMA)[1]
            curves = (np.sqrt(cov[:, 2, 2]), _correlation(cov, 0, 2), _correlation(cov, 1, 2))
            for axes, y in zip(panels, curves, strict=True):
                axes.plot(elevation, y, color=colour, label=f"range {r / 1e3:.0f} km")
        _name(panels, ("σz, m", "correlation γxz", "correlation γyz"))
        panels[0].set_ylim(0)
        for axes in panels[1:]:
            axes.set_ylim(-1, 1)
        panels[2].set_xlabel("elevation, degrees")
        panels[2].set_xlim(0, 90)
        panels[2].set_xticks(np.arange(0, 91, 15))
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower left", ncols=3)
        save(figure, path)


def _trajectory(path: Path, truth: Scene, trial: Trial) -> None:
    way, seen = radar_paper_trajectory(), trial.measurement[0] / 1e3
    with new_figure(8.6, "Trajectory, and the measurements of one run") as figure:
        plan, height = figure.subplots(2, 1, height_ratios=[2.6, 1.0])
        plan.plot(seen[:, 0], seen[:, 1], "o", ms=3, mfc="none", mec=GREY, mew=0.8, label="measurement")
        _, km = _curve(way, slice(None))
        plan.plot(km[:, 0], km[:, 1], color=BLUE, label="true position")
        for part in _intervals(way.turning):
            _, km = _curve(way, part)
            plan.plot(km[:, 0], km[:, 1], color=ORANGE, lw=3, label="turn")
        plan.plot(0, 0, marker="^", ms=9, color=INK, ls="none", label="radar")
        plan.annotate("start", way.position[0, :2] / 1e3, (8, 0), textcoords="offset points")
        plan.set_aspect("equal", adjustable="datalim")
        plan.set_xlabel("x, km")
        plan.set_ylabel("y, km")
        _legend_once(plan, "lower right")
        height.plot(truth.time, seen[:, 2], "o", ms=3, mfc="none", mec=GREY, mew=0.8)
        time, km = _curve(way, slice(None))
        height.plot(time, km[:, 2], color=BLUE)
        for part in _intervals(way.climbing):
            time, km = _curve(way, part)
            height.plot(time, km[:, 2], color=TEAL, lw=3, label="vertical manoeuvre")
        height.set_xlabel("time, s")
        height.set_ylabel("z, km")
        height.set_xlim(0, truth.time[-1])
        _legend_once(height, "upper right")
        save(figure, path)


def _curve(way: Motion, part: slice) -> tuple[_Array, _Array]:
    """Draw-ready time (s) and position (km) between the scans: the cubic through positions and velocities."""
    from scipy.interpolate import CubicHermiteSpline

    t = way.time[part]
    fine = np.linspace(t[0], t[-1], 10 * (len(t) - 1) + 1)
    return fine, np.asarray(CubicHermiteSpline(t, way.position[part], way.velocity[part])(fine)) / 1e3


def _estimates(path: Path, truth: Scene, trial: Trial) -> None:
    curves = (
        (_rms(trial.measurement - truth.position), "measurement", GREY, "-"),
        (_rms(trial.estimate[:, FILTERS.index("adaptive")] - truth.position), "estimate, adaptive filter", BLUE, "-"),
    )
    title = f"Errors of estimate and measurement (RMS over {len(trial.measurement)} runs)"
    _stacked(path, truth, curves, title, "RMSE")


def _predictions(path: Path, truth: Scene, trial: Trial) -> None:
    i, k = FILTERS.index("adaptive"), FILTERS.index("kalman_steady")
    curves = (
        (_rms(trial.prediction[:, k] - truth.position), "RMSE, Kalman filter for steady flight", GREY, "-"),
        (_rms(trial.prediction[:, i] - truth.position), "RMSE, adaptive filter", BLUE, "-"),
        (_rms(trial.prediction_sd[:, i]), "standard deviation the adaptive filter computes", ORANGE, "--"),
    )
    _stacked(path, truth, curves, f"One-scan predictions (RMS over {len(trial.measurement)} runs)", "prediction error")


def _stacked(
    path: Path, truth: Scene, curves: tuple[tuple[_Array, str, str, str], ...], title: str, quantity: str
) -> None:
    """Draw curves (T, 3) in time, one panel per axis, manoeuvres shaded."""
    with new_figure(8.2, title) as figure:
        panels = figure.subplots(3, 1, sharex=True)
        for c, axes in enumerate(panels):
            flags = truth.climbing if c == 2 else truth.turning
            shade(axes, truth.time, flags, "turn (x, y), vertical manoeuvre (z)")
            for values, label, colour, line in curves:
                axes.plot(truth.time, values[:, c], line, color=colour, label=label)
            axes.set_ylim(0)
        _name(panels, [f"{quantity} in {axis}, m" for axis in _AXES])
        panels[2].set_xlabel("time, s")
        panels[2].set_xlim(0, truth.time[-1])
        figure.legend(
            *panels[0].get_legend_handles_labels(), loc="outside lower left", ncols=3 if len(curves) == 2 else 2
        )
        save(figure, path)


def _manoeuvres(path: Path, truth: Scene, trial: Trial) -> None:
    i = FILTERS.index("adaptive")
    noise = np.diagonal(trial.noise_cov, axis1=-2, axis2=-1)
    gate = 3 * np.sqrt(np.square(trial.prediction_sd[:, i]) + noise)[0]
    off = (trial.measurement - trial.prediction[:, i])[0]
    rows = (("P", 0), ("gate", 0), ("gate", 1), ("P", 1), ("gate", 2))
    with new_figure(10.6, "Probability of manoeuvre, and three-sigma gates of one run") as figure:
        panels = figure.subplots(5, 1, sharex=True)
        for axes, (what, c) in zip(panels, rows, strict=True):
            vertical = axes in (panels[3], panels[4])
            shade(axes, truth.time, truth.climbing if vertical else truth.turning, "manoeuvre")
            if what == "P":
                _probability(axes, truth.time, trial.prob_manoeuvre[..., c])
                axes.set_ylabel("P, vertical" if vertical else "P, horizontal")
            else:
                _gate(axes, truth.time, off[:, c] / 1e3, gate[:, c] / 1e3)
                axes.set_ylabel(f"{_AXES[c]} − prediction, km")
        panels[4].set_xlabel("time, s")
        panels[4].set_xlim(0, truth.time[-1])
        figure.align_ylabels(panels)
        handles, labels = panels[0].get_legend_handles_labels()
        more, names = panels[1].get_legend_handles_labels()
        figure.legend(handles + more[1:], labels + names[1:], loc="outside lower left", ncols=3)
        save(figure, path)


def _probability(axes: "Axes", time: _Array, prob: _Array) -> None:
    low, high = np.quantile(prob, [0.1, 0.9], axis=0)
    axes.fill_between(time, low, high, color=BLUE, alpha=0.22, lw=0, label="80 % of the runs")
    axes.plot(time, prob.mean(0), color=BLUE, label="mean over the runs")
    axes.set_ylim(0, 1)
    axes.set_yticks([0, 0.5, 1])


def _gate(axes: "Axes", time: _Array, off: _Array, gate: _Array) -> None:
    inside, limit = np.abs(off) <= gate, 1.15 * float(np.max(np.maximum(gate, np.abs(off))))
    axes.set_ylim(-limit, limit)
    axes.locator_params(axis="y", nbins=5, steps=[1, 2, 5, 10])
    axes.plot(time, gate, color=INK, lw=1, label="gate")
    axes.plot(time, -gate, color=INK, lw=1)
    axes.plot(time[inside], off[inside], "o", ms=3.2, color=BLUE, label="measurement inside")
    axes.plot(time[~inside], off[~inside], "X", ms=7, color=ORANGE, label="measurement outside")


def _name(panels: "npt.NDArray[np.object_]", names: "tuple[str, ...] | list[str]") -> None:
    for axes, name in zip(panels, names, strict=True):
        axes.set_ylabel(name)
    panels[0].figure.align_ylabels(panels)


def _legend_once(axes: "Axes", place: Literal["lower right", "upper right"]) -> None:
    handles, labels = axes.get_legend_handles_labels()
    first = [labels.index(label) for label in dict.fromkeys(labels)]
    axes.legend([handles[i] for i in first], [labels[i] for i in first], loc=place)


def _intervals(flags: npt.NDArray[np.bool_]) -> list[slice]:
    """Slices of the points that bound each flagged run of scans, the one before included."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return [slice(max(int(start) - 1, 0), int(stop)) for start, stop in edges.reshape(-1, 2)]


def _rms(errors: _Array) -> _Array:
    return np.asarray(np.sqrt(np.mean(np.square(errors), axis=0)))


def _correlation(cov: _Array, i: int, j: int) -> _Array:
    return np.asarray(cov[..., i, j] / np.sqrt(cov[..., i, i] * cov[..., j, j]))
