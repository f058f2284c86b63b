"""ASTERIX frames worked out by hand, for the tests of framing and of each category."""

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


def plot(*, tod=100.5, rho=2560, theta=0x4000, kind="a0", code="029c", level="0190", state="2000", sic=0x81):
    """PLOT with fields replaced, each as it stands in the frame."""
    return bytes.fromhex(
        f"30001f fdc102 14{sic:02x} {round(tod * 128):06x} {kind} {rho:04x}{theta:04x} {code} {level} 3c6444"
        f"10c231820820 {state}"
    )
