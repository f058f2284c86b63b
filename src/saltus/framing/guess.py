"""Which framing a recording has, told by its structure."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.framing.capture import MAGIC, PCAPNG
from saltus.framing.containers import CONTAINERS, Container, assigned
from saltus.framing.scan import HEADER
from saltus.framing.twins import Scanner

__all__ = ["ENOUGH", "HEAD", "Credible", "Guess", "begins_capture", "explained", "guess", "sensible"]

# (category, records of a block) -> whether all of them parse in one edition; None where no definition is known.
Credible = Callable[[int, bytes], bool | None]
HEAD = 1 << 17  # bytes at the beginning that a guess looks at
ENOUGH = 8  # blocks in a row that are no accident
CHAIN = 3  # frames in a row that are worth a closer look
_GAPS = 16  # stretches without frames that a guess looks beyond
_Bytes = npt.NDArray[np.uint8]


class Guess(NamedTuple):
    """One framing, the share of the bytes looked at that its frames explain, and whether they do from the first on."""

    name: str
    share: float
    begins: bool


def guess(head: _Bytes, final: bool, scanner: Scanner, credible: Credible) -> list[Guess]:
    """Weigh the framings of a recording by its first bytes, the likeliest first; plain goes first among equals.

    Args:
        head: the first `HEAD` bytes, or all.
        final: the recording ends with them.
        scanner: the scanners in use.
        credible: what the definitions say of a block.
    """
    capture = begins_capture(head, 0)
    if capture:
        return [Guess(capture, 1.0, True)]
    plain = explained(head, 0, final, CONTAINERS[0], scanner, credible)
    if plain.share == 1.0:
        return [plain]
    others = [
        explained(head, c.file_header, final, c, scanner, credible) for c in CONTAINERS[1:] if c.file_header < len(head)
    ]
    return sorted([plain, *others], key=lambda g: (not g.begins, -g.share))


def begins_capture(data: _Bytes, position: int) -> str:
    """The name of the capture format that begins here, "" if none does."""
    head = data[position : position + 12].tobytes()
    if head[:4] == PCAPNG:
        return "pcapng" if head[8:12] in (b"\x1a\x2b\x3c\x4d", b"\x4d\x3c\x2b\x1a") else ""
    versions = (b"\0\x02\0\x04", b"\x02\0\x04\0")
    return "pcap" if head[:4] in MAGIC and head[4:8] in versions else ""


def explained(
    data: _Bytes, start: int, final: bool, container: Container, scanner: Scanner, credible: Credible
) -> Guess:
    """Weigh one container: which bytes are a file header or its believable frames."""
    known, position, covered, n, begins = assigned(), start, start, len(data), False
    for _ in range(_GAPS):
        found = scanner.scan(data, position, n, container, known)
        fits = position == start and final and found.position == n  # from the first byte to the last
        whole = found.frames > found.foreign
        if container.weak:
            believed = (fits and not start) or sensible(data, position, container, credible)
        else:
            believed = fits or container.checked or container.fill >= 0 or found.frames >= CHAIN
        if whole and believed:
            covered += found.position - position
            begins |= position == start
        further = scanner.find(data, min(found.position + 1, n), n, n, container, known, CHAIN)
        if further < 0:
            covered += 0 if final or found.broken or not whole else n - found.position
            break
        position = further
    return Guess(container.name, covered / n if covered > start else 0.0, begins)


def sensible(data: _Bytes, position: int, container: Container, credible: Credible) -> bool:
    """Whether the blocks of a container that only they hold together follow the definitions, above all the first."""
    right, judged, seen, first = 0, 0, 0, None
    while seen < ENOUGH and position + HEADER < len(data):
        size = int(data[position + 1]) << 8 | int(data[position + 2])
        if size <= HEADER or position + size > len(data):
            break
        verdict = credible(int(data[position]), data[position + HEADER : position + size].tobytes())
        first = verdict if not seen else first
        if first is False:
            return False
        right, judged, seen = right + (verdict is True), judged + (verdict is not None), seen + 1
        position += size + container.trailer
    return 2 * right >= judged if first else seen == ENOUGH and not judged
