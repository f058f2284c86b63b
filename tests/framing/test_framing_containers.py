"""Every container: recognised by its structure, cut into the blocks it was made of, with their times."""

import numpy as np
import pytest
from containers_made import CONTAINERS, blocks, frame, gps, hdlc, ioss, oradis, plain, radar_block, rff, time_of_day

from saltus.errors import DataError
from saltus.framing import Framer
from saltus.framing.twins import DEFINITION, compiled
from saltus.io.blocks import credible

BODIES = blocks(100)
SCANNERS = [DEFINITION, *([compiled()] if compiled() else [])]


@pytest.mark.parametrize("using", SCANNERS, ids=["definition", "compiled"][: len(SCANNERS)])
@pytest.mark.parametrize("name", CONTAINERS)
def test_containers_are_told_by_their_structure(name, using):
    data = CONTAINERS[name](BODIES)
    got, told = frame(data, using=using)
    assert [b for _, _, b, _, _ in got] == BODIES
    assert [data[at : at + len(b)] for _, at, b, _, _ in got] == BODIES
    assert not any(cut for *_, cut in got)
    assert told.problems == ()
    (segment,) = told.segments
    assert (segment.framing, segment.start, segment.stop, segment.n_blocks) == (name, 0, len(data), len(BODIES))
    assert segment.share == 1.0
    assert told.guesses[0].name == name
    assert told.guesses[0].share == 1.0
    assert all(g.share < 0.2 for g in told.guesses[1:])


@pytest.mark.parametrize("name", CONTAINERS)
def test_one_block_is_enough(name):
    got, told = frame(CONTAINERS[name]([radar_block(0)]))
    assert [b for _, _, b, _, _ in got] == [radar_block(0)]
    assert told.segments[0].framing == name


@pytest.mark.parametrize("piece", [1, 3, 100, 4096])
@pytest.mark.parametrize("name", CONTAINERS)
def test_pieces_change_nothing(name, piece):
    data = CONTAINERS[name](BODIES[:40])
    assert frame(data, piece=piece)[0] == frame(data)[0]


def test_times_of_day_of_recorders():
    for made, step in ((gps, 1 / 128), (ioss, 0.01)):
        clock = [c for *_, c, _ in frame(made(BODIES))[0]]
        assert np.allclose(clock, [time_of_day(k) for k in range(len(BODIES))], rtol=0, atol=step / 2 + 1e-9)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("start", [b"2023-05-02 08:00:00\0", b"20230502080000\0\0\0\0\0\0", b"02/05/2023 08:00:00 "])
def test_rff_counts_from_its_header(order, start):
    framer = Framer("a.rff", credible)
    (chunk,) = [*framer.feed(rff(BODIES, order=order, start=start)), *framer.finish()]
    began = 19479 * 86400 + 8 * 3600  # 2023-05-02 08:00:00
    expected = [began + round(1e3 * time_of_day(k)) / 1e3 for k in range(len(BODIES))]
    assert chunk.dated
    assert np.allclose(chunk.clock, expected, rtol=0, atol=1e-6)


def test_rff_without_a_date_has_no_clock():
    framer = Framer("a.rff", credible)
    (chunk,) = [*framer.feed(rff(BODIES, start=bytes(20))), *framer.finish()]
    assert not chunk.dated
    assert np.isnan(chunk.clock).all()


def test_lines_are_channels():
    data = ioss(BODIES[:20], line=1) + ioss(BODIES[20:40], line=2)
    framer = Framer("a.rec", credible)
    (chunk,) = [*framer.feed(data), *framer.finish()]
    assert framer.told.channels == ["board 3 line 1", "board 3 line 2"]
    assert chunk.channel.tolist() == [0] * 20 + [1] * 20


def test_several_blocks_in_a_frame_and_idle_bytes():
    pairs = [BODIES[k] + BODIES[k + 1] for k in range(0, 100, 2)]
    for made in (ioss, oradis, rff):
        assert [b for _, _, b, _, _ in frame(made(pairs))[0]] == BODIES[:100]
    got, told = frame(hdlc(pairs, idle=b"\x7e\x7e"))
    assert [b for _, _, b, _, _ in got] == BODIES[:100]
    assert told.problems == ()


def test_foreign_frames_are_counted():
    foreign = ioss([b"hello, this is no ASTERIX"])
    got, told = frame(ioss(BODIES[:10]) + foreign * 3 + ioss(BODIES[10:20]))
    assert [b for _, _, b, _, _ in got] == BODIES[:20]
    assert told.passed == {"frames without ASTERIX": 3}
    assert "3 frames whose content is no ASTERIX" in told.problems[0]


def test_framing_as_asked():
    data = plain(BODIES)
    assert frame(data, framing="plain")[0] == frame(data)[0]
    got, told = frame(data, framing="oradis")  # obeyed, though it fits nowhere
    assert told.segments[0].framing == "oradis"
    assert not [b for _, _, b, _, cut in got if not cut]
    assert (
        "framing oradis, as asked, explains 0% of the first bytes, plain 100%; leave --framing out" in told.problems[0]
    )
    with pytest.raises(DataError, match=r"framing 'oradi' is not known; choose one of plain, gps, ioss"):
        frame(data, framing="oradi")
    with pytest.raises(DataError, match=r"byte 0: .*no packet capture"):
        frame(data, framing="pcap")
