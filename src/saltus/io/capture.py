"""UDP payloads of packet captures: classic pcap (both byte orders, micro- and nanoseconds) and pcapng."""

import struct
from collections.abc import Iterator
from typing import NamedTuple

from saltus.errors import DataError

__all__ = ["CAPTURE_MAGIC", "Packet", "read_packets"]

# magic number as it lies in the file -> (byte order, clock ticks per second)
_CLASSIC = {
    b"\xa1\xb2\xc3\xd4": (">", 1e6),
    b"\xd4\xc3\xb2\xa1": ("<", 1e6),
    b"\xa1\xb2\x3c\x4d": (">", 1e9),
    b"\x4d\x3c\xb2\xa1": ("<", 1e9),
}
_PCAPNG = b"\x0a\x0d\x0d\x0a"
CAPTURE_MAGIC = (*_CLASSIC, _PCAPNG)

_LOOPBACK, _ETHERNET, _COOKED, _COOKED_2 = (0, 108), (1,), (113,), (276,)  # link types of the pcap registry
_RAW_IP = (12, 14, 101, 228, 229)
_VLAN = (0x8100, 0x88A8, 0x9100)
_IPV4, _IPV6 = 0x0800, 0x86DD
_UDP = 17


class Packet(NamedTuple):
    """One UDP payload: where it lies in the file, when it was captured (s, UTC), and its bytes."""

    offset: int
    clock: float
    payload: bytes


def read_packets(data: bytes, name: str) -> tuple[list[Packet], list[str]]:
    """Take the UDP payloads out of a capture.

    Args:
        data: the whole file.
        name: its name, for messages.

    Returns:
        The payloads in file order, and what could not be read (other protocols are passed over in silence).

    Raises:
        DataError: the link type is not Ethernet, Linux cooked, raw IP or loopback.
    """
    problems: list[str] = []
    frames = _pcapng(data, name, problems) if data[:4] == _PCAPNG else _classic(data, name, problems)
    packets = []
    n_fragments = n_cut = 0
    for offset, clock, link, frame, whole in frames:
        ip = _network(frame, link, name)
        if ip is None:
            continue
        start, stop, fragment = _udp(frame, ip)
        if fragment:
            n_fragments += 1
        elif start:
            n_cut += stop > len(frame) or not whole
            packets.append(Packet(offset + start, clock, frame[start:stop]))
    if n_fragments:
        problems.append(f"{name}: {n_fragments} fragmented IP packets were not put together and not read.")
    if n_cut:
        problems.append(f"{name}: {n_cut} packets were cut by the capture (snap length); the rest of each is lost.")
    return packets, problems


def _classic(data: bytes, name: str, problems: list[str]) -> Iterator[tuple[int, float, int, bytes, bool]]:
    """Yield (offset, time, link type, frame, whole) of each record of a classic capture."""
    order, ticks = _CLASSIC[data[:4]]
    if len(data) < 24:
        raise DataError(f"{name}: byte {len(data)}: the capture ends within its header of 24 bytes.")
    link = struct.unpack(order + "I", data[20:24])[0] & 0xFFFF
    position = 24
    while position < len(data):
        if position + 16 > len(data):
            problems.append(f"{name}: byte {position}: the capture ends within a packet header.")
            return
        seconds, fraction, size, original = struct.unpack(order + "4I", data[position : position + 16])
        position += 16
        frame = data[position : position + size]
        if len(frame) < size:
            left = len(data) - position
            problems.append(f"{name}: byte {position}: a packet of {size} bytes, {left} are left; not read.")
            return
        yield position, seconds + fraction / ticks, link, frame, size >= original
        position += size


def _pcapng(data: bytes, name: str, problems: list[str]) -> Iterator[tuple[int, float, int, bytes, bool]]:
    """Yield the packets of enhanced and simple packet blocks; interfaces are numbered anew in each section."""
    order = "<"
    links: list[tuple[int, float]] = []
    position = 0
    while position + 12 <= len(data):
        kind = data[position : position + 4]
        if kind == _PCAPNG:
            order = ">" if data[position + 8 : position + 12] == b"\x1a\x2b\x3c\x4d" else "<"
            links = []
        number, length = struct.unpack(order + "2I", data[position : position + 8])
        if length < 12 or length % 4 or position + length > len(data):
            break
        body = data[position + 8 : position + length - 4]
        if number == 1 and len(body) >= 8:
            links.append((struct.unpack(order + "H", body[:2])[0], _ticks(body[8:], order)))
        elif number == 6 and len(body) >= 20:
            interface, high, low, size, original = struct.unpack(order + "5I", body[:20])
            if interface < len(links):
                link, ticks = links[interface]
                clock = ((high << 32) | low) / ticks
                yield position + 28, clock, link, body[20 : 20 + size], size >= original
        elif number == 3 and len(body) >= 4 and links:
            original = struct.unpack(order + "I", body[:4])[0]
            frame = body[4 : 4 + original]
            yield position + 12, float("nan"), links[0][0], frame, len(frame) >= original
        position += length
    if position != len(data):
        problems.append(f"{name}: byte {position}: not a whole pcapng block; the rest of the file was not read.")


def _ticks(options: bytes, order: str) -> float:
    """Clock ticks per second of an interface: option 9, default microseconds."""
    position = 0
    while position + 4 <= len(options):
        code, length = struct.unpack(order + "2H", options[position : position + 4])
        if code == 9 and length == 1:
            exponent = options[position + 4]
            return float(2 ** (exponent & 0x7F)) if exponent & 0x80 else 10.0**exponent
        if code == 0:
            break
        position += 4 + (length + 3) // 4 * 4
    return 1e6


def _network(frame: bytes, link: int, name: str) -> int | None:
    """Where the IP header starts, or None when the frame carries something else."""
    if link in _ETHERNET:
        position = 12
    elif link in _COOKED:
        position = 14
    elif link in _COOKED_2:
        position = 0
    elif link in _RAW_IP:
        return 0 if frame else None
    elif link in _LOOPBACK:
        return 4 if len(frame) > 4 else None
    else:
        raise DataError(
            f"{name}: link type {link} of the capture is not read. Record on Ethernet, Linux cooked, raw IP or "
            "loopback, or save the UDP payloads as a plain ASTERIX file."
        )
    kind = int.from_bytes(frame[position : position + 2], "big")
    if link in _COOKED_2:
        position = 18
    while kind in _VLAN:
        position += 4
        kind = int.from_bytes(frame[position : position + 2], "big")
    return position + 2 if kind in (_IPV4, _IPV6) else None


def _udp(frame: bytes, ip: int) -> tuple[int, int, bool]:
    """Start and stop of the UDP payload (0, 0 when it is not UDP), and whether it is a fragment."""
    version = frame[ip] >> 4 if ip < len(frame) else 0
    if version == 4 and len(frame) >= ip + 20 and frame[ip + 9] == _UDP:
        if int.from_bytes(frame[ip + 6 : ip + 8], "big") & 0x3FFF:
            return 0, 0, True
        header = ip + (frame[ip] & 15) * 4
    elif version == 6 and len(frame) >= ip + 40 and frame[ip + 6] == _UDP:
        header = ip + 40
    else:
        return 0, 0, False
    if len(frame) < header + 8:
        return 0, 0, False
    length = int.from_bytes(frame[header + 4 : header + 6], "big")
    return header + 8, header + max(length, 8), False
