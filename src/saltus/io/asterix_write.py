"""Write simulated radar plots as ASTERIX: CAT048 target reports, CAT034 north and sector messages."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from saltus.asterix.codec import Column
from saltus.asterix.encode import Encoded, blocks, encode
from saltus.asterix.layout import editions, layout
from saltus.errors import DataError
from saltus.io.write import blamed, output_file

__all__ = ["write_cat048"]

_DAY = 86400.0  # s
_NM = 1852.0  # m
_RANGE_LSB = _NM / 256  # I048/040 RHO
_AZIMUTH_LSB = 2 * np.pi / 65536  # I048/040 THETA
_TIME_LSB = 1 / 128  # s, I048/140 and I034/030
_ALTITUDE_LSB = 25 * 0.3048  # m, I048/090: a quarter of a flight level
_PER_BLOCK = 10  # plots in one data block: what radars send in a burst


def write_cat048(
    path: Path | str,
    *,
    sac: int,
    sic: int,
    time_of_day: npt.ArrayLike,
    range_m: npt.ArrayLike,
    azimuth_rad: npt.ArrayLike,
    altitude_m: npt.ArrayLike | None = None,
    icao24: npt.ArrayLike | None = None,
    mode3a: npt.ArrayLike | None = None,
    callsign: npt.ArrayLike | None = None,
    on_ground: npt.ArrayLike | None = None,
    north_marker_times: npt.ArrayLike = (),
    n_sectors: int = 8,
) -> None:
    """Write the plots of one radar as plain ASTERIX (CAT048 and CAT034, newest editions), in time order.

    Values are rounded to the format's steps: 1/128 s, 1/256 NM, 360/65536 degrees, 25 ft. The type of detection
    (I048/020) is Mode S roll-call for plots with an address, SSR for others with a code or a height, else PSR.

    Args:
        path: file to write; replaced as a whole when writing succeeds.
        sac: system area code, 0 to 255.
        sic: system identification code, 0 to 255.
        time_of_day: (N,) s after midnight UTC of the first day; written modulo a day.
        range_m: (N,) slant range, m, below 256 NM.
        azimuth_rad: (N,) rad from north, clockwise; any turn.
        altitude_m: (N,) pressure altitude, m; NaN = none.
        icao24: (N,) Mode S address; -1 = none.
        mode3a: (N,) Mode 3/A code, 12 bits; -1 = none.
        callsign: (N,) aircraft identification of up to 8 letters, digits and spaces; "" = none.
        on_ground: (N,) 1 ground, 0 airborne, -1 = not said.
        north_marker_times: (S,) s, times at which the antenna passed north, increasing.
        n_sectors: sector crossings sent between two north markers, 2 to 256.

    Raises:
        DataError: columns differ in length, or a value does not fit its field.
    """
    time = np.asarray(time_of_day, np.float64)
    n = len(time)
    columns = {
        "range_m": _column("range_m", range_m, n, np.nan),
        "azimuth_rad": _column("azimuth_rad", azimuth_rad, n, np.nan),
        "altitude_m": _column("altitude_m", altitude_m, n, np.nan),
        "icao24": _column("icao24", icao24, n, -1.0),
        "mode3a": _column("mode3a", mode3a, n, -1.0),
        "on_ground": _column("on_ground", on_ground, n, -1.0),
    }
    names = [""] * n if callsign is None else [str(c) for c in np.asarray(callsign).tolist()]
    _check(path, time, columns, names, sac, sic)
    order = np.argsort(time, kind="stable")
    status, when = _status(sac, sic, np.asarray(north_marker_times, np.float64), n_sectors)
    plot = {name: values[order] for name, values in columns.items()}
    reports, begin = _plots(sac, sic, time[order], plot, [names[k] for k in order], when)
    at = np.argsort(np.concatenate([when, begin]), kind="stable")  # a marker before the plots of its time
    with output_file(path) as temporary, blamed(temporary):
        temporary.write_bytes(b"".join((status + reports)[k] for k in at))


def _column(name: str, values: npt.ArrayLike | None, n: int, absent: float) -> npt.NDArray[np.float64]:
    column = np.full(n, absent) if values is None else np.asarray(values, np.float64)
    if column.shape != (n,):
        raise DataError(f"{name} has shape {column.shape}, expected ({n},): one value for each time.")
    return column


def _check(
    path: Path | str,
    time: npt.NDArray[np.float64],
    columns: dict[str, npt.NDArray[np.float64]],
    names: list[str],
    sac: int,
    sic: int,
) -> None:
    """Refuse what does not fit its field: a silently wrapped value would come back as another aircraft."""
    if not (0 <= sac <= 255 and 0 <= sic <= 255):
        raise DataError(f"{path}: SAC/SIC {sac}/{sic} must each be 0 to 255.")
    if len(names) != len(time):
        raise DataError(f"callsign has {len(names)} entries, expected {len(time)}: one for each time.")
    limits = {
        "range_m": (0.0, 65535.49 * _RANGE_LSB),
        "azimuth_rad": (-1e3, 1e3),
        "altitude_m": (-8192 * _ALTITUDE_LSB, 8191 * _ALTITUDE_LSB),
        "icao24": (-1.0, 0xFFFFFF),
        "mode3a": (-1, 0o7777),
        "on_ground": (-1, 1),
    }
    bad = ~np.isfinite(time) | (time < 0)
    if bad.any():
        k = int(bad.argmax())
        raise DataError(f"{path}: time_of_day[{k}] is {time[k]}; give seconds after midnight.")
    for name, (low, high) in limits.items():
        values = columns[name]
        bad = ~((values >= low) & (values <= high)) & ~(np.isnan(values) & (name == "altitude_m"))
        if bad.any():
            k = int(bad.argmax())
            raise DataError(f"{path}: {name}[{k}] is {values[k]:g}, which must lie in {low:g} to {high:g}.")
    for k, text in enumerate(names):
        if len(text) > 8 or not all(c.isascii() and (c.isupper() or c.isdigit() or c == " ") for c in text):
            raise DataError(f"{path}: callsign[{k}] is {text!r}; use up to 8 capitals, digits, spaces.")


def _status(
    sac: int, sic: int, north: npt.NDArray[np.float64], n_sectors: int
) -> tuple[list[bytes], npt.NDArray[np.float64]]:
    """A block for each north marker, and for sector crossings spread evenly up to the next one; and their times."""
    if not (np.isfinite(north).all() and (np.diff(north) > 0).all()):
        raise DataError("north_marker_times must be finite and increasing.")
    if not 2 <= n_sectors <= 256:
        raise DataError(f"n_sectors is {n_sectors}, which must lie in 2 to 256.")
    if not len(north):
        return [], north
    turn = np.diff(north, append=2 * north[-1] - north[-2] if len(north) > 1 else north[-1])
    sector = np.arange(1, n_sectors)  # the north marker itself opens sector 0
    crossing = (north[:-1, None] + turn[:-1, None] * sector / n_sectors).ravel()
    time = np.concatenate([north, crossing])
    marker = np.arange(len(time)) < len(north)
    angle = np.concatenate([np.zeros(len(north)), np.tile((256 * sector) // n_sectors, len(north) - 1)])
    period = np.concatenate([turn, np.zeros(len(crossing))])
    columns: dict[str, npt.ArrayLike | Column] = {
        **_source(sac, sic, len(time)),
        "000": np.where(marker, 1, 2),
        "020": Column(angle.astype(np.int64), ~marker, None),
        "030": _raw_time(time),
        "041": Column(np.rint(period / _TIME_LSB).astype(np.int64), period > 0, None),
    }
    return _blocks(34, encode(layout(34, editions(34)[-1]), columns), np.arange(len(time))), time


def _plots(
    sac: int,
    sic: int,
    time: npt.NDArray[np.float64],
    plot: dict[str, npt.NDArray[np.float64]],
    names: list[str],
    breaks: npt.NDArray[np.float64],
) -> tuple[list[bytes], npt.NDArray[np.float64]]:
    """Blocks of consecutive plots, and when each begins; a block ends at every marker: file order is time order."""
    sector = np.searchsorted(np.sort(breaks), time, side="right")
    code, height, address = plot["mode3a"].astype(np.int64), plot["altitude_m"], plot["icao24"].astype(np.int64)
    ground, ssr = plot["on_ground"].astype(np.int64), (code >= 0) | ~np.isnan(height)
    columns: dict[str, npt.ArrayLike | Column] = {
        **_source(sac, sic, len(time)),
        "140": _raw_time(time),
        "020/TYP": np.select([address >= 0, ssr], [5, 2], 1),
        "040/RHO": np.rint(plot["range_m"] / _RANGE_LSB).astype(np.int64),
        "040/THETA": np.rint(plot["azimuth_rad"] / _AZIMUTH_LSB).astype(np.int64) % 65536,
        "070/MODE3A": Column(code, code >= 0, None),  # V = G = L = 0: validated, not garbled, from this reply
        "090/FL": height,
        "220": Column(address, address >= 0, None),
        "240": np.array(names, "S8"),
        "230/COM": Column(np.ones(len(time), np.int64), ground >= 0, None),
        "230/STAT": Column(ground, ground >= 0, None),
    }
    first = _starts(sector)
    return _blocks(48, encode(layout(48, editions(48)[-1]), columns), first), time[first]


def _starts(sector: npt.NDArray[np.intp]) -> npt.NDArray[np.int64]:
    """Index of the first plot of each block: a new sector, or as many plots as a block holds."""
    new = np.flatnonzero(np.diff(sector, prepend=-1))
    first = [np.arange(a, b, _PER_BLOCK) for a, b in pairwise([*new.tolist(), len(sector)])]
    return np.concatenate([np.zeros(0, np.int64), *first]).astype(np.int64)


def _source(sac: int, sic: int, n: int) -> dict[str, npt.NDArray[np.int64]]:
    return {"010/SAC": np.full(n, sac), "010/SIC": np.full(n, sic)}


def _blocks(category: int, encoded: Encoded, first: npt.NDArray[np.int64]) -> list[bytes]:
    data, start = blocks(category, encoded, first)
    return [data[a:b] for a, b in pairwise(start.tolist())]


def _raw_time(time: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    raw: npt.NDArray[np.int64] = np.rint((time % _DAY) / _TIME_LSB).astype(np.int64) % round(_DAY / _TIME_LSB)
    return raw
