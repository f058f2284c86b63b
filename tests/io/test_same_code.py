"""Two sensors that send one SAC/SIC: told apart by channel where that tells them, else said and counted."""

import struct

import frames
import numpy as np
import pytest

from saltus.config import load_config
from saltus.io import read, read_in_order
from saltus.io.asterix import read_pieces

CODE = (20, 129)
TURN = 4.0  # s
# Two radars 60 km apart, east and north of the first, m; and three aircraft that fly east
SITES = ((0.0, 0.0), (60e3, 0.0))
AIRCRAFT = [(20e3, 30e3), (-10e3, 50e3), (40e3, -35e3)]


def radar(site, turns, *, phase=0.0, first=36_000.0):
    """Plots of one radar as (time, block), and its north marks."""
    found = []
    for k in range(turns):
        north = first + phase + TURN * k
        mark = frames.NORTH.replace(bytes.fromhex("003200"), round(north * 128).to_bytes(3, "big"))
        found.append((north, mark))
        for n, (east, up) in enumerate(AIRCRAFT):
            x, y = east + 200.0 * (north - first) - site[0], up - site[1]
            azimuth = np.arctan2(x, y) % (2 * np.pi)
            when = north + TURN * azimuth / (2 * np.pi)
            rho, theta = round(np.hypot(x, y) * 256 / 1852), round(azimuth * 65536 / (2 * np.pi)) % 65536
            found.append((when, frames.plot(tod=when, rho=rho, theta=theta, address=0x400000 + n)))
    return found


def ioss(blocks):
    """FINAL frames of (line, block)."""
    return b"".join(
        struct.pack(">HBBB", 12 + len(body), 1, line, 7) + bytes(3) + body + b"\xa5" * 4 for line, body in blocks
    )


def recording(path, *, sites=SITES, phases=(0.0, 1.1), lines=(1, 2), turns=60):
    """Two radars of one code, each on its line; or both on one."""
    both = [(line, *p) for line, s, ph in zip(lines, sites, phases, strict=True) for p in radar(s, turns, phase=ph)]
    both.sort(key=lambda row: row[1])
    path.write_bytes(ioss([(line, body) for line, _, body in both]))
    return path


def test_two_radars_on_lines_of_their_own_are_kept_apart(tmp_path):
    path = recording(tmp_path / "a.raw")
    got = read([path])
    assert [str(s.system) for s in got.plots.sources] == [
        "CAT048:20/129 on board 1 line 1",
        "CAT048:20/129 on board 1 line 2",
    ]
    assert np.bincount(got.plots.source).tolist() == [180, 180]
    (said,) = (p for p in got.problems if "SAC/SIC 20/129" in p)
    assert "is sent by 2 sensors: of " in said
    assert 'channel = "board 1 line 1"' in said
    periods = {str(c.system): c.update_period for c in got.contents}
    assert periods == pytest.approx(dict.fromkeys(periods, TURN), abs=0.02)
    assert len(periods) == 4  # plots and service messages of both


def test_so_they_are_however_it_is_read(tmp_path):
    path = recording(tmp_path / "a.raw", turns=200)
    whole = read([path])
    *chunks, last = read_in_order([path])
    assert {str(s.system) for c in chunks for s in c.plots.sources} == {str(s.system) for s in whole.plots.sources}
    assert last.problems == whole.problems
    *pieces, _ = read_pieces(path, date=None, editions={})
    assert {str(c.system) for p in pieces for c in p.contents} == {str(c.system) for c in whole.contents}


def test_two_radars_on_one_line_are_said_and_counted(tmp_path):
    got = read([recording(tmp_path / "a.raw", lines=(1, 1))])
    assert [str(s.system) for s in got.plots.sources] == ["CAT048:20/129"]
    (said,) = (p for p in got.problems if "SAC/SIC 20/129" in p)
    assert "nothing in the recording tells them apart: they are used as if they were one" in said
    assert "Correct the code of one at its source" in said


def test_two_antennas_at_one_site_are_told_by_their_north_marks(tmp_path):
    one_site = (SITES[0], SITES[0])
    got = read([recording(tmp_path / "a.raw", sites=one_site, lines=(1, 1))])
    assert any("its north marks are those of two antennas" in p for p in got.problems)
    got = read([recording(tmp_path / "a.raw", sites=one_site)])
    assert {s.system.channel for s in got.plots.sources} == {"board 1 line 1", "board 1 line 2"}


def test_codes_that_several_aircraft_share_are_no_second_sensor(tmp_path):
    """Five aircraft with Mode 3/A 7000 and one with 1234, without addresses: 010 140 020 040 070 090."""
    plots = []
    for k in range(60):
        for n in range(6):
            body = f"1481 {round((36_000 + TURN * k + n / 2) * 128):06x} 40 {2560 + 999 * n:04x}{9000 * n:04x}"
            record = bytes.fromhex("fc" + body + ("0e00" if n else "029c") + "0190")
            plots.append(b"\x30" + (3 + len(record)).to_bytes(2, "big") + record)
    (tmp_path / "a.ast").write_bytes(b"".join(plots))
    got = read([tmp_path / "a.ast"])
    assert (got.plots.reason == 0).all()
    assert not any("SAC/SIC" in p for p in got.problems)


def test_one_radar_on_two_lines_is_one(tmp_path):
    """Redundant lines repeat every block; a radar may also send every other block on each."""
    alone = [body for _, body in sorted(radar(SITES[0], 60))]
    doubled = tmp_path / "a.raw"
    doubled.write_bytes(ioss([(line, body) for body in alone for line in (1, 2)]))
    got = read([doubled])
    assert [str(s.system) for s in got.plots.sources] == ["CAT048:20/129"]
    assert not any("SAC/SIC" in p for p in got.problems)
    assert [c.rejected for c in got.contents if c.n_reports] == [{"duplicate": 180}]
    shared = tmp_path / "b.raw"
    shared.write_bytes(ioss([(1 + k % 2, body) for k, body in enumerate(alone)]))
    assert [str(s.system) for s in read([shared]).plots.sources] == ["CAT048:20/129"]


def test_a_configuration_tells_them_apart_without_being_asked(tmp_path):
    path = recording(tmp_path / "a.raw", turns=3)  # too few to find out
    assert len(read([path]).plots.sources) == 1
    (tmp_path / "c.toml").write_text(
        "".join(
            f'[[sensor]]\nsac = 20\nsic = 129\nchannel = "board 1 line {line}"\nlatitude = 41\nlongitude = {line}\n'
            for line in (1, 2)
        )
    )
    config = load_config(tmp_path / "c.toml")
    got = read([path], apart=config.apart)
    sites = [config.site_for(s.system) for s in got.plots.sources]
    assert [s.longitude for s in sites] == [1, 2]
    assert config.site_for(read([path]).plots.sources[0].system) is None
    longer = recording(tmp_path / "b.raw")
    for found in (read([longer], apart=config.apart), list(read_in_order([longer], apart=config.apart))[-1]):
        assert not any("SAC/SIC" in p for p in found.problems)  # what to do has been done
        assert {c.system.channel for c in found.contents} == {"board 1 line 1", "board 1 line 2"}
