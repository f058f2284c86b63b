"""The report: self-contained, safe against what files hold, true to the tables, written whole or not at all."""

import base64
import json
import os
import re
from dataclasses import fields, replace
from html.parser import HTMLParser

import numpy as np
import pyarrow as pa
import pytest

from saltus.errors import DataError
from saltus.geo import Site
from saltus.records import REASONS, Kind, Plots, Source, System
from saltus.report import colours, data, tables, write_report
from saltus.report.sensors import HEIGHT, WIDTH
from saltus.report.settings import UNITS, readable
from saltus.report.updates import groups, read_updates
from saltus.tracks.health import Degraded, Health
from saltus.tracks.registration import RegistrationSettings
from saltus.tracks.settings import FilterSettings, SystemsSettings, TrackerSettings
from saltus.tracks.setup_settings import IntakeSettings, PeriodSettings, SetupSettings

T0 = 1_700_000_000.0
SITE = Site(np.radians(41.3), np.radians(2.1), 27.3, 0.0)
EVIL = "</script><script>alert(1)</script>"
_VOID = {"meta", "input", "br"}
_TYPES = {"f4": "<f4", "u1": "u1", "u2": "<u2", "i2": "<i2", "i4": "<i4"}


class Page(HTMLParser):
    """Collect elements, attributes and the embedded data; fail on an element closed out of order."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.open, self.scripts = [], [], []
        self.text = text
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in _VOID:
            self.open.append(tag)
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, content):
        if self.open and self.open[-1] == "script":
            self.scripts[-1] += content

    @property
    def data(self):
        return json.loads(self.scripts[0], parse_constant=lambda name: pytest.fail(f"{name} in JSON"))


def column(packed):
    return np.frombuffer(base64.b64decode(packed["b64"]), _TYPES[packed["type"]])


def scene(n=40, callsign="VLG8304", file="one.ast"):
    """Two tracks (one turning, one parked) from polar plots; some plots unused, some rejected."""
    k = np.arange(n)
    time = T0 + 4.0 * k
    plots = Plots.build(
        2 * n,
        (Source(System(48, 20, 129, "BCN")),),
        (file,),
        {
            "time": np.concatenate([time, time + 1.0]),
            "source": np.zeros(2 * n),
            "file": np.zeros(2 * n),
            "record": np.arange(2 * n),
            "kind": np.full(2 * n, Kind.POLAR),
            "range": np.concatenate([20_000.0 + 600.0 * k, np.full(n, 4_000.0)]),
            "azimuth": np.full(2 * n, 1.0),
            "altitude": np.concatenate([np.full(n, 3_000.0), np.full(n, 30.0)]),
            "reason": np.where(k == 3, REASONS.index("coasted by station"), 0).tolist() + [0] * n,
        },
    )
    used = np.concatenate([~np.isin(k, [3, 5]), np.full(n, True)])
    ids = [(7 if i < n else 9) if u else None for i, u in enumerate(used)]
    reasons = [None if u else "coasted by station" if i == 3 else "not associated" for i, u in enumerate(used)]
    assignments = pa.table(
        {
            "source": [file] * (2 * n),
            "category": np.full(2 * n, 48),
            "record": np.arange(2 * n),
            "time": plots.time,
            "track_id": pa.array(ids, pa.int64()),
            "reason": pa.array(reasons, pa.string()),
        }
    )
    tracks = pa.table(
        {
            "track_id": np.repeat([7, 9], n),
            "time": plots.time,
            "latitude": np.concatenate([41.4 + 0.004 * k, np.full(n, 41.31)]),
            "longitude": np.concatenate([2.3 + 0.005 * k, np.full(n, 2.11)]),
            "altitude": plots.altitude,
            "speed_mps": np.repeat([150.0, 0.2], n),
            "course_deg": np.full(2 * n, 45.0),
            "p_manoeuvre_h": np.concatenate([np.where(k >= n - 10, 0.9, 0.1), np.zeros(n)]),
            "p_manoeuvre_v": np.zeros(2 * n),
            "status": ["tentative", "tentative", *["confirmed"] * (n - 3), "coasted"] * 2,
            "icao24": ["4b1617"] * n + [None] * n,
            "mode3a": pa.array([0o7000] * n + [None] * n, pa.int32()),
            "callsign": [callsign] * n + [None] * n,
        }
    )
    innovations = pa.table(
        {
            "track_id": np.full(n, 7),
            "time": time,
            "source": ["CAT048:20/129"] * n,
            "latitude": 41.4 + 0.004 * k,
            "longitude": 2.3 + 0.005 * k,
            "gate_e": np.full(n, 210.0),
            "gate_n": np.full(n, 190.0),
            "nis": np.full(n, 2.0),
            "dof": np.full(n, 2),
        }
    )
    return {"tracks": tracks, "plots": plots, "assignments": assignments, "innovations": innovations}


def render(tmp_path, summary=None, sites=None, **parts):
    path = tmp_path / "report.html"
    write_report(path, **parts, summary=summary or {}, sites={"CAT048:20/129": SITE} if sites is None else sites)
    return Page(path.read_text(encoding="utf-8"))


def test_page_needs_nothing_but_itself(tmp_path):
    page = render(tmp_path, **scene(), summary={"inputs": ["one.ast"]})
    assert not re.search(r"https?://|//cdn|@import|url\(|fetch\(|XMLHttpRequest|WebSocket|importScripts", page.text)
    assert not [a for _, attrs in page.elements for a in attrs if a in ("src", "href", "srcset", "action", "data")]
    policy = next(attrs["content"] for tag, attrs in page.elements if attrs.get("http-equiv"))
    assert "default-src 'none'" in policy


def test_script_finds_every_element_it_asks_for(tmp_path):
    page = render(tmp_path, **scene())
    asked = set(re.findall(r'getElementById\("([\w-]+)"\)', page.scripts[1]))
    ids = [attrs["id"] for _, attrs in page.elements if "id" in attrs]
    assert len(asked) > 10
    assert asked <= set(ids)
    assert len(ids) == len(set(ids))


def test_text_from_files_stays_text(tmp_path):
    image = "<img src=x onerror=alert(2)>"
    parts = scene(callsign=EVIL, file=image + ".ast")
    summary = {
        "inputs": [image + ".ast", EVIL, "third"],
        "problems": [EVIL + " & more"],
        "noise": {image: {"sigma_range_m": {"configured": EVIL, "estimated": 3.5}}},
        image: {EVIL: {"deep": [EVIL, image]}},
    }
    page = render(tmp_path, **parts, summary=summary, sites={EVIL: SITE})
    assert len(page.scripts) == 2  # the data and ours
    assert not any(tag == "img" for tag, _ in page.elements)
    assert not any(name.startswith("on") for _, attrs in page.elements for name in attrs)
    assert page.data["tracks"][0]["callsign"] == EVIL
    assert page.data["sites"][0]["name"] == EVIL


def test_positions_agree_with_geodesics(tmp_path):
    from pyproj import Geod

    parts = scene()
    drawn = render(tmp_path, **parts).data
    site = drawn["sites"][0]
    geod = Geod(ellps="WGS84")
    for x, y, lat, lon in (
        (
            column(drawn["updates"]["x"]),
            column(drawn["updates"]["y"]),
            parts["tracks"]["latitude"].to_numpy(),
            parts["tracks"]["longitude"].to_numpy(),
        ),
        (
            column(drawn["gates"]["x"])[:40],
            column(drawn["gates"]["y"])[:40],
            parts["innovations"]["latitude"].to_numpy(),
            parts["innovations"]["longitude"].to_numpy(),
        ),
    ):
        azimuth, _, distance = geod.inv(np.full(len(lat), 2.1), np.full(len(lat), 41.3), lon, lat)
        # A conformal plane stretches distances by (d / 2R)^2: 6e-6 at 32 km; float32 holds 40 km to 4 mm.
        np.testing.assert_allclose(np.hypot(x - site["x"], y - site["y"]), distance, rtol=1e-5, atol=0.1)
        np.testing.assert_allclose(np.degrees(np.arctan2(x - site["x"], y - site["y"])) % 360, azimuth % 360, atol=0.01)


def test_polar_plots_lie_at_their_ground_range_and_azimuth(tmp_path):
    parts = scene()
    drawn = render(tmp_path, **parts).data
    x, y = column(drawn["plots"]["x"]), column(drawn["plots"]["y"])
    plots = parts["plots"]
    # Flat triangle: the earth's curvature moves the ground range by less than 30 m at 45 km and 3 km of height.
    ground = np.sqrt(plots.range**2 - (plots.altitude - SITE.height) ** 2)
    np.testing.assert_allclose(np.hypot(x, y), ground, atol=40.0)
    np.testing.assert_allclose(np.arctan2(x, y), plots.azimuth, atol=1e-4)


@pytest.mark.parametrize("order", ["as read", "shuffled"])
def test_plots_are_told_apart(tmp_path, rng, order):
    parts = scene()
    if order == "shuffled":
        parts["assignments"] = parts["assignments"].take(rng.permutation(parts["assignments"].num_rows))
    plots = render(tmp_path, **parts).data["plots"]
    kind = column(plots["class"])
    assert kind[3] == 2
    assert kind[5] == 1
    assert (np.delete(kind, [3, 5]) == 0).all()
    assert column(plots["track"]).tolist() == [0, 0, 0, -1, 0, -1, *[0] * 34, *[1] * 40]


def test_updates_keep_their_values(tmp_path):
    parts = scene()
    drawn = render(tmp_path, **parts).data
    u = drawn["updates"]
    np.testing.assert_allclose(column(u["ph"]) * 0.004, parts["tracks"]["p_manoeuvre_h"].to_numpy(), atol=0.002)
    np.testing.assert_allclose(column(u["course"]) * 0.01, 45.0, atol=0.005)
    np.testing.assert_allclose(column(u["t"]), parts["plots"].time - T0, atol=1e-3)
    assert np.isnan(column(drawn["gates"]["e"])[40:]).all()  # the parked track has no innovations
    first, second = drawn["tracks"]
    assert (first["icao24"], first["mode3a"], first["id"]) == ("4B1617", "7000", 7)
    assert (second["label"], second["first"], second["end"]) == ("#9", 40, 80)


def test_track_rows_sum_up_each_track():
    updates = read_updates(scene()["tracks"].take(np.random.default_rng(0).permutation(80)))
    turning, parked = updates.rows
    assert turning.n_updates == 39
    assert turning.n_coasted == 1
    assert turning.duration == 4.0 * 39
    assert turning.manoeuvre_s == 4.0 * 9  # the last ten updates, one of them coasted
    assert (parked.n_moving, parked.max_h) == (0, 0.0)
    assert groups(updates.rows) == ([0], [1])


def test_tracks_without_height_have_no_vertical_probability():
    tracks = scene()["tracks"]
    at = tracks.column_names.index("altitude")
    tracks = tracks.set_column(at, "altitude", pa.array([3_000.0] * 40 + [None] * 40, pa.float64()))
    flying, sailing = read_updates(tracks).rows
    assert flying.max_v == 0.0 and np.isnan(sailing.max_v)


def test_busiest_are_those_that_move():
    tracks = scene()["tracks"].drop(["p_manoeuvre_h", "speed_mps"])
    tracks = tracks.append_column("speed_mps", pa.array(np.repeat([0.1, 9.0], 40)))
    assert groups(read_updates(tracks).rows) == ([], [1, 0])


def _empty(parts):
    return {k: v.slice(0, 0) if isinstance(v, pa.Table) else v for k, v in parts.items()} | {
        "plots": Plots.build(0, (), (), {})
    }


def _nulls(parts):
    tracks = parts["tracks"]
    for name in ("altitude", "speed_mps", "course_deg", "p_manoeuvre_h", "p_manoeuvre_v", "callsign", "icao24"):
        tracks = tracks.set_column(tracks.column_names.index(name), name, pa.nulls(tracks.num_rows))
    plots = parts["plots"]
    time, slant = plots.time.copy(), plots.range.copy()
    time[4], slant[6] = np.nan, np.nan
    plots = replace(plots, time=time, range=slant)
    return parts | {"tracks": tracks, "plots": plots, "innovations": parts["innovations"].slice(0, 0)}


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (_empty, "No track was confirmed."),
        (_nulls, "Not drawn for want of a position or a time"),
        (lambda p: p | {"tracks": p["tracks"].slice(0, 0)}, "No track was confirmed."),
        (lambda p: _empty(p) | {"tracks": p["tracks"]}, "VLG8304"),
    ],
    ids=["nothing", "nulls", "no tracks", "no plots"],
)
@pytest.mark.parametrize("sites", [{}, {"A": SITE}])
def test_gaps_in_the_data_still_give_a_page(tmp_path, change, text, sites):
    page = render(tmp_path, **change(scene()), sites=sites, summary={"noise": None, "x": {"y": float("nan")}})
    assert text in page.text
    assert {"plots", "updates", "gates"} <= set(page.data)


def test_large_inputs_are_thinned_and_the_page_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(data, "MAX_PLOTS", 30)
    monkeypatch.setattr(data, "MAX_UPDATES", 30)
    page = render(tmp_path, **scene())
    assert "One report in 3 is drawn, of 80;" in page.text
    assert "One track update in 3 is drawn, of 80" in page.text
    t = column(page.data["updates"]["t"])
    assert len(column(page.data["plots"]["t"])) == 27
    first, second = page.data["tracks"]
    assert t[[first["first"], first["end"] - 1]].tolist() == [0.0, 156.0]  # ends are kept
    assert t[[second["first"], second["end"] - 1]].tolist() == [1.0, 157.0]


def test_wild_times_of_rejected_reports_do_not_stretch_the_page(tmp_path):
    parts = scene()
    time = parts["plots"].time.copy()
    time[3] = T0 + 1e6
    parts["plots"] = replace(parts["plots"], time=time)
    assert render(tmp_path, **parts).data["t1"] == T0 + 157.0


def test_a_time_window_counts_and_draws_only_what_is_inside(tmp_path, monkeypatch):
    """Of 80 reports 44 are inside, at 0 to 85 s; one of them is rejected, one on no track."""
    monkeypatch.setattr(data, "MAX_PLOTS", 30)
    parts = scene()
    outside = parts["plots"].time > T0 + 86.0
    reason = np.where(outside, REASONS.index(tables.OUTSIDE), parts["plots"].reason)
    parts["plots"] = replace(parts["plots"], reason=reason.astype(parts["plots"].reason.dtype))
    ids, why = parts["assignments"]["track_id"].to_pylist(), parts["assignments"]["reason"].to_pylist()
    for i in np.flatnonzero(outside):
        ids[i], why[i] = None, tables.OUTSIDE
    for name, values, kind in (("track_id", ids, pa.int64()), ("reason", why, pa.string())):
        at = parts["assignments"].column_names.index(name)
        parts["assignments"] = parts["assignments"].set_column(at, name, pa.array(values, kind))
    page = render(tmp_path, **parts)
    assert page.data["t1"] == T0 + 85.0
    assert column(page.data["updates"]["t"]).max() == 85.0
    assert len(column(page.data["plots"]["t"])) == 22 and column(page.data["plots"]["t"]).max() <= 85.0
    assert "One report in 2 is drawn, of 44 in the time window;" in page.text
    assert "outside the time window: 36 reports" in page.text
    rows = tables.reason_rows(parts["assignments"])
    assert rows[0] == ("on a track", 42, 42 / 44) and rows[-1][:2] == (tables.OUTSIDE, 36)
    assert np.isnan(rows[-1][2]) and sum(share for *_, share in rows[:-1]) == pytest.approx(1.0)
    assert "<dt>On a track</dt><dd>42 <small>95.5%" in page.text


def test_tracks_that_coast_past_the_end_do_not_stretch_the_page(tmp_path):
    parts = scene()
    past = parts["tracks"].slice(79)
    past = past.set_column(past.column_names.index("time"), "time", pa.array([T0 + 180.0]))
    page = render(tmp_path, **(parts | {"tracks": pa.concat_tables([parts["tracks"], past])}))
    assert page.data["t1"] == T0 + 157.0
    assert len(column(page.data["updates"]["t"])) == 80


def test_failed_writing_leaves_the_old_page(tmp_path, monkeypatch):
    path = tmp_path / "report.html"
    path.write_text("old")

    def refuse(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(DataError, match="disk full"):
        write_report(path, **scene(), summary={}, sites={})
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_outcomes_are_counted():
    rows = tables.reason_rows(scene()["assignments"])
    assert [(name, n) for name, n, _ in rows] == [("on a track", 78), ("coasted by station", 1), ("not associated", 1)]
    assert sum(share for _, _, share in rows) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("factor", "verdict"),
    [(1.0, "fits"), (0.75, "fits"), (1.3, "noise used is too small"), (0.44, "noise used is too large")],
)
def test_innovations_are_judged_by_chi_square(rng, factor, verdict):
    from scipy.stats import chi2

    n = 4000
    dof = np.where(rng.random(n) < 0.5, 2, 3)
    nis = factor * rng.chisquare(dof)
    (row,) = tables.innovation_rows(pa.table({"source": ["A"] * n, "nis": nis, "dof": dof}))
    assert row.verdict == verdict
    assert row.inside == np.mean(nis <= chi2.ppf(0.95, dof))
    assert (row.low, row.high) == pytest.approx((1.1 - 6.0 / np.sqrt(n), 2.2 + 6.0 / np.sqrt(n)))
    assert abs(row.mean / factor - 2.0) < 5.0 * 2.0 / np.sqrt(n)


def test_any_summary_becomes_tables():
    noise = tables.blocks("noise", {"A": {"sigma_range_m": {"configured": None, "estimated": 3.5}}})
    assert noise == [
        tables.Block("Noise", ("", "σ range, m · configured", "σ range, m · estimated"), (("A", "–", "3.5"),))
    ]
    mixed = tables.blocks("settings", {"identity": "use", "gate": {"probability": 0.999, "keep": True}, "list": [1, 2]})
    assert [b.title for b in mixed] == ["Settings", "Settings · gate"]
    assert mixed[0].rows == (("Identity", "use"), ("List", "1, 2"))
    assert mixed[1].rows == (("Probability", "0.999"), ("Keep", "yes"))
    assert tables.blocks("runs", [{"a": 1}, {"b": 2.0}])[0].rows == (("1", "–"), ("–", "2"))
    assert tables.blocks("n", 12_345)[0].rows == (("12\u202f345",),)


def test_the_plane_is_said_in_short():
    plane = {"projection": "stereographic, WGS-84, of scale 1", "latitude": 41.300699561, "longitude": 2.1}
    said = readable({"plane": plane})["plane"]
    assert said == {"projection": "stereographic", "centre_latitude_deg": 41.3007, "centre_longitude_deg": 2.1}


def test_run_has_dates_and_units(tmp_path):
    kinds = {"tracker": TrackerSettings, "filter": FilterSettings, "systems": SystemsSettings}
    kinds |= {"registration": RegistrationSettings, "setup": SetupSettings}
    kinds |= {"intake": IntakeSettings, "periods": PeriodSettings}
    for group, units in UNITS.items():
        assert set(units) <= {field.name for field in fields(kinds[group])}
    chosen = {"tracker": {"max_speed": 400.0, "coast_seconds": 20.0}, "filter": {"accel_h": (0.15, 3.0)}}
    summary = {"time_from": T0, "time_to": None, "settings": {"identity": "use", **chosen}}
    text = render(tmp_path, **scene(), summary=summary).text
    assert "<td>2023-11-14 22:13:20 UTC</td>" in text
    assert '<td>Max speed, m/s</td><td class="n">400</td>' in text
    assert '<td>Acceleration horizontal, m/s²</td><td class="n">0.15, 3</td>' in text
    assert "<td>Coast, s</td>" in text


def test_colours_are_even_steps_that_darken():
    # Ottosson (2020): sRGB red is Oklab (0.6280, 0.2249, 0.1258), white is (1, 0, 0).
    np.testing.assert_allclose(colours.srgb_to_oklab([1.0, 0.0, 0.0]), [0.6280, 0.2249, 0.1258], atol=1e-4)
    np.testing.assert_allclose(colours.srgb_to_oklab(np.ones(3)), [1.0, 0.0, 0.0], atol=1e-4)
    for ends in (colours.PROBABILITY_ENDS, colours.HEIGHT_ENDS):
        rgb = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in colours.colour_map(ends)]) / 255.0
        steps = np.linalg.norm(np.diff(colours.srgb_to_oklab(rgb), axis=0), axis=1)
        # Rounding to 1/255 moves a colour by at most half a level in three channels: about 0.003.
        assert np.ptp(steps) < 0.006
        # Another measure of lightness: CIE Y, by the Rec. 709 weights.
        luminance = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722]
        assert (np.diff(luminance) < 0).all()


def test_sensors_in_time(tmp_path):
    """Bars of faulty plots, lines of P(degraded), and the spells as text; a sensor without plots is left out."""
    time = T0 + np.arange(0.0, 160.0, 0.5)
    fault = np.zeros(len(time), np.int8)
    fault[time < T0 + 1.0] = 2  # both plots of the first bin, in range
    p = np.stack([np.where((time > T0 + 80) & (time < T0 + 120), 0.9, 0.0), np.zeros(len(time))], axis=-1)
    spell = Degraded(T0 + 80.5, T0 + 119.5, "azimuth degraded", 0.9)
    radar = Health(f"Radar {EVIL}", ("azimuth", "range"), time, fault, time, p, [spell])
    idle = Health("Idle", ("position",), time[:0], fault[:0], time[:0], p[:0, :1], [])
    page = render(tmp_path, **scene(), sensors=[radar, idle])
    assert EVIL not in page.text and "Idle" not in page.text
    paths = [attrs for tag, attrs in page.elements if tag == "path"]
    assert [a["class"] for a in paths] == ["bars h", "bars v", "line h", "line v"]
    assert paths[0]["d"] == ""
    span = 4.0 * 39 + 1.0  # s, of the page's plots and tracks
    assert paths[1]["d"].count("M") == 1 and f"V{HEIGHT * 0:.1f}" in paths[1]["d"]  # a whole bin faulty: full height
    points = np.array([xy.split() for xy in paths[2]["d"][1:].split("L")], float)
    high = points[points[:, 1] < HEIGHT / 2, 0] / WIDTH * span
    assert 79.0 < high.min() < 82.0 and 118.0 < high.max() < 121.0
    assert "azimuth degraded, P 0.90" in page.text
    assert [tag for tag, a in page.elements if a.get("id") == "sensors"] == ["section"]
    ticks = re.findall(r"<span>(\d\d:\d\d[:\d]*)</span>", page.text)
    assert (ticks[0], ticks[3], ticks[-1]) == ("22:13:20", "22:14:38", "22:15:57")  # T0 is 22:13:20
    assert "Sensors in time" not in render(tmp_path, **scene()).text
