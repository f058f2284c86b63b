"""Whether the values of records make sense: what tells an edition from one that parses by luck."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from saltus.asterix.codec import Data, Records, Want, decode
from saltus.asterix.layout import Field, Layout, layout

__all__ = ["Check", "checks", "evidence"]

_DAY = 86400.0  # s
_LEVELS = -15.0, 1300.0  # flight levels of aircraft
_NEAR = 600.0  # s between records that follow each other
_RIGHT = 0.98  # of the values of a record read rightly are what they should be
_Raw = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]


class Check(NamedTuple):
    """One field whose bits can be told from arbitrary ones."""

    path: str
    valid: Callable[[_Raw], _Mask]  # of the field's bits as numbers
    luck: float  # share of arbitrary bits that are valid
    follows: bool = False  # a time of day, near that of the record before
    meant: bool = True  # valid bits speak for the edition, else only others against it


@cache
def checks(category: int, edition: str) -> tuple[Check, ...]:
    """What can be checked of the records of an edition."""
    found = (_check(fields[0]) for fields in layout(category, edition).fields.values())
    return tuple(check for check in found if check is not None)


def _check(field: Field) -> Check | None:
    if field.repeated or field.guards:
        return None
    if field.kind == "icao" and field.size == 48:
        return Check(field.path, _spells, (37 / 64) ** 8)
    if field.kind == "table" and field.labels and len(field.labels) < 1 << field.size:
        known = np.array(sorted(field.labels), np.int64)
        return Check(field.path, lambda raw: np.isin(raw, known), len(known) / (1 << field.size), meant=False)
    if field.kind != "quantity":
        return None
    low, high = 0.0, 0.0
    clock = field.unit == "s" and field.size == 24 and field.lsb == 1 / 128
    if clock:
        low, high = 0.0, np.nextafter(_DAY, 0.0)
    elif field.unit == "°" and field.path.endswith("/LAT"):
        low, high = -90.0, 90.0
    elif field.unit == "°" and field.path.endswith("/LON"):
        low, high = -180.0, 180.0
    elif field.unit == "FL":  # two's complement in every edition; older tables say unsigned
        (low, high), field = _LEVELS, replace(field, signed=True)
    if low == high:
        return None
    span = field.lsb * (1 << field.size)
    least = -span / 2 if field.signed else 0.0
    luck = (min(high, least + span) - max(low, least)) / span
    return Check(field.path, _between(field, low, high), min(luck, 1.0), follows=clock) if luck < 1.0 else None


def _between(field: Field, low: float, high: float) -> Callable[[_Raw], _Mask]:
    half = 1 << (field.size - 1)

    def valid(raw: _Raw) -> _Mask:
        value = np.where(raw >= half, raw - 2 * half, raw) if field.signed else raw
        inside: _Mask = (value * field.lsb >= low) & (value * field.lsb <= high)
        return inside

    return valid


def _spells(raw: _Raw) -> _Mask:
    """Whether eight characters of six bits are letters, digits and blanks; none at all is an answer too."""
    letters = np.zeros(64, np.bool_)
    letters[[*range(1, 27), 32, *range(48, 58)]] = True
    good = np.ones(len(raw), np.bool_)
    for shift in range(0, 48, 6):
        good &= letters[(raw >> shift) & 63]
    good |= raw == 0
    return good


def evidence(data: Data, records: Records, form: Layout) -> tuple[float, float]:
    """Weigh the values of records.

    A value that can be told from arbitrary bits speaks for the edition by the logarithm of how much likelier it is
    when read rightly, ln(0.98 / luck), and one that cannot be against it, ln(0.02 / (1 - luck)).

    Args:
        data: the buffer.
        records: of it.
        form: the edition's layout.

    Returns:
        The sum, nats, and the share of the values that are what they should be, 1 when there is none.
    """
    table = checks(form.category, form.edition)
    held = decode(data, records, form, {check.path: Want(check.path, "raw", signed=False) for check in table})
    total, good, n = 0.0, 0, 0
    for check in table:
        column = held[check.path]
        if column.present is None:
            continue
        raw = column.values[column.present].astype(np.int64)
        valid = check.valid(raw)
        nats, right = _weigh(valid, check.luck, meant=check.meant)
        total, good, n = total + nats, good + right, n + len(valid)
        if check.follows and len(raw) > 1:
            step = (np.diff(raw) / 128 + _DAY / 2) % _DAY - _DAY / 2
            near = (np.abs(step) < _NEAR) & valid[1:] & valid[:-1]
            nats, right = _weigh(near, 2 * _NEAR / _DAY, meant=True)
            total, good, n = total + nats, good + right, n + len(near)
    return total, good / n if n else 1.0


def _weigh(valid: _Mask, luck: float, *, meant: bool) -> tuple[float, int]:
    right = int(np.count_nonzero(valid))
    speaks = np.log(_RIGHT / luck) if meant else 0.0
    against = np.log((1.0 - _RIGHT) / (1.0 - luck))
    return float(right * speaks + (len(valid) - right) * against), right
