"""Datagrams as they come: the same blocks as of their capture, whatever is around them."""

import random

import numpy as np
import pytest
from containers_made import blocks, hdlc, ioss, oradis

from saltus.framing import Datagrams
from saltus.framing.twins import DEFINITION, compiled

BODIES = blocks(30)
USING = [DEFINITION, *([compiled()] if compiled() else [])]


def of(chunk):
    spans = zip(chunk.offset.tolist(), chunk.length.tolist(), strict=True)
    return [chunk.data[a : a + n].tobytes() for a, n in spans]


@pytest.mark.parametrize("using", USING)
def test_payloads_of_blocks_and_of_containers(using):
    payloads = [b"".join(BODIES[:3]), ioss(BODIES[3:5]), oradis(BODIES[5:7]), hdlc(BODIES[7:8]), BODIES[8]]
    feed = Datagrams(using)
    chunk = feed.feed(payloads, 100.0 + np.arange(5), [7, 8, 7, 9, 7])
    assert of(chunk) == BODIES[:9]
    assert chunk.at.tolist() == [0, 0, 0, 1, 1, 2, 2, 3, 4]
    assert chunk.clock.tolist() == [100.0] * 3 + [101.0] * 2 + [102.0] * 2 + [103.0, 104.0]
    assert chunk.channel.tolist() == [7, 7, 7, 8, 8, 7, 7, 9, 7]
    assert chunk.dated
    assert not feed.passed
    assert feed.feed([BODIES[9]], [200.0]).at.tolist() == [5]


@pytest.mark.parametrize("using", USING)
def test_what_is_no_asterix_is_counted_and_a_torn_block_too(using):
    feed = Datagrams(using)
    chunk = feed.feed([b"hello, world", BODIES[0] + BODIES[1][:9], b"", BODIES[2]], np.zeros(4))
    assert of(chunk) == [BODIES[0], BODIES[2]]
    assert feed.passed == {"no ASTERIX": 2, "ends within a block": 1}
    assert len(feed.feed([], [])) == 0


def test_how_they_are_fed_changes_nothing():
    rng = random.Random(2)
    payloads = [b"".join(rng.sample(BODIES, rng.randrange(1, 4))) for _ in range(200)]
    payloads[50] = rng.randbytes(300)
    time = np.arange(200) / 10
    at_once = Datagrams().feed(payloads, time)
    feed, got = Datagrams(), []
    for k in range(0, 200, 7):
        got.append(feed.feed(payloads[k : k + 7], time[k : k + 7]))
    assert [b for c in got for b in of(c)] == of(at_once)
    for name in ("at", "clock", "channel", "category"):
        assert np.concatenate([getattr(c, name) for c in got]).tolist() == getattr(at_once, name).tolist()


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="65507 at most"):
        Datagrams().feed([bytes(70_000)], [0.0])
    with pytest.raises(ValueError, match="2 payloads"):
        Datagrams().feed([b"a", b"b"], [0.0])
