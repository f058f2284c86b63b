"""Simulated plots as bytes: a frame worked out by hand, and what may not be written."""

import numpy as np
import pytest

from saltus.errors import DataError
from saltus.io.asterix_write import write_cat048

ONE = dict(
    time_of_day=[100.5],
    range_m=[18520.0],
    azimuth_rad=[np.pi / 2],
    altitude_m=[3048.0],
    icao24=[0x3C6444],
    mode3a=[0o1234],
    callsign=["DLH1"],
    on_ground=[0],
)


def test_one_plot_byte_by_byte(tmp_path):
    write_cat048(tmp_path / "a.ast", sac=20, sic=129, **ONE)
    expected = (
        "30 001f"  # CAT048, 3 + 28 bytes
        "fd c1 02"  # FSPEC: 010 140 020 040 070 090 - | 220 240 - - - - - | - - - - - - 230
        "14 81"  # SAC 20, SIC 129
        "003240"  # 100.5 s x 128 = 12864
        "a0"  # TYP 5 in the three high bits
        "0a00 4000"  # 10 NM x 256 = 2560; 90 degrees = a quarter of 65536
        "029c"  # octal 1234, V G L all 0
        "0190"  # FL 100 = 400 quarters
        "3c6444"
        "10c231 820820"  # D 000100 L 001100 H 001000 1 110001, then four spaces 100000
        "2000"  # COM 1, STAT 0: airborne
    )
    assert (tmp_path / "a.ast").read_bytes() == bytes.fromhex(expected)


def test_markers_and_sectors_frame_the_plots(tmp_path):
    write_cat048(tmp_path / "a.ast", sac=1, sic=2, **ONE, north_marker_times=[100.0, 104.0], n_sectors=2)
    data = (tmp_path / "a.ast").read_bytes()
    seen = []
    while data:
        length = int.from_bytes(data[1:3], "big")
        seen.append((data[0], data[:length].hex()))
        data = data[length:]
    assert [category for category, _ in seen] == [34, 48, 34, 34]
    # FSPEC 010 000 030 - 041: e8; message 1; 100 s x 128 = 12800; period 4 s x 128 = 512
    assert seen[0][1] == "22000c" + "e8" + "0102" + "01" + "003200" + "0200"
    # FSPEC 010 000 030 020: f0; message 2; 102 s x 128 = 13056; half a turn = 128
    assert seen[2][1] == "22000b" + "f0" + "0102" + "02" + "003300" + "80"


@pytest.mark.parametrize(
    ("column", "value", "text"),
    [
        ("range_m", [500e3], r"range_m\[0\] is 500000"),
        ("azimuth_rad", [np.nan], r"azimuth_rad\[0\] is nan"),
        ("altitude_m", [1e6], r"altitude_m\[0\]"),
        ("mode3a", [4096], r"mode3a\[0\]"),
        ("callsign", ["lower"], r"callsign\[0\] is 'lower'"),
        ("time_of_day", [-1.0], r"time_of_day\[0\]"),
        ("icao24", [1, 2], "expected \\(1,\\)"),
    ],
)
def test_values_that_do_not_fit_are_refused(tmp_path, column, value, text):
    with pytest.raises(DataError, match=text):
        write_cat048(tmp_path / "a.ast", sac=1, sic=2, **{**ONE, column: value})
    assert not (tmp_path / "a.ast").exists()
