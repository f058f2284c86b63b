"""`saltus info` on the command line."""

import numpy as np
import pytest
from click.testing import CliRunner

from saltus.cli import main
from saltus.config import load_config
from saltus.info.figures import Figures
from saltus.io.asterix_write import write_cat048
from saltus.records import Kind, Plots


def info(*arguments):
    return CliRunner().invoke(main, ["info", *map(str, arguments)])


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / "radar.ast"
    write_cat048(
        path,
        sac=20,
        sic=129,
        time_of_day=[3600.0, 3604.0],
        range_m=[10e3, 10.1e3],
        azimuth_rad=[1.0, 1.1],
        icao24=[1, 1],
        north_marker_times=[3599.0, 3603.0, 3607.0],
    )
    return path


def test_says_what_is_in_a_recording(recording):
    (recording.parent / "c.toml").write_text(
        'date = 2024-05-01\n[[sensor]]\nname = "BCN"\nsac = 20\nsic = 129\nlatitude = 41.3\nlongitude = 2.1\n'
    )
    result = info(recording, "--config", recording.parent / "c.toml")
    assert result.exit_code == 0, result.output
    lines = [" ".join(line.split()) for line in result.output.splitlines()]
    assert "radar.ast" in lines
    assert "CAT048:20/129 BCN edition 1.32 monoradar plots" in lines
    assert "framing plain ASTERIX (explains 100.0%)" in lines
    assert "targets 1 by Mode S address" in lines
    assert "extent range 5.4 to 5.5 NM (10.0 to 10.1 km), azimuth 57 to 63 degrees" in lines
    assert "I048/040 Measured Position in Polar Co-ordinates 2 100%" in lines
    assert "records 2, of these 2 target reports" in lines
    assert "time 2024-05-01 01:00:00.000 to 2024-05-01 01:00:04.000 UTC (4.000 s)" in lines
    assert lines.count("update 4.000 s") == 2
    assert "types Single ModeS Roll-Call 2" in lines
    assert "rejected none (2 usable)" in lines
    assert "2 target reports, 2 usable, 0 rejected" in lines
    assert "problem" not in result.output
    assert "\x1b" not in result.output  # plain when it is no terminal


def test_option_goes_before_configuration(recording):
    result = info(recording, "--date", "2024-05-02")
    assert "2024-05-02 01:00:00.000" in result.output


def test_without_a_date_times_of_day(recording):
    result = info(recording)
    assert "01:00:00.000 to 01:00:04.000 UTC" in result.output
    assert "problem: radar.ast: no date given" in result.output


def test_one_clear_line_for_what_cannot_be(recording, tmp_path):
    (tmp_path / "x.json").write_text("{}")
    for arguments, text in (
        ((tmp_path / "x.json",), "unknown format"),
        ((tmp_path / "absent.ast",), "absent.ast"),
        ((recording, "--date", "yesterday"), "YYYY-MM-DD"),
    ):
        result = info(*arguments)
        assert result.exit_code != 0
        assert text in result.output
        assert len(result.output.strip().splitlines()) == 1


def test_files_that_cannot_be_read_are_named_after_the_others(recording, tmp_path):
    (tmp_path / "x.json").write_text("{}")
    (tmp_path / "empty.ast").touch()
    one = info(tmp_path / "x.json", recording)
    assert one.exit_code == 2
    assert "2 target reports, 2 usable" in one.output
    assert "x.json: unknown format" in one.output.splitlines()[-1]
    two = info(tmp_path / "x.json", recording, tmp_path / "empty.ast")
    assert two.exit_code == 2
    assert "2 target reports, 2 usable" in two.output
    assert ["x.json: unknown" in two.output.splitlines()[-2], "empty" in two.output.splitlines()[-1]] == [True, True]


def test_recordings_as_given(recordings):
    folder = recordings / "lebl_2016-05-10"
    result = info(folder / "smr.ast", "--config", folder / "sensors.toml")
    text = " ".join(result.output.split())
    assert "CAT010:0/7 SMR edition 1.1 surface movement sensors of an airport records 26549, of these 22353" in text
    assert "time 2016-05-10 22:00:01.695 to 2016-05-10 22:34:59.984 UTC (35.0 min) update 1.000 s" in text
    assert "rejected no position 311 (22042 usable)" in text


def test_a_skeleton_is_a_configuration(tmp_path):
    n = 400
    for sic, offset in ((1, 0.0), (2, 5e3)):
        write_cat048(
            tmp_path / f"r{sic}.ast",
            sac=20,
            sic=sic,
            time_of_day=3600 + 4.0 * np.arange(n),
            range_m=20e3 + offset + 100.0 * np.arange(n),
            azimuth_rad=np.full(n, 1.0),
            icao24=np.full(n, 0xABCDEF),
            north_marker_times=3599 + 4.0 * np.arange(n),
        )
    result = info(tmp_path, "--skeleton", "--date", "2024-05-01")
    assert result.exit_code == 0, result.output
    path = tmp_path / "sensors.toml"
    path.write_text(result.output)
    config = load_config(path)
    assert str(config.date) == "2024-05-01"
    assert [(s.sac, s.sic, s.category, s.name, s.period) for s in config.sensor] == [
        (20, 1, 48, "CAT048:20/1", 4.0),
        (20, 2, 48, "CAT048:20/2", 4.0),
    ]
    assert set(config.editions) == {34, 48} and config.editions[48] == "1.32"
    assert result.output.count("# latitude = 0.0 ") == 2
    # Filled in, it is all that a run needs.
    path.write_text(
        result.output.replace("# latitude = 0.0 ", "latitude = 41.3 ").replace("# longitude = 0.0", "longitude = 2.1")
    )
    run = CliRunner().invoke(
        main, ["track", str(tmp_path / "r1.ast"), "--config", str(path), "-o", str(tmp_path / "out")]
    )
    assert run.exit_code == 0, run.output


def test_a_skeleton_takes_the_site_that_a_radar_tells(tmp_path):
    # CAT034: 010, 000 = 1 (north marker), 030, and 120: 100 m, 45 and -90 degrees in steps of 180/2^23 in 3 bytes
    latitude, longitude = (45 << 23) // 180, -(90 << 23) // 180
    place = (100).to_bytes(2, "big") + latitude.to_bytes(3, "big") + longitude.to_bytes(3, "big", signed=True)
    body = bytes.fromhex("e110 0a0b 01 003240".replace(" ", "")) + place
    north = b"\x22" + (3 + len(body)).to_bytes(2, "big") + body
    plot = bytes.fromhex("30 000f f0 0a0b 003240 a0 0a004000".replace(" ", ""))
    (tmp_path / "a.ast").write_bytes((north + plot) * 3)
    shown = " ".join(info(tmp_path / "a.ast").output.split())
    assert "site 45.000000, -90.000000 degrees, 100.0 m, as it tells itself" in shown
    (tmp_path / "s.toml").write_text(info(tmp_path / "a.ast", "--skeleton").output)
    (sensor,) = load_config(tmp_path / "s.toml").sensor
    assert (sensor.latitude, sensor.longitude, sensor.height) == (45.0, -90.0, 100.0)


def test_the_beginning_of_a_large_file_is_enough(tmp_path, monkeypatch):
    from framing.containers_made import blocks, plain

    monkeypatch.setattr("saltus.info.command._HEAD", 1 << 20)
    path = tmp_path / "long.ast"
    path.write_bytes(plain(blocks(60_000)))
    size = path.stat().st_size
    head = " ".join(info(path).output.split())
    assert f"read the first 1.0 MB of {size / 1e6:.1f} MB ({(1 << 20) / size:.1%}); --full reads all" in head
    assert "60000 target reports" not in head
    full = " ".join(info(path, "--full").output.split())
    assert "60000 target reports, 60000 usable, 0 rejected" in full
    assert "--full" not in full


def test_containers_and_packets_passed_over(tmp_path):
    from framing.containers_made import blocks, ethernet, gps, ipv4, pcap, udp

    (tmp_path / "a.bin").write_bytes(gps(blocks(50)))
    shown = " ".join(info(tmp_path / "a.bin").output.split())
    assert "framing GPS recorder (explains 100.0%)" in shown
    assert "problem: a.bin: no date given" in shown
    frames = [ethernet(ipv4(udp(b))) for b in blocks(20)] + [bytes(12) + b"\x08\x06" + bytes(28)] * 3
    (tmp_path / "b.pcap").write_bytes(pcap(frames))
    shown = " ".join(info(tmp_path / "b.pcap").output.split())
    assert "channels 1: 10.0.0.1:4000 > 239.1.1.1:8600" in shown
    assert "passed over ARP 3" in shown


def plots(**columns):
    n = len(next(iter(columns.values())))
    return Plots.build(n, (), (), columns)


def targets(*some):
    figures = Figures()
    for each in some:
        figures.add(each)
    return figures.targets()


def extents(*some):
    figures = Figures()
    for each in some:
        figures.add(each)
    return figures.extents()


def levels(*some):
    figures = Figures()
    for each in some:
        figures.add(each)
    return figures.levels()


def test_targets_by_what_tells_them_apart_best():
    assert targets(plots(icao24=[1, 2, 2, -1, -1], mode3a=[7, 7, 7, 8, -1])) == (
        "2 by Mode S address, 1 by Mode 3/A code of those without; 1 report without identity"
    )
    assert targets(plots(icao24=[1, 2]), plots(icao24=[2, 3])) == "3 by Mode S address"
    assert targets(plots(local_id=[5, 6, 6])) == "2 by the system's own track numbers"
    assert targets(plots(time=[1.0, 2.0])) == "cannot be told: no report carries an identity"


def test_extents_across_north_and_across_the_date_line():
    kind = np.full(3, Kind.POLAR)
    some = plots(kind=kind, range=[1852.0, 18520.0, 9260.0], azimuth=np.radians([350.0, 5.0, 10.0]))
    assert extents(some) == ["range 1.0 to 10.0 NM (1.9 to 18.5 km), azimuth 350 to 10 degrees"]
    kind = np.full(3, Kind.GEODETIC)
    some = plots(kind=kind, latitude=np.radians([-17.0, -16.0, -18.0]), longitude=np.radians([179.0, -179.0, 178.0]))
    assert extents(some) == ["latitude -18.000 to -16.000, longitude 178.000 to -179.000 degrees"]
    turning = np.radians(np.arange(0.0, 360.0, 5.0))
    some = plots(kind=np.full(72, Kind.POLAR), range=np.full(72, 1e4), azimuth=turning)
    assert extents(some)[0].endswith("all round")
    # One wild position among many is left out.
    far = np.concatenate([np.linspace(40.0, 41.0, 999), [89.0]])
    some = plots(kind=np.full(1000, Kind.GEODETIC), latitude=np.radians(far), longitude=np.full(1000, 0.1))
    assert "latitude 40.0" in extents(some)[0]
    assert "to 41.0" in extents(some)[0] or "to 40.99" in extents(some)[0]


def test_levels():
    feet = np.array([0.0, 5000.0, 10000.0, 15000.0, np.nan])
    some = plots(altitude=feet * 0.3048, on_ground=[1, 0, 0, 0, 0])
    assert levels(some) == "FL 0 to 150, half of them FL 0 to 100; 80% tell one; 20% on the ground"
    assert levels(some, some) == levels(some)
    assert levels(plots(time=[1.0])) == ""
