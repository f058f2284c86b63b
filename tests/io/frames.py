"""ASTERIX frames worked out by hand, for the tests of framing and of each category."""

import struct

# CAT048, one record of 28 bytes: SAC/SIC 20/129
PLOT = bytes.fromhex(
    "30 001f"  # category 48, 3 + 28 bytes
    "fd c1 02"  # FSPEC: 010 140 020 040 070 090 - | 220 240 - - - - - | - - - - - - 230
    "14 81"
    "003240"  # 12864 / 128 = 100.5 s
    "a0"  # TYP 5
    "0a00 4000"  # 2560 / 256 = 10 NM = 18520 m; a quarter turn
    "029c"  # octal 1234
    "0190"  # 400 quarters = FL 100 = 3048 m
    "3c6444"
    "10c231 820820"  # DLH1
    "2000"  # STAT 0: airborne
)

# CAT034, north marker of the same radar at 100 s (12800), turning in 4 s (512)
NORTH = bytes.fromhex("22 000c e8 1481 01 003200 0200")


def plot(
    *, tod=100.5, rho=2560, theta=0x4000, kind="a0", code="029c", level="0190", state="2000", sic=0x81, address=0x3C6444
):
    """PLOT with fields replaced, each as it stands in the frame."""
    return bytes.fromhex(
        f"30001f fdc102 14{sic:02x} {round(tod * 128):06x} {kind} {rho:04x}{theta:04x} {code} {level} {address:06x}"
        f"10c231820820 {state}"
    )


def capture(payloads, *, start=1_700_000_000.0, step=1.0):
    """A classic capture of UDP datagrams, one each step from start, s."""
    data = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
    for k, payload in enumerate(payloads):
        ip = struct.pack(">BBHHHBBH", 0x45, 0, 28 + len(payload), 0, 0, 64, 17, 0) + bytes([10, 0, 0, 1, 239, 1, 1, 1])
        packet = bytes(12) + b"\x08\0" + ip + struct.pack(">HHHH", 4000, 8600, 8 + len(payload), 0) + payload
        seconds, micro = divmod(round(1e6 * (start + k * step)), 10**6)
        data += struct.pack("<IIII", seconds, micro, len(packet), len(packet)) + packet
    return data
