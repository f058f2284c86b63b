"""Recordings of every container, made of blocks; each builder repeats what its container's description says."""

import binascii
import struct

from saltus.framing import Framer
from saltus.io.blocks import credible


def radar_block(k, *, sic=0x81):
    """One CAT048 record, 31 bytes: number k of a radar that reports every 1/16 s from 100 s on."""
    tod = 12800 + 8 * k
    head = bytes.fromhex(f"30001f fdc102 14{sic:02x}") + tod.to_bytes(3, "big")
    rho, theta = 2560 + k % 9, 37 * k % 65536
    return head + bytes.fromhex(f"a0 {rho:04x}{theta:04x} 029c 0190 3c6444 10c231820820 2000")


def blocks(n):
    """A north marker every 32 reports, so lengths differ."""
    made = []
    for k in range(n):
        if k % 32 == 0:
            made.append(
                bytes.fromhex("22 000c e8 1481 01") + (12800 + 8 * k).to_bytes(3, "big") + bytes.fromhex("0200")
            )
        made.append(radar_block(k))
    return made


def time_of_day(k):
    return 100.0 + k / 64


def plain(bodies):
    return b"".join(bodies)


def gps(bodies):
    frames = [b + bytes(6) + round(time_of_day(k) * 128).to_bytes(3, "big") + b"\x07" for k, b in enumerate(bodies)]
    return b"\xcd" * 2200 + b"".join(frames)


def ioss(bodies, *, sequence=False, line=1):
    out = []
    for k, body in enumerate(bodies):
        clock = round(time_of_day(k) * 100).to_bytes(3, "big")
        number = struct.pack(">I", k) if sequence else b""
        length = 8 + len(number) + len(body) + 4
        out.append(struct.pack(">H", length) + number + bytes([3, line, 7]) + clock + body + b"\xa5" * 4)
    return b"".join(out)


def ioss_seq(bodies):
    return ioss(bodies, sequence=True)


def oradis(bodies):
    return b"".join(struct.pack(">HI", 6 + len(b), 1000 + k) + b for k, b in enumerate(bodies))


def rff(bodies, *, order=">", start=b"2023-05-02 08:00:00\0"):
    frames = [
        struct.pack(order + "I", round(1e3 * time_of_day(k))) + struct.pack("<H", len(b)) + b
        for k, b in enumerate(bodies)
    ]
    return start + b"2023-05-02 09:00:00\0" + bytes(88) + b"".join(frames)


def hdlc(bodies, *, idle=b""):
    """The check sum of ISO/IEC 13239 is the CRC of CCITT on bits turned around, here by way of the standard library."""

    def turned(data):
        return bytes(int(f"{byte:08b}"[::-1], 2) for byte in data)

    out = []
    for body in bodies:
        frame = b"\x01\x03" + body
        crc = binascii.crc_hqx(turned(frame), 0xFFFF) ^ 0xFFFF
        out.append(frame + turned(struct.pack(">H", crc)) + idle)
    return b"".join(out)


CONTAINERS = {
    "plain": plain,
    "gps": gps,
    "ioss": ioss,
    "ioss-seq": ioss_seq,
    "oradis": oradis,
    "rff": rff,
    "hdlc": hdlc,
}


def frame(data, *, piece=None, framing=None, using=None, judge=credible):
    """All blocks as (category, byte of the file, bytes, clock, cut), and what was told."""
    framer = Framer("a.rec", judge, framing=framing, using=using)
    got = []
    pieces = [data] if piece is None else [data[k : k + piece] for k in range(0, len(data), piece)]
    for chunk in [*(c for p in pieces for c in framer.feed(p)), *framer.finish()]:
        for k in range(len(chunk)):
            start, size = int(chunk.offset[k]), int(chunk.length[k])
            body = chunk.data[start : start + size].tobytes()
            clock = None if chunk.clock[k] != chunk.clock[k] else float(chunk.clock[k])
            assert chunk.category[k] == body[0]
            got.append((body[0], int(chunk.at[k]), body, clock, bool(chunk.cut[k])))
    return got, framer.told


# Packets ---------------------------------------------------------------------------------------------------------


def udp(payload, *, port=8600, size=None):
    return struct.pack(">HHHH", 4000, port, 8 + len(payload) if size is None else size, 0) + payload


def ipv4(data, *, protocol=17, flags=0, number=0, host=1):
    head = struct.pack(
        ">BBHHHBBH4s4s",
        0x45,
        0,
        20 + len(data),
        number,
        flags,
        64,
        protocol,
        0,
        bytes([10, 0, 0, host]),
        bytes([239, 1, 1, 1]),
    )
    return head + data


def ipv6(data, *, protocol=17):
    return struct.pack(">IHBB", 0x60000000, len(data), protocol, 64) + bytes(15) + b"\x01" + b"\xff" + bytes(15) + data


def ethernet(data, *, kind=0x0800, tags=b""):
    return bytes(12) + tags + struct.pack(">H", kind) + data


def pcap(frames, *, order="<", link=1, start=1_700_000_000, step=1.0):
    data = struct.pack(order + "IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, link)
    for k, f in enumerate(frames):
        seconds, micro = divmod(round(1e6 * (start + k * step)), 10**6)
        data += struct.pack(order + "IIII", seconds, micro, len(f), len(f)) + f
    return data


def pcapng_block(kind, body, order="<"):
    body += bytes(-len(body) % 4)
    size = struct.pack(order + "I", 12 + len(body))
    return struct.pack(order + "I", kind) + size + body + size


def pcapng(frames, *, order="<", link=1, start=1_700_000_000, step=1.0, options=b""):
    data = pcapng_block(0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1), order)
    data += pcapng_block(1, struct.pack(order + "HHI", link, 0, 65535) + options, order)
    for k, f in enumerate(frames):
        ticks = round(1e6 * (start + k * step))
        data += pcapng_block(
            6, struct.pack(order + "5I", 0, ticks >> 32, ticks & 0xFFFFFFFF, len(f), len(f)) + f, order
        )
    return data
