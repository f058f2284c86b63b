"""What a run keeps of its reports: all of few, every so many-th of many, all of them counted."""

import numpy as np
import pytest

from saltus.config import Config
from saltus.records import REASONS, Kind, Plots, Recording, Source, System, Traits
from saltus.run import seen as module
from saltus.run.seen import Seen

SOURCES = tuple(Source(System(None, None, None, name), traits=Traits()) for name in ("a", "b"))


def piece(begin, n, **columns):
    time = np.arange(begin, begin + n, dtype=float)
    return Plots.build(n, SOURCES, ("f",), {"time": time, "record": time.astype(int), **columns})


@pytest.mark.parametrize("size", [1, 7, 10, 64, 1000])
def test_a_sample_is_every_so_many_th_whatever_the_pieces(monkeypatch, size):
    monkeypatch.setattr(module, "_DRAWN", 100)
    seen = Seen(Config())
    for begin in range(0, 1000, size):
        seen.add(
            Recording(piece(begin, min(size, 1000 - begin), kind=np.full(min(size, 1000 - begin), 3)), None, (), ())
        )
    plots, number = seen.sample()
    assert seen.n == 1000 and seen.every == 16
    assert number.tolist() == list(range(0, 1000, 16))
    assert plots.record.tolist() == number.tolist()
    assert plots.time.base is None  # nothing else is held


def test_reports_are_counted_by_reason_and_source():
    seen = Seen(Config())
    reason = np.array([0, 0, 0, REASONS.index("duplicate")], np.int8)
    kind = np.array([Kind.POLAR, Kind.GEODETIC, Kind.POLAR, Kind.GEODETIC], np.int8)
    plots = piece(0, 4, reason=reason, kind=kind, source=np.array([0, 1, 1, 1]))
    seen.add(Recording(plots, None, (), ("one", "two")))
    seen.add(Recording(piece(4, 0), None, (), ("two", "three")))
    counts = {name: int(n) for name, n in zip(REASONS, seen.reasons, strict=True) if n}
    assert counts == {"": 1, "site unknown": 2, "duplicate": 1}
    assert {system.name: n for system, n in seen.unplaced.items()} == {"a": 1, "b": 1}
    assert seen.usable and seen.problems == ("one", "two", "three")
