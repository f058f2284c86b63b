"""The figures of the switching diffusions."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from saltus.filters import GridDensity, MomentFilter
from saltus.studies.moments import FILTERS, Outcome
from saltus.studies.style import BLUE, GREY, INK, LIGHT, ORANGE, TEAL, new_figure, save, shade

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_moments"]

_Array = npt.NDArray[np.float64]

_TITLES = {
    "a1": "a1: double well, weak sensor",
    "a2": "a2: double well, cubic sensor",
    "b": "b: two linear modes, state kept",
    "br": "br: state drawn anew",
    "c": "c: range and bearing",
}
_SHOWN = 8  # runs among which a bent posterior is looked for
_CURVES = (("gaussian2", ORANGE, "order 2"), ("maxent4", BLUE, "maximum entropy 4"), ("hermite4", TEAL, "Hermite 4"))


def draw_moments(folder: Path, outcomes: dict[str, Outcome]) -> None:
    """Draw all figures as PNG into `folder`."""
    _densities(folder / "figure1_densities.png", outcomes)
    _orders(folder / "figure2_orders.png", outcomes)
    _trajectory(folder / "figure3_trajectory.png", outcomes["a1"])
    _plane(folder / "figure4_plane.png", outcomes["c"])


def _bent(outcome: Outcome) -> tuple[int, int]:
    """A run and a step at which the posterior, over all modes, is far from a Gaussian."""
    z = outcome.draws.z[:_SHOWN]
    plain = FILTERS["gaussian2"].run(outcome.case.model, outcome.case.sensor, z, outcome.case.times)
    off = np.abs(plain.mean - outcome.reference.mean[:_SHOWN]).max(axis=-1)
    spread = np.sqrt(np.diagonal(outcome.reference.cov[:_SHOWN], axis1=-2, axis2=-1)).max(axis=-1)
    run, step = np.unravel_index(int((off[:, 5:] * spread[:, 5:]).argmax()), off[:, 5:].shape)
    return int(run), int(step) + 5


def _grid_density(outcome: Outcome, run: int, step: int) -> GridDensity:
    case, z = outcome.case, outcome.draws.z[run : run + 1, : step + 1]
    found = case.reference.densities(case.model, case.sensor, z, case.times[: step + 1])
    return found._replace(probs=found.probs[:, -1:])


def _closure(outcome: Outcome, name: str, run: int, step: int, y: _Array) -> _Array:
    one, case = FILTERS[name], outcome.case
    if not isinstance(one, MomentFilter):
        raise AssertionError("only a moment filter has a closure")
    history = one.follow(case.model, case.sensor, outcome.draws.z[run : run + 1, : step + 1], case.times[: step + 1])
    return np.asarray(np.exp(history.posterior.log_pdf(y))[0])


def _densities(path: Path, outcomes: dict[str, Outcome]) -> None:
    with new_figure(7.4, "Posterior densities where they are far from Gaussian") as figure:
        panels = figure.subplots(2, 2)
        for axes, name in zip(panels.flat, ("a1", "a2", "b", "br"), strict=True):
            outcome = outcomes[name]
            run, step = _bent(outcome)
            found = _grid_density(outcome, run, step)
            y, true = found.axes[0], found.density[0, 0].sum(axis=0)
            axes.fill_between(y, true, color=LIGHT, lw=0)
            axes.plot(y, true, color=INK, lw=2.2, label="grid: the posterior itself")
            highest = true.max()
            for label, colour, words in _CURVES:
                density = _closure(outcome, label, run, step, y[:, None])
                axes.plot(y, density, color=colour, lw=1.3, label=words)
                highest = max(highest, density.max())
            seen = y[true > 1e-3 * true.max()]
            axes.set_xlim(seen[0] - 0.4, seen[-1] + 0.4)
            axes.set_ylim(0, min(1.08 * highest, 2.2 * true.max()))
            axes.set_title(_TITLES[name])
            axes.set_xlabel("state")
        for axes in panels[:, 0]:
            axes.set_ylabel("density")
        figure.legend(*panels.flat[0].get_legend_handles_labels(), loc="outside lower left", ncols=4)
        save(figure, path)


def _orders(path: Path, outcomes: dict[str, Outcome]) -> None:
    lines = (
        ("maximum entropy", BLUE, "o-", {2: "gaussian2", 4: "maxent4", 6: "maxent6"}),
        ("Hermite, protected", TEAL, "s-", {2: "gaussian2", 3: "hermite3", 4: "hermite4", 6: "hermite6"}),
        ("Hermite, raw", ORANGE, "^--", {2: "gaussian2", 3: "raw_hermite3", 4: "raw_hermite4", 6: "raw_hermite6"}),
    )
    with new_figure(6.6, "Error of the mean against the order of the moments") as figure:
        panels = figure.subplots(2, 3, sharey=True)
        for axes, (name, outcome) in zip(panels.flat, outcomes.items(), strict=False):
            for words, colour, style, points in lines:
                value = [outcome.filters[label].mean_err for label in points.values()]
                axes.plot(list(points), value, style, color=colour, ms=5, lw=1.4, label=words)
            axes.axhline(outcome.filters["sum4"].mean_err, color=GREY, ls=":", lw=1.4, label="four Gaussians a mode")
            axes.axhline(outcome.filters["grid_coarse"].mean_err, color=GREY, lw=1.0, label="coarse grid")
            axes.set_yscale("log")
            axes.set_xticks([2, 3, 4, 6])
            axes.set_title(_TITLES[name], fontsize=9)
            axes.set_xlabel("order")
        panels.flat[-1].set_axis_off()
        panels.flat[-1].legend(*panels.flat[0].get_legend_handles_labels(), loc="center", frameon=False)
        for axes in panels[:, 0]:
            axes.set_ylabel("error, posterior σ")
        save(figure, path)


def _trajectory(path: Path, outcome: Outcome) -> None:
    run = int(np.argmax([np.count_nonzero(np.diff(modes)) for modes in outcome.draws.modes[:_SHOWN]]))
    case, z = outcome.case, outcome.draws.z[run : run + 1]
    four = FILTERS["maxent4"].run(case.model, case.sensor, z, case.times)
    two = FILTERS["gaussian2"].run(case.model, case.sensor, z, case.times)
    t, second = case.times, outcome.draws.modes[run] == 1
    with new_figure(6.4, "A switching double well (a1): state and probability of its linear mode") as figure:
        top, low = figure.subplots(2, 1, sharex=True, height_ratios=[1.5, 1])
        for axes in (top, low):
            shade(axes, t, second, "linear mode holds")
        mean, sd = four.mean[0, :, 0], np.sqrt(four.cov[0, :, 0, 0])
        top.fill_between(t, mean - 2 * sd, mean + 2 * sd, color=BLUE, alpha=0.15, lw=0, label="± 2 σ")
        top.plot(t, z[0, :, 0], ".", color=GREY, ms=4, label="measurements")
        top.plot(t, outcome.draws.states[run, :, 0], color=INK, lw=2.2, label="truth")
        top.plot(t, mean, color=BLUE, lw=1.5, label="maximum entropy 4")
        top.set_ylabel("state")
        low.plot(t, outcome.reference.probs[run, :, 1], color=GREY, lw=4.5, alpha=0.6, label="grid")
        low.plot(t, two.probs[0, :, 1], color=ORANGE, lw=1.3, label="order 2")
        low.plot(t, four.probs[0, :, 1], color=BLUE, lw=1.5)
        low.set_ylim(0, 1)
        low.set_ylabel("P(linear mode)")
        low.set_xlabel("time, s")
        low.set_xlim(0, t[-1])
        handles, labels = top.get_legend_handles_labels()
        more, names = low.get_legend_handles_labels()
        known = [(h, n) for h, n in zip(more, names, strict=True) if n not in labels]
        figure.legend(
            handles + [h for h, _ in known], labels + [n for _, n in known], loc="outside lower left", ncols=4
        )
        save(figure, path)


def _plane(path: Path, outcome: Outcome) -> None:
    run, step = _bent(outcome)
    found = _grid_density(outcome, run, step)
    true = found.density[0, 0].sum(axis=0)
    x = np.stack(np.meshgrid(*found.axes, indexing="ij"), axis=-1)
    each = [
        (words, _closure(outcome, name, run, step, x.reshape(-1, 2)).reshape(true.shape)) for name, _, words in _CURVES
    ]
    levels = true.max() * np.array([0.02, 0.1, 0.3, 0.6, 0.9])
    highest = np.max([true, *(density for _, density in each)], axis=0)  # of all panels: no contour is cut off
    inside = [np.flatnonzero(highest.max(axis=1 - axis) > levels[0]) for axis in range(2)]
    with new_figure(7.4, "Range and bearing (c): contours of the posterior, and the truth (+)") as figure:
        panels = figure.subplots(2, 2, sharex=True, sharey=True)
        for axes, (words, density) in zip(panels.flat, [("grid: the posterior itself", true), *each], strict=True):
            _contours(axes, found.axes, true, density, levels)
            axes.plot(*outcome.draws.states[run, step], "+", color=ORANGE, ms=11, mew=2)
            axes.set_title(words)
        for set_limits, line, cells in zip(
            (panels[0, 0].set_xlim, panels[0, 0].set_ylim), found.axes, inside, strict=True
        ):
            set_limits(line[max(cells[0] - 2, 0)], line[min(cells[-1] + 2, len(line) - 1)])
        for axes in panels[:, 0]:
            axes.set_ylabel("second coordinate")
        for axes in panels[1]:
            axes.set_xlabel("first coordinate")
        save(figure, path)


def _contours(axes: "Axes", grid: tuple[_Array, ...], true: _Array, density: _Array, levels: _Array) -> None:
    axes.contourf(*grid, true.T, levels=[levels[0], true.max()], colors=[LIGHT])
    axes.contour(*grid, density.T, levels=levels, colors=[BLUE if density is not true else INK], linewidths=1.2)
