"""Recordings are read a piece at a time: where they are cut changes nothing."""

from dataclasses import replace

import frames
import numpy as np
import pytest
from test_editions import OLD, cat021

from saltus.io import read, stream
from saltus.io.asterix import read_pieces
from saltus.records import Plots, Source, System


def equal(a, b):
    assert a.plots.sources == b.plots.sources
    assert a.plots.files == b.plots.files
    for name in Plots.column_names():
        np.testing.assert_array_equal(getattr(a.plots, name), getattr(b.plots, name), err_msg=name)
    period = [c.update_period for c in a.contents]
    assert period == pytest.approx([c.update_period for c in b.contents], nan_ok=True, rel=1e-3)
    assert [replace(c, update_period=0.0) for c in a.contents] == [replace(c, update_period=0.0) for c in b.contents]
    assert a.problems == b.problems


def block(category, body):
    data = bytes.fromhex(body)
    return bytes([category]) + (3 + len(data)).to_bytes(2, "big") + data


def cat001(k):
    """A plot of an old radar at 10340 + k s: 010, 020, 040, 141 modulo 512 s."""
    return block(1, f"e2 1481 20 0a00{(300 * k) % 65536:04x} {(100 + k) * 128 % 65536:04x}")


def cat002(k):
    """A north marker at 10340 + k s: 10240 is 20 times 512."""
    return block(2, f"d0 1481 01 {(10340 + k) * 128:06x}")


RECORDINGS = {
    "radar": b"".join(
        frames.NORTH.replace(bytes.fromhex("003200"), (12800 + 512 * k).to_bytes(3, "big"))
        + b"".join(frames.plot(tod=100 + 4 * k + 0.1 * j, rho=2560 + k, theta=600 * j) for j in range(30))
        for k in range(60)
    ),
    "midnight": b"".join(frames.plot(tod=(86380 + 0.5 * k) % 86400, theta=(900 * k) % 65536) for k in range(400)),
}


@pytest.mark.parametrize("name", RECORDINGS)
@pytest.mark.parametrize("size", [500, 4096, 20_000])
def test_pieces_of_any_size_give_the_same(tmp_path, monkeypatch, name, size):
    path = tmp_path / "a.ast"
    path.write_bytes(RECORDINGS[name])
    whole = read([path])
    monkeypatch.setattr(stream, "PIECE", size)
    equal(read([path]), whole)
    assert whole.plots.record.tolist() == list(range(len(whole.plots)))


def test_service_messages_complete_times_of_later_pieces(tmp_path, monkeypatch):
    path = tmp_path / "a.ast"
    path.write_bytes(cat002(0) + b"".join(cat001(k) for k in range(200)))
    whole = read([path])
    assert whole.plots.time.tolist() == [10340.0 + k for k in range(200)]
    monkeypatch.setattr(stream, "PIECE", 400)
    equal(read([path]), whole)


def test_an_edition_guessed_from_few_blocks_is_guessed_again(tmp_path, monkeypatch):
    """Reports of CAT021 that every edition lays out alike, and a megabyte later those that only 0.23 explains."""
    path = tmp_path / "a.ast"
    alike = block(21, "80 146b")  # the source alone
    between = b"".join(frames.plot(tod=100 + 0.001 * k) for k in range(40_000))
    path.write_bytes(alike * 3 + between + cat021(OLD) * 60)
    monkeypatch.setattr(stream, "PIECE", 1 << 16)
    *pieces, _ = read_pieces(path, date=None, editions={})
    assert {c.edition for part in pieces for c in part.contents if c.system.category == 21} == {"2.1", "0.23"}
    got = read([path])
    (line,) = (c for c in got.contents if c.system.category == 21)
    assert (line.edition, line.n_records) == ("0.23", 63)


def test_a_column_of_one_value_is_held_once():
    sources = (Source(System(48, 1, 1)),)
    columns = {"time": np.arange(1000.0), "range": np.full(1000, 5.0), "source": np.zeros(1000), "file": np.zeros(1000)}
    plots = Plots.build(1000, sources, ("a",), columns)
    held = {name: getattr(plots, name) for name in Plots.column_names()}
    assert {name for name, values in held.items() if values.strides != (0,)} == {"time"}
    both = Plots.concat([plots, plots.take(slice(0, 10))])
    assert both.range.strides == (0,) and both.range[0] == 5.0
    assert len(both) == 1010
    mixed = Plots.concat(
        [plots, Plots.build(2, sources, ("b",), {"time": [1, 2], "range": [6, 7], "source": [0, 0], "file": [0, 0]})]
    )
    assert mixed.range[-2:].tolist() == [6.0, 7.0]
    assert mixed.range[0] == 5.0
    assert np.isnan(mixed.latitude).all() and mixed.latitude.strides == (0,)
