"""The multimode filter of a described model, over records of one object."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError, ModelError
from saltus.filters.estimates import Estimates
from saltus.filters.imm import imm_filter
from saltus.models import HybridModel

__all__ = ["IMM", "Record"]


class Record(NamedTuple):
    """One measurement of one object: time (s), name of the sensor, values (m,) in the sensor's units."""

    time: float
    sensor: str
    z: npt.ArrayLike


@dataclass(frozen=True, slots=True)
class IMM:
    """The interacting-multiple-model filter on the product of a model's chains.

    `IMM(model).run(records)` filters records; `IMM(per_mode=True)` holds settings, and a call with a model binds it.

    Attributes:
        model: the model it is bound to, or None.
        per_mode: keep every mode's mean and covariance.
    """

    model: HybridModel | None = None
    per_mode: bool = False

    def __call__(self, model: HybridModel) -> "IMM":
        """Bind the settings to a model."""
        return replace(self, model=model)

    def run(self, records: Iterable[Record | tuple[float, str, npt.ArrayLike]]) -> Estimates:
        """Filter records of one object, in time order, from any of the model's sensors, at any intervals.

        The prior holds at the first record, unless it names a time. Records of the same time are separate rows with
        no interval between them.

        Args:
            records: (time, sensor, values) each; NaN is a missing component.

        Returns:
            Estimates with one row per record.

        Raises:
            ModelError: the filter is bound to no model, or a sensor is unknown.
            DataError: there is no record, or time goes back.
        """
        if self.model is None:
            raise ModelError("this filter is bound to no model: write IMM(model).run(records).")
        listed = [Record(*record) for record in records]
        if not listed:
            raise DataError("there is no record to filter.")
        times = np.array([record.time for record in listed], dtype=np.float64)
        back = np.flatnonzero(np.diff(times) < 0)
        if len(back):
            k = int(back[0]) + 1
            raise DataError(
                f"record {k} at {times[k]} s is older than record {k - 1} at {times[k - 1]} s; sort by time."
            )
        names = [record.sensor for record in listed]
        layout, arrays = self.model.arrays_for(times, names)
        z = layout.stack(names, [record.z for record in listed])
        found = imm_filter(z, **arrays._asdict(), per_mode=self.per_mode)
        return replace(found, chains=tuple(chain.name for chain in self.model.chains), times=times)
