"""The compiled twins, where they were built."""

import logging
import os
from functools import cache
from types import ModuleType

__all__ = ["native_module"]


@cache
def native_module() -> ModuleType | None:
    """Return the compiled kernel, or None where it was not built (said once in the log)."""
    try:
        from saltus import _native
    except ImportError as error:
        if os.environ.get("SALTUS_REQUIRE_NATIVE") == "1":
            raise ImportError(
                "SALTUS_REQUIRE_NATIVE=1, but saltus was installed without its compiled kernel "
                f"({error}). Install a C++20 compiler and reinstall saltus."
            ) from error
        logging.getLogger("saltus").warning("the compiled kernel is absent (%s): all runs in NumPy and Python", error)
        return None
    return _native
