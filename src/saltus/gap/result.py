"""What a comparison found: figures with intervals, and a verdict in words."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import NamedTuple

__all__ = ["LIMIT", "Candidate", "Figure", "Gap", "Group", "verdict"]

LIMIT = 0.05  # loss of RMSE from which another filter is worth its time
_DOUBTFUL = 0.25  # posterior standard deviations: with such an error of its own a reference is none
_ROUND_OFF = 1e-9  # of a ratio of RMSE: two filters that compute the same thing


class Figure(NamedTuple):
    """A figure over runs with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


class Group(NamedTuple):
    """Of states judged together: root mean squares over runs, rows and these states."""

    rmse_fast: Figure
    rmse_reference: Figure
    loss: Figure  # rmse_fast / rmse_reference - 1, paired over runs
    stated_fast: float  # standard deviation the filter claims
    stated_reference: float
    bound: float  # no filter can be better


class Candidate(NamedTuple):
    """Another filter on the same runs."""

    name: str
    loss: dict[str, Figure]  # of RMSE against the reference, by group
    cost: float  # its time over the fast filter's


@dataclass(frozen=True, slots=True)
class Gap:
    """How far a fast filter is from the optimum.

    Attributes:
        title: of the model.
        fast: name of the fast filter.
        reference: name of the reference.
        runs: simulated runs.
        steps: measurements of each.
        groups: states judged together.
        probability: rms difference of the joint mode probabilities, fast against reference.
        brier: mean of sum (P - truth)^2 over the modes, fast minus reference: 0 is no loss.
        log_likelihood: reference minus fast, nats per measurement.
        nees_fast, nees_reference: mean normalised squared error over n; 1 is honest, above is too sure.
        reference_error: the reference's own error, posterior standard deviations (rms of its 95 % bounds).
        late: share of the fast filter's excess squared error within three rows after a change of mode, and the share
            of rows that lie there.
        candidates: other filters, tried where the fast one loses.
        verdict: in words.
    """

    title: str
    fast: str
    reference: str
    runs: int
    steps: int
    groups: Mapping[str, Group]
    probability: Figure
    brier: Figure
    log_likelihood: Figure
    nees_fast: Figure
    nees_reference: Figure
    reference_error: float
    late: tuple[float, float]
    candidates: tuple[Candidate, ...] = ()
    verdict: str = ""

    @property
    def worst(self) -> str:
        """The group in which the fast filter loses most."""
        return max(self.groups, key=lambda name: self.groups[name].loss.value)

    def to_dict(self) -> dict[str, object]:
        """Plain names and numbers, for JSON."""
        plain = asdict(self)
        plain["groups"] = {
            name: {key: _plain(value) for key, value in group._asdict().items()} for name, group in self.groups.items()
        }
        plain["candidates"] = [
            {"name": c.name, "cost": c.cost, "loss": {k: _plain(v) for k, v in c.loss.items()}} for c in self.candidates
        ]
        for key in ("probability", "brier", "log_likelihood", "nees_fast", "nees_reference"):
            plain[key] = _plain(getattr(self, key))
        return {**plain, "late": list(self.late)}

    def lines(self) -> list[str]:
        """The table a person reads."""
        head = f"{self.fast} against {self.reference}, {self.runs} runs of {self.steps} measurements"
        out = [self.title, head] if self.title else [head]
        wide = max(9, *(len(name) for name in self.groups))
        out.append(
            f"  {'RMSE of':<{wide}}  {'fast':>10}  {'reference':>10}  {'loss (95 %)':>26}  {'bound':>10}  "
            f"{'stated: fast':>12}  {'reference':>10}"
        )
        for name, g in self.groups.items():
            out.append(
                f"  {name:<{wide}}  {g.rmse_fast.value:>10.4g}  {g.rmse_reference.value:>10.4g}  "
                f"{percent(g.loss):>26}  {g.bound:>10.4g}  {g.stated_fast:>12.4g}  {g.stated_reference:>10.4g}"
            )
        out += [
            f"mode probabilities differ by {self.probability.value:.3f} (rms)",
            f"Brier score worse by {spread(self.brier)}",
            f"log-likelihood lost: {spread(self.log_likelihood)} nats per measurement",
            f"NEES / n: fast {spread(self.nees_fast)}, reference {spread(self.nees_reference)}",
            f"the reference's own error: {self.reference_error:.4f} posterior standard deviations",
        ]
        for c in self.candidates:
            worst = max(c.loss, key=lambda name: c.loss[name].value)
            out.append(f"  {c.name}: {percent(c.loss[worst])} in {worst}, at {c.cost:.1f} times the time")
        return [*out, self.verdict]


def percent(f: Figure) -> str:
    """A share as per cent with its interval."""
    return f"{100 * f.value:+.1f} % ({100 * f.low:+.1f} to {100 * f.high:+.1f})"


def spread(f: Figure) -> str:
    """A figure with its interval."""
    digits = ".4f" if abs(f.value) < 1e4 else ".3g"
    return f"{f.value:{digits}} ({f.low:{digits}} to {f.high:{digits}})"


def verdict(gap: Gap, linear: bool) -> str:
    """Say in words what the figures mean."""
    loss = gap.groups[gap.worst].loss
    if gap.reference_error > _DOUBTFUL or any(g.loss.high < -_ROUND_OFF for g in gap.groups.values()):
        return (
            f"No verdict: the reference itself is off by {gap.reference_error:.2f} posterior standard deviations, "
            "or worse than what it is to judge. Take more particles (--particles)."
        )
    if loss.high < LIMIT:
        told = (
            f"{gap.fast} is as good as optimal here: in {gap.worst}, where it loses most, its RMSE is "
            f"{percent(loss)} above the reference's. Another filter has nothing to gain."
        )
    elif loss.low > LIMIT:
        told = f"{gap.fast} loses {percent(loss)} in {gap.worst}. {_why(gap, linear)} {_offer(gap)}"
    else:
        told = (
            f"{gap.fast} loses {percent(loss)} in {gap.worst}: the interval includes {100 * LIMIT:.0f} %. "
            f"{_offer(gap) if gap.candidates else ''}".rstrip()
            + " More runs would tell (--runs)."
        )
    return told + _honesty(gap)


def _why(gap: Gap, linear: bool) -> str:
    within = [c for c in gap.candidates if max(f.value for f in c.loss.values()) < gap.groups[gap.worst].loss.value / 2]
    if linear and any(c.name.startswith("GPB2") for c in within):
        why = "Why: it merges histories by their newest mode before the measurement can tell them apart."
    elif linear and within:
        why = "Why: what tells the modes apart comes several measurements late, after their histories were merged."
    elif not linear and within:
        why = (
            "Why: it replaces the sensor by its tangent at the predicted mean, and the sensor bends too much for that."
        )
    else:
        why = "Why: its one Gaussian per mode cannot hold the posterior, which has several pieces."
    share, rows = gap.late
    if share > 1.5 * rows:
        why += (
            f" {100 * share:.0f} % of the excess falls within three rows after a change of mode, where "
            f"{100 * rows:.0f} % of all rows are."
        )
    return why


def _offer(gap: Gap) -> str:
    good = [c for c in gap.candidates if max(f.value for f in c.loss.values()) < LIMIT]
    if not good:
        return "Of the filters tried only the reference itself does not: take it, or fewer particles of it."
    best = min(good, key=lambda c: c.cost)
    worst = max(best.loss.values(), key=lambda f: f.value)
    return f"{best.name} does not: {percent(worst)}, at {best.cost:.1f} times the time."


def _honesty(gap: Gap) -> str:
    fast, reference = gap.nees_fast, gap.nees_reference
    if fast.low > max(1.05, reference.high):
        return f" Its covariance is too small: NEES / n is {fast.value:.2f}, the reference's {reference.value:.2f}."
    if fast.high < min(0.95, reference.low):
        return f" Its covariance is too large: NEES / n is {fast.value:.2f}, the reference's {reference.value:.2f}."
    return ""


def _plain(value: object) -> object:
    return value._asdict() if isinstance(value, Figure) else value
