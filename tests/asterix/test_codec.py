"""Records to columns: frames worked out by hand, and what does not follow its layout."""

import numpy as np
import pytest

from saltus.asterix.codec import Want, decode, find_records
from saltus.asterix.layout import categories, editions, layout
from saltus.errors import DataError

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


def find(data, layout, **options):
    return find_records(data, np.array([0]), np.array([len(data)]), layout, **options)


def test_every_edition_compiles():
    n = 0
    for category in categories():
        for edition in editions(category):
            held = layout(category, edition)
            assert held.has("010"), (category, edition)
            n += 1
    assert n == 68


def test_one_plot_by_hand():
    form = layout(48, "1.32")
    found = find_records(PLOT * 2, np.array([0, 31]), np.array([31, 31]), form)
    assert len(found.faults.code) == 0
    assert found.records.block.tolist() == [0, 1]
    assert found.records.start.tolist() == [3, 34]
    held = decode(
        PLOT * 2,
        found.records,
        form,
        {
            "time": Want("140"),
            "range": Want("040/RHO"),
            "range_nm": Want("040/RHO", form="native"),
            "raw": Want("040/RHO", form="raw"),
            "azimuth": Want("040/THETA"),
            "code": Want("070/MODE3A"),
            "callsign": Want("240"),
            "track": Want("161/TRN"),
            "level": Want("090", form="span"),
        },
    )
    assert {name: column.values.tolist()[0] for name, column in held.items()} == {
        "time": 100.5,
        "range": 18520.0,
        "range_nm": 10.0,
        "raw": 2560,
        "azimuth": np.pi / 2,
        "code": 0o1234,
        "callsign": b"DLH1",
        "track": -1,
        "level": [18, 20],
    }
    assert held["range"].present.all()
    assert not held["track"].present.any()


def test_faults_say_what_and_where():
    form = layout(34, "1.29")
    north = bytes.fromhex("22 000c e8 1481 01 003200 0200")
    found = find(north[:9], form)
    assert found.records.start.tolist() == []
    assert found.faults.text(0) == "item 030 needs 3 bytes, 2 are left"
    assert found.faults.offset.tolist() == [7]


def test_an_unknown_field_names_what_there_is():
    form = layout(34, "1.29")
    with pytest.raises(DataError, match=r"category 34 edition 1\.29 has no field '041/X'; its items are 000, 010"):
        decode(b"", find(b"", form).records, form, {"x": Want("041/X")})
    with pytest.raises(DataError, match=r"choose one of 1\.27, 1\.28, 1\.29"):
        layout(34, "9.9")
    with pytest.raises(DataError, match="category 30 has no layout"):
        layout(30, "1.0")
