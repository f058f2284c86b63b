"""How fast is ASTERIX read and written? Saltus against libasterix and asterix_decoder. Prints a Markdown table.

The recording is made here: CAT048 reports with three Comm-B registers each. Saltus takes every column that a tracker
wants, the registers' fields among them, out of the bytes; the peers parse records into their own objects, which is all
they offer. Figures are CPU seconds of one process, the least of several turns, in which contenders alternate.

asterix_decoder is under the GPL and calls its module as libasterix does: it runs in an environment of its own, whose
interpreter is given as --peer.
"""

import argparse
import json
import platform
import subprocess
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np

from saltus.asterix.codec import Column, Records, Want, decode, find_records, walk
from saltus.asterix.encode import Encoded, blocks, encode
from saltus.asterix.layout import layout
from saltus.asterix.program import compile_program

PER_BLOCK = 10
CHUNK = 5000  # blocks decoded at once: memory is bounded by it
TURNS = 5
FORM = layout(48, "1.32")
ITEMS = (
    "010/SAC 010/SIC 140 020/TYP 020/SIM 020/RAB 020/TST 020/ERR 040/RHO 040/THETA 070/V 070/G 070/L 070/MODE3A "
    "090/V 090/G 090/FL 220 240 161/TRN 042/X 042/Y 200/GSP 200/HDG 230/STAT"
).split()
WANTS = {path: Want(path) for path in [*ITEMS, *(p for p in FORM.fields if p.startswith("250/") and "," in p)]}
PEER = """
import asterix, sys, time
data = open(sys.argv[1], "rb").read()
start = time.process_time()
n = len(asterix.parse(data))
print(n, time.process_time() - start)
"""


def columns(n: int, rng: np.random.Generator) -> dict[str, Column]:
    """Random reports, every field that a Mode S radar sends."""

    def code(path: str, values: np.ndarray) -> tuple[str, Column]:
        return path, Column(values, None, None)

    def bits(size: int) -> np.ndarray:
        return rng.integers(0, 1 << size, n)

    rows = np.repeat(np.arange(n), 3)
    dense = dict(
        code(path, bits(FORM.field(path).size) if path != "240" else np.full(n, "SALTUS1", "S8"))
        for path in ITEMS
        if path not in ("020/TST", "020/ERR")
    )
    registers = {
        "250/MBDATA": Column(rng.integers(0, 1 << 56, 3 * n), None, rows),
        "250/BDS1": Column(np.tile([4, 5, 6], n), None, rows),
        "250/BDS2": Column(np.zeros(3 * n, np.int64), None, rows),
    }
    return dense | registers


def decoded(data: np.ndarray, offset: np.ndarray, length: np.ndarray) -> int:
    """Bytes to columns, a chunk of blocks at a time."""
    n = 0
    for k in range(0, len(offset), CHUNK):
        records = find_records(data, offset[k : k + CHUNK], length[k : k + CHUNK], FORM).records
        decode(data, records, FORM, WANTS)
        n += len(records.start)
    return n


def in_python(data: bytes, offset: np.ndarray, length: np.ndarray) -> int:
    """The definition of the decoder."""
    records, _ = walk.find(data, offset, length, compile_program(FORM, {}, "010"), False)
    found = Records(*records)
    walk.extract(data, found.start, found.stop, compile_program(FORM, WANTS))
    return len(found.start)


def libasterix(data: bytes, start: np.ndarray) -> int:
    """Records as objects of libasterix, and the numbers of one item of each."""
    from asterix import base, generated

    n = 0
    for a, b in pairwise(start.tolist()):
        raw = base.Bits.from_bytes(data[a + 3 : b])
        for record in generated.Cat_048_1_32.cv_uap.parse(raw):
            record.get_item("040")
            n += 1
    return n


def asterix_decoder(peer: str, path: Path) -> float:
    """CPU seconds of the peer's parser in its own process, its start not counted."""
    said = subprocess.run([peer, "-c", PEER, str(path)], check=True, capture_output=True, text=True).stdout
    return float(said.split()[1])


def seconds(call: Callable[[], object]) -> float:
    """CPU seconds of one call."""
    start = time.process_time()
    call()
    return time.process_time() - start


def race(n: int, few: int, peer: str | None, folder: Path) -> dict[str, float]:
    """Records a second of each contender."""
    held = columns(n, np.random.default_rng(1))
    records = encode(FORM, held)
    whole = blocks(48, records, np.arange(0, n, PER_BLOCK))
    data = np.frombuffer(whole.data, np.uint8)
    offset, length = whole.start[:-1], np.diff(whole.start)
    head = Encoded(whole.data[: whole.start[few // PER_BLOCK]], whole.start[: few // PER_BLOCK + 1])
    path = folder / "asterix_speed.ast"
    path.write_bytes(head.data)
    contenders: dict[str, tuple[int, Callable[[], float]]] = {
        "saltus, bytes to columns": (n, lambda: seconds(lambda: decoded(data, offset, length))),
        "saltus, records found only": (n, lambda: seconds(lambda: find_records(data, offset, length, FORM))),
        "saltus, columns to blocks": (
            n,
            lambda: seconds(lambda: blocks(48, encode(FORM, held), np.arange(0, n, PER_BLOCK))),
        ),
        "saltus, the definition in Python": (
            few,
            lambda: seconds(lambda: in_python(head.data, head.start[:-1], np.diff(head.start))),
        ),
        "libasterix, records as objects": (few, lambda: seconds(lambda: libasterix(head.data, head.start))),
    }
    if peer:
        contenders["asterix_decoder, records as dictionaries"] = few, lambda: asterix_decoder(peer, path)
    best = dict.fromkeys(contenders, float("inf"))
    for _ in range(TURNS):
        for name, (_, run) in contenders.items():
            best[name] = min(best[name], run())
    path.unlink()
    return {name: contenders[name][0] / best[name] for name in contenders}


def main() -> None:
    """Race, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=300_000)
    parser.add_argument("--few", type=int, default=1000, help="records that the slow ones read")
    parser.add_argument("--peer", help="interpreter of an environment with asterix_decoder")
    parser.add_argument("-o", type=Path, default=Path("out/asterix_speed.json"))
    options = parser.parse_args()
    options.o.parent.mkdir(parents=True, exist_ok=True)
    found = race(options.records, options.few, options.peer, options.o.parent)
    ours = found["saltus, bytes to columns"]
    print(f"{len(WANTS)} columns, {platform.machine()}, Python {platform.python_version()}, NumPy {np.__version__}\n")
    print("| | records/s | saltus is faster by |\n|---|---|---|")
    for name, rate in found.items():
        print(f"| {name} | {rate:,.0f} | {ours / rate:,.1f} |")
    options.o.write_text(json.dumps(found, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
