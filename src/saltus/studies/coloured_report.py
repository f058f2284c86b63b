"""What the experiment with coloured noise showed: errors, decisions and honesty, as a tree of numbers."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from saltus.evaluate.estimation import Interval, consistency, mean_over_runs, rmse
from saltus.studies.coloured import FILTERS, PAPER_RATE, STEPS, Trial, run_coloured
from saltus.studies.coloured_figures import draw_paper, draw_value

__all__ = ["RATES", "coloured_metrics", "coloured_study", "value_metrics"]

RATES = (10.0, 3.0, 1.0, 0.3)  # of the noise, in units of the oscillator's: from nearly white to slow
_RUNS = 300
_PARTS = {"all": (1, 400), "nominal": (1, 49), "agitated": (50, 149), "noisy": (200, 299), "after": (300, 400)}
_STATE = ("x", "v")

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


def coloured_study(
    folder: Path, runs: int | None, seed: int, progress: Callable[[int, int], None] | None
) -> dict[str, object]:
    """Run the experiment with the published chains, then with drawn ones at several correlation times; draw both."""
    n_runs = _RUNS if runs is None else runs
    n_all = n_runs * (1 + len(RATES))

    def told(before: int) -> Callable[[int, int], None] | None:
        return None if progress is None else lambda done, _: progress(before + done, n_all)

    paper = run_coloured(n_runs, seed, progress=told(0))
    draw_paper(folder, paper)
    metrics = coloured_metrics(paper)
    value: dict[str, object] = {}
    for i, rate in enumerate(RATES):
        trial = run_coloured(n_runs, seed, rate=rate, drawn=STEPS, progress=told((i + 1) * n_runs))
        value[f"{rate:g}"] = value_metrics(trial, rate)
    draw_value(folder, value)
    return {**metrics, "value_of_colour": value}


def coloured_metrics(trial: Trial) -> dict[str, object]:
    """Summarise runs with the published chains.

    Every figure has value, standard error and 95 % interval over the runs; errors are those of the mean estimate,
    pooled (mean square) over the steps of each part, in units of the noise's lower standard deviation.
    """
    parts = {name: _steps(first, last) for name, (first, last) in _PARTS.items()}
    errors = trial.states[:, None] - trial.estimate
    rms = {
        part: {name: _by_state(errors[:, i], mask) for i, name in enumerate(FILTERS)}
        | {"raw": _number(rmse(trial.z[..., 0] - trial.states[..., 0], pool=(1,), where=mask))}
        for part, mask in parts.items()
    }
    return {
        "runs": len(trial.z),
        "steps": STEPS,
        "rate": PAPER_RATE,
        "rmse": rms,
        "map_mode_correct": {part: _map_correct(trial, 0, mask) for part, mask in parts.items()},
        "map_chain_correct": {"a": _chain_correct(trial, 0), "b": _chain_correct(trial, 1)},
        "probability_of_true_mode": _number(mean_over_runs(_prob_of_truth(trial, 0), pool=(1,))),
        "nees": {name: _number(mean_over_runs(trial.nees[:, i], pool=(1,))) for i, name in enumerate(FILTERS)},
        "lags": {
            "a_onset": _lag(trial, 0, 50, 149, True),
            "a_end": _lag(trial, 0, 150, 199, False),
            "b_onset": _lag(trial, 1, 200, 299, True),
            "b_end": _lag(trial, 1, 300, 400, False),
        },
    }


def value_metrics(trial: Trial, rate: float) -> dict[str, object]:
    """Summarise runs with drawn chains: what modelling the colour is worth at this rate of the noise.

    `nees_inside` is the share of steps whose mean over the runs lies in its 95 % band.
    """
    errors = trial.states[:, None] - trial.estimate
    every = np.ones(trial.z.shape[1], np.bool_)
    return {
        "phi_yy": float(np.exp(-rate * np.pi / 20)),
        "rmse": {name: _by_state(errors[:, i], every) for i, name in enumerate(FILTERS)},
        "nees": {name: _number(mean_over_runs(trial.nees[:, i], pool=(1,))) for i, name in enumerate(FILTERS)},
        "nees_inside": {name: consistency(trial.nees[:, i], 2).inside for i, name in enumerate(FILTERS)},
        "map_mode_correct": {name: _map_correct(trial, i, every) for i, name in enumerate(("adaptive", "white"))},
    }


def _steps(first: int, last: int) -> _Mask:
    k = np.arange(1, STEPS + 1)
    return np.asarray((k >= first) & (k <= last))


def _by_state(errors: _Array, mask: _Mask) -> dict[str, object]:
    return {name: _number(rmse(errors[..., i], pool=(1,), where=mask)) for i, name in enumerate(_STATE)}


def _number(interval: Interval) -> dict[str, float]:
    return {name: float(getattr(interval, name)) for name in ("value", "standard_error", "low", "high")}


def _map_correct(trial: Trial, which: int, mask: _Mask) -> dict[str, float]:
    """Share of steps at which the most probable joint mode is the true one."""
    p = trial.probs[:, which]
    best = p.reshape(*p.shape[:2], 4).argmax(-1)
    right = best == 2 * trial.modes[..., 0] + trial.modes[..., 1]
    return _number(mean_over_runs(right.astype(float), pool=(1,), where=mask))


def _chain_correct(trial: Trial, chain: int) -> dict[str, float]:
    """Share of steps at which one chain's more probable state is the true one."""
    decided = _second(trial, chain) > 0.5
    return _number(mean_over_runs((decided == trial.modes[..., chain]).astype(float), pool=(1,)))


def _second(trial: Trial, chain: int) -> _Array:
    """Probability that a chain is in its second state, (B, K), by the adaptive filter."""
    return np.asarray(trial.probs[:, 0].sum(axis=3 - chain)[..., 1])


def _prob_of_truth(trial: Trial, which: int) -> _Array:
    p = trial.probs[:, which]
    run, step = np.indices(p.shape[:2])
    return np.asarray(p[run, step, trial.modes[..., 0], trial.modes[..., 1]])


def _lag(trial: Trial, chain: int, first: int, last: int, up: bool) -> dict[str, float]:
    """Steps from a jump until the chain is decided right, over the runs in which it is, before the next jump."""
    decided = _second(trial, chain)[:, first - 1 : last] > 0.5
    right = decided if up else ~decided
    hit = right.any(1)
    lags = right[hit].argmax(1)
    return {
        "detected": float(hit.mean()),
        "median": float(np.quantile(lags, 0.5, method="inverted_cdf")),
        "quantile_90": float(np.quantile(lags, 0.9, method="inverted_cdf")),
    }
