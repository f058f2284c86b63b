"""Several systems: what was known at a time does not change when the recording goes on."""

import numpy as np
import pytest
from engine_scenes import radars_toml, scene

from saltus.config import load_config
from saltus.engine import Session

SLICE = 4.0  # s: longest that reports wait for others


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("config") / "radars.toml"
    path.write_text(radars_toml())
    return load_config(path)


def finished(config, plots):
    session = Session.open(config)
    session.feed(plots)
    return session.finish()


def known_before(table, time, *, without=()):
    names = [name for name in table.column_names if name not in without]
    keep = np.flatnonzero(table["time_known"].to_numpy() < time)
    return table.select(names).take(keep).to_pylist()


@pytest.mark.parametrize("cut", [150.0, 200.0])
def test_what_was_known_at_a_time_stays(config, cut):
    plots = scene(2, seconds=300.0)
    whole, part = finished(config, plots), finished(config, plots.take(plots.time <= cut))
    linked = [row for row in whole.identifications.to_pylist() if row["merged_into"] is not None]
    assert linked and any(row["time_known"] < cut for row in linked)  # there are decisions, or nothing is shown
    early, then = known_before(whole.tracks, cut), known_before(part.tracks, cut)
    assert len(early) > 300
    assert [row for row in then if row in early] == early
    assert all(row["time"] > cut - SLICE for row in then if row not in early)  # the last slice goes on
    decided = [known_before(r.identifications, cut, without=["time_to"]) for r in (whole, part)]
    assert len(decided[0]) > 15 and decided[0] == decided[1]
    series = [r.biases["systems"]["CAT048:1/2"]["series"] for r in (whole, part)]
    assert series[1] and series[1] == [s for s in series[0] if s["time"] <= series[1][-1]["time"]]
