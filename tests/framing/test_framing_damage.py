"""Truncation, garbage, lying lengths, formats joined: nothing lost that could be read, everything told by its byte."""

import random

import pytest
from containers_made import (
    CONTAINERS,
    blocks,
    ethernet,
    frame,
    gps,
    ioss,
    ipv4,
    oradis,
    pcap,
    pcapng,
    plain,
    radar_block,
    udp,
)

from saltus.framing.twins import DEFINITION

BODIES = blocks(60)
STRONG = [name for name in CONTAINERS if name not in ("plain", "gps")]


def bodies(got):
    return [b for _, _, b, _, cut in got if not cut]


@pytest.mark.parametrize("name", CONTAINERS)
def test_truncated_at_every_byte_of_the_last_frame(name):
    made = CONTAINERS[name]
    shorter, whole = len(made(BODIES[:20])), made(BODIES[:21])
    for size in range(shorter, len(whole)):
        got, told = frame(whole[:size])
        assert bodies(got)[:20] == BODIES[:20], size
        assert len(bodies(got)) <= 21, size
        assert len(told.problems) == (size > shorter), (size, told.problems)


@pytest.mark.parametrize("size", [1, 5, 40, 700, 5000])
@pytest.mark.parametrize("name", CONTAINERS)
def test_garbage_between_frames(name, size):
    made = CONTAINERS[name]
    garbage = random.Random(size).randbytes(size)
    first = made(BODIES[:20])
    second = made(BODIES)[len(first) :]
    got, told = frame(first + garbage + second)
    assert bodies(got) == BODIES
    assert told.n_gap_bytes == size
    assert told.problems == (f"a.rec: byte {len(first)}: no ASTERIX block; skipped {size} bytes to the next one.",)
    assert got == frame(first + garbage + second, piece=1000)[0]


@pytest.mark.parametrize("name", CONTAINERS)
def test_a_frame_whose_length_lies_costs_itself_at_most(name):
    made = CONTAINERS[name]
    start, data = len(made(BODIES[:20])), bytearray(made(BODIES))
    where = {"plain": 1, "gps": 1, "ioss": 0, "ioss-seq": 0, "oradis": 0, "rff": 4, "hdlc": 3}[name]
    for high, low in ((0, 20), (0, 90), (3, 7), (200, 0)):
        pair = (low, high) if name == "rff" else (high, low)
        data[start + where : start + where + 2] = bytes(pair)
        got, told = frame(bytes(data))
        rest = [b for b in bodies(got) if b in BODIES]
        assert rest == BODIES[:20] + BODIES[21:] or rest == BODIES, (high, low)
        assert told.problems, (high, low)
        assert start <= int(told.problems[0].split()[2].rstrip(":")) <= start + 30


def test_whole_records_of_a_block_that_says_too_much_are_used():
    lying = bytearray(radar_block(7))
    lying[1:3] = (60).to_bytes(2, "big")
    data = plain(BODIES[:20]) + bytes(lying) + plain(BODIES[20:])
    got, told = frame(data)
    at = len(plain(BODIES[:20]))
    assert [(at, bytes(lying), True)] == [(a, b, cut) for _, a, b, _, cut in got if cut]
    assert told.problems == (
        f"a.rec: byte {at}: the block of category 48 says 60 bytes, the next begins after 31: "
        "its whole records are used.",
    )


def test_unassigned_categories_between_known_ones():
    strange = bytes.fromhex("fa 0005 8001")
    for many in (1, 3, 40):
        got, told = frame(plain(BODIES[:20]) + strange * many + plain(BODIES[20:]))
        assert bodies(got) == BODIES[:20] + [strange] * many + BODIES[20:]
        assert told.problems == ()


def test_a_file_of_one_unassigned_category():
    strange = bytes.fromhex("fa 0005 8001")
    assert bodies(frame(strange * 10)[0]) == [strange] * 10


def packets(some):
    return [ethernet(ipv4(udp(b))) for b in some]


def test_formats_joined():
    parts = [
        (plain(BODIES[:20]), "plain"),
        (pcap(packets(BODIES[:20])), "pcap"),
        (gps(BODIES[:20]), "gps"),
        (ioss(BODIES[:20]), "ioss"),
        (pcapng(packets(BODIES[:20])), "pcapng"),
        (oradis(BODIES[:20]), "oradis"),
        (plain(BODIES[:20]), "plain"),
    ]
    data = b"".join(part for part, _ in parts)
    for piece in (None, 777):
        got, told = frame(data, piece=piece)
        assert [s.framing for s in told.segments] == [name for _, name in parts]
        assert [s.stop - s.start for s in told.segments] == [len(part) for part, _ in parts]
        assert bodies(got) == BODIES[:20] * 7
        assert len(told.problems) == 6
        assert f"byte {len(parts[0][0])}: the recording goes on as packet capture" in told.problems[0]


@pytest.mark.parametrize("second", ["pcap", "pcapng", "gps", "ioss", "rff"])
@pytest.mark.parametrize("cut", [1, 3, 7, 20, 30])
def test_a_cut_block_does_not_hide_the_beginning_of_another_format(second, cut):
    made = {"pcap": lambda b: pcap(packets(b)), "pcapng": lambda b: pcapng(packets(b)), **CONTAINERS}[second]
    first = plain(BODIES[:20])[:-cut]
    got, told = frame(first + made(BODIES[:40]))
    assert bodies(got) == BODIES[:19] + BODIES[:40]
    assert [s.framing for s in told.segments] == ["plain", second]
    assert told.problems


def test_captures_joined_where_the_first_is_cut_off():
    first, second = pcap(packets(BODIES[:20])), pcap(packets(BODIES[20:40]), start=1_700_000_900)
    for lost in (1, 10, 60, 80):
        got, told = frame(first[:-lost] + second)
        assert [b for b in bodies(got) if b in BODIES][:19] == BODIES[:19]
        assert [b for b in bodies(got) if b in BODIES][-20:] == BODIES[20:40]
        assert told.problems


def test_garbage_within_captures():
    for made in (pcap, pcapng):
        head = made(packets(BODIES[:20]))
        rest = made(packets(BODIES))[len(head) :]
        garbage = random.Random(3).randbytes(333)
        got, told = frame(head + garbage + rest)
        assert bodies(got) == BODIES
        assert f"byte {len(head)}: no ASTERIX block; skipped 333 bytes" in told.problems[0]


def test_a_long_recording_in_pieces():
    """Above what must be at hand behind a place: gaps and lies far from the end are settled before it comes."""
    many = blocks(60_000)  # 1.9 MB
    data = bytearray(plain(many))
    draw = random.Random(5)
    for _ in range(40):
        at = draw.randrange(len(data) - 100)
        data[at : at + 30] = draw.randbytes(draw.choice([0, 5, 30, 60]))
    whole, told = frame(bytes(data))
    for piece in (50_000, 1 << 19):
        got, again = frame(bytes(data), piece=piece)
        assert got == whole
        assert again.problems == told.problems
    assert len(whole) > len(many) - 200


def test_the_definition_bridges_the_same_gaps():
    data = bytearray(plain(BODIES[:30]))
    data[200:230] = random.Random(2).randbytes(50)
    assert frame(bytes(data), using=DEFINITION)[0] == frame(bytes(data))[0]


@pytest.mark.parametrize("seed", range(60))
def test_any_bytes_are_taken_and_accounted_for(seed):
    draw = random.Random(seed)
    name = draw.choice([*CONTAINERS, "pcap", "pcapng"])
    made = {**CONTAINERS, "pcap": lambda b: pcap(packets(b)), "pcapng": lambda b: pcapng(packets(b))}[name]
    data = bytearray(made(BODIES[:30]))
    for _ in range(draw.choice([1, 4, 30])):
        data[draw.randrange(len(data))] = draw.randrange(256)
    try:
        got, told = frame(bytes(data))
    except Exception as error:
        pytest.fail(f"{name} {seed}: {error!r}")
    assert sum(b in BODIES for b in bodies(got)) + 4 * len(told.problems) + len(told.passed) >= 1
    assert all(at + 3 < len(data) and len(b) > 3 for _, at, b, *_ in got)
