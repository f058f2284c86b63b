"""What faults cost, in numbers and pictures."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from saltus.evaluate.plots import KNOT, Followed, Motion
from saltus.injection.plots import AZIMUTH, RANGE
from saltus.records import Kind, Plots
from saltus.studies.style import BLUE, GREY, ORANGE, TEAL, new_figure, save

__all__ = ["RUNS", "draw", "errors", "found", "growth"]

RUNS = ("clean_with", "clean_without", "injected_with", "injected_without")  # with or without the chains of faults
_MIN_TRACK, _MIN_SPEED = 5, 100.0  # plots of a track, kt
_LEAST, _MOST = 1e-6, 1 - 1e-8  # probabilities beyond are drawn in a row of their own
_MANY, _OFTEN = 100, 0.05  # plots of an aircraft, share of them suspected

_Array = npt.NDArray[np.float64]
_Figures = dict[str, float | None]


def errors(run: Followed, reference: Motion) -> tuple[_Figures, dict[str, _Array]]:
    """Judge a run: figures, and the errors themselves, on tracks of 5 plots and more of what is faster than 100 kt."""
    number, count = np.unique(run.track[run.track > 0], return_counts=True)
    long = np.isin(run.track, number[count >= _MIN_TRACK])
    good = long & np.isfinite(run.course + reference.course) & (reference.speed > _MIN_SPEED * KNOT)
    course = np.abs((run.course - reference.course + 180.0) % 360.0 - 180.0)
    speed = (run.speed - reference.speed) / KNOT
    straight, turning = good & reference.straight, good & reference.turning
    parts = {
        "course_straight": course[straight],
        "speed_straight": np.abs(speed[straight]),
        "course_turn": course[turning],
        "speed_turn": np.abs(speed[turning]),
    }
    sure = run.confirmed[straight]
    return {
        "plots_straight": float(straight.sum()),
        "plots_turn": float(turning.sum()),
        "speed_straight_rms_kt": _root_mean_square(parts["speed_straight"]),
        "speed_straight_rms_confirmed_kt": _root_mean_square(parts["speed_straight"][sure]),
        "speed_straight_median_kt": _quantile(parts["speed_straight"], 0.5),
        "course_straight_median_deg": _quantile(parts["course_straight"], 0.5),
        "course_straight_p95_deg": _quantile(parts["course_straight"], 0.95),
        "course_turn_median_deg": _quantile(parts["course_turn"], 0.5),
        "course_turn_p95_deg": _quantile(parts["course_turn"], 0.95),
        "tracks": float(len(number)),
    }, parts


def growth(before: _Figures, after: _Figures, *, own: bool) -> _Figures:
    """By what share each error grew; None of departures from the program's `own` run over clean plots."""
    out: _Figures = {}
    for name, value in before.items():
        later = after[name]
        if name.endswith(("_kt", "_deg")):
            out[name] = None if own or not value or later is None else later / value - 1.0
    return out


def found(fault: npt.NDArray[np.int8], clean: Followed, injected: Followed, plots: Plots) -> dict[str, object]:
    """Say how many faulty plots were told, and how many clean ones suspected.

    A plot is judged when it updated a track past its start in the run over clean plots: there a fault of it could be
    told. A faulty one that the tracker then left out of every track is not told. On the ground near the radar a degree
    is a few metres, so airborne plots are counted by themselves. Aircraft suspected in more than 5 % of their clean
    plots have real faults; they are named, and the share of the others is given beside that of all.

    Args:
        fault: of each plot: 0, AZIMUTH or RANGE.
        clean: the run over clean plots.
        injected: the run over the plots with faults.
        plots: the reports.
    """
    judged = (plots.kind == Kind.POLAR) & (plots.reason == 0) & np.isfinite(clean.p_fault)
    airborne, told = judged & (plots.on_ground != 1), injected.p_fault > 0.5
    bad = _often_suspected(plots.icao24[judged], clean.p_fault[judged] > 0.5)
    sound = ~np.isin(plots.icao24, bad)
    intact = judged & (fault == 0) & np.isfinite(injected.p_fault)

    def share(of: npt.NDArray[np.bool_], what: npt.NDArray[np.bool_] = told) -> dict[str, float | None]:
        n = int(of.sum())
        value = float(what[of].mean()) if n else None
        deviation = None if value is None else float(np.sqrt(value * (1.0 - value) / n))
        return {"value": value, "standard_error": deviation, "plots": float(n)}

    return {
        "injected_told": share(judged & (fault > 0)),
        "injected_told_airborne": share(airborne & (fault > 0)),
        "injected_azimuth_told_airborne": share(airborne & (fault == AZIMUTH)),
        "injected_range_told_airborne": share(airborne & (fault == RANGE)),
        "injected_left_out": share(judged & (fault > 0), np.isnan(injected.p_fault)),
        "clean_suspected": share(intact),
        "clean_suspected_other_aircraft": share(intact & sound),
        "clean_run_suspected": share(judged, clean.p_fault > 0.5),
        "aircraft_with_real_faults": [f"{code:06X}" for code in bad],
    }


def _often_suspected(code: npt.NDArray[np.int32], suspected: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
    """Addresses of which more than 5 % of 100 plots and more are suspected."""
    known = np.unique(code[code >= 0])
    counts = np.array([[(mine := code == c).sum(), suspected[mine].sum()] for c in known]).reshape(-1, 2)
    return np.asarray(known[(counts[:, 0] >= _MANY) & (counts[:, 1] > _OFTEN * counts[:, 0])])


def draw(
    folder: Path, parts: Mapping[str, Mapping[str, _Array]], fault: npt.NDArray[np.int8], run: Followed, slant: _Array
) -> None:
    """Draw the errors of all runs, and the probabilities of faults over range."""
    looks = {
        "clean_with": ("clean", BLUE, "-"),
        "injected_with": ("with faults, known to the filter", TEAL, "-"),
        "injected_without": ("with faults, unknown to it", ORANGE, "-"),
        "clean_without": ("clean, filter without faults", GREY, "--"),
    }
    with new_figure(6.4, "Errors of course and speed: share of plots above") as figure:
        panels = figure.subplots(2, 2)
        for axes, (name, what) in zip(panels.flat, _PANELS.items(), strict=True):
            for key, (label, colour, line) in looks.items():
                values = np.sort(parts[key][name])
                above = 1.0 - np.arange(1, len(values) + 1) / max(len(values), 1)
                axes.plot(values, np.maximum(above, 1e-4), line, color=colour, label=label)
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_xlim(1e-2, 1e2)
            axes.set_ylim(1e-3, 1.0)
            axes.set_xlabel(what)
        figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower left", ncols=2)
        save(figure, folder / "figure1_errors.png")
    with new_figure(4.6, "Probability that the plot is faulty") as figure:
        axes = figure.subplots()
        kinds = ((0, GREY, "clean"), (AZIMUTH, ORANGE, "azimuth off by 1°"), (RANGE, BLUE, "range off by 0.5 NM"))
        for kind, colour, label in kinds:
            mine = (fault == kind) & np.isfinite(run.p_fault)
            small = kind == 0
            axes.plot(
                slant[mine] / 1e3,
                _log_odds(run.p_fault[mine]),
                ".",
                color=colour,
                ms=2 if small else 5,
                alpha=0.25 if small else 0.9,
                label=label,
            )
        ticks = np.array([_LEAST, 1e-4, 1e-2, 0.5, 1 - 1e-2, 1 - 1e-4, 1 - 1e-6, _MOST])
        names = ["≤ 1e-6", "1e-4", "0.01", "0.5", "0.99", "1 − 1e-4", "1 − 1e-6", "≥ 1 − 1e-8"]
        axes.set_yticks(_log_odds(ticks), names)
        axes.set_ylim(_log_odds(ticks[:1])[0] - 1, _log_odds(ticks[-1:])[0] + 1)
        axes.set_xlabel("range, km")
        axes.set_ylabel("p_fault")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower left", ncols=3, markerscale=2)
        save(figure, folder / "figure2_p_fault.png")


_PANELS = {
    "course_straight": "course in straight flight, degrees",
    "course_turn": "course in turns, degrees",
    "speed_straight": "speed in straight flight, kt",
    "speed_turn": "speed in turns, kt",
}


def _log_odds(p: _Array) -> _Array:
    p = np.clip(p, _LEAST, _MOST)
    return np.asarray(np.log(p / (1.0 - p)))


def _quantile(values: _Array, share: float) -> float | None:
    return float(np.quantile(values, share)) if len(values) else None


def _root_mean_square(values: _Array) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None
