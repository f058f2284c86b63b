"""What a model compiles to: the arguments of a filter, and the place of each sensor in a stacked measurement."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.errors import DataError
from saltus.models.checks import FloatArray
from saltus.models.sensors import Measured
from saltus.shapes import Float

__all__ = ["Arrays", "Layout", "stack_sensors"]


class Arrays(NamedTuple):
    """The arguments of `imm_filter`, in its shapes: C chains, axes of length 1 where nothing depends.

    Constant matrices have C + 2 axes (vectors C + 1), time-varying ones a time axis before them.
    """

    F: FloatArray  # (T?, M1|1, ..., MC|1, n, n)
    Q: FloatArray  # (T?, ..., n, n)
    H: FloatArray  # (T?, ..., m, n)
    R: FloatArray  # (T?, ..., m, m)
    trans: tuple[FloatArray, ...]  # each (T?, Mc, Mc)
    b: FloatArray | None  # (T?, ..., n)
    d: FloatArray | None  # (T?, ..., m)
    mean0: FloatArray  # (M1|1, ..., MC|1, n)
    cov0: FloatArray  # (M1|1, ..., MC|1, n, n)
    probs0: FloatArray  # (M1, ..., MC)

    def rows(self, piece: slice) -> "Arrays":
        """The arrays of a piece of the rows, with the same prior."""
        C = self.probs0.ndim

        def cut(a: FloatArray, constant: int) -> FloatArray:
            return a[piece] if a.ndim > constant and len(a) > 1 else a

        return self._replace(
            F=cut(self.F, C + 2),
            Q=cut(self.Q, C + 2),
            H=cut(self.H, C + 2),
            R=cut(self.R, C + 2),
            trans=tuple(cut(t, 2) for t in self.trans),
            b=None if self.b is None else cut(self.b, C + 1),
            d=None if self.d is None else cut(self.d, C + 1),
        )


class Layout(NamedTuple):
    """Which components of a stacked measurement belong to which sensor."""

    columns: dict[str, slice]
    n_measured: int

    def stack(
        self,
        sensor_names: Sequence[str] | npt.NDArray[np.generic],
        measurements: Sequence[npt.ArrayLike] | FloatArray,
    ) -> Float[np.ndarray, "T m"]:
        """Put each row's measurement into its sensor's components; the others are NaN, that is missing.

        Args:
            sensor_names: sensor of each row, (T,).
            measurements: measurement of each row, each of its sensor's length.

        Returns:
            (T, m).

        Raises:
            DataError: lengths differ, or a sensor is not part of this layout.
        """
        if len(sensor_names) != len(measurements):
            raise DataError(f"{len(sensor_names)} sensor names for {len(measurements)} measurements.")
        z = np.full((len(measurements), self.n_measured), np.nan)
        for row, (name, values) in enumerate(zip(sensor_names, measurements, strict=True)):
            if name not in self.columns:
                known = ", ".join(self.columns)
                raise DataError(f"row {row}: sensor {name!r} is not in this layout, which has {known}.")
            place = z[row, self.columns[name]]
            if np.shape(values) != place.shape:
                raise DataError(
                    f"row {row}: sensor {name!r} measures {place.shape[0]} component(s), got shape {np.shape(values)}."
                )
            place[:] = values
        return z


def stack_sensors(parts: Sequence[Measured]) -> Measured:
    """Stack the matrices of several sensors that measure together: rows of H, blocks of R."""
    if len(parts) == 1:
        return parts[0]
    lead = np.broadcast_shapes(*(a.shape[:-2] for part in parts for a in (part.H, part.R)))
    lead = np.broadcast_shapes(lead, *(part.d.shape[:-1] for part in parts if part.d is not None))
    sizes = [part.H.shape[-2] for part in parts]
    ends = np.cumsum(sizes)
    H = np.concatenate([np.broadcast_to(p.H, (*lead, *p.H.shape[-2:])) for p in parts], axis=-2)
    R = np.zeros((*lead, ends[-1], ends[-1]))
    d = np.zeros((*lead, ends[-1])) if any(p.d is not None for p in parts) else None
    for part, end, size in zip(parts, ends, sizes, strict=True):
        R[..., end - size : end, end - size : end] = part.R
        if d is not None and part.d is not None:
            d[..., end - size : end] = part.d
    return Measured(H, R, d)
