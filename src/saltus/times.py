"""Times as people write them: a window of a recording."""

import re
from datetime import UTC, datetime

import numpy as np

from saltus.errors import DataError

__all__ = ["parse_time", "time_window", "utc"]

_DAY = 86400.0  # s


def parse_time(text: str, start: float) -> float:
    """Read HH:MM[:SS] of the day of `start` (UTC seconds), or ISO 8601 (UTC unless it says otherwise)."""
    if re.fullmatch(r"\d{1,2}:\d{2}(:\d{2}(\.\d+)?)?", text):
        hours, minutes, *seconds = (float(part) for part in text.split(":"))
        if hours < 24 and minutes < 60 and sum(seconds) < 60:
            return float(np.floor(start / 86400.0) * 86400.0 + 3600.0 * hours + 60.0 * minutes + sum(seconds))
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise DataError(f"{text!r} is no time; write HH:MM, HH:MM:SS or 2023-05-02T08:00:00 (UTC).") from error
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def time_window(time_from: str | None, time_to: str | None, start: float, end: float) -> tuple[float, float]:
    """Read --from and --to against the span of the recording; past midnight, a time of day before is the next day's."""
    past_midnight = np.floor(end / _DAY) > np.floor(start / _DAY)

    def read(text: str, not_before: float) -> float:
        moment = parse_time(text, start)
        return moment + _DAY if past_midnight and "-" not in text and moment < not_before else moment

    first = start if time_from is None else read(time_from, start)
    last = end if time_to is None else read(time_to, first)
    if first > last and time_from is not None and time_to is not None:
        raise DataError(f"--from {time_from} is after --to {time_to}: {utc(first)} and {utc(last)} (UTC).")
    if first > last or first > end or last < start:
        window = " ".join(
            [f"from {utc(first)}"] * (time_from is not None) + [f"to {utc(last)}"] * (time_to is not None)
        )
        raise DataError(
            f"every report is outside time window {window}: the recording lasts from "
            f"{utc(start)} to {utc(end)} (UTC). Give --from and --to inside it, as HH:MM:SS or 2023-05-02T08:00:00."
        )
    return first, last


def utc(seconds: float) -> str:
    """Write UTC seconds for people."""
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S")
