"""Formats that are known and not read are named, with the way to one that is."""

import pytest

from saltus.errors import DataError
from saltus.io import read

AVR = "*8D40621D58C382D690C8AC2863A7;\n"  # a message printed in every book on ADS-B
CASES = [
    ("a.nmea", b"!AIVDM,1,1,,A,13u?etPv2;0n:dDPwUM1U1Cb069D,0*24\r\n", "AIS sentences", "pyais"),
    ("a.txt", b"\\s:r1,c:1700000000*5A\\!AIVDM,1,1,,A,13u?etPv2;0n,0*24\n", "AIS sentences", "pyais"),
    ("a.csv", b"MSG,3,1,1,ABC001,1,2023/11/14,22:13:20.000,2023/11/14,22:13:20.000,,35000\n", "BaseStation", "MSG,3"),
    ("a.json", b'{"now": 1.7e9, "aircraft": []}', "dump1090", "seen_pos"),
    ("b.json", b'{"time": 1700000000, "states": []}', "OpenSky", "time_position"),
    ("a.log", AVR.encode(), r"Mode S messages \(AVR\)", "rs1090"),
    ("a.bin", b"\x1a3\0\0\0\0\0\0\x40" + bytes(14), r"Mode S messages \(Beast\)", "rs1090"),
    ("b.csv", b"MMSI,BaseDateTime,LAT,LON\n1,2024-05-01T12:00:00,41,2\n", "MarineCadastre", "Rename BaseDateTime"),
    ("a.ast", b"\x1f\x8b\x08\0", "compressed", "Unpack"),
    ("a.xlsx", b"PK\x03\x04\0\0", "ZIP", "save the sheet as CSV"),
    ("README", b"Recorded on Monday.\nBy hand.\n", "begins with 'Recorded on Monday.'", "It is text"),
    ("a.dat", bytes(range(200, 250)), "begins with c8 c9", "--framing NAME"),
]


@pytest.mark.parametrize(("name", "content", "what", "remedy"), CASES, ids=[c[0] for c in CASES])
def test_named_with_a_remedy(tmp_path, name, content, what, remedy):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError, match=f"{name}: .*{what}.*{remedy}"):
        read([tmp_path / name])
