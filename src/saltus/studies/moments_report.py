"""What the switching diffusions showed: a table of errors against the grid, and figures."""

from collections.abc import Callable
from pathlib import Path

from saltus.studies.moments import CASES, FILTERS, Outcome, run_case
from saltus.studies.moments_figures import draw_moments

__all__ = ["moments_metrics", "moments_study"]

_RUNS = 60


def moments_study(
    folder: Path, runs: int | None, seed: int, progress: Callable[[int, int], None] | None
) -> dict[str, object]:
    """Run all cases, draw the figures and return the metrics: case, filter, then errors against the grid."""
    n = _RUNS if runs is None else runs
    total = len(CASES) * (len(FILTERS) + 1)
    done = 0

    def told(_: str) -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    outcomes = {name: run_case(name, n, seed + i, told) for i, name in enumerate(CASES)}
    draw_moments(folder, outcomes)
    return moments_metrics(outcomes)


def moments_metrics(outcomes: dict[str, Outcome]) -> dict[str, object]:
    """Errors of every filter in every case, and beside them the runs made and the errors against the truth.

    `mean_err` is in posterior standard deviations (rms), `var_err` relative, `prob_err` rms, `us_per_step` in
    microseconds of process time for a run's step when all runs are filtered at once, `failed` a share of runs.
    """
    table: dict[str, object] = {
        name: {label: errors._asdict() for label, errors in outcome.filters.items()}
        for name, outcome in outcomes.items()
    }
    return {
        "units": "posterior standard deviations, shares of 1, microseconds",
        "runs": {name: len(outcome.draws.z) for name, outcome in outcomes.items()},
        "steps": {name: len(outcome.case.times) for name, outcome in outcomes.items()},
        "rmse_to_truth": {name: outcome.rmse for name, outcome in outcomes.items()},
        **table,
    }
