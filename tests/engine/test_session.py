"""Sessions: the same answer in pieces of any size, saved and restored at any moment; what they publish on the way."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from engine_scenes import radars_toml, scene

from saltus import Session
from saltus.config import load_config
from saltus.engine import Setup
from saltus.errors import DataError
from saltus.records import REASONS, Kind, Source, System, Traits


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("engine") / "sensors.toml"
    path.write_text(radars_toml())
    return path


def tables(result):
    return [result.tracks, result.assignments, result.identifications]


def equal(a, b):
    assert json.dumps(a.biases) == json.dumps(b.biases)
    for x, y in zip(tables(a), tables(b), strict=True):
        assert x.schema == y.schema
        assert x.combine_chunks().equals(y.combine_chunks())
        for name in x.column_names:  # NaN and the last bit included
            old, new = x[name].to_numpy(zero_copy_only=False), y[name].to_numpy(zero_copy_only=False)
            assert old.dtype.kind == "O" or old.tobytes() == new.tobytes()


def fed(config, plots, cuts=(), **options):
    session = Session.open(config, **options)
    edges = [0, *cuts, len(plots)]
    told = [session.feed(plots.take(slice(a, b))) for a, b in pairwise(edges)]
    return session.finish(), told


@pytest.mark.parametrize("radars", [1, 2])
def test_pieces_of_any_size_give_the_same_bytes(config, radars, rng):
    plots = scene(radars)
    whole, _ = fed(config, plots)
    assert len(whole.assignments) == len(plots) and len(whole.tracks) > 150
    for cuts in (
        range(1, len(plots), 7),
        range(100, len(plots), 100),
        np.sort(rng.choice(len(plots), 9, replace=False)),
    ):
        equal(whole, fed(config, plots, [int(c) for c in cuts])[0])


def test_reports_that_come_in_disorder_change_nothing(config, rng):
    """Each up to 1.5 s late, as the hold allows: the tracks are those of the reports in order."""
    plots = scene(2)
    shuffled = plots.take(np.argsort(plots.time + rng.uniform(0.0, 1.5, len(plots)), kind="stable"))
    whole, other = fed(config, plots)[0], fed(config, shuffled)[0]
    assert whole.tracks.combine_chunks().equals(other.tracks.combine_chunks())
    for column in ("track_id", "reason"):
        of = [r.assignments.sort_by("record")[column].to_pylist() for r in (whole, other)]
        assert of[0] == of[1]


@pytest.mark.parametrize("radars", [1, 2])
def test_a_session_saved_at_any_moment_goes_on(config, radars, rng, tmp_path):
    """At six moments, each time saved, forgotten and taken up by another one; before and after the first stretch."""
    plots = scene(radars)
    whole, _ = fed(config, plots)
    cuts = np.sort(rng.choice(len(plots), 6, replace=False)).tolist()
    session = Session.open(config)
    for begin, end in zip([0, *cuts], [*cuts, len(plots)], strict=True):
        session.feed(plots.take(slice(begin, end)))
        session.save(tmp_path / "state", {"at": end})
        lost = session
        session = Session.restore(tmp_path / "state")
        assert session.reports == end and session.notes == {"at": end}
        lost.feed(plots.take(slice(end, end + 100)))  # what happens to the other one afterwards is its own affair
    equal(whole, session.finish())


def test_what_is_published_on_the_way_is_what_is_known_in_the_end(config):
    plots = scene(1, seconds=160.0)
    result, told = fed(config, plots, range(60, len(plots), 60))
    assert not len(told[0].tracks) and not len(told[0].assignments)  # the setup is not learnt yet
    rows = {}
    for part in told:
        for row in part.tracks.to_pylist():
            rows[row["track_id"], row["time"], row["status"]] = row
    final = result.tracks.to_pylist()
    known = [row for row in final if row["time_known"] < told[-1].tracks["time_known"].to_numpy().min()]
    assert len(known) > 100
    assert all(rows[row["track_id"], row["time"], row["status"]] == row for row in known)
    order = [(row["time_known"], row["track_id"], row["time"]) for row in final]
    assert order == sorted(order)
    last = {}
    for part in told:
        last |= {row["record"]: row["track_id"] for row in part.assignments.to_pylist()}
    confirmed = {row["track_id"] for row in final}
    for row in result.assignments.to_pylist():
        if row["record"] in last:
            assert row["track_id"] == (last[row["record"]] if last[row["record"]] in confirmed else None)


def test_a_source_that_appears_later_begins_with_its_configuration(config):
    """The second radar reports from 70 s on: a version of the setup tells when, and its reports make tracks."""
    plots = scene(2, seconds=180.0)
    plots = plots.take((plots.source == 0) | (plots.time > 70.0))
    result, _ = fed(config, plots)
    estimate = result.setup.sensors[1].estimate  # told after the end, from all its tracks: 30 m and 1 mrad are true
    assert abs(estimate.range - 30.0) < 8.0 and abs(estimate.azimuth - 1e-3) < 3e-4
    versions = Session.open(config)
    versions.feed(plots)
    times = versions.health()["setups"]
    assert len(times) == 2 and 70.0 < times[1] < 75.0
    late = np.array(result.assignments["time"]) > 100.0
    of_second = plots.source == 1
    used = np.array(result.assignments["track_id"].is_valid())
    assert used[late & of_second].mean() > 0.6  # eight aircraft of nine in ten scans, beside three false plots
    equal(result, fed(config, plots, range(333, len(plots), 333))[0])


def test_a_setup_learnt_before_begins_at_once(config):
    """A session begun with another one's setup tracks the first reports as soon as their slice is complete."""
    plots = scene(1)
    learnt = Session.open(config)
    learnt.feed(plots)
    session = Session(learnt.setup)
    told = session.feed(plots.take(slice(0, 100)))
    assert len(told.tracks) > 0 and len(told.assignments) > 50
    session.feed(plots.take(slice(100, None)))
    equal(session.finish(), learnt.finish())


def test_every_report_has_a_reason_or_a_track(config):
    plots = scene(2)
    reason = plots.reason.copy()
    reason[5] = REASONS.index("duplicate")
    stranger = replace(
        plots, sources=(plots.sources[0], Source(System(48, 9, 9), Traits(rotating=True))), reason=reason
    )
    result, _ = fed(config, stranger)
    found = result.assignments
    assert found["reason"].to_pylist()[5] == "duplicate"
    why = np.array(found["reason"].to_pylist(), object)
    assert (why[(plots.source == 1) & (reason == 0)] == "site unknown").all()
    assert (found["track_id"].is_valid().to_numpy() ^ found["reason"].is_valid().to_numpy()).all()


def test_a_session_without_usable_reports_says_so(config):
    session = Session.open(config)
    with pytest.raises(DataError, match="no setup yet"):
        assert isinstance(session.setup, Setup)
    session.feed(scene(1).take(slice(0, 0)))
    with pytest.raises(DataError, match="no report can be tracked"):
        session.finish()


def test_a_damaged_journal_is_noticed_before_the_run_goes_on(config, tmp_path, monkeypatch):
    monkeypatch.setattr("saltus.engine.journal._ROWS", 200)
    session = Session.open(config, folder=tmp_path)
    session.feed(scene(2))
    session.save(tmp_path)
    segment = tmp_path / "plots-000000.arrow"
    whole = segment.read_bytes()
    changed = bytearray(whole)
    changed[len(whole) // 2] ^= 1
    for broken in (b"", whole[:500], bytes(changed), None):
        segment.write_bytes(broken) if broken is not None else segment.unlink()
        said = "was changed after it was sealed" if broken is not None else "cannot be read"
        with pytest.raises(DataError, match=rf"plots-000000\.arrow: the journal's segment {said}"):
            Session.restore(tmp_path)
    segment.write_bytes(whole)
    equal(session.finish(), Session.restore(tmp_path).finish())


def test_a_folder_of_another_session_is_cleared_first(config, tmp_path, monkeypatch):
    monkeypatch.setattr("saltus.engine.journal._ROWS", 200)
    first = Session.open(config)
    first.feed(scene(2))
    first.save(tmp_path)
    (tmp_path / "mine.txt").write_text("kept")
    second = Session.open(config)
    second.feed(scene(1).take(slice(0, 50)))
    second.save(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["checkpoint.json", "mine.txt", "state-000000.npz"]


def test_what_is_no_checkpoint_is_said(config, tmp_path):
    with pytest.raises(DataError, match="holds no checkpoint"):
        Session.restore(tmp_path)
    session = Session.open(load_config(config))
    session.feed(scene(1))
    session.save(tmp_path)
    pointer = tmp_path / "checkpoint.json"
    found = json.loads(pointer.read_text())
    pointer.write_text(json.dumps({**found, "format": 99}))
    with pytest.raises(DataError, match=r"format 99 .* Go on with the version that wrote it"):
        Session.restore(tmp_path)
    for broken in (json.dumps(found)[:-20], "[" * 100_000):
        pointer.write_text(broken)
        with pytest.raises(DataError, match="no readable checkpoint"):
            Session.restore(tmp_path)
    for state in ("../victim.npz", str(tmp_path / "victim"), "state-1.npz", None):
        pointer.write_text(json.dumps({**found, "state": state}))
        with pytest.raises(DataError, match="no checkpoint"):
            Session.restore(tmp_path)
        with pytest.raises(DataError, match="no checkpoint"):
            session.save(tmp_path)
    pointer.write_text(json.dumps(found))
    state = tmp_path / found["state"]
    whole = state.read_bytes()
    changed = bytearray(whole)
    changed[len(whole) // 2] ^= 0xFF
    for broken in (b"", b"PK", whole[:1000], whole[:-30], bytes(changed)):
        state.write_bytes(broken)
        with pytest.raises(DataError, match=r"the checkpoint there .* Begin anew"):
            Session.restore(tmp_path)
    state.write_bytes(whole)
    pointer.write_text(json.dumps({**found, "words": found["words"] | {"hold": 2.5}}))
    with pytest.raises(DataError, match=r"checkpoint\.json was changed after it was written"):
        Session.restore(tmp_path)
    for name in ("words", *found["words"]):
        less = json.loads(json.dumps(found))
        (less if name == "words" else less["words"]).pop(name)
        pointer.write_text(json.dumps(less))
        with pytest.raises(DataError, match="the checkpoint there cannot be read"):
            Session.restore(tmp_path)
    pointer.write_text(json.dumps(found))
    Session.restore(tmp_path)
    session.finish()
    with pytest.raises(DataError, match="has ended"):
        session.feed(scene(1))


def test_a_radar_that_tells_positions_alone_later_is_tracked_on(config):
    """Its faults were those of range and azimuth: a position without them is no reason to stop."""
    plots = scene(1, seconds=160.0)
    late = plots.time > 100.0
    east, north = plots.range * np.sin(plots.azimuth), plots.range * np.cos(plots.azimuth)
    kind = np.where(late, Kind.PLANE, plots.kind).astype(np.int8)
    mixed = replace(plots, kind=kind, x=np.where(late, east, np.nan), y=np.where(late, north, np.nan))
    for reports, part in ((mixed, late), (replace(mixed, kind=np.full(len(plots), Kind.PLANE, np.int8)), late)):
        found = fed(config, replace(reports, x=east, y=north))[0].assignments
        used = found["track_id"].is_valid().to_numpy()
        assert used[part].mean() > 0.6  # eight aircraft of nine in ten scans, beside three false plots


def test_a_radar_of_positions_that_appears_later_is_tracked(config):
    plots = scene(2, seconds=160.0)
    plots = plots.take((plots.source == 0) | (plots.time > 70.0))
    second = plots.source == 1
    kind = np.where(second, Kind.PLANE, plots.kind).astype(np.int8)
    east, north = plots.range * np.sin(plots.azimuth), plots.range * np.cos(plots.azimuth)
    found = fed(config, replace(plots, kind=kind, x=east, y=north))[0].assignments
    used = found["track_id"].is_valid().to_numpy()
    assert used[second & (plots.time > 100.0)].mean() > 0.6
