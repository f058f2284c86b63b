"""What becomes of ill-conditioned models and outliers? Ten million filter steps of them answered, by both backends.

Every run has a model of its own (`tests/strategies.hostile_problem`): ratios of variances over 32 decades, covariances
of any rank, components without noise, more measurements than states, outliers up to overflow. Prints how far
probabilities are from summing to 1, the most negative eigenvalue of a covariance in units of its variances, and what
was refused.
"""

import argparse
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from saltus import imm_filter
from saltus.compiled import native_module
from saltus.errors import SaltusError
from saltus.linalg import NOTHING
from strategies import hostile_problem, of_runs

CHAINS = ((), (2,), (3,), (2, 2))
FARTHEST = (0.0, 3.0, 16.0, 150.0, 300.0)


@dataclass
class Tally:
    """What was seen of one backend."""

    steps: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    worst_sum: float = 0.0
    least_eigenvalue: float = 0.0
    not_finite: int = 0
    seconds: float = 0.0


def kind(error: SaltusError) -> str:
    """The error without its numbers."""
    for words in ("overflows double precision", "not positive definite", "prediction is not finite"):
        if words in str(error):
            return f"{type(error).__name__}: {words}"
    return f"{type(error).__name__}: {str(error)[:60]}"


def filtered(p: dict[str, object], backend: str, tally: Tally) -> None:
    """Filter the runs that are not refused, and count."""
    left = np.arange(len(p["z"]))
    start = time.process_time()
    while len(left):
        try:
            est = imm_filter(**of_runs(p, left), backend=backend, per_mode=True)
            break
        except SaltusError as error:
            if error.runs is None:
                raise
            tally.refused[kind(error)] += int(error.runs.sum())
            left = left[~error.runs]
    tally.seconds += time.process_time() - start
    if not len(left):
        return
    chains = tuple(range(2, est.probs.ndim))
    tally.steps += est.probs[..., :1].size if not chains else est.probs.shape[0] * est.probs.shape[1]
    tally.worst_sum = max(tally.worst_sum, float(np.abs(est.probs.sum(chains) - 1.0).max()))
    for part in (est.mean, est.cov, est.mode_means, est.mode_covs):
        tally.not_finite += int((~np.isfinite(part)).sum())
    for covs in (est.cov, est.mode_covs):
        variance = np.diagonal(covs, axis1=-2, axis2=-1)
        sigma = np.sqrt(np.where(variance > NOTHING, variance, 1.0))
        scaled = covs / sigma[..., :, None] / sigma[..., None, :]
        tally.least_eigenvalue = min(tally.least_eigenvalue, float(np.linalg.eigvalsh(scaled).min()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=float, default=1e7, help="answered, of all backends together")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    backends = ["numpy"] if native_module() is None else ["numpy", "native"]
    tallies = {name: Tally() for name in backends}
    rng, begun = np.random.default_rng(args.seed), 0
    while sum(t.steps for t in tallies.values()) < args.steps:
        n = int(rng.integers(1, 10))
        m, rows, decades = int(rng.integers(1, n + 3)), int(rng.integers(1, 21)), (2.0, 8.0)[rng.integers(2)]
        sizes, farthest = CHAINS[rng.integers(len(CHAINS))], FARTHEST[rng.integers(len(FARTHEST))]
        p = hostile_problem(rng, 2000, sizes, n, m, rows, decades, farthest)
        for name, tally in tallies.items():
            filtered(p, name, tally)
        begun += 2000 * rows * len(tallies)
    answered = sum(t.steps for t in tallies.values())
    print(f"{answered:,} steps answered, of runs of {begun:,} steps, seed {args.seed}")
    print("| backend | steps answered | worst \\|sum p - 1\\| | least eigenvalue | not finite | CPU s |")
    print("|---|---|---|---|---|---|")
    for name, t in tallies.items():
        cells = (
            f"{t.steps:,}",
            f"{t.worst_sum:.1e}",
            f"{t.least_eigenvalue:.1e}",
            f"{t.not_finite}",
            f"{t.seconds:.0f}",
        )
        print(" | ".join((f"| {name}", *cells)) + " |")
    print("\n| refused runs | " + " | ".join(tallies) + " |\n|---|" + "---|" * len(tallies))
    for words in sorted(set().union(*(t.refused for t in tallies.values()))):
        print(f"| {words} | " + " | ".join(str(t.refused[words]) for t in tallies.values()) + " |")


if __name__ == "__main__":
    main()
