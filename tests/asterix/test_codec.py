"""Records to columns: frames worked out by hand, and what does not follow its layout."""

import numpy as np
import pytest

from saltus.asterix.codec import Column, Want, decode, find_records
from saltus.asterix.encode import blocks, encode
from saltus.asterix.layout import categories, editions, layout
from saltus.errors import DataError, ModelError

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


def test_items_in_any_order_fill_the_same_columns():
    """CAT002 FSPEC 81 02: item 010, and random field sequencing of two items, FRN 4 and FRN 2."""
    form = layout(2, "1.2")
    block = bytes.fromhex("02 000e 81 02 1402 02 04 384000 02 01")
    found = find(block, form)
    assert [found.faults.text(k) for k in range(len(found.faults.code))] == []
    held = decode(block, found.records, form, {"time": Want("030"), "message": Want("000")})
    assert (held["time"].values[0], held["message"].values[0]) == (28800.0, 1)


def test_what_extends_beyond_its_definition_is_skipped_and_told():
    # FSPEC b0: 010 - 020 040; 020 has two octets in 1.27, here a third one: a1 01 02
    form = layout(48, "1.27")
    block = bytes.fromhex("30 000d b0 1481 a1 01 02 0a00 4000")
    strict = find(block, form, strict=True)
    assert len(strict.records.start) == 0
    assert strict.faults.text(0) == "item 020 extends beyond its definition"
    found = find(block, form)
    assert found.faults.record.tolist() == [0]
    held = decode(block, found.records, form, {"range": Want("040/RHO"), "kind": Want("020/TYP")})
    assert (held["range"].values[0], held["kind"].values[0]) == (18520.0, 5)


def test_a_wrong_length_at_the_end_costs_its_item_alone():
    # FSPEC 81 01 01 04: 010 and SP; SP says 9 bytes, 2 are there
    form = layout(48, "1.32")
    block = bytes.fromhex("30 000b 81 01 01 04 1481 09 ff")
    found = find(block, form)
    assert found.records.stop.tolist() == [11]
    assert found.faults.record.tolist() == [0]
    assert found.faults.text(0) == "item SP needs 9 bytes, 2 are left"
    assert decode(block, found.records, form, {"sic": Want("010/SIC")})["sic"].values.tolist() == [0x81]


@pytest.mark.parametrize(
    ("columns", "error", "text"),
    [
        ({"040/RHO": [500e3]}, DataError, r"040/RHO\[0\] is 500000\.0, which does not fit its 16 bits"),
        ({"070/MODE3A": [4096]}, DataError, "does not fit its 12 bits"),
        ({"240": ["lower"]}, DataError, "use capitals, digits and blanks"),
        ({"240": ["NINE9CHAR"]}, DataError, "at most 8 letters"),
        ({"250/5,0/ROLL": [0.1]}, ModelError, "cannot be written"),
        ({"250/BDS1": [4]}, ModelError, "must be repeated alike"),
        ({"040/RHO": [1.0], "220": [1, 2]}, ModelError, "has 1 values, others have 2"),
        ({"041/X": [1]}, DataError, "has no field"),
    ],
)
def test_what_cannot_be_written_is_refused(columns, error, text):
    with pytest.raises(error, match=text):
        encode(layout(48, "1.32"), columns)


def test_a_count_that_does_not_fit_is_refused():
    rows = np.zeros(256, np.int64)
    held = {f"250/{name}": Column(np.zeros(256, np.int64), None, rows) for name in ("MBDATA", "BDS1", "BDS2")}
    with pytest.raises(DataError, match="record 0 repeats an item"):
        encode(layout(48, "1.32"), held)


def test_blocks_are_no_longer_than_their_header_can_say():
    held = encode(layout(48, "1.32"), {"010/SAC": np.zeros(30000, np.int64)})
    with pytest.raises(DataError, match="block 0 of category 48 has 90003 bytes"):
        blocks(48, held, [0])
