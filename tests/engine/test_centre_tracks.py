"""Sessions with another centre's tracks, and the system that is told to be right."""

import numpy as np
import pyarrow.compute as pc
import pytest
from engine_scenes import centre, radars_toml, scene

from saltus.config import load_config
from saltus.engine import Session
from saltus.errors import ModelError

SECONDS = 260.0


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("config") / "radars.toml"
    path.write_text(radars_toml())
    return path


def pieces(plots, tracks, cuts):
    """Reports, and the tracks that came with them: up to the time of the last report, in the end all."""
    low = -np.inf
    for begin, end in zip([0, *cuts], [*cuts, len(plots)], strict=True):
        high = np.inf if end == len(plots) else float(plots.time[end - 1])
        yield (
            plots.take(slice(begin, end)),
            tracks.filter(pc.and_(pc.greater(tracks["time"], low), pc.less_equal(tracks["time"], high))),
        )
        low = high


def tables(result):
    return [result.tracks, result.assignments, result.identifications]


def test_the_tracks_of_a_centre_are_found_to_be_ours_in_pieces_and_across_states(config, rng, tmp_path):
    plots, tracks = scene(2, seconds=SECONDS), centre(seconds=SECONDS)
    session = Session.open(config)
    session.feed(plots, tracks)
    whole = session.finish()
    found = [row for row in whole.identifications.to_pylist() if row["system"] == "CAT062:1/9"]
    ours = set(whole.tracks["track_id"].to_pylist())
    assert {row["track_id"] for row in found} <= ours  # a track of theirs alone is not published
    assert len({row["local_id"] for row in found}) >= 6  # of eight
    cuts = np.sort(rng.choice(np.arange(1, len(plots)), 6, replace=False)).tolist()
    session = Session.open(config)
    for reports, theirs in pieces(plots, tracks, cuts):
        session.feed(reports, theirs)
        session.save(tmp_path / "state")
        session = Session.restore(tmp_path / "state")
    result = session.finish()
    for a, b in zip(tables(whole), tables(result), strict=True):
        assert a.combine_chunks().equals(b.combine_chunks())
    assert whole.biases == result.biases


def test_the_centre_may_be_the_reference(config):
    known = load_config(config)
    systems = known.systems.__class__(reference="CAT062:1/9")
    session = Session.open(known.model_copy(update={"systems": systems}))
    session.feed(scene(2, seconds=SECONDS), centre(seconds=SECONDS))
    assert session.setup.order[0] == "CAT062:1/9"
    assert session.finish().biases["reference"] == "CAT062:1/9"


def test_a_reference_that_is_no_system_is_refused_when_the_setup_is_learnt(config):
    known = load_config(config)
    wrong = known.model_copy(update={"systems": known.systems.__class__(reference="nobody")})
    plots = scene(2, seconds=SECONDS)
    session = Session.open(wrong)
    session.feed(plots.take(plots.time < 30.0))  # within the first stretch nobody knows all sources
    with pytest.raises(ModelError, match=r"'nobody' names none of the systems in the inputs: CAT048:1/1, CAT048:1/2"):
        session.feed(plots.take(plots.time >= 30.0).take(slice(0, 400)))
    with pytest.raises(ModelError, match="nobody"):
        Session.open(wrong.model_copy()).feed(plots)
    right = known.model_copy(update={"systems": known.systems.__class__(reference="CAT048:1/2")})
    session = Session.open(right)
    session.feed(plots)
    assert session.settle().order == ("CAT048:1/2", "CAT048:1/1")
