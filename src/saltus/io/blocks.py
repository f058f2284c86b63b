"""Data blocks of a recording: category, length, records; and the way back to them after garbage.

A block is one byte of category, two bytes of length (header included, most significant first) and its records.
"""

import re
from collections.abc import Callable
from typing import NamedTuple

from saltus.io.capture import read_packets
from saltus.io.layout import Malformed, categories, layout

__all__ = ["Block", "frame_capture", "frame_plain", "looks_like_asterix"]

_HEADER = 3
_CHAIN = 3  # headers that follow each other to the end of the file by no accident


class Block(NamedTuple):
    """One data block: its records are `data[3:]`."""

    category: int
    offset: int  # of the header in the file
    data: bytes
    clock: float  # s, UTC, when it was captured; NaN for plain files
    cut: bool  # the file ends within it


def looks_like_asterix(data: bytes) -> bool:
    """Tell whether the file opens with a block of a known category whose records follow a known edition."""
    length = _length(data, 0)
    return length > _HEADER and length <= len(data) and _systems(data[0], data[_HEADER:length]) is not None


def frame_plain(data: bytes, name: str) -> tuple[list[Block], list[str]]:
    """Cut a plain ASTERIX file into blocks.

    As long as headers follow each other to the end of the file they are believed. Otherwise every block is held
    against the definitions, and after bytes that are none the search goes on for the next block whose records
    parse, whose system has been met, and which another block or the end of the file follows.

    Args:
        data: the whole file.
        name: its name, for messages.

    Returns:
        The blocks, and what was skipped.
    """
    blocks = []
    nan = float("nan")
    position = 0
    while position < len(data):
        length = int.from_bytes(data[position + 1 : position + 3], "big")
        stop = position + length
        if length <= _HEADER or stop > len(data):
            return _frame_doubtful(data, name)
        blocks.append(Block(data[position], position, data[position:stop], nan, False))
        position = stop
    if len(blocks) < _CHAIN and any(b.category not in categories() for b in blocks):
        return _frame_doubtful(data, name)
    return blocks, []


def frame_capture(data: bytes, name: str) -> tuple[list[Block], list[str]]:
    """Cut the UDP payloads of a packet capture into blocks; a payload that breaks off loses its own rest only."""
    packets, problems = read_packets(data, name)
    blocks = []
    foreign: list[int] = []
    for packet in packets:
        position, payload = 0, packet.payload
        while position < len(payload):
            length = int.from_bytes(payload[position + 1 : position + 3], "big")
            if length <= _HEADER or position + length > len(payload):
                if position == 0:
                    foreign.append(packet.offset)
                else:
                    problems.append(f"{name}: byte {packet.offset + position}: the packet ends within a block.")
                break
            chunk = payload[position : position + length]
            blocks.append(Block(chunk[0], packet.offset + position, chunk, packet.clock, False))
            position += length
    if foreign:
        problems.append(f"{name}: {len(foreign)} UDP payloads are not ASTERIX, the first at byte {foreign[0]}.")
    return blocks, problems


def _frame_doubtful(data: bytes, name: str) -> tuple[list[Block], list[str]]:
    """Frame a file whose headers do not follow each other to its end."""
    blocks: list[Block] = []
    problems: list[str] = []
    met: set[tuple[int, bytes]] = set()
    position = 0
    while position < len(data):
        stop = position + _length(data, position)
        whole = position + _HEADER < stop <= len(data)
        systems = _systems(data[position], data[position + _HEADER : stop]) if whole else None
        if systems is not None or (whole and _starts_block(data, stop, met)):
            met |= {(data[position], s) for s in systems or ()}
            blocks.append(_block(data, position, stop))
            position = stop
            continue
        following = _search(data, position + 1, met)
        if following is None:
            problems.append(_last_words(data, position, name))
            if stop > len(data) and data[position] in categories():
                blocks.append(_block(data, position, len(data), cut=True))
            break
        problems.append(
            f"{name}: byte {position}: no ASTERIX block; skipped {following - position} bytes to the next one."
        )
        position = following
    return blocks, problems


def _last_words(data: bytes, position: int, name: str) -> str:
    length, left = _length(data, position), len(data) - position
    if left >= _HEADER and data[position] in categories() and length > left:
        return (
            f"{name}: byte {position}: the block of category {data[position]} says {length} bytes, {left} are left: "
            "truncated; its whole records are used."
        )
    return f"{name}: byte {position}: no ASTERIX block, and none follows; the last {left} bytes are not used."


def _search(data: bytes, start: int, met: set[tuple[int, bytes]]) -> int | None:
    """First position from `start` on where a block of a system already met begins (any, when none was met)."""
    known = sorted({category for category, _ in met} or set(categories()))
    for match in re.finditer(b"[" + re.escape(bytes(known)) + b"]", data[start:], re.DOTALL):
        if _starts_block(data, start + match.start(), met) and start + match.start() < len(data):
            return start + match.start()
    return None


def _starts_block(data: bytes, position: int, met: set[tuple[int, bytes]]) -> bool:
    """Whether a credible block starts here, or the file ends."""
    if position == len(data):
        return True
    stop = position + _length(data, position)
    if stop <= position + _HEADER or stop > len(data):
        return False
    if stop < len(data) and not (data[stop] in categories() or stop + _HEADER > len(data)):
        return False
    systems = _systems(data[position], data[position + _HEADER : stop])
    return systems is not None and (not met or any((data[position], s) in met for s in systems))


def _systems(category: int, payload: bytes) -> set[bytes] | None:
    """The data sources (item 010) of records that all parse in one edition, or None."""
    for edition in reversed(categories().get(category, {})):
        found = _try(layout(category, edition).walk, payload)
        if found:
            return found
    return None


def _try(
    walk: Callable[[bytes, int, int], tuple[bytes, dict[str, tuple[int, int]], int]], payload: bytes
) -> set[bytes] | None:
    found = set()
    position = 0
    try:
        while position < len(payload):
            _, spans, position = walk(payload, position, len(payload))
            start, stop = spans["010"]
            found.add(payload[start:stop])
    except (Malformed, KeyError):
        return None
    return found


def _length(data: bytes, position: int) -> int:
    return int.from_bytes(data[position + 1 : position + 3], "big")


def _block(data: bytes, start: int, stop: int, *, cut: bool = False) -> Block:
    return Block(data[start], start, data[start:stop], float("nan"), cut)
