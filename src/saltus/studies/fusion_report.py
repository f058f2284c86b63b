"""What the fusion experiment showed: errors, decisions, delays and honesty, as a tree of numbers."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from saltus.evaluate.estimation import Interval, mean_over_runs, rmse
from saltus.studies.fusion import CHAINS, FILTERS, STATES, STEPS, Chains, Trial, Variant, fixed_chains, run_fusion
from saltus.studies.fusion_figures import draw_fusion

__all__ = ["SEGMENTS", "calibration_curve", "fusion_metrics", "fusion_study", "lags"]

# First and last step, counted from 1: one fault or manoeuvre at a time, and none.
SEGMENTS = {"all": (1, STEPS), "B": (50, 69), "C": (90, 129), "A": (160, 179), "nominal": (1, 49)}
_RUNS = 300
_BINS = 10

_Array = npt.NDArray[np.float64]
_Tree = dict[str, object]


def fusion_study(
    folder: Path, runs: int | None, seed: int, progress: Callable[[int, int], None] | None
) -> dict[str, object]:
    """Run the fusion experiment, draw its figures into `folder` and return its metrics."""
    n = _RUNS if runs is None else runs
    parts: tuple[tuple[Variant, Chains], ...] = (("frozen", "test"), ("frozen", "drawn"), ("range", "test"))

    def told(part: int) -> Callable[[int, int], None] | None:
        return None if progress is None else lambda done, total: progress(part * total + done, len(parts) * total)

    # One seed each: equal draws would make their errors, and so their deviations from the truth, look alike.
    trials = [run_fusion(n, seed + i * 1_000_003, *part, told(i)) for i, part in enumerate(parts)]
    draw_fusion(folder, trials[0], calibration_curve(trials[1]))
    return fusion_metrics(*trials)


def fusion_metrics(test: Trial, drawn: Trial, by_range: Trial) -> dict[str, object]:
    """Summarise the runs.

    Plain numbers in rad, rad/s, m/s, m/s^2, steps and shares of 1; `intervals` holds the same keys with value,
    standard error and 95 % interval over the runs. RMSE are pooled (mean square) over the steps of a segment.

    `nees` (over phi, omega, V, J: 4 expected) and `calibration` are those of chains drawn from the model's own law;
    with the test chains, nominal most of the time, NEES is lower, as it should be.
    """
    errors = _errors(test)
    overall = {name: found["all"] for name, found in _swapped(errors).items()}
    correct = (test.decided == test.modes).all(-1)
    joint = {name: mean_over_runs(correct[:, part], pool=(1,)) for name, part in _slices().items()}
    each = mean_over_runs(test.decided == test.modes, pool=(1,))
    nees, nees_test = (mean_over_runs(t.nees, pool=(1,)) for t in (drawn, test))
    prob_true = mean_over_runs(test.prob_true, pool=(1,))
    found = {chain: lags(test, c) for c, chain in enumerate(CHAINS)}
    intervals: _Tree = {
        "rmse": overall,
        "rmse_segments": errors,
        "p_joint_mode_correct": joint,
        "nees": nees,
        "nees_test_chains": nees_test,
    }
    return {
        "runs": len(test.states),
        "units": {"phi": "rad", "omega": "rad/s", "V": "m/s", "J": "m/s^2", "lag": "steps of 1 s"},
        "segments": {name: list(ends) for name, ends in SEGMENTS.items()},
        "rmse": _values(overall),
        "rmse_segments": _values(errors),
        "p_joint_mode_correct": float(joint["all"].value),
        "p_joint_mode_correct_segments": _values(joint),
        "p_chain_correct": {chain: float(each.value[c]) for c, chain in enumerate(CHAINS)},
        "p_true_mode": float(prob_true.value),
        "lag": {chain: float(np.median(of[~np.isnan(of)])) for chain, of in found.items()},
        "lags": {chain: _spread(test, of, c) for c, (chain, of) in enumerate(found.items())},
        "nees": float(nees.value),
        "nees_test_chains": float(nees_test.value),
        "calibration": _calibration(drawn),
        "drawn_chains": {"rmse": _values({name: f["all"] for name, f in _swapped(_errors(drawn)).items()})},
        "range_dependent": {
            "rmse": _values({name: f["all"] for name, f in _swapped(_errors(by_range)).items()}),
            "rmse_segments": _values(_errors(by_range)),
            "p_joint_mode_correct": float((by_range.decided == by_range.modes).all(-1).mean()),
        },
        "intervals": _full(intervals),
    }


def lags(trial: Trial, chain: int) -> _Array:
    """Count the steps from each change of a test chain to its second state until P(second state) > 0.5.

    Returns:
        (B, changes); 0 where it is so at the first step already, NaN where it is nowhere until the chain returns.
    """
    on = fixed_chains()[:, chain]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], on, [0]]))).reshape(-1, 2)
    out = np.empty((len(trial.states), len(edges)))
    for i, (start, stop) in enumerate(edges):
        over = trial.marginals[:, start:stop, chain] > 0.5
        out[:, i] = np.where(over.any(1), over.argmax(1), np.nan)
    return out


def calibration_curve(trial: Trial) -> tuple[_Array, _Array, _Array]:
    """Compare P(second state) of each chain with how often it is true, in ten bins of equal width.

    Returns:
        Mean probability, share of truth and its standard error over the runs, each (3, bins); NaN in empty bins.
    """
    out = np.full((3, 3, _BINS), np.nan)
    for c in range(3):
        p, truth = trial.marginals[..., c], trial.modes[..., c] == 1
        which = np.minimum((p * _BINS).astype(int), _BINS - 1)
        for b in range(_BINS):
            inside = which == b
            if inside.any():
                share = mean_over_runs(truth, pool=(1,), where=inside)
                out[:, c, b] = p[inside].mean(), share.value, share.standard_error
    return out[0], out[1], out[2]


def _calibration(drawn: Trial) -> _Tree:
    true, square = (mean_over_runs(a, pool=(1,)) for a in (drawn.prob_true, drawn.prob_square))
    gap = mean_over_runs(drawn.prob_true - drawn.prob_square, pool=(1,))
    stated, observed, error = calibration_curve(drawn)
    return {
        "prob_true": float(true.value),
        "prob_square": float(square.value),
        "difference": float(gap.value),
        "difference_standard_error": float(gap.standard_error),
        "curve": {
            chain: {"stated": _listed(stated[c]), "observed": _listed(observed[c]), "standard_error": _listed(error[c])}
            for c, chain in enumerate(CHAINS)
        },
    }


def _slices() -> dict[str, slice]:
    return {name: slice(first - 1, last) for name, (first, last) in SEGMENTS.items()}


def _errors(trial: Trial) -> dict[str, dict[str, dict[str, Interval]]]:
    """RMSE by segment, filter and state."""
    off = trial.estimate - trial.states[:, None]
    out: dict[str, dict[str, dict[str, Interval]]] = {}
    for segment, part in _slices().items():
        found = rmse(off[:, :, part], pool=(2,))
        out[segment] = {
            name: {state: _at(found, (f, s)) for s, state in enumerate(STATES)} for f, name in enumerate(FILTERS)
        }
    return out


def _at(found: Interval, index: tuple[int, ...]) -> Interval:
    return Interval(found.value[index], found.standard_error[index], found.low[index], found.high[index], found.n_runs)


def _swapped(errors: dict[str, dict[str, dict[str, Interval]]]) -> dict[str, dict[str, dict[str, Interval]]]:
    return {name: {segment: found[name] for segment, found in errors.items()} for name in FILTERS}


def _spread(trial: Trial, of: _Array, chain: int) -> list[_Tree]:
    """Summarise the lags after each change."""
    on = fixed_chains()[:, chain]
    starts = np.flatnonzero(np.diff(on, prepend=0) == 1) + 1
    return [
        {
            "step": int(start),
            "median": float(np.nanmedian(lag)),
            "quantile_90": float(np.nanquantile(lag, 0.9)),
            "detected": float(np.mean(~np.isnan(lag))),
        }
        for start, lag in zip(starts, of.T, strict=True)
    ]


def _values(tree: object) -> object:
    """Keep the values of a tree of intervals."""
    if isinstance(tree, Interval):
        return float(tree.value)
    return {key: _values(branch) for key, branch in tree.items()} if isinstance(tree, dict) else tree


def _full(tree: object) -> object:
    if isinstance(tree, Interval):
        return {name: float(getattr(tree, name)) for name in ("value", "standard_error", "low", "high")}
    return {key: _full(branch) for key, branch in tree.items()} if isinstance(tree, dict) else tree


def _listed(values: _Array) -> list[float | None]:
    return [None if np.isnan(v) else float(v) for v in values]
