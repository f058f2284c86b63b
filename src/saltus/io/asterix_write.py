"""Write simulated radar plots as ASTERIX: CAT048 target reports, CAT034 north and sector messages."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

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
    blocks = _status_blocks(sac, sic, np.asarray(north_marker_times, np.float64), n_sectors)
    breaks = [t for t, _ in blocks]
    blocks += _plot_blocks(sac, sic, time, columns, names, order, breaks)
    with output_file(path) as temporary, blamed(temporary):
        temporary.write_bytes(b"".join(block for _, block in sorted(blocks, key=lambda b: b[0])))


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


def _status_blocks(sac: int, sic: int, north: npt.NDArray[np.float64], n_sectors: int) -> list[tuple[float, bytes]]:
    """One block for each north marker, and sector crossings spread evenly up to the next one."""
    if not (np.isfinite(north).all() and (np.diff(north) > 0).all()):
        raise DataError("north_marker_times must be finite and increasing.")
    if not 2 <= n_sectors <= 256:
        raise DataError(f"n_sectors is {n_sectors}, which must lie in 2 to 256.")
    from asterix import generated

    category = generated.Cat_034_1_29

    def block(t: float, items: Mapping[str, object]) -> tuple[float, bytes]:
        common = {"010": (("SAC", sac), ("SIC", sic)), "030": _raw_time(t)}
        values: Any = {**common, **items}
        record = category.cv_record.create(values)
        return t, category.create([record]).unparse().to_bytes()

    blocks = []
    for k, t in enumerate(north.tolist()):
        after = north[k + 1] if k + 1 < len(north) else t + (t - north[k - 1] if k else 0.0)
        period = float(after) - t
        blocks.append(block(t, {"000": 1, **({"041": round(period / _TIME_LSB)} if period > 0 else {})}))
        if k + 1 < len(north):
            for sector in range(1, n_sectors):  # the north marker itself opens sector 0
                crossing = {"000": 2, "020": (256 * sector) // n_sectors}
                blocks.append(block(t + period * sector / n_sectors, crossing))
    return blocks


def _plot_blocks(
    sac: int,
    sic: int,
    time: npt.NDArray[np.float64],
    columns: dict[str, npt.NDArray[np.float64]],
    names: list[str],
    order: npt.NDArray[np.intp],
    breaks: list[float],
) -> list[tuple[float, bytes]]:
    """Blocks of consecutive plots; a block ends at every marker, so that file order stays time order."""
    from asterix import generated

    category = generated.Cat_048_1_32
    sector = np.searchsorted(np.sort(np.asarray(breaks, np.float64)), time[order], side="right")
    blocks = []
    start = 0
    for stop in range(1, len(order) + 1):
        if stop == len(order) or stop - start == _PER_BLOCK or sector[stop] != sector[start]:
            records = [
                category.cv_record.create(_items(sac, sic, time[k], {c: v[k] for c, v in columns.items()}, names[k]))
                for k in order[start:stop]
            ]
            blocks.append((float(time[order[start]]), category.create(records).unparse().to_bytes()))
            start = stop
    return blocks


def _items(sac: int, sic: int, time: float, plot: dict[str, float], name: str) -> Any:
    """Items of one I048 record as raw field values."""
    address, code, height = int(plot["icao24"]), int(plot["mode3a"]), plot["altitude_m"]
    ssr = code >= 0 or not np.isnan(height)
    kind = 5 if address >= 0 else 2 if ssr else 1
    theta = round(plot["azimuth_rad"] / _AZIMUTH_LSB) % 65536
    items: dict[str, object] = {
        "010": (("SAC", sac), ("SIC", sic)),
        "140": _raw_time(time),
        "020": ((("TYP", kind), 0, 0, 0, 0, None),),
        "040": (round(plot["range_m"] / _RANGE_LSB), theta),
    }
    if code >= 0:
        items["070"] = code  # V = G = L = 0: validated, not garbled, from this reply
    if not np.isnan(height):
        items["090"] = round(height / _ALTITUDE_LSB) % 16384  # two's complement in 14 bits
    if address >= 0:
        items["220"] = address
    if name.strip():
        items["240"] = name.ljust(8)
    if plot["on_ground"] >= 0:
        # COM = 1, STAT = 1 on ground or 0 airborne, then spare and the Mode S capability bits
        items["230"] = (1 << 13) | (int(plot["on_ground"]) << 10)
    return items


def _raw_time(t: float) -> int:
    return round((t % _DAY) / _TIME_LSB) % round(_DAY / _TIME_LSB)
