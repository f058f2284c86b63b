"""The compiled scanners against their definitions: whole, cut and damaged recordings, byte for byte."""

import random

import numpy as np
import pytest
from containers_made import CONTAINERS, blocks, ethernet, ipv4, ipv6, pcap, pcapng, udp

from saltus.framing.containers import CONTAINERS as TABLE
from saltus.framing.containers import assigned, container
from saltus.framing.twins import DEFINITION, compiled

BODIES = blocks(24)
SEEDS = range(120)

pytestmark = pytest.mark.skipif(compiled() is None, reason="the kernel was not built")


def same(a, b):
    """Two named tuples of arrays and numbers."""
    for name, x, y in zip(a._fields, a, b, strict=True):
        if isinstance(x, np.ndarray):
            assert x.dtype == y.dtype, name
            assert np.array_equal(x, y, equal_nan=x.dtype.kind == "f"), name
        else:
            assert x == y, name


def damaged(data, draw):
    """With some bytes changed, cut somewhere."""
    out = bytearray(data)
    for _ in range(draw.choice([0, 1, 3, 20])):
        out[draw.randrange(len(out))] = draw.choice([0, 1, 0x7E, 0xA5, draw.randrange(256)])
    return np.frombuffer(bytes(out[: draw.randrange(len(out) // 2, len(out) + 1)]), np.uint8)


@pytest.mark.parametrize("seed", SEEDS)
def test_frames(seed):
    draw = random.Random(seed)
    name = draw.choice(list(CONTAINERS))
    data, c = damaged(CONTAINERS[name](BODIES), draw), container(name)
    known = assigned()
    known[draw.randrange(256)] = True
    start = min(c.file_header + draw.choice([0, 0, 1, 43]), len(data))
    same(DEFINITION.scan(data, start, len(data), c, known), compiled().scan(data, start, len(data), c, known))
    for other in TABLE:
        for count in (1, 3):
            last = min(start + 300, len(data))
            expected = DEFINITION.find(data, start, last, len(data), other, known, count)
            assert compiled().find(data, start, last, len(data), other, known, count) == expected
            held = DEFINITION.holds(data, start, len(data), other, known, count)
            assert compiled().holds(data, start, len(data), other, known, count) == held


def traffic(draw):
    """Packets of many kinds."""
    out = []
    for k, body in enumerate(BODIES):
        data = udp(body + draw.choice([b"", body, b"\x30", b"\xa5" * 4]), port=draw.choice([80, 8600]))
        kind = draw.randrange(6)
        if kind == 0:
            out.append(ethernet(ipv6(data, protocol=draw.choice([17, 0, 44, 43, 51, 60, 6])), kind=0x86DD))
        elif kind == 1:
            out += [ethernet(ipv4(data[:16], flags=0x2000, number=k)), ethernet(ipv4(data[16:], flags=2, number=k))]
        elif kind == 2:
            out.append(ethernet(data, kind=draw.choice([0x0806, 0x88CC, 0x0026])))
        else:
            out.append(ethernet(ipv4(data), tags=draw.choice([b"", b"\x81\0\0\5"])))
    return out


@pytest.mark.parametrize("seed", SEEDS)
def test_captures(seed):
    draw = random.Random(seed)
    made = draw.choice([pcap, pcapng])
    data = damaged(made(traffic(draw), order=draw.choice("<>"), link=draw.choice([1, 1, 1, 113, 101])), draw)
    mine, theirs = DEFINITION.packets(), compiled().packets()
    start = mine.begin(data[:24].tobytes())
    assert theirs.begin(data[:24].tobytes()) == start
    middle = draw.randrange(start, len(data) + 1)
    for stop in (middle, len(data)):
        a, b = mine.scan(data, start, stop, 5), theirs.scan(data, start, stop, 5)
        same(a, b)
        start = a.position
        if a.broken:
            break
    mine.finish()
    theirs.finish()
    assert theirs.passed == mine.passed
    assert theirs.channels == mine.channels
