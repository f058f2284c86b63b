"""Whole recordings against what another program decoded, and against what is known of them."""

import datetime

import numpy as np
import pyarrow.parquet as pq
import pytest

from saltus.io import read
from saltus.records import REASONS, Kind

LEBL = datetime.date(2016, 5, 10)


def twin(path):
    table = pq.read_table(path)
    return {name: table[name].to_pylist() for name in table.column_names}


def aligned(plots, table, keep=None):
    """Reports in file order by time (ties in file order), the twin likewise; both are stable."""
    rows = [k for k in range(len(table["time"])) if keep is None or keep(k)]
    rows.sort(key=lambda k: table["time"][k])
    assert len(plots) == len(rows)
    return plots, {name: [column[k] for k in rows] for name, column in table.items()}


def floats(values):
    return np.array([np.nan if v is None else v for v in values], np.float64)


def same(mine, theirs, tolerance):
    """Equal within half a step of float32, and absent together."""
    theirs = floats(theirs)
    np.testing.assert_array_equal(np.isnan(mine), np.isnan(theirs))
    np.testing.assert_allclose(mine, theirs, atol=tolerance, rtol=2e-7, equal_nan=True)


def octal(values):
    return np.array([-1 if v is None else int(v, 8) for v in values])


def hexadecimal(values):
    return np.array([-1 if v is None else int(v, 16) for v in values])


def names(values):
    return np.array([(v or "").strip() for v in values], "U8")


def order(plots, *columns):
    """A common order for rows of equal time: the twins keep no file order among them."""
    return np.lexsort((*columns, plots.time))


def test_barcelona_radar(recordings):
    folder = recordings / "bcn_cat048_2023-05-02"
    got = read([folder / "bcn_cat048.ast"], date=datetime.date(2023, 5, 2))
    plots, table = aligned(got.plots, twin(folder / "bcn_cat048.parquet"))
    mine = order(plots, np.round(np.degrees(plots.azimuth), 4))
    theirs = np.lexsort((np.round(floats(table["theta_deg"]), 4), floats(table["time"])))
    plots = plots.take(mine)
    table = {name: [column[k] for k in theirs] for name, column in table.items()}
    same(plots.time, table["time"], 1e-6)
    same(plots.range / 1852, table["rho_nm"], 0.0)
    same(np.degrees(plots.azimuth), table["theta_deg"], 1e-5)
    valid = np.array([v == 0 and g == 0 for v, g in zip(table["fl_v"], table["fl_g"], strict=True)])
    same(plots.altitude / 30.48, np.where(valid, floats(table["fl"]), np.nan), 1e-6)
    valid = np.array([v == 0 and g == 0 for v, g in zip(table["mode3a_v"], table["mode3a_g"], strict=True)])
    known = plots.mode3a >= 0
    np.testing.assert_array_equal(plots.mode3a[known], octal(table["mode3a"])[known])
    assert np.all(valid[known])
    np.testing.assert_array_equal(plots.icao24, hexadecimal(table["icao24"]))
    np.testing.assert_array_equal(plots.callsign, names(table["callsign"]))
    np.testing.assert_array_equal(plots.local_id, table["trk"])
    coasted = plots.reason == REASONS.index("coasted by station")
    np.testing.assert_array_equal(coasted, np.array(table["typ"]) == 0)
    assert sorted(plots.record.tolist()) == list(range(29212))
    (line,) = got.contents
    assert str(line.system) == "CAT048:20/129"
    assert line.n_records == line.n_reports == 29212
    assert line.rejected == {"coasted by station": 123}
    assert line.update_period == pytest.approx(4.0, abs=0.02)
    assert len(set(plots.icao24.tolist()) - {-1}) == 129


def test_argentina_radar_dated_by_its_capture(recordings):
    folder = recordings / "argentina_2026-04-29"
    got = read([folder / "radar_226_232.pcap"])
    plots, table = aligned(got.plots, twin(folder / "radar_226_232.parquet"))
    same(plots.time, table["time"], 1e-6)
    same(plots.range / 1852, table["rho_nm"], 0.0)
    same(np.degrees(plots.azimuth), table["theta_deg"], 1e-5)
    valid = np.array([v == 0 and g == 0 for v, g in zip(table["fl_v"], table["fl_g"], strict=True)])
    same(plots.altitude / 30.48, np.where(valid, floats(table["fl"]), np.nan), 1e-6)
    assert not got.problems
    by_category = {c.system.category: c for c in got.contents}
    assert by_category[48].n_records == 2585
    assert by_category[48].update_period == pytest.approx(7.63, abs=0.01)
    assert by_category[34].n_by_type == {"North marker message": 361, "Sector crossing message": 11574}


def test_argentina_system_tracks(recordings):
    folder = recordings / "argentina_2026-04-29"
    got = read([folder / "cat062_226_2.pcap"])
    table = twin(folder / "cat062_226_2.parquet")
    tracks = got.tracks.to_pydict()
    assert len(tracks["time"]) == 37082
    mine = np.lexsort((tracks["track_number"], tracks["time"]))
    theirs = np.lexsort((table["trk"], table["time"]))
    ours = {name: [column[k] for k in mine] for name, column in tracks.items()}
    table = {name: [column[k] for k in theirs] for name, column in table.items()}
    same(np.array(ours["time"]), table["time"], 1e-6)
    assert ours["track_number"] == table["trk"]
    same(np.array(ours["latitude"]), table["lat"], 1e-9)
    same(np.array(ours["longitude"]), table["lon"], 1e-9)
    same(np.array(ours["x_m"]), table["x_m"], 0.0)
    same(np.array(ours["vy"]), table["vy_mps"], 0.0)
    same(np.array(ours["vertical_rate"]) / 0.3048 * 60, table["roc_fpm"], 1e-3)
    assert ours["coasted"] == [v == 1 for v in table["cst"]]
    assert ours["last"] == [v == 1 for v in table["tse"]]
    assert np.all(got.plots.reason == REASONS.index("system track"))
    assert got.contents[0].update_period == pytest.approx(4.0, abs=0.05)


def test_barcelona_surface_radar(recordings):
    folder = recordings / "lebl_2016-05-10"
    got = read([folder / "smr.ast"], date=LEBL)
    table = twin(folder / "smr.parquet")
    plots, table = aligned(got.plots, table, lambda k: table["msg_type"][k] == 1)
    mine, theirs = order(plots, plots.local_id), np.lexsort((table["trk"], table["time"]))
    plots = plots.take(mine)
    table = {name: [column[k] for k in theirs] for name, column in table.items()}
    same(plots.time, table["time"], 1e-6)
    same(plots.range, table["rho_m"], 0.0)
    same(np.degrees(plots.azimuth), table["theta_deg"], 1e-5)
    same(plots.x, table["x_m"], 0.0)
    assert np.count_nonzero(plots.kind == Kind.POLAR) == 22042
    (line,) = got.contents
    assert (line.n_records, line.n_reports) == (26549, 22353)
    assert line.n_by_type == {"PSR": 22353, "Start of Update Cycle": 2098, "Periodic Status Message": 2098}
    assert line.rejected == {"no position": 311}
    assert line.update_period == pytest.approx(1.0, abs=0.05)


def test_barcelona_multilateration(recordings):
    folder = recordings / "lebl_2016-05-10"
    got = read([folder / "mlat.ast"], date=LEBL)
    table = twin(folder / "mlat.parquet")
    plots, table = aligned(got.plots, table, lambda k: table["msg_type"][k] == 1)
    theirs = np.lexsort((floats(table["x_m"]), hexadecimal(table["icao24"]), table["time"]))
    plots = plots.take(order(plots, plots.x, plots.icao24))
    table = {name: [column[k] for k in theirs] for name, column in table.items()}
    same(plots.time, table["time"], 1e-6)
    same(plots.x, table["x_m"], 0.0)
    same(plots.y, table["y_m"], 0.0)
    np.testing.assert_array_equal(plots.icao24, hexadecimal(table["icao24"]))
    np.testing.assert_array_equal(plots.callsign, names(table["callsign"]))
    np.testing.assert_array_equal(plots.on_ground == 1, [v == 1 for v in table["gbs"]])
    assert np.all(plots.kind == Kind.PLANE)


def test_barcelona_adsb_edition_0_23(recordings):
    folder = recordings / "lebl_2016-05-10"
    got = read([folder / "adsb_v023.ast"], date=LEBL)
    plots, table = aligned(got.plots, twin(folder / "adsb_v023.parquet"))
    theirs = np.lexsort((table["lat"], hexadecimal(table["icao24"]), table["time"]))
    plots = plots.take(order(plots, plots.latitude, plots.icao24))
    table = {name: [column[k] for k in theirs] for name, column in table.items()}
    same(plots.time, table["time"], 1e-6)
    same(np.degrees(plots.latitude), table["lat"], 1e-9)
    same(np.degrees(plots.longitude), table["lon"], 1e-9)
    same(plots.altitude, table["altitude_m"], 1e-3)
    np.testing.assert_array_equal(plots.on_ground, table["gbs"])
    assert got.contents[0].edition == "0.23"
    assert "edition guessed: 0.23" in got.contents[0].notes[0]


def test_three_systems_merge_by_time(recordings):
    folder = recordings / "lebl_2016-05-10"
    got = read([folder / f"{name}.ast" for name in ("smr", "mlat", "adsb_v023")], date=LEBL)
    assert [str(s.system) for s in got.plots.sources] == ["CAT010:0/7", "CAT010:0/107", "CAT021:0/107"]
    assert np.all(np.diff(got.plots.time) >= 0)
    counts = np.bincount(got.plots.source)
    assert counts.tolist() == [22353, 30418, 42848]
    assert got.plots.files == ("smr.ast", "mlat.ast", "adsb_v023.ast")
    np.testing.assert_array_equal(got.plots.file, got.plots.source)


def test_small_recordings(recordings):
    folder = recordings / "asterix_small"
    adsb = read([folder / "adsb_v21_bcn.ast"])
    assert {str(c.system): (c.n_records, c.edition) for c in adsb.contents} == {
        "CAT021:20/219": (7565, "2.1"),
        "CAT023:20/219": (58, "1.3"),
    }
    assert len(set(adsb.plots.icao24.tolist())) == 147
    assert any("no date given" in p for p in adsb.problems)
    radars = read([folder / "croatia_cat034_048.pcap"])
    assert sum(c.n_records for c in radars.contents if c.system.category == 48) == 128
    assert sum(c.n_records for c in radars.contents if c.system.category == 34) == 34
    centre = read([folder / "croatia_cat062_065.pcap"])
    assert [(c.system.category, c.n_records) for c in centre.contents] == [(62, 2), (65, 1)]
    old = read([folder / "croatia_cat062.pcap"])
    assert "none of the editions" in old.contents[0].notes[0]
    assert len(old.plots) == 0
