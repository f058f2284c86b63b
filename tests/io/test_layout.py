"""The compiled walker against the library's own parser."""

import random

import pytest
from asterix import base
from frames import NORTH, PLOT

from saltus.io.layout import Malformed, categories, layout


def library(record, payload):
    """Lengths of the items of each record, and whether the library refuses the rest."""
    rest, records = base.Bits.from_bytes(payload), []
    while len(rest):
        try:
            result = record.parse(base.ParsingMode.StrictParsing, rest)
        except TypeError:  # how the library meets announced fields beyond its table
            return records, True
        if isinstance(result, ValueError):
            return records, True
        parsed, rest = result
        records.append({name: len(item.unparse()) // 8 for name, item in parsed.items_regular.items()})
    return records, False


def walked(compiled, payload):
    position, records = 0, []
    while position < len(payload):
        try:
            _, spans, position = compiled.walk(payload, position, len(payload))
        except Malformed:
            return records, True
        records.append({name: stop - start for name, (start, stop) in spans.items() if name != "RFS"})
    return records, False


def test_walks_random_bytes_like_the_library():
    draw = random.Random(1)
    n_whole = 0
    for _ in range(3000):
        category = draw.choice(sorted(categories()))
        edition = draw.choice(sorted(categories()[category]))
        mask = draw.choice([255, 254, 15, 3])  # fewer bits: shorter records that more often parse
        payload = bytes(draw.randrange(256) & mask for _ in range(draw.randrange(1, 50)))
        expected = library(categories()[category][edition], payload)
        assert walked(layout(category, edition), payload) == expected, (category, edition, payload.hex())
        n_whole += len(expected[0])
    assert n_whole > 1000  # the comparison is not of refusals only


@pytest.mark.parametrize("edition", ["1.27", "1.31", "1.32"])
def test_walks_cut_frames_like_the_library(edition):
    for stop in range(4, len(PLOT) + 1):
        payload = PLOT[3:stop]
        assert walked(layout(48, edition), payload) == library(categories()[48][edition], payload)


def test_walks_real_records_like_the_library(recordings):
    data = (recordings / "asterix_small" / "adsb_v21_bcn.ast").read_bytes()
    position, n = 0, 0
    while position < len(data) and n < 150:
        stop = position + int.from_bytes(data[position + 1 : position + 3], "big")
        if data[position] == 21:
            for edition in ("0.23", "2.1", "2.7"):
                payload = data[position + 3 : stop]
                assert walked(layout(21, edition), payload) == library(categories()[21][edition], payload)
            n += 1
        position = stop


def test_fields_lie_where_the_library_finds_them():
    record = categories()[48]["1.32"].parse(base.ParsingMode.StrictParsing, base.Bits.from_bytes(PLOT[3:]))[0]
    compiled = layout(48, "1.32")
    _, spans, _ = compiled.walk(PLOT, 3, len(PLOT))
    for item, name in (("040", "RHO"), ("040", "THETA"), ("070", "MODE3A"), ("090", "FL"), ("230", "STAT")):
        field = compiled.field(item, name)
        start, stop = spans[item]
        value = int.from_bytes(PLOT[start:stop], "big") >> (8 * (stop - start) - field.offset - field.size)
        assert value & ((1 << field.size) - 1) == record.get_item(item).variation.get_item(name).as_uint()


def test_malformed_says_where():
    with pytest.raises(Malformed, match="item 030 needs 3 bytes, 2 are left") as caught:
        layout(34, "1.29").walk(NORTH, 3, 9)
    assert caught.value.offset == 7
