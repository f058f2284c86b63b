"""Does `saltus track` know which reports of several systems are one aircraft, on real recordings?

    python benchmarks/identification.py BARCELONA ARGENTINA [-o FILE.json]

BARCELONA holds smr.ast, adsb_v023.ast, mlat.ast and sensors.toml of one airport: a surface radar without identities,
ADS-B and multilateration. ARGENTINA holds radar_226_232.pcap, cat062_226_2.pcap and sensors.toml: a radar's plots and a
centre's tracks. Three runs, each judged by what it did not see:

* radar and ADS-B in. The referee is the address of the multilateration target within 40 m of a radar report. A radar
  track is the radar's own number; it lies on an aircraft while the referee says so. One that lies 30 s or more on an
  aircraft with ADS-B must be identified with it, no other; and reports with no multilateration target within 150 m
  must not be on a system track with an ADS-B identity. Of the radar reports within 60 m of a target whose aircraft has
  ADS-B at that time, and that are on a track, how many are on one with its address, or with another one?
* ADS-B and multilateration in, addresses hidden from both. The referee are those addresses: of the multilateration
  reports whose aircraft has an ADS-B report within 3 s and has had for 30 s, how many share a system track with it?
* The plots and the centre's tracks, codes hidden. The referee are the codes: every code that 20 plots or more and
  exactly one track of the centre have.

Prints one table and writes the same as JSON.
"""

import argparse
import json
import platform
import tempfile
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from saltus import io
from saltus.config import SensorConfig, load_config
from saltus.geo import Site
from saltus.records import Plots
from saltus.run import track_files
from saltus.tracks.measurements import default_noise, make_plane, place_plots

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

_NEAR, _ALONE = 40.0, 150.0  # m: a radar report on a target, and off all of them
_ON = 60.0  # m: a radar report of a target, of whatever track
_TOGETHER = 3.0  # s between reports that are of one time
_LONG = 30.0  # s
_FEWEST = 20  # plots of a code


class Line(NamedTuple):
    """One line of the table."""

    name: str
    value: str
    wanted: str = ""


class Run(NamedTuple):
    """Reports with their system tracks, and what the run said of systems."""

    plots: Plots
    track: Index  # of each report, -1 none
    identifications: list[dict[str, Any]]
    biases: dict[str, dict[str, Any]]
    seconds: float  # of tracking


def run(folder: Path, names: Sequence[str], identity: str) -> Run:
    """Track files of a folder and join the reports with the assignments."""
    config = load_config(folder / "sensors.toml")
    files = [folder / name for name in names]
    with tempfile.TemporaryDirectory() as out:
        summary = track_files(files, Path(out), folder / "sensors.toml", None, identity, None, None, report=False)
        assigned = pq.read_table(Path(out) / "assignments.parquet")
        found = pq.read_table(Path(out) / "identifications.parquet").to_pylist()
        biases = json.loads((Path(out) / "biases.json").read_text())["systems"]
    plots = io.read(files, date=config.date, editions=config.editions).plots
    names = [Path(name).name for name in assigned["source"].to_pylist()]
    told = zip(names, assigned["category"].to_pylist(), assigned["record"].to_pylist(), strict=True)
    of = dict(zip(told, assigned["track_id"].fill_null(-1).to_pylist(), strict=True))
    track = [of[Path(plots.files[f]).name, c, r] for f, c, r in _keys(plots)]
    seconds = summary["seconds"]
    assert isinstance(seconds, dict)
    return Run(plots, np.array(track, np.int64), found, biases, seconds["tracking"])


def position(folder: Path, names: Sequence[str]) -> tuple[Plots, Index, Array]:
    """Plane positions of the usable reports of some files, and which reports they are."""
    config = load_config(folder / "sensors.toml")
    plots = io.read([folder / n for n in names], date=config.date, editions=config.editions).plots
    sites = [_site(config.site_for(source.system)) for source in plots.sources]
    noise = {s: default_noise(source) for s, source in enumerate(plots.sources)}
    m = place_plots(plots, make_plane(plots, sites), sites, noise, config.tracker.height_prior)
    return plots, m.plot, m.position[:, :2]


def _site(sensor: SensorConfig | None) -> Site | None:
    if sensor is None or sensor.latitude is None or sensor.longitude is None:
        return None
    latitude, longitude = np.radians([sensor.latitude, sensor.longitude])
    return Site(float(latitude), float(longitude), sensor.height or 0.0)


def latest(time: Array, group: Index, value: Index, at: Array, of: Index) -> tuple[Index, Array]:
    """Value of the report nearest in time to `at` in group `of`, -1 none, and how far in time, s."""
    out, gap = np.full(len(at), -1), np.full(len(at), np.inf)
    for g in np.unique(of):
        mine, wanted = np.flatnonzero(group == g), np.flatnonzero(of == g)
        if not len(mine):
            continue
        mine = mine[np.argsort(time[mine], kind="stable")]
        k = np.searchsorted(time[mine], at[wanted])
        for j in (np.clip(k - 1, 0, len(mine) - 1), np.clip(k, 0, len(mine) - 1)):
            d = np.abs(time[mine[j]] - at[wanted])
            nearer = d < gap[wanted]
            gap[wanted[nearer]], out[wanted[nearer]] = d[nearer], value[mine[j]][nearer]
    return out, gap


def category(plots: Plots, number: int, sic: int) -> npt.NDArray[np.bool_]:
    """Which reports a source gave."""
    match = [s.system.category == number and s.system.sic == sic for s in plots.sources]
    return np.array(match)[plots.source]


def surface(folder: Path) -> list[Line]:
    """Radar and ADS-B, multilateration the referee."""
    found = run(folder, ["smr.ast", "adsb_v023.ast"], "use")
    every, at, xy = position(folder, ["smr.ast", "adsb_v023.ast", "mlat.ast"])
    radar, mlat, adsb = (category(every, *k)[at] for k in ((10, 7), (10, 107), (21, 107)))
    bias = found.biases["CAT010:0/7"]["biases"]
    offset = np.array([bias[k]["value"] for k in ("east_m", "north_m")])
    # Multilateration lies about (10, 13) m from ADS-B; the referee needs it on the radar's map to a few metres.
    address, distance = _referee(every.time[at], xy, radar, mlat, every.icao24[at], offset + np.array([10.0, 13.0]))
    time, code = every.time[at][radar], np.where(distance < _NEAR, address, -1)
    track = _tracks(found, every, at[radar])
    a = category(found.plots, 21, 107) & (found.track >= 0) & (found.plots.icao24 >= 0)
    given, gap = latest(found.plots.time[a], found.track[a], _wide(found.plots.icao24[a]), time, track)
    given = np.where(gap <= _LONG, given, -1)
    known = _wide(every.icao24[at][adsb])
    _, silence = latest(every.time[at][adsb], known, known, time, code)
    lines = _radar_tracks(every.local_id[at][radar], time, code, (code >= 0) & (silence <= _TOGETHER), given)
    lines += _named(time, np.where(distance < _ON, address, -1), (every.time[at][adsb], known), track, given)
    far = distance >= _ALONE
    share = f"{(given[far] >= 0).sum()} of {far.sum()} = {100 * (given[far] >= 0).mean():.2f} %"
    shown = ", ".join(f"{bias[k]['value']:.1f} ± {bias[k]['sd']:.1f}" for k in ("east_m", "north_m"))
    return [
        *lines,
        Line("reports off every target on a track with an ADS-B identity", share, "<= 1 %"),
        Line("radar minus ADS-B, m east and north", shown, "+5, +8 within 4"),
        Line("reports per second, whole run", f"{len(found.plots) / found.seconds:.0f}"),
    ]


def _tracks(found: Run, every: Plots, which: Index) -> Index:
    """System tracks of reports, which another reading of the files numbers otherwise."""
    of = {
        (Path(found.plots.files[f]).name, c, r): t for (f, c, r), t in zip(_keys(found.plots), found.track, strict=True)
    }
    keys = _keys(every)
    return np.array([of[(Path(every.files[keys[k][0]]).name, *keys[k][1:])] for k in which.tolist()], np.int64)


def _wide(codes: npt.NDArray[np.integer]) -> Index:
    return codes.astype(np.int64)


def _keys(plots: Plots) -> list[tuple[int, int, int]]:
    cat = [s.system.category or -1 for s in plots.sources]
    return [(int(f), cat[s], int(r)) for f, s, r in zip(plots.file, plots.source, plots.record, strict=True)]


def _referee(
    time: Array, xy: Array, radar: npt.NDArray[np.bool_], mlat: npt.NDArray[np.bool_], icao24: Index, shift: Array
) -> tuple[Index, Array]:
    """Address of the nearest multilateration target of the same time (3 s) of each radar report, and its distance."""
    from scipy.spatial import cKDTree

    speed = 50.0  # m per s of difference in time
    tree = cKDTree(np.column_stack([xy[mlat] + shift, speed * time[mlat]]))
    code, when, place = icao24[mlat], time[mlat], xy[mlat] + shift
    address, distance = np.full(int(radar.sum()), -1), np.full(int(radar.sum()), np.inf)
    points = np.column_stack([xy[radar], speed * time[radar]])
    for k, near in enumerate(tree.query_ball_point(points, 2.0 * _ALONE)):
        near = np.array([j for j in near if abs(when[j] - time[radar][k]) <= _TOGETHER], dtype=np.int64)
        if len(near):
            d = np.linalg.norm(place[near] - xy[radar][k], axis=-1)
            address[k], distance[k] = code[near[d.argmin()]], d.min()
    return address, distance


def _radar_tracks(own: Index, time: Array, code: Index, equipped: npt.NDArray[np.bool_], given: Index) -> list[Line]:
    """Judge each of the radar's tracks by the identity that most of its identified reports have."""
    wanted, missed, false, reports, strange = 0, [], 0, 0, 0
    seen = []
    for number in np.unique(own):
        rows = np.flatnonzero(own == number)
        for part in np.split(rows, np.flatnonzero(np.diff(time[rows]) > _LONG) + 1):
            for address in np.unique(code[part][equipped[part]]):
                on = part[(code[part] == address) & equipped[part]]
                if np.ptp(time[on]) >= _LONG and len(on) >= _LONG:
                    seen.append((int(number), int(address), on))
    for _, address, on in seen:
        wanted += 1
        identified = given[on][given[on] >= 0]
        reports, strange = reports + len(on), strange + int((identified != address).sum())
        if not (identified == address).any():
            missed.append((address, on))
        elif 2 * (identified != address).sum() > len(identified):
            false += 1
    second = sum(
        any(_meets(time, on, other) for a, other in _others(seen, given, address, on)) for address, on in missed
    )
    return [
        Line("radar tracks 30 s or more on an aircraft with ADS-B", str(wanted), "about 45"),
        Line("  never identified with it", str(len(missed)), "<= 1"),
        Line("    of these second echoes of an aircraft identified meanwhile", str(second)),
        Line("  identified with another aircraft", str(false), "0"),
        Line("    reports on a track of another aircraft", f"{strange} of {reports}"),
    ]


def _named(time: Array, code: Index, sent: tuple[Array, Index], track: Index, given: Index) -> list[Line]:
    """Judge each radar report on an aircraft that sends ADS-B at that time by the identity of its system track.

    Args:
        time: of the radar reports, s.
        code: address of the aircraft that each is of, by the referee, -1 none.
        sent: times and addresses of the ADS-B reports.
        track: system track of each radar report, -1 none.
        given: address that each radar report got, -1 none.
    """
    _, silence = latest(sent[0], sent[1], sent[1], time, code)
    every = (code >= 0) & (silence <= _TOGETHER)
    on = every & (track >= 0)
    middle = np.median(time)
    halves = [on & (time <= middle), on & (time > middle)]

    def shares(hit: npt.NDArray[np.bool_]) -> str:
        return f"{100.0 * hit[on].mean():.2f} % ({', '.join(f'{100.0 * hit[h].mean():.2f}' for h in halves)})"

    return [
        Line("reports on aircraft that have ADS-B at that time", f"{every.sum()}, {on.sum()} of them on tracks"),
        Line("  with the right address (first half, second half)", shares(given == code), ">= 97 %"),
        Line("  with a false one", shares((given >= 0) & (given != code)), "<= 0.05 %"),
    ]


def _others(seen: list[tuple[int, int, Index]], given: Index, address: int, on: Index) -> list[tuple[int, Index]]:
    """Other radar tracks of an aircraft that were identified with it, where they were."""
    return [(n, rows[given[rows] == address]) for n, a, rows in seen if a == address and rows is not on]


def _meets(time: Array, on: Index, other: Index) -> bool:
    return bool(len(other)) and time[other].min() < time[on].max() and time[other].max() > time[on].min()


def hidden(folder: Path) -> list[Line]:
    """ADS-B against multilateration, addresses hidden."""
    found = run(folder, ["adsb_v023.ast", "mlat.ast"], "ignore")
    plots = found.plots
    mlat, adsb = category(plots, 10, 107), category(plots, 21, 107)
    usable = (plots.icao24 >= 0) & np.isfinite(plots.time) & (plots.reason == 0)
    m, a = np.flatnonzero(mlat & usable), np.flatnonzero(adsb & usable)
    code = plots.icao24.astype(np.int64)
    _, silence = latest(plots.time[a], code[a], code[a], plots.time[m], code[m])
    common = np.intersect1d(code[m], code[a])
    begun = {int(c): max(plots.time[m][code[m] == c].min(), plots.time[a][code[a] == c].min()) for c in common}
    since = plots.time[m] - np.array([begun.get(int(c), np.inf) for c in code[m]])
    both = (silence <= _TOGETHER) & (found.track[m] >= 0)
    tracked = a[found.track[a] >= 0]
    other, gap = latest(plots.time[tracked], found.track[tracked], code[tracked], plots.time[m], found.track[m])
    decided = both & (gap <= _TOGETHER)
    right = decided & (other == code[m])
    settled = both & (since >= _LONG)
    share = 100.0 * right.sum() / max(decided.sum(), 1)
    wrong = 100.0 * (decided & ~right).sum() / max(both.sum(), 1)
    of, bias = next((name, table["biases"]) for name, table in found.biases.items() if "biases" in table)
    return [
        Line("reports seen by both", str(int(both.sum()))),
        Line("  of those on a common track: with its own ADS-B", f"{share:.3f} %", ">= 99.9 %"),
        Line("  with another aircraft's ADS-B, of all", f"{wrong:.2f} %", "<= 0.2 %"),
        Line("  identified, 30 s after both began or later", f"{100 * (right & settled).sum() / settled.sum():.2f} %"),
        Line(f"{of} minus the reference, m and s", ", ".join(f"{k} {v['value']} ± {v['sd']}" for k, v in bias.items())),
    ]


def centre(folder: Path) -> list[Line]:
    """A radar's plots against a centre's tracks, codes hidden."""
    names = ["radar_226_232.pcap", "cat062_226_2.pcap"]
    found = run(folder, names, "ignore")
    config = load_config(folder / "sensors.toml")
    table = io.read([folder / n for n in names], date=config.date, editions=config.editions).tracks
    assert isinstance(table, pa.Table)
    plots = found.plots
    radar = category(plots, 48, 232) & (plots.mode3a >= 0)
    number = np.array(table["track_number"].to_pylist())
    code = np.array([int(c, 8) if c else -1 for c in table["mode3a"].to_pylist()])
    of_number = {int(n): {int(c) for c in np.unique(code[number == n]) if c >= 0} for n in np.unique(number)}
    linked: dict[object, set[int]] = {}
    for row in found.identifications:
        if str(row["system"]).startswith("CAT062"):
            linked.setdefault(row["track_id"], set()).add(int(str(row["local_id"])))
    wanted, right, false = [], [], []
    for c in np.unique(plots.mode3a[radar]):
        mine = radar & (plots.mode3a == c)
        numbers = [n for n, codes in of_number.items() if c in codes]
        if mine.sum() < _FEWEST or not numbers:
            continue
        got = {n for t in np.unique(found.track[mine & (found.track >= 0)]) for n in linked.get(int(t), set())}
        false += [f"{c:04o}" for n in got if c not in of_number[n]]
        if len(numbers) == 1:
            wanted.append(f"{c:04o}")
            right += [f"{c:04o}"] * (numbers[0] in got)
    azimuth = next(v for k, v in found.biases.items() if k.startswith("CAT048"))["biases"].get("azimuth_deg")
    shown = f"{azimuth['value']} ± {azimuth['sd']}" if azimuth else "not found"
    missing = ", ".join(sorted(set(wanted) - set(right)))
    wrong = ", ".join(sorted(set(false)))
    return [
        Line("azimuth of the plots minus that of the centre's tracks, degrees", shown, "0.6 in size"),
        Line("codes with 20 plots and one track of the centre", str(len(wanted))),
        Line("  identified with that track", f"{len(right)}" + (f" (not {missing})" if missing else ""), "all"),
        Line("  identified with a track of another code", str(len(set(false))) + (f" ({wrong})" if wrong else ""), "0"),
    ]


def main() -> None:
    """Run all three and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("barcelona", type=Path)
    parser.add_argument("argentina", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).with_name("results_identification.json"))
    args = parser.parse_args()
    began = time.perf_counter()
    parts = {
        "surface radar and ADS-B": surface(args.barcelona),
        "ADS-B and multilateration, addresses hidden": hidden(args.barcelona),
        "radar plots and a centre's tracks, codes hidden": centre(args.argentina),
    }
    for title, lines in parts.items():
        print(f"\n{title}")
        for line in lines:
            print(f"  {line.name:<66} {line.value:<40} {line.wanted}")
    result = {
        "saltus": version("saltus"),
        "machine": platform.processor() or platform.machine(),
        "seconds": round(time.perf_counter() - began, 1),
        "parts": {title: [line._asdict() for line in lines] for title, lines in parts.items()},
    }
    args.output.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
