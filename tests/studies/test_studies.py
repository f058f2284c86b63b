"""Running a study: what is written, and that it is written whole or not at all."""

import json
import struct

import numpy as np
import pytest

from saltus import studies
from saltus.errors import ModelError
from saltus.studies import STUDIES, run_study
from saltus.studies.radar import run_radar


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("studies") / "radar"
    run_study("radar", folder, 4, 7)
    return folder


def test_a_study_writes_metrics_and_pictures(written):
    metrics = json.loads((written / "metrics.json").read_text())
    assert (metrics["study"], metrics["runs"], metrics["seed"]) == ("radar", 4, 7)
    figure = metrics["rmse"]["measurement"]["steady"]["x"]
    assert set(figure) == {"value", "standard_error", "low", "high"}
    pictures = sorted(p.name for p in written.iterdir() if p.suffix == ".png")
    assert len(pictures) == 6 and len(list(written.glob("[!.]*"))) == 7
    for name in pictures:
        head = (written / name).read_bytes()[:24]
        assert head[:8] == b"\x89PNG\r\n\x1a\n"
        assert struct.unpack(">I", head[16:20]) == (1200,)


def test_equal_seeds_give_equal_numbers(written, tmp_path):
    seen = []
    run_study("radar", tmp_path, 4, 7, progress=lambda done, total: seen.append((done, total)))
    assert (tmp_path / "metrics.json").read_bytes() == (written / "metrics.json").read_bytes()
    assert seen == [(4, 4)]
    assert not np.any(run_radar(4, 8).measurement == run_radar(4, 7).measurement)


def test_an_unknown_study_lists_the_known(tmp_path):
    with pytest.raises(ModelError, match=r"'sonar'; the studies are: .*radar"):
        run_study("sonar", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("runs", "seed"), [(1, 0), (4, -1)])
def test_numbers_out_of_range_are_refused(tmp_path, runs, seed):
    with pytest.raises(ModelError, match="runs >= 2"):
        run_study("radar", tmp_path / "out", runs, seed)


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_interrupted_study_leaves_nothing(tmp_path, monkeypatch, error):
    def fails(folder, runs, seed, progress):
        (folder / "half.png").write_bytes(b"half")
        raise error

    monkeypatch.setitem(studies.STUDIES, "radar", fails)
    with pytest.raises(error):
        run_study("radar", tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_number_that_is_none_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setitem(STUDIES, "radar", lambda folder, runs, seed, progress: {"rmse": np.nan})
    with pytest.raises(ValueError, match="JSON"):
        run_study("radar", tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
