"""What the identification experiments showed, as a tree of numbers."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from saltus.evaluate import mean_over_runs
from saltus.identify import DIFFERENT, SAME, UNDECIDED, p_correct, p_false, sprt
from saltus.studies.identification import (
    AFTER,
    ASKED,
    DIMS,
    FARTHEST,
    POINTS,
    TRUTHS,
    Bounds,
    Calibration,
    Recursive,
    Static,
    run_bounds,
    run_calibration,
    run_recursive,
    run_static,
)
from saltus.studies.identification_figures import draw_identification

__all__ = ["calibration_bins", "identification_metrics", "identification_study"]

_RUNS = 1000
_BINS = 10
_PROMISES = ((1e-2, 1e-2), (1e-3, 1e-2))  # of the sequential test: false, missed

_Array = npt.NDArray[np.float64]
_Tree = dict[str, object]


def identification_study(
    folder: Path, runs: int | None, seed: int, progress: Callable[[int, int], None] | None
) -> dict[str, object]:
    """Run the experiments, draw their figures into `folder` and return their metrics."""
    n = _RUNS if runs is None else runs
    static, recursive = run_static(20 * n, seed), run_recursive(n, seed)
    calibration, bounds = run_calibration(10 * n, seed), run_bounds(n, seed, progress)
    bins = {name: calibration_bins(found) for name, found in calibration.items()}
    draw_identification(folder, static, recursive, bins, bounds)
    return identification_metrics(static, recursive, calibration, bounds)


def identification_metrics(
    static: Static, recursive: Recursive, calibration: dict[str, Calibration], bounds: Bounds
) -> dict[str, object]:
    """Summarise the runs.

    `static`: the analytic curves at thresholds h, and how far the draws lie from them in standard errors. `recursive`:
    shares declared one object, and the mean ratio. `calibration`: in bins of the stated probability, the share of
    truth. `bounds`: false-identification probabilities asked for, and observed in plain pairs with the 95 % interval of
    that observation; in another weighted sample; and by the identity E[exp(-llr); llr >= bound | one object], exact but
    for the approximations of a multimode filter. `sprt`: errors of the sequential test against those promised.
    """
    return {
        "runs": len(recursive.llr),
        "static": _static(static),
        "recursive": _recursive(recursive),
        "calibration": {name: _calibration(found) for name, found in calibration.items()},
        "bounds": [_bound(bounds, i) for i in range(len(ASKED))],
        "sprt": [_sequential(bounds, *promise) for promise in _PROMISES],
    }


def _static(static: Static) -> _Tree:
    out: _Tree = {"h": POINTS.tolist(), "draws": static.draws}
    for d, dim in enumerate(DIMS):
        curves = {"p_correct": (p_correct(POINTS, dim), static.correct[d])}
        for u, high in enumerate(FARTHEST):
            curves[f"p_false_to_{high:g}"] = (p_false(POINTS, (0.0, high), dim), static.false[d, u])
        out[f"{dim}d"] = {name: _against(*pair, static.draws) for name, pair in curves.items()}
    return out


def _against(curve: _Array, seen: _Array, n: int) -> _Tree:
    error = np.sqrt(np.maximum(curve * (1.0 - curve), 1.0 / n) / n)
    return {
        "analytic": curve.tolist(),
        "observed": seen.tolist(),
        "largest_deviation_standard_errors": float(np.abs((seen - curve) / error).max()),
    }


def _recursive(recursive: Recursive) -> _Tree:
    out: _Tree = {}
    for s, truth in enumerate(TRUTHS):
        llr = recursive.llr[:, s]
        same = mean_over_runs(llr[:, np.array(AFTER) - 1] >= 0.0)
        mean = mean_over_runs(llr[:, -1])
        out[truth] = {
            "p_same": {str(k): float(p) for k, p in zip(AFTER, same.value, strict=True)},
            "p_same_standard_error": {str(k): float(e) for k, e in zip(AFTER, same.standard_error, strict=True)},
            "mean_llr": float(mean.value),
            "mean_llr_standard_error": float(mean.standard_error),
        }
    return out


def calibration_bins(calibration: Calibration) -> tuple[_Array, _Array, _Array]:
    """Compare the stated probability with the share of truth, in ten bins of equal width.

    Returns:
        Mean probability, share of truth, its standard error if the probability is honest; NaN in empty bins.
    """
    p, truth, weight = calibration
    which = np.minimum((p * _BINS).astype(int), _BINS - 1)

    def total(values: _Array) -> _Array:
        return np.bincount(which, values, _BINS).astype(np.float64)

    with np.errstate(invalid="ignore", divide="ignore"):
        stated, share = total(weight * p) / total(weight), total(weight * truth) / total(weight)
        error = np.sqrt(total(weight**2 * (truth - p) ** 2)) / total(weight)
    return stated, share, error


def _calibration(calibration: Calibration) -> _Tree:
    stated, share, error = calibration_bins(calibration)
    gap = calibration.weight * (calibration.stated - calibration.truth) / calibration.weight.sum()
    return {
        "stated": _listed(stated),
        "observed": _listed(share),
        "standard_error": _listed(error),
        "mean_difference": float(gap.sum()),
        "mean_difference_standard_error": float(np.sqrt((gap**2).sum())),
    }


def _bound(bounds: Bounds, i: int) -> _Tree:
    from scipy.stats import beta

    hits, n = bounds.reached[i], bounds.pairs[i]
    low = float(beta.ppf(0.025, hits, n - hits + 1)) if hits else 0.0
    high = float(beta.ppf(0.975, hits + 1, n - hits))
    return {
        "asked": ASKED[i],
        "bound": float(bounds.bound[i]),
        "standard_error": float(bounds.stated_error[i]),
        "observed": {
            "value": float(hits / n),
            "low": low,
            "high": high,
            "pairs": int(n),
            "asked_inside": bool(low <= ASKED[i] <= high),
        },
        "weighted": {"value": float(bounds.fresh[i]), "standard_error": float(bounds.fresh_error[i])},
        "identity": float(bounds.inverse[i]),
        "recognised": float(bounds.recognised[i]),
    }


def _sequential(bounds: Bounds, false: float, missed: float) -> _Tree:
    two, one = (sprt(paths, p_false=false, p_missed=missed) for paths in (bounds.paths, bounds.paths_same))
    return {
        "promised": {"false": false / (1.0 - missed), "missed": missed / (1.0 - false)},
        "false": float((two.verdict == SAME).mean()),
        "missed": float((one.verdict == DIFFERENT).mean()),
        "undecided_same": float((one.verdict == UNDECIDED).mean()),
        "undecided_different": float((two.verdict == UNDECIDED).mean()),
        "rows": {"same": float(np.mean(one.row + 1.0)), "different": float(np.mean(two.row + 1.0))},
    }


def _listed(values: _Array) -> list[float | None]:
    return [None if np.isnan(v) else float(v) for v in values]
