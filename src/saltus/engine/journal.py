"""The journal: everything that became known, in the order in which it did; it only grows.

Tables of one kind are cut into segments of so many rows, each an Arrow file that is written once and never changed:
`KIND-000000.arrow`. What does not yet fill a segment waits in memory and goes into a checkpoint. The columns of each
kind are an interface, `SCHEMA` its version.

| kind | a row | columns |
| --- | --- | --- |
| `reports` | report received, in order of arrival | `time`, `source`, `file`, `record`, `local_id`, `reason` |
| `plots` | report placed, in order of time | those of `Measurements`; `plot` is the report's number, from 0 |
| `rows` | state published by a local tracker | those of `Rows`; `system` |
| `fates` | what became of a plot; of two the later holds | those of `Fates`; `system` |
| `confirmed` | local track confirmed | `system`, `track_id` |
| `conditions` | scan that told of its source's condition | `source`, `time`, `probs` of the conditions, 0 behind |
| `refused` | report that came too late or at a wild time | `plot`, `reason` |
| `foreign` | state of another centre's track | as its reader gives them |
"""

import os
import shutil
import tempfile
import weakref
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.engine.arrays import from_table, joined, to_table
from saltus.errors import DataError

__all__ = ["SCHEMA", "Journal", "foreign_columns"]

_Array = npt.NDArray[Any]

SCHEMA = 2
_ROWS = 1 << 16  # of a segment
_BATCH = 1 << 13  # of these, read at a time
_FOREIGN = ("time", "track_number", "latitude", "longitude", "vx", "vy", "coasted")


class Journal:
    """Tables that grow, on disk but for the last rows of each."""

    def __init__(self, folder: Path | None = None) -> None:
        """Begin an empty journal in a folder; None: in a temporary one that goes with the journal."""
        self._folder = Path(tempfile.mkdtemp(prefix="saltus-")) if folder is None else Path(folder)
        self._folder.mkdir(parents=True, exist_ok=True)
        # A temporary folder goes with the journal, at the latest with the program.
        self._gone = None if folder is not None else weakref.finalize(self, shutil.rmtree, self._folder, True)
        self._sealed: dict[str, list[int]] = {}  # checksum of each segment
        self._waiting: dict[str, list[dict[str, _Array]]] = {}
        self._count: dict[str, int] = {}

    def append(self, kind: str, columns: Mapping[str, _Array]) -> None:
        """Add rows."""
        n = len(next(iter(columns.values())))
        if not n:
            return
        self._waiting.setdefault(kind, []).append(dict(columns))
        self._count[kind] = self._count.get(kind, 0) + n
        if self._count[kind] >= _ROWS:
            self._seal(kind)

    def parts(self, kind: str, columns: Sequence[str] | None = None) -> Iterator[dict[str, _Array]]:
        """Yield all rows of a kind, some thousands at a time; `columns` names those wanted, None: all."""
        for k in range(len(self._sealed.get(kind, ()))):
            with pa.memory_map(str(self._path(kind, k))) as source:
                reader = pa.ipc.open_file(source)
                for batch in range(reader.num_record_batches):
                    table = pa.Table.from_batches([reader.get_batch(batch)])
                    yield from_table(table if columns is None else table.select(list(columns)))
        if self._count.get(kind):
            waiting = self._waiting[kind]
            yield joined(waiting if columns is None else [{name: part[name] for name in columns} for part in waiting])

    def count(self, kind: str) -> int:
        """Return the number of rows of a kind."""
        return len(self._sealed.get(kind, ())) * _ROWS + self._count.get(kind, 0)

    def all(self, kind: str) -> dict[str, _Array] | None:
        """Return all rows of a kind at once, None without any."""
        parts = list(self.parts(kind))
        return joined(parts) if parts else None

    def lies_in(self, folder: Path) -> bool:
        """Say whether it is written in that folder."""
        return folder.resolve() == self._folder.resolve()

    def move(self, folder: Path) -> None:
        """Go on in another folder: what is sealed is copied there."""
        if self.lies_in(folder):
            return
        folder.mkdir(parents=True, exist_ok=True)
        for kind, sums in self._sealed.items():
            for k in range(len(sums)):
                with _whole(folder / self._path(kind, k).name) as temporary:
                    shutil.copyfile(self._path(kind, k), temporary)
        self.close()
        self._folder = folder

    def close(self) -> None:
        """Remove a temporary folder."""
        if self._gone is not None:
            self._gone()
            self._gone = None

    def state(self) -> dict[str, Any]:
        """Return what `restore` goes on from: the checksums of the segments sealed, and the rows that wait."""
        waiting = {kind: joined(parts) for kind, parts in self._waiting.items() if self._count.get(kind)}
        return {"sealed": {kind: np.array(sums, np.uint32) for kind, sums in self._sealed.items()}, "waiting": waiting}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on in the journal's folder from what `state` gave; segments sealed later are written anew.

        Raises:
            DataError: a segment is missing, or was changed after it was written.
        """
        self._sealed = {kind: sums.tolist() for kind, sums in state.get("sealed", {}).items()}
        self._waiting = {kind: [dict(columns)] for kind, columns in state.get("waiting", {}).items()}
        self._count = {kind: len(next(iter(parts[0].values()))) for kind, parts in self._waiting.items()}
        for kind, sums in self._sealed.items():
            for k, checksum in enumerate(sums):
                _check(self._path(kind, k), checksum)

    def _seal(self, kind: str) -> None:
        """Write whole segments."""
        columns = joined(self._waiting[kind])
        n = self._count[kind]
        for begin in range(0, n - _ROWS + 1, _ROWS):
            part = to_table({name: values[begin : begin + _ROWS] for name, values in columns.items()})
            sums = self._sealed.setdefault(kind, [])
            with _whole(self._path(kind, len(sums))) as temporary:
                with pa.OSFile(str(temporary), "wb") as sink, pa.ipc.new_file(sink, part.schema) as writer:
                    writer.write_table(part, max_chunksize=_BATCH)
                sums.append(_checksum(temporary))
        rest = n - n % _ROWS
        self._waiting[kind] = [{name: values[rest:].copy() for name, values in columns.items()}]
        self._count[kind] = n % _ROWS

    def _path(self, kind: str, k: int) -> Path:
        return self._folder / f"{kind}-{k:06d}.arrow"


def foreign_columns(tracks: pa.Table) -> dict[str, _Array]:
    """Return another centre's tracks as columns: numbers, and text that is empty where there is none."""
    out: dict[str, _Array] = {}
    for name in ("system", "mode3a", "icao24"):
        out[name] = np.array([str(v or "") for v in tracks[name].to_pylist()], str)
    for name in _FOREIGN:
        out[name] = np.asarray(tracks[name].to_numpy(zero_copy_only=False), np.float64)
    return out


def _check(path: Path, checksum: int) -> None:
    """Refuse a segment that is not what was sealed."""
    try:
        found = _checksum(path)
    except OSError as error:
        raise DataError(
            f"{path}: the journal's segment cannot be read: {error}. Begin anew without --resume."
        ) from error
    if found != checksum:
        raise DataError(f"{path}: the journal's segment was changed after it was sealed. Begin anew without --resume.")


def _checksum(path: Path) -> int:
    found = 0
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            found = zlib.crc32(block, found)
    return found


@contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """Give a path to write to; the file is there as a whole or not at all."""
    temporary = path.with_name(f".{path.name}.tmp")
    yield temporary
    with temporary.open("rb+") as file:
        os.fsync(file.fileno())
    os.replace(temporary, path)
