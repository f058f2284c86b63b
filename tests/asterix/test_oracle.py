"""Every category and edition against libasterix: its random records are read, and written again to the byte."""

import random

import numpy as np
import pytest
from library import Draw, definitions, in_blocks, value

from saltus.asterix.codec import Column, Want, decode, find_records
from saltus.asterix.encode import blocks, encode
from saltus.asterix.layout import EXPLICIT, categories, editions, layout

ALL = list(definitions())


def test_the_layouts_are_those_of_the_library():
    have = {(c, e) for c in categories() for e in editions(c)}
    assert have == {(c, e) for c, e, _, _ in ALL}


def drawn(category, edition, profile, record, n):
    """Random records in blocks of up to three, and what each holds."""
    rng = random.Random(f"{category} {edition} {profile}")
    octets, held = [], []
    for _ in range(n):
        draw = Draw(rng, category)
        octets.append(draw.record(record, profile))
        held.append(draw.fields)
    return octets, held


def equal(got, expected):
    if isinstance(expected, float):
        return got == pytest.approx(expected, rel=1e-12)
    if isinstance(got, bytes):  # bytes of more than 64 bits, or a text
        return got == expected or int.from_bytes(got, "big") == expected
    return got == expected or got == expected - (1 << 64)


@pytest.mark.parametrize(("category", "edition", "profile", "record"), ALL, ids=lambda v: str(v)[-20:])
def test_reads_what_the_library_writes(category, edition, profile, record):
    form = layout(category, edition)
    octets, held = drawn(category, edition, profile, record, 24)
    data, offset, length = in_blocks(category, octets)
    found = find_records(data, offset, length, form, strict=True)
    assert len(found.faults.code) == 0, [found.faults.text(k) for k in range(len(found.faults.code))]
    assert (found.records.stop - found.records.start).tolist() == [len(o) for o in octets]
    assert {list(form.records)[p] for p in found.records.profile} == {profile}
    plain = [path for path, fields in form.fields.items() if not fields[0].guards]
    columns = decode(data, found.records, form, {path: Want(path) for path in plain})
    n_values = 0
    for path, column in columns.items():
        for row, fields in enumerate(held):
            expected = [value(*e) for e in fields.get(path, [])]
            if column.rows is not None:
                got = column.values[column.rows == row].tolist()
            else:
                got = [column.values[row].tobytes() if column.values.dtype.kind == "V" else column.values[row]]
                got = got if column.present[row] else []
            assert len(got) == len(expected), (path, row)
            assert all(map(equal, got, expected)), (path, row, got, expected)
            n_values += len(got)
    assert n_values == sum(len(values) for fields in held for values in fields.values())


@pytest.mark.parametrize(("category", "edition", "profile", "record"), ALL, ids=lambda v: str(v)[-20:])
def test_writes_what_the_library_writes(category, edition, profile, record):
    form = layout(category, edition)
    octets, _ = drawn(category, edition, profile, record, 24)
    data, offset, length = in_blocks(category, octets)
    records = find_records(data, offset, length, form).records
    raw = {p: Want(p, "raw") for p, f in form.fields.items() if not f[0].guards}
    columns = decode(data, records, form, raw)
    spans = {p: Want(p, "span") for p in explicit(form)}
    for path, column in decode(data, records, form, spans).items():
        if any(p.startswith(f"{path}/") for p in columns):
            continue
        chunks = [data[a + 1 : b] if a >= 0 else b"" for a, b in column.values.tolist()]
        rows = np.repeat(np.arange(len(chunks)), [len(c) for c in chunks])
        columns[path] = Column(np.frombuffer(b"".join(chunks), np.uint8).astype(np.int64), None, rows)
    held = {
        p: c for p, c in columns.items() if (c.rows is not None and len(c.rows)) or (c.rows is None and any(c.present))
    }
    encoded = encode(form, held, profile=profile)
    got = [encoded.data[a:b] for a, b in zip(encoded.start[:-1], encoded.start[1:], strict=True)]
    assert got == octets
    assert blocks(category, encoded, np.arange(0, len(octets), 3)).data == data


def explicit(form):
    """Paths of the items that say their length themselves."""
    found, nodes = set(), list(form.records.values())
    while nodes:
        node = nodes.pop()
        if node.kind == EXPLICIT:
            found.add(node.path)
        nodes += [child for child in node.children if child is not None]
    return found
