"""What the jamming experiment showed: faults found, false alarms, and what not being told costs."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from saltus.alarms import alarms
from saltus.evaluate import mean_over_runs, rmse
from saltus.evaluate.estimation import Interval
from saltus.studies.jamming import FAULTS, FILTERS, FIRST, LENGTH, PERIOD, SIZE, STEPS, Trial, conditions, run_jamming
from saltus.studies.style import BLUE, GREY, ORANGE, TEAL, new_figure, save, shade

__all__ = ["ALARM", "WITHIN", "jamming_metrics", "jamming_study"]

ALARM = 0.9  # probability of any fault from which an alarm is raised
WITHIN = 3  # measurements in which a fault must be found
_RUNS = 200

_Tree = dict[str, object]


def jamming_study(
    folder: Path, runs: int | None, seed: int, progress: Callable[[int, int], None] | None
) -> dict[str, object]:
    """Run the jamming experiment with and without faults, draw its figures and return its metrics."""
    n = _RUNS if runs is None else runs

    def told(part: int) -> Callable[[int, int], None] | None:
        return None if progress is None else lambda done, total: progress(part * total + done, 2 * total)

    faulty = run_jamming(n, seed, progress=told(0))
    quiet = run_jamming(n, seed + 1_000_003, faults=False, progress=told(1))
    _draw(folder / "figure1_faults.png", faulty)
    return jamming_metrics(faulty, quiet)


def jamming_metrics(faulty: Trial, quiet: Trial) -> dict[str, object]:
    """Summarise the runs.

    Each figure has value, standard error and 95 % interval over the runs. Errors are distances in m, pooled (mean
    square) over measurements; `ratio` is adaptive over informed. An alarm stands where P(any fault) reaches `ALARM`;
    a false alarm is a fault-free measurement at which one stands, those just after a fault included.
    """
    parts = {"all": slice(None), **_slices()}
    well = (conditions() == 0).all(axis=-1)
    standing = alarms(1 - faulty.prob[..., 0, 0], threshold=ALARM).standing
    false = mean_over_runs(standing[:, well], pool=(1,))
    calm = mean_over_runs(alarms(1 - quiet.prob[..., 0, 0], threshold=ALARM).standing, pool=(1,))
    errors = {name: rmse(faulty.error[..., part], pool=(2,)) for name, part in parts.items()}
    return {
        "runs": len(faulty.error),
        "units": "m, measurements, shares of 1",
        "fault_size_sigma": SIZE,
        "alarm_probability": ALARM,
        "rmse": {name: {f: _number(found, i) for i, f in enumerate(FILTERS)} for name, found in errors.items()},
        "ratio": {name: float(found.value[0] / found.value[1]) for name, found in errors.items()},
        "detected_within_3": {name: _number(_detected(faulty, i)) for i, name in enumerate(FAULTS)},
        "identified_within_3": {name: _number(_identified(faulty, i)) for i, name in enumerate(FAULTS)},
        "false_alarms": {"fault_free_measurements": _number(false), "runs_without_faults": _number(calm)},
        "nees": {
            "with_faults": _number(mean_over_runs(faulty.nees, pool=(1,))),
            "without_faults": _number(mean_over_runs(quiet.nees, pool=(1,))),
            "expected": 4.0,
        },
        "price_without_faults": float(
            rmse(quiet.error[:, 0], pool=(1,)).value / rmse(quiet.error[:, 2], pool=(1,)).value
        ),
    }


def _slices() -> dict[str, slice]:
    return {name: slice(first, first + LENGTH) for name, first in zip(FAULTS, FIRST, strict=True)}


def _detected(trial: Trial, fault: int) -> Interval:
    """Count the runs in which an alarm stands within three measurements of a fault's begin."""
    first = FIRST[fault]
    over = 1 - trial.prob[:, first : first + WITHIN, 0, 0] >= ALARM
    return mean_over_runs(over.any(axis=1).astype(float))


def _identified(trial: Trial, fault: int) -> Interval:
    """Count the runs in which the true joint condition becomes the most probable one."""
    first = FIRST[fault]
    flat = trial.prob[:, first : first + WITHIN].reshape(len(trial.prob), WITHIN, 8)
    radar, beacon = conditions()[first]
    return mean_over_runs((flat.argmax(-1) == 2 * radar + beacon).any(axis=1).astype(float))


def _number(found: Interval, index: int | tuple[()] = ()) -> dict[str, float]:
    return {name: float(getattr(found, name)[index]) for name in ("value", "standard_error", "low", "high")}


def _draw(path: Path, trial: Trial) -> None:
    time = PERIOD * np.arange(1, STEPS + 1)
    rms = np.sqrt(np.mean(np.square(trial.error), axis=0))
    title = f"Faults of {SIZE:.0f} standard deviations, told to the filter or not ({len(trial.error)} runs)"
    with new_figure(9.0, title) as figure:
        panels = figure.subplots(3, 1, sharex=True, height_ratios=[1.5, 1, 1])
        bad = (conditions() > 0).any(axis=-1)
        for axes in panels:
            shade(axes, time, bad, "fault")
        for i, colour in ((2, ORANGE), (1, TEAL), (0, BLUE)):
            panels[0].plot(
                time, rms[i], color=colour, label=("adaptive", "told the faults", "never heard of faults")[i]
            )
        panels[0].set_yscale("log")
        panels[0].set_ylim(20, 2 * rms.max())
        panels[0].set_ylabel("position error (RMS), m")
        for first, name in zip(FIRST, FAULTS, strict=True):
            at = PERIOD * (first + LENGTH / 2)
            panels[0].annotate(
                name, (at, 1.0), xycoords=("data", "axes fraction"), ha="center", va="bottom", color=GREY
            )
        mean = trial.prob.mean(axis=0)
        radar, beacon = mean.sum(axis=2), mean.sum(axis=1)
        for state, (line, name) in enumerate((("-", "jammed"), ("--", "biased"), (":", "lost")), start=1):
            panels[1].plot(time, radar[:, state], line, color=BLUE, label=name)  # the colour is the filter's
        panels[2].plot(time, beacon[:, 1], color=BLUE, label="jammed")
        for axes, what, place in ((panels[1], "radar", "center right"), (panels[2], "beacon", "center left")):
            axes.set_ylim(-0.02, 1.04)  # curves at 0 and 1 are seen whole
            axes.set_yticks([0, 0.5, 1])
            axes.set_ylabel(f"P, {what}\n(adaptive)")
            axes.legend(*_curves(axes.get_legend_handles_labels()), loc=place)
        panels[2].set_xlabel("time, s")
        panels[2].set_xlim(0, time[-1])
        figure.align_ylabels(panels)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower left", ncols=4)
        save(figure, path)


def _curves(found: tuple[list[object], list[str]]) -> "tuple[list[object], list[str]]":
    """Leave the shading to the common legend."""
    kept = [(handle, label) for handle, label in zip(*found, strict=True) if label != "fault"]
    return [handle for handle, _ in kept], [label for _, label in kept]
