"""Framing: truncation, garbage, captures; nothing lost that could be read, nothing dropped in silence."""

import random
import struct

import numpy as np
import pytest
from frames import NORTH, PLOT, plot

from saltus.errors import DataError
from saltus.io import read

FILE = NORTH + PLOT + plot(tod=101.0) + plot(tod=102.0)  # 12 + 31 + 31 + 31 bytes


def write(tmp_path, data, name="a.ast"):
    (tmp_path / name).write_bytes(data)
    return tmp_path / name


def test_truncation_at_every_byte(tmp_path):
    whole = read([write(tmp_path, FILE)]).plots.time.tolist()
    assert whole == [100.5, 101.0, 102.0]
    for size in range(len(FILE)):
        path = write(tmp_path, FILE[:size])
        n_whole = max(0, (size - 12) // 31)
        if size < 12:
            with pytest.raises(DataError, match=r"a\.ast: (byte 0: the file is empty|no ASTERIX record)"):
                read([path])
            continue
        got = read([path])
        assert got.plots.time.tolist() == whole[:n_whole]
        told = [p for p in got.problems if "no date" not in p]
        at_border = (size - 12) % 31 == 0
        assert len(told) == (0 if at_border else 1), (size, told)
        assert at_border or f"a.ast: byte {12 + 31 * n_whole}:" in told[0]


def test_leading_whole_records_of_a_cut_block_are_used(tmp_path):
    two = bytes.fromhex("30 003b") + PLOT[3:] + plot(tod=101.0)[3:]
    got = read([write(tmp_path, two[:-5])])
    assert got.plots.time.tolist() == [100.5]
    assert "truncated" in got.problems[0]


def test_garbage_between_blocks_is_skipped_and_told(tmp_path):
    draw = random.Random(7)
    for size in (1, 2, 3, 17, 400):
        garbage = bytes(draw.randrange(256) for _ in range(size))
        path = write(tmp_path, NORTH + PLOT + garbage + plot(tod=101.0) + plot(tod=102.0))
        got = read([path])
        assert got.plots.time.tolist() == [100.5, 101.0, 102.0], size
        assert f"byte 43: no ASTERIX block; skipped {size} bytes" in got.problems[0]


def test_garbage_before_the_first_block(tmp_path):
    got = read([write(tmp_path, b"header\0\xff" * 20 + PLOT + plot(tod=101.0))])
    assert got.plots.time.tolist() == [100.5, 101.0]
    assert "byte 0: no ASTERIX block; skipped 160 bytes" in got.problems[0]


def test_wrong_category_loses_that_block_only(tmp_path):
    wrong = bytes([62]) + plot(tod=101.0)[1:]  # a radar plot announced as a system track
    got = read([write(tmp_path, PLOT + wrong + plot(tod=102.0))])
    assert got.plots.time[got.plots.reason == 0].tolist() == [100.5, 102.0]
    assert any("byte 31" in p or "category 62" in p for p in got.problems)


def test_unknown_category_is_counted(tmp_path):
    got = read([write(tmp_path, bytes.fromhex("fa 0005 8001") + PLOT + plot(tod=101.0))])
    assert got.plots.time.tolist() == [100.5, 101.0]
    assert any("category 250 is not read: 1 blocks" in p for p in got.problems)
    assert [str(c.system) for c in got.contents] == ["CAT048:20/129", "CAT250"]


@pytest.mark.parametrize("seed", range(40))
def test_random_bytes_give_an_error_or_say_what_was_skipped(tmp_path, seed):
    draw = random.Random(seed)
    data = bytes(draw.randrange(256) for _ in range(draw.choice([1, 3, 30, 1000])))
    for name in ("a.ast", "a.pcap"):
        try:
            got = read([write(tmp_path, data, name)])
        except DataError as error:
            assert name in str(error)
        else:
            assert any("byte" in p for p in got.problems)


@pytest.mark.parametrize("seed", range(10))
def test_damaged_bytes_never_crash(tmp_path, seed):
    draw = random.Random(seed)
    data = bytearray((PLOT + NORTH) * 20)
    for _ in range(12):
        data[draw.randrange(len(data))] = draw.randrange(256)
    got = read([write(tmp_path, bytes(data))])
    assert len(got.plots) >= 5


def udp(payload, *, vlan=b"", fragment=0):
    """Ethernet, IPv4 and UDP around a payload."""
    header = struct.pack(">HHHH", 4000, 8600, 8 + len(payload), 0)
    ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 28 + len(payload), 0, fragment, 64, 17, 0, bytes(4), bytes(4))
    return bytes(12) + vlan + b"\x08\x00" + ip + header + payload


def classic(frames, order="<", magic=0xA1B2C3D4, link=1, seconds=1700000000):
    data = struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 65535, link)
    for k, frame in enumerate(frames):
        data += struct.pack(order + "IIII", seconds + k, 500, len(frame), len(frame)) + frame
    return data


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("magic", [0xA1B2C3D4, 0xA1B23C4D])
def test_capture_clock_gives_the_date(tmp_path, order, magic):
    # 1699920100 is 2023-11-14 00:01:40: day 19675 and 100 s
    seconds = 19675 * 86400 + 100
    data = classic([udp(PLOT), udp(plot(tod=101.0))], order, magic, seconds=seconds)
    got = read([write(tmp_path, data, "a.pcap")])
    assert got.plots.time.tolist() == [seconds + 0.5, seconds + 1.0]
    assert got.problems == ()


def test_capture_before_midnight_of_a_report_after_it(tmp_path):
    seconds = 19676 * 86400 - 1  # captured at 23:59:59 by a clock that is late
    data = classic([udp(plot(tod=0.25))], seconds=seconds)
    assert read([write(tmp_path, data, "a.pcap")]).plots.time.tolist() == [19676 * 86400 + 0.25]


def test_links_vlan_and_what_is_passed_over(tmp_path):
    tagged = udp(PLOT, vlan=b"\x81\x00\x00\x05")
    arp = bytes(12) + b"\x08\x06" + bytes(28)
    foreign = udp(b"GET / HTTP/1.1")
    part = udp(plot(tod=101.0), fragment=0x2000)
    got = read([write(tmp_path, classic([tagged, arp, foreign, part]), "a.pcap")])
    assert len(got.plots) == 1
    assert any("1 UDP payloads are not ASTERIX" in p for p in got.problems)
    assert any("1 parts of fragmented IP packets" in p for p in got.problems)
    over = "a.pcap: 2 packets passed over, without ASTERIX: 1 of ARP, 1 of UDP to port 8600, no ASTERIX."
    assert over in got.problems
    cooked = bytes(14) + udp(PLOT)[12:]
    assert len(read([write(tmp_path, classic([cooked], link=113), "b.pcap")]).plots) == 1
    raw = udp(PLOT)[14:]
    assert len(read([write(tmp_path, classic([raw], link=101), "c.pcap")]).plots) == 1
    with pytest.raises(DataError, match="link type 105"):
        read([write(tmp_path, classic([raw], link=105), "d.pcap")])


def test_pcapng(tmp_path):
    def block(kind, body):
        body += bytes(-len(body) % 4)
        return struct.pack("<II", kind, 12 + len(body)) + body + struct.pack("<I", 12 + len(body))

    frame = udp(PLOT)
    ticks = (19675 * 86400 + 100) * 1_000_000
    packet = struct.pack("<5I", 0, ticks >> 32, ticks & 0xFFFFFFFF, len(frame), len(frame)) + frame
    data = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    data += block(1, struct.pack("<HHI", 1, 0, 65535)) + block(6, packet)
    got = read([write(tmp_path, data, "a.pcapng")])
    assert got.plots.time.tolist() == [19675 * 86400 + 100.5]
    assert got.problems == ()
    cut = read([write(tmp_path, data + b"\x06\0\0\0\xff", "b.pcapng")])
    assert len(cut.plots) == 1
    assert f"byte {len(data)}" in cut.problems[0]


def ip(protocol, rest, version=4):
    """Ethernet and IP around what a protocol carries."""
    if version == 6:
        return bytes(12) + b"\x86\xdd" + struct.pack(">IHBB", 6 << 28, len(rest), protocol, 64) + bytes(32) + rest
    head = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(rest), 0, 0, 64, protocol, 0, bytes(4), bytes(4))
    return bytes(12) + b"\x08\x00" + head + rest


def test_packets_passed_over_are_counted_by_protocol(tmp_path):
    frames = [udp(PLOT), *[ip(6, bytes(20))] * 3, ip(1, bytes(8)), ip(200, bytes(8))]
    frames += [ip(17, udp(PLOT)[34:], 6), bytes(12) + b"\x88\xcc" + bytes(20), bytes(12) + b"\x12\x34" + bytes(20)]
    got = read([write(tmp_path, classic(frames), "a.pcap")])
    assert got.contents[0].n_records == 2
    over = next(p for p in got.problems if "passed over" in p)
    assert over.startswith("a.pcap: 7 packets passed over, without ASTERIX: 3 of TCP, ")
    for what in ("1 of ICMP", "1 of IP protocol 200", "1 of LLDP", "1 of Ethernet type 0x1234"):
        assert what in over


def test_capture_cut_at_every_byte(tmp_path):
    data = classic([udp(PLOT), udp(plot(tod=101.0))])
    first = 24 + 16 + len(udp(PLOT))
    for size in range(first, len(data), 3):
        got = read([write(tmp_path, data[:size], "a.pcap")])
        assert len(got.plots) == 1
        assert size == first or "byte" in got.problems[0]


def test_unknown_formats_name_the_known_ones(tmp_path):
    path = write(tmp_path, b'{"a": 1}', "a.json")
    with pytest.raises(DataError, match=r"a\.json: unknown format.*ASTERIX.*CSV"):
        read([path])
    assert np.all(read([write(tmp_path, FILE, "recording")]).plots.time > 0)  # told by its content


@pytest.mark.parametrize("name", ["a.csv", "a.parquet", "a.txt", "a.pcap"])
def test_asterix_is_told_by_its_first_block_whatever_it_is_called(tmp_path, name):
    (tmp_path / name).write_bytes(PLOT + PLOT)
    assert read([tmp_path / name]).contents[0].system.category == 48
