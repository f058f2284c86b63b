"""Simulated hours through the program: do memory and time per report grow with the length of a recording?

    .venv/bin/python benchmarks/soak.py [--hours 1 4 12 24] [--targets 12] [--systems 1] [--json FILE]

Aircraft fly outward and are gone after a quarter of an hour, when the next ones follow. One radar sees them; with
`--systems 3` a second radar and ADS-B do, too, each every 4 s, and addresses come with ADS-B alone. Each length is one
process of `saltus track --no-report`; its CPU time includes the start. Its peaks of memory are those after the first
hour of data, when all is fed, and at the very end.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from saltus.asterix.codec import Column
from saltus.asterix.encode import blocks, encode
from saltus.asterix.layout import editions, layout
from saltus.geo import Site
from saltus.geo.earth import geodetic_to_polar
from saltus.io.asterix_write import write_cat048

SITES = ((48.0, 11.0), (48.3, 11.4))
PERIOD, LIFE, GONE = 4.0, 900.0, 60.0  # s
HEIGHT = 9144.0  # m
DEGREE = 111_200.0  # m of latitude

_Array = npt.NDArray[np.float64]


def config(systems: int) -> str:
    """Return where the radars stand."""
    lines = ["date = 2025-06-01"]
    for sic, (latitude, longitude) in enumerate(SITES[: min(systems, 2)], start=1):
        lines += ["[[sensor]]", "sac = 25", f"sic = {sic}", f"latitude = {latitude}", f"longitude = {longitude}"]
        lines += ["height = 500.0", f"period = {PERIOD}"]
    return "\n".join(lines) + "\n"


class Traffic:
    """Aircraft that come and go."""

    def __init__(self, targets: int) -> None:
        """Spread them over all directions, and over the quarter of an hour that each lives."""
        self.number = np.arange(targets)
        self.angle = 2.0 * np.pi * (self.number + 0.5) / targets

    def at(self, when: _Array) -> tuple[_Array, _Array, npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
        """Return latitude, longitude (degrees), number and presence at times (n, targets), s."""
        phase = when + LIFE * self.number / len(self.number)
        away = 20e3 + 150.0 * np.mod(phase, LIFE)
        latitude = SITES[0][0] + away * np.cos(self.angle) / DEGREE
        longitude = SITES[0][1] + away * np.sin(self.angle) / DEGREE / np.cos(np.radians(SITES[0][0]))
        number = self.number + len(self.number) * np.floor(phase / LIFE).astype(np.int64)
        return latitude, longitude, number, np.mod(phase, LIFE) > GONE


def record(folder: Path, hours: float, targets: int, systems: int) -> int:
    """Write what each system reports for `hours`, an hour at a time; return how many reports."""
    rng, traffic, count = np.random.default_rng(0), Traffic(targets), 0
    end = 3600.0 * hours
    for begin in np.arange(0.0, end, 3600.0).tolist():
        ticks = np.arange(begin, min(begin + 3600.0, end), PERIOD)[:, None]
        for k in range(min(systems, 2)):
            count += _radar(folder / f"radar{k}.ast", k, ticks, traffic, rng)
        if systems > 2:
            count += _adsb(folder / "adsb.ast", ticks + PERIOD * rng.random(targets), traffic, rng)
    return count


def _radar(path: Path, k: int, ticks: _Array, traffic: Traffic, rng: np.random.Generator) -> int:
    """Add an hour of a radar's plots to a file."""
    site = Site(*np.radians(SITES[k]).tolist(), 500.0, 0.0)
    when = ticks + np.zeros(len(traffic.number))
    for _ in range(2):  # the beam meets a target when it points there
        latitude, longitude, _number, there = traffic.at(when)
        slant, azimuth, _up = geodetic_to_polar(np.radians(latitude), np.radians(longitude), HEIGHT, site)
        when = ticks + PERIOD * azimuth / (2.0 * np.pi)
    seen = there & (rng.random(when.shape) < 0.97)
    order = np.argsort(when[seen])
    part = path.with_suffix(".part")
    write_cat048(
        part,
        sac=25,
        sic=k + 1,
        time_of_day=np.mod(when[seen][order], 86400.0),
        range_m=(slant + rng.normal(0.0, 50.0, slant.shape))[seen][order],
        azimuth_rad=np.mod((azimuth + rng.normal(0.0, 1e-3, slant.shape))[seen][order], 2.0 * np.pi),
        altitude_m=np.full(int(seen.sum()), HEIGHT),
    )
    with path.open("ab") as whole:
        whole.write(part.read_bytes())
    part.unlink()
    return int(seen.sum())


def _adsb(path: Path, when: _Array, traffic: Traffic, rng: np.random.Generator) -> int:
    """Add an hour of ADS-B reports to a file, the newest edition of CAT021."""
    latitude, longitude, number, there = traffic.at(when)
    seen = there & (rng.random(when.shape) < 0.97)
    order = np.argsort(when[seen])
    lat, lon = (degrees + rng.normal(0.0, 15.0, when.shape) / DEGREE for degrees in (latitude, longitude))
    n = len(order)
    columns = {
        "010/SAC": np.full(n, 25),
        "010/SIC": np.full(n, 9),
        "040/ATP": np.zeros(n, np.int64),
        "073": Column(np.rint(128.0 * np.mod(when[seen][order], 86400.0)).astype(np.int64), None, None),
        "131/LAT": np.radians(lat[seen][order]),
        "131/LON": np.radians(lon[seen][order]),
        "145": np.full(n, HEIGHT),
        "080": 0x400000 + number[seen][order] % 0x10000,
    }
    data, _start = blocks(21, encode(layout(21, editions(21)[-1]), columns), np.arange(0, n, 10))
    with path.open("ab") as whole:
        whole.write(data)
    return n


def followed() -> None:
    """Be `saltus track` with the arguments given, and print its peaks of memory on the way."""
    from saltus.engine import Session
    from saltus.run import Options, track_files

    peaks: dict[str, float] = {}
    first: list[float] = []
    fed, finished = Session.feed, Session.finish

    def feed(session: Session, reports: Any, tracks: Any = None) -> Any:
        done = fed(session, reports, tracks)
        if len(reports):
            first.append(float(reports.time[0]))
            if float(reports.time[-1]) <= first[0] + 3600.0 or "hour" not in peaks:
                peaks["hour"] = _peak()
        del first[1:]
        return done

    def finish(session: Session) -> Any:
        peaks["fed"] = _peak()
        return finished(session)

    Session.feed, Session.finish = feed, finish  # type: ignore[method-assign]
    folder = Path(sys.argv[2])
    options = Options(config=folder / "a.toml", report=False)
    track_files(sorted(folder.glob("*.ast")), folder / "out", options.config, report=False)
    used = resource.getrusage(resource.RUSAGE_SELF)
    print(json.dumps({**peaks, "end": _peak(), "cpu_s": used.ru_utime + used.ru_stime}))


def _peak() -> float:
    """Peak of resident memory so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def track(folder: Path, hours: float, targets: int, systems: int) -> dict[str, float]:
    """Track one length in a process of its own."""
    n = record(folder, hours, targets, systems)
    (folder / "a.toml").write_text(config(systems))
    command = [sys.executable, __file__, "--follow", str(folder)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return {"hours": hours, "reports": n, **json.loads(done.stdout.splitlines()[-1])}


def main() -> None:
    """Run the lengths and print one row for each."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--hours", type=float, nargs="+", default=[1.0, 4.0, 12.0, 24.0])
    parser.add_argument("--targets", type=int, default=12)
    parser.add_argument("--systems", type=int, default=1, choices=(1, 2, 3))
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    rows = []
    print("| hours | reports | CPU, s | us a report | peak after 1 h, MB | when fed | at the end |")
    print("|---|---|---|---|---|---|---|")
    for hours in given.hours:
        with tempfile.TemporaryDirectory() as name:
            row = track(Path(name), hours, given.targets, given.systems)
        rows.append(row)
        per = 1e6 * row["cpu_s"] / row["reports"]
        peaks = " | ".join(f"{row[name]:.0f}" for name in ("hour", "fed", "end"))
        print(f"| {hours:g} | {row['reports']} | {row['cpu_s']:.1f} | {per:.0f} | {peaks} |", flush=True)
    if given.json is not None:
        given.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    followed() if sys.argv[1:2] == ["--follow"] else main()
