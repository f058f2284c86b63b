"""Tables on disk while they are made: rows put in order as they become known, batches written one behind the other."""

import shutil
import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa

from saltus.io.write import blamed
from saltus.tracks.rows import Rows, join_rows

__all__ = ["InOrder", "Place", "Spool", "Stored"]


class Place:
    """A temporary folder that goes when nobody needs it any more."""

    def __init__(self) -> None:
        """Make it."""
        self.path = Path(tempfile.mkdtemp(prefix="saltus-"))
        self._gone = weakref.finalize(self, shutil.rmtree, self.path, True)


class Stored:
    """A table in a file."""

    def __init__(self, place: Place, path: Path) -> None:
        """Take a file that is complete."""
        self._place, self._path = place, path

    def table(self) -> pa.Table:
        """Return the table, mapped into memory: what is not looked at stays on disk."""
        with blamed(self._path):
            return pa.ipc.open_file(pa.memory_map(str(self._path))).read_all()

    def batches(self) -> Iterator[pa.Table]:
        """Read it batch by batch; an empty table is one."""
        with blamed(self._path):
            opened = pa.OSFile(str(self._path))
        with opened as file:
            reader = pa.ipc.open_file(file)
            for k in range(reader.num_record_batches):
                yield pa.Table.from_batches([reader.get_batch(k)])
            if not reader.num_record_batches:
                yield reader.schema.empty_table()


class Spool:
    """A table that is written batch by batch."""

    def __init__(self, place: Place, name: str) -> None:
        """Begin with nothing written."""
        self._place, self._path = place, place.path / f"{name}.arrow"
        with blamed(self._path):
            self._sink = pa.OSFile(str(self._path), "wb")
        self._writer: pa.ipc.RecordBatchFileWriter | None = None

    def write(self, table: pa.Table) -> None:
        """Write a batch; the first one says what the columns are, and may be empty."""
        if self._writer is None:
            self._writer = pa.ipc.new_file(self._sink, table.schema)
        if table.num_rows:
            with blamed(self._path):
                self._writer.write_table(table.combine_chunks())

    def stored(self) -> Stored:
        """End the table."""
        with blamed(self._path):
            if self._writer is not None:
                self._writer.close()
            self._sink.close()
        return Stored(self._place, self._path)


class InOrder:
    """Published rows that wait until no earlier one can follow, and go in the order of tables, so many at a time.

    Rows are ordered by (time_known, track_id, time); of equal ones the first given goes first.
    """

    def __init__(self, at_once: int) -> None:
        """Begin without rows."""
        self._at_once = at_once
        self._waiting: list[Rows] = []  # no order
        self._sorted: list[Rows] = []  # ready to go
        self._n = 0

    def add(self, rows: Rows, before: float) -> Iterator[Rows]:
        """Take rows; yield what can go, in batches of the same number.

        Args:
            rows: published.
            before: no row to come is known before that, s.
        """
        waiting = join_rows([*self._waiting, rows])
        go = waiting.time_known < before
        self._waiting = [waiting.take(~go)]
        yield from self._go(waiting.take(go))

    def end(self) -> Iterator[Rows]:
        """Yield the rest, the last batch as long as it is."""
        yield from self._go(join_rows(self._waiting))
        yield join_rows(self._sorted)
        self._waiting, self._sorted, self._n = [], [], 0

    def _go(self, rows: Rows) -> Iterator[Rows]:
        rows = rows.take(np.lexsort((rows.time, rows.track_id, rows.time_known)))
        self._sorted.append(rows)
        self._n += len(rows.time)
        if self._n < self._at_once:
            return
        rows, begin = join_rows(self._sorted), 0
        while self._n - begin >= self._at_once:
            yield rows.take(np.arange(begin, begin + self._at_once))
            begin += self._at_once
        self._sorted, self._n = [rows.take(np.arange(begin, self._n))], self._n - begin
