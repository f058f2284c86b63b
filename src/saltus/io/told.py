"""What is told of recordings that they do not tell themselves."""

import datetime
from collections.abc import Callable, Mapping
from typing import NamedTuple

from saltus.io.settings import ReadingSettings

__all__ = ["Progress", "Told"]

Progress = Callable[[str, float], None]


class Told(NamedTuple):
    """What is told of recordings that they do not tell themselves."""

    date: datetime.date | None = None  # of the first record of ASTERIX files; past midnight counts on
    editions: Mapping[int, str] = {}  # ASTERIX category -> edition, as "0.23"; categories not named are guessed
    framing: str | None = None  # one of `saltus.framing.NAMES`; None has it guessed
    settings: ReadingSettings = ReadingSettings()  # bounds of reading
    most: int | None = None  # bytes read of an ASTERIX file, from the beginning; None = all
    apart: frozenset[tuple[int, int]] = frozenset()  # SAC and SIC of the sources that the channel tells apart
