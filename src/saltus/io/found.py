"""The records of one category of a recording, or of a piece of it."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from saltus.asterix.codec import Faults, Records, find_records
from saltus.asterix.layout import Layout, layout
from saltus.io.blocks import Blocks
from saltus.io.columns import Category, Columns, read_columns

__all__ = ["Found", "find"]

_MOST = 1 << 16  # more than a block holds records


@dataclass(frozen=True, slots=True)
class Found:
    """The records of one category of a recording."""

    layout: Layout
    data: npt.NDArray[np.uint8]
    records: Records
    columns: Columns
    sequence: npt.NDArray[np.int64]  # rises in the order in which all records of the recording came
    clock: npt.NDArray[np.float64]  # s, UTC, when each was captured, NaN = not known
    channel: npt.NDArray[np.int32]  # that brought each, -1 = not told
    faults: Faults

    def __len__(self) -> int:
        """Number of records."""
        return len(self.sequence)


def find(category: Category, edition: str, blocks: Blocks, place: npt.NDArray[np.int64]) -> Found:
    """Find the records of blocks by an edition, and take what their category wants.

    Args:
        category: what it takes.
        edition: of it.
        blocks: of the category.
        place: number of each among the blocks of all categories.
    """
    form = layout(category.number, edition)
    records, faults = find_records(blocks.data, blocks.offset, blocks.length, form)
    columns = read_columns(blocks.data, records, form, category.fields)
    sequence = place[records.block] * _MOST + records.number
    return Found(
        form,
        blocks.data,
        records,
        columns,
        sequence,
        blocks.clock[records.block],
        blocks.channel[records.block],
        faults,
    )
