"""The compiled codec against its definition in Python: same records, faults, columns and bytes, whatever the input."""

import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from library import Draw, definitions

from saltus.asterix import codec, encode, walk
from saltus.asterix.codec import Want, decode, find_records
from saltus.asterix.layout import categories, editions, layout
from saltus.compiled import native_module

ALL = list(definitions())
pytestmark = pytest.mark.skipif(native_module() is None, reason="the compiled kernel is absent")


def both(monkeypatch, run):
    """What the compiled code makes of it, and what the definition makes of it."""
    mine = run()
    with monkeypatch.context() as patch:
        for module in (codec, encode):
            patch.setattr(module, "native_module", lambda: None)
        return mine, run()


def everything(form):
    wants = {path: Want(path) for path in form.fields}
    wants |= {f"{path} raw": Want(path, "raw", absent=-7) for path in form.fields}
    return wants | {f"{path} span": Want(path, "span") for path in form.titles}


def assert_same(mine, theirs):
    for a, b in zip(mine, theirs, strict=True):
        if isinstance(a, np.ndarray):
            assert a.dtype == b.dtype
            assert a.tobytes() == b.tobytes()  # NaN and trailing zeros included
        else:
            assert a == b


def compare(monkeypatch, data, offset, length, form, strict):
    found, expected = both(monkeypatch, lambda: find_records(data, offset, length, form, strict=strict))
    assert_same(found.records, expected.records)
    assert_same(found.faults, expected.faults)
    held, expected = both(monkeypatch, lambda: decode(data, found.records, form, everything(form)))
    for name, column in held.items():
        assert_same(column, expected[name])
    return found


def test_mutated_records_of_every_edition(monkeypatch):
    rng = random.Random(5)
    n_records = n_faults = 0
    for category, edition, profile, record in ALL:
        data, offset, length = bytearray(), [], []
        for _ in range(4):
            body = b"".join(Draw(rng, category).record(record, profile) for _ in range(2))
            offset.append(len(data))
            length.append(3 + len(body))
            data += bytes([category, 0, 0]) + body
        for _ in range(rng.choice([0, 6, 20])):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        found = compare(
            monkeypatch, bytes(data), np.array(offset), np.array(length), layout(category, edition), rng.random() < 0.5
        )
        n_records += len(found.records.start)
        n_faults += len(found.faults.code)
    assert n_records > 150
    assert n_faults > 30


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(categories()), st.integers(0, 20), st.binary(max_size=60), st.booleans())
def test_any_bytes(category, edition, body, strict):
    names = editions(category)
    form = layout(category, names[edition % len(names)])
    data = bytes([category, 0, 0]) + body
    with pytest.MonkeyPatch.context() as patch:
        compare(patch, data, np.array([0]), np.array([len(data)]), form, strict)


def test_written_bytes(monkeypatch):
    rng = random.Random(6)
    for category, edition, profile, record in ALL:
        form = layout(category, edition)
        body = b"".join(Draw(rng, category).record(record, profile) for _ in range(4))
        data = bytes([category, 0, 0]) + body
        records = find_records(data, np.array([0]), np.array([len(data)]), form).records
        raw = {p: Want(p, "raw") for p, f in form.fields.items() if not f[0].guards}
        held = {
            path: column
            for path, column in decode(data, records, form, raw).items()
            if (len(column.rows) if column.rows is not None else column.present.any())
        }
        mine, theirs = both(monkeypatch, lambda f=form, h=held, p=profile: encode.encode(f, h, profile=p))
        assert_same(mine, theirs)


def test_values_match_the_bits():
    assert walk.bits(bytes([0b10110011, 0b01010101]), 0, 3, 7) == 0b1001101
