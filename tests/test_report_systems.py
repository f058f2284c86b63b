"""The report's section of several systems: its numbers are those of the tables, its series those of the evidence."""

import csv
import html
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from saltus.engine.identified import Identified, SystemNames
from saltus.identify import Conflict, Decisions, DecisionSettings, Episodes, Evidence, join_evidence
from saltus.records import Plots, Source, System
from saltus.report import pairs
from saltus.report.pairs import pair_rows, step_path, thinned_series, undecided
from saltus.report.section import systems_section
from saltus.report.systems import MAX_CONFLICTS, SystemsFound, bias_blocks, conflict_rows, system_rows
from saltus.run import track_files
from saltus.run.identified import systems_found
from saltus.tracks.membership import Segments
from saltus.tracks.settings import SystemsSettings
from saltus.tracks.systems import Registered
from test_report import EVIL, T0, Page, column, render, scene

RULE = DecisionSettings(prior=0.25, hold=30.0)


def logit(p):
    return np.log(p) - np.log1p(-np.asarray(p))


def found(series, *, episodes=(), conflicts=(), names=("A", "B"), local=("1", "", "3c0001", "4"), biases=None):
    """Four local tracks, 0 and 1 of A, 2 and 3 of B; 0 and 2 are track 7, 1 and 3 are alone.

    `series` gives (a, b, times after T0, probabilities) of each pair.
    """
    pair = np.concatenate([np.full(len(t), k) for k, (_, _, t, _) in enumerate(series)] or [np.zeros(0)]).astype(int)
    time = np.concatenate([T0 + np.asarray(t, float) for _, _, t, _ in series] or [np.zeros(0)])
    llr = np.concatenate([logit(p) - logit(RULE.prior) for *_, p in series] or [np.zeros(0)])
    ends = np.array([(a, b) for a, b, _, _ in series], int).reshape(-1, 2)
    e = [np.array(x) for x in zip(*episodes, strict=True)] or [np.zeros(0, int)] * 2 + [np.zeros(0)] * 3
    e[2:4] = [T0 + x for x in e[2:4]]
    start, end = T0 + np.zeros(4), T0 + np.full(4, 150.0)
    s = Segments(np.arange(4), start, end, np.array([7, 9, 7, 11]), np.array([1.0, 1.0, 0.8, 1.0]), time_known=start)
    return SystemsFound(
        names=names,
        titles=names,
        system=np.array([0, 0, 1, 1]),
        local_id=local,
        address=np.array([-1, 0x4B1617, 0x3C0001, -1]),
        segments=s,
        decisions=Decisions(Episodes(*e, since=np.full(len(e[0]), -np.inf), until=e[3]), tuple(conflicts)),
        evidence=Evidence(ends, pair, time, llr),
        rule=RULE,
        biases=biases or {"reference": "A", "systems": {}},
    )


def test_matrix_counts_objects_and_tracks():
    a, b = system_rows(found([]))
    assert (a.common, a.identified, a.alone, a.reference) == ((2, 1), 1, 1, True)
    assert (b.common, b.identified, b.alone, b.reference) == ((1, 2), 1, 1, False)


def test_biases_are_written_to_the_second_figure_of_their_deviation():
    known = {"azimuth_deg": {"value": -0.5079, "sd": 0.004343}, "east_m": {"value": 16.74, "sd": 2.04}}
    table = {"relative_to": "A", "common_objects": 7, "biases": known, "not_estimated": {"range": "not separable"}}
    (block,) = bias_blocks({"systems": {"B": table}})
    assert block.rows == (
        ("position, east", "16.7 ± 2.0 m", ""),
        ("azimuth", "\u22120.5079 ± 0.0043 °", ""),
        ("range", "–", "not separable"),
    )


def test_thinned_steps_stay_within_their_bound(rng):
    """The steps drawn, a value held until the next, differ from the evidence by 0.01 at most."""
    t = np.cumsum(rng.uniform(1.0, 5.0, 3000))
    p = 1.0 / (1.0 + np.exp(-np.clip(np.cumsum(0.2 * rng.normal(size=3000)), -8.0, 8.0)))
    p[1000:] = np.round(p[1000:], 1).clip(1e-4, 1 - 1e-4)
    declared = [(0, 2, 0.0, 9.0, 0.999)]
    (quiet,) = thinned_series(found([(0, 2, t[1000:1400], p[1000:1400])], episodes=declared))
    assert len(quiet.time) < 200
    at = np.searchsorted(quiet.time, T0 + t[1000:1400], side="right") - 1
    assert np.abs(quiet.p[at] - p[1000:1400]).max() <= 0.01 + 1e-9
    (lively,) = thinned_series(found([(0, 2, t, p)], episodes=declared))
    assert 20 < len(lively.time) <= pairs.MAX_POINTS
    at = np.searchsorted(lively.time, T0 + t, side="right") - 1
    assert np.abs(lively.p[at] - p).max() <= 0.16  # 0.01 doubled as often as it takes
    assert lively.time[[0, -1]].tolist() == (T0 + t[[0, -1]]).tolist()


def test_series_break_where_nothing_is_known():
    (x,) = thinned_series(found([(0, 2, [0.0, 10.0, 100.0], [0.2, 0.9, 0.9])]))
    assert (x.time - T0).tolist() == [0.0, 10.0, 40.0, 100.0]
    np.testing.assert_allclose(x.p, [0.2, 0.9, np.nan, 0.9])
    assert step_path(x, (T0, T0 + 120.0)) == "M0.0 20.8H20.0V2.6H80.0M200.0 2.6"


def test_pairs_declared_and_in_conflict_come_before_probable_ones(monkeypatch):
    flat = [(0, 3, [0.0, 9.0], [0.7, 0.7]), (1, 2, [0.0, 9.0], [0.3, 0.4]), (1, 3, [0.0, 9.0], [0.1, 0.1])]
    whole = found(
        [*flat, (0, 2, [0.0, 9.0], [0.2, 0.2])],
        episodes=[(0, 2, 0.0, 9.0, 0.999)],
        conflicts=[Conflict("places", 1, 3, T0, T0 + 8.0)],
    )
    assert [x.pair for x in thinned_series(whole)] == [3, 2, 0]  # the second was never probable
    monkeypatch.setattr(pairs, "MAX_PAIRS", 2)
    section, drawn = systems_section(whole, {7: 0}, (T0, T0 + 100.0))
    assert (section.held, section.probable) == (2, 3)
    assert column(drawn["systems"]["pairs"]["a"]).tolist() == [0, 1]
    monkeypatch.setattr(pairs, "MAX_TOTAL", 3)
    assert [x.pair for x in thinned_series(whole)] == [3]


def test_pairs_undecided_longest_come_first():
    """A value counts until the next one, or for `hold` at most."""
    whole = found(
        [(0, 3, [0.0, 10.0, 100.0], [0.995, 0.6, 0.999]), (0, 2, [0.0, 5.0, 50.0], [0.999, 0.5, 0.001])],
        episodes=[(0, 2, 0.0, 6.0, 0.9), (0, 2, 20.0, 38.0, 0.95)],
    )
    np.testing.assert_allclose(undecided(whole), [30.0, 30.0])
    whole = found([(0, 2, [0.0, 5.0], [0.5, 0.999]), (0, 3, [0.0, 8.0], [0.5, 0.999])], episodes=[(0, 2, 0, 6, 0.9)])
    first, second = pair_rows(whole, thinned_series(whole), (T0, T0 + 10.0))
    assert (first.a.name, first.b.name, first.undecided, first.tracks) == ("1", "4", 8.0, (7, 11))
    assert np.isnan(first.probability)
    assert (second.b.name, second.together, second.probability, second.tracks) == ("3c0001", 6.0, 0.9, (7,))


def test_conflicts_are_capped_and_the_page_says_so(tmp_path):
    many = [Conflict("rival", 0, 3, T0 + k, T0 + 2 * k) for k in range(MAX_CONFLICTS + 5)]
    whole = found([(0, 3, [0.0, 9.0], [0.7, 0.7])], conflicts=many)
    rows = conflict_rows(whole)
    lasting = [c.time_to - c.time_from for c in rows]
    assert lasting == sorted(lasting, reverse=True) and lasting[0] == MAX_CONFLICTS + 4
    assert rows[0].tracks == (7, 11)
    page = render(tmp_path, **scene(), systems=whole)
    assert "5 shorter ones are not listed" in page.text
    assert "1 pair of tracks look like one object" in page.text


def test_names_from_files_stay_text_and_one_system_has_no_section(tmp_path):
    conflict = Conflict("addresses", 1, 2, T0, T0 + 60.0)
    biases = {EVIL: {"relative_to": EVIL, "common_objects": 1, "biases": {}, "not_estimated": {EVIL: EVIL}}}
    whole = found(
        [(1, 2, [0.0, 9.0], [0.7, 0.7])],
        conflicts=[conflict],
        names=(EVIL, "B"),
        local=(EVIL, EVIL, EVIL, EVIL),
        biases={"reference": EVIL, "systems": biases},
    )
    page = render(tmp_path, **scene(), systems=whole)
    assert len(page.scripts) == 2
    assert "two by their addresses" in page.text
    assert page.data["systems"]["local"][0] == [0, EVIL]
    alone = render(tmp_path, **scene())
    assert "systems" not in alone.data
    assert 'id="systems"' not in alone.text and '<th data-sort="t">Systems' not in alone.text


def test_configured_names_are_what_people_read(tmp_path):
    """The designation stands once, beside the name in the header; several sources of one system are one system."""
    parts = scene()
    biases = {"B": {"relative_to": "A", "common_objects": 1, "biases": {}, "not_estimated": {}}}
    whole = replace(
        found([(0, 2, [0.0], [0.7])], biases={"reference": "A", "systems": biases}), titles=("Airport", "Hill")
    )
    page = render(tmp_path, **parts, systems=whole, names={"CAT048:20/129": "Barcelona"})
    assert page.data["sites"][0]["name"] == "Barcelona" and page.data["plots"]["sources"] == ["Barcelona"]
    assert page.data["systems"]["names"] == ["Airport", "Hill"]
    assert page.text.count("CAT048:20/129") == 1 and "Barcelona (CAT048:20/129)</p>" in page.text
    assert "Airport is right by definition" in page.text and "<small>against Airport, " in page.text
    assert "<dt>Systems</dt><dd>2 <small>1 source<" in page.text
    boats = Plots.build(0, (Source(System(None, None, None, "eo")), Source(System(None, None, None, "ir"))), (), {})
    page = render(tmp_path, **(parts | {"plots": boats}))
    assert " · eo · ir</p>" in page.text and "<dt>Systems</dt><dd>1 <small>2 sources" in page.text


def one_track(name, own):
    """A system with one track, of measurements or another centre's."""
    return SystemNames(name, own, np.array([1]), ("",), np.array([-1]), np.array([T0 + 1.0]))


def test_objects_of_other_centres_alone_are_not_counted():
    """As in identifications.parquet: two centres agree on one object of which no measurement is there."""
    systems = [one_track("radar", True), one_track("centre", False), one_track("other centre", False)]
    begin = T0 + np.zeros(3)
    lives = Segments(np.arange(3), begin, begin + 1.0, np.array([1, 2, 2]), np.ones(3), begin)
    nobody = Episodes(*[np.zeros(0, int)] * 2, *[np.zeros(0)] * 5)
    how = [Registered(s.name, "", None) for s in systems]
    whole = Identified(systems, how, lives, (), (), Decisions(nobody, ()), join_evidence([]), {})
    single = Identified(systems[:1], how[:1], lives, (), (), whole.decisions, whole.evidence, {})
    rows = system_rows(systems_found(whole, SystemsSettings(), {"radar": "R"}))
    assert [r.common for r in rows] == [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
    assert [r.identified for r in rows] == [0, 0, 0]
    assert systems_found(whole, SystemsSettings(), {"radar": "R"}).titles == ("R", "centre", "other centre")
    assert systems_found(single, SystemsSettings(), {}) is None


@pytest.fixture(scope="module")
def output(tmp_path_factory):
    """Six aircraft seen by two systems, the second 40 m off; one sends another address to it. One seen by the first."""
    folder = tmp_path_factory.mktemp("systems")
    rng = np.random.default_rng(3)
    for name, offset in (("near", 0.0), ("far", 40.0)):
        rows = []
        for k in range(7 if name == "near" else 6):
            for t in np.arange(rng.uniform(0.0, 2.0), 160.0, 2.0):
                x, y = 6e3 * k + offset + 8.0 * rng.normal(), 150.0 * (-1) ** k * t + 8.0 * rng.normal()
                code = "4CAAAA" if (name, k) == ("far", 5) else f"3C000{k}"
                rows.append({"time": T0 + t, "source": name, "icao24": code, "x_m": x, "y_m": y, "altitude_m": 0.0})
        rows.sort(key=lambda row: row["time"])
        with (folder / f"{name}.csv").open("w", newline="") as file:
            table = csv.DictWriter(file, list(rows[0]))
            table.writeheader()
            table.writerows(rows)
    site = "period = 2.0\nlatitude = 48.0\nlongitude = 11.0\nheight = 0.0\nsigma_xy = 8.0\n"
    text = '[systems]\nreference = "near"\n'
    text += "".join(f'[[sensor]]\nname = "{n}"\nsystem = "{n}"\n{site}' for n in ("near", "far"))
    (folder / "c.toml").write_text(text)
    track_files([folder / "near.csv", folder / "far.csv"], folder / "out", folder / "c.toml")
    return folder / "out"


def rows_of(page, name):
    """Cells of a table of the page's section as text."""
    table = re.search(rf'<table class="{name}">(.*?)</table>', page.text, re.S)[1]
    cells = [re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row, re.S) for row in re.findall(r"<tr.*?</tr>", table, re.S)]
    return [[html.unescape(" ".join(re.sub(r"<[^>]*>", "", c).split())) for c in row] for row in cells]


def test_the_page_says_what_the_tables_say(output: Path):
    page = Page((output / "report.html").read_text(encoding="utf-8"))
    found = pq.read_table(output / "identifications.parquet")
    tracks, systems = found["track_id"].to_numpy(), np.array(found["system"].to_pylist())
    both = np.intersect1d(tracks[systems == "near"], tracks[systems == "far"])
    assert len(both) == 5
    _, *rows = rows_of(page, "matrix")
    summary = json.loads((output / "summary.json").read_text())["systems"]
    assert set(summary) == {"near", "far"}
    for row, name, at in zip(rows, summary, (1, 2), strict=True):
        own, shared = summary[name]["local_tracks"], summary[name]["identified_with_another_system"]
        assert row[at] == str(own) and row[3 - at] == str(len(both))
        assert row[3:] == [str(shared), str(own - shared)]
    east = json.loads((output / "biases.json").read_text())["systems"]["far"]["biases"]["east_m"]
    shown = re.search(r"position, east</td>\s*<td class=\"n\">([\d.]+) ± ([\d.]+) m", page.text)
    assert abs(float(shown[1]) - east["value"]) <= 0.05 and abs(float(shown[2]) - east["sd"]) <= 0.05
    assert abs(east["value"] - 40.0) < 4 * east["sd"] + 2.0
    conflicts = [line for line in json.loads((output / "summary.json").read_text())["problems"] if "conflict" in line]
    listed = re.search(r"<h3>Identity conflicts</h3>.*?</table>", page.text, re.S)[0]
    assert len(conflicts) >= 1 and listed.count("two by their addresses</td>") >= 1


def test_the_script_gets_the_members_of_every_track(output: Path):
    page = Page((output / "report.html").read_text(encoding="utf-8"))
    rows = pq.read_table(output / "identifications.parquet").sort_by("track_id").to_pylist()
    found = [row for row in rows if row["merged_into"] is None]  # the others announce numbers given up
    assert 0 < len(found) < len(rows)
    drawn = page.data["systems"]
    local = [drawn["local"][k] for k in column(drawn["members"]["local"])]
    start = column(drawn["members"]["from"])
    told = {
        (page.data["tracks"][k]["id"], drawn["names"][s], name, round(float(t)))
        for k, (s, name), t in zip(column(drawn["members"]["track"]), local, start, strict=True)
    }
    t0 = page.data["t0"]
    assert told == {(row["track_id"], row["system"], row["local_id"], round(row["time_from"] - t0)) for row in found}
    of = {row["track_id"]: set() for row in found}
    for row in found:
        of[row["track_id"]].add(drawn["names"].index(row["system"]) + 1)
    table = re.search(r'<table class="sortable" id="list">(.*?)</table>', page.text, re.S)[1]
    for row in re.findall(r"<tr data-track.*?</tr>", table, re.S):
        chips = {int(n) for n in re.findall(r'class="chip"[^>]*>(\d+)<', row)}
        assert chips == of[int(re.search(r'data-v="(\d+)"', row)[1])]


def test_the_series_are_those_of_the_pairs(output: Path):
    drawn = Page((output / "report.html").read_text(encoding="utf-8")).data["systems"]
    first, p = column(drawn["pairs"]["first"]), column(drawn["pairs"]["p"])
    ends = {
        tuple(sorted((drawn["local"][a][1], drawn["local"][b][1]))): p[first[j] : first[j + 1]]
        for j, (a, b) in enumerate(zip(column(drawn["pairs"]["a"]), column(drawn["pairs"]["b"]), strict=True))
    }
    for pair in (("3C0000", "3C0000"), ("3C0001", "3C0001")):
        assert ends[pair][-1] == 250  # 1 in steps of 0.004
    assert ("3C0005", "4CAAAA") in ends  # by positions one object, declared never


def test_an_empty_run_of_several_systems_has_a_page(tmp_path):
    whole = found([])
    page = render(tmp_path, **{**scene(), "tracks": scene()["tracks"].slice(0, 0)}, systems=whole)
    assert "None: all identities agree" in page.text
    assert "Pairs of local tracks" not in page.text
