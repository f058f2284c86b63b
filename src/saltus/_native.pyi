from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

_Array = npt.NDArray[np.float64]
_Rows = npt.NDArray[np.int64]

def instruction_sets() -> list[str]: ...
def lanes(isa: str) -> int: ...
def multiply_adds(isa: str, rounds: int) -> float: ...
def imm_filter(
    isa: str, z: _Array, model: dict[str, object], out: dict[str, _Array | None], every: bool, threads: int
) -> int: ...

class Bank:
    def __init__(self, isa: str, n: int, sizes: Sequence[int], capacity: int) -> None: ...
    def grow(self, capacity: int) -> None: ...
    def step(self, rows: _Rows, trans: Sequence[_Array | None], F: _Array, b: _Array | None, Q: _Array) -> None: ...
    def measure(
        self,
        rows: _Rows,
        write: bool,
        z: _Array,
        H: _Array,
        d: _Array | None,
        R: _Array,
        d2: _Array,
        log_likelihood: _Array,
    ) -> int: ...
    def moments(self, rows: _Rows, mean: _Array, cov: _Array, probs: _Array) -> None: ...
    def read(self, rows: _Rows, log_probs: _Array, means: _Array, covs: _Array) -> None: ...
    def write(self, rows: _Rows, log_probs: _Array, means: _Array, covs: _Array) -> None: ...
    def expand(
        self,
        rows: _Rows,
        now: _Rows,
        same: _Rows,
        trans: _Array,
        z: _Array,
        F: _Array,
        b: _Array | None,
        Q: _Array,
        H: _Array,
        d: _Array | None,
        R: _Array,
        law: _Array,
        log_likelihood: _Array,
    ) -> int: ...
    def merge(self, rows: _Rows, weight: _Array, label: _Rows, mass: _Array, means: _Array, covs: _Array) -> None: ...
    def copy_from(self, rows: _Rows, other: Bank, other_rows: _Rows) -> None: ...
