"""What becomes of each category's items, on frames worked out by hand."""

import datetime

import numpy as np
import pytest
from frames import NORTH, PLOT, capture, plot

from saltus.asterix.layout import categories, editions, layout
from saltus.errors import DataError
from saltus.io import read
from saltus.io.asterix_write import write_cat048
from saltus.io.categories import CATEGORIES
from saltus.records import REASONS, Datum, Kind, Traits

DAY = datetime.date(2024, 5, 1)
MIDNIGHT = datetime.datetime(2024, 5, 1, tzinfo=datetime.UTC).timestamp()


def load(tmp_path, *frames, **options):
    (tmp_path / "a.ast").write_bytes(b"".join(frames))
    return read([tmp_path / "a.ast"], date=DAY, **options)


def reasons(got):
    return [REASONS[code] for code in got.plots.reason]


def block(category, body):
    records = bytes.fromhex(body)
    return bytes([category]) + (3 + len(records)).to_bytes(2, "big") + records


def test_radar_plot(tmp_path):
    got = load(tmp_path, NORTH, PLOT)
    (p,) = [got.plots.take(slice(0, 1))]
    assert len(got.plots) == 1
    assert p.time[0] == MIDNIGHT + 100.5
    assert p.range[0] == 18520.0
    assert p.azimuth[0] == pytest.approx(np.pi / 2, rel=1e-15)
    assert p.altitude[0] == pytest.approx(3048.0)
    assert (p.icao24[0], p.mode3a[0], p.callsign[0]) == (0x3C6444, 0o1234, "DLH1")
    assert (p.on_ground[0], p.kind[0], p.record[0], p.local_id[0]) == (0, Kind.POLAR, 0, -1)
    source = p.sources[p.source[0]]
    assert (source.range_lsb, source.time_lsb) == (1852 / 256, 1 / 128)
    assert str(source.system) == "CAT048:20/129"
    assert source.traits == Traits(rotating=True)
    assert got.problems == ()


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("00", "coasted by station"),  # TYP 0
        ("b0", "simulated"),  # TYP 5, SIM is the fourth bit
        ("a2", "field monitor"),  # RAB is the seventh
        ("a0", ""),
    ],
)
def test_what_is_no_plot_says_why(tmp_path, kind, reason):
    got = load(tmp_path, plot(kind=kind))
    assert reasons(got) == [reason]
    assert got.contents[0].rejected == ({reason: 1} if reason else {})
    assert got.contents[0].n_reports == 1


def test_test_target_in_the_first_extension(tmp_path):
    frame = plot().replace(b"\xa0\x0a\x00", b"\xa1\x80\x0a\x00")  # FX set; TST is the extension's first bit
    assert reasons(load(tmp_path, b"\x30\x00\x20" + frame[3:])) == ["test target"]


@pytest.mark.parametrize(("code", "level"), [("829c", "8190"), ("429c", "4190"), ("229c", "0190")])
def test_doubtful_codes_are_lost_and_the_plot_is_not(tmp_path, code, level):
    """V, G, L are the three high bits of Mode 3/A; V, G of Mode C."""
    got = load(tmp_path, plot(code=code, level=level))
    assert reasons(got) == [""]
    assert got.plots.mode3a[0] == -1
    assert np.isnan(got.plots.altitude[0]) == (level != "0190")


@pytest.mark.parametrize("edition", ["1.27", "1.31", "1.32"])
def test_levels_below_zero(tmp_path, edition):
    """-12 quarters = -300 ft: 0x4000 - 12 = 0x3ff4 in 14 bits, whatever the edition's table says of the sign."""
    got = load(tmp_path, plot(level="3ff4"), editions={48: edition})
    assert got.plots.altitude[0] == pytest.approx(-91.44)
    assert got.contents[0].edition == edition


@pytest.mark.parametrize(
    ("state", "ground"), [("2000", 0), ("2400", 1), ("2800", 0), ("2c00", 1), ("3000", -1), ("3400", -1)]
)
def test_flight_status(tmp_path, state, ground):
    """COM 1 is 0x2000; STAT counts in steps of 0x0400."""
    assert load(tmp_path, plot(state=state)).plots.on_ground[0] == ground


def test_records_count_within_their_category(tmp_path):
    three = bytes.fromhex("30 0057") + PLOT[3:] + plot(tod=101.0)[3:] + plot(tod=102.0)[3:]
    got = load(tmp_path, NORTH, three, NORTH, plot(tod=103.0, sic=7))
    assert got.plots.record.tolist() == [0, 1, 2, 3]
    by_system = {str(c.system): c for c in got.contents}
    assert by_system["CAT048:20/129"].n_records == 3
    assert by_system["CAT048:20/7"].n_records == 1
    assert by_system["CAT034:20/129"].n_by_type == {"North marker message": 2}
    assert by_system["CAT048:20/129"].fields["I048/240"] == 3


def test_no_date(tmp_path):
    (tmp_path / "a.ast").write_bytes(PLOT)
    got = read([tmp_path / "a.ast"])
    assert got.plots.time.tolist() == [100.5]
    assert got.problems == ("a.ast: no date given: times count from 1970-01-01; give --date YYYY-MM-DD.",)


def test_unknown_edition(tmp_path):
    with pytest.raises(DataError, match=r"edition '9\.9' of category 48 is not known; choose one of 1\.27"):
        load(tmp_path, PLOT, editions={48: "9.9"})


def test_surface_reports(tmp_path):
    # FSPEC f3 04: 010 000 020 140 - - 042 | - - - - - 220 -; X = 1500 = 05dc, Y = -2 = fffe
    plane = block(10, "f304 0007 01 20 003240 05dcfffe 3c6444")  # 020: TYP 1 (001 in the high bits), airborne
    ground = block(10, "f304 0007 01 24 0032c0 05dcfffe 3c6444")  # GBS is the sixth bit
    polar = block(10, "f4 0007 01 60 003340 03e8 8000")  # 010 000 020 140 - 040 -: TYP 3; 1000 m; half a turn
    cycle = block(10, "d0 0007 02 003240")  # 010 000 - 140
    got = load(tmp_path, cycle, plane, ground, polar)
    p = got.plots
    assert p.record.tolist() == [1, 2, 3]
    assert p.kind.tolist() == [Kind.PLANE, Kind.PLANE, Kind.POLAR]
    assert (p.x[0], p.y[0]) == (1500.0, -2.0)
    assert p.icao24.tolist() == [0x3C6444, 0x3C6444, -1]
    assert p.on_ground.tolist() == [0, 1, -1]
    assert p.range[2] == 1000.0
    assert p.azimuth[2] == pytest.approx(np.pi, rel=1e-15)
    assert got.contents[0].n_records == 4
    assert got.contents[0].n_by_type["Start of Update Cycle"] == 1


def test_adsb_2_1_takes_the_finer_position(tmp_path):
    # FSPEC c7 19 02: 010 040 - - - 130 131 | - - - 080 073 - - | - - - - - - 145
    # 040: 01 (extended) 40 (GBS)
    # 40 degrees are 1864135 = 1c71c7 steps of 180/2^23 and 238609294 = 0e38e38e of 180/2^30
    # 145: FL 350 = 1400 quarters = 0578
    body = "c71902 14db 0140 1c71c7000000 0e38e38e00000000 abcdef 003240 0578"
    got = load(tmp_path, block(21, body), editions={21: "2.1"})
    p = got.plots
    assert np.degrees(p.latitude[0]) == pytest.approx(238609294 * 180 / 2**30, abs=1e-12)
    assert p.time[0] == MIDNIGHT + 100.5
    assert p.altitude[0] == pytest.approx(350 * 30.48)
    assert (p.icao24[0], p.on_ground[0], p.kind[0]) == (0xABCDEF, 1, Kind.GEODETIC)


def test_adsb_0_26_has_no_finer_position(tmp_path):
    # FSPEC d9 01 01 02: 010 040 - 130 080 - - | - - - - - - - | - - - - - - - | - - - - - 131 -
    # 130: 40 degrees are 7456540 = 71c71c steps of 180/2^25; 131 is the signal amplitude, 1 byte
    body = "d9010102 14db 0000 0071c71c00000000 abcdef 7f"
    got = load(tmp_path, block(21, body), editions={21: "0.26"})
    assert np.degrees(got.plots.latitude[0]) == pytest.approx(7456540 * 180 / 2**25, abs=1e-12)


def test_an_edition_that_is_plainly_not_the_files_is_refused(tmp_path):
    ours = block(21, "c71902 14db 0140 1c71c7000000 0e38e38e00000000 abcdef 003240 0578")
    message = (
        r'a\.ast: category 21 .* edition 0\.23, as configured: it explains 90% of .* 40 .* 2\.1 100% .*Write 21 = "'
    )
    with pytest.raises(DataError, match=message):
        load(tmp_path, *[ours] * 40, editions={21: "0.23"})
    # An edition no other is better than is left to the user's word, broken blocks told.
    broken = block(21, "ffffff")
    got = load(tmp_path, *[broken] * 30, *[ours] * 10, editions={21: "2.1"})
    assert got.contents[0].n_reports == 10
    assert "block of category 21 (edition 2.1)" in got.problems[0]


def test_round_trip_of_simulated_plots(tmp_path, rng):
    n = 400
    truth = dict(
        time_of_day=np.sort(rng.uniform(86300, 86500, n)),  # midnight at 86400
        range_m=rng.uniform(1e3, 400e3, n),
        azimuth_rad=rng.uniform(0, 2 * np.pi, n),
        altitude_m=np.where(rng.random(n) < 0.2, np.nan, rng.uniform(-300, 15000, n)),
        icao24=np.where(rng.random(n) < 0.3, -1, rng.integers(0, 1 << 24, n)),
        mode3a=np.where(rng.random(n) < 0.3, -1, rng.integers(0, 4096, n)),
        callsign=rng.choice(["", "DLH1", "AB 12XYZ"], n),
        on_ground=rng.integers(-1, 2, n),
    )
    path = tmp_path / "r.ast"
    write_cat048(path, sac=1, sic=2, **truth, north_marker_times=np.arange(86300.0, 86500.0, 4.0))
    got = read([path], date=DAY)
    p = got.plots
    assert got.problems == ()
    assert np.all(p.reason == 0)
    # written steps are rounded to the nearest, so half a step each
    assert np.max(np.abs(p.time - MIDNIGHT - truth["time_of_day"])) <= 0.5 / 128 + 1e-6
    order = np.argsort(np.round(truth["time_of_day"] * 128), kind="stable")
    truth = {name: values[order] for name, values in truth.items()}
    assert np.max(np.abs(p.range - truth["range_m"])) <= 1852 / 512 + 1e-6
    turn = (p.azimuth - truth["azimuth_rad"] + np.pi) % (2 * np.pi) - np.pi
    assert np.max(np.abs(turn)) <= np.pi / 65536 + 1e-12
    np.testing.assert_array_equal(np.isnan(p.altitude), np.isnan(truth["altitude_m"]))
    assert np.nanmax(np.abs(p.altitude - truth["altitude_m"])) <= 12.5 * 0.3048 + 1e-9
    np.testing.assert_array_equal(p.icao24, truth["icao24"])
    np.testing.assert_array_equal(p.mode3a, truth["mode3a"])
    np.testing.assert_array_equal(p.callsign, truth["callsign"])
    np.testing.assert_array_equal(p.on_ground, truth["on_ground"])
    assert {c.system.category: round(c.update_period, 6) for c in got.contents} == {34: 4.0, 48: 4.0}


def test_old_radar_is_dated_by_its_service_messages(tmp_path):
    """I001/141 counts modulo 512 s: 28801 s are 56 x 512 + 129, and 129 x 128 = 16512 = 4080."""
    # CAT002 FSPEC d0: 010 000 - 030; 28800 s x 128 = 3686400 = 384000
    north = block(2, "d0 1402 01 384000")
    # CAT001 FSPEC fa: 010 020 040 070 090 - 141
    secondary = "20"  # TYP 0 plot, SSRPSR 2 in bits 6-5
    report = f"fa 1402 {secondary} 0500 4000 029c 0190 4080"
    got = load(tmp_path, north, block(1, report), north)
    p = got.plots
    assert got.problems == ()
    assert reasons(got) == [""]
    assert p.time[0] == MIDNIGHT + 28801.0
    assert p.range[0] == 0x500 * 1852 / 128  # 10 NM
    assert p.azimuth[0] == pytest.approx(np.pi / 2, rel=1e-15)
    assert p.altitude[0] == pytest.approx(3048.0)
    assert (p.mode3a[0], p.kind[0]) == (0o1234, Kind.POLAR)
    assert p.sources[0].traits == Traits(rotating=True)
    assert got.contents[0].n_by_type == {"Sole secondary detection": 1}


def test_old_radar_without_a_clock_has_no_time(tmp_path):
    got = load(tmp_path, block(1, "fa 1402 20 0500 4000 029c 0190 4080"))
    assert reasons(got) == ["no time"]
    assert "tell their time modulo 512 s only" in got.problems[0]


def test_old_radar_that_tells_no_time_is_dated_by_what_recorded_it(tmp_path):
    """Reports without I001/141, in a capture."""
    report = block(1, "f8 1402 20 0500 4000 029c 0190")  # 010 020 040 070 090
    path = tmp_path / "a.pcap"
    path.write_bytes(capture([report] * 3, start=1_714_557_600.25, step=1.0))
    got = read([path])
    assert got.plots.time.tolist() == [1_714_557_600.25 + k for k in range(3)]
    assert reasons(got) == [""] * 3
    assert got.problems == ("a.pcap: 3 reports of category 1 tell no time: the clock that recorded them dates them.",)


def test_what_has_no_table_is_refused_with_what_to_do(tmp_path):
    got = load(tmp_path, PLOT, block(30, "80 1402"))
    assert any("CAT030 is the former format of system tracks" in p and "CAT062" in p for p in got.problems)
    rng = np.random.default_rng(4)
    odd = [block(62, "bf01" + rng.bytes(30).hex()) for _ in range(30)]
    got = load(tmp_path, PLOT, *odd)
    (said,) = (p for p in got.problems if "category 62 is not read" in p)
    assert "30 blocks; none of the editions 1.16" in said
    assert "Of CAT062 there is no table of editions before 1.16: have the centre send a later one." in said


def test_plots_and_tracks_of_an_old_radar_in_one_block(tmp_path):
    """The second octet of a track's FSPEC is laid out otherwise: TYP (the high bit of 020) says which it is."""
    north = block(2, "d0 1402 01 384000")
    plot = "fa 1402 20 0500 4000 029c 0190 4080"
    # FSPEC e9 40 of a track: 010 020 161 - 042 - - | - 141; 161 is 7; X = 64/64 NM, Y = -64/64 NM
    track = "e9 40 1402 a0 0007 0040 ffc0 4080"
    got = load(tmp_path, north, block(1, plot + track + plot))
    p = got.plots
    assert p.kind.tolist() == [Kind.POLAR, Kind.PLANE, Kind.POLAR]
    assert reasons(got) == ["", "system track", "duplicate"]
    assert (p.x[1], p.y[1], p.local_id[1]) == (1852.0, -1852.0, 7)


def test_multilateration(tmp_path):
    # FSPEC ff 0f 08: 010 020 140 041 042 161 170 | - - - - 220 245 110 | - - - - 500 - -
    # 40 degrees are 7456540 = 71c71c steps of 180/2^25; X = 100 m = 200 steps = c8
    head = "ff 0f 08 1401"
    # 020: 41 is MS, extended; GBS is 10 in the extension
    body = (
        f"{head} 41 10 003240 0071c71c 00000000 0000c8 ffff38 0007 00 3c6444 00 10c231820820 0010 "
        "40 0008 0008 0000"  # 500: SDP, 2 m and 2 m
    )
    got = load(tmp_path, block(20, body))
    p = got.plots
    assert reasons(got) == [""]
    assert np.degrees(p.latitude[0]) == pytest.approx(40.0, abs=1e-5)
    assert (p.x[0], p.y[0], p.kind[0]) == (100.0, -100.0, Kind.GEODETIC)
    assert p.z[0] == pytest.approx(16 * 6.25 * 0.3048)
    assert p.sigma[0] == pytest.approx(2.0)
    assert (p.icao24[0], p.callsign[0], p.on_ground[0], p.local_id[0]) == (0x3C6444, "DLH1", 1, 7)
    assert got.contents[0].n_by_type == {"Mode S multilateration": 1}


def test_surface_guidance_tracks_are_another_systems(tmp_path):
    # FSPEC d9 0d 10: 010 000 - 140 041 - - | - - - - 161 170 - | - - - 092; 40 degrees are 1c71c71c steps of 180/2^31
    # 092: 400 steps of 6.25 ft
    body = "d9 0d 10 0007 01 003240 1c71c71c 00000000 0005 00 0190"
    got = load(tmp_path, block(11, body))
    p = got.plots
    assert reasons(got) == ["system track"]
    assert np.degrees(p.latitude[0]) == pytest.approx(40.0, abs=1e-5)
    assert p.height[0] == pytest.approx(400 * 6.25 * 0.3048)
    assert p.datum[0] == Datum.MEAN_SEA_LEVEL
    assert got.tracks["track_number"].to_pylist() == [5]
    assert got.tracks["system"].to_pylist() == ["CAT011:0/7"]


@pytest.mark.parametrize(
    ("version", "quality", "sigma", "containment"),
    [
        # 090: NUCr 0, NUCp or NIC 8 (10 hexadecimal, and FX), then NICbaro, SIL, NACp 8 (10)
        (2, "11 10", 92.6 / 2.45, 185.2),  # NACp 8: 0.05 NM; NIC 8: 0.1 NM
        (0, "11 10", np.nan, 25.0),  # version 0 knows no NACp; NUCp 8: 25 m
        (2, "10", np.nan, 185.2),
        (2, "11 11 01 b0", 92.6 / 2.45, 185.2),  # PIC 11: 0.1 NM
        (2, "11 11 01 d0", 92.6 / 2.45, 0.013 * 1852),  # PIC 13 goes before NIC
    ],
)
def test_adsb_quality_by_version(tmp_path, version, quality, sigma, containment):
    # FSPEC c5 19 30: 010 040 - - - 130 - | - - - 080 073 - - | - - 090 210
    body = f"c5 19 30 14db 00 1c71c7000000 abcdef 003240 {quality} {version << 3:02x}"
    got = load(tmp_path, block(21, body), editions={21: "2.1"})
    assert got.problems == ()
    assert got.plots.sigma[0] == pytest.approx(sigma, nan_ok=True)
    assert got.plots.containment[0] == pytest.approx(containment)


def test_every_category_of_the_layouts_has_its_line():
    assert set(CATEGORIES) == set(categories())
    for category in CATEGORIES.values():
        newest = layout(category.number, editions(category.number)[-1])
        for field in category.fields:
            path = field if isinstance(field, str) else field.path
            known = any(path in layout(category.number, e).fields for e in editions(category.number))
            assert known or not path, (category.number, path)
        assert newest.has("010")
