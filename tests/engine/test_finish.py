"""What is made after the end does not depend on where the journal is cut, and needs little memory."""

import numpy as np
import pyarrow as pa
import pytest
from engine_scenes import centre, radars_toml, scene

from saltus.config import load_config
from saltus.engine import Session, journal, result
from saltus.engine.spool import InOrder, Place, Spool
from saltus.tracks.local import Misfit
from saltus.tracks.rows import join_rows

TABLES = ("tracks", "assignments", "identifications", "gates")


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("config") / "radars.toml"
    path.write_text(radars_toml())
    return load_config(path)


@pytest.mark.parametrize("systems", [1, 2])
@pytest.mark.parametrize("foreign", [False, True])
def test_the_same_tables_from_segments_of_any_length(config, monkeypatch, systems, foreign):
    plots = scene(2, seconds=200.0)
    plots = plots if systems == 2 else plots.take(plots.source == 0)

    def finished():
        session = Session.open(config)
        session.feed(plots, centre(2, seconds=200.0) if foreign else None)
        return session.finish()

    whole = finished()
    monkeypatch.setattr(journal, "_ROWS", 97)
    pieces = finished()
    for name in TABLES:
        assert getattr(pieces, name).equals(getattr(whole, name)), name
    assert len(whole.tracks) > 300 and len(np.unique(whole.tracks["track_id"])) > 5
    assert pieces.biases == whole.biases and pieces.span == whole.span
    assert pieces.outcome._replace(stored=None, placed=None, tracked=None) == whole.outcome._replace(
        stored=None, placed=None, tracked=None
    )
    np.testing.assert_array_equal(pieces.outcome.tracked, whole.outcome.tracked)
    np.testing.assert_allclose(pieces.figures.nis, whole.figures.nis, rtol=1e-12)
    assert pieces.figures[0:2] == whole.figures[0:2]


def test_batches_are_the_table(config, monkeypatch):
    monkeypatch.setattr(result, "_AT_ONCE", 100)
    session = Session.open(config)
    session.feed(scene(2))
    made = session.finish()
    batches = list(made.stored["tracks"].batches())
    assert [len(b) for b in batches[:-1]] == [100] * (len(made.tracks) // 100)
    assert np.concatenate([b["time"].to_numpy() for b in batches]).tolist() == made.tracks["time"].to_pylist()


def test_misfit_goes_on_where_it_was(rng):
    """Tracks that come and go: the same factors in pieces as from all reports of a track at once."""
    n = 60
    track, time = np.repeat([3, 5, 8], n), np.tile(np.arange(n) * 4.0, 3)
    z, R = rng.normal(0.0, 60.0, (3 * n, 2)), np.tile(400.0 * np.eye(2), (3 * n, 1, 1))
    whole = Misfit().factor(track, time, z, R)
    assert whole.max() > 2.0 and (whole[[0, 1, n, n + 1]] == 1.0).all()
    pieces, misfit = np.zeros(3 * n), Misfit()
    for low, high in [(0.0, 0.0), (0.0, 1.0), (1.0, 30.0), (30.0, 31.0), (31.0, 36.0), (36.0, 500.0)]:
        at = np.flatnonzero((time >= low) & (time < high) & ((track != 5) | (time > 20.0)))
        pieces[at] = misfit.factor(track[at], time[at], z[at], R[at])
    late = (track == 5) & (time > 20.0)
    np.testing.assert_array_equal(pieces[track != 5], whole[track != 5])
    np.testing.assert_array_equal(pieces[late], Misfit().factor(track[late], time[late], z[late], R[late]))


def rows_known(known, track):
    """Rows of which nothing but the order counts."""
    nothing = join_rows([])
    n = len(known)
    filled = {name: np.zeros((n, *getattr(nothing, name).shape[1:])) for name in nothing._fields if name != "moments"}
    moments = nothing.moments._make(np.zeros((n, *column.shape[1:])) for column in nothing.moments)
    return nothing._replace(moments=moments, **filled)._replace(
        time_known=np.array(known, float), track_id=np.array(track)
    )


def test_rows_wait_for_earlier_ones():
    order = InOrder(3)
    given = [([5.0, 1.0, 2.0], [1, 2, 3], 2.0), ([2.0, 3.0], [1, 4], 4.0), ([9.0, 4.0], [5, 6], np.inf)]
    batches = [b for known, track, before in given for b in order.add(rows_known(known, track), before)]
    batches += order.end()
    assert [b.time_known.tolist() for b in batches] == [[1.0, 2.0, 2.0], [3.0, 4.0, 5.0], [9.0]]
    assert [b.track_id.tolist() for b in batches] == [[2, 1, 3], [4, 6, 1], [5]]


def test_a_stored_table_lives_as_long_as_it_is_used():
    place = Place()
    folder, spool = place.path, Spool(place, "a")
    spool.write(pa.table({"x": np.arange(3)}))
    stored = spool.stored()
    del place, spool
    assert folder.exists()
    table = stored.table()
    del stored
    assert not folder.exists()
    assert table["x"].to_pylist() == [0, 1, 2]
