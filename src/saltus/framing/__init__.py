"""Recordings as data blocks: containers, captures and plain files, cut into ASTERIX blocks piece by piece."""

from saltus.framing.chunk import Chunk, Segment
from saltus.framing.datagrams import Datagrams
from saltus.framing.framer import NAMES, Framer
from saltus.framing.reader import PIECE, read_chunks
from saltus.framing.told import Told

__all__ = ["NAMES", "PIECE", "Chunk", "Datagrams", "Framer", "Segment", "Told", "read_chunks"]
