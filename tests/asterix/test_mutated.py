"""Mutated records against libasterix: what it decodes is decoded to the same values, and what it refuses is refused."""

import random

import numpy as np
import pytest
from library import Draw, definitions, parsed, value
from test_oracle import equal

from saltus.asterix.codec import FAULTS, Want, decode, find_records
from saltus.asterix.layout import layout

ALL = list(definitions())
_INSIDE = FAULTS.index("what item {item} holds does not follow its definition")  # the library leaves it as bytes
_NO_KIND = FAULTS.index("item {item} does not tell the kind of record")  # the library is told the kind


def mutated(rng, octets):
    """The bytes of a record with some changed, put in, or taken out."""
    data = bytearray(octets)
    for _ in range(rng.choice([1, 1, 2, 4])):
        at = rng.randrange(len(data))
        match rng.randrange(4):
            case 0:
                data[at] ^= 1 << rng.randrange(8)
            case 1:
                data[at] = rng.randrange(256)
            case 2:
                data.insert(at, rng.randrange(256))
            case _:
                if len(data) > 1:
                    del data[at]
    return bytes(data)


def by_the_library(classes, profiles, data):
    """Length and fields of each record that the library finds, told the kinds of the first ones."""
    found, position = [], 0
    while position < len(data):
        one = parsed(classes[profiles[min(len(found), len(profiles) - 1)]], data[position:])
        if one is None:
            return found, False
        found.append(one)
        position += one[0]
    return found, True


def sample(rng, category, edition, profile, record, classes):
    """Compare one mutated block; return how many records were equal, 0 where the two cannot be compared."""
    form = layout(category, edition)
    body = b"".join(mutated(rng, Draw(rng, category).record(record, profile)) for _ in range(2))
    data = bytes([category]) + (3 + len(body)).to_bytes(2, "big") + body
    records, faults = find_records(data, np.array([0]), np.array([len(data)]), form, strict=True, require=None)
    if np.isin(faults.code, (_INSIDE, _NO_KIND)).any():
        return 0
    kept = faults.record[faults.record >= 0]  # used without the item of explicit length that the library refuses
    records = records.take(np.arange(min(kept.tolist(), default=len(records.start))))
    names = list(form.records)
    profiles = [names[p] for p in records.profile] or [profile]
    theirs, whole = by_the_library(classes, profiles, body)
    n = len(records.start)
    if len(classes) > 1:  # what follows the last record may be of another kind than the library was told
        theirs, whole = theirs[:n], whole and len(theirs) <= n
    assert (records.stop - records.start).tolist() == [size for size, _ in theirs], data.hex()
    assert (len(faults.code) == 0) == whole or len(classes) > 1, data.hex()
    plain = [path for path, fields in form.fields.items() if not fields[0].guards]
    columns = decode(data, records, form, {path: Want(path) for path in plain})
    for row, (_, fields) in enumerate(theirs):
        for path, expected in fields.items():
            column = columns[path]
            if column.rows is not None:
                got = column.values[column.rows == row].tolist()
            else:
                one = column.values[row]
                got = [one.tobytes() if column.values.dtype.kind == "V" else one] if column.present[row] else []
            want = [value(*e) for e in expected]
            assert len(got) == len(want), (path, data.hex())
            assert all(map(equal, got, want)), (path, got, want, data.hex())
    return n


@pytest.mark.parametrize("seed", range(4))
def test_mutated_records_decode_as_by_the_library(seed):
    rng = random.Random(seed)
    classes = {}
    for category, edition, profile, record in ALL:
        classes.setdefault((category, edition), {})[profile] = record
    n = 0
    for category, edition, profile, record in ALL:
        for _ in range(6):
            n += sample(rng, category, edition, profile, record, classes[category, edition])
    assert n > 100
