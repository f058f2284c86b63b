"""One target for each reader, over recordings, tables, setups and sessions that the project makes itself.

A target reads one kind of file through the public entry points, so whatever decodes behind them is covered.
"""

import random
import sys
from contextlib import redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from fuzzing import Failed, Target

from saltus.config import load_config
from saltus.convert import convert_files
from saltus.diagnose.residuals import from_table
from saltus.evaluate.tables import read_reference, read_tracks
from saltus.gap import load_scenario
from saltus.io import FORMATS, ReadingSettings, read, read_in_order
from saltus.records import Recording

TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS / name) for name in ("io", "framing", "asterix", "engine")]

import containers_made as made  # noqa: E402
import frames  # noqa: E402
from library import Draw, definitions, in_blocks  # noqa: E402
from states import states  # noqa: E402

SETTINGS = ReadingSettings(memory=2e8)


def _radar(k: int) -> bytes:
    return frames.plot(tod=100 + 0.5 * k, rho=2560 + 8 * k, theta=(1500 * k) % 65536, sic=0x81 + (k % 5 == 0))


def _blocks(category: int, bodies: list[str]) -> bytes:
    parts = [bytes.fromhex(body) for body in bodies]
    return b"".join(bytes([category]) + (3 + len(part)).to_bytes(2, "big") + part for part in parts)


def _tod(k: int) -> str:
    return f"{round((100 + 0.5 * k) * 128):06x}"


def _asterix() -> dict[str, bytes]:
    """Plain recordings of every category that is read, 40 blocks of one record each."""
    n = range(40)
    return {
        "cat048": b"".join(_radar(k) for k in n),
        "cat034": b"".join((_radar(k) if k % 4 else frames.NORTH) for k in n),
        "cat010": _blocks(10, [f"f304 0007 01 20 {_tod(k)} {1500 + k:04x}fffe {0x3C6444 + k % 3:06x}" for k in n]),
        "cat021": _blocks(
            21, [f"c71902 14db 0140 {0x1C71C7 + k:06x}000000 0e38e3{k:02x}00000000 abcdef {_tod(k)} 0578" for k in n]
        ),
        "cat062": _blocks(62, [f"9948 14db {_tod(k)} {0x0E38E38 + k:08x} 00100000 029c {k % 4:04x}" for k in n]),
    }


@cache
def _every_category() -> tuple[bytes, ...]:
    """Random records of every category and edition, a recording for each, by libasterix."""
    draw = random.Random(7)
    found = []
    for category, _, profile, record in definitions():
        octets = [Draw(draw, category).record(record, profile) for _ in range(6)]
        found.append(in_blocks(category, octets)[0])
    return tuple(found)


def _table(n: int = 40) -> dict[str, list[object]]:
    draw = np.random.default_rng(5)
    return {
        "time": [1.7e9 + 4.0 * k for k in range(n)],
        "latitude": [round(41 + 0.002 * k + 1e-4 * draw.standard_normal(), 6) for k in range(n)],
        "longitude": [round(2 + 0.003 * k, 6) if k % 9 else None for k in range(n)],
        "range_m": [round(9e3 + 90 * k, 1) if k % 4 == 3 else None for k in range(n)],
        "azimuth_deg": [round((7.0 * k) % 360, 3) for k in range(n)],
        "altitude_m": [3000 + k for k in range(n)],
        "icao24": [f"{0x400000 + k % 3:06x}" for k in range(n)],
        "mode3a": ["1200" if k % 2 else None for k in range(n)],
        "callsign": [f"ÉTÉ{k % 3}" for k in range(n)],
        "on_ground": ["false" if k % 2 else "" for k in range(n)],
        "source": [("radar", "mlat")[k % 2] for k in range(n)],
        "kind": [("", "geodetic")[k % 2] for k in range(n)],
        "note": [f"row {k}" for k in range(n)],
    }


def _csv(columns: dict[str, list[object]], end: str = "\n") -> bytes:
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(columns), *(",".join("" if v is None else str(v) for v in row) for row in rows)]
    return (end.join(lines) + end).encode()


def _parquet(columns: dict[str, list[object]], **options: object) -> bytes:
    sink = pa.BufferOutputStream()
    pq.write_table(pa.table(columns), sink, **options)
    return bytes(sink.getvalue())


_TRUTH = {
    "time": [1.7e9 + k for k in range(20)],
    "target_id": [f"a{k % 2}" for k in range(20)],
    "latitude": [41 + 0.01 * k for k in range(20)],
    "longitude": [2.0] * 20,
    "altitude": [3000.0] * 20,
}
_TRACKS = {name: [float(k % 3) for k in range(20)] for name in ("track_id", "latitude", "longitude")} | {
    "time": [1.7e9 + k for k in range(20)],
    **dict.fromkeys(("cov_ee", "cov_nn"), [9.0] * 20),
    "cov_en": [0.0] * 20,
    "status": [("confirmed", "coasted")[k % 2] for k in range(20)],
}
_CONFIG = (
    b'date = 2023-05-02\n[[sensor]]\nsac = 20\nsic = 129\nlatitude = 41.3\nlongitude = 2.1\nheight = 27\nname = "BCN"\n'
    b'sigma_range = 3.5\nperiod = 4.0\n[[sensor]]\nname = "pier"\nsystem = "platform"\n[editions]\n21 = "0.23"\n'
    b"[reading]\nmemory = 4e9\n[tracker]\nmax_speed = 300\nconfirm_hits = 2\nheight_prior = [5e3, 3e3]\n"
    b'[filter]\nform = "joint"\naccel_h = [0.2, 3]\n[systems]\np_false = 1e-3\n[registration]\n'
)
_CELLS = (
    *(
        b"nan",
        b"inf",
        b"-1",
        b"1e999",
        b"9" * 400,
        b"NULL",
        b'"',
        b'"",',
        b",",
        b",,",
        b"\n",
        b"\r",
        b"\r\n",
        b"\xc3\xa9",
    ),
    *(b"\x1b[2J", b"\xff\xfe", b"\0", b"\xef\xbb\xbf", b"2024-05-01T12:00:00Z", b"time", b"F" * 17, b"2024-13-45"),
)
_VALUES = (
    *(
        b"nan",
        b"inf",
        b"-inf",
        b"1e400",
        b"-1",
        b"0",
        b"9" * 400,
        b"9" * 5000,
        b"[]",
        b"{}",
        b'""',
        b"true",
        b"[[1.0]]",
    ),
    *(
        b"3",
        b"1979-05-27",
        b"1979-05-27T07:32:00Z",
        b"[" * 500,
        b"{a=" * 200,
        b"'''",
        b'"""',
        b"#",
        b"=",
        b"\n",
        b"[a]\n",
    ),
    *(b"[[a]]\n", b"\xc3\xa9", b"\x1b", b'"\\u0000"', b'"\\ud800"', b"0x10", b"1_0", b"+1", b"{by = {radar = 1}}"),
    *(b"[1, [2]]", b"['a', 1]", b"\xff", b"\0"),
)
_BYTES = (b"\0\0\0", b"\xff\xff\xff", b"\x30\x00\x1f", b"\x22\x00\x0c", b"\0\x03", b"\xff\xff", b"\x15\0\x04")


def _record(path: Path) -> Recording:
    return read([path], settings=SETTINGS)


def _ordered(path: Path) -> object:
    """Read in order of time; usable reports never go back."""
    newest, n = -np.inf, 0
    for found in read_in_order([path], settings=SETTINGS):
        time = found.plots.time[found.plots.reason == 0]
        if len(time) and (time[0] < newest or np.any(np.diff(time) < 0)):
            raise Failed("reports are out of order")
        newest = max([newest, *time[-1:].tolist()])
        n += len(time)
    return n


def _converted(path: Path) -> object:
    with redirect_stdout(StringIO()):
        return convert_files([path], path.with_suffix(".jsonl"))


def _residuals(path: Path) -> object:
    return from_table(path, ["latitude", "altitude_m"], "source")


def targets() -> dict[str, Target]:
    """One of each reader, over recordings and tables that the project makes itself."""
    plain = _asterix()
    bodies = [plain["cat048"][31 * k : 31 * k + 31] for k in range(40)]
    datagrams = [made.ethernet(made.ipv4(made.udp(body))) for body in bodies]
    captures = (made.pcap(datagrams), made.pcap(datagrams, order=">"), made.pcapng(datagrams))
    contained = tuple(build(bodies) for name, build in made.CONTAINERS.items() if name != "plain")
    examples = TESTS.parent / "examples"
    models = tuple(path.read_bytes() for path in sorted(examples.glob("gap_*.toml")))
    table = _table()
    parquet = (_parquet(table), _parquet(table, compression="none", use_dictionary=False, row_group_size=7))
    found = [
        *(Target(name, ".ast", (data,), _BYTES, _record, 40) for name, data in plain.items()),
        Target("mixed", ".ast", (b"".join(plain.values()),), _BYTES, _record),
        Target("capture", ".pcap", captures, _BYTES, _record),
        Target("container", ".raw", contained, _BYTES, _record),
        Target("categories", ".ast", _every_category(), _BYTES, _record),
        Target("ordered", ".pcap", (*captures, captures[0] + captures[1], *contained), _BYTES, _ordered),
        Target("converted", ".ast", (plain["cat048"], *_every_category()[:6]), _BYTES, _converted),
        Target("csv", ".csv", (_csv(table), _csv(table, "\r\n")), _CELLS, _record),
        Target("rows", ".csv", (_csv(table), _csv(table, "\r\n")), _CELLS, _ordered),
        Target("parquet", ".parquet", parquet, _CELLS, _record),
        Target("truth", ".csv", (_csv(_TRUTH),), _CELLS, read_reference),
        Target("tracks", ".parquet", (_parquet(_TRACKS),), _CELLS, read_tracks),
        Target("residuals", ".csv", (_csv(table),), _CELLS, _residuals),
        Target("config", ".toml", (_CONFIG,), _VALUES, load_config),
        Target("model", ".toml", models, _VALUES, load_scenario),
        *states(_VALUES, bodies),
    ]
    assert {f.name for f in FORMATS} == {"Parquet table", "packet capture", "ASTERIX", "CSV table"}, "a format unfuzzed"
    return {target.name: target for target in found}
