"""Why a filter refuses a measurement: what both backends say, with run, row and component."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, NumericalError, SaltusError
from saltus.shapes import Bool, Float

__all__ = ["NotPositive", "check_evidence", "check_finite", "not_finite", "of_runs", "place", "too_far"]

_Error = TypeVar("_Error", bound=SaltusError)


class NotPositive(NumericalError):
    """A measured component has neither noise nor uncertainty.

    Attributes:
        where: of `place`, and
        component: the number in it.
    """

    def __init__(self, where: str, component: int | None = None) -> None:
        self.where, self.component = where, component
        super().__init__(
            f"{where}: an innovation covariance S = H P H' + R is not positive definite: the component has neither "
            "noise nor uncertainty of its own. Give every measured component a positive variance in R."
        )


def place(run: Sequence[int] = (), row: int | None = None, component: int | None = None) -> str:
    """Say where: "run 3, row 2, component 1", as much of it as there is."""
    runs = f"run {run[0]}" if len(run) == 1 else f"run {[int(i) for i in run]}" if len(run) else ""
    parts = [runs, "" if row is None else f"row {row}", "" if component is None else f"component {component}"]
    return ", ".join(part for part in parts if part) or "the measurement"


def of_runs(error: _Error, refused: npt.ArrayLike) -> _Error:
    """Let an error say which runs it is about: `refused` has the axes of the batch, none for a single run."""
    if np.ndim(refused):
        error.runs = np.asarray(refused, bool).ravel()
    return error


def too_far(where: str, value: float, others: int, predicted: str = "") -> DataError:
    """A measurement so far from what every mode predicts that double precision cannot hold its distance.

    Args:
        where: of `place`.
        value: what was measured.
        others: number of other runs that were refused nothing.
        predicted: what was predicted instead, if known.
    """
    told = f", where {predicted} was predicted" if predicted else ""
    rest = f" The other {others} run(s) have no such row: z[~error.runs] holds them alone." if others else ""
    return DataError(
        f"{where} measures {value:.6g}{told}: its distance overflows double precision. Give NaN for an outlier; check "
        f"units.{rest}"
    )


def not_finite(where: str) -> NumericalError:
    """A prediction that has left the range of double precision."""
    return NumericalError(
        f"{where}: the prediction is not finite: state or covariance has overflowed. Look at F, Q, b and H, their "
        "units, and how many rows pass without a measurement."
    )


def check_evidence(
    log_f: Float[np.ndarray, "*lead"],
    y: Float[np.ndarray, "*modes m"],
    Y: Float[np.ndarray, "*_y m sources"],
    z: Float[np.ndarray, "*lead m"],
    seen: Bool[np.ndarray, "*lead m"],
    row: int | None = None,
    first: int = 0,
) -> None:
    """Refuse what has no likelihood, and say of which run, row and component it is.

    Args:
        log_f: log f(z) of every run.
        y: predicted measurements of the modes, (*lead, M1, ..., MC, m), and
        Y: their deviations by sources, as `steps.Joint` has them.
        z: the measurements.
        seen: what of them was seen.
        row: number of the row, if there is one.
        first: number of the first run.

    Raises:
        DataError: a measurement is too far from what every mode predicts.
        NumericalError: a prediction has overflowed.
    """
    refused = ~np.isfinite(log_f)
    bad = np.argwhere(refused)
    if not len(bad):
        return
    run = tuple(int(i) for i in bad[0])
    named = (run[0] + first, *run[1:]) if run else run
    (m, sources), lead = Y.shape[-2:], z.ndim - 1
    modes = y.shape[lead:-1]
    y = np.broadcast_to(y, (*z.shape[:-1], *modes, m))[run].reshape(-1, m)
    Y = np.broadcast_to(Y, (*z.shape[:-1], *modes, m, sources))[run].reshape(-1, m, sources)
    with np.errstate(all="ignore"):
        sigma = np.sqrt(np.sum(np.square(Y), axis=-1))
        away = np.where(seen[run], np.abs(z[run] - y) / sigma, 0.0)
    if not (np.isfinite(y).all() and np.isfinite(sigma).all()):
        raise of_runs(not_finite(place(named, row)), refused)
    mode = int(away.max(axis=-1).argmin())
    a = int(away[mode].argmax())
    predicted = f"{y[mode, a]:.6g} +- {sigma[mode, a]:.3g}"
    told = too_far(place(named, row, a), float(z[run][a]), int(np.isfinite(log_f).sum()), predicted)
    raise of_runs(told, refused)


def check_finite(
    mean: Float[np.ndarray, "*lead n"], cov: Float[np.ndarray, "*lead n n"], row: int | None = None
) -> None:
    """Refuse an estimate that has left the range of double precision.

    Raises:
        NumericalError: with the first run of which that is so.
    """
    sound = np.isfinite(mean).all(axis=-1) & np.isfinite(cov).all(axis=(-1, -2))
    if not sound.all():
        refused = ~np.asarray(sound)
        raise of_runs(not_finite(place([int(i) for i in np.argwhere(refused)[0]], row)), refused)
