"""The scanners in use: the compiled twins where they were built, else their definitions."""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from saltus.compiled import native_module
from saltus.framing import capture, scan
from saltus.framing.capture import Capture, Taken
from saltus.framing.containers import Container, assigned
from saltus.framing.scan import Known, Scan

__all__ = ["DEFINITION", "Packets", "Scanner", "compiled", "scanner"]

_Bytes = npt.NDArray[np.uint8]


@runtime_checkable
class Packets(Protocol):
    """What takes the packets of a capture apart: `saltus.framing.capture.Capture` or its twin."""

    @property
    def passed(self) -> dict[tuple[int, int], tuple[int, int]]:
        """(Passed, number) -> how many packets gave no block, and the byte of the first."""

    @property
    def channels(self) -> list[bytes]:
        """Addresses and ports of each channel."""

    def begin(self, head: bytes) -> int:
        """Read the magic number; return the size of the header."""

    def scan(self, data: _Bytes, start: int, stop: int, base: int) -> Taken:
        """Take the blocks of the packets."""

    def record(self, data: _Bytes, position: int, stop: int) -> int:
        """Size of a record: 0 when bytes are lacking, -1 when it is none."""

    def finish(self) -> None:
        """Count the parts that no others came to."""


class Scanner(NamedTuple):
    """The functions of `saltus.framing.scan`, and what takes captures apart."""

    scan: Callable[[_Bytes, int, int, Container, Known], Scan]
    holds: Callable[[_Bytes, int, int, Container, Known, int], bool]
    find: Callable[[_Bytes, int, int, int, Container, Known, int], int]
    packets: Callable[[], Packets]


DEFINITION = Scanner(scan.scan, scan.holds, scan.find, Capture)


@cache
def compiled() -> Scanner | None:
    """The compiled twins, or None where they were not built."""
    native = native_module()
    if native is None:
        return None

    def scan_frames(data: _Bytes, start: int, stop: int, container: Container, known: Known) -> Scan:
        found = Scan(*native.scan_frames(data, start, stop, _numbers(container), known.view(np.uint8)))
        return found._replace(offset=found.offset.view(np.int64), frame=found.frame.view(np.int64))  # not long long

    def holds_frames(data: _Bytes, start: int, stop: int, container: Container, known: Known, count: int) -> bool:
        return bool(native.holds_frames(data, start, stop, _numbers(container), known.view(np.uint8), count))

    def find_frames(
        data: _Bytes, start: int, last: int, stop: int, container: Container, known: Known, count: int
    ) -> int:
        return int(native.find_frames(data, start, last, stop, _numbers(container), known.view(np.uint8), count))

    return Scanner(scan_frames, holds_frames, find_frames, _Compiled)


def scanner() -> Scanner:
    """The scanners to use."""
    return compiled() or DEFINITION


class _Compiled:
    def __init__(self) -> None:
        native = native_module()
        assert native is not None
        self._capture = native.Capture([_numbers(c) for c in capture.INSIDE], assigned().view(np.uint8))

    @property
    def passed(self) -> dict[tuple[int, int], tuple[int, int]]:
        return dict(self._capture.passed)

    @property
    def channels(self) -> list[bytes]:
        return list(self._capture.channels)

    def begin(self, head: bytes) -> int:
        return int(self._capture.begin(head))

    def scan(self, data: _Bytes, start: int, stop: int, base: int) -> Taken:
        taken = Taken(*self._capture.scan(data, start, stop, base))
        offset, at = taken.offset.view(np.int64), taken.at.view(np.int64)
        return taken._replace(offset=offset, at=at, cut=taken.cut.view(np.bool_))

    def record(self, data: _Bytes, position: int, stop: int) -> int:
        return int(self._capture.record(data, position, stop))

    def finish(self) -> None:
        self._capture.finish()


def _numbers(c: Container) -> tuple[object, ...]:
    return (
        *(c.header, c.trailer, c.length_at, c.little, c.whole, c.checked, c.fill, c.idle, c.opening),
        *(c.clock_at, c.clock_bytes, c.clock_step, c.clock_little, c.channel_at),
    )
