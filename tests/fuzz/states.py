"""Targets of what Saltus itself wrote and reads back: setups, checkpoints, journals, folders of outputs; datagrams."""

import json
import shutil
import struct
import tempfile
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple
from unittest import mock

from engine_scenes import radars_toml, scene
from fuzzing import Failed, Target

from saltus import Session
from saltus.engine import journal
from saltus.engine.saved import setup_toml
from saltus.errors import DataError
from saltus.framing.datagrams import Datagrams
from saltus.io.publish import MANIFEST
from saltus.io.write import output_directory

_WORDS = (b"null", b"-1", b"1e999", b"[]", b"{}", b'""', b"9" * 400, b"NaN", b"[" * 2000, b'"../x"', b"true", b"\0")
_BINARY = (b"\0\0\0\0", b"\xff\xff\xff\xff", b"PK\x03\x04", b"PK\x01\x02", b"ARROW1", b"<f8", b"(9999999999,)", b"|O")


class Saved(NamedTuple):
    """A session saved amid a recording: the setup that it learnt, as a file, and the files of its state."""

    setup: bytes
    files: dict[str, bytes]


@cache
def saved() -> Saved:
    """Two radars, tracked for a while; the journal's segments are short, so that some are sealed."""
    with tempfile.TemporaryDirectory() as name, mock.patch.object(journal, "_ROWS", 256):
        folder = Path(name)
        (folder / "radars.toml").write_text(radars_toml())
        session = Session.open(folder / "radars.toml", hold=0.0)
        session.feed(scene(2).take(slice(0, 600)))
        session.save(folder / "state")
        files = {path.name: path.read_bytes() for path in (folder / "state").iterdir()}
        return Saved(setup_toml(session.setup, ["simulated"]).encode(), files)


def _restored(path: Path, name: str) -> object:
    """Go on with a session one file of whose state is the input, to its end; the folder is named after the input."""
    folder = path.with_name(f"{path.name}.state")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for other, content in saved().files.items():
        (folder / other).write_bytes(content)
    shutil.copyfile(path, folder / name)
    with mock.patch.object(journal, "_ROWS", 256):
        return Session.restore(folder).finish()


def _published(path: Path) -> object:
    """Write a set into a folder whose list of files is the input: what lies there of others', and beside it, stays."""
    folder = path.with_name(f"{path.name}.out")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    beside = path.with_name("precious")
    beside.write_text("mine")
    (folder / "notes").write_text("mine")
    shutil.copyfile(path, folder / MANIFEST)
    for said in "12":
        with output_directory(folder) as stage:
            (stage / "tables").write_text(said)
    if beside.read_text() != "mine" or (folder / "tables").read_text() != "2":
        raise Failed("a list of files deletes what is none of the folder's, or what was written")
    if {p.name for p in folder.iterdir()} - {"notes"} != {"tables", MANIFEST}:
        raise Failed(f"left behind: {sorted(p.name for p in folder.iterdir())}")
    return json.loads((folder / MANIFEST).read_text())


def _in_datagrams(payloads: Sequence[bytes]) -> bytes:
    return b"".join(struct.pack(">H", len(payload)) + payload for payload in payloads)


def _fed(path: Path) -> object:
    """Cut an input into datagrams, each behind its length, and feed them one by one and at once: the same blocks."""
    content, payloads = path.read_bytes(), []
    while len(content) >= 2 and len(payloads) < 300:
        size = 2 + int.from_bytes(content[:2], "big")
        payloads.append(content[2:size])
        content = content[size:]
    if any(len(payload) > 65507 for payload in payloads):
        raise DataError(f"{path}: no datagram is so long")
    at_once = Datagrams()
    chunk = at_once.feed(payloads, list(range(len(payloads))))
    if ((chunk.offset < 0) | (chunk.offset + chunk.length > len(chunk.data)) | (chunk.length < 3)).any():
        raise Failed("a block lies outside the bytes")
    blocks = [bytes(chunk.data[o : o + n]) for o, n in zip(chunk.offset, chunk.length, strict=True)]
    singly, found = Datagrams(), []
    for k, payload in enumerate(payloads):
        one = singly.feed([payload], [k])
        found += [(bytes(one.data[o : o + n]), at) for o, n, at in zip(one.offset, one.length, one.at, strict=True)]
    if found != list(zip(blocks, chunk.at.tolist(), strict=True)) or at_once.passed != singly.passed:
        raise Failed("datagrams one by one give other blocks than at once")
    return len(blocks)


def states(words: tuple[bytes, ...], bodies: Sequence[bytes]) -> list[Target]:
    """One target for each file; `words` mean something in TOML, `bodies` are blocks."""
    files = saved().files
    segments = sorted(name for name in files if name.endswith(".arrow"))
    listed = b'{"sets": {"track": ["tables", "summary.json"], "demo": ["radar.ast"]}, "kept": ["radar.ast"]}'
    pairs = (_in_datagrams(bodies), _in_datagrams([b"".join(bodies[:3]), b"", b"GARBAGE", bodies[0][:9], bodies[1]]))

    def restored(name: str) -> Callable[[Path], object]:
        return partial(_restored, name=name)

    return [
        Target("setup", ".toml", (saved().setup,), words, Session.open),
        Target("pointer", ".json", (files["checkpoint.json"],), _WORDS, restored("checkpoint.json")),
        Target("state", ".npz", (files["state-000000.npz"],), _BINARY, restored("state-000000.npz")),
        *(
            Target(f"journal-{name.split('-')[0]}", ".arrow", (files[name],), _BINARY, restored(name))
            for name in segments
        ),
        Target("published", ".json", (listed,), _WORDS, _published),
        Target("datagrams", ".bin", pairs, (b"\x30\x00\x1f", b"\0\x03", b"\xff\xff", b"\0\0"), _fed),
    ]
