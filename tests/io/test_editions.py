"""Editions told by what they explain and by the sense of the values, of many blocks and of one."""

import numpy as np
import pytest

from saltus.asterix.layout import editions, layout
from saltus.errors import DataError
from saltus.io import read
from saltus.io.blocks import Blocks
from saltus.io.editions import choose_edition, weigh

# CAT021 edition 0.23: FSPEC ff a0, 010 040 030 130 080 140 090 | 210 - 145
# 20/107; 040; 23:59:59.148 is 11059091 = a8bf93 of 1/128 s; latitude and longitude 2 x 3 bytes, 180/2^23 degrees:
# -9.404 is -438260 = f9500c, 45.797 is 2134282 = 20910a; address; 140; 090; 210; flight level 350 = 1400 = 0578
OLD = "ffa0 146b 0028 a8bf93 f9500c20910a 4d2023 1730 0007 08 0578"


def cat021(body, category=21):
    data = bytes.fromhex(body)
    return bytes([category]) + (3 + len(data)).to_bytes(2, "big") + data


def blocks(*some):
    length = np.array([len(b) for b in some], np.int64)
    offset = np.cumsum(length) - length
    n, none = len(some), np.full(len(some), np.nan)
    category = np.array([b[0] for b in some], np.uint8)
    data = np.frombuffer(b"".join(some), np.uint8)
    return Blocks(data, offset, length, category, none, np.zeros(n, np.bool_), offset, np.full(n, -1, np.int32), False)


def test_one_record_tells_its_edition(tmp_path):
    (tmp_path / "a.ast").write_bytes(cat021(OLD))
    got = read([tmp_path / "a.ast"])
    assert got.contents[0].edition == "0.23"
    assert got.plots.time[0] == pytest.approx(11059091 / 128, abs=1e-9)  # 23:59:59.148
    assert np.degrees(got.plots.latitude[0]) == pytest.approx(-438260 * 180 / 2**23, abs=1e-9)
    assert np.degrees(got.plots.longitude[0]) == pytest.approx(2134282 * 180 / 2**23, abs=1e-9)
    assert got.plots.altitude[0] == pytest.approx(35000 * 0.3048)
    assert got.plots.containment[0] == pytest.approx(185.2)  # PA 7 is a NUCp: a bound of 0.1 NM
    assert np.isnan(got.plots.sigma[0])  # and no accuracy
    assert "edition guessed: 0.23 explains 100% of the bytes" in got.contents[0].notes[0]


def new(content=""):
    """A report of edition 2.1: 131 is 41.904 and 3.030 degrees in steps of 180/2^30, 145 is 1480/4 = FL 370."""
    latitude, longitude = round(41.904 * 2**30 / 180), round(3.030 * 2**30 / 180)
    values = {"010": "14db", "040": "00", "131": f"{latitude:08x}{longitude:08x}", "080": "abcdef", "073": "384000"}
    values |= {"145": "05c8", "RE": content} if content else {"145": "05c8"}
    names = [child.path if child else "" for child in layout(21, "2.1").records[""].children]
    flags = bytearray(7)
    for name in values:
        flags[names.index(name) // 7] |= 0x80 >> names.index(name) % 7
    for k in range(6):
        flags[k] |= 1
    return cat021(flags.hex() + "".join(values[n] for n in names if n in values))


def test_a_broken_item_in_every_block(tmp_path):
    broken = new("03ff12")  # a reserved expansion field that announces more than it holds
    for n in (1, 60):
        (tmp_path / "a.ast").write_bytes(broken * n)
        got = read([tmp_path / "a.ast"])
        assert got.contents[0].edition == "2.1"
        assert len(got.plots) == n
        assert np.degrees(got.plots.latitude[0]) == pytest.approx(41.904, abs=1e-6)
        assert np.degrees(got.plots.longitude[0]) == pytest.approx(3.030, abs=1e-6)
        assert got.plots.altitude[0] == pytest.approx(37000 * 0.3048)
        told = [p for p in got.problems if "RE" in p]
        assert len(told) == min(n, 8)
        assert "the record is used without it" in told[0]


def test_of_equals_the_newest_but_the_commonest_of_adsb():
    chosen = choose_edition(21, blocks(new()), None, "a")
    assert chosen.edition == "2.1"
    assert "2.1 to 2.7 explain 100% of the bytes" in chosen.note
    radar = bytes.fromhex("30000f f0 1481 003240 a0 0a004000")
    chosen = choose_edition(48, blocks(radar), None, "a")
    assert (chosen.edition, chosen.note) == (editions(48)[-1], "")


def test_evidence_is_of_bytes_and_of_sense():
    old = weigh(21, "0.23", blocks(cat021(OLD)))
    assert (old.share, old.sense) == (1.0, 1.0)
    assert old.nats > 0 > weigh(21, "2.1", blocks(cat021(OLD))).nats
    # A time of day beyond midnight and a flight level of 2000 speak against it, 0.98 against 0.02.
    wrong = OLD.replace("a8bf93", "ffffff").replace("0578", "1f40")
    assert weigh(21, "0.23", blocks(cat021(wrong))).nats < old.nats - 5


def test_none_fits_and_what_to_try(tmp_path):
    other = cat021("ffffffffffff")
    chosen = choose_edition(21, blocks(*[other] * 30), None, "a")
    assert chosen.edition == ""
    assert 'to see what there is, write 21 = "' in chosen.note
    with pytest.raises(DataError, match=r"edition '9\.9' of category 21 is not known; choose one of 0\.23"):
        choose_edition(21, blocks(other), "9.9", "a")
    assert choose_edition(250, blocks(cat021("8001", 250)), None, "a").note == "no definition of it is known."


def test_field_cases(request):
    folder = request.getfixturevalue("recordings").parent / "field"
    if not folder.is_dir():
        pytest.skip(f"field cases not found at {folder}")
    one = read([folder / "cat021_one_record" / "ed023.ast"])
    assert one.contents[0].edition == "0.23"
    assert one.plots.time[0] == pytest.approx(86399.148, abs=1e-3)
    assert np.degrees([one.plots.latitude[0], one.plots.longitude[0]]) == pytest.approx([-9.404, 45.797], abs=1e-3)
    assert one.plots.altitude[0] == pytest.approx(35000 * 0.3048)
    bad = read([folder / "cat021_bad_re" / "block1.ast"])
    assert bad.contents[0].edition == "2.1"
    assert np.degrees([bad.plots.latitude[0], bad.plots.longitude[0]]) == pytest.approx([41.904, 3.030], abs=1e-3)
    assert bad.plots.altitude[0] == pytest.approx(37000 * 0.3048)
    assert any("RE" in p for p in bad.problems)


def test_values_that_make_no_sense_do_not_speak_for_an_edition_that_explains_nothing():
    """A test pattern: times past the end of the day, latitudes beyond the poles, by 2.1 alone to be parsed."""
    times, position = "ffffff", "7fffffff7fffffff"
    values = {
        "010": "14db",
        "040": "00",
        "131": position,
        "080": "ffffff",
        "073": times,
        "145": "7fff",
        "170": "ff" * 6,
    }
    names = [child.path if child else "" for child in layout(21, "2.1").records[""].children]
    flags = bytearray(5)
    for name in values:
        flags[names.index(name) // 7] |= 0x80 >> names.index(name) % 7
    for k in range(4):
        flags[k] |= 1
    pattern = cat021(flags.hex() + "".join(values[n] for n in names if n in values))
    chosen = choose_edition(21, blocks(pattern, pattern), None, "a")
    assert chosen.edition == "2.1"
    assert next(w for w in chosen.weighed if w.edition == "2.1").share == 1.0
