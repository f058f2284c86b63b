"""The exceptions Saltus raises.

SaltusError
├── ModelError       a description (model, configuration, array shape) is wrong
├── DataError        an input (file, record, measurement) is wrong
└── NumericalError   a computation failed

Every message says what is wrong, where (with the values), and how to mend it.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

__all__ = ["DataError", "ModelError", "NumericalError", "SaltusError"]


class SaltusError(Exception):
    """Base of every exception raised on purpose.

    Attributes:
        runs: where a batch filter refuses some of its runs: which, (runs,), True for those known to be refused, in the
            order of `z.reshape(-1, T, m)`; a later row of another may yet be. None where it is no matter of one run.
    """

    runs: "npt.NDArray[np.bool_] | None" = None


class ModelError(SaltusError):
    """A description is wrong: a model, a configuration or the shape of an array."""


class DataError(SaltusError):
    """An input is wrong: a file, a record or a measurement."""


class NumericalError(SaltusError):
    """A computation failed although its inputs were admissible."""
