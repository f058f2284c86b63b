"""The file header of RFF recordings: when the recording began, and the byte order of its clock."""

import datetime
import re

import numpy as np
import numpy.typing as npt

from saltus.framing.containers import Container, assigned
from saltus.framing.scan import Scan
from saltus.framing.twins import Scanner

__all__ = ["clock_order", "start_of"]

_LOOKED_AT = 200  # frames
_YEAR_FIRST = re.compile(rb"(\d{4})[-/. ]?(\d\d)[-/. ]?(\d\d)[-T/_ ]*(\d\d)[:.h]?(\d\d)[:.m]?(\d\d)")
_DAY_FIRST = re.compile(rb"(\d\d)[-/. ](\d\d)[-/. ](\d{4})[-T/_ ]*(\d\d)[:.h]?(\d\d)[:.m]?(\d\d)")


def start_of(header: bytes) -> float | None:
    """When the recording began, s, UTC, from the first 20 bytes of its header; None where they tell no date."""
    text = header[:20]
    found = _YEAR_FIRST.search(text)
    parts = [int(p) for p in found.groups()] if found else []
    if not found and (found := _DAY_FIRST.search(text)):
        day, month, year, *rest = (int(p) for p in found.groups())
        parts = [year, month, day, *rest]
    try:
        return datetime.datetime(*parts, tzinfo=datetime.UTC).timestamp() if parts else None  # type: ignore[arg-type, misc]  # six numbers
    except ValueError:
        return None


def clock_order(data: npt.NDArray[np.uint8], position: int, c: Container, scanner: Scanner) -> Container:
    """The container with the byte order by which its first times span the least."""
    piece = data[position : position + _LOOKED_AT * 512]

    def span(order: Container) -> float:
        found: Scan = scanner.scan(piece, 0, len(piece), order, assigned())
        clock = found.clock[:_LOOKED_AT]
        return float(np.abs(np.diff(clock)).sum()) + float(clock[0]) if len(clock) else 0.0

    swapped = c._replace(clock_little=True)
    return swapped if span(swapped) < span(c) else c
