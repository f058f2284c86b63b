"""Setups as files: what is learnt once starts another run at once; what does not fit is refused."""

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from engine_scenes import demo_start, radars_toml, scene

from saltus import Session
from saltus.cli import main
from saltus.config import load_config
from saltus.engine.saved import setup_toml
from saltus.errors import DataError, ModelError
from saltus.records import Kind, Plots, Source, System


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A setup learnt from two radars, as a file; what it was learnt from, and how."""
    folder = tmp_path_factory.mktemp("saved")
    config = folder / "sensors.toml"
    config.write_text("date = 2024-01-31\n[tracker]\nmax_speed = 350.0\n" + radars_toml())
    plots = scene(2)
    session = Session.open(config, hold=0.0)
    session.feed(plots.take(slice(0, 300)))
    path = folder / "setup.toml"
    path.write_text(setup_toml(session.settle(), ["simulated"]))
    return path, plots, config


def test_a_setup_read_back_is_the_setup(saved):
    path, plots, config = saved
    learnt = Session.open(config, hold=0.0)
    learnt.feed(plots.take(slice(0, 300)))
    a, b = learnt.settle(), Session.open(path).setup
    assert b.config == a.config.model_copy(update={"date": None})
    assert (a.time, a.plane, a.use_identity) == (b.time, b.plane, b.use_identity)
    for one, other in zip(a.sensors, b.sensors, strict=True):
        assert one.source == other.source and one.noise == other.noise and one.period == other.period
        assert str(one.estimate) == str(other.estimate)  # NaN included
        for name in ("even", "cell", "near", "known", "layer", "count"):
            assert np.array_equal(getattr(one.background, name), getattr(other.background, name)), name


def test_a_saved_setup_starts_at_once(saved):
    path, plots, config = saved
    learnt, at_once = Session.open(config, hold=0.0), Session.open(path, hold=0.0)
    first = plots.take(slice(0, 150))
    assert len(learnt.feed(first).assignments) == 0 < len(at_once.feed(first).assignments)


def test_what_the_configuration_says_goes_before_what_was_learnt(saved, tmp_path):
    path, _, _ = saved
    learnt = Session.open(path).setup.sensors[0]
    text = re.sub(r"(\[\[sensor\]\]\n)", r"\1sigma_range = 77.0\nperiod = 9.5\n", path.read_text(), count=1)
    (tmp_path / "edited.toml").write_text(text)
    sensor = Session.open(tmp_path / "edited.toml").setup.sensors[0]
    assert sensor.noise.range == 77.0 and sensor.period == sensor.wait == 9.5
    assert sensor.noise.azimuth == learnt.noise.azimuth


def test_other_sources_and_another_place_are_refused(saved):
    path, plots, _ = saved
    strangers = replace(plots, sources=tuple(Source(System(48, 7, k), s.traits) for k, s in enumerate(plots.sources)))
    strangers = replace(strangers, kind=np.full(len(plots), Kind.GEODETIC, np.int8))
    strangers = replace(strangers, latitude=np.full(len(plots), 0.8), longitude=np.full(len(plots), 0.2))
    with pytest.raises(DataError, match="other sources: of CAT048:1/1, CAT048:1/2; the reports are of CAT048:7/0"):
        _tracked(path, strangers)
    far = replace(strangers, sources=plots.sources, longitude=np.full(len(plots), -2.9))
    with pytest.raises(DataError, match=r"another place, \d+ km from the reports. Learn one from these reports with"):
        _tracked(path, far)


@pytest.mark.parametrize("chunk", [1, 5, 100])
def test_the_pieces_do_not_decide_whether_a_setup_fits(saved, chunk):
    """The first report is of a source that the setup does not know, the others are not; or all are."""
    path, plots, _ = saved
    sources = (*plots.sources, Source(System(48, 9, 9), plots.sources[0].traits))
    some, all_ = plots.source.copy(), np.full(len(plots), 2, plots.source.dtype)
    some[0] = 2
    place = {"kind": np.full(len(plots), Kind.GEODETIC, np.int8), "latitude": np.full(len(plots), 0.84)}
    place["longitude"] = np.full(len(plots), 0.19)
    for source, fits in ((some, True), (all_, False)):
        mixed = replace(plots, sources=sources, source=source, **place).take(slice(0, 100))
        session = Session.open(path, hold=0.0)
        for begin in range(0, 100, chunk):
            session.feed(mixed.take(slice(begin, begin + chunk)))
        if fits:
            assert len(session.finish().assignments) == 100
        else:
            with pytest.raises(DataError, match="the reports are of CAT048:9/9"):
                session.finish()


def test_a_session_saved_before_its_first_report_still_refuses(saved, tmp_path):
    path, _, _ = saved
    Session.open(path).save(tmp_path)
    session = Session.restore(tmp_path)
    alien = Plots.build(1, (Source(System(None, None, None, "boat")),), ("x",), _position(60.0, 5.0))
    session.feed(alien)
    session.save(tmp_path)
    with pytest.raises(DataError, match="the reports are of boat"):
        Session.restore(tmp_path).finish()


def _tracked(path, plots):
    session = Session.open(path)
    session.feed(plots)
    return session.finish()


def _position(latitude, longitude):
    place = {"latitude": np.radians([latitude]), "longitude": np.radians([longitude])}
    return {"time": [0.0], "source": [0], "file": [0], "record": [0], "kind": [Kind.GEODETIC], **place}


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("version = 1", "version = 2", "version = 2"),
        ('kind = "polar"', 'kind = "sonar"', "sensor.1.kind = 'sonar'"),
        ("period = ", "period = -", "period = -"),
        (r"plane = \[\s*[0-9.]+", "plane = [ 99.0", "no such centre of a plane"),
        ("even = [0-9.e-]+", "even = nan", "even = nan"),
        ('cell = "....', 'cell = "????', "background.cell"),
        ('count = ".*"', 'count = ""', "background.count"),
        ('near = "(.*)"\nknown = "(.*)"', 'near = "\\2"\nknown = ""', "background"),
        ("range = [0-9.]+\nazimuth", "range = 0.0\nazimuth", "range = 0.0 is no standard deviation"),
        ("heard = true", 'heard = "perhaps"', "heard = 'perhaps'"),
        ("wait = ", "weight = ", "weight"),
    ],
)
def test_what_is_no_setup_is_refused_by_file_and_key(saved, tmp_path, old, new, said):
    text = saved[0].read_text()
    changed = re.sub(old, new, text, count=1)
    assert changed != text
    (tmp_path / "bad.toml").write_text(changed)
    with pytest.raises(ModelError, match=re.escape(said)) as caught:
        Session.open(tmp_path / "bad.toml")
    assert str(tmp_path / "bad.toml") in str(caught.value) and "saltus setup" in str(caught.value)


def test_learnt_is_a_table(tmp_path):
    (tmp_path / "a.toml").write_text("learnt = 3\n")
    with pytest.raises(ModelError, match=r"learnt = 3: saltus setup writes the table \[learnt\]"):
        load_config(tmp_path / "a.toml")


def test_the_program_learns_a_setup_and_tracks_with_it(tmp_path):
    """What `track` learns by itself, `setup` writes: the same tables to the byte."""
    inputs, config = demo_start(tmp_path, 5)

    def run(*arguments):
        result = CliRunner().invoke(main, [*arguments])
        assert result.exit_code == 0, result.output
        return result.output

    file = str(tmp_path / "setup.toml")
    said = run("setup", *inputs, "--config", str(config), "-o", file)
    assert "sigma_range_m" in said and "update period" in said and file in said
    assert "date" not in tomllib.loads(Path(file).read_text())
    date = ["--date", str(load_config(config).date)]
    run("track", *inputs, "--config", str(config), "-o", str(tmp_path / "a"), "--no-report")
    run("track", *inputs, "--config", file, *date, "-o", str(tmp_path / "b"), "--no-report")
    for name in ("tracks.parquet", "assignments.parquet", "identifications.parquet"):
        assert pq.read_table(tmp_path / "a" / name).equals(pq.read_table(tmp_path / "b" / name)), name
