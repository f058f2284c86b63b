"""What a captured frame carries: link types, Ethernet types, fragments of IP."""

import struct
from enum import IntEnum

from saltus.framing.scan import Bytes

__all__ = ["Passed", "joined", "network", "ticks_of"]

_LOOPBACK, _ETHERNET, _COOKED, _COOKED_2 = (0, 108), (1,), (113,), (276,)  # link types of the pcap registry
_RAW_IP = (12, 14, 101, 228, 229)
_VLAN = (0x8100, 0x88A8, 0x9100)
_IPV4, _IPV6 = 0x0800, 0x86DD


class Passed(IntEnum):
    """Why a packet gave no block; the number beside it says which."""

    LINK = 0  # link type
    ETHERTYPE = 1
    LENGTH = 2  # IEEE 802.3 frame that names no protocol
    PROTOCOL = 3  # IP protocol
    PORT = 4  # UDP destination port; its payload is no ASTERIX
    BROKEN = 5  # IP or UDP header that cannot be
    CUT = 6  # blocks lost: the capture kept the packet's beginning only
    TORN = 7  # blocks lost: the payload ends within a block
    MISSING = 8  # parts of a datagram whose others did not come


def joined(parts: dict[int, bytes]) -> bytes | None:
    """The datagram, or None while a part is missing."""
    if -1 not in parts:
        return None
    whole = bytearray()
    for place in sorted(p for p in parts if p >= 0):
        if place > len(whole):
            return None
        whole += parts[place][len(whole) - place :]
    return bytes(whole)


def ticks_of(options: bytes, order: str) -> tuple[float, float]:
    """Clock ticks per second of a pcapng interface (option 9, default microseconds), and its offset in s (14)."""
    ticks, shift, position = 1e6, 0.0, 0
    while position + 4 <= len(options):
        code, length = struct.unpack(order + "2H", options[position : position + 4])
        value = options[position + 4 : position + 4 + length]
        if code == 9 and len(value) == 1:
            ticks = float(2 ** (value[0] & 0x7F)) if value[0] & 0x80 else 10.0 ** value[0]
        if code == 14 and len(value) == 8:
            shift = float(struct.unpack(order + "q", value)[0])
        if code == 0:
            break
        position += 4 + (length + 3) // 4 * 4
    return ticks, shift


def network(data: Bytes, start: int, end: int, link: int) -> tuple[int, int, int]:
    """Where the IP header is; else -1 and what the frame carries."""
    if link in _RAW_IP:
        return start, 0, 0
    if link in _LOOPBACK:
        return start + 4, 0, 0
    if link in _ETHERNET:
        at = start + 12
    elif link in _COOKED:
        at = start + 14
    elif link in _COOKED_2:
        at = start
    else:
        return -1, Passed.LINK, link
    kind = _kind(data, at, end)
    if link in _COOKED_2:
        at = start + 18
    while kind in _VLAN:
        at += 4
        kind = _kind(data, at, end)
    if kind in (_IPV4, _IPV6):
        return at + 2, 0, 0
    return (-1, Passed.LENGTH, 0) if kind < 0x0600 else (-1, Passed.ETHERTYPE, kind)


def _kind(data: Bytes, at: int, end: int) -> int:
    return data[at] << 8 | data[at + 1] if at + 2 <= end else 0
