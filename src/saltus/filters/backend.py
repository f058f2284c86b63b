"""The choice between the definition in NumPy and its compiled twin, and what this machine offers."""

import os
from collections.abc import Sequence
from functools import cache
from math import prod
from typing import Literal

import numpy as np
import numpy.typing as npt

from saltus.compiled import native_module
from saltus.errors import ModelError

__all__ = [
    "MOST_MODES",
    "MOST_STATES",
    "Backend",
    "check_settings",
    "fits_kernel",
    "instruction_set",
    "system_report",
    "thread_count",
    "use_native",
]

Backend = Literal["numpy", "native"]

MOST_STATES, MOST_MODES = 256, 65536  # limits of the compiled kernel; states, and measured components
_THREAD_WORK = 2e7  # multiply-adds below which starting a thread costs more than it saves


def use_native(backend: Backend | None) -> bool:
    """Say whether `backend` (None chooses) means the compiled kernel.

    Raises:
        ModelError: an unknown backend, or "native" where there is none.
    """
    if backend not in (None, "numpy", "native"):
        raise ModelError(f'backend is None, "numpy" or "native", not {backend!r}.')
    if backend == "numpy":
        return False
    if native_module() is not None:
        return True
    if backend == "native":
        raise ModelError(
            'backend="native", but saltus was installed without its compiled kernel: there was no C++20 compiler. '
            'Install one and reinstall saltus, or use backend="numpy".'
        )
    return False


def check_settings(keep: str, num_threads: int | None) -> None:
    """Check what the batch filters have in common.

    Raises:
        ModelError: another `keep` than "all" and "last", or no thread.
    """
    if keep not in ("all", "last"):
        raise ModelError(f'keep is "all" or "last", not {keep!r}.')
    if num_threads is not None and num_threads < 1:
        raise ModelError(f"num_threads is at least 1, not {num_threads}.")


def fits_kernel(state: npt.ArrayLike, z: npt.ArrayLike, trans: Sequence[npt.ArrayLike]) -> bool:
    """Say whether the sizes, the last axes of these arrays, are within the limits of the compiled kernel."""
    n, m, *sizes = (prod(np.shape(a)[-1:]) for a in (state, z, *trans))
    return n <= MOST_STATES and m <= MOST_STATES and prod(sizes) <= MOST_MODES


def instruction_set() -> str:
    """Return the instruction set in use: the widest this machine has, or the one that SALTUS_ISA names.

    Raises:
        ModelError: SALTUS_ISA names one that this machine or this build does not have.
    """
    native = native_module()
    names: list[str] = [] if native is None else _instruction_sets()
    wanted = os.environ.get("SALTUS_ISA", "")
    if wanted and wanted not in names:
        raise ModelError(f"SALTUS_ISA={wanted} is not available here; there is: {', '.join(names) or 'none'}.")
    return wanted or (names[0] if names else "")


@cache
def _instruction_sets() -> list[str]:
    native = native_module()
    return [] if native is None else list(native.instruction_sets())


def thread_count(num_threads: int | None, work: float) -> int:
    """Return the number of threads: as asked, else the cores this process may use when `work` is worth it.

    Args:
        num_threads: what the caller asked for.
        work: multiply-adds to do.
    """
    if num_threads is not None:
        return int(num_threads)
    if work < _THREAD_WORK:
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def system_report() -> dict[str, str]:
    """Describe the backend in use, for people: kernel, instruction set, lanes, threads."""
    native = native_module()
    threads = str(thread_count(None, float("inf")))
    if native is None:
        return {"kernel": "absent: filters run in NumPy", "threads": threads}
    isa = instruction_set()
    return {
        "kernel": "compiled",
        "instruction set": f"{isa} ({native.lanes(isa)} tracks per register)",
        "instruction sets of this machine": ", ".join(_instruction_sets()),
        "threads": threads,
    }
