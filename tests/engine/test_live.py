"""The running picture of several systems: numbers as they are known, and what announces that they change."""

from itertools import pairwise

import numpy as np
import pytest
from engine_scenes import radars_toml, scene

from saltus.engine import Session

CUTS = (150, 500, 777, 1000)


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("config") / "radars.toml"
    path.write_text(radars_toml())
    return path


def published(session, plots, cuts, folder=None):
    """Feed in pieces, saved and taken up again after each where there is a folder; return what was told, the result."""
    told = []
    for begin, end in zip([0, *cuts], [*cuts, len(plots)], strict=True):
        told.append(session.feed(plots.take(slice(begin, end))))
        if folder is not None:
            session.save(folder)
            session = Session.restore(folder)
    return told, session.finish()


def announced(told):
    return [row for part in told for row in part.identifications.to_pylist()]


def final(merged, number):
    while number in merged:
        number = merged[number]
    return number


@pytest.fixture(scope="module")
def whole(config):
    plots = scene(2, seconds=300.0)
    return plots, *published(Session.open(config), plots, range(100, len(plots), 100))


def test_every_number_leads_to_the_one_that_holds_in_the_end(whole):
    """By what was announced: a number given up names the one that took its place, and so on."""
    plots, told, result = whole
    rows = announced(told)
    assert all(a["time_known"] <= b["time_known"] for a, b in pairwise(rows))
    merged = {row["track_id"]: row["merged_into"] for row in rows if row["merged_into"] is not None}
    assert len(merged) >= 16  # eight aircraft, seen by two radars
    said = {row["record"]: row["track_id"] for part in told for row in part.assignments.to_pylist()}
    end = dict(zip(result.assignments["record"].to_pylist(), result.assignments["track_id"].to_pylist(), strict=True))
    late = plots.time.max() - 30.0  # what is confirmed or decided afterwards, no look has seen
    known = [r for r in np.flatnonzero(plots.time < late).tolist() if end[r] is not None and said.get(r)]
    same = [final(merged, said[r]) == end[r] for r in known]
    assert len(same) > 800 and np.mean(same) > 0.98
    assert np.mean([said[r] == end[r] for r in known]) > 0.3  # most when they are published, once it is decided


def test_what_holds_is_announced_as_it_is_known_in_the_end(whole):
    _, told, result = whole
    names = ("track_id", "system", "local_id", "time_known", "merged_into")
    rows = {tuple(row[n] for n in names) for row in announced(told) if row["track_id"] < 10**12}
    last = max(row[3] for row in rows)
    after = [tuple(row[n] for n in names) for row in result.identifications.to_pylist() if row["time_known"] <= last]
    assert len(after) > 20
    assert sum(row in rows for row in after) >= 0.9 * len(after)  # local tracks' codes come in, too


def test_pieces_and_states_announce_the_same(whole, config, tmp_path):
    plots, told, _ = whole
    other, _ = published(Session.open(config), plots, CUTS)
    assert announced(other) == announced(told)
    saved, _ = published(Session.open(config), plots, CUTS, tmp_path / "state")
    assert announced(saved) == announced(told)


def test_one_system_announces_nothing(config):
    told, _ = published(Session.open(config), scene(1, seconds=150.0), [300])
    assert not announced(told)
