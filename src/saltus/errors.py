"""The exceptions Saltus raises.

SaltusError
├── ModelError       a description (model, configuration, array shape) is wrong
├── DataError        an input (file, record, measurement) is wrong
└── NumericalError   a computation failed

Every message says what is wrong, where (with the values), and how to mend it.
"""

__all__ = ["DataError", "ModelError", "NumericalError", "SaltusError"]


class SaltusError(Exception):
    """Base of every exception raised on purpose."""


class ModelError(SaltusError):
    """A description is wrong: a model, a configuration or the shape of an array."""


class DataError(SaltusError):
    """An input is wrong: a file, a record or a measurement."""


class NumericalError(SaltusError):
    """A computation failed although its inputs were admissible."""
