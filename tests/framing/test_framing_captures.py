"""Packet captures: what carries ASTERIX is found, what does not is counted by protocol."""

import struct

import pytest
from containers_made import (
    blocks,
    ethernet,
    frame,
    ioss,
    ipv4,
    ipv6,
    oradis,
    pcap,
    pcapng,
    pcapng_block,
    radar_block,
    udp,
)

from saltus.framing import Framer
from saltus.framing.twins import DEFINITION, compiled
from saltus.io.blocks import credible

BODIES = blocks(20)
USING = [DEFINITION, *([compiled()] if compiled() else [])]


@pytest.fixture(params=USING, ids=["definition", "compiled"][: len(USING)])
def using(request):
    return request.param


def bodies(got):
    return [b for _, _, b, _, _ in got]


def wrap(data, link):
    """An IPv4 packet as frames of a link type."""
    return {
        1: ethernet(data),
        113: bytes(14) + b"\x08\x00" + data,
        276: b"\x08\x00" + bytes(18) + data,
        101: data,
        12: data,
        0: b"\x02\0\0\0" + data,
    }[link]


@pytest.mark.parametrize("link", [1, 113, 276, 101, 12, 0])
@pytest.mark.parametrize("made", [pcap, pcapng])
@pytest.mark.parametrize("order", ["<", ">"])
def test_links_and_byte_orders(using, made, link, order):
    got, told = frame(made([wrap(ipv4(udp(b)), link) for b in BODIES], link=link, order=order), using=using)
    assert bodies(got) == BODIES
    assert [c for *_, c, _ in got] == [1_700_000_000.0 + k for k in range(len(BODIES))]
    assert told.problems == ()
    assert told.passed == {}
    assert told.channels == ["10.0.0.1:4000 > 239.1.1.1:8600"]


def test_vlan_tags_and_ipv6_with_extension_headers(using):
    b = BODIES[1]
    hop = struct.pack(">BB6x", 60, 0)  # hop-by-hop options, then destination options
    options = struct.pack(">BB14x", 17, 1)  # 16 bytes, then UDP
    frames = [
        ethernet(ipv4(udp(b)), tags=b"\x81\x00\x00\x05"),
        ethernet(ipv4(udp(b)), tags=b"\x88\xa8\x00\x05\x81\x00\x00\x07"),
        ethernet(ipv6(udp(b)), kind=0x86DD),
        ethernet(ipv6(hop + options + udp(b), protocol=0), kind=0x86DD),
    ]
    got, told = frame(pcap(frames), using=using)
    assert bodies(got) == [b] * 4
    assert told.channels == ["10.0.0.1:4000 > 239.1.1.1:8600", "[::1]:4000 > [ff00::]:8600"]


def fragments(data, number, size, *, host=1):
    pieces = range(0, len(data), size)
    return [
        ipv4(data[k : k + size], flags=k // 8 | (0x2000 if k + size < len(data) else 0), number=number, host=host)
        for k in pieces
    ]


def test_fragments_are_put_together_in_any_order(using):
    long = b"".join(BODIES)
    first, second = fragments(udp(long), 7, 104), fragments(udp(long), 8, 64)
    mixed = [p for pair in zip(first, reversed(second[: len(first)]), strict=True) for p in pair]
    mixed += second[len(first) :]
    data = pcap([ethernet(p) for p in mixed])
    got, told = frame(data, using=using)
    assert bodies(got) == BODIES * 2
    assert told.problems == ()
    assert all(0 < at < len(data) for _, at, *_ in got)
    assert bodies(frame(data, piece=100, using=using)[0]) == BODIES * 2  # parts of several pieces


def test_ipv6_fragments(using):
    whole = udp(b"".join(BODIES))
    parts = [(k, whole[k : k + 200]) for k in range(0, len(whole), 200)]
    frames = [
        ethernet(ipv6(struct.pack(">BBHI", 17, 0, k | (k + 200 < len(whole)), 99) + part, protocol=44), kind=0x86DD)
        for k, part in parts
    ]
    got, _ = frame(pcap(frames[::-1]), using=using)
    assert bodies(got) == BODIES
    single = ethernet(ipv6(struct.pack(">BBHI", 17, 0, 0, 5) + udp(BODIES[0]), protocol=44), kind=0x86DD)
    assert bodies(frame(pcap([single]), using=using)[0]) == BODIES[:1]  # an atomic fragment


def test_parts_that_miss_their_others_are_counted(using):
    long = udp(b"".join(BODIES))
    lonely = [fragments(long, n, 200)[0] for n in range(100)]  # more than are waited for
    got, told = frame(pcap([ethernet(p) for p in [*lonely, ipv4(udp(BODIES[0]))]]), using=using)
    assert bodies(got) == BODIES[:1]
    assert any("100 parts of fragmented IP packets whose other parts are missing" in p for p in told.problems)


def test_a_datagram_that_grows_without_end_is_dropped(using):
    piece = bytes(1400)
    hostile = [ipv4(piece, flags=0x2000 | (k % 8), number=1) for k in range(8)] * 40
    huge = [ipv4(bytes(60_000), flags=0x2000 | k, number=2) for k in range(4)]
    got, told = frame(pcap([ethernet(p) for p in [*hostile, *huge, ipv4(udp(BODIES[0]))]]), using=using)
    assert bodies(got) == BODIES[:1]
    assert sum(told.passed.values()) == 3  # of the huge one, given up at its third part


def test_what_is_passed_over_is_counted_by_protocol(using):
    arp, lldp = bytes(12) + b"\x08\x06" + bytes(28), bytes(12) + b"\x88\xcc" + bytes(46)
    tree = bytes(12) + b"\x00\x26" + bytes(38)
    frames = [arp, arp, lldp, tree]
    frames += [ethernet(ipv4(bytes(20), protocol=p)) for p in (6, 6, 6, 1, 2, 200)]
    frames += [ethernet(ipv6(bytes(20), protocol=58), kind=0x86DD)]
    frames += [ethernet(ipv4(udp(b"GET / HTTP/1.1", port=80))), ethernet(ipv4(udp(b"", port=9)))]
    frames += [ethernet(b"\x45\x00"), ethernet(b"\x41" + bytes(30))]
    got, told = frame(pcap([*frames, ethernet(ipv4(udp(BODIES[0])))]), using=using)
    assert bodies(got) == BODIES[:1]
    assert told.passed == {
        "ARP": 2,
        "LLDP": 1,
        "IEEE 802.3 (spanning tree and others)": 1,
        "TCP": 3,
        "ICMP": 1,
        "IGMP": 1,
        "IP protocol 200": 1,
        "ICMPv6": 1,
        "UDP to port 80, no ASTERIX": 1,
        "UDP to port 9, no ASTERIX": 1,
        "broken IP or UDP headers": 2,
    }
    assert "2 UDP payloads are not ASTERIX, the first at byte" in told.problems[0]


def test_other_links_are_passed_over(using):
    data = pcap([bytes(60)] * 3, link=105)
    got, told = frame(data, using=using)
    assert not got
    assert told.passed == {"link type 105, which is not read": 3}


def test_packets_cut_by_the_capture_keep_their_whole_blocks(using):
    packet = ethernet(ipv4(udp(BODIES[0] + BODIES[1] + BODIES[2])))
    cut = packet[: 42 + 12 + 31 + 20]
    data = bytearray(pcap([packet, cut]))
    at = 24 + 16 + len(packet) + 12
    data[at : at + 4] = struct.pack("<I", len(packet))
    got, told = frame(bytes(data), using=using)
    assert bodies(got) == [*BODIES[:3], *BODIES[:2], BODIES[2][:20]]
    assert [c for *_, c in got] == [False] * 5 + [True]
    assert any("1 packets were cut by the capture" in p for p in told.problems)


def test_payloads_that_end_within_a_block(using):
    got, told = frame(pcap([ethernet(ipv4(udp(BODIES[0] + b"\x30\x00\x50\xff")))]), using=using)
    assert bodies(got) == BODIES[:1]
    assert any("1 UDP payloads end within a block" in p for p in told.problems)


@pytest.mark.parametrize("made", [ioss, oradis])
def test_containers_inside_of_packets(using, made):
    payloads = [made([b]) for b in BODIES] + [made(BODIES[:3])]
    got, told = frame(pcap([ethernet(ipv4(udp(p))) for p in payloads]), using=using)
    assert bodies(got) == BODIES + BODIES[:3]
    assert told.passed == {}


def test_interfaces_of_pcapng_have_clocks_of_their_own(using):
    packet = ethernet(ipv4(udp(radar_block(0))))

    def enhanced(interface, ticks):
        head = struct.pack("<5I", interface, ticks >> 32, ticks & 0xFFFFFFFF, len(packet), len(packet))
        return pcapng_block(6, head + packet)

    nano = struct.pack("<HHB3x", 9, 1, 9)
    binary = struct.pack("<HHB3x", 9, 1, 0x80 | 20)
    shifted = struct.pack("<HHq", 14, 8, 1_700_000_000)
    data = pcapng([], options=nano)
    data += pcapng_block(1, struct.pack("<HHI", 1, 0, 65535) + binary)
    data += pcapng_block(1, struct.pack("<HHI", 1, 0, 65535) + shifted)
    data += enhanced(0, 1_700_000_000 * 10**9) + enhanced(1, 1_700_000_000 << 20) + enhanced(2, 5_000_000)
    data += pcapng_block(3, struct.pack("<I", len(packet)) + packet)  # a simple packet has no time
    data += pcapng_block(0xBAD, b"unknown block") + enhanced(7, 0)  # an interface that is not there
    got, told = frame(data, using=using)
    assert [c for *_, c, _ in got] == [1_700_000_000.0, 1_700_000_000.0, 1_700_000_005.0, None]
    assert told.problems == ()


def test_dated_by_the_capture():
    framer = Framer("a.pcap", credible)
    (chunk,) = [*framer.feed(pcap([ethernet(ipv4(udp(b))) for b in BODIES])), *framer.finish()]
    assert chunk.dated
    assert chunk.channel.tolist() == [0] * len(BODIES)


def test_a_capture_cut_within_a_packet_says_so(using):
    got, told = frame(pcap([ethernet(ipv4(udp(b))) for b in BODIES])[:-5], using=using)
    assert bodies(got) == BODIES[:-1]
    (problem,) = told.problems
    assert "no whole packet, and none follows" in problem
